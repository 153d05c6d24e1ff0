"""What was compiled or computed of sources, on disk: where it is, who may own it, and how it is kept.

A kept kernel is a pickle of machine code: whoever can put one there can make whoever loads it do anything. So the
cache, the directories that lead to it and its files must belong to this user or root, and nobody else may write them.
Each is checked once it is open, relative to the one before it, from the root on: in a directory that others cannot
write, or only under the sticky bit, they cannot replace what belongs to this user or root.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import pickle
import stat
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stickslip.sim.kernels.digest import kernel_digest

#: Seconds to wait for another process that compiles; that takes half a minute or so, and may hang.
_PATIENCE = 180.0
_DIGEST_SIZE = hashlib.sha256().digest_size
_ENDING = ".nbc"
#: Where numba reads settings too, in the working directory, whoever wrote them.
_SETTINGS = ".numba_config.yaml"
MOST_LINKS = 40  # as Linux follows them
# a directory may be passed without the right to list it; macOS has no such descriptor
PASS = os.O_DIRECTORY | os.O_NOFOLLOW | (os.O_PATH if sys.platform == "linux" else os.O_RDONLY)


class CacheError(Exception):
    """Others could write the kernel cache, or change kernels. The message says by which file, and what to do."""


def cache_directory() -> Path:
    """Where compiled kernels are kept: ``$NUMBA_CACHE_DIR`` or the user's cache, below it ``stickslip/<digest>``.

    Raises `CacheError` if a file in the working directory changes what is compiled.
    """
    if os.path.isfile(_SETTINGS):
        raise CacheError(
            f"{os.path.abspath(_SETTINGS)}: expected no file of this name where kernels are compiled, as numba reads "
            "settings there that change numbers; remove it, or work in another directory"
        )
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "stickslip" / kernel_digest()


def has_kernel(package: str) -> bool:
    """Whether a kernel of a package, or of a module, is kept.

    Raises `CacheError` if others could write there.
    """
    try:
        with _opened(cache_directory()) as directory:
            return any(name.startswith(f"{package}.") for name in _kernels(directory))
    except OSError:
        return False


class CacheFiles:
    """Things on disk, each in a file that begins with a name and is named by its key."""

    def __init__(self, directory: Path, name: str) -> None:
        self._directory, self._name = directory, name
        self._locks: dict[str, contextlib.ExitStack] = {}

    def _file(self, key: object, ending: str = _ENDING) -> str:
        return f"{self._name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}{ending}"

    def load(self, key: object) -> Any:
        """What was saved under a key; None, and it is to be compiled, if nothing was, or not what can be used here.

        That is a file of which a byte has changed, and one that needs a module of a user's that is not here.

        If another process is compiling it, wait for its result.

        Raises `CacheError` if others could have written it.
        """
        entry = self._read(key)
        if entry is None and repr(key) not in self._locks:
            self._locks[repr(key)] = self._alone(key)
            entry = self._read(key)
            if entry is not None:
                self._locks.pop(repr(key)).close()
        return entry

    def _alone(self, key: object) -> contextlib.ExitStack:
        """A lock against other processes that compile it, unless nothing can be locked or it takes too long."""
        locks = contextlib.ExitStack()
        with contextlib.suppress(OSError), _opened(self._directory) as directory:
            # others may not read it either, or they could lock it
            how = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW
            lock = os.open(self._file(key, ".lock"), how, 0o600, dir_fd=directory)
            locks.callback(os.close, lock)
            end = time.monotonic() + _PATIENCE
            while time.monotonic() < end:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.05)
        return locks

    def _read(self, key: object) -> Any:
        try:
            with _opened(self._directory) as directory:
                content = _content(directory, self._directory / self._file(key))
        except OSError:
            return None
        data, digest = content[:-_DIGEST_SIZE], content[-_DIGEST_SIZE:]
        if hashlib.sha256(data).digest() != digest:
            return None
        try:
            return pickle.loads(data)
        except ModuleNotFoundError:  # it has a law of a user's own, from a module under a name that is not here
            return None

    def save(self, key: object, thing: object) -> None:
        data = pickle.dumps(thing)
        temporary = f"{self._name}.{uuid.uuid4().hex}.tmp"
        try:
            with _opened(self._directory) as directory:
                try:
                    new = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644, dir_fd=directory)
                    with open(new, "wb") as stream:
                        stream.write(data + hashlib.sha256(data).digest())
                    os.replace(temporary, self._file(key), src_dir_fd=directory, dst_dir_fd=directory)
                except BaseException:
                    with contextlib.suppress(OSError):
                        os.unlink(temporary, dir_fd=directory)
                    raise
        finally:
            self._locks.pop(repr(key), contextlib.ExitStack()).close()

    def flush(self) -> None:
        with _opened(self._directory) as directory:
            for name in _kernels(directory):
                if name.startswith(f"{self._name}."):
                    os.unlink(name, dir_fd=directory)


def _kernels(directory: int) -> list[str]:
    descriptor = os.open(".", os.O_RDONLY | os.O_DIRECTORY, dir_fd=directory)
    try:
        return [name for name in os.listdir(descriptor) if name.endswith(_ENDING)]
    finally:
        os.close(descriptor)


# ---------------------------------------------------------------------------------------------- whose it may be


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    """A descriptor by which the files of a directory are opened; a missing directory is created."""
    parts, place, n_links = [*reversed(path.absolute().parts)], Path("/"), 0
    descriptor = os.open("/", PASS)
    try:
        while parts:
            name = parts.pop()
            status = _found(name, descriptor)
            if stat.S_ISLNK(status.st_mode):
                if not is_ours(status):
                    raise _refusal(place / name, f"a link of {_owner(status)}", path)
                n_links += 1
                if n_links > MOST_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
                parts += reversed(Path(os.readlink(name, dir_fd=descriptor)).parts)
                continue
            inner = os.open(name, PASS, dir_fd=descriptor)
            os.close(descriptor)
            descriptor, place = inner, place.parent if name == ".." else place / name  # no part of `at` is a link
            _check(os.fstat(descriptor), place, path, is_passed=bool(parts))
        yield descriptor
    finally:
        os.close(descriptor)


def _found(name: str, directory: int) -> os.stat_result:
    try:
        return os.stat(name, dir_fd=directory, follow_symlinks=False)
    except FileNotFoundError:
        with contextlib.suppress(FileExistsError):
            os.mkdir(name, 0o755, dir_fd=directory)
        return os.stat(name, dir_fd=directory, follow_symlinks=False)


def _content(directory: int, file: Path) -> bytes:
    """The content of a file in an opened directory, without following links or waiting for pipes."""
    try:
        descriptor = os.open(file.name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=directory)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _refusal(file, "a link", file.parent) from None
        raise
    try:
        status = os.fstat(descriptor)
        _check(status, file, file.parent)
        if not stat.S_ISREG(status.st_mode):
            raise _refusal(file, "no plain file", file.parent)
        with open(descriptor, "rb", closefd=False) as stream:
            return stream.read()
    finally:
        os.close(descriptor)


def is_ours(status: os.stat_result) -> bool:
    """Whether a file or a directory is this user's or root's."""
    return status.st_uid in (0, os.geteuid())


def others_write(status: os.stat_result) -> bool:
    """Whether its mode lets others write it."""
    return bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def _owner(status: os.stat_result) -> str:
    return f"the user with the id {status.st_uid}"


def _check(status: os.stat_result, place: Path, cache: Path, is_passed: bool = False) -> None:
    """Refuse what others own or may write; in a directory that is only passed, the sticky bit protects ours."""
    if not is_ours(status):
        raise _refusal(place, f"one of {_owner(status)}", cache)
    if others_write(status) and not (is_passed and status.st_mode & stat.S_ISVTX):
        raise _refusal(place, f"one that others may write (mode {stat.S_IMODE(status.st_mode):o})", cache)


def _refusal(place: Path, got: str, cache: Path) -> CacheError:
    return CacheError(
        f"kernel cache {cache} on {os.uname().nodename}: expected directories and files of your own or root's that "
        f"nobody else may write, as what is kept there is run; got {place}, {got}; set NUMBA_CACHE_DIR to a "
        f"directory of your own (mkdir -m 700), or remove what is not yours and `chmod go-w` what is"
    )
