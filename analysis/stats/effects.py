"""Ratio of a quantity to its value under a null model, with its interval, for several comparisons at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined
from stickslip.analysis.stats.multiplicity import adjusted


@dataclass(frozen=True)
class Effect:
    """Ratio of the observed value to that of the null.

    Attributes
    ----------
    ratio : Estimate
    p, p_adjusted : float or None
        p-value of a ratio of 1, alone and adjusted for the comparisons made together (`together`).
    p_equivalent, p_equivalent_adjusted : float or None
        p-value of a ratio beyond the margin, alone and adjusted.
    margin : float
        Margin of the logarithm of the ratio.
    """

    ratio: Estimate
    p: float | None = None
    p_equivalent: float | None = None
    p_adjusted: float | None = None
    p_equivalent_adjusted: float | None = None
    margin: float = 0.0


def over_null(
    of: Statistic, observed: np.ndarray, null: np.ndarray, confidence: float, margin: float = 0.0
) -> Effect:
    """Ratio of a statistic to that of the null, by the jackknife-t of its logarithm over matrices.

    Parameters
    ----------
    of : callable
        Positive; raises `Undefined` with a reason.
    observed, null : ndarray, shape (G, c)
        Sums, one row a matrix; a matrix is compared with its own null.
    confidence : float
    margin : float
        Relative difference from the null that still counts as equal; 0 if none is declared.
    """
    columns = observed.shape[1]

    def log_ratio(sums: np.ndarray) -> np.ndarray:
        above, below = of(sums[:, :columns]), of(sums[:, columns:])
        if (above <= 0).any() or (below <= 0).any():
            raise Undefined("nothing to compare")
        return np.log(above / below)

    try:
        test = against(log_ratio, np.hstack([observed, null]), float(np.log1p(margin)))
    except Undefined as undefined:
        return Effect(Estimate(reason=str(undefined)))
    value, low, high = (float(np.exp(x)) for x in (test.difference, *test.interval(confidence)))
    return Effect(Estimate(value, low, high), test.p_different, test.p_equivalent, margin=test.margin)


def together(effects: Sequence[Effect], n_primary: int = 0) -> list[Effect]:
    """The effects with adjusted p-values: the first `n_primary` as tested in order, the others by Holm's rule."""
    known = [k for k, one in enumerate(effects) if one.p is not None]
    n_first = sum(k < n_primary for k in known)
    each = ([effects[k].p or 0.0 for k in known], [effects[k].p_equivalent or 0.0 for k in known])
    both = (np.concatenate(adjusted(p[:n_first], p[n_first:])) for p in each)
    out = list(effects)
    for k, p, p_equivalent in zip(known, *both, strict=True):
        out[k] = replace(out[k], p_adjusted=float(p), p_equivalent_adjusted=float(p_equivalent))
    return out
