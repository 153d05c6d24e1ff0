"""Arguments of public statistics, checked: whatever has no meaning is refused by a ValueError with its name."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable
from numbers import Real
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

_Kind = TypeVar("_Kind")
_Function = TypeVar("_Function", bound=Callable[..., object])


def number(name: str, value: object, expected: str = "a number") -> float:
    """A number, of Python or NumPy: no truth and no text."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise ValueError(f"{name}: expected {expected}, got {reprlib.repr(value)}; give one")
    return float(value)


def numbers(name: str, values: ArrayLike, expected: str) -> np.ndarray:
    """An array of numbers, float64."""
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name}: expected {expected}, got {reprlib.repr(values)}; give numbers")
    return array.astype(np.float64)


def instance(name: str, value: object, kind: type[_Kind]) -> _Kind:
    """An object of a type."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise ValueError(f"{name}: expected {article} {kind.__name__}, got {reprlib.repr(value)}; give one")
    return value


def called(name: str, value: _Function, example: str) -> _Function:
    """What can be called."""
    if not callable(value):
        raise ValueError(f"{name}: expected a function, got {reprlib.repr(value)}; give one, such as {example}")
    return value


def level(confidence: float) -> float:
    """A level of confidence, between 0 and 1."""
    is_number = isinstance(confidence, Real)
    if not is_number or not 0.0 < confidence < 1.0:
        in_percent = is_number and 1.0 < confidence < 100.0
        raise ValueError(
            f"confidence: expected a number between 0 and 1, got {confidence!r}; "
            f"write {confidence / 100 if in_percent else 0.95:g}"
        )
    return float(confidence)


def sums(values: ArrayLike, n_columns: int | None = None, name: str = "sums") -> np.ndarray:
    """Rows of sums, one a matrix, finite float64 of shape (m, c); of two columns the second holds counts >= 0."""
    try:
        rows = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.ndim != 2 or n_columns not in (None, rows.shape[1]):
        shape = f"(matrices, {n_columns or 'columns'})"
        raise ValueError(
            f"{name}: expected numbers of shape {shape}, got {reprlib.repr(values)}; make a row for each matrix,"
            " np.array([[sizes.sum(), len(sizes)]]) for the sizes of one"
        )
    if not math.isfinite(rows.sum()) and not np.isfinite(rows).all():
        row, column = (int(k) for k in np.argwhere(~np.isfinite(rows))[0])
        raise ValueError(
            f"{name}: expected finite numbers, got {rows[row, column]} in row {row}, column {column}; leave out "
            "matrices that have none"
        )
    if n_columns == 2 and (rows[:, 1] < 0).any():
        row = int(np.flatnonzero(rows[:, 1] < 0)[0])
        raise ValueError(
            f"{name}: expected counts >= 0 in column 1, got {rows[row, 1]:g} in row {row}; give how many"
        )
    return rows


def counts(name: str, values: ArrayLike) -> np.ndarray:
    """Numbers of things, an array of any shape."""
    numbers = np.asarray(values)
    is_wrong = ~np.isfinite(numbers) | (numbers < 0)
    if is_wrong.any():
        raise ValueError(f"{name}: expected finite numbers >= 0, got {numbers[is_wrong][0]:g}; give how many")
    return numbers
