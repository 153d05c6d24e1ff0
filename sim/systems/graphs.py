"""Blocks tied by springs along the edges of a graph, each held by a leaf spring: K is sparse.

    (K z)_i = leaf_i z_i + kappa sum_j (z_i - z_j)        over the neighbours j of block i (dimensionless)

A chain of these is the model of Burridge and Knopoff (1967).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats

if TYPE_CHECKING:
    from scipy.sparse import csc_array

#: Pairs of neighbours among n blocks, shape (m, 2), each once, and none of a block with itself.
Pairs = NDArray[np.int64]


def _chain(n: int, _degree: float, _rng: np.random.Generator) -> Pairs:
    first = np.arange(n - 1)
    return np.column_stack((first, first + 1))


def _ring(n: int, degree: float, rng: np.random.Generator) -> Pairs:
    closing = [[0, n - 1]] if n > 2 else np.empty((0, 2), dtype=np.int64)
    return np.concatenate((_chain(n, degree, rng), closing))


def grid_width(n: int) -> int:
    """Blocks of a row of a grid of n: the least width whose square is at least n."""
    return math.isqrt(n - 1) + 1


def _grid(n: int, _degree: float, _rng: np.random.Generator) -> Pairs:
    """Rows of `grid_width` blocks, the last maybe shorter; four neighbours each."""
    width = grid_width(n)
    block = np.arange(n)
    right, below = block[(block + 1) % width != 0], block[: max(0, n - width)]
    right = right[right < n - 1]
    return np.concatenate((np.column_stack((right, right + 1)), np.column_stack((below, below + width))))


def _network(n: int, degree: float, rng: np.random.Generator) -> Pairs:
    """As many pairs as the mean degree needs, all equally likely; a network of lower degree is a part of it."""
    wanted = min(round(n * degree / 2), n * (n - 1) // 2)
    found = np.empty(0, dtype=np.int64)
    drawn = np.empty((0, 2), dtype=np.int64)
    while len(found) < wanted:
        drawn = np.concatenate((drawn, np.sort(rng.integers(n, size=(2 * wanted + 64, 2)), axis=1)))
        drawn = drawn[drawn[:, 0] < drawn[:, 1]]
        _, first = np.unique(drawn[:, 0] * n + drawn[:, 1], return_index=True)
        found = np.sort(first)
    return drawn[found[:wanted]]


class Graph(NamedTuple):
    """Along which pairs of blocks springs lie."""

    pairs: Callable[[int, float, np.random.Generator], Pairs]  #: of n, the mean number of neighbours and a generator
    has_degree: bool = False  #: whether the mean number of neighbours matters, which scenes then may say


#: All there are, by name: a line here makes one known to `draw_system`, scenes, datasets and reports.
GRAPHS: dict[str, Graph] = {
    "chain": Graph(_chain),
    "ring": Graph(_ring),
    "grid": Graph(_grid),
    "network": Graph(_network, has_degree=True),
}


def spring_matrix(n: int, pairs: Pairs, kappa: float, leaf: float | Floats) -> csc_array:
    """K of n blocks with a spring between the two of each pair, and a leaf spring for each block, shape (n, n)."""
    from scipy.sparse import csc_array  # takes a tenth of a second to load, and few systems need it

    i, j = pairs.T
    counts = np.bincount(pairs.ravel(), minlength=n)
    block = np.arange(n)
    entries = np.concatenate((np.full(2 * len(pairs), -kappa), leaf + kappa * counts))
    rows, columns = np.concatenate((i, j, block)), np.concatenate((j, i, block))
    return csc_array((entries, (rows, columns)), shape=(n, n))
