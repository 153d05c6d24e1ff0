"""Horner's scheme for the series of many blocks side by side: a shift of their origin, and their value and slope.

Several levels of the scheme share a pass over the coefficients and stay in registers: with loops over levels, orders
and blocks a shift took 2.3 times as long for 200 blocks and 4.7 times for 20 (order 13), and runs of 20 to 200 blocks
and of a chain of 1,000 took 16 to 24% longer.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from stickslip.sim.kernels.compile import inner

#: How many levels share a pass, and how many blocks; what is left of these goes by the next width.
_LEVELS, _WIDTHS = 4, (16, 4, 1)


def _pass(n_levels: int, width: int, in_place: bool) -> Any:
    """``f(rows, target, i, k, order, steps)``: levels k, k + 1, ... of the scheme for `width` blocks from i on.

    Row m of `rows` holds the coefficients m of all blocks; `order` is the highest, at least k + `n_levels`. Level k
    adds step c_{m + 1} to c_m, from the highest m on down to k. If not `in_place`, only c_k, c_{k + 1}, ... are kept,
    in the first rows of `target`.
    """
    number, index = ir.DoubleType(), ir.IntType(64)
    vector = ir.VectorType(number, width)

    @intrinsic
    def apply(typing_context, rows, target, i, k, order, steps):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            source, result, lengths = (
                context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 1, 5)
            )
            first, low, top = arguments[2:5]
            fused = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fmuladd.v{width}f64"
            )

            def place(array: Any, m: Any) -> Any:
                stride = cgutils.unpack_tuple(builder, array.shape)[-1]
                at = builder.gep(array.data, [builder.add(builder.mul(m, stride), first)])
                return builder.bitcast(at, vector.as_pointer())

            def load(array: Any, m: Any) -> Any:
                value = builder.load(place(array, m))
                value.align = 8
                return value

            def store(value: Any, array: Any, m: Any) -> None:
                builder.store(value, place(array, m)).align = 8

            step = load(lengths, index(0))

            def row(m: Any, levels: int) -> None:
                value = load(source, m)
                for level in sums[:levels]:
                    value = builder.call(fused, [step, builder.load(level), value])
                    builder.store(value, level)
                if in_place:
                    store(value, result, m)

            sums = [cgutils.alloca_once(builder, vector) for _ in range(n_levels)]
            highest = load(source, top)
            for level in sums:
                builder.store(highest, level)
            shared = builder.sub(top, builder.add(low, index(n_levels - 1)))
            with cgutils.for_range(builder, shared) as loop:
                row(builder.sub(builder.sub(top, index(1)), loop.index), n_levels)
            for levels in range(n_levels - 1, 0, -1):
                row(builder.add(low, index(levels - 1)), levels)
            if not in_place:
                for m, level in enumerate(sums):
                    store(builder.load(level), result, index(m))
            return context.get_dummy_value()

        return types.void(rows, target, types.intp, types.intp, types.intp, steps), codegen

    return apply


def _all_levels(width: int) -> Any:
    """``f(rows, target, i, order, steps)``: the whole scheme, in place, for `width` blocks from i on."""
    several, single = _pass(_LEVELS, width, True), _pass(1, width, True)

    @inner
    def apply(rows, target, i, order, steps):  # type: ignore[no-untyped-def]
        k = 0
        while k + _LEVELS <= order:
            several(rows, target, i, k, order, steps)
            k += _LEVELS
        while k < order:
            single(rows, target, i, k, order, steps)
            k += 1

    return apply


def _two_levels(width: int) -> Any:
    """As `_all_levels`, of two levels, into two rows of `target`."""
    two = _pass(2, width, False)

    @inner
    def apply(rows, target, i, order, steps):  # type: ignore[no-untyped-def]
        two(rows, target, i, 0, order, steps)

    return apply


def _over_columns(parts: list[Any]) -> Any:
    """``f(rows, target, first, last, order, steps)``: blocks `first` to `last` - 1, by the parts of `_WIDTHS`."""
    (wide, narrow, _), (of_wide, of_narrow, of_one) = _WIDTHS, parts

    @inner
    def apply(rows, target, first, last, order, steps):  # type: ignore[no-untyped-def]
        by_wide, by_narrow = last - (last - first) % wide, last - (last - first) % narrow
        for i in range(first, by_wide, wide):
            of_wide(rows, target, i, order, steps)
        for i in range(by_wide, by_narrow, narrow):
            of_narrow(rows, target, i, order, steps)
        for i in range(by_narrow, last):
            of_one(rows, target, i, order, steps)

    return apply


_shift, _values = _over_columns([*map(_all_levels, _WIDTHS)]), _over_columns([*map(_two_levels, _WIDTHS)])


@inner
def shift_rows(rows, first, last, order, steps):  # type: ignore[no-untyped-def]
    """Shift the origin of the series of blocks `first` to `last` - 1, each by its step.

    c_k <- sum_m C(m, k) c_m step^(m - k), m up to `order`.
    """
    _shift(rows, rows, first, last, order, steps)


@inner
def values_and_slopes(rows, order, steps, values):  # type: ignore[no-untyped-def]
    """Value and slope of the series of every block, of this order, at least 2, a step from its origin, by rows."""
    _values(rows, values, 0, rows.shape[1], order, steps)
