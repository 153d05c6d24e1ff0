"""How many independent samples a window of n_stick is worth: span / (2 tau), tau = T var(mean) / (2 var).

Two estimates of tau, each pooled over runs; the larger one is used, and which it was is said.

- `BATCH_MEANS`: means of 10 batches, 2 L var(L) - (L/2) var(L/2) with L the length of a batch, which takes off the
  error of order 1 / L (Vats and Flegal 2022, Biometrika 109, 735). It sees motion as slow as the batches are long.
- `SOKAL`: the autocorrelation summed up to the first lag of five tau (`estimates.correlation_time`). It is sharper
  where one time rules, and stops short of a slow motion of small amplitude under a fast one.

Neither is too small under a slow oscillation; both are too large there, up to three times, since the mean of many
periods is better known than their power says. Both are too small where motion is slower than the batches and does not
oscillate. Batches of twice the length show that: `is_short`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats import student
from stickslip.analysis.stats.cascades import Window
from stickslip.analysis.stats.estimates import (
    SHORT_WINDOW,
    Estimate,
    Undefined,
    jackknife,
    over_matrices,
    ratio,
)

BATCH_MEANS, SOKAL = "batch means", "Sokal"
BATCHES = 10
_COUNTS = (BATCHES // 2, BATCHES, 2 * BATCHES)
_GROWTH_SHOWN = 0.95  # one-sided level at which longer batches count as giving more


def row(win: Window, tau: float) -> np.ndarray:
    """What one run adds, shape (5,), `tau` its correlation time, 0 if it has none.

    The variance in time; length times variance of the means of 5, 10, 20 batches; Sokal's 2 tau times the variance.
    """
    span, variance, finest = win.t_stop - win.t_start, win.time_variance(), win.means(_COUNTS[-1])
    spread = []
    for count in _COUNTS:
        means = finest.reshape(count, -1).mean(axis=1)
        means -= means.mean()
        spread.append(span / count * (means @ means) / (count - 1))
    return np.array([variance, *spread, 2 * tau * variance])


@dataclass(frozen=True)
class Effective:
    """Effective samples of all runs together.

    Attributes
    ----------
    tau : Estimate
        Dimensionless time; jackknife-t interval over matrices.
    samples : float or None
        G span / (2 tau).
    method : str
        `BATCH_MEANS` or `SOKAL`.
    is_short : bool
        Longer batches give more, or a window holds fewer than 20 tau: tau is then too small, and samples too many.
    """

    tau: Estimate
    samples: float | None
    method: str
    is_short: bool


def effective(rows: np.ndarray, span: float, confidence: float) -> Effective:
    """Pool runs of equal length.

    Parameters
    ----------
    rows : ndarray, shape (G, 5)
        `row` of each matrix.
    span : float
        Length of a window.
    confidence : float
    """
    variance, fives, tens, twenties, sokal = np.asarray(rows, dtype=np.float64).T
    by_batches = np.column_stack([2 * tens - twenties, 2 * variance])
    by_sokal = np.column_stack([sokal, 2 * variance])
    method = BATCH_MEANS if by_batches[:, 0].sum() >= by_sokal[:, 0].sum() else SOKAL
    tau = over_matrices(ratio, by_batches if method == BATCH_MEANS else by_sokal, confidence)
    if tau.value is None:
        return Effective(tau, None, method, True)
    is_short = span < SHORT_WINDOW * tau.value or _grows(2 * fives - 3 * tens + twenties, variance)
    return Effective(tau, len(rows) * span / (2 * tau.value), method, is_short)


def _grows(more: np.ndarray, variance: np.ndarray) -> bool:
    """Whether batches of twice the length are shown to give more."""
    if len(more) < 2:
        return False
    try:
        value, error = jackknife(ratio, np.column_stack([more, variance]))
    except Undefined:
        return False
    return value > student.quantile(_GROWTH_SHOWN, len(more) - 1) * error
