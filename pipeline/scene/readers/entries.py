"""Sparse matrices from their entries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def of_entries(
    row: np.ndarray,
    column: np.ndarray,
    values: np.ndarray,
    n: int,
    sign: int | None,
    where: Callable[[int], str],
) -> Any:
    """A sparse matrix from its entries, whose rows and columns count from one; `where` says where an entry stands."""
    from scipy import sparse  # takes a tenth of a second to load

    outside = (np.minimum(row, column) < 1) | (np.maximum(row, column) > n)
    if outside.any():
        k = int(np.argmax(outside))
        raise ValueError(f"expected rows and columns from 1 to {n}, got ({row[k]}, {column[k]}) at {where(k)}")
    row, column = row - 1, column - 1
    if sign is not None:
        across = row != column
        if sign == -1 and not across.all():
            k = int(np.argmin(across))
            raise ValueError(f"expected no entry on the diagonal of a skew-symmetric matrix, got one at {where(k)}")
        mirrored = np.isin(row * n + column, column[across] * n + row[across])
        if mirrored.any():
            k = int(np.flatnonzero(mirrored)[-1])
            raise ValueError(
                f"expected one triangle of a symmetric matrix, got ({row[k] + 1}, {column[k] + 1}) at {where(k)} and"
                f" ({column[k] + 1}, {row[k] + 1}) too; leave out one triangle, or write general in its first line"
            )
        row, column = np.concatenate([row, column[across]]), np.concatenate([column, row[across]])
        values = np.concatenate([values, sign * values[across]])
    return sparse.coo_array((values, (row, column)), (n, n))
