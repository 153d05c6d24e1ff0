"""A dataset in a directory: files are written, synced and renamed over the old ones; the lock is the kernel's."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.place import DATA, LOCK, TEMPORARY, Hold, Mark, Place, part, this_process


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[BinaryIO]:
    """A stream for the new content of a file, which replaces the old in one step if the with-block succeeds."""
    temporary = _temporary(file)
    try:
        with _synced(temporary) as stream:
            yield stream
        os.replace(temporary, file)
    except BaseException:
        _remove(temporary)
        raise
    _sync(file.parent)


def _temporary(file: Path) -> Path:
    return file.with_name(f"{_begun(file)}{os.getpid()}")


@contextlib.contextmanager
def _synced(file: Path) -> Iterator[BinaryIO]:
    """A stream for a file whose content is on the disk after the with-block."""
    with open(file, "wb") as stream:
        yield stream
        stream.flush()
        os.fsync(stream.fileno())


def _remove(*temporary: Path) -> None:
    for file in temporary:
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    directory = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _begun(file: Path) -> str:
    """Prefix of the temporary copies of a file that this machine's processes write; the process id follows."""
    return f"{TEMPORARY}{file.name}-{socket.gethostname()}-"


def remove_left(folder: Path, name: str = "") -> None:
    """Remove the unfinished copies that killed processes of this machine left in a folder, of one file or of all."""
    of = re.escape(name) if name else ".*"
    left = re.compile(rf"{re.escape(TEMPORARY)}{of}-{re.escape(socket.gethostname())}-(\d{{1,9}})")
    for one in folder.iterdir():
        if (found := left.fullmatch(one.name)) and not is_alive(int(found[1])):
            with contextlib.suppress(OSError):  # another user's file stays
                one.unlink()


def is_alive(pid: int) -> bool:
    """Whether this machine has a process of that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # somebody else's, or of another system
        pass
    return True


class Directory(Place):
    """A directory of the local file system, or of one that is mounted."""

    arrow = None
    remedy = "check its permissions"

    def __init__(self, path: Path) -> None:
        self.path, self.address = path, str(path)

    @property
    def from_anywhere(self) -> Directory:
        return Directory(self.path.absolute())

    def named(self, name: str) -> str:
        return str(self.path / name)

    key = named

    def read(self, name: str) -> bytes:
        return (self.path / name).read_bytes()

    def marks(self, names: Sequence[str]) -> list[Mark | None]:
        return [self._mark(name) for name in names]

    def _mark(self, name: str) -> Mark | None:
        with contextlib.suppress(OSError):
            found = (self.path / name).stat()
            return Mark(found.st_size, (found.st_ino, found.st_mtime_ns, found.st_ctime_ns))
        return None

    def replace(self, name: str, content: bytes) -> None:
        file = self.path / name
        file.parent.mkdir(exist_ok=True)
        with replacing(file) as stream:
            stream.write(content)

    def replace_all(self, files: Mapping[str, Callable[[], bytes]]) -> None:
        """All are written before the first old one is replaced: a disk that is full leaves these."""
        begun = {self.path / name: _temporary(self.path / name) for name in files}
        try:
            for content, (file, temporary) in zip(files.values(), begun.items(), strict=True):
                file.parent.mkdir(exist_ok=True)
                with _synced(temporary) as stream:
                    stream.write(content())
            for folder, some in groupby(begun, lambda file: file.parent):
                for file in some:
                    os.replace(begun[file], file)
                _sync(folder)
        except BaseException:
            _remove(*begun.values())
            raise

    def remove(self, name: str) -> None:
        (self.path / name).unlink(missing_ok=True)

    def names(self) -> list[str]:
        if not self.path.exists():
            return []
        if not self.path.is_dir():
            raise StoreError(f"{self.path}: expected a directory, got a file; choose another directory")
        data = self.path / DATA
        files = [*self.path.iterdir(), *(data.iterdir() if data.is_dir() else ())]
        return sorted(file.relative_to(self.path).as_posix() for file in files)

    @contextlib.contextmanager
    def own(self) -> Iterator[Hold]:
        self.path.mkdir(parents=True, exist_ok=True)
        file = self.path / LOCK
        descriptor = _acquire(file)
        lock = _Locked(file)
        try:
            yield lock
        finally:
            # removed while held: a process that has opened it meanwhile sees that the name is gone, and retries
            lock.give_back()
            os.close(descriptor)

    @contextlib.contextmanager
    def record(self, name: str) -> Iterator[Callable[[bytes], None]]:
        file = self.path / part(name, max(len(self._parts(name)) - 1, 0))
        if file.exists():
            whole = file.read_bytes().rpartition(b"\n")
            os.truncate(file, len(whole[0]) + len(whole[1]))
        descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            yield lambda line: _append(descriptor, line)
        finally:
            os.close(descriptor)


@dataclass
class _Locked(Hold):
    file: Path

    def note(self, line: str) -> None:
        with contextlib.suppress(OSError), open(self.file, "a", encoding="utf-8") as lock:
            lock.write(line + "\n")

    def check(self) -> None:
        pass  # the kernel's lock is not lost

    def give_back(self) -> None:
        with contextlib.suppress(OSError):
            self.file.unlink(missing_ok=True)


def _acquire(file: Path) -> int:
    """An exclusive lock on a file, as a descriptor that holds it until it is closed."""
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        if not is_locked(descriptor):
            owner = os.read(descriptor, 200).decode(errors="replace").partition("\n")[0]
            os.close(descriptor)
            raise StoreError(
                f"{file.parent}: expected to be its only writer, got a lock held by "
                f"{owner or 'another process'}; wait for it to end, or choose another directory"
            )
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
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
