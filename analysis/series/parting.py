"""When a changed run has parted from its base.

The gap of two runs is |difference of n_stick|, averaged over the last `SPAN` units of time. A run has parted when the
gap first reaches `SHARE` of the level, the mean |difference of n_stick| of two different matrices. The level belongs
to a steady state: where runs settle, it vanishes.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stickslip.analysis.series.cascades import sample
from stickslip.analysis.series.windows import ChangePoints

SPAN = 20.0
SHARE = 0.5
STEP = 1.0  # between the times at which gaps are known
_WIDTH = round(SPAN / STEP)


def mean_gap(first: ChangePoints, second: ChangePoints, edges: np.ndarray) -> np.ndarray:
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
    """The gap at `SPAN`, `SPAN` + `STEP`, ... up to t_stop; empty if t_stop is less than `SPAN`."""
    n_steps = int(t_stop / STEP)
    if n_steps < _WIDTH:
        return np.zeros(0)
    sums = np.concatenate(([0.0], np.cumsum(mean_gap(first, second, STEP * np.arange(n_steps + 1)))))
    return (sums[_WIDTH:] - sums[:-_WIDTH]) / _WIDTH


def parted_at(gaps: np.ndarray, level: float) -> float | None:
    """When a run parted; None if it has not by the end of its gaps."""
    over = np.flatnonzero(gaps >= SHARE * level)
    return SPAN + STEP * float(over[0]) if len(over) else None


def counts(bases: Iterable[ChangePoints], until: Iterable[float], n: int, t_from: float, t_stop: float) -> np.ndarray:
    """Numbers of runs of n blocks with each n_stick, at the middle of each `STEP` of [t_from, t_stop].

    Parameters
    ----------
    until : iterable of float
        Until when each run is known, and counted.

    Returns
    -------
    ndarray of int, shape (m, n + 1)
    """
    times = np.arange(t_from + 0.5 * STEP, t_stop, STEP)
    totals = np.zeros((len(times), n + 1), dtype=np.int64)
    for base, t in zip(bases, until, strict=True):
        places = np.flatnonzero(times < t)
        totals[places, sample(*base, times[places])] += 1
    return totals


def level(runs: np.ndarray) -> float:
    """Mean |n_stick difference| over time and over all pairs of runs of different matrices, from their `counts`.

    At each time the pairs are those of runs still known then; times without a pair are left out. 0 if there are none.
    """
    g = runs.sum(axis=1)
    runs, g = runs[g > 1], g[g > 1]
    below = np.cumsum(runs[:, :-1], axis=1)  # each pair differs by the number of levels that part it
    return float(np.mean(np.sum(below * (g[:, None] - below), axis=1) / (g * (g - 1) / 2))) if len(g) else 0.0
