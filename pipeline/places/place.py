"""Where a dataset lies: a directory, or a prefix of an object store; what is asked of either is the same."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

SCENE, MANIFEST, TIMINGS, LOCK, DATA = "scene.toml", "manifest.json", "timings.jsonl", ".lock", "data"
#: What the names of files begin with while they are being written.
TEMPORARY = ".tmp-"
#: Parts of a file of lines that are asked for at once.
_PARTS = 16


class Hold(ABC):
    """The right to write in a place, while it is held."""

    @abstractmethod
    def note(self, line: str) -> None:
        """Add a line to the lock, for processes that look who is writing."""

    @abstractmethod
    def check(self) -> None:
        """Raise `StoreError` if the right was lost to another."""

    @abstractmethod
    def give_back(self) -> None:
        """Remove the lock, if it is ours."""


@dataclass(frozen=True)
class Lock:
    """What a lock says: its owner, what the owner noted, and, in an object store, until when it holds and a token."""

    owner: str
    notes: dict[str, str]
    until: float | None  #: None: no lease, the kernel knows whether it is held
    token: str

    @classmethod
    def parse(cls, content: bytes) -> Lock:
        """Read a lock; a lease that cannot be read is void."""
        owner, *lines = content.decode(errors="replace").splitlines() or [""]
        notes = dict(line.partition(" ")[::2] for line in lines)
        if "lease" not in notes:
            return cls(owner, notes, None, "")
        until, _, token = notes.pop("lease").partition(" ")
        try:
            return cls(owner, notes, float(until), token)
        except ValueError:
            return cls(owner, notes, 0.0, token)

    @property
    def remaining(self) -> float:
        """Seconds that a lease still runs."""
        return max(0.0, (self.until or 0.0) - time.time())

    @property
    def is_held(self) -> bool:
        """Whether it is held, by what it says."""
        return self.until is None or self.remaining > 0.0


@dataclass(frozen=True)
class Mark:
    """What differs once a file has changed."""

    size: int
    version: object


class Place(ABC):
    """A directory or a prefix; names are relative to it and have ``/`` between their parts.

    All methods raise `OSError` with its `strerror` and `filename` set if they are refused.
    """

    address: str
    remedy: str  #: what to do about a file that cannot be read

    def __str__(self) -> str:
        return self.address

    @abstractmethod
    def named(self, name: str) -> str:
        """What messages call the file `name`."""

    @abstractmethod
    def read(self, name: str) -> bytes:
        """The content of a file."""

    @abstractmethod
    def marks(self, names: Sequence[str]) -> list[Mark | None]:
        """The mark of each file, which is had without reading it; None: no file."""

    def read_each(self, names: Sequence[str]) -> Iterator[bytes | None]:
        """The content of each file, in order; None for one that is not there."""
        yield from map(self._read_if_there, names)

    def _read_if_there(self, name: str) -> bytes | None:
        try:
            return self.read(name)
        except FileNotFoundError:
            return None

    @abstractmethod
    def replace(self, name: str, content: bytes) -> None:
        """Give a file new content in one step that a crash cannot divide."""

    @abstractmethod
    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""

    @abstractmethod
    def names(self) -> list[str]:
        """Files and directories here and in `DATA`, sorted; none if there is nothing at the address."""

    @abstractmethod
    def own(self) -> contextlib.AbstractContextManager[Hold]:
        """The right to write here, for the length of a with-block.

        Raises
        ------
        StoreError
            If another process has it.
        """

    @abstractmethod
    def record(self, name: str) -> contextlib.AbstractContextManager[Callable[[bytes], None]]:
        """A file of lines and how to append one for good, whole or not at all; a line that a crash cut short goes."""

    def read_record(self, name: str) -> bytes:
        """The content of a file of lines, all its parts together; empty if there is none."""
        return b"".join(self._parts(name))

    def _parts(self, name: str) -> list[bytes]:
        """An object cannot grow: in a store, and in a copy of one, a file of lines may have many parts."""
        parts: list[bytes] = []
        while True:
            asked = range(len(parts), len(parts) + _PARTS)
            found = [content for content in self.read_each([part(name, k) for k in asked]) if content is not None]
            parts += found
            if len(found) < _PARTS:
                return parts

    @property
    @abstractmethod
    def arrow(self) -> Any:
        """The file system by which Arrow reads here; None: the local one."""

    @abstractmethod
    def key(self, name: str) -> str:
        """What `arrow` calls the file `name`."""


def part(name: str, k: int) -> str:
    """What the k-th part of a file of lines is called."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}-{k}{dot}{ending}" if k else name


Where: TypeAlias = str | os.PathLike[str] | Place


def this_process() -> str:
    """Who writes, as a lock says it."""
    return f"process {os.getpid()} on {socket.gethostname()}"
