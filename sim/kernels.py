"""The loops that the engines share: products with K, and roots of polynomials that miss none."""

from __future__ import annotations

import math

import numba
import numba.extending
import numpy as np

from stickslip.sim.compile import inner

#: what rounding may do to a sum of terms, relative to the sum of their magnitudes
ROUNDING = 32 * np.finfo(np.float64).eps

#: what rounding K and a vector to float32, and adding the products up in it, may do to (K x)_i, relative to
#: sum_j |K_ij| max |x|: three roundings, and a margin for those of the sum
ROUGH = 8 * np.finfo(np.float32).eps

#: the deepest halving of the unit interval in search of a root; below it two roots count as one touching
_MAX_DEPTH = 44
_MAX_DEGREE = 40


#: Pascal's triangle; exact in float64 up to row 56
BINOMIALS = np.array([[float(math.comb(i, j)) for j in range(_MAX_DEGREE + 1)] for i in range(_MAX_DEGREE + 1)])


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


@inner
def _moving(x, u, moving):  # type: ignore[no-untyped-def]
    """List the blocks with x_j or u_j not zero; returns how many there are."""
    m = 0
    for j in range(len(x)):
        if x[j] != 0.0 or u[j] != 0.0:
            moving[m] = j
            m += 1
    return m


@inner
def _one_pass(dense, x, y, moving, m):  # type: ignore[no-untyped-def]
    """y = K x over the columns listed; eight columns share a pass over y."""
    n = len(x)
    for i in range(n):
        y[i] = 0.0
    eights = m - m % 8
    for j in range(0, eights, 8):
        c0, c1, c2, c3 = moving[j], moving[j + 1], moving[j + 2], moving[j + 3]
        c4, c5, c6, c7 = moving[j + 4], moving[j + 5], moving[j + 6], moving[j + 7]
        k0, k1, k2, k3, k4, k5, k6, k7 = (
            dense[c0], dense[c1], dense[c2], dense[c3], dense[c4], dense[c5], dense[c6], dense[c7],
        )  # fmt: skip
        x0, x1, x2, x3, x4, x5, x6, x7 = x[c0], x[c1], x[c2], x[c3], x[c4], x[c5], x[c6], x[c7]
        for i in range(n):
            y[i] += ((k0[i] * x0 + k1[i] * x1) + (k2[i] * x2 + k3[i] * x3)) + (
                (k4[i] * x4 + k5[i] * x5) + (k6[i] * x6 + k7[i] * x7)
            )
    for j in range(eights, m):
        column, xj = dense[moving[j]], x[moving[j]]
        for i in range(n):
            y[i] += column[i] * xj


@inner
def _two_in_one_pass(dense, x, u, y, z, moving, m):  # type: ignore[no-untyped-def]
    """y = K x and z = K u over the columns listed; eight columns share a pass over y and z."""
    n = len(x)
    for i in range(n):
        y[i] = 0.0
        z[i] = 0.0
    eights = m - m % 8
    for j in range(0, eights, 8):
        c0, c1, c2, c3 = moving[j], moving[j + 1], moving[j + 2], moving[j + 3]
        c4, c5, c6, c7 = moving[j + 4], moving[j + 5], moving[j + 6], moving[j + 7]
        k0, k1, k2, k3, k4, k5, k6, k7 = (
            dense[c0], dense[c1], dense[c2], dense[c3], dense[c4], dense[c5], dense[c6], dense[c7],
        )  # fmt: skip
        x0, x1, x2, x3, x4, x5, x6, x7 = x[c0], x[c1], x[c2], x[c3], x[c4], x[c5], x[c6], x[c7]
        u0, u1, u2, u3, u4, u5, u6, u7 = u[c0], u[c1], u[c2], u[c3], u[c4], u[c5], u[c6], u[c7]
        for i in range(n):
            a, b, c, d, e, f, g, h = k0[i], k1[i], k2[i], k3[i], k4[i], k5[i], k6[i], k7[i]
            y[i] += ((a * x0 + b * x1) + (c * x2 + d * x3)) + ((e * x4 + f * x5) + (g * x6 + h * x7))
            z[i] += ((a * u0 + b * u1) + (c * u2 + d * u3)) + ((e * u4 + f * u5) + (g * u6 + h * u7))
    for j in range(eights, m):
        column, xj, uj = dense[moving[j]], x[moving[j]], u[moving[j]]
        for i in range(n):
            y[i] += column[i] * xj
            z[i] += column[i] * uj


@inner
def _sparse_product(columns, x, y):  # type: ignore[no-untyped-def]
    _, _, indptr, indices, data = columns
    for i in range(len(x)):
        y[i] = 0.0
    for j in range(len(x)):
        if x[j] != 0.0:
            for k in range(indptr[j], indptr[j + 1]):
                y[indices[k]] += data[k] * x[j]


@inner
def one_product(columns, x, y, moving):  # type: ignore[no-untyped-def]
    """y = K x; see `two_products`."""
    if len(columns[0]) == 0:
        _sparse_product(columns, x, y)
    else:
        _one_pass(columns[0], x, y, moving, _moving(x, x, moving))


@inner
def two_products(columns, x, u, y, z, moving):  # type: ignore[no-untyped-def]
    """y = K x and z = K u in one pass over K: reading K, not the arithmetic, is what a product costs.

    Columns of blocks that do not move (x_j = u_j = 0) are not read; `moving` is work space, int64, shape (n,).
    """
    if len(columns[0]) == 0:
        _sparse_product(columns, x, y)
        _sparse_product(columns, u, z)
    else:
        _two_in_one_pass(columns[0], x, u, y, z, moving, _moving(x, u, moving))


@inner
def rough_product(columns, x, y, moving, single):  # type: ignore[no-untyped-def]
    """y = K x with K in float32, off by at most ROUGH sum_j |K_ij| max |x|: half the memory to read.

    `single` is work space, float32, shape (2, n).
    """
    x_max = largest(x)
    if len(columns[0]) == 0 or x_max == 0.0:
        one_product(columns, x, y, moving)
        return
    for i in range(len(x)):  # in units of the largest, or small numbers would leave the range of float32
        single[0, i] = x[i] / x_max
    _one_pass(columns[1], single[0], single[1], moving, _moving(x, x, moving))
    for i in range(len(x)):
        y[i] = single[1, i] * x_max


@inner
def to_bernstein(coefficients, degree, bernstein):  # type: ignore[no-untyped-def]
    """Power basis on [0, 1] to Bernstein basis: b_j = sum_{k<=j} C(j,k) / C(degree,k) a_k, by sums of neighbours."""
    for k in range(degree + 1):
        bernstein[k] = coefficients[k] / BINOMIALS[degree, k]
    for k in range(1, degree + 1):
        for j in range(degree, k - 1, -1):
            bernstein[j] += bernstein[j - 1]


@inner
def horner(coefficients, degree, x):  # type: ignore[no-untyped-def]
    """Value of a polynomial."""
    value = coefficients[degree]
    for k in range(degree - 1, -1, -1):
        value = value * x + coefficients[k]
    return value


@inner
def _sign_changes(bernstein, degree):  # type: ignore[no-untyped-def]
    changes = 0
    last = 0.0
    for j in range(degree + 1):
        if bernstein[j] != 0.0:
            if last * bernstein[j] < 0.0:
                changes += 1
            last = bernstein[j]
    return changes


@inner
def _refine(coefficients, degree, low, high, rises):  # type: ignore[no-untyped-def]
    """The one root in (low, high), to rounding: Newton's method, kept inside a shrinking bracket.

    Whether the polynomial rises through it is said by the caller: at an end that is a root too, its value does not.
    """
    x = 0.5 * (low + high)
    for _ in range(100):
        value = coefficients[degree]
        slope = 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + value
            value = value * x + coefficients[k]
        if value == 0.0:
            return x
        if (value < 0.0) == rises:
            low = x
        else:
            high = x
        new = x - value / slope if slope != 0.0 else low
        if not (low < new < high):
            new = 0.5 * (low + high)
        if abs(new - x) <= 2.2e-16 * abs(x) or new in (low, high):
            return new
        x = new
    return x


@inner
def roots(coefficients, degree, found):  # type: ignore[no-untyped-def]
    """Roots in (0, 1] of a polynomial in the power basis with a_0 != 0, in rising order.

    By Descartes' rule in the Bernstein basis: an interval whose coefficients do not change sign holds no
    root, one change means exactly one root, more are halved. So two roots close together are both found;
    where a polynomial only touches zero, rounding decides between a pair, one root at the touch, and none.

    Returns the number of roots; their places are in `found`, and as many are looked for as it holds.
    """
    stack = np.empty((_MAX_DEPTH + 2, degree + 1))
    stack_low = np.empty(_MAX_DEPTH + 2)
    stack_depth = np.empty(_MAX_DEPTH + 2, dtype=np.int64)
    n_found = 0
    to_bernstein(coefficients, degree, stack[0])
    stack_low[0] = 0.0
    stack_depth[0] = 0
    top = 0
    while top >= 0:
        changes = _sign_changes(stack[top], degree)
        low = stack_low[top]
        depth = stack_depth[top]
        width = 0.5**depth
        at_end = stack[top, degree] == 0.0 and changes == 0 and depth <= _MAX_DEPTH
        if changes == 0:
            top -= 1
            if not at_end:
                continue
            root = low + width
        elif changes == 1 and stack[top, 0] * stack[top, degree] < 0.0:
            top -= 1
            root = _refine(coefficients, degree, low, low + width, stack[top + 1, 0] < 0.0)
        elif depth >= _MAX_DEPTH:
            top -= 1
            root = low
        else:
            # de Casteljau: the left half goes on top of the right half
            right = stack[top]
            left = stack[top + 1]
            for j in range(degree + 1):
                left[j] = right[0]
                for k in range(degree - j):
                    right[k] = 0.5 * (right[k] + right[k + 1])
            stack_low[top] = low + 0.5 * width
            stack_depth[top] = depth + 1
            stack_low[top + 1] = low
            stack_depth[top + 1] = depth + 1
            top += 1
            continue
        if n_found == 0 or root > found[n_found - 1]:
            found[n_found] = root
            n_found += 1
            if n_found == len(found):
                return n_found
    return n_found


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
