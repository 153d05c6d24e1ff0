"""How well a law, as a rule the exponential, fits the sizes of cascades: the largest gap, and size by size.

Everything here works on histograms, one row a matrix, [g, k] cascades of size k: the matrices are the independent
units, the cascades within one are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.families import EXPONENTIAL, Family, Fit, derivatives, maximise

FLIPS = 9999  # random signs: an error of 0.2 points on a p-value of 0.05
#: A size is judged if so many cascades are expected above it. Nothing in the data says where to cut the tail, so the
#: test is made at each of these; p_value is that of the second.
CUTS = (200, 60, 20)
FEWEST_SHOWN = 10  # cascades expected of a size for it to be drawn
REJECTED, NOT_REJECTED, UNDECIDED, UNKNOWN = "rejected", "not rejected", "undecided", "cannot be told"


def effective(counts: np.ndarray, values: np.ndarray, fit: Fit) -> np.ndarray:
    """What each matrix adds to sum (f(k) - E f) over its cascades, freed of what estimating the law adds.

    f is projected off the law's own scores (the exponential's: k - E k) under the fit: the sum over matrices is
    unchanged, since the fit makes the sums of scores zero, and the rows are independent to first order.

    Parameters
    ----------
    counts : ndarray, shape (G, K)
    values : ndarray, shape (K, b)
        b functions f of the size.
    fit : Fit

    Returns
    -------
    ndarray, shape (G, b)
    """
    shares = np.exp(fit.log_shares())
    centred = values - shares @ values
    scores, _ = derivatives(fit.family, fit.sizes, fit.theta, fit.free)
    weighted = shares * scores.T
    return counts @ (centred - scores @ np.linalg.solve(weighted @ scores, weighted @ centred))


def sign_flips(n_matrices: int, rng: np.random.Generator) -> np.ndarray:
    """Random signs, the observed ones first, shape (FLIPS + 1, G)."""
    signs = rng.choice([-1.0, 1.0], (FLIPS + 1, n_matrices))
    signs[0] = 1.0
    return signs


@dataclass(frozen=True)
class Goodness:
    """How far the sizes lie from the fitted law, and whether that is more than the spread of matrices gives.

    Attributes
    ----------
    gap : float or None
        Largest difference of observed and fitted P(size <= k) over the sizes judged.
    at : int or None
        The size where it is.
    bound : float or None
        No gap above this is left open, at the stated confidence, over all sizes judged together.
    p_value, p_least, p_most : float or None
        At the usual cut of the tail, and the least and the most over `CUTS`.
    reason : str
        Why there is no p-value; then null.
    """

    gap: float | None = None
    at: int | None = None
    bound: float | None = None
    p_value: float | None = None
    p_least: float | None = None
    p_most: float | None = None
    reason: str = ""

    def verdict(self, level: float) -> str:
        """`REJECTED` or `NOT_REJECTED` if that holds wherever the tail is cut, `UNDECIDED` if it does not."""
        if self.p_least is None or self.p_most is None:
            return UNKNOWN
        if self.p_most <= level:
            return REJECTED
        return NOT_REJECTED if self.p_least > level else UNDECIDED


def goodness(
    sizes: np.ndarray,
    counts: np.ndarray,
    confidence: float,
    rng: np.random.Generator,
    family: Family = EXPONENTIAL,
) -> Goodness:
    """Kolmogorov-Smirnov test of a law, its null distribution from the matrices themselves.

    The statistic is the largest gap of observed and fitted distribution function, each in units of its own standard
    error over matrices. Its null distribution comes from turning the sign of each matrix's part of the gaps at
    random: if the law holds, these parts scatter about zero, however the cascades within a matrix depend on each
    other and however much matrices differ in spread (sign-flipped effective scores: Hemerik, Goeman and Finos 2020,
    J. R. Stat. Soc. B 82, 841). A bootstrap of single cascades would take them as independent.

    Parameters
    ----------
    sizes : ndarray, shape (K,)
    counts : ndarray, shape (G, K)
        As `families.truncate` gives them; matrices without a cascade are left out.
    confidence : float
    rng : numpy.random.Generator
        For the signs.
    family : Family
    """
    seen = counts[counts.sum(axis=1) > 0]
    n, total = len(seen), seen.sum()
    try:
        fit = maximise(family, sizes, seen.sum(axis=0))
    except Undefined as undefined:
        return Goodness(reason=str(undefined))
    above = total * (1.0 - np.cumsum(np.exp(fit.log_shares())))
    judged = np.flatnonzero(above >= CUTS[-1])
    if len(judged) < 2:
        return Goodness(reason="few cascades")
    below = (sizes[:, None] <= sizes[judged]).astype(np.float64)
    parts = effective(seen, below, fit) / total
    gaps = parts.sum(axis=0)
    worst = int(np.abs(gaps).argmax())
    found = Goodness(float(abs(gaps[worst])), int(sizes[judged[worst]]))
    # All n parts have one sign, up to a common one, in 2 of 2^n patterns: the least p-value there can be.
    if n < 1 + int(np.ceil(-np.log2(1.0 - confidence))):
        return replace(found, reason="few matrices")
    signs = sign_flips(n, rng)
    counted = [max(2, int(np.count_nonzero(above >= cut))) for cut in CUTS]
    flipped = _studentised(signs, parts)
    p_values = [_share_as_large(flipped[:, :columns].max(axis=1)) for columns in counted]
    scatter = np.sqrt(n / (n - 1)) * (parts - parts.mean(axis=0))  # what the gaps would do about their own values
    reach = np.quantile(_studentised(signs[1:], scatter)[:, : counted[1]].max(axis=1), confidence)
    bound = float((np.abs(gaps) + reach * np.sqrt((scatter**2).sum(axis=0)))[: counted[1]].max())
    return replace(found, bound=bound, p_value=p_values[1], p_least=min(p_values), p_most=max(p_values))


def _studentised(signs: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """|signed sum of parts| in units of its standard error, for each row of signs and each size."""
    return np.abs(signs @ parts / np.sqrt((parts**2).sum(axis=0)))


def _share_as_large(statistic: np.ndarray) -> float:
    """Share of the entries at least as large as the first, the observed one."""
    return float(np.mean(statistic >= statistic[0] * (1 - 1e-12)))


@dataclass(frozen=True)
class Quotient:
    """Observed share over fitted share of one size, with its interval over matrices."""

    size: int
    n_cascades: int
    share: float
    fit: float
    value: float
    low: float | None
    high: float | None


def quotients(sizes: np.ndarray, counts: np.ndarray, confidence: float) -> list[Quotient]:
    """Observed over fitted share for each size of which at least `FEWEST_SHOWN` cascades are expected.

    The intervals count what estimating gamma takes from the scatter.

    Raises
    ------
    Undefined
        If there is no fit.
    """
    seen = counts[counts.sum(axis=1) > 0]
    n, total = len(seen), seen.sum()
    fit = maximise(EXPONENTIAL, sizes, seen.sum(axis=0))
    shares = np.exp(fit.log_shares())
    judged = np.flatnonzero(total * shares >= FEWEST_SHOWN)
    parts = effective(seen, (sizes[:, None] == sizes[judged]).astype(np.float64), fit)
    parts /= total * shares[judged]
    values = 1.0 + parts.sum(axis=0)
    half = None if n < 2 else student.half_width(confidence, n - 1) * np.sqrt(n) * parts.std(axis=0, ddof=1)
    pooled = seen.sum(axis=0)
    found = []
    for i, k in enumerate(judged):
        ends = (None, None) if half is None else (float(values[i] - half[i]), float(values[i] + half[i]))
        share, fitted = float(pooled[k] / total), float(shares[k])
        found.append(Quotient(int(sizes[k]), int(pooled[k]), share, fitted, float(values[i]), *ends))
    return found
