"""Whether two methods give the same law on the same systems: the largest gap of their distribution functions.

Each system has one or more runs by each of two methods. If both methods have the same law, the runs of a system may
be swapped whole between the methods, however the values within a run depend on each other. The p-value of a
difference is the share of such swaps that give a difference as large (swapping a pair flips a sign: Fisher 1935, The
Design of Experiments, 21). A permutation of single values would treat them as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats import flips, student
from stickslip.analysis.stats.enough import FEW_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined

MOST_JUMPS = 100_000  # of more jumps so many quantiles, which miss 1e-5 of the gap at most
POINTS = 200  # quantiles at which a gap is tested: each pattern of swaps takes all of them
Pairs = Sequence[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Difference:
    """Difference of two laws, with its tests.

    Attributes
    ----------
    size : Estimate
        Of the gap; `low` is zero where no difference is shown.
    p_different : float
        p-value of the test of no difference.
    p_floor : float
        The least p-value of no difference that so many systems can have.
    """

    size: Estimate
    p_different: float
    p_floor: float


def largest_gap(pairs: Pairs, confidence: float, rng: np.random.Generator) -> Difference:
    """Largest gap of the distribution functions of two methods, within systems: sup |sum w (F' - F) / sum w|.

    A system with m and m' values has the weight w = m m' / (m + m'), which is optimal for a difference of two means
    and does not change when the two are swapped. The gap is the largest at any jump; it is tested at `POINTS`
    quantiles. The lower end of the interval is the largest gap there minus the 1 - alpha / 2 quantile of the largest
    error, from swaps of the systems' deviations from their mean. The upper end is the largest of those of the gap at
    each jump.

    Parameters
    ----------
    pairs : sequence of two ndarray, shape (m,) and (m',)
        Values by the first and by the second method, for each system.
    rng : numpy.random.Generator
        For the swaps.

    Raises
    ------
    Undefined
        If too few systems have values by both, or all values are the same.
    """
    sorted_pairs = [(np.sort(a), np.sort(b)) for a, b in pairs if len(a) and len(b)]
    if not sorted_pairs:
        raise Undefined(FEW_MATRICES)
    pooled = np.sort(np.concatenate([x for pair in sorted_pairs for x in pair]))
    n_jumps = min(len(pooled), MOST_JUMPS)
    points, jumps = (np.unique(pooled[np.arange(m) * len(pooled) // m]) for m in (POINTS, n_jumps))
    edges = np.append(points, jumps)
    edges = edges[edges < pooled[-1]]
    if not len(edges):
        raise Undefined("one value")
    weights = np.array([len(a) * len(b) / (len(a) + len(b)) for a, b in sorted_pairs])
    gaps = np.array([_below(b, edges) - _below(a, edges) for a, b in sorted_pairs])
    weights /= weights.sum()
    return distance(weights[:, None] * gaps, weights, confidence, rng, len(points))


def distance(
    shares: np.ndarray, weights: np.ndarray, confidence: float, rng: np.random.Generator, n_tested: int | None = None
) -> Difference:
    """Largest of some differences of distribution functions, each a sum over systems; the interval of `largest_gap`.

    Parameters
    ----------
    shares : ndarray, shape (G, K)
        What each system adds to each difference; of either sign with equal chance where there is none.
    weights : ndarray, shape (G,)
        The part of each system in a difference that all systems have; they add to 1.
    n_tested : int, optional
        How many of the differences, from the first on, are tested; default: all.

    Raises
    ------
    Undefined
        If there are too few systems.
    """
    n, observed = len(weights), shares.sum(axis=0)
    if not flips.suffice(n, confidence):
        raise Undefined(FEW_MATRICES)
    off = np.sqrt(n / (n - 1)) * (shares - weights[:, None] * observed)
    signs, p_floor = flips.patterns(n, rng), flips.floor(n)
    swapped = np.abs(signs @ shares[:, :n_tested]).max(axis=1)
    p_different, gap = flips.p_value(swapped, p_floor), float(np.abs(observed).max())
    error = np.sqrt((off**2).sum(axis=0))
    high = float(np.max(np.abs(observed) + student.half_width(confidence, n - 1) * error))
    low = 0.0
    if p_different < 1 - confidence:
        errors = np.abs(signs[1:] @ off[:, :n_tested]).max(axis=1)
        low = max(float(swapped[0] - np.quantile(errors, (1 + confidence) / 2)), 0.0)
    return Difference(Estimate(gap, low, min(high, 1.0)), p_different, p_floor)


def _below(ordered: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Empirical distribution function of ordered values."""
    return np.searchsorted(ordered, at, side="right") / len(ordered)
