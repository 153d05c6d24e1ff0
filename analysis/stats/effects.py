"""Ratio of a quantity to its value under a null model, with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined


@dataclass(frozen=True)
class Effect:
    """Ratio of the observed value to that of the null, and the p-value of a ratio of 1."""

    ratio: Estimate
    p: float | None = None


def over_null(of: Statistic, observed: np.ndarray, null: np.ndarray, confidence: float) -> Effect:
    """Ratio of a statistic to that of the null, by the jackknife-t of its logarithm over matrices.

    Parameters
    ----------
    of : callable
        Positive; raises `Undefined` with a reason.
    observed, null : ndarray, shape (G, c)
        Sums, one row a matrix; a matrix is compared with its own null.
    """
    columns = observed.shape[1]

    def log_ratio(sums: np.ndarray) -> np.ndarray:
        above, below = of(sums[:, :columns]), of(sums[:, columns:])
        if (above <= 0).any() or (below <= 0).any():
            raise Undefined("nothing to compare")
        return np.log(above / below)

    try:
        test = against(log_ratio, np.hstack([observed, null]))
    except Undefined as undefined:
        return Effect(Estimate(reason=str(undefined)))
    value, low, high = (float(np.exp(x)) for x in (test.difference, *test.interval(confidence)))
    return Effect(Estimate(value, low, high), test.p_different)
