"""Arithmetic that the kernels share: what rounding may do, the largest of an array, a copy, tanh."""

from __future__ import annotations

import math

import numba
import numba.extending
import numpy as np

from stickslip.sim.engines.compile import inner

#: What rounding may do to a sum of terms, relative to the sum of their magnitudes
ROUNDING = 32 * np.finfo(np.float64).eps


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


@inner
def largest(x):  # type: ignore[no-untyped-def]
    """max |x_i|, NaN if there is one: taken over the bits, since a maximum of floats does not vectorise."""
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


_LOG2_E = 1.4426950408889634
# ln 2 in two parts, the first with 21 trailing zero bits, so that k times it is exact
_LN2_HIGH = 0.6931471803691238
_LN2_LOW = 1.9082149292705877e-10
#: Taylor coefficients of exp; with |f| <= ln(2)/2 the first one left out adds 2e-16
_EXP = np.array([1.0 / math.factorial(k) for k in range(13)])


@inner
def tanh_positive(y):  # type: ignore[no-untyped-def]
    """tanh(y) for y >= 0 to 2 units in the last place of 1, without branches, so that loops over it vectorise.

    tanh y = (1 - E) / (1 + E), E = exp(-2 y) = 2^k exp(f), |f| <= ln(2) / 2; the absolute error is what a
    force of size mu tanh needs. Beyond y = 20 the result is 1 to rounding.
    """
    x = -2.0 * min(y, 20.0)
    k = np.rint(x * _LOG2_E)
    f = (x - k * _LN2_HIGH) - k * _LN2_LOW
    p = _EXP[12]
    p = p * f + _EXP[11]
    p = p * f + _EXP[10]
    p = p * f + _EXP[9]
    p = p * f + _EXP[8]
    p = p * f + _EXP[7]
    p = p * f + _EXP[6]
    p = p * f + _EXP[5]
    p = p * f + _EXP[4]
    p = p * f + _EXP[3]
    p = p * f + _EXP[2]
    p = p * f + _EXP[1]
    p = p * f + _EXP[0]
    e = p * _as_float((np.int64(k) + 1023) << 52)  # type: ignore[call-arg]
    return (1.0 - e) / (1.0 + e)
