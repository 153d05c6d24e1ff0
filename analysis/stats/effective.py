"""How long n_stick of a window remembers: tau = T var(mean) / (2 var), so that a window holds T / (2 tau) samples.

Two estimates, each pooled over runs; the larger one is used.

- Means of 10 batches, 2 L var(L) - (L/2) var(L/2) with L the length of a batch, which takes off the error of order
  1 / L (Vats and Flegal 2022, Biometrika 109, 735). It sees motion as slow as the batches are long.
- Sokal's: the autocorrelation summed up to the first lag of five tau (`estimates.correlation_time`). It is sharper
  where one time rules, and stops short of a slow motion of small amplitude under a fast one.

Neither is too small under a slow oscillation; both are too large there, up to three times, since the mean of many
periods is better known than their power says. Both are too small where motion is slower than the batches and does not
oscillate.
"""

from __future__ import annotations

import numpy as np

from stickslip.analysis.series.cascades import Window

BATCHES = 10


def row(win: Window, tau: float) -> np.ndarray:
    """What one run adds, shape (4,), `tau` its correlation time, 0 if it has none.

    The variance in time; length times variance of the means of 10 and 20 batches; Sokal's 2 tau times the variance.
    """
    span, variance, finest = win.t_stop - win.t_start, win.time_variance(), win.means(2 * BATCHES)
    spread = []
    for count in (BATCHES, 2 * BATCHES):
        means = finest.reshape(count, -1).mean(axis=1)
        means -= means.mean()
        spread.append(span / count * (means @ means) / (count - 1))
    return np.array([variance, *spread, 2 * tau * variance])


def tau(rows: np.ndarray) -> float | None:
    """Of runs of equal length, `row` of each, shape (G, 4); None if n_stick does not change."""
    variance, tens, twenties, sokal = np.sum(rows, axis=0)
    return float(max(2 * tens - twenties, sokal) / (2 * variance)) if variance > 0 else None
