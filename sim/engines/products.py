"""Products of K with one vector or two: what most of a run's time goes into."""

from __future__ import annotations

from stickslip.sim.engines.compile import inner


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
    indptr, indices, data = columns.indptr, columns.indices, columns.data
    for i in range(len(x)):
        y[i] = 0.0
    for j in range(len(x)):
        if x[j] != 0.0:
            for k in range(indptr[j], indptr[j + 1]):
                y[indices[k]] += data[k] * x[j]


@inner
def one_product(columns, x, y, moving):  # type: ignore[no-untyped-def]
    """y = K x; see `two_products`."""
    if len(columns.dense) == 0:
        _sparse_product(columns, x, y)
    else:
        _one_pass(columns.dense, x, y, moving, _moving(x, x, moving))


@inner
def two_products(columns, x, u, y, z, moving):  # type: ignore[no-untyped-def]
    """y = K x and z = K u in one pass over K: reading K, not the arithmetic, is what a product costs.

    Columns of blocks that do not move (x_j = u_j = 0) are not read; `moving` is work space, int64, shape (n,).
    """
    if len(columns.dense) == 0:
        _sparse_product(columns, x, y)
        _sparse_product(columns, u, z)
    else:
        _two_in_one_pass(columns.dense, x, u, y, z, moving, _moving(x, u, moving))
