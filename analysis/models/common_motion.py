"""Slow common motion of blocks in n_stick: a noisy damped oscillator, on top of what time-shifted blocks do.

With S_0 the spectrum of blocks that ignore each other (`nulls.rotated`, in closed form), the one-sided spectrum of
n_stick is modelled, at periods of several cycles of a block, as

    S(f) = c S_0(f) + P s(f),     s(f) = 8 g w0^2 / ((w0^2 - w^2)^2 + 4 g^2 w^2),     w = 2 pi f, g = w0 / (2 Q),

The integral of s is 1, so P is the variance of the common motion. Up to Q = 1 / 2 nothing oscillates, and above
1 / sqrt(2) the spectrum has a peak, at w^2 = w0^2 - 2 g^2: at Q = 1 it is a broad hump, and the motion decays to
1 / e, in the time 1 / g, before a third of a period is over.

The four numbers P, w0, Q and c are fitted to periodograms of whole windows, averaged over matrices, by Whittle's
likelihood with the expected periodogram in place of the spectrum (Sykulski, Olhede, Guillaumin, Lilly and Early 2019,
Biometrika 106: 251). Leakage at the window's ends is thus part of the model, and estimates do not depend on the
length of the window.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import NamedTuple

import numpy as np
from scipy import special

from stickslip.analysis.series.nulls import BlockSteps
from stickslip.analysis.stats.estimates import Estimate, jackknife_estimate

QUALITIES = (0.2, 20.0)  # range of the fit
LEAST_HARMONICS = 10  # in the band
LEAST_PERIODS = 2.0  # of the oscillator in a window
SURROGATES = 999
MOST_STEPS = 100  # of Fisher scoring


class Shown(Enum):
    """Whether slow common motion is shown."""

    SLOW = "slow"
    NONE = "none shown"
    SHORT = "window too short"  #: the motion is too slow for it


class Number(StrEnum):
    """What is estimated of it."""

    PERIOD = "period"  #: the natural one, without damping
    QUALITY = "quality"
    VARIANCE = "variance"
    SHARE = "share"  #: of the variance of n_stick
    LEFT = "left"  #: the share c of the blocks' own power


def n_harmonics(span: float, shortest: float) -> int:
    """Number of frequencies k / span, k = 1, 2, ..., of a window up to 1 / shortest."""
    return int(span / shortest * (1 + 1e-12))


def periodogram(steps: BlockSteps, m: int) -> np.ndarray:
    """Power of n_stick at the first m harmonics of the window, and the sum of the blocks' powers, shape (2, m).

    It is one-sided, 2 |X(f)|^2 / span, and exact: computed from the times of the steps, without samples. The sum of
    the blocks' powers is the expectation of the power of n_stick under rotation.
    """
    order = steps.by_block
    firsts = np.flatnonzero(np.diff(steps.block[order], prepend=-1))
    turn = np.exp(-2j * np.pi * (steps.t[order] - steps.t_start) / steps.span)
    phase, powers = steps.step[order].astype(np.complex128), np.empty((2, m))
    net = np.add.reduceat(phase, firsts)
    for k in range(m):
        phase *= turn
        x = np.add.reduceat(phase, firsts) - net
        powers[:, k] = abs(x.sum()) ** 2, np.sum(x.real**2 + x.imag**2)
    return powers * (2 / steps.span) * (steps.span / (2 * np.pi * np.arange(1, m + 1))) ** 2


def expected(frequency: np.ndarray, span: float, period: np.ndarray, quality: np.ndarray) -> np.ndarray:
    """Expected periodogram of an oscillator of variance 1, at the harmonics of a window of length `span`.

    It is 4 int_0^span (1 - t / span) R(t) cos(2 pi f t) dt, with R = (s2 exp(s1 t) - s1 exp(s2 t)) / (s2 - s1) and
    s1, s2 the roots of s^2 + 2 g s + w0^2. Periods and qualities are numbers, or columns for several oscillators.
    """
    w0 = 2 * np.pi / np.asarray(period)
    g = w0 / (2 * np.asarray(quality))
    root = np.sqrt(g * g - w0 * w0 + 0j)
    root = np.where(abs(root) < 1e-5 * g, 1e-5 * g, root)  # avoids the double root
    s1, s2 = -g + root, -g - root
    square = (2 * np.pi * frequency) ** 2  # exp(2 pi i f span) = 1
    power = np.zeros(np.broadcast(square, root).shape)
    for weight, s in ((s2 / (s2 - s1), s1), (s1 / (s1 - s2), s2)):
        poles = 1 / (s * s + square)
        power = power - 4 * (weight * (s * poles + (1 - np.exp(s * span)) / span * (s * s - square) * poles**2)).real
    return power


# ------------------------------------------------------------------------------------------------ the fit


@dataclass(frozen=True)
class Spectra:
    """Periodograms of an ensemble at the harmonics of its windows.

    Attributes
    ----------
    span : float
        Length of each window.
    observed, independent : ndarray, shape (G, m)
        Power of n_stick, and the sum of the blocks' powers (`periodogram`); one row a matrix, the mean of its runs.
    variance : ndarray, shape (G,)
        Variance of n_stick in time, within windows.
    n_runs : ndarray, shape (G,)
        Number of runs of each matrix.
    """

    span: float
    observed: np.ndarray
    independent: np.ndarray
    variance: np.ndarray
    n_runs: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        return np.arange(1, self.observed.shape[1] + 1) / self.span


def fit(
    span: float, observed: np.ndarray, independent: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whittle estimates of log(P, natural period, Q, c) by Fisher scoring, for several sets of spectra at once.

    Parameters
    ----------
    observed, independent : ndarray, shape (b, m)
        Mean periodograms at the harmonics.
    start : ndarray, shape (b, 4)

    Returns
    -------
    ndarray, shape (b, 4)
    ndarray, shape (b,)
        Minus the mean log likelihood.
    """
    frequency = np.arange(1, observed.shape[1] + 1) / span
    low, high = _bounds(frequency, observed)

    def motion(at: np.ndarray) -> np.ndarray:
        variance, period, quality, _ = np.moveaxis(np.exp(at), -1, 0)[..., None]
        return variance * expected(frequency, span, period, quality)

    def loss(at: np.ndarray) -> np.ndarray:
        model = motion(at) + np.exp(at[:, 3:]) * independent
        return np.mean(np.log(model) + observed / model, axis=1)

    at, damping = np.clip(start, low, high), np.full(len(start), 1e-2)
    value, around = loss(at), np.zeros((5, 1, 4))  # at a point, and beside it in period and in quality
    around[1:3, 0, 1] = around[3:, 0, 2] = 1e-4, -1e-4
    for _ in range(MOST_STEPS):
        value_here, *gradients = motion(at + around)
        noise = np.exp(at[:, 3:]) * independent
        slopes = [(above - below) / 2e-4 for above, below in (gradients[:2], gradients[2:])]
        model = value_here + noise
        gain = np.stack([value_here, *slopes, noise], axis=2) / model[:, :, None]
        fisher = np.einsum("bki,bkj->bij", gain, gain)
        ridge = np.einsum("bii->bi", fisher) * damping[:, None] + 1e-9
        score = np.einsum("bki,bk->bi", gain, observed / model - 1)
        step = np.linalg.solve(fisher + ridge[:, :, None] * np.eye(4), score[:, :, None])[:, :, 0]
        tried = np.clip(at + np.clip(step, -0.7, 0.7), low, high)
        lost = loss(tried)
        is_better = lost <= value + 1e-12
        gained = np.max(value - lost, where=is_better, initial=0.0)
        at, value = np.where(is_better[:, None], tried, at), np.where(is_better, lost, value)
        damping = np.clip(np.where(is_better, damping / 5, damping * 5), 1e-8, 1e8)
        if gained < 1e-9 and (is_better | (damping > 1e3)).all():
            break
    return at, value


def _bounds(frequency: np.ndarray, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the parameters of `fit`; periods from the shortest of the band up to two windows."""
    scale = observed.mean() * frequency[-1]  # a variance
    low = np.log([1e-4 * scale, 1 / frequency[-1], QUALITIES[0], 1e-3])
    return low, np.log([1e2 * scale, 2 / frequency[0], QUALITIES[1], 1e3])


def best(span: float, observed: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """The best fit, shape (4,), from a grid of initial periods and qualities, to spectra of shape (m,)."""
    low, high = _bounds(np.arange(1, len(observed) + 1) / span, observed)
    share = max(np.median(observed[len(observed) // 2 :] / independent[len(observed) // 2 :]), 0.01)
    above = max(np.sum(observed - share * independent), 0.01 * observed.sum()) / span
    periods = np.linspace(low[1], high[1], 8)[1:-1]
    start = np.array(
        [[np.log(above), period, quality, np.log(share)] for period in periods for quality in np.log([0.8, 3.0])]
    )
    rows = len(start), len(observed)
    at, value = fit(span, np.broadcast_to(observed, rows), np.broadcast_to(independent, rows), start)
    return at[value.argmin()]


class Goodness(NamedTuple):
    """How far mean periodograms lie from a fit.

    Attributes
    ----------
    deviance : float
        Twice what the fit lacks in log likelihood (Whittle's); its mean is `dof` if it is the spectrum of all runs.
    dof : int
        Harmonics less parameters.
    """

    deviance: float
    dof: int

    @property
    def p_value(self) -> float:
        """The chance of a deviance as large, by chi-squared."""
        return float(special.chdtrc(self.dof, self.deviance))


def goodness(observed: np.ndarray, model: np.ndarray, n_runs: float) -> Goodness:
    """Deviance of a mean of periodograms of so many runs from a fit, both of shape (m,)."""
    ratio = observed / model
    return Goodness(float(2 * n_runs * np.sum(ratio - 1 - np.log(ratio))), len(observed) - 4)


# ------------------------------------------------------------------------------------------- what is concluded


@dataclass(frozen=True)
class CommonMotion:
    """The slow common motion of an ensemble.

    Attributes
    ----------
    p : float
        The share of surrogates without coupling whose slow power is as concentrated.
    period : float, optional
        The natural period that fits best; None for `Shown.NONE`.
    estimates : dict of Number to Estimate
        Empty unless it is shown.
    values : dict of Number to ndarray, shape (1 + G,)
        The same numbers, from all matrices and with each left out.
    goodness : Goodness, optional
        Of the fit to the mean of all matrices.
    """

    shown: Shown
    p: float
    period: float | None = None
    estimates: Mapping[Number, Estimate] = field(default_factory=dict)
    values: Mapping[Number, np.ndarray] = field(default_factory=dict)
    goodness: Goodness | None = None


def common_motion(data: Spectra, confidence: float, rng: np.random.Generator) -> CommonMotion:
    """The slow common motion, if there is one, with jackknife-t intervals over matrices.

    Parameters
    ----------
    data : Spectra
        Spectra of at least two matrices with `LEAST_HARMONICS` harmonics or more.
    rng : numpy.random.Generator
        Draws the surrogates.
    """
    p = p_value(data, rng)
    if p > 1 - confidence:
        return CommonMotion(Shown.NONE, p)
    g = len(data.observed)
    mean_observed, mean_own = data.observed.mean(axis=0), data.independent.mean(axis=0)
    start = best(data.span, mean_observed, mean_own)
    power, period, quality, share = np.exp(start)
    if period > data.span / LEAST_PERIODS:
        return CommonMotion(Shown.SHORT, p, float(period))
    observed, independent = (
        (g * mean - rows) / (g - 1) for mean, rows in ((mean_observed, data.observed), (mean_own, data.independent))
    )
    left_out, _ = fit(data.span, observed, independent, np.tile(start, (g, 1)))
    variance = np.append(data.variance.mean(), (data.variance.sum() - data.variance) / (g - 1))
    values = _values(np.exp(np.vstack([start, left_out])), data.span, variance)
    estimates = {number: _estimate(values[number], confidence, number is Number.SHARE) for number in Number}
    model = power * expected(data.frequency, data.span, period, quality) + share * mean_own
    n_runs = g**2 / np.sum(1 / data.n_runs)  # of a mean of means
    return CommonMotion(Shown.SLOW, p, float(period), estimates, values, goodness(mean_observed, model, n_runs))


def _values(fits: np.ndarray, span: float, variance: np.ndarray) -> dict[Number, np.ndarray]:
    """Numbers from fits, shape (b, 4), and the variances of n_stick within windows, shape (b,)."""
    power, period, quality, rest_share = fits.T
    at_zero = expected(np.zeros(1), span, period[:, None], quality[:, None])[:, 0]
    total = variance + power * at_zero / (2 * span)  # adds the variance that the mean of a window removes
    share = np.minimum(power / total, 1 - 1e-6)
    return dict(zip(Number, (period, quality, power, share, rest_share), strict=True))


def _estimate(values: np.ndarray, confidence: float, is_share: bool) -> Estimate:
    """A number with its interval on the log or logit scale; values from all matrices, and with each left out."""
    forth, back = (special.logit, special.expit) if is_share else (np.log, np.exp)
    return jackknife_estimate(forth(values), confidence).under(back)


def p_value(data: Spectra, rng: np.random.Generator) -> float:
    """p-value of the null that slow power is spread over periods as in blocks that ignore each other.

    Under rotation, each harmonic of the periodogram of a run is exponential, independent of the others, with the sum
    of the blocks' powers as its mean; surrogates are drawn from that. The statistic is the largest correlation
    between a resonance and the ratio of the power to this mean, over some periods and qualities. The total power is
    irrelevant.
    """
    frequency, independent = data.frequency, data.independent.sum(axis=0)
    periods, qualities = np.meshgrid(np.geomspace(2 / frequency[-1], data.span / LEAST_PERIODS, 6), (1.0, 4.0))
    shapes = expected(frequency, data.span, periods.reshape(-1, 1), qualities.reshape(-1, 1)) / independent
    shapes -= shapes.mean(axis=1, keepdims=True)
    shapes /= np.sqrt(np.sum(shapes**2, axis=1, keepdims=True))

    def largest(power: np.ndarray) -> np.ndarray:
        ratio = power / independent
        return np.max(ratio @ shapes.T, axis=-1) / ratio.sum(axis=-1)

    surrogates = np.array(
        [
            np.sum(
                data.independent * (rng.standard_gamma(data.n_runs, data.independent.T.shape) / data.n_runs).T, axis=0
            )
            for _ in range(SURROGATES)
        ]
    )
    n_as_far = int(np.sum(largest(surrogates) >= largest(data.observed.sum(axis=0))))
    return (1 + n_as_far) / (1 + SURROGATES)
