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

#: How many levels share a pass, and how many blocks: sums for them fill the registers.
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


def _for_columns(width: int) -> tuple[Any, Any]:
    """For `width` blocks from i on: all levels, and two."""
    several, single, values = _pass(_LEVELS, width, True), _pass(1, width, True), _pass(2, width, False)

    @inner
    def shift(rows, i, order, steps):  # type: ignore[no-untyped-def]
        k = 0
        while k + _LEVELS <= order:
            several(rows, rows, i, k, order, steps)
            k += _LEVELS
        while k < order:
            single(rows, rows, i, k, order, steps)
            k += 1

    return shift, values


(_shift_16, _values_16), (_shift_4, _values_4), (_shift_1, _values_1) = map(_for_columns, _WIDTHS)


@inner
def shift_rows(rows, first, last, order, steps):  # type: ignore[no-untyped-def]
    """Shift the origin of the series of blocks `first` to `last` - 1, each by its step.

    c_k <- sum_m C(m, k) c_m step^(m - k), m up to `order`.
    """
    by_16 = last - (last - first) % 16
    by_4 = last - (last - first) % 4
    for i in range(first, by_16, 16):
        _shift_16(rows, i, order, steps)
    for i in range(by_16, by_4, 4):
        _shift_4(rows, i, order, steps)
    for i in range(by_4, last):
        _shift_1(rows, i, order, steps)


@inner
def values_and_slopes(rows, order, steps, values):  # type: ignore[no-untyped-def]
    """Value and slope of the series of every block, of this order, at least 2, a step from its origin, by rows."""
    n = rows.shape[1]
    by_16, by_4 = n - n % 16, n - n % 4
    for i in range(0, by_16, 16):
        _values_16(rows, values, i, 0, order, steps)
    for i in range(by_16, by_4, 4):
        _values_4(rows, values, i, 0, order, steps)
    for i in range(by_4, n):
        _values_1(rows, values, i, 0, order, steps)
