"""Arguments as users give them, into what the kernels take; errors name the argument."""

from __future__ import annotations

import difflib
import math
import numbers
import reprlib
from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]


def apart(*values: float, digits: int = 6) -> tuple[str, ...]:
    """Texts of numbers that a message compares: with so many digits, or as many as tell apart those that differ."""
    for n in range(digits, 17):
        texts = tuple(f"{value:.{n}g}" for value in values)
        if len(set(texts)) == len({*values}):
            return texts
    return tuple(repr(float(value)) for value in values)


def floats(name: str, value: ArrayLike, expected: str) -> Floats:
    """A new float64 array in C order; TypeError for what holds no real numbers, or masks some."""
    if type(value) is np.ndarray and value.dtype == np.float64:  # at once, as most are
        return value.copy("C")
    parts = value if isinstance(value, list | tuple) else (value,)
    if any(isinstance(part, np.ma.MaskedArray) for part in parts):
        raise TypeError(f"{name}: expected {expected}, got a masked array; fill it, or leave out what is masked")
    try:
        array = np.asarray(value)
        kind = array.dtype
        if kind == np.object_:
            array = _numbers(array)
        elif kind != np.float64:
            if kind == np.bool_ or not np.can_cast(kind, np.float64, casting="same_kind"):
                raise TypeError(f"numbers of type {kind}")
            with np.errstate(all="ignore"):  # what float64 does not hold is told in our own words
                array = array.astype(np.float64)
        return np.array(array, order="C")  # sums round by the order of entries
    except (TypeError, ValueError) as error:
        got = " ".join(reprlib.repr(value).split())
        raise TypeError(f"{name}: expected {expected}, got {got} ({error})") from error


def _numbers(array: NDArray[np.object_]) -> Floats:
    """Floats from objects, as NumPy makes of tables with nullable types; TypeError names what is no number."""
    for place, entry in np.ndenumerate(array):
        if not isinstance(entry, numbers.Real) or isinstance(entry, bool | np.bool_):
            where = f" at {place[0] if len(place) == 1 else place}" if place else ""
            raise TypeError(f"{' '.join(reprlib.repr(entry).split())}{where}")
    return array.astype(np.float64)


def per_block(name: str, value: ArrayLike, n: int, bound: str = "") -> Floats:
    """A read-only float64 array of shape (n,) from one finite number or one a block.

    `bound` is "x > 0" or "x >= 0", by any name in the place of x.
    """
    if type(value) is float and math.isfinite(value) and (not bound or value > 0.0):  # at once, see `number`
        array = np.empty(n)
        array.fill(value)  # `np.full` takes three times as long
    else:
        array = floats(name, value, f"a number or {n} numbers")
        if array.ndim == 0:
            array = np.full(n, array)
        if array.shape != (n,):
            raise ValueError(f"{name}: expected a number or an array of shape ({n},), got shape {array.shape}")
        if not np.isfinite(array).all():
            block = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ValueError(f"{name}: expected finite values, got {array[block]} for block {block}")
        is_outside = np.less if bound.endswith(">= 0") else np.less_equal
        if bound and is_outside(array, 0.0).any():
            block = int(np.flatnonzero(is_outside(array, 0.0))[0])
            raise ValueError(f"{name}: expected {bound}, got {array[block]:g} for block {block}")
    array.flags.writeable = False
    return array


def number(name: str, value: Any, above: float = -np.inf, below: float = np.inf) -> float:
    """One finite number in the open interval (above, below)."""
    if type(value) is float and above < value < below:
        return value  # at once, as most are: small systems run in a fraction of a millisecond
    is_bounded = above > -np.inf
    array = floats(name, value, f"a number in ({above:g}, {below:g})" if is_bounded else "a finite number")
    if array.ndim != 0 or not np.isfinite(array) or not above < array < below:
        low, high = apart(above, below, *array.flat)[:2]
        expected = f"a number in ({low}, {high})" if is_bounded else "a finite number"
        raise ValueError(f"{name}: expected {expected}, got {value!r}")
    return float(array)


def flag(name: str, value: Any) -> bool:
    """True or False, and nothing that merely looks like it."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: expected True or False, got {value!r}")
    return bool(value)


def integer(name: str, value: Any, low: int, high: int | None) -> int:
    """One integer from low to high, both included; None: without bound."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: expected an integer, got {value!r}")
    if value < low or (high is not None and value > high):
        span = f"at least {low}" if high is None else f"from {low} to {high}"
        raise ValueError(f"{name}: expected an integer {span}, got {value}")
    return int(value)


def sign(name: str, value: Any) -> int:
    """+1 or -1."""
    if isinstance(value, bool | np.bool_) or value not in (-1, 1):
        raise ValueError(f"{name}: expected +1 or -1, got {value!r}")
    return int(value)


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """What `word` may have been meant for, as the end of a message; empty if nothing is near."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
