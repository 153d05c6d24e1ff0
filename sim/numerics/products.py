"""Products of K with one vector or two, which take most of the time of a run."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.panels import PAIR_HEIGHT, SINGLE_PAIR_HEIGHT, listed_products, panels
from stickslip.sim.numerics.sparse import Columns

_pair, _single_pair = listed_products(2, PAIR_HEIGHT, False), listed_products(2, SINGLE_PAIR_HEIGHT, True)
#: Systems of fewer blocks gain nothing from float32; row sums beyond this, or below its inverse, may leave its range.
_SMALL, _LARGE = 48, 1e30


class Pairs(NamedTuple):
    """K in panels, for products with two vectors at a time.

    Both kinds of panels are empty if K is sparse, those in float32 also where they do not pay.
    """

    panels: Floats
    single_panels: NDArray[np.float32]

    @classmethod
    def of(cls, matrices: Floats, row_sums: Floats) -> Pairs:
        """Those of several dense K, shape (m, n, n), of one kind, see `are_of_one_kind`; (m, 0, 0) of a sparse K."""
        m, n = row_sums.shape
        double, single = np.empty((m, 0, n, PAIR_HEIGHT)), np.empty((m, 0, n, SINGLE_PAIR_HEIGHT), np.float32)
        if matrices.size:
            double = panels(matrices, PAIR_HEIGHT, np.float64)
            if _may_be_single(row_sums[0]):
                single = panels(matrices, SINGLE_PAIR_HEIGHT, np.float32)
        return cls(double, single)


class Room(NamedTuple):
    """Workspace of products."""

    product: Floats
    single: NDArray[np.float32]
    single_product: NDArray[np.float32]
    columns: Ints  #: a list of blocks, for the next products; see `list_moving`

    @classmethod
    def of(cls, n: int) -> Room:
        """For n blocks."""
        padded = -(-n // SINGLE_PAIR_HEIGHT) * SINGLE_PAIR_HEIGHT
        single, single_product = np.zeros((2, n), np.float32), np.zeros((2, padded), np.float32)
        return cls(np.zeros((2, padded)), single, single_product, np.zeros(n, np.int64))


def _may_be_single(sums: Floats) -> bool:
    """Whether there are so many blocks that float32 pays, and the row sums of |K| are well within its range."""
    if len(sums) < _SMALL or not (coupled := sums[sums > 0.0]).size:
        return False
    return bool(coupled.min() > 1 / _LARGE and coupled.max() < _LARGE)


def are_of_one_kind(row_sums: Floats) -> bool:
    """Whether the pairs of all matrices have float32, or none; from row sums of |K|, shape (m, n)."""
    return row_sums.shape[1] < _SMALL or len({_may_be_single(sums) for sums in row_sums}) == 1


@inner
def list_moving(x: Floats, u: Floats, moving: Ints) -> int:
    """List the blocks with x_j or u_j not zero; returns how many there are."""
    m = 0
    for j in range(len(x)):
        if x[j] != 0.0 or u[j] != 0.0:
            moving[m] = j
            m += 1
    return m


@inner
def _one_pass(dense: Floats, x: Floats, y: Floats, moving: Ints, m: int) -> None:
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
def _sparse_product(columns: Columns, x: Floats, y: Floats) -> None:
    indptr, indices, data = columns.indptr, columns.indices, columns.data
    for i in range(len(x)):
        y[i] = 0.0
    for j in range(len(x)):
        if x[j] != 0.0:
            for k in range(indptr[j], indptr[j + 1]):
                y[indices[k]] += data[k] * x[j]


@inner
def one_product(columns: Columns, x: Floats, y: Floats, moving: Ints) -> None:
    """y = K x; see `two_products`."""
    if len(columns.dense) == 0:
        _sparse_product(columns, x, y)
    else:
        _one_pass(columns.dense, x, y, moving, list_moving(x, x, moving))


@inner
def two_products(columns: Columns, pairs: Pairs, room: Room, m: int, x: Floats, y: Floats) -> None:
    """y_k = K x_k of two vectors, shape (2, n), in one pass over K, whose cost is reading K and not the arithmetic.

    Of a dense K only the columns of the m blocks that `list_moving` has put into `room.columns` are read.
    """
    if len(pairs.panels) == 0:
        _sparse_product(columns, x[0], y[0])
        _sparse_product(columns, x[1], y[1])
    else:
        product = room.product
        _pair(pairs.panels, x, product, room.columns, m)
        for k in range(2):
            for i in range(y.shape[1]):
                y[k, i] = product[k, i]


@inner
def two_single_products(pairs: Pairs, room: Room, m: int, x: Floats, sizes: Floats, y: Floats) -> None:
    """As `two_products`, in single precision, each vector scaled to its size; the error is that of `SINGLE_ERROR`."""
    single, product = room.single, room.single_product
    for k in range(2):
        scale = 1.0 / sizes[k] if sizes[k] > 0.0 else 0.0
        for j in range(x.shape[1]):
            single[k, j] = np.float32(x[k, j] * scale)
    _single_pair(pairs.single_panels, single, product, room.columns, m)
    for k in range(2):
        for i in range(y.shape[1]):
            y[k, i] = sizes[k] * product[k, i]
