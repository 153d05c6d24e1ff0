"""Formulas for several blocks at once, written once in Python and emitted as vector instructions.

A formula is a function of numbers. It is called while a kernel is compiled, with `Lane` objects as its numbers, and
emits SIMD code for `WIDTH` numbers side by side; its loops are unrolled. LLVM splits the vectors where a processor
has shorter ones or none, and fuses products and sums where it can. No operation goes across lanes, so the result of a
block does not depend on its neighbours. Where nothing is compiled its numbers are arrays of NumPy (see `emit`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba import types

from stickslip.sim.kernels.compile import HAS_WIDE_REGISTERS
from stickslip.sim.kernels.emit import Code, Index, View, emitted, times_power_of_two
from stickslip.sim.kernels.emit import Lane as Lane
from stickslip.sim.kernels.emit import absolute as absolute
from stickslip.sim.kernels.emit import copysign as copysign
from stickslip.sim.kernels.emit import where as where

#: Numbers side by side: four float64 fill a register of AVX2, eight one of AVX-512.
NARROW = 4
WIDTH = 8 if HAS_WIDE_REGISTERS else NARROW


def greater(x: Lane, y: Lane | float) -> Lane:
    """The greater of two; the second if one is NaN."""
    return where(x > y, x, y)


def less(x: Lane, y: Lane | float) -> Lane:
    """The less of two; the second if one is NaN."""
    return where(x < y, x, y)


def total(terms: list[Lane]) -> Lane:
    """Their sum, by pairs: the terms of each pair wait for each other only."""
    while len(terms) > 1:
        pairs = [a + b for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[len(pairs) * 2 :]
    return terms[0]


def dot(weights: Any, terms: list[Lane]) -> Lane:
    """sum_k weights_k terms_k, in order, each step one instruction; weights of zero are left out."""
    weighted = [(float(weight), term) for weight, term in zip(weights, terms, strict=True) if weight != 0.0]
    result = weighted[0][1] * weighted[0][0]
    for weight, term in weighted[1:]:
        result = result + term * weight
    return result


_LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with 21 trailing zero bits, so that k times it is exact
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_SHIFT = 1.5 * 2.0**52


def exponential(x: Lane) -> Lane:
    """exp(x) for -700 < x < 700: 2^k exp(f), |f| <= ln(2) / 2, by its series to f^12 (the next adds 2e-16)."""
    shifted = x * _LOG2_E + _SHIFT
    k = shifted - _SHIFT
    f = (x - k * _LN2_HIGH) - k * _LN2_LOW
    powers = [f]
    terms: list[Any] = [1.0 / math.factorial(j) for j in range(13)]
    while len(terms) > 1:  # by pairs, with f, f^2, f^4, ...
        pairs = [powers[-1] * b + a for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[len(pairs) * 2 :]
        powers.append(powers[-1] * powers[-1])
    return times_power_of_two(terms[0], shifted)


class Rows:
    """The rows of a table at some columns, by name, as a formula reads and writes them: a list, if one a node."""

    def __init__(self, table: View, column: Index, width: int) -> None:
        vars(self).update(_places=table.places, _array=table.array, _column=column, _width=width)

    def _place(self, row: int) -> Index:
        return self._array.shape[1] * row + self._column

    def __getattr__(self, name: str) -> Any:
        first, count = self._places[name]
        rows = [self._array.load(self._place(first + k), self._width) for k in range(max(count, 1))]
        return rows if count else rows[0]

    def __setattr__(self, name: str, value: Lane | list[Lane]) -> None:
        first, _ = self._places[name]
        for k, lane in enumerate(value if isinstance(value, list) else [value]):
            self._array.store(self._place(first + k), lane)


class Numbers:
    """Numbers that are the same in every lane, by name: the first of a row, or all, where there is one row a node."""

    def __init__(self, code: Code, table: View) -> None:
        self._code, self._places, self._array = code, table.places, table.array

    def __getattr__(self, name: str) -> Any:
        first, count = self._places[name]
        return [[self._load(first + k, j) for j in range(count)] for k in range(count)] or self._load(first, 0)

    def _load(self, row: int, column: int) -> Lane:
        return self._code.spread(self._array[self._array.shape[1] * row + column], WIDTH)


def on_rows(formula: Callable[[Any, Any], Lane | None], width: int = WIDTH) -> Any:
    """A formula on rows of a table, for kernels.

    ``f(table, column, given)`` works on so many columns from `column` on. `given` is a table of numbers, or an empty
    named tuple, whose class the formula gets, so that it can emit code for that class alone. If the formula returns a
    condition, f returns a number whose bit k says whether it fails in column k: 0 if it holds in all.
    """

    def piece(code: Code, table: View, column: Index, table_of_numbers: Any) -> Index | None:
        shared = Numbers(code, table_of_numbers) if isinstance(table_of_numbers, View) else table_of_numbers
        condition = formula(Rows(table, column, width), shared)
        return None if condition is None else code.bits(condition) * -1 + (2**width - 1)

    return emitted(piece, types.int64)


def on_number(formula: Callable[[Lane], tuple[Lane, Lane]]) -> Any:
    """A formula from a number to two numbers, for kernels."""

    def piece(code: Code, x: Lane) -> tuple[Lane, Lane]:
        return formula(x)

    return emitted(piece, types.UniTuple(types.float64, 2))
