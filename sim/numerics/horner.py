"""Horner's scheme for the series of many blocks side by side: a shift of their origin, and their value and slope.

Of several blocks the values of a level stay in registers: with plain loops runs took 9 to 17% longer.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stickslip.sim.kernels.compile import inner
from stickslip.sim.kernels.emit import Array, Code, Index, emitted
from stickslip.sim.numerics.arguments import Floats

#: How many blocks share a pass; what is left of them goes by the next width.
_WIDTHS = 16, 4, 1


def _shift_of(width: int) -> Any:
    """``f(rows, target, i, order, steps)``: `shift_rows`, in place, of `width` blocks from i on, level by level."""

    def piece(code: Code, rows: Array, _: Array, i: Index, order: Index, steps: Array) -> None:
        step, stride = steps.load(i, width), rows.shape[1]
        highest = rows.load(stride * order + i, width)

        def level(k: Index) -> None:
            value = code.cell(highest)

            def add(n: Index) -> None:
                place = stride * (order - 1 - n) + i
                value.value = code.fused(step, value.value, rows.load(place, width))
                rows.store(place, value.value)

            code.loop(order - k, add)

        code.loop(order, level)

    return emitted(piece)


def _values_of(width: int) -> Any:
    """``f(rows, target, i, order, steps)``: `values_and_slopes` of `width` blocks from i on."""

    def piece(code: Code, rows: Array, target: Array, i: Index, order: Index, steps: Array) -> None:
        step, stride = steps.load(i, width), rows.shape[1]
        value, slope = code.cell(rows.load(stride * order + i, width)), code.cell(code.zeros(width, np.float64))

        def add(n: Index) -> None:
            slope.value = code.fused(step, slope.value, value.value)
            value.value = code.fused(step, value.value, rows.load(stride * (order - 1 - n) + i, width))

        code.loop(order, add)
        target.store(i, value.value)
        target.store(target.shape[1] + i, slope.value)

    return emitted(piece)


def _over_columns(parts: list[Any]) -> Any:
    """``f(rows, target, first, last, order, steps)``: blocks `first` to `last` - 1, by the parts of `_WIDTHS`."""
    (wide, narrow, _), (of_wide, of_narrow, of_one) = _WIDTHS, parts

    @inner
    def apply(rows: Floats, target: Floats, first: int, last: int, order: int, steps: Floats) -> None:
        by_wide, by_narrow = last - (last - first) % wide, last - (last - first) % narrow
        for i in range(first, by_wide, wide):
            of_wide(rows, target, i, order, steps)
        for i in range(by_wide, by_narrow, narrow):
            of_narrow(rows, target, i, order, steps)
        for i in range(by_narrow, last):
            of_one(rows, target, i, order, steps)

    return apply


_shift = _over_columns([_shift_of(width) for width in _WIDTHS])
_values = _over_columns([_values_of(width) for width in _WIDTHS])


@inner
def shift_rows(rows: Floats, first: int, last: int, order: int, steps: Floats) -> None:
    """Shift the origin of the series of blocks `first` to `last` - 1, each by its step.

    c_k <- sum_m C(m, k) c_m step^(m - k), m up to `order`.
    """
    _shift(rows, rows, first, last, order, steps)


@inner
def values_and_slopes(rows: Floats, order: int, steps: Floats, values: Floats) -> None:
    """Value and slope of the series of every block of this order, a step from its origin, by rows."""
    _values(rows, values, 0, rows.shape[1], order, steps)
