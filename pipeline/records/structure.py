"""Statistics of the graph that couples the blocks."""

from __future__ import annotations

from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Member, Record, Sharing
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System

#: Blocks up to which all eigenvalues are computed.
_DENSE = 500
#: Distances between blocks that are computed at once.
_AT_ONCE = 4_000_000


class Structure(Record):
    """Statistics of the graph in which two blocks are neighbours if K couples them, either way."""

    name = "structure"
    words = "whether to keep statistics of the graph that couples the blocks"
    columns = (
        Column("number", "mean_degree", "mean number of the blocks that a block is coupled to", least=0.0),
        Column(
            "number",
            "clustering",
            "mean share of the pairs of a block's neighbours that are neighbours",
            title="clustering coefficient",
            least=0.0,
            most=1.0,
            note="0 for a block with fewer than two; Watts and Strogatz (1998)",
        ),
        Column(
            "number",
            "path_length",
            "mean number of springs on the shortest path between two blocks, over connected pairs",
            least=0.0,
            absent="no two blocks are coupled",
        ),
        Column("whole", "n_components", "number of connected parts", least=0.0, title="number of connected parts"),
        Column(
            "number",
            "largest_eigenvalue",
            "largest eigenvalue of K",
            title="largest eigenvalue of K",
            absent="K is not symmetric",
            dimension="stiffness",
            note="of a graph kappa times that of its Laplacian, and `leaf`",
        ),
    )
    is_shared = True
    takes_load = True
    needs = frozenset({"system"})

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 2e-7 * member.n**2 / (sharing.copies + 1) / sharing.engines / sharing.draws

    def of(self, result: Made) -> dict[str, Any]:
        return _statistics(result.system)


@once_a_system
def _statistics(system: System) -> dict[str, Any]:
    from scipy.sparse import csr_array, diags_array  # takes a tenth of a second to load
    from scipy.sparse.csgraph import connected_components, shortest_path

    matrix = csr_array(system.stiffness)
    n = matrix.shape[0]
    coupled = csr_array(matrix - diags_array(matrix.diagonal()))
    tied = csr_array(((coupled != 0) + (coupled != 0).T).astype(np.int64))
    degree = tied.sum(axis=1)
    closed, pairs = (tied @ tied).multiply(tied).sum(axis=1), degree * (degree - 1)
    at_once = max(1, _AT_ONCE // n)
    total = n_paths = 0
    for first in range(0, n, at_once):
        blocks = np.arange(first, min(n, first + at_once))
        distances = shortest_path(tied, method="D", unweighted=True, indices=blocks)
        is_path = np.isfinite(distances) & (distances > 0)
        total, n_paths = total + int(distances[is_path].sum()), n_paths + int(is_path.sum())
    statistics = {
        "mean_degree": float(degree.mean()),
        "clustering": float((closed / np.maximum(pairs, 1)).mean()),
        "n_components": int(connected_components(tied, directed=False)[0]),
    }
    if n_paths:
        statistics["path_length"] = total / n_paths
    if not (matrix != matrix.T).nnz:
        statistics["largest_eigenvalue"] = _largest(matrix)
    return statistics


def _largest(matrix: Any) -> float:
    """The largest eigenvalue of a symmetric sparse matrix."""
    n = matrix.shape[0]
    if n <= _DENSE:
        return float(np.linalg.eigvalsh(matrix.toarray())[-1])
    from scipy.sparse.linalg import eigsh  # as above

    start = np.random.default_rng(0).standard_normal(n)  # SciPy's own is another each time
    return float(eigsh(matrix, k=1, which="LA", v0=start, maxiter=100 * n, return_eigenvectors=False)[0])
