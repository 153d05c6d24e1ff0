"""A quantity over what a null model gives: the ratio with its interval, for several comparisons at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined, jackknife
from stickslip.analysis.stats.multiplicity import adjusted

MORE, LESS, AS_CHANCE, UNKNOWN = "more", "less", "as chance", "cannot be told"


@dataclass(frozen=True)
class Effect:
    """Observed over null.

    Attributes
    ----------
    ratio : Estimate
    p, p_adjusted : float or None
        That it is 1, by itself and among the comparisons that are made together (`together`).
    """

    ratio: Estimate
    p: float | None = None
    p_adjusted: float | None = None

    def verdict(self, level: float) -> str:
        """One of `MORE`, `LESS`, `AS_CHANCE` and `UNKNOWN`."""
        if self.p_adjusted is None or self.ratio.value is None:
            return UNKNOWN
        if self.p_adjusted > level:
            return AS_CHANCE
        return MORE if self.ratio.value > 1 else LESS

    @property
    def shown(self) -> float:
        """The size that the interval shows at least, |log ratio|; 0 if it contains 1 or there is none."""
        if self.ratio.low is None or self.ratio.high is None:
            return 0.0
        return float(max(np.log(self.ratio.low), -np.log(self.ratio.high), 0.0))


def over_null(of: Statistic, observed: np.ndarray, null: np.ndarray, confidence: float) -> Effect:
    """A statistic of what is observed over that of the null; jackknife-t of its logarithm over matrices.

    Parameters
    ----------
    of : callable
        Positive; raises `Undefined` with a reason.
    observed, null : ndarray, shape (G, c)
        Sums, a row a matrix; a matrix is set against its own null.
    confidence : float
    """
    columns = observed.shape[1]

    def log_ratio(sums: np.ndarray) -> np.ndarray:
        above, below = of(sums[:, :columns]), of(sums[:, columns:])
        if (above <= 0).any() or (below <= 0).any():
            raise Undefined("nothing to compare")
        return np.log(above / below)

    sums = np.hstack([observed, null])
    if len(sums) < 2:
        return Effect(Estimate(reason="fewer than two matrices"))
    try:
        value, error = jackknife(log_ratio, sums)
    except Undefined as undefined:
        return Effect(Estimate(reason=str(undefined)))
    half = student.half_width(confidence, len(sums) - 1) * error
    ratio = Estimate(float(np.exp(value)), float(np.exp(value - half)), float(np.exp(value + half)))
    return Effect(ratio, student.two_sided(value / error, len(sums) - 1) if error else float(value == 0))


def together(found: Sequence[Effect], n_primary: int = 0) -> list[Effect]:
    """The same with p-values adjusted for each other: the first in their order, the others by Holm's rule."""
    known = [k for k, one in enumerate(found) if one.p is not None]
    primary = [k for k in known if k < n_primary]
    p = [found[k].p or 0.0 for k in known]
    out = list(found)
    for k, one in zip(known, np.concatenate(adjusted(p[: len(primary)], p[len(primary) :])), strict=True):
        out[k] = replace(found[k], p_adjusted=float(one))
    return out
