"""Correlation time of n_stick, tau = T var(mean) / (2 var): a window of length T holds T / (2 tau) effective samples.

Sokal's estimate sums the autocorrelation up to the first lag of five tau. It misses a slow motion of small amplitude
under a fast one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import fft

from stickslip.analysis import arguments
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.windows import Windows
from stickslip.analysis.stats.estimates import Estimate

CORRELATION_SAMPLES = 8192  # of a window, at first: as a rule far finer than the correlation time, and cheap by FFT
MOST_SAMPLES = 1 << 20  # where these are too far apart for the correlation time
RESOLVED, FINER = 4.0, 8  # samples that a correlation time has to hold; so many times more where it does not
LEAST_SAMPLES = 256
SAMPLES_A_CHANGE = 16  # enough for a window with few changes
SOKAL_WINDOW = 5.0  # sum the autocorrelation up to the first lag >= 5 tau (Sokal 1997, section 3)
SHORT_WINDOW = 20.0  # in a window of fewer correlation times, the estimate of tau itself is too low
_TOGETHER = 1 << 18  # samples whose spectra are in memory at once


def correlation_times(runs: Windows) -> np.ndarray:
    """Integrated autocorrelation times of n_stick, tau = int_0^inf rho(s) ds, with Sokal's window, shape (R,).

    A window of length T holds T / (2 tau) effectively independent samples. It is 0, which no other tau is, where
    n_stick does not change; `is_short` says where it cannot be known.
    """
    n_changes = np.diff(runs.first) - 1
    n_wanted = 2.0 ** (np.floor(np.log2(np.maximum(SAMPLES_A_CHANGE * n_changes, 1))) + 1)
    n_wanted = np.clip(n_wanted, LEAST_SAMPLES, MOST_SAMPLES).astype(int)
    n_samples = np.minimum(n_wanted, CORRELATION_SAMPLES)
    taus, todo = np.zeros(len(runs)), np.flatnonzero(n_changes > 0)
    while len(todo):
        for batch, count in _batches(todo, n_samples):
            windows = runs.take(batch)
            taus[batch] = _sokal(windows.level[windows.at(count)].astype(np.float64)) / count
        todo = todo[(taus[todo] * n_samples[todo] < RESOLVED) & (n_samples[todo] < n_wanted[todo])]
        n_samples[todo] = np.minimum(FINER * n_samples[todo], n_wanted[todo])
    return taus * runs.span


def _batches(runs: np.ndarray, n_samples: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Runs of one number of samples, by their numbers, and that: as many together as the memory is to take."""
    for count in np.unique(n_samples[runs]).tolist():
        alike, at_once = runs[n_samples[runs] == count], max(1, _TOGETHER // count)
        for k in range(0, len(alike), at_once):
            yield alike[k : k + at_once], count


def correlation_time(win: Window) -> Estimate:
    """The correlation time of one window: `correlation_times`.

    Returns
    -------
    Estimate
        tau (dimensionless). It has no value if n_stick does not change, and a reason beside the value if the window
        is too short.

    Raises
    ------
    ValueError
        If it is no window.
    """
    taus = correlation_times(arguments.instance("win", win, Window).alone)
    if not taus[0]:
        return Estimate(reason="n_stick does not change")
    return Estimate(float(taus[0]), reason="short window" if is_short(win.alone, taus)[0] else "")


def _sokal(samples: np.ndarray) -> np.ndarray:
    """Sum of the autocorrelation of each row in steps of a sample; 0 for a row that is constant."""
    samples -= samples.mean(axis=1, keepdims=True)
    n = samples.shape[1]
    size = fft.next_fast_len(2 * n, real=True)
    products = fft.irfft(np.abs(fft.rfft(samples, size)) ** 2, size)[:, :n]
    moves = products[:, 0] > 0
    taus = np.cumsum(products[moves] / products[moves, :1], axis=1) - 0.5  # the trapezoidal rule halves the first
    wide_enough = np.argmax(np.arange(n) >= SOKAL_WINDOW * taus, axis=1)
    # The sum over an oscillating series can be negative; a window never holds more than its own samples.
    tau_in_samples = np.zeros(len(samples))
    tau_in_samples[moves] = np.maximum(np.take_along_axis(taus, wide_enough[:, None], axis=1)[:, 0], 0.5)
    return tau_in_samples


def is_short(runs: Windows, taus: np.ndarray) -> np.ndarray:
    """Whether windows hold too few correlation times, `taus`, to estimate these, shape (R,)."""
    return runs.span < SHORT_WINDOW * taus
