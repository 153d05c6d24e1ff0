"""The version of the program that numbers come from: its name, and a digest of the code that determines them."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import stickslip
from stickslip.version import __version__

#: Packages and modules that determine numbers: a system and its run, which draws and settings a member has, what is
#: kept of its run, and how.
_DETERMINING = (
    "sim",
    "pipeline/dataset/schema.py",
    "pipeline/ensemble",
    "pipeline/records",
    "pipeline/running/ends.py",
    "pipeline/running/worker.py",
    "pipeline/scene",
)

#: Parts of these that no run needs: they explain, or draw.
_OUTSIDE = ("sim/theory/", "sim/runs/show.py")


@cache
def program() -> str:
    """What numbers come from: the version of stickslip, and a digest of its code, as this process loaded it.

    The digest is of the parsed code: a comment, a docstring or another layout leaves it as it is.
    """
    digest = hashlib.sha256()
    root = Path(stickslip.__file__).parent
    for name, file in sorted(_sources(root)):
        words = [name]
        _add(ast.parse(file.read_bytes()), words)
        digest.update("\n".join(words).encode(errors="surrogatepass"))
    return f"{__version__}-{digest.hexdigest()[:16]}"


def _sources(root: Path) -> Iterator[tuple[str, Path]]:
    """The files that determine numbers, with their names below `root`."""
    for place in _DETERMINING:
        for file in [root / place] if place.endswith(".py") else (root / place).rglob("*.py"):
            name = file.relative_to(root).as_posix()
            if not name.startswith(_OUTSIDE):
                yield name, file


def _add(node: object, words: list[str]) -> None:
    """Add parsed code word by word; what is absent is left out, as versions of Python differ in how they say so."""
    if isinstance(node, ast.AST):
        words.append(type(node).__name__)
        for field in node._fields:
            value = getattr(node, field, None)
            if value is not None and value != []:
                words.append(field)
                _add(value, words)
        words.append(".")
    elif isinstance(node, list):
        words.append("[")
        for entry in node:
            if not _is_text(entry):
                _add(entry, words)
        words.append("]")
    else:
        words.append(repr(node))


def _is_text(node: object) -> bool:
    """Whether a statement is a text and no more, as a docstring is."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
