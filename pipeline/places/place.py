"""Where a dataset is stored: a directory, or a prefix of an object store, behind one interface."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

from stickslip.pipeline.errors import remedy

SCENE, MANIFEST, TIMINGS, LOCK, DATA = "scene.toml", "manifest.json", "timings.jsonl", ".lock", "data"
PACKAGE = "datapackage.json"
#: Prefix of the names of files while they are being written.
TEMPORARY = ".tmp-"
#: Files that are read, or written, at once.
AT_ONCE = 16
#: Bytes of a part that is no shard: a manifest of a million shards has fewer.
_MOST = 2**29
#: Who holds a lock, as `this_process` says it.
_OWNER = re.compile(r"process ([0-9]{1,10}) on (.+)")
#: The largest number that a lock can hold.
_LARGEST = 1e15


def check_size(n_bytes: int) -> None:
    """Raise `OSError` if a part that is no shard has more bytes than it can have."""
    if n_bytes > _MOST:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))


class Hold(ABC):
    """The right to write in a place, while it is held."""

    @abstractmethod
    def note(self, line: str) -> None:
        """Add a line to the lock, for processes that ask who is writing."""

    @abstractmethod
    def check(self) -> None:
        """Raise `StoreError` if the right was lost to another."""

    @abstractmethod
    def give_back(self) -> None:
        """Remove the lock, if it is ours."""


@dataclass(frozen=True)
class Lock:
    """The content of a lock: its owner, the owner's notes and, in an object store, a token and when it expires."""

    owner: str
    pid: int
    host: str
    notes: dict[str, str]
    until: float | None  #: None: no lease, the kernel knows whether it is held
    token: str

    @classmethod
    def parse(cls, content: bytes) -> Lock | None:
        """Read a lock; None if it is none of ours. A lease that cannot be read is void."""
        owner, *lines = content.decode(errors="replace").splitlines() or [""]
        match = _OWNER.fullmatch(owner)
        if match is None:
            return None
        notes = dict(line.partition(" ")[::2] for line in lines)
        until, token = None, ""
        if "lease" in notes:
            words, _, token = notes.pop("lease").partition(" ")
            until = 0.0
            with contextlib.suppress(ValueError):
                until = number(words)
        return cls(owner, int(match[1]), match[2], notes, until, token)

    @classmethod
    def is_one(cls, content: bytes) -> bool:
        """Whether it is a lock of ours, or what a crash leaves of one: nothing, or the beginning of a line."""
        return cls.parse(content) is not None or (b"\n" not in content and b"process "[: len(content)] == content[:8])

    @property
    def remaining(self) -> float:
        """Seconds that a lease still runs."""
        return max(0.0, (self.until or 0.0) - time.time())

    @property
    def is_held(self) -> bool:
        """Whether it is held, by what it says."""
        return self.until is None or self.remaining > 0.0


def number(word: str) -> float:
    """A number of a lock; `ValueError` if it is none, or none that a lock can hold."""
    value = float(word)
    if not abs(value) <= _LARGEST:
        raise ValueError(f"expected a number of at most {_LARGEST:g}, got {value}")
    return value


class Place(ABC):
    """A directory or a prefix; names are relative to it and have ``/`` between their parts.

    All methods raise `OSError` with its `strerror` and `filename` set if they are refused.
    """

    address: str

    def __str__(self) -> str:
        return self.address

    def remedy(self, error: Exception) -> str:
        """What to do about a file that cannot be read."""
        return remedy(error)

    @abstractmethod
    def named(self, name: str) -> str:
        """The file `name` as messages show it."""

    @abstractmethod
    def below(self, name: str) -> Place:
        """A place in this one, whose parts are parts of it."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """The content of a file."""

    @abstractmethod
    def sizes(self, names: Sequence[str]) -> list[int | None]:
        """The bytes of each file, found without reading it; None if there is no such file."""

    def read_each(self, names: Sequence[str]) -> Iterator[bytes | None]:
        """The content of each file, in order; None for one that is not there."""
        yield from map(self._read_if_there, names)

    def read_sized(self, expected: Mapping[str, int]) -> Iterator[bytes | int | None]:
        """The content of each file if it has the size that is expected; else its size, or None if it is gone."""
        sizes = dict(zip(expected, self.sizes(list(expected)), strict=True))
        contents = self.read_each([name for name, size in sizes.items() if size == expected[name]])
        for name, size in sizes.items():
            yield next(contents) if size == expected[name] else size

    @abstractmethod
    def check_parts(self) -> None:
        """Refuse a dataset of which a part is no plain file or folder, without opening any.

        Raises `StoreError` if one is something else, as a link, which leads out of it.
        """

    def _read_if_there(self, name: str) -> bytes | None:
        try:
            return self.read(name)
        except FileNotFoundError:
            return None

    @abstractmethod
    def replace(self, name: str, content: bytes) -> None:
        """Replace the content of a file in one step: a crash leaves the old or the new."""

    @property
    def from_anywhere(self) -> Place:
        """The same for processes that were started in another directory."""
        return self

    def replace_all(self, files: Mapping[str, Callable[[], bytes]]) -> None:
        """As `replace`, one file after the other, of which each is made when it is written."""
        for name, content in files.items():
            self.replace(name, content())

    def replace_each(self, contents: Mapping[str, bytes]) -> None:
        """As `replace`, for each file; if one is refused, others may be there or not."""
        with ThreadPoolExecutor(AT_ONCE) as pool:  # most of the time is waiting, for a disk as for a store
            list(pool.map(self.replace, contents, contents.values()))

    @abstractmethod
    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""

    @abstractmethod
    def names(self) -> list[str]:
        """Files and directories here and in `DATA`, sorted; none if there is nothing at the address."""

    @abstractmethod
    def own(self) -> contextlib.AbstractContextManager[Hold]:
        """The right to write here, for the length of a with-block.

        Raises `StoreError` if another process has it.
        """

    @abstractmethod
    def record(self, name: str) -> contextlib.AbstractContextManager[Callable[[bytes], None]]:
        """A function that appends lines to a file, durably; a line that a crash cut short is removed."""

    def read_record(self, name: str) -> bytes:
        """The content of a file of lines, all its parts together; empty if there is none."""
        return b"".join(self._parts(name))

    def _parts(self, name: str) -> list[bytes]:
        """An object cannot grow: in a store, and in a copy of one, a file of lines may have many parts."""
        contents: list[bytes] = []
        while True:
            n_before = len(contents)
            for content in self.read_each([part(name, n_before + k) for k in range(AT_ONCE)]):
                if content is not None:
                    contents.append(content)
                    check_size(sum(map(len, contents)))
            if len(contents) < n_before + AT_ONCE:
                return contents


def part(name: str, k: int) -> str:
    """What the k-th part of a file of lines is called."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}-{k}{dot}{ending}" if k else name


Where: TypeAlias = str | os.PathLike[str] | Place


def this_process() -> str:
    """This process, as a lock names it."""
    return f"process {os.getpid()} on {socket.gethostname()}"
