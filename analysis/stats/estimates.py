"""Estimates and their intervals.

Matrices are the independent units: the cascades of one run, and the runs of one matrix, depend on each other.
Every estimate here is a function of sums over matrices, and every interval comes from leaving out one matrix
at a time; resampling cascades or time samples would give intervals far too short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from stickslip.analysis.series.cascades import Window
from stickslip.analysis.stats import student

LN2 = float(np.log(2.0))  # gamma of P(k) = 2^-k: exits and entries equally likely and independent


class Undefined(ArithmeticError):
    """Raised where a statistic has no value on some data; the message is the reason, in words for a reader."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval. What is missing is None, never NaN, and `reason` says why."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    reason: str = ""

    def __repr__(self) -> str:
        value = "no value" if self.value is None else f"{self.value:.6g}"
        interval = "" if self.low is None or self.high is None else f" ({self.low:.6g} to {self.high:.6g})"
        return f"Estimate({value}{interval}{self.reason and f': {self.reason}'})"


def at_least(estimate: Estimate, least: float | None) -> Estimate:
    """An estimate whose interval does not go below what the number is never below, by what it is.

    A t interval is symmetric and may; what is cut off cannot be covered, so the coverage stays what it is.
    """
    if least is None or estimate.low is None:
        return estimate
    return replace(estimate, low=max(estimate.low, least))


Statistic = Callable[[np.ndarray], np.ndarray]  # sums, shape (m, c) -> values, shape (m,); may raise Undefined


def ratio(sums: np.ndarray) -> np.ndarray:
    """First column over the second, which is a mean if the second is a count."""
    if (sums[:, 1] == 0).any():
        raise Undefined("nothing was counted")
    return sums[:, 0] / sums[:, 1]


def gamma(sums: np.ndarray) -> np.ndarray:
    """Maximum-likelihood rate of the discrete exponential P(k) = (1 - q) q^(k-1), k >= 1, q = exp(-gamma).

    gamma = -log(1 - 1/mean): the likelihood depends on the sizes through their mean alone.

    Parameters
    ----------
    sums : ndarray, shape (m, 2)
        Total of the sizes, and number of cascades.

    Raises
    ------
    Undefined
        If there are no cascades, or all sizes are 1 (the likelihood then increases with gamma without bound).
    """
    total, count = sums[:, 0], sums[:, 1]
    if (count == 0).any():
        raise Undefined("no complete cascade")
    if (total <= count).any():
        raise Undefined("every cascade has size 1, so gamma has no finite value")
    return -np.log1p(-count / total)


def paired_difference(of: Statistic) -> Statistic:
    """The statistic that is `of` the first half of the columns minus `of` the second half, paired by matrix."""

    def difference(sums: np.ndarray) -> np.ndarray:
        half = sums.shape[1] // 2
        return of(sums[:, :half]) - of(sums[:, half:])

    return difference


def jackknife(statistic: Statistic, sums: np.ndarray) -> tuple[float, float]:
    """Value of a statistic of the summed rows, and its standard error from leaving out one row at a time.

    Parameters
    ----------
    statistic : callable
    sums : ndarray, shape (rows, c)
        At least two rows, independent of each other.
    """
    whole = sums.sum(axis=0, keepdims=True)
    return float(statistic(whole)[0]), jackknife_error(statistic(whole - sums))


def jackknife_error(left_out: np.ndarray) -> float:
    """Standard error, sqrt((G-1)/G sum (x - mean)^2), from the values with one of G matrices left out, shape (G,)."""
    n_rows = len(left_out)
    return float(np.sqrt((n_rows - 1) / n_rows * np.sum((left_out - left_out.mean()) ** 2)))


def over_matrices(statistic: Statistic, sums: np.ndarray, confidence: float) -> Estimate:
    """A statistic of the whole ensemble with a jackknife-t interval over matrices.

    value +- t(G - 1) * jackknife standard error, with G the number of rows. For a mean this is the t interval.

    Parameters
    ----------
    statistic : callable
        Maps sums, shape (m, c), to values, shape (m,); raises `Undefined` with a reason.
    sums : ndarray, shape (G, c)
        One row a matrix; the statistic is that of their sum.
    confidence : float

    Returns
    -------
    Estimate
        With a reason instead of an interval for a single matrix.
    """
    if len(sums) == 0:
        return Estimate(reason="no matrix has data")
    try:
        value = float(statistic(sums.sum(axis=0, keepdims=True))[0])
    except Undefined as undefined:
        return Estimate(reason=str(undefined))
    if len(sums) == 1:
        return Estimate(value, reason="one matrix")
    try:
        _, error = jackknife(statistic, sums)
    except Undefined as undefined:
        return Estimate(value, reason=f"one left out: {undefined}")
    half = student.half_width(confidence, len(sums) - 1) * error
    return Estimate(value, value - half, value + half)


def add_histograms(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of two histograms, the shorter padded with zeros."""
    out = np.zeros(max(len(a), len(b)), dtype=np.int64)
    out[: len(a)] += a
    out[: len(b)] += b
    return out


CORRELATION_SAMPLES = 8192  # of a window, at most: far finer than the correlation time, and cheap by FFT
SAMPLES_A_CHANGE = 16  # enough for a window with few changes
SOKAL_WINDOW = 5.0  # sum the autocorrelation up to the first lag >= 5 tau (Sokal 1997, section 3)
SHORT_WINDOW = 20.0  # in a window of fewer correlation times, the estimate of tau itself is too low


def is_short(win: Window, tau: float) -> bool:
    """Whether a window holds too few correlation times tau to estimate tau."""
    return win.t_stop - win.t_start < SHORT_WINDOW * tau


def correlation_time(win: Window) -> Estimate:
    """Integrated autocorrelation time of n_stick, tau = int_0^inf rho(s) ds, with Sokal's automatic window.

    A window of length T holds T / (2 tau) effectively independent samples.

    Returns
    -------
    Estimate
        tau (dimensionless). It has no value if n_stick does not change, and a reason beside the value if the window
        is too short.
    """
    span = win.t_stop - win.t_start
    enough = 1 << int(SAMPLES_A_CHANGE * len(win.t)).bit_length()
    dt = span / min(CORRELATION_SAMPLES, max(enough, 256))
    samples = win.path()[win.grid_index(dt)].astype(np.float64)
    samples -= samples.mean()
    if not samples.any():
        return Estimate(reason="n_stick does not change")
    n = len(samples)
    spectrum = fft.rfft(samples, fft.next_fast_len(2 * n, real=True))
    products = fft.irfft(np.abs(spectrum) ** 2, fft.next_fast_len(2 * n, real=True))[:n]
    rho = products / products[0]
    taus = np.cumsum(rho) - 0.5  # in samples; the trapezoidal rule halves the first
    wide_enough = np.flatnonzero(np.arange(n) >= SOKAL_WINDOW * taus)
    # The sum over an oscillating series can be negative; a window never holds more than its own samples.
    tau = max(float(taus[wide_enough[0]]), 0.5) * dt
    if is_short(win, tau):
        return Estimate(tau, reason="short window")
    return Estimate(tau)
