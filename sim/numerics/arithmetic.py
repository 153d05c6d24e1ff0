"""Arithmetic that the kernels share: a bound of rounding, the largest of an array, a copy; and arrays for it."""

from __future__ import annotations

import math
from typing import Any

import numba
import numba.extending
import numpy as np
from numba.core import cgutils
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import DTypeLike, NDArray

from stickslip.sim.kernels.compile import inner

#: A bound of the rounding of a sum, relative to the sum of the magnitudes of its terms
ROUNDING = 32 * np.finfo(np.float64).eps
_LINE = 64  # the bytes of a line of the cache


def aligned_zeros(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Zeros that begin with a line of the cache: a load of eight numbers then never takes two lines.

    Products of K took 17% longer with arrays where numpy puts them (n = 200, AVX-512).
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.zeros(size + _LINE, np.uint8)
    first = -room.__array_interface__["data"][0] % _LINE
    return room[first : first + size].view(dtype).reshape(shape)


@numba.extending.intrinsic
def _bits(typing_context, value):  # type: ignore[no-untyped-def]
    """The 64 bits of a float64 as an integer; of floats >= 0 they are in the order of the floats."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))

    return numba.types.int64(numba.types.float64), codegen


@numba.extending.intrinsic
def _as_float(typing_context, bits):  # type: ignore[no-untyped-def]
    """The float64 with these 64 bits."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], context.get_value_type(signature.return_type))

    return numba.types.float64(numba.types.int64), codegen


def _room(typing_context, rows, columns):  # type: ignore[no-untyped-def]
    """A float64 array on the stack, of this shape, two literals; it is gone when the function returns."""
    kind = numba.types.Array(numba.types.float64, 2, "C")
    shape = rows.literal_value, columns.literal_value

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        numbers = [context.get_constant(numba.types.intp, k) for k in (*shape, 8 * shape[1], 8)]
        data = cgutils.alloca_once(builder, context.get_value_type(numba.types.float64), size=shape[0] * shape[1])
        array = make_array(kind)(context, builder)
        populate_array(array, data, numbers[:2], numbers[2:], numbers[3], None)
        return array._getvalue()

    return kind(rows, columns), codegen


room: Any = numba.extending.intrinsic(prefer_literal=True)(_room)


@inner
def largest(x):  # type: ignore[no-untyped-def]
    """max |x_i|, NaN if there is one: by their bits, since a maximum of floats does not vectorise."""
    most = np.int64(0)
    for i in range(len(x)):
        bits = _bits(abs(x[i]))  # type: ignore[call-arg, var-annotated]
        most = bits if bits > most else most
    return _as_float(most)  # type: ignore[call-arg]


@inner
def copy(source, target):  # type: ignore[no-untyped-def]
    """target = source: as a loop, since an assignment of arrays takes ten times as long to compile."""
    for i in range(len(source)):
        target[i] = source[i]
