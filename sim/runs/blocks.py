"""Names of blocks: what one may be called, and which block a name is."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Sequence
from typing import Any

from stickslip.sim.numerics.arguments import did_you_mean, integer

#: Characters of a name at most, and what it is made of: it becomes part of the names of columns.
LONGEST = 40
PATTERN = rf"[A-Za-z][A-Za-z0-9_]{{0,{LONGEST - 1}}}"
_TO_WRITE = f"a letter, then letters, digits and _, {LONGEST} at most"
#: Names that a message lists.
_LISTED = 10


def named(names: Sequence[str], n: int) -> tuple[str, ...]:
    """The names of n blocks, checked; empty if blocks have none.

    Raises
    ------
    TypeError, ValueError
        If there is not one name for each block, one is no plain name, or two differ at most in upper and lower case.
    """
    listed = tuple(names) if isinstance(names, list | tuple) else names
    if not isinstance(listed, tuple) or not all(isinstance(name, str) for name in listed):
        raise TypeError(f"names: expected a list of {n} texts, one for each block, got {reprlib.repr(names)}")
    if listed and len(listed) != n:
        raise ValueError(f"names: expected one for each of {n} blocks, got {len(listed)}; write all, or none")
    owners: dict[str, str] = {}
    for name in listed:
        if not re.fullmatch(PATTERN, name):
            raise ValueError(f"names: expected {_TO_WRITE}, got {reprlib.repr(name)}; rename that block")
        if name.lower() in owners:
            pair = f"{owners[name.lower()]!r} and {name!r}"
            raise ValueError(f"names: expected each once, whatever its case, got {pair}; rename one")
        owners[name.lower()] = name
    return listed


def numbered(key: str, block: Any, names: Sequence[str], n: int) -> int:
    """The number of a block that is given by its name or its number; errors begin with `key`."""
    if not isinstance(block, str):
        return integer(key, block, 0, n - 1)
    if block not in names:
        listed = ", ".join([*names[:_LISTED], *(["..."] if len(names) > _LISTED else [])])
        known = f"one of {listed}" if names else f"a number from 0 to {n - 1}, as these blocks have no names"
        raise ValueError(f"{key}: expected {known}, got {reprlib.repr(block)}{did_you_mean(block, names)}")
    return names.index(block)
