"""Ratio of a quantity to its value under a null model, with its interval, for several comparisons at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined
from stickslip.analysis.stats.multiplicity import holm


@dataclass(frozen=True)
class Effect:
    """Ratio of the observed value to that of the null.

    `p` is the p-value of a ratio of 1, alone, and `p_adjusted` that for the comparisons made together (`together`).
    """

    ratio: Estimate
    p: float | None = None
    p_adjusted: float | None = None


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


def together(effects: Sequence[Effect]) -> list[Effect]:
    """The effects with p-values adjusted by Holm's rule."""
    p_values = {k: effect.p for k, effect in enumerate(effects) if effect.p is not None}
    adjusted = dict(zip(p_values, holm([*p_values.values()]).tolist(), strict=True))
    return [replace(effect, p_adjusted=adjusted.get(k)) for k, effect in enumerate(effects)]
