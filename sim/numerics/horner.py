"""Horner's scheme for the series of many blocks side by side: a shift of their origin, and their value and slope.

Several levels of the scheme share a pass over the coefficients and stay in registers: with loops over levels, orders
and blocks a shift took 2.3 times as long for 200 blocks and 4.7 times for 20 (order 13), and runs of 20 to 200 blocks
and of a chain of 1,000 took 16 to 24% longer.
"""

from __future__ import annotations

from typing import Any

from stickslip.sim.kernels.compile import inner
from stickslip.sim.kernels.emit import Array, Cell, Code, Index, emitted
from stickslip.sim.numerics.arguments import Floats

#: How many levels share a pass, and how many blocks; what is left of these goes by the next width.
_LEVELS, _WIDTHS = 4, (16, 4, 1)


def _pass(n_levels: int, width: int, in_place: bool) -> Any:
    """``f(rows, target, i, k, order, steps)``: levels k, k + 1, ... of the scheme for `width` blocks from i on.

    Row m of `rows` holds the coefficients m of all blocks; `order` is the highest, at least k + `n_levels`. Level k
    adds step c_{m + 1} to c_m, from the highest m on down to k. If not `in_place`, only c_k, c_{k + 1}, ... are kept,
    in the first rows of `target`.
    """

    def piece(code: Code, rows: Array, target: Array, i: Index, k: Index, order: Index, steps: Array) -> None:
        step = steps.load(i, width)
        highest = rows.load(order * rows.shape[1] + i, width)
        sums = [code.cell(highest) for _ in range(n_levels)]

        def add(m: Index, levels: list[Cell]) -> None:
            value = rows.load(m * rows.shape[1] + i, width)
            for level in levels:
                value = level.value = code.fused(step, level.value, value)
            if in_place:
                target.store(m * target.shape[1] + i, value)

        code.loop(order - k - (n_levels - 1), lambda n: add(order - 1 - n, sums))
        for n in range(n_levels - 1, 0, -1):
            add(k + (n - 1), sums[:n])
        if not in_place:
            for m, level in enumerate(sums):
                target.store(target.shape[1] * m + i, level.value)

    return emitted(piece)


def _all_levels(width: int) -> Any:
    """As `_pass`, in place, of all levels from k on."""
    several, single = _pass(_LEVELS, width, True), _pass(1, width, True)

    @inner
    def apply(rows: Floats, target: Floats, i: int, k: int, order: int, steps: Floats) -> None:
        while k + _LEVELS <= order:
            several(rows, target, i, k, order, steps)
            k += _LEVELS
        while k < order:
            single(rows, target, i, k, order, steps)
            k += 1

    return apply


def _over_columns(parts: list[Any]) -> Any:
    """``f(rows, target, first, last, order, steps)``: blocks `first` to `last` - 1, by the parts of `_WIDTHS`."""
    (wide, narrow, _), (of_wide, of_narrow, of_one) = _WIDTHS, parts

    @inner
    def apply(rows: Floats, target: Floats, first: int, last: int, order: int, steps: Floats) -> None:
        by_wide, by_narrow = last - (last - first) % wide, last - (last - first) % narrow
        for i in range(first, by_wide, wide):
            of_wide(rows, target, i, 0, order, steps)
        for i in range(by_wide, by_narrow, narrow):
            of_narrow(rows, target, i, 0, order, steps)
        for i in range(by_narrow, last):
            of_one(rows, target, i, 0, order, steps)

    return apply


_shift = _over_columns([_all_levels(width) for width in _WIDTHS])
_values = _over_columns([_pass(2, width, False) for width in _WIDTHS])


@inner
def shift_rows(rows: Floats, first: int, last: int, order: int, steps: Floats) -> None:
    """Shift the origin of the series of blocks `first` to `last` - 1, each by its step.

    c_k <- sum_m C(m, k) c_m step^(m - k), m up to `order`.
    """
    _shift(rows, rows, first, last, order, steps)


@inner
def values_and_slopes(rows: Floats, order: int, steps: Floats, values: Floats) -> None:
    """Value and slope of the series of every block, of this order, at least 2, a step from its origin, by rows."""
    _values(rows, values, 0, rows.shape[1], order, steps)
