"""The text of a scene file as tables, in bounded time, whatever it holds. Loads nothing but TOML."""

from __future__ import annotations

import codecs
import os
import re
import tomllib
from collections.abc import Sized
from pathlib import Path
from typing import Any

from stickslip.pipeline.errors import SceneError, remedy, shortened

#: Keys of a table at most, and tables of an array: each would be a problem with a line of its own.
_MAX_KEYS = 1000
#: Files of systems at most, each with a table of its own in a scene that is kept.
MAX_FILES = 10_000
#: The number of a realisation: what a file says, or what a function is given that takes it.
REALISATION = "realisation"
#: Bytes and lines of a scene file at most, which are read in a second or two.
MAX_SOURCE, _MAX_LINES = 4_000_000, 100_000
#: Parts of a dotted key at most: the time to read one grows with the square of their number.
_MAX_PARTS = 20
_DOTTED = re.compile(
    rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_MAX_PARTS}}}""", re.ASCII
)


def read_source(path: str | Path) -> bytes:
    """The bytes of a scene file.

    Raises `SceneError` if it cannot be read.
    """
    path = Path(path)
    try:
        # a pipe that nobody writes to would block, and a device has no end
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            os.set_blocking(file.fileno(), True)
            return file.read(MAX_SOURCE + 1)
    except IsADirectoryError:
        raise SceneError(f"{path}: expected a scene file, got a directory; name the .toml file in it") from None
    except FileNotFoundError:
        raise SceneError(f"{path}: expected a scene file, found nothing there; check the path") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}); {remedy(error)}") from error


def parse_toml(source: bytes | str, name: str) -> dict[str, Any]:
    """The tables that a scene file holds, as they are written; `name` is what errors call it.

    Raises `SceneError` if it is not TOML.
    """
    if len(source) > MAX_SOURCE:
        raise SceneError(f"{name}: expected at most {MAX_SOURCE} bytes, got more; shorten its lists and texts")
    text = source if isinstance(source, str) else _decoded(source, name)
    if (n_lines := text.count("\n")) > _MAX_LINES:
        raise SceneError(f"{name}: expected at most {_MAX_LINES} lines, got {n_lines}; remove the others")
    if (long := _DOTTED.search(text)) is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise SceneError(f"{name}: line {line}: expected a key of at most {_MAX_PARTS} parts, got more; shorten it")
    try:
        tables = tomllib.loads(text)
        repr(tables)  # no message could show an integer of absurd length, which 0x and 0b let in
        _check_sizes(tables, f"{name}: ")
        return tables
    except SceneError:
        raise
    except (ValueError, RecursionError) as error:  # ValueError: also an integer of absurd length
        raise SceneError(f"{name}: expected TOML, got: {error}; correct that line") from None


def _decoded(source: bytes, name: str) -> str:
    if source.startswith(codecs.BOM_UTF8):
        raise SceneError(f"{name}: expected plain UTF-8, got a byte order mark; save the file as UTF-8 without it")
    try:
        return source.decode()
    except UnicodeDecodeError as error:
        line = source.count(b"\n", 0, error.start) + 1
        raise SceneError(
            f"{name}: line {line}: expected UTF-8 text, got byte 0x{source[error.start]:02x}; save the file as UTF-8"
        ) from None


def _check_sizes(tables: dict[str, Any], head: str, path: str = "") -> None:
    """Refuse tables of more keys, and arrays of more tables, than any has."""
    _check_size(tables, "keys", MAX_FILES if path == "system.files" else _MAX_KEYS, f"{head}{path or 'a scene'}")
    for key, value in tables.items():
        inner = f"{path}.{key}".lstrip(".")
        tables_here = [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else [value]
        if isinstance(value, list):
            _check_size(tables_here, "tables", _MAX_KEYS, f"{head}{inner}")
        for table in tables_here:
            if isinstance(table, dict):
                _check_sizes(table, head, inner)


def _check_size(entries: Sized, what: str, limit: int, where: str) -> None:
    if len(entries) > limit:
        raise SceneError(
            f"{shortened(where, 120)}: expected at most {limit} {what}, got {len(entries)}; remove the others"
        )
