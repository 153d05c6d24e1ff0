"""Where a dataset lies: a directory, or a prefix of an object store; what is asked of either is the same.

A directory: a file is replaced by writing beside it, syncing and renaming, and its lock is the kernel's, which a
crash releases at once.

An object store, by any address that fsspec knows (``s3://bucket/dir``, ``gs://``, ``memory://``): see
`stickslip.pipeline.object_store`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from stickslip.pipeline.errors import StoreError

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


def place_of(where: Where) -> Place:
    """The place at a path or an address.

    Raises
    ------
    StoreError
        If the address is of no store that fsspec knows, or the package for it is missing.
    """
    if isinstance(where, Place):
        return where
    if not (isinstance(where, str) and "://" in where):
        return Directory(Path(where))
    address = where.rstrip("/")
    protocol, _, path = address.partition("://")
    if protocol in ("file", "local"):
        return Directory(Path(path))
    if not path.strip("/"):
        raise StoreError(f"{where}: expected an address such as s3://bucket/dir, got only its beginning")
    import fsspec  # with what it loads, a tenth of a second

    from stickslip.pipeline.object_store import Prefix

    try:
        # no cached listings: other processes write there
        system, root = fsspec.core.url_to_fs(address, use_listings_cache=False)
    except ImportError as error:
        remedy = 'run: pip install "stickslip[s3]"' if protocol == "s3" else str(error)
        raise StoreError(f"{address}: expected the package for {protocol}://, got none; {remedy}") from error
    except ValueError as error:
        raise StoreError(
            f"{address}: expected a directory or an address such as s3://bucket/dir, got one that fsspec cannot open "
            f"({error}); correct it"
        ) from error
    return Prefix(address, system, root.rstrip("/"))


# ---------------------------------------------------------------------------------------------- a directory


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[BinaryIO]:
    """A stream to the new content of a file, which it takes in one step, if the with-block ends well."""
    temporary = file.with_name(f"{_begun(file)}{os.getpid()}")
    try:
        with open(temporary, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, file)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    directory = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _begun(file: Path) -> str:
    """How files begin that processes of this machine write before they replace a file; the rest is who writes."""
    return f"{TEMPORARY}{file.name}-{socket.gethostname()}-"


def remove_left(file: Path) -> None:
    """Remove what processes of this machine that were killed had written of a file."""
    left = re.compile(re.escape(_begun(file)) + r"(\d{1,9})")
    for one in file.parent.iterdir():
        if (found := left.fullmatch(one.name)) and not _is_alive(int(found[1])):
            with contextlib.suppress(OSError):  # another user's stays
                one.unlink()


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


class Directory(Place):
    """A directory of the local file system, or of one that is mounted."""

    arrow = None
    remedy = "check its permissions"

    def __init__(self, path: Path) -> None:
        self.path, self.address = path, str(path)

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
        descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
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
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
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
                with contextlib.suppress(OSError):  # a full disk: the lock then does not say whose it is
                    os.write(descriptor, f"{this_process()}\n".encode())
                return descriptor
        os.close(descriptor)  # its last owner removed it between our opening and our locking


def is_locked(descriptor: int) -> bool:
    """Lock an open file for this process alone, unless another has; whether it is this one's until it is closed."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def this_process() -> str:
    """Who writes, as a lock says it."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def _append(descriptor: int, line: bytes) -> None:
    """Append a line for good, whole or not at all."""
    size = os.fstat(descriptor).st_size
    try:
        if os.write(descriptor, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(descriptor)
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(descriptor, size)
        raise
