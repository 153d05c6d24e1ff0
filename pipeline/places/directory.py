"""A dataset in a directory: files are written, synced and renamed over the old ones; the lock is the kernel's.

Its parts are plain files and folders: see `pipeline.places.plain`. The directory itself may be reached through links,
though not through those by which another user leads to what is not that user's.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import IO

from stickslip.pipeline.errors import StoreError, printable
from stickslip.pipeline.machine.memory import COPIES, is_hollow, lack
from stickslip.pipeline.places import plain
from stickslip.pipeline.places.place import (
    DATA,
    LOCK,
    MANIFEST,
    PACKAGE,
    SCENE,
    TIMINGS,
    Hold,
    Place,
    check_size,
    part,
    this_process,
)

#: What a dataset has, and of which kind it is.
_PARTS = {
    **dict.fromkeys((SCENE, MANIFEST, TIMINGS, LOCK, PACKAGE, "report.html"), stat.S_IFREG),
    **dict.fromkeys((DATA, "report", "compared"), stat.S_IFDIR),
}


class Directory(Place):
    """A directory of the local file system, or of one that is mounted.

    Parameters
    ----------
    inner : tuple of str
        Folders below it, in which the files are.
    """

    def __init__(self, path: Path, inner: tuple[str, ...] = ()) -> None:
        self._root, self._inner = path, inner
        self.path = path.joinpath(*inner)
        self.address = str(self.path)
        self._owned: os.stat_result | None = None  # the directory that is written, while it is

    @property
    def from_anywhere(self) -> Directory:
        return Directory(self._root.absolute(), self._inner)

    def below(self, name: str) -> Directory:
        return Directory(self._root, (*self._inner, *name.split("/")))

    def named(self, name: str) -> str:
        return str(self.path / name)

    @contextlib.contextmanager
    def _folder(self, inner: Sequence[str] = (), is_made: bool = False) -> Iterator[int]:
        """Descriptor of the directory, or of a folder in it."""
        with plain.folder(self._root, (*self._inner, *inner), is_made, self._owned) as directory:
            yield directory

    @contextlib.contextmanager
    def _holding(self, name: str) -> Iterator[tuple[str, int]]:
        """A file's last name, and a descriptor of the folder that it is in."""
        *inner, name_there = name.split("/")
        with self._folder(inner) as directory:
            yield name_there, directory

    def opened(self, name: str) -> int:
        """Descriptor of a plain file, to read."""
        with self._holding(name) as (name_there, directory):
            return plain.opened(name_there, directory, self.path / name)

    def read(self, name: str) -> bytes:
        with open(self.opened(name), "rb") as stream, plain.filename(self.path / name):
            return _content(stream, is_shard=name.startswith(f"{DATA}/"))

    def sizes(self, names: Sequence[str]) -> list[int | None]:
        return [self._size(name) for name in names]

    def _size(self, name: str) -> int | None:
        with contextlib.suppress(FileNotFoundError), self._holding(name) as (name_there, directory):
            status = plain.status(name_there, directory)
            if status is not None:
                plain.check(status, self.path / name)
                return status.st_size
        return None

    def replace(self, name: str, content: bytes) -> None:
        self.replace_all({name: lambda: content})

    def replace_all(self, files: Mapping[str, Callable[[], bytes]]) -> None:
        """All are written before the first old one is replaced: a disk that is full leaves these."""
        replacements: list[plain.Replacement] = []
        with contextlib.ExitStack() as stack:
            inner = dict.fromkeys(tuple(name.split("/")[:-1]) for name in files)
            folders = {names: stack.enter_context(self._folder(names, is_made=True)) for names in inner}
            for name, content in files.items():
                *above, name_there = name.split("/")
                new = plain.Replacement(name_there, folders[tuple(above)], self.path / name)
                replacements.append(stack.enter_context(new))
                new.write(content())
            for directory, group in groupby(replacements, lambda new: new.directory):
                for new in group:
                    new.put()
                os.fsync(directory)

    def remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError), self._holding(name) as (name_there, directory):
            os.unlink(name_there, dir_fd=directory)

    def make(self) -> None:
        """Create the directory, and those above it, if it is not there."""
        with (
            plain.way(self._root, plain.refusal_of(self._root), is_made=True) as (folder, name, _),
            contextlib.suppress(FileExistsError),
            plain.filename(self._root),
        ):
            os.mkdir(name, dir_fd=folder)

    def remove_left(self) -> None:
        """Remove what killed processes of this machine left unfinished here and where reports are."""
        for inner in ((), ("report",), ("report", "figures")):
            with contextlib.suppress(FileNotFoundError), self._folder(inner) as directory:
                plain.remove_left(directory)

    def names(self) -> list[str]:
        if not self.path.exists():
            return []
        if not self.path.is_dir():
            raise StoreError(f"{self.path}: expected a directory, got a file; choose another directory")
        names = self._listed()
        return sorted([*names, *(f"{DATA}/{name}" for name in (self._listed(DATA) if DATA in names else ()))])

    def _listed(self, *inner: str) -> list[str]:
        with self._folder(inner) as directory:
            return os.listdir(directory)

    def check_parts(self) -> None:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), self._folder() as directory:
            for name, kind in _PARTS.items():
                status = plain.status(name, directory)
                if status is not None:
                    plain.check(status, self.path / name, kind)

    @contextlib.contextmanager
    def own(self) -> Iterator[Hold]:
        self.make()
        with self._folder() as directory:
            lock = _Locked(_acquire(directory, self.path), directory)
            self._owned = os.fstat(directory)
            try:
                yield lock
            finally:
                # removed while held: a process that has opened it meanwhile sees that the name is gone, and retries
                lock.give_back()
                self._owned = None
                os.close(lock.descriptor)

    @contextlib.contextmanager
    def record(self, name: str) -> Iterator[Callable[[bytes], None]]:
        name = part(name, max(len(self._parts(name)) - 1, 0))
        with self._holding(name) as (name_there, directory):
            descriptor = plain.opened(name_there, directory, self.path / name, os.O_RDWR | os.O_APPEND | os.O_CREAT)
        with open(descriptor, "rb+", buffering=0) as stream:
            with plain.filename(self.path / name):
                lines = _content(stream).rpartition(b"\n")
                stream.truncate(len(lines[0]) + len(lines[1]))
            yield lambda line: _append(descriptor, line)


def _content(stream: IO[bytes], is_shard: bool = False) -> bytes:
    """All of an open file, if this machine can hold it, and a part that is no shard if it can be so large."""
    status = os.fstat(stream.fileno())
    if not is_shard:
        check_size(status.st_size)
    with contextlib.suppress(MemoryError):
        if not is_hollow(status) and not lack(COPIES * status.st_size, ""):
            return stream.read(status.st_size)
    raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))


@dataclass
class _Locked(Hold):
    descriptor: int
    directory: int

    def note(self, line: str) -> None:
        with contextlib.suppress(OSError):
            os.write(self.descriptor, f"{line}\n".encode())

    def check(self) -> None:
        pass  # the kernel's lock is not lost

    def give_back(self) -> None:
        with contextlib.suppress(OSError):
            os.unlink(LOCK, dir_fd=self.directory)


def _acquire(directory: int, path: Path) -> int:
    """An exclusive lock on the lock file in an open directory, as a descriptor that holds it until it is closed."""
    while True:
        descriptor = plain.opened(LOCK, directory, path / LOCK, os.O_RDWR | os.O_CREAT)
        if not is_locked(descriptor):
            owner = os.read(descriptor, 200).decode(errors="replace").partition("\n")[0]
            os.close(descriptor)
            raise StoreError(
                f"{path}: expected to be its only writer, got a lock held by "
                f"{printable(owner) or 'another process'}; wait for it to end, or choose another directory"
            )
        status = plain.status(LOCK, directory)
        if status is not None and os.path.samestat(os.fstat(descriptor), status):
            os.truncate(descriptor, 0)
            with contextlib.suppress(OSError):  # a full disk: the lock then does not name its owner
                os.write(descriptor, f"{this_process()}\n".encode())
            return descriptor
        os.close(descriptor)  # its last owner removed it between our opening and our locking


def is_locked(descriptor: int) -> bool:
    """Try to lock an open file for this process alone, until it is closed; whether that worked."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _append(descriptor: int, line: bytes) -> None:
    """Append a line durably, whole or not at all."""
    size = os.fstat(descriptor).st_size
    try:
        if os.write(descriptor, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(descriptor)
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(descriptor, size)
        raise
