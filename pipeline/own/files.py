"""Files of a user's own: their bytes and digests, and which of them lie beside a scene."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import stat
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.machine.memory import COPIES, is_hollow, lack


class ChangedError(SceneError):
    """A file or a module of the user's own has changed."""


def digest(content: bytes) -> str:
    """The sha256 of some bytes."""
    return hashlib.sha256(content).hexdigest()


def content_of(path: Path, key: str) -> bytes:
    """The bytes of a plain file; `key` is what errors begin with.

    Raises `SceneError` if it cannot be read, is no plain file or is being written.
    """
    try:
        # a pipe that nobody writes to would block
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            facts = os.fstat(file.fileno())
            if not stat.S_ISREG(facts.st_mode):
                raise SceneError(f"{key}: expected a file, got {path}, which is not a regular file; correct the path")
            problem = (
                "expected content, got holes" if is_hollow(facts) else lack(COPIES * facts.st_size, "what takes")
            )
            if problem:
                raise SceneError(f"{key}: {path}: {problem}; correct the path")
            content = file.read(facts.st_size + 1)
    except OSError as error:
        raise SceneError(
            f"{key}: {path} cannot be read ({error.strerror}); restore it, or correct the path"
        ) from None
    if len(content) != facts.st_size:
        raise SceneError(
            f"{key}: expected {facts.st_size} bytes in {path}, got {'others' if content else 'none'}; write the"
            " file before it is read"
        )
    return content


def name_beside(file: str, root: Path) -> str | None:
    """The path of a file within a scene's folder; None if it lies elsewhere, is installed or hidden."""
    if "__pycache__" in file:
        try:
            file = importlib.util.source_from_cache(file)
        except ValueError:
            return None
    if is_installed(Path(file).resolve()):
        return None
    # a link there counts, even if it leads out of it
    for path in (Path(file), Path(file).parent.resolve() / Path(file).name):
        if path.is_relative_to(root):
            name = path.relative_to(root)
            return None if any(folder.startswith(".") for folder in name.parts) else name.as_posix()
    return None


def is_installed(file: Path) -> bool:
    """Whether a file is of this package, of one that is installed, or of Python, which may lie in the user's home."""
    places = (Path(__file__).resolve().parents[1], Path(sys.prefix), Path(sys.base_prefix))
    is_package = not {"site-packages", "dist-packages"}.isdisjoint(file.parts)
    return is_package or any(file.is_relative_to(place.resolve()) for place in places)


def check_beside(root: Path, files: Iterable[tuple[str, str]], key: str) -> None:
    """See that files that a function reads are as they were.

    Raises `ChangedError` if one has changed; `SceneError` if one is gone.
    """
    for name, sha256 in files:
        file = root / name
        if not file.is_file() or _digest_now(file, key) != sha256:
            raise (ChangedError if file.is_file() else SceneError)(
                f"{key}: expected {file}, which the function reads, as it was when the scene was read "
                f"(sha256 {sha256[:12]}), found {'another' if file.is_file() else 'none'}; if it was changed, run "
                f"the scene into another directory"
            )


def _digest_now(file: Path, key: str) -> str:
    """The sha256 of a file, which is read again if it may have changed."""
    facts = file.stat()
    return _digest_once(file, key, facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)


@lru_cache(maxsize=64)
def _digest_once(file: Path, key: str, *_: int) -> str:
    return digest(content_of(file, key))
