"""Goodness of fit of a law of sizes, usually the exponential: the largest gap.

Everything here takes histograms, one row a matrix, [g, k] cascades of size k. The matrices are the independent units;
the cascades of one matrix are not independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats import flips
from stickslip.analysis.stats.compare import UNKNOWN
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.families import EXPONENTIAL, Family, Fit, maximise

#: A size is judged if so many cascades are expected above it. The data do not say where to cut the tail, so the test
#: is repeated at each of these; p_value is that of the second.
CUTS = (200, 60, 20)
REJECTED, NOT_REJECTED, UNDECIDED = "rejected", "not rejected", "undecided"


def effective(counts: np.ndarray, values: np.ndarray, fit: Fit) -> np.ndarray:
    """Contribution of each matrix to sum (f(k) - E f) over all cascades, without the effect of estimating the law.

    f is made orthogonal to the law's scores (the exponential's: k - E k) under the fit. The sum over matrices does
    not change, since the fit makes the sums of the scores zero, and rows become independent to first order.

    Parameters
    ----------
    counts : ndarray, shape (G, K)
    values : ndarray, shape (K, b)
        b functions f of the size.

    Returns
    -------
    ndarray, shape (G, b)
    """
    shares, scores = fit.shares(), fit.scores()
    centred = values - shares @ values
    return counts @ (centred - scores @ np.linalg.solve(fit.information(), (shares * scores.T) @ centred))


@dataclass(frozen=True)
class Goodness:
    """How far the sizes lie from the fitted law, and whether by more than the spread over matrices explains.

    Attributes
    ----------
    gap : float or None
        Largest difference of observed and fitted P(size <= k) over the sizes judged.
    at : int or None
        The size where it is.
    p_values : tuple of float
        p-values with the tail cut at each of `CUTS`; empty if there are none.
    p_floor : float or None
        The least p-value that so many matrices can have.
    reason : str
        Why something is missing.
    """

    gap: float | None = None
    at: int | None = None
    p_values: tuple[float, ...] = ()
    p_floor: float | None = None
    reason: str = ""

    @property
    def p_value(self) -> float | None:
        """The p-value at the usual cut of the tail."""
        return self.p_values[1] if self.p_values else None

    def verdict(self, level: float) -> str:
        """`REJECTED` or `NOT_REJECTED` if that holds at every cut of the tail, else `UNDECIDED`; or `UNKNOWN`."""
        if not self.p_values:
            return UNKNOWN
        if max(self.p_values) <= level:
            return REJECTED
        return NOT_REJECTED if min(self.p_values) > level else UNDECIDED


def goodness(
    sizes: np.ndarray,
    counts: np.ndarray,
    confidence: float,
    rng: np.random.Generator,
    family: Family = EXPONENTIAL,
) -> Goodness:
    """Kolmogorov-Smirnov test of a law, with a null distribution from the matrices themselves.

    The statistic is the largest gap between observed and fitted distribution function, with the gap at each size in
    units of its standard error over matrices. Its null distribution comes from flipping the sign of each matrix's
    contribution to the gaps at random: if the law holds, these contributions scatter about zero, however the cascades
    of a matrix depend on each other and however much matrices differ in spread (sign-flipped effective scores:
    Hemerik, Goeman and Finos 2020, J. R. Stat. Soc. B 82, 841). A bootstrap would treat cascades as independent.

    Parameters
    ----------
    sizes : ndarray, shape (K,)
    counts : ndarray, shape (G, K)
        Results of `families.truncate`; matrices without a cascade are left out.
    rng : numpy.random.Generator
        For the signs.
    """
    histograms = counts[counts.sum(axis=1) > 0]
    n, total = len(histograms), histograms.sum()
    try:
        fit = maximise(family, sizes, histograms.sum(axis=0))
    except Undefined as undefined:
        return Goodness(reason=str(undefined))
    above = total * (1.0 - np.cumsum(fit.shares()))
    judged = np.flatnonzero(above >= CUTS[-1])
    if len(judged) < 2:
        return Goodness(reason="few cascades")
    below = (sizes[:, None] <= sizes[judged]).astype(np.float64)
    contributions = effective(histograms, below, fit) / total
    gaps = contributions.sum(axis=0)
    worst = int(np.abs(gaps).argmax())
    gap, size = float(abs(gaps[worst])), int(sizes[judged[worst]])
    if not flips.suffice(n, confidence):
        return Goodness(gap, size, reason="few matrices")
    flipped = np.abs(flips.patterns(n, rng) @ contributions / np.sqrt((contributions**2).sum(axis=0)))
    p_floor = flips.floor(n)
    p_values = []
    for cut in CUTS:
        largest = flipped[:, : max(2, np.count_nonzero(above >= cut))].max(axis=1)
        p_values.append(flips.p_value(largest, p_floor))
    return Goodness(gap, size, tuple(p_values), p_floor)
