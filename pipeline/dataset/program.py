"""The version of the program that numbers come from: its name, and a digest of the code that determines them."""

from __future__ import annotations

import contextlib
import hashlib
import io
import sys
import tokenize
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import stickslip
from stickslip.sim.kernels.cache import CacheError, CacheFiles, cache_directory
from stickslip.sim.kernels.digest import is_compiled
from stickslip.version import __version__

#: Packages and modules that determine numbers: a system and its run, which draws and settings a member has, what is
#: kept of its run, and how.
_DETERMINING = (
    "sim",
    "pipeline/dataset/schema.py",
    "pipeline/design/column.py",
    "pipeline/design/design.py",
    "pipeline/design/values.py",
    "pipeline/ensemble",
    "pipeline/own",
    "pipeline/records",
    "pipeline/running/ends.py",
    "pipeline/running/kept.py",
    "pipeline/running/worker.py",
    "pipeline/scene",
)

#: What no run needs of these.
_OUTSIDE = ("sim/runs/show.py",)


def program() -> str:
    """What numbers come from: the version of stickslip, and a digest of its code, as this process loaded it.

    Where kernels are not compiled, it says so.
    """
    return version_of(_DETERMINING) + ("" if is_compiled() else "-not-compiled")


@cache
def version_of(places: tuple[str, ...]) -> str:
    """The version of stickslip, and a digest of the code in packages and modules, as this process loaded it.

    The digest is of the code's tokens: a comment, a docstring, an empty or a broken line leaves it as it is. Reading
    these takes a third of a second, so it is kept, by the digest of the files.
    """
    root = Path(stickslip.__file__).parent
    sources = [(name, file.read_bytes()) for name, file in sorted(_sources(root, places))]
    makes = __version__, sys.version, Path(__file__).read_bytes(), sources
    files, key = CacheFiles(cache_directory(), "program"), hashlib.sha256(repr(makes).encode()).hexdigest()
    with contextlib.suppress(CacheError):  # where it could be another's it is found anew
        if isinstance(version := files.load(key), str):
            return version
    digest = hashlib.sha256()
    for name, source in sources:
        words = _words(source) if name.endswith(".py") else [source.decode()]
        digest.update("\0".join((name, *words, "")).encode())
    version = f"{__version__}-{digest.hexdigest()[:16]}"
    with contextlib.suppress(CacheError, OSError):
        files.save(key, version)
    return version


def _sources(root: Path, places: Iterable[str]) -> Iterator[tuple[str, Path]]:
    """The files of packages and modules, with their names below `root`."""
    for place in places:
        for file in [root / place] if place.endswith(".py") else (root / place).rglob("*.*"):
            name = file.relative_to(root).as_posix()
            if file.suffix in (".py", ".html", ".css") and not name.startswith(_OUTSIDE):
                yield name, file


#: Tokens that say how code is laid out, by what stands for them; those of None mean nothing.
_LAYOUT = {
    tokenize.INDENT: ">",
    tokenize.DEDENT: "<",
    tokenize.COMMENT: None,
    tokenize.NL: None,
    tokenize.ENCODING: None,
    tokenize.ENDMARKER: None,
}


def _words(source: bytes) -> Iterator[str]:
    """The tokens of code, without statements that are nothing but a text, as docstrings are.

    Not its syntax tree: CPython 3.11 cannot build two at once in threads, as those of a worker would.
    """
    line: list[str] = []
    is_text = True
    for kind, word in _tokens(source):
        if kind == tokenize.NEWLINE:
            if not is_text:
                yield from (*line, ";")
            line, is_text = [], True
        elif kind not in _LAYOUT:
            line.append(word)
            is_text = is_text and kind == tokenize.STRING
        elif (mark := _LAYOUT[kind]) is not None:
            yield mark


def _tokens(source: bytes) -> Iterator[tuple[int, str]]:
    """Kind and text of each token; an f-string is one, as before Python 3.12, which takes it to pieces."""
    begins, ends = (getattr(tokenize, f"FSTRING_{name}", None) for name in ("START", "END"))
    lines = source.decode().splitlines(keepends=True)
    depth, start = 0, (0, 0)
    for token in tokenize.tokenize(io.BytesIO(source).readline):
        if token.type == begins:
            start = start if depth else token.start
            depth += 1
        elif token.type == ends:
            depth -= 1
            if not depth:
                yield tokenize.STRING, _between(lines, start, token.end)
        elif not depth:
            yield token.type, token.string


def _between(lines: list[str], start: tuple[int, int], end: tuple[int, int]) -> str:
    """The text from one place to another, each a line, counted from 1, and a column."""
    rows = lines[start[0] - 1 : end[0]]
    rows[-1] = rows[-1][: end[1]]
    return "".join(rows)[start[1] :]
