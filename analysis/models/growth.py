"""Growth rate of small displacements, with its sign.

The logarithm of the distance of two runs is regressed on time over one range for all pairs, from a fixed time on. If
the range began or ended where a pair has grown, it would select upward fluctuations, and a rate near zero would come
out positive.

A pair is in its linear range while floor < distance < ceiling. Pairs that leave it before `t_from + least` have no
range to regress and are dropped. The others share the range from `t_from` to the first time at which one of them
leaves. If more than a tenth of the pairs are dropped, the remaining rates are a biased selection: `is_selected`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.estimates import Estimate, over_matrices, ratio

LEAST_POINTS = 5  # of a range, to fit a slope
MOST_DROPPED = 0.1  # share of the pairs, without `is_selected`


@dataclass(frozen=True)
class Growth:
    """Growth rate of small displacements, over matrices.

    Attributes
    ----------
    rate : Estimate
        Mean over matrices of the slope of log distance (per unit of time), with a jackknife-t interval.
    t_from, t_to : float
        The range that was regressed.
    n_pairs, n_used : int
        Number of all pairs, and of those that stay in their linear range.
    """

    rate: Estimate
    t_from: float
    t_to: float
    n_pairs: int
    n_used: int

    @property
    def is_selected(self) -> bool:
        """Whether so many pairs are dropped that the rate is that of a biased selection."""
        return self.n_pairs - self.n_used > MOST_DROPPED * self.n_pairs


def growth(
    times: np.ndarray,
    distances: Sequence[np.ndarray],
    matrix: Sequence[int],
    t_from: float,
    least: float,
    bounds: tuple[float, float],
    confidence: float,
) -> Growth:
    """Growth rate of the distance of pairs of runs whose starts differ by one small size.

    Parameters
    ----------
    times : ndarray, shape (m,)
        Common to all pairs, ascending.
    distances : sequence of ndarray, each shape (m,) or shorter
        One array a pair; a shorter one ended early and leaves the range there.
    matrix : sequence of int
        Matrix of each pair. Pairs of one matrix are averaged, as they are not independent.
    t_from, least : float
        Beginning of the range, and the shortest length that counts.
    bounds : (float, float)
        Floor, above the error of integration, and ceiling, below the distance at which pairs saturate.
    """
    t = times[times >= t_from]
    inside = np.zeros((len(distances), len(t)), dtype=bool)
    log = np.zeros(inside.shape)
    for k, distance in enumerate(distances):
        d = np.asarray(distance)[len(times) - len(t) :]
        inside[k, : len(d)] = (d > bounds[0]) & (d < bounds[1])
        log[k, : len(d)] = np.log(np.where(inside[k, : len(d)], d, 1.0))
    length = np.cumprod(inside, axis=1, dtype=np.int64).sum(axis=1)  # points up to the first outside
    needed = max(int(np.searchsorted(t, t_from + least, side="right")), LEAST_POINTS)
    is_long = length >= needed
    if not is_long.any():
        none = Estimate(reason="no pair in range")
        return Growth(none, t_from, t_from, len(is_long), 0)
    m = int(length[is_long].min())
    centred = t[:m] - t[:m].mean()
    slopes = log[is_long, :m] @ centred / (centred @ centred)
    _, index = np.unique(np.asarray(matrix)[is_long], return_inverse=True)
    rates = np.bincount(index, slopes) / np.bincount(index)
    rate = over_matrices(ratio, np.column_stack([rates, np.ones(len(rates))]), confidence)
    return Growth(rate, float(t[0]), float(t[m - 1]), len(is_long), int(is_long.sum()))
