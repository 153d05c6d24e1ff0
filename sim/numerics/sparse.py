"""Sparse matrices that users pass, without loading SciPy's for those who pass none."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from stickslip.sim.numerics.arguments import floats

if TYPE_CHECKING:
    import scipy.sparse


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
