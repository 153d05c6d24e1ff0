"""Whether two methods give the same law on the same systems: gaps of distribution functions, shares, correlations.

Each system has one or more runs by each of two methods. If both methods have the same law, the runs of a system may
be swapped whole between the methods, however the values within a run depend on each other. The p-value of a
difference is the share of such swaps that give a difference as large (swapping a pair flips a sign: Fisher 1935, The
Design of Experiments, 21). A permutation of single values would treat them as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from stickslip.analysis.stats import flips, student
from stickslip.analysis.stats.enough import FEW_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, jackknife, ratio

POINTS = 200  # quantiles at which distribution functions are compared
Pairs = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Difference:
    """Difference of two laws, with its tests.

    Attributes
    ----------
    size : Estimate
        Of a gap, `low` is zero where no difference is shown.
    p_different : float
        p-value of the test of no difference.
    p_floor : float
        The least p-value of no difference that so many systems can have.
    at, below : float, optional
        For distribution functions: the value at which their gap is largest, and F' - F there.
    """

    size: Estimate
    p_different: float
    p_floor: float
    at: float | None = None
    below: float | None = None


def largest_gap(pairs: Pairs, confidence: float, rng: np.random.Generator) -> Difference:
    """Largest gap of the distribution functions of two methods, within systems: sup |sum w (F' - F) / sum w|.

    A system with m and m' values has the weight w = m m' / (m + m'), which is optimal for a difference of two means
    and does not change when the two are swapped. The lower end of the interval is the gap minus the 1 - alpha
    quantile of the largest error, from swaps of the systems' deviations from their mean. The upper end is the largest
    of the one-sided bounds of the gap at each value.

    Parameters
    ----------
    pairs : sequence of two ndarray, shape (m,) and (m',)
        Values by the first and by the second method, for each system.
    confidence : float
    rng : numpy.random.Generator
        For the swaps.

    Raises
    ------
    Undefined
        If too few systems have values by both, or all values are the same.
    """
    known = [(np.sort(a), np.sort(b)) for a, b in pairs if len(a) and len(b)]
    _check(len(known), confidence)
    pooled = np.sort(np.concatenate([x for pair in known for x in pair]))
    at = np.unique(pooled[np.arange(POINTS) * len(pooled) // POINTS])
    at = at[at < pooled[-1]]
    if not len(at):
        raise Undefined("one value")
    weights = np.array([len(a) * len(b) / (len(a) + len(b)) for a, b in known])
    gaps = np.array([_below(b, at) - _below(a, at) for a, b in known])
    n, weights = len(known), weights[:, None] / weights.sum()
    parts = weights * gaps
    seen = parts.sum(axis=0)
    off = np.sqrt(n / (n - 1)) * weights * (gaps - seen)
    signs, p_floor = flips.patterns(n, rng), flips.floor(n)
    swapped = np.abs(signs @ parts).max(axis=1)
    p_different, gap = flips.p_value(swapped, p_floor), float(swapped[0])
    error = np.sqrt((off**2).sum(axis=0))
    high = float(np.max(np.abs(seen) + student.quantile(confidence, n - 1) * error))
    low = 0.0
    if p_different < 1 - confidence:
        low = max(gap - float(np.quantile(np.abs(signs[1:] @ off).max(axis=1), confidence)), 0.0)
    k = int(np.abs(seen).argmax())
    size = Estimate(gap, low, min(high, 1.0))
    return Difference(size, p_different, p_floor, float(at[k]), float(seen[k]))


def distance_of_shares(pairs: Pairs, confidence: float, rng: np.random.Generator) -> Difference:
    """Distance between shares of categories within systems: sqrt(sum D^2 / sum p^2), D = p' - p.

    The halves of runs are used so that noise adds nothing: sum D^2 is estimated by the product of D in the first half
    and in the second, sum p^2 likewise. If the laws are the same and the halves of a run are independent, the two
    methods may be swapped in one half alone, which flips the sign of the product. A negative product counts as zero
    before its error is added, so that the interval is not too short.

    Parameters
    ----------
    pairs : sequence of two ndarray, shape (2, K)
        Counts of K categories in the first and in the second half, for each system by each method.
    confidence, rng
        As in `largest_gap`.

    Raises
    ------
    Undefined
        If too few systems have counts in each half, or all counts are in one category.
    """
    known = [(a, b) for a, b in pairs if a.sum(axis=1).all() and b.sum(axis=1).all()]
    _check(len(known), confidence)
    if len(np.flatnonzero(sum(a.sum(axis=0) + b.sum(axis=0) for a, b in known))) == 1:
        raise Undefined("one value")
    shares = np.array([[a / a.sum(axis=1, keepdims=True), b / b.sum(axis=1, keepdims=True)] for a, b in known])
    apart = np.prod(shares[:, 1] - shares[:, 0], axis=1).sum(axis=1)
    scale = np.prod(shares, axis=2).sum(axis=2).mean(axis=1)
    value, error = jackknife(ratio, np.column_stack([apart, scale]))
    value, dof = max(value, 0.0), len(known) - 1
    half = student.half_width(confidence, dof) * error
    size = Estimate(*np.sqrt(np.maximum([value, value - half, value + half], 0.0)).tolist())
    p_floor = flips.floor(len(known), 1)  # the product has a sign
    p_different = flips.p_value(flips.patterns(len(known), rng) @ apart, p_floor)
    return Difference(size, p_different, p_floor)


def difference_of_order(pairs: Pairs, confidence: float, rng: np.random.Generator) -> Difference:
    """Spearman's rank correlation of two columns by the second method minus that by the first, within systems.

    Parameters
    ----------
    pairs : sequence of two ndarray, shape (m, 2) and (m', 2)
    confidence, rng
        As in `largest_gap`.

    Raises
    ------
    Undefined
        If too few systems have a correlation by both.
    """
    known = [(a, b) for a, b in pairs if all(len(x) > 2 and np.ptp(x, axis=0).all() for x in (a, b))]
    _check(len(known), confidence)
    apart = np.array([_rank_correlation(b) - _rank_correlation(a) for a, b in known])
    n, mean = len(apart), float(apart.mean())
    error = float(apart.std(ddof=1) / np.sqrt(n))
    half = student.half_width(confidence, n - 1) * error
    p_floor = flips.floor(n)
    p_different = flips.p_value(np.abs(flips.patterns(n, rng) @ apart), p_floor)
    return Difference(Estimate(mean, mean - half, mean + half), p_different, p_floor)


def _check(n: int, confidence: float) -> None:
    """Refuse so few systems that a test by signs could show nothing."""
    if not flips.suffice(n, confidence):
        raise Undefined(FEW_MATRICES)


def _below(ordered: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Empirical distribution function of ordered values."""
    return np.searchsorted(ordered, at, side="right") / len(ordered)


def _rank_correlation(columns: np.ndarray) -> float:
    return float(np.corrcoef(pd.DataFrame(columns).rank(), rowvar=False)[0, 1])
