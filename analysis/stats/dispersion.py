"""The dispersion of cascade sizes: a one-parameter test of whether their law is exponential.

P(k) = (1 - q) q^(k-1) has mean m = 1 / (1 - q) and variance m (m - 1). So

    excess = variance / (m (m - 1)) - 1

is zero for the exponential, negative for a thinner tail and positive for a thicker one. Rates that differ between
matrices or in time mix exponentials and make it positive; a finite pool of blocks makes it negative.
"""

from __future__ import annotations

import numpy as np

from stickslip.analysis.stats.estimates import Undefined


def moments(counts: np.ndarray) -> np.ndarray:
    """Number of cascades, sum of their sizes and sum of squares, shape (..., 3), of histograms of shape (..., K).

    counts[..., k] is the number of cascades of size k + 1. An exponential counted from a least size on is the same
    exponential, so smaller sizes may simply be cut off.
    """
    sizes = np.arange(1.0, counts.shape[-1] + 1)
    return np.asarray(counts, dtype=np.float64) @ np.column_stack([sizes**0, sizes, sizes**2])


def excess(sums: np.ndarray) -> np.ndarray:
    """Variance over m (m - 1), minus one, from summed `moments`.

    Parameters
    ----------
    sums : ndarray, shape (m, 3)

    Raises
    ------
    Undefined
        If there are fewer than two cascades, or all sizes are 1.
    """
    count, total, squares = sums.T
    if (count < 2).any():
        raise Undefined("fewer than two cascades")
    if (total <= count).any():
        raise Undefined("one size only")
    mean = total / count
    # The factor (N + 1) / (N - 1) makes the expectation exactly zero for N independent geometric sizes.
    unbiased = (squares / count - mean**2) * (count + 1) / (count - 1)
    return unbiased / (mean * (mean - 1)) - 1
