"""Products of one matrix with several vectors at once.

One product is bound by memory: each entry of K is read for one multiplication. Several vectors share that read. K is
kept in panels of rows; the sums of a panel, for every vector, stay in registers while K streams by.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import DTypeLike, NDArray

from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arithmetic import aligned_zeros

#: Rows of a panel: sums of 8 float64 or 16 float32 fill two registers of AVX2 a vector.
HEIGHT, SINGLE_HEIGHT = 8, 16
#: The same for panels for two vectors, whose sums leave more registers.
PAIR_HEIGHT, SINGLE_PAIR_HEIGHT = 16, 32
#: The error of (K x)_i in float32, relative to sum_j |K_ij| max |x|: roundings of K, x and their products, and of the
#: sum. With terms of random signs it was 0.05 of this, n = 48 to 3,000; with terms of one sign at most 0.8 of it with
#: n = 200, and 4 with n = 3,000.
SINGLE_ERROR = 8 * float(np.finfo(np.float32).eps)
_SINGLE_MAX = float(np.finfo(np.float32).max)


def panels(matrix: NDArray[np.float64], height: int, dtype: DTypeLike) -> NDArray[Any]:
    """A square matrix, or several, shape (..., n, n), in panels of `height` rows, each stored by columns.

    Rows of zeros are added to fill the last panel. Shape (..., number of panels, n, height).
    """
    *several, n, _ = matrix.shape
    found, whole = aligned_zeros((*several, -(-n // height), n, height), dtype), n // height
    if dtype == np.float32:  # what is beyond its range is not used, but infinity would be warned of
        matrix = np.clip(matrix, -_SINGLE_MAX, _SINGLE_MAX)
    if whole:
        rows = matrix[..., : whole * height, :].reshape(*several, whole, height, n)
        found[..., :whole, :, :] = rows.swapaxes(-1, -2)
    if n % height:
        found[..., whole, :, : n % height] = matrix[..., whole * height :, :].swapaxes(-1, -2)
    return found


def _panel(n_vectors: int, height: int, single: bool, listed: bool = False) -> Any:
    """The code for one panel: ``f(panels, p, x, y)`` puts rows p height ... of K x_k into y_k, k < n_vectors.

    If `listed`, it is ``f(panels, p, x, y, columns, m)``: only the first m of these columns are read.
    """
    number = ir.FloatType() if single else ir.DoubleType()
    vector, index = ir.VectorType(number, height), ir.IntType(64)
    ones = ir.Constant(ir.VectorType(ir.IntType(32), height), [0] * height)

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        arrays = {a: context.make_array(signature.args[a])(context, builder, arguments[a])
                  for a in (0, 2, 3, *([4] if listed else []))}  # fmt: skip
        k, xs, ys = arrays[0], arrays[2], arrays[3]
        n = cgutils.unpack_tuple(builder, k.shape)[1]
        x_stride, y_stride = (cgutils.unpack_tuple(builder, array.shape)[1] for array in (xs, ys))
        name = f"llvm.fmuladd.v{height}f{32 if single else 64}"
        fused = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
        sums = [cgutils.alloca_once(builder, vector) for _ in range(n_vectors)]
        for place in sums:
            builder.store(ir.Constant(vector, [0.0] * height), place)
        first = builder.mul(arguments[1], builder.mul(n, index(height)))
        with cgutils.for_range(builder, arguments[5] if listed else n) as loop:
            j = builder.load(builder.gep(arrays[4].data, [loop.index])) if listed else loop.index
            at = builder.gep(k.data, [builder.add(first, builder.mul(j, index(height)))])
            column = builder.load(builder.bitcast(at, vector.as_pointer()))
            column.align = 4 if single else 8
            for v, place in enumerate(sums):
                one = builder.load(builder.gep(xs.data, [builder.add(builder.mul(x_stride, index(v)), j)]))
                undefined = ir.Constant(vector, ir.Undefined)
                spread = builder.insert_element(undefined, one, ir.IntType(32)(0))
                spread = builder.shuffle_vector(spread, undefined, ones)
                builder.store(builder.call(fused, [column, spread, builder.load(place)]), place)
        row = builder.mul(arguments[1], index(height))
        for v, place in enumerate(sums):
            at = builder.gep(ys.data, [builder.add(builder.mul(y_stride, index(v)), row)])
            store = builder.store(builder.load(place), builder.bitcast(at, vector.as_pointer()))
            store.align = 4 if single else 8
        return context.get_dummy_value()

    if listed:

        @intrinsic
        def apply(typing_context, panels, p, x, y, columns, m):  # type: ignore[no-untyped-def]
            return types.void(panels, types.intp, x, y, columns, types.intp), codegen

    else:

        @intrinsic
        def apply(typing_context, panels, p, x, y):  # type: ignore[no-untyped-def]
            return types.void(panels, types.intp, x, y), codegen

    return apply


def products(n_vectors: int, single: bool = False) -> Any:
    """For kernels: ``f(panels, x, y)`` makes y_k = K x_k for the `n_vectors` rows of x and y.

    x and y, shape (n_vectors, m), are as long as the panels are high, at least; panels are made by `panels` with
    `HEIGHT` and float64, or with `SINGLE_HEIGHT` and float32 if `single`.
    """
    panel = _panel(n_vectors, SINGLE_HEIGHT if single else HEIGHT, single)

    @inner
    def apply(panels, x, y):  # type: ignore[no-untyped-def]
        for p in range(len(panels)):
            panel(panels, p, x, y)

    return apply


def pair_products(single: bool = False) -> Any:
    """For kernels: ``f(panels, x, y, columns, m)`` makes y_k = K x_k of two vectors, over the first m columns listed.

    As `products`, with panels of `PAIR_HEIGHT` and float64, or of `SINGLE_PAIR_HEIGHT` and float32; y alone is as
    long as they are high. x_j of a column that is not listed counts as zero.
    """
    panel = _panel(2, SINGLE_PAIR_HEIGHT if single else PAIR_HEIGHT, single, listed=True)

    @inner
    def apply(panels, x, y, columns, m):  # type: ignore[no-untyped-def]
        for p in range(len(panels)):
            panel(panels, p, x, y, columns, m)

    return apply
