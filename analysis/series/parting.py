"""When a changed run has parted from its base.

The gap of two runs is |difference of n_stick|, averaged over the last `SPAN` units of time. A run has parted when the
gap first reaches `SHARE` of the level, the mean |difference of n_stick| of two different matrices. The level belongs
to a steady state: where runs settle, it vanishes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stickslip.analysis.series.cascades import sample
from stickslip.analysis.series.windows import ChangePoints

SPAN = 20.0
SHARE = 0.5
STEP = 1.0  # between the times at which gaps are known


def mean_difference(first: ChangePoints, second: ChangePoints, edges: np.ndarray) -> np.ndarray:
    """Exact mean of |n_stick difference| over each window [edges[k], edges[k+1]).

    Parameters
    ----------
    first, second : ChangePoints
        Known from edges[0] on.
    edges : ndarray, shape (k + 1,)
        Ascending.

    Returns
    -------
    ndarray, shape (k,)
    """
    t = np.unique(np.concatenate([edges, first[0], second[0]]))
    t = t[(t >= edges[0]) & (t <= edges[-1])]
    gap = np.abs(sample(*first, t[:-1]).astype(np.int64) - sample(*second, t[:-1]))
    area = np.concatenate(([0.0], np.cumsum(gap * np.diff(t))))
    return np.diff(area[np.searchsorted(t, edges)]) / np.diff(edges)


def gap(first: ChangePoints, second: ChangePoints, t_stop: float) -> np.ndarray:
    """The gap at `SPAN`, `SPAN` + `STEP`, ... up to t_stop (`gap_times`); empty if t_stop is less than `SPAN`."""
    edges = STEP * np.arange(int(t_stop / STEP) + 1)
    width = round(SPAN / STEP)
    if len(edges) <= width:
        return np.zeros(0)
    sums = np.concatenate(([0.0], np.cumsum(mean_difference(first, second, edges))))
    return (sums[width:] - sums[:-width]) / width


def gap_times(gaps: np.ndarray) -> np.ndarray:
    """Times of the values of `gap`, shape (len(gaps),)."""
    return SPAN + STEP * np.arange(len(gaps))


def parted_at(gaps: np.ndarray, level: float) -> float | None:
    """When a run parted; None if it has not by the end of its gaps."""
    over = np.flatnonzero(gaps >= SHARE * level)
    return float(gap_times(gaps)[over[0]]) if len(over) else None


def level(bases: Sequence[ChangePoints], until: Sequence[float], t_from: float, t_stop: float) -> float:
    """Mean |n_stick difference| over [t_from, t_stop] and over all pairs of runs of different matrices.

    At each time the pairs are those of runs still known then; times without a pair are left out. 0 if there are none.

    Parameters
    ----------
    bases : sequence of ChangePoints
    until : sequence of float
        Until when each run is known.
    """
    times = np.arange(t_from + 0.5 * STEP, t_stop, STEP)
    values = np.sort(
        [np.where(times < t, sample(*base, times), np.inf) for base, t in zip(bases, until, strict=True)],
        axis=0,
    )
    g = np.isfinite(values).sum(axis=0)
    has_pairs = g > 1
    values, g = values[:, has_pairs], g[has_pairs]
    # of sorted values x_(i): sum over pairs of differences = sum_i (2 i - g + 1) x_(i)
    weights = 2 * np.arange(len(values))[:, None] - g + 1
    sums = np.sum(weights * np.where(np.isfinite(values), values, 0.0), axis=0)
    return float(np.mean(sums / (g * (g - 1) / 2))) if len(g) else 0.0
