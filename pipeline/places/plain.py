"""Plain files and folders, opened so that nothing else can stand in for one.

What lies in a dataset, or beside it, may be of others: a link leads out of it, and a pipe lets a reader wait. So each
part of a path is opened relative to the folder before it and never followed, and what is open is looked at once more
before it is used: nobody can exchange it in between. New content gets a name that nobody can guess.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import socket
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from stickslip.pipeline.errors import StoreError
from stickslip.pipeline.places.place import TEMPORARY
from stickslip.sim.kernels.cache import MOST_LINKS, PASS, is_ours

_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a directory",
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
#: Neither follows, nor waits, nor takes a terminal.
_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY


def check(facts: os.stat_result, path: Path, kind: int = stat.S_IFREG) -> None:
    """`StoreError` if what is at a path, links not followed, is no plain file, or is not of another `kind`."""
    if stat.S_IFMT(facts.st_mode) != kind:
        what = _KINDS.get(stat.S_IFMT(facts.st_mode), "something else")
        raise StoreError(f"{path}: expected {_KINDS[kind]}, got {what}; remove it, or choose another directory")


def status(name: str, directory: int) -> os.stat_result | None:
    """What a name in an open folder stands for, links not followed; None if it is free."""
    try:
        return os.stat(name, dir_fd=directory, follow_symlinks=False)
    except FileNotFoundError:
        return None


def opened(name: str, directory: int, path: Path, flags: int = os.O_RDONLY, kind: int = stat.S_IFREG) -> int:
    """Descriptor of a plain file, or a folder, in an open folder.

    Raises `StoreError` if it is something else; or, where it would be written, has a second name, which may be
    another's; `OSError` if it cannot be opened.
    """
    facts = status(name, directory)
    if facts is not None:
        check(facts, path, kind)
    with filename(path):
        descriptor = os.open(name, flags | _SAFELY, 0o666, dir_fd=directory)
    try:
        facts = os.fstat(descriptor)
        check(facts, path, kind)
        if flags & (os.O_WRONLY | os.O_RDWR) and facts.st_nlink > 1:
            raise StoreError(
                f"{path}: expected a file with one name, got one of {facts.st_nlink} (hard links), which would"
                " change under all; put a copy in its place"
            )
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


@contextlib.contextmanager
def way(path: Path, refusal: Callable[[str], Exception], is_made: bool = False) -> Iterator[tuple[int, str, Path]]:
    """The folder in which a path ends, to pass through, the path's last name, and the folder's path without links.

    A link of another user may lead only to what is that user's, or lies in what is: not to what is this user's alone.
    Raises `OSError` if it cannot be passed.

    Parameters
    ----------
    refusal : callable
        The error for a link, which it is told, that leads elsewhere.
    is_made : bool
        Whether folders on the way that are missing are created.
    """
    steps, place = [*reversed(path.parts)] or ["."], Path("/") if path.is_absolute() else Path.cwd()
    foreign_links: list[tuple[int, int, Path]] = []  # another user's links: how many parts follow, whose, where
    n_links = 0
    descriptor = os.open(path.anchor or ".", PASS)
    try:
        with filename(path):
            while True:
                name = steps.pop()
                facts = status(name, descriptor)
                if facts is not None and stat.S_ISLNK(facts.st_mode):
                    if not is_ours(facts):
                        foreign_links.append((len(steps), facts.st_uid, place / name))
                    target = Path(os.readlink(name, dir_fd=descriptor))
                    n_links += 1
                    if n_links > MOST_LINKS or not _is_same(facts, status(name, descriptor)):
                        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
                    steps += reversed(target.parts)
                    continue
                while foreign_links and foreign_links[-1][0] == len(steps):  # it leads here
                    _, user, link = foreign_links.pop()
                    if user not in {entry.st_uid for entry in (os.fstat(descriptor), facts) if entry is not None}:
                        raise refusal(f"the link {link} of the user with the id {user}")
                if not steps:
                    break
                if facts is None and is_made:
                    with contextlib.suppress(FileExistsError):
                        os.mkdir(name, dir_fd=descriptor)
                inner = os.open(name, PASS, dir_fd=descriptor)
                os.close(descriptor)
                descriptor, place = inner, place.parent if name == ".." else place / name
        yield descriptor, name, place
    finally:
        os.close(descriptor)


def _is_same(earlier: os.stat_result, now: os.stat_result | None) -> bool:
    return now is not None and os.path.samestat(earlier, now) and earlier.st_ctime_ns == now.st_ctime_ns


def refusal_of(root: Path) -> Callable[[str], StoreError]:
    """The error for a link of another user on the way to a dataset."""
    return lambda link: StoreError(f"{root}: expected a directory, got {link}; name the directory itself")


@contextlib.contextmanager
def folder(
    root: Path, inner: Sequence[str] = (), is_made: bool = False, expected: os.stat_result | None = None
) -> Iterator[int]:
    """Descriptor of a folder: `root` may be reached through links as of `way`, the folders `inner` below it may not.

    What has taken the place of a root that was `expected` counts as none. Raises `StoreError` if an inner one is
    something else, or a link of another user leads to the root; `OSError` if it cannot be opened; with `is_made`,
    inner ones that are missing are created.
    """
    with way(root, refusal_of(root)) as (passed, name, _), filename(root):
        descriptor = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=passed)
    try:
        if expected is not None and not os.path.samestat(os.fstat(descriptor), expected):
            raise FileNotFoundError(errno.ENOENT, "another directory is in its place", str(root))
        for name in inner:
            root /= name
            if is_made:
                with contextlib.suppress(FileExistsError), filename(root):
                    os.mkdir(name, dir_fd=descriptor)
            below = opened(name, descriptor, root, os.O_RDONLY | os.O_DIRECTORY, stat.S_IFDIR)
            os.close(descriptor)
            descriptor = below
        yield descriptor
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def filename(path: Path) -> Iterator[None]:
    """Have errors of the system name a file by its path, not by its name in an open folder."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        if error.filename2 is not None:  # of two names; None would be told as the second
            del error.filename2
        raise


class Replacement:
    """The new content of a file, under a name of its own until it takes the file's place; a context manager.

    `directory` is the descriptor of the folder, which has to stay open; the content goes into `stream`. What is not
    put in place within the with-block is removed.
    """

    def __init__(self, name: str, directory: int, path: Path) -> None:
        facts = status(name, directory)
        if facts is not None:
            check(facts, path)
        self._name, self.directory, self._shown = name, directory, path
        self._temporary = f"{_begun(name)}{os.getpid()}-{secrets.token_hex(8)}"
        with filename(path):
            how = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
            descriptor = os.open(self._temporary, how, 0o666, dir_fd=directory)
        self.stream: BinaryIO = open(descriptor, "w+b")  # noqa: SIM115  until the end of the with-block

    def __enter__(self) -> Replacement:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # of closing: what was written last finds no room
            self.stream.close()
        with contextlib.suppress(OSError):  # it is in place
            os.unlink(self._temporary, dir_fd=self.directory)

    def write(self, content: bytes) -> None:
        """Have the content on the disk, all of it."""
        with filename(self._shown):
            self.stream.write(content)
        self.keep()

    def keep(self) -> None:
        """Have on the disk what is in the stream."""
        with filename(self._shown), self.stream:
            self.stream.flush()
            os.fsync(self.stream.fileno())

    def put(self) -> None:
        """Take the file's place in one step."""
        with filename(self._shown):
            os.replace(self._temporary, self._name, src_dir_fd=self.directory, dst_dir_fd=self.directory)


@contextlib.contextmanager
def replacing(file: Path, directory: int) -> Iterator[BinaryIO]:
    """A stream for the new content of a file in an open folder, which replaces the old if the with-block succeeds."""
    with Replacement(file.name, directory, file) as new:
        yield new.stream
        new.keep()
        new.put()
    os.fsync(directory)


def _begun(name: str) -> str:
    """What the names of unfinished copies of a file begin with on this machine; process and chance follow."""
    return f"{TEMPORARY}{name}-{socket.gethostname()}-"


def unfinished(name: str, host: str) -> str:
    """The pattern of the names of unfinished copies, of a file and a machine by theirs; the last group is the pid."""
    return rf"{re.escape(TEMPORARY)}{name}-{host}-([0-9]{{1,9}})-[0-9a-f]{{16}}"


def remove_left(directory: int, name: str = "") -> None:
    """Remove the unfinished copies that killed processes of this user left in a folder, of one file or of all."""
    pattern = re.compile(unfinished(re.escape(name) if name else ".*", re.escape(socket.gethostname())))
    for entry in os.listdir(directory):
        match = pattern.fullmatch(entry)
        if match is None or is_alive(int(match[1])):
            continue
        facts = status(entry, directory)
        if facts is not None and stat.S_ISREG(facts.st_mode) and facts.st_uid == os.geteuid():
            with contextlib.suppress(OSError):
                os.unlink(entry, dir_fd=directory)


def is_alive(pid: int) -> bool:
    """Whether this machine has a process of that number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # somebody else's, or of another system
        pass
    return True
