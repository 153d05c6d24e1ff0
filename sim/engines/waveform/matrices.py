"""Matrices as products of macro steps take them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.panels import HEIGHT, SINGLE_HEIGHT, SUMMED, panels
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System

#: In units of `SINGLE_ERROR`, eight in the last place.
_OF_ORDER = 0.6 / 8.0


class Matrix(NamedTuple):
    """A matrix for products: in panels if it is dense, else by sparse rows."""

    panels: Floats  #: shape (panels, n, height), as the next
    single_panels: NDArray[np.float32]
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    data: Floats


def matrix_of(matrix: Any) -> Matrix:
    """The panels of a dense matrix, or of several, shape (m, n, n); the rows of a sparse one."""
    if isinstance(matrix, np.ndarray):
        no_index = np.empty(0, dtype=np.int32)
        dense, single = panels(matrix, HEIGHT, np.float64), panels(matrix, SINGLE_HEIGHT, np.float32)
        return Matrix(dense, single, no_index, no_index, np.empty(0))
    rows = matrix.tocsr()
    no_panels = np.empty((0, 0, HEIGHT)), np.empty((0, 0, SINGLE_HEIGHT), np.float32)
    indptr, indices = rows.indptr.astype(np.int32), rows.indices.astype(np.int32)
    return Matrix(*no_panels, indptr, indices, rows.data.astype(np.float64))


@once_a_system
def signed_sum(system: System) -> float:
    """The largest row sum of |K| as far as K z has its rounding in single precision, `SINGLE_ERROR` times this.

    A sum of so many terms, in order, is off by half the root of their number or so, in units in the last place of
    itself, or of what signs at random leave of it: by 0.1 to 0.4 of the root, n = 48 to 3,000.
    """
    matrix = system.stiffness
    if not isinstance(matrix, np.ndarray):
        return float(system.row_sums.max())  # it has no panels
    size = np.maximum(np.abs(matrix.sum(axis=1)), np.linalg.norm(matrix, axis=1)).max()
    return float(_OF_ORDER * np.sqrt(min(system.n, SUMMED)) * size)


NONE = matrix_of(np.empty((0, 0)))


@once_a_system  # making panels takes as long as 30 products
def matrices_of(system: System) -> tuple[Matrix, Matrix, bool]:
    """K and N of a system, as of a stack of one, and whether there is an N."""
    cross = system.cross_damping
    of_cross = NONE if cross is None else matrix_of(cross)
    return course.stack([matrix_of(system.stiffness)]), course.stack([of_cross]), cross is not None
