"""Correlation time of n_stick, tau = T var(mean) / (2 var): a window of length T holds T / (2 tau) effective samples.

There are two estimates, each pooled over runs; the larger one is used.

- Means of 10 batches: 2 L var(L) - (L/2) var(L/2), with L the length of a batch, in which the error of order 1 / L
  cancels (Vats and Flegal 2022, Biometrika 109, 735). It sees motion as slow as a batch is long.
- Sokal's: the autocorrelation summed up to the first lag of five tau (`estimates.correlation_time`). It is sharper
  where one time scale dominates, and misses a slow motion of small amplitude under a fast one.

Under a slow oscillation neither is too small. Both are too large, by up to a factor of three, since the mean of many
periods is known better than their power suggests. Both are too small where motion is slower than the batches and does
not oscillate.
"""

from __future__ import annotations

import numpy as np

from stickslip.analysis.series.cascades import Window

BATCHES = 10


def row(win: Window, tau: float) -> np.ndarray:
    """The sums of one run, shape (4,), from its window and its correlation time `tau` (0 if it has none).

    They are the variance in time; length times variance of the means of 10 and of 20 batches; and Sokal's 2 tau times
    the variance.
    """
    span, variance, finest = win.t_stop - win.t_start, win.time_variance(), win.means(2 * BATCHES)
    spread = []
    for count in (BATCHES, 2 * BATCHES):
        means = finest.reshape(count, -1).mean(axis=1)
        means -= means.mean()
        spread.append(span / count * (means @ means) / (count - 1))
    return np.array([variance, *spread, 2 * tau * variance])


def tau(rows: np.ndarray) -> float | None:
    """Correlation time from the rows of runs of equal length, shape (G, 4); None if n_stick does not change."""
    variance, tens, twenties, sokal = np.sum(rows, axis=0)
    return float(max(2 * tens - twenties, sokal) / (2 * variance)) if variance > 0 else None
