"""Blocks tied by springs along the edges of a graph, each held by a leaf spring: K is sparse.

    (K z)_i = leaf_i z_i + kappa sum_j w_ij (z_i - z_j),    K = kappa L + diag(leaf)        (dimensionless)

over the neighbours j of block i, with weights w_ij = w_ji, one unless a graph has others; L is the graph's Laplacian.
A chain of these is the model of Burridge and Knopoff (1967).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats, floats, integer
from stickslip.sim.numerics.sparse import by_columns, is_sparse

if TYPE_CHECKING:
    from scipy.sparse import csc_array

#: Pairs of neighbours among n blocks, shape (m, 2), each once, and none of a block with itself.
Pairs = NDArray[np.int64]


class Edges(NamedTuple):
    """The springs of a graph of n blocks: pairs, shape (m, 2), and their weights, shape (m,)."""

    n: int
    pairs: Pairs
    weights: Floats


def _chain(n: int, _rng: np.random.Generator) -> Pairs:
    first = np.arange(n - 1)
    return np.column_stack((first, first + 1))


def _ring(n: int, rng: np.random.Generator) -> Pairs:
    closing = [[0, n - 1]] if n > 2 else np.empty((0, 2), dtype=np.int64)
    return np.concatenate((_chain(n, rng), closing))


def grid_width(n: int) -> int:
    """Blocks of a row of a grid of n: the least width whose square is at least n."""
    return math.isqrt(n - 1) + 1


def _grid(n: int, _rng: np.random.Generator) -> Pairs:
    """Rows of `grid_width` blocks, the last maybe shorter; four neighbours each."""
    width = grid_width(n)
    block = np.arange(n)
    right, below = block[(block + 1) % width != 0], block[: max(0, n - width)]
    right = right[right < n - 1]
    return np.concatenate((np.column_stack((right, right + 1)), np.column_stack((below, below + width))))


def _network(n: int, rng: np.random.Generator, degree: float) -> Pairs:
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


def _small_world(n: int, rng: np.random.Generator, degree: float, rewiring: float) -> Pairs:
    """Watts and Strogatz, Nature 393 (1998) 440: a ring with degree / 2 neighbours on each side, rewired.

    With the probability `rewiring` the far end of a spring goes to another block, all equally likely. What is rewired
    at a probability is rewired at all that are higher.
    """
    block = np.arange(n)
    pairs = np.concatenate([np.column_stack((block, (block + far) % n)) for far in range(1, int(degree) // 2 + 1)])
    is_moved, targets = rng.random(len(pairs)) < rewiring, rng.integers(n, size=len(pairs))
    neighbours: list[set[int]] = [set() for _ in range(n)]
    for i, j in pairs.tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    for edge in np.flatnonzero(is_moved).tolist():
        i, j = pairs[edge].tolist()
        if len(neighbours[i]) >= n - 1:
            continue  # tied to all others
        target = int(targets[edge])
        while target == i or target in neighbours[i]:
            target = int(rng.integers(n))
        neighbours[i] ^= {j, target}
        neighbours[j].remove(i)
        neighbours[target].add(i)
        pairs[edge, 1] = target
    return np.sort(pairs, axis=1)


def _scale_free(n: int, rng: np.random.Generator, degree: float) -> Pairs:
    """Barabasi and Albert, Science 286 (1999) 509: each block in turn is tied to degree / 2 of those before it.

    A block is chosen in proportion to its springs. The first degree / 2 + 1 blocks are a star.
    """
    m = int(degree) // 2
    pairs = [(0, block) for block in range(1, m + 1)]
    ends = [block for pair in pairs for block in pair]
    for block in range(m + 1, n):
        chosen: set[int] = set()
        while len(chosen) < m:
            chosen.add(ends[int(rng.integers(len(ends)))])
        pairs += [(other, block) for other in sorted(chosen)]
        ends += [end for other in sorted(chosen) for end in (other, block)]
    return np.array(pairs, dtype=np.int64)


def _random_regular(n: int, rng: np.random.Generator, degree: float) -> Pairs:
    """Every block with `degree` springs: A. Steger and N. C. Wormald, Comb. Probab. Comput. 8 (1999) 377.

    Free ends are paired at random, pairs of a block with itself or of neighbours are undone, and what comes to a stop
    is begun again.
    """
    drawn: set[tuple[int, int]] = set()
    free = np.repeat(np.arange(n), int(degree))
    while len(free):
        before, left = len(drawn), []
        for i, j in np.sort(rng.permutation(free).reshape(-1, 2), axis=1).tolist():
            if i == j or (i, j) in drawn:
                left += [i, j]
            else:
                drawn.add((i, j))
        free = np.array(left, dtype=np.int64)
        if len(drawn) == before and not _may_go_on(free, drawn):
            drawn, free = set(), np.repeat(np.arange(n), int(degree))
    return np.array(sorted(drawn), dtype=np.int64).reshape(-1, 2)


def _may_go_on(free: NDArray[np.int64], drawn: set[tuple[int, int]]) -> bool:
    """Whether two blocks with free ends are not tied."""
    blocks = np.unique(free).tolist()
    return any((i, j) not in drawn for k, i in enumerate(blocks) for j in blocks[k + 1 :])


def _is_any(n: int, degree: float) -> str:
    return "" if degree <= n - 1 else f"at most n - 1 = {n - 1}, all the others"


def _is_even(n: int, degree: float) -> str:
    is_right = degree >= 2 and degree % 2 == 0 and degree <= n - 1
    return "" if is_right else f"an even number from 2 to n - 1 = {n - 1}"


def _is_regular(n: int, degree: float) -> str:
    if degree != int(degree) or degree > n - 1:
        return f"a whole number of at most n - 1 = {n - 1}"
    return "" if n * degree % 2 == 0 else f"an even number with n = {n}, as each spring has two ends"


class Graph(NamedTuple):
    """Along which pairs of blocks springs lie."""

    pairs: Callable[..., Pairs]  #: of n, a generator, and by name what it takes
    takes: tuple[str, ...] = ()  #: of "degree" and "rewiring", which scenes then may say
    expected: Callable[[int, float], str] = _is_any  #: of n and the degree: what that would have to be, "" if it is
    words: str = ""  #: the graph, for those who have the data alone


#: All there are, by name: a line here makes one known to `draw_system`, scenes, datasets and reports.
GRAPHS: dict[str, Graph] = {
    "chain": Graph(_chain, words="block i is tied to i + 1, with free ends"),
    "ring": Graph(_ring, words="block i is tied to i + 1, and the last to the first"),
    "grid": Graph(
        _grid,
        words="block i is tied to i + 1 in its row and to the one below; rows have the least width with width^2 >= n",
    ),
    "network": Graph(_network, ("degree",), words="n degree / 2 pairs, all equally likely"),
    "small_world": Graph(
        _small_world,
        ("degree", "rewiring"),
        _is_even,
        words="Watts and Strogatz: a ring of degree / 2 neighbours to each side, springs moved by chance rewiring",
    ),
    "scale_free": Graph(
        _scale_free,
        ("degree",),
        _is_even,
        words="Barabasi and Albert: a block is tied to degree / 2 of those before it, in proportion to their springs",
    ),
    "random_regular": Graph(
        _random_regular, ("degree",), _is_regular, words="each block has degree neighbours, drawn at random"
    ),
}


#: A spring that pushes apart may leave K without a least energy: whoever means it has to see K.
_WEIGHTS = "weights from 0 up, as stiffnesses are (with others pass K itself to System)"


def drawn_edges(name: str, n: int, rng: np.random.Generator, degree: float, rewiring: float) -> Edges:
    """The springs of one of `GRAPHS`.

    Raises `ValueError` if it has none of that degree or that rewiring.
    """
    graph, numbers = GRAPHS[name], {"degree": degree, "rewiring": rewiring}
    if expected := graph.expected(n, degree) if "degree" in graph.takes else "":
        raise ValueError(f"degree: expected {expected}, got {degree:g}")
    if "rewiring" in graph.takes and not 0.0 <= rewiring <= 1.0:
        raise ValueError(f"rewiring: expected a probability from 0 to 1, got {rewiring:g}")
    pairs = graph.pairs(n, rng, **{key: numbers[key] for key in graph.takes})
    return Edges(n, pairs, np.ones(len(pairs)))


def edges_of(graph: Any, n: int | None = None) -> Edges:
    """The springs of a graph: see `System.from_graph`."""
    if isinstance(graph, Edges):
        return graph
    networkx = sys.modules.get("networkx")  # whoever has a graph of networkx has loaded it
    if networkx is not None and isinstance(graph, networkx.Graph):
        if graph.is_directed():
            raise ValueError(
                "graph: expected an undirected one, as a spring pulls both its blocks, got a directed one; pass"
                " graph.to_undirected(), or for couplings that pull one way K itself to System"
            )
        number = {node: block for block, node in enumerate(graph)}
        listed = [(number[i], number[j], weight) for i, j, weight in graph.edges(data="weight", default=1.0)]
        return listed_edges(np.array(listed, dtype=np.float64).reshape(-1, 3), len(number) if n is None else n)
    if is_sparse(graph):
        return adjacent_edges(by_columns("graph", graph))
    edges = floats("graph", graph, "edges of shape (m, 2) or (m, 3), a sparse adjacency or a networkx graph")
    if edges.ndim != 2 or edges.shape[1] not in (2, 3):
        raise ValueError(
            f"graph: expected edges i, j and perhaps a weight, shape (m, 2) or (m, 3), got shape {edges.shape}; pass"
            " an adjacency matrix as scipy.sparse.csr_array(A)"
        )
    return listed_edges(edges, n)


def listed_edges(edges: Floats, n: int | None) -> Edges:
    """The springs of a list of i, j and perhaps a weight, shape (m, 2) or (m, 3); n: by default all that it names.

    Raises `ValueError` if one is none, or a pair comes twice.
    """
    ends, weights = edges[:, :2], edges[:, 2] if edges.shape[1] == 3 else np.ones(len(edges))
    whole = np.where(np.abs(ends) < 2**53, ends, -1.0).astype(np.int64)
    pairs = np.sort(whole, axis=1)
    blocks = np.unique(pairs[pairs >= 0])
    if n is None and (blocks != np.arange(len(blocks))).any():
        lone = int(np.argmax(blocks != np.arange(len(blocks))))
        raise ValueError(
            f"graph: expected each block from 0 on at a spring, got none of {lone}, and {blocks[lone]} as the next;"
            " number them without a gap, or, if that has no springs, give a graph that lists its blocks"
        )
    n = integer("n", pairs.max(initial=0) + 1 if n is None else n, 1, None)
    order = np.lexsort(pairs.T)
    again = np.zeros(len(pairs), dtype=bool)
    again[order[1:]] = (np.diff(pairs[order], axis=0) == 0).all(axis=1)
    for is_wrong, expected in (
        ((ends != whole).any(axis=1), "whole numbers of blocks"),
        ((pairs[:, 0] < 0) | (pairs[:, 1] >= n), f"blocks from 0 to n - 1 = {n - 1}"),
        (pairs[:, 0] == pairs[:, 1], "springs between two blocks, as one to itself does nothing"),
        (again, "each pair once, in one order, as else its stiffness is doubled"),
        (~((weights >= 0.0) & np.isfinite(weights)), _WEIGHTS),
    ):
        if is_wrong.any():
            edge = int(np.argmax(is_wrong))
            raise ValueError(
                f"graph: expected {expected}, got {', '.join(f'{number:g}' for number in edges[edge])} at edge {edge}"
            )
    return Edges(n, pairs, weights)


def adjacent_edges(adjacency: Any) -> Edges:
    """The springs of an adjacency matrix, dense or sparse, shape (n, n): its entries are their weights.

    Raises `ValueError` if it is not symmetric, or has a diagonal.
    """
    from scipy.sparse import coo_array, triu  # takes a tenth of a second to load, and few systems need it

    matrix = coo_array(adjacency)
    if matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise ValueError(f"graph: expected a square adjacency matrix, got shape {matrix.shape}")
    is_wrong = ~((matrix.data >= 0.0) & np.isfinite(matrix.data))
    if is_wrong.any():
        raise ValueError(f"graph: expected {_WEIGHTS}, got {matrix.data[is_wrong][0]:g}")
    if matrix.diagonal().any():
        block = int(np.flatnonzero(matrix.diagonal())[0])
        raise ValueError(
            f"graph: expected an adjacency matrix with zeros on its diagonal, got {matrix.diagonal()[block]:g} at"
            f" block {block}; pass a Laplacian, or K, to System, or set the diagonal to zero"
        )
    skew = (matrix - matrix.T).tocoo()
    if skew.data.any():
        entry = int(np.flatnonzero(skew.data)[0])
        i, j = int(skew.coords[0][entry]), int(skew.coords[1][entry])
        raise ValueError(
            f"graph: expected a symmetric adjacency, as a spring pulls both its blocks, got other weights at"
            f" ({i}, {j}) and ({j}, {i}); pass (A + A.T) / 2, or for couplings that pull one way K itself to System"
        )
    upper = triu(matrix, 1).tocoo()
    is_tied = upper.data != 0.0
    pairs = np.column_stack(upper.coords).astype(np.int64)[is_tied]
    return Edges(matrix.shape[0], pairs, upper.data[is_tied].astype(np.float64))


def spring_matrix(edges: Edges, kappa: float, leaf: float | Floats) -> csc_array:
    """K = kappa L + diag(leaf), shape (n, n)."""
    from scipy.sparse import csc_array  # as above

    n, pairs, weights = edges
    i, j = pairs.T
    total = np.bincount(pairs.ravel(), np.repeat(weights, 2), minlength=n)
    block = np.arange(n)
    pulls = -kappa * weights
    entries = np.concatenate((pulls, pulls, leaf + kappa * total))
    rows, columns = np.concatenate((i, j, block)), np.concatenate((j, i, block))
    return csc_array((entries, (rows, columns)), shape=(n, n))
