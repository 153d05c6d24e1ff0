"""What no spring holds: displacements that change no force."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.systems.system import System

#: Of K dz, over that of its terms: below, z has only moved along the null space of K. Up to so many blocks all
#: of that is found.
NULL, _DENSE = 1e-12, 500


def across(system: System, z: Floats) -> Floats:
    """z without what no spring holds, shape (..., n)."""
    free = null_space(system)
    return np.asarray(z - z @ free @ free.T)


@lru_cache(maxsize=2)
def null_space(system: System) -> Any:
    """Displacements at which no spring pulls, as orthonormal columns, shape (n, k), an array or a sparse one.

    Of more than `_DENSE` blocks: of those that springs connect, if they are moved by as much.
    """
    k, sums = system.stiffness, system.row_sums
    if system.n > _DENSE:
        n_parts, part = connected_components(csr_array(k) != 0, directed=False)
        sizes = np.bincount(part, minlength=n_parts)
        shifts = csr_array((sizes[part] ** -0.5, (np.arange(system.n), part)))
        is_held = np.bincount(part, np.abs(k @ np.ones(system.n)) > NULL * sums, minlength=n_parts) > 0
        return shifts[:, np.flatnonzero(~is_held)]
    dense = k if isinstance(k, np.ndarray) else k.toarray()
    _, sizes, directions = np.linalg.svd(dense / np.where(sums > 0.0, sums, 1.0)[:, np.newaxis])
    return np.asarray(directions[sizes <= NULL].T)
