"""Directories for files that nobody needs once a process has ended."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Iterator
from typing import NamedTuple

from stickslip.pipeline.machine.signals import last_act, unbroken

#: Names are this machine's: a lock may not be seen by others that mount the same file system.
_PREFIX = f"stickslip-scratch-{socket.gethostname()}-"
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
#: How often a directory is removed, in which processes that end may still write.
_REMOVALS = 10


class Scratch(NamedTuple):
    """A directory, and a descriptor of it."""

    path: str
    descriptor: int

    @property
    def pinned(self) -> str:
        """A short path of the directory for this process's children, under which nobody can create it again.

        A child may be late: it would make a removed `path` anew, and nobody would remove that.
        """
        return f"/proc/{os.getpid()}/fd/{self.descriptor}" if sys.platform == "linux" else self.path

    def remove(self) -> None:
        """Remove the directory with all that is in it; of what cannot be removed, nothing is said."""
        for _ in range(_REMOVALS):
            shutil.rmtree(self.path, ignore_errors=True)
            if not os.path.lexists(self.path):
                break


@contextlib.contextmanager
def scratch(parent: str | None = None) -> Iterator[Scratch]:
    """A directory of this process alone, which goes with the with-block; those that killed processes left go first.

    A process holds a lock on its directory, which lasts no longer than the process. Raises `OSError` if it cannot be
    created.

    Parameters
    ----------
    parent : str, optional
        Where it lies: the system's directory for temporary files if left out.
    """
    parent = parent or tempfile.gettempdir()
    _sweep(parent)
    with contextlib.ExitStack() as opened:
        with unbroken():  # a signal waits until it is known what is to be removed
            directory = _locked(parent)
            opened.callback(os.close, directory.descriptor)
            opened.callback(directory.remove)
            opened.enter_context(last_act(directory.remove))
        yield directory


def _locked(parent: str) -> Scratch:
    while True:
        path = tempfile.mkdtemp(prefix=_PREFIX, dir=parent)
        os.chmod(path, stat.S_IRWXU)  # whatever the umask: else nobody can open it, to remove it
        # another process may sweep it before it is locked: then the next
        with contextlib.suppress(FileNotFoundError), contextlib.ExitStack() as opened:
            descriptor = os.open(path, _FOLDER)
            opened.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            except OSError:  # where a directory cannot be locked, nobody takes it for left either
                pass
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                opened.pop_all()
                return Scratch(path, descriptor)


def _sweep(parent: str) -> None:
    """Remove this user's directories whose processes are gone; of what cannot be removed, nothing is said."""
    with contextlib.suppress(OSError):
        folder = os.open(parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for name in os.listdir(folder):
                # what `mkdtemp` adds has no hyphen: else it is of a machine whose name only begins as this one's
                if name.startswith(_PREFIX) and "-" not in name.removeprefix(_PREFIX):
                    _remove_left(folder, name)
        finally:
            os.close(folder)


def _remove_left(folder: int, name: str) -> None:
    with contextlib.suppress(OSError):
        descriptor = os.open(name, _FOLDER, dir_fd=folder)
        try:
            if os.fstat(descriptor).st_uid == os.geteuid():
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _clear(descriptor)  # by its descriptor: whatever has its name by now is not followed
                os.rmdir(name, dir_fd=folder)
        finally:
            os.close(descriptor)


def _clear(folder: int) -> None:
    for name in os.listdir(folder):
        try:
            os.unlink(name, dir_fd=folder)
        except (IsADirectoryError, PermissionError):  # as Linux and macOS say of a directory
            shutil.rmtree(name, dir_fd=folder)
