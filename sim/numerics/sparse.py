"""Matrices by columns, and sparse ones that users pass, without loading SciPy's for those who pass none."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats, floats

if TYPE_CHECKING:
    import scipy.sparse


class Columns(NamedTuple):
    """A matrix by columns as the exact engine takes it: transposed or, when this is empty, CSC."""

    dense: Floats
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    data: Floats

    @classmethod
    def of(cls, matrix: Any) -> Columns:
        """Those of a matrix, shape (n, n), dense or sparse."""
        if isinstance(matrix, np.ndarray):
            none = np.empty(0, dtype=np.int32)
            # a copy always: kernels are compiled anew for what is read-only
            return cls(np.array(matrix.T, order="C"), none, none, np.empty(0))
        indptr, indices = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        return cls(np.empty((0, 0)), indptr, indices, matrix.data.copy())


def is_sparse(matrix: object) -> bool:
    """As `scipy.sparse.issparse`, without loading that: whoever has a sparse matrix has loaded it."""
    sparse = sys.modules.get("scipy.sparse")
    return sparse is not None and bool(sparse.issparse(matrix))


def by_columns(name: str, matrix: Any) -> scipy.sparse.csc_array:
    """A copy of a sparse matrix as CSC, each entry once and real."""
    from scipy.sparse import csc_array

    csc = csc_array(_checked(name, matrix), copy=True)  # its entries are sorted in place
    csc = csc_array((floats(name, csc.data, "real entries"), csc.indices, csc.indptr), csc.shape)
    csc.sum_duplicates()
    return csc


def _checked(name: str, matrix: Any) -> Any:
    """A sparse matrix whose indices are in range, as SciPy's compiled code assumes."""
    from scipy.sparse import coo_array

    try:
        if matrix.format in ("csc", "csr", "bsr"):
            matrix.check_format(full_check=True)
            return matrix
        entries = matrix.tocoo()
        return coo_array((entries.data, entries.coords), entries.shape)  # which checks them
    except ValueError as error:
        raise ValueError(
            f"{name}: expected a sparse matrix with its indices in range, got one with {error}"
        ) from None
