"""Do the blocks swing together? Spectrum and variance of n_stick, and Fano factors of exits, against two nulls.

n_stick is the sum of the blocks' series x_i (1 where block i sticks), so its power, its variance, and the variance of
the number of exits in a window are sums over pairs of blocks. Without collective motion the terms of two different
blocks cancel on average, and the sum over single blocks is left. That is the null `rotation`: each block's series is
turned by a random amount of its own (`nulls.rotated`), and these expectations need no draws:

    power      sum_i |X_i(f)|^2          variance   sum_i var x_i          Fano   `clustering.OwnGaps.fano`.

The null `blocks` knows less of a block: only the rates a_i at which it lets go while it sticks and b_i at which it
sticks while it slips, both constant. With l = a + b and r = a b / l exits a unit of time

    power      4 r / (l^2 + w^2)   (one-sided, per unit of frequency; w = 2 pi f)
    variance   a b / l^2
    counts     r L - 2 r^2 (L / l - (1 - exp(-l L)) / l^2)   in windows of length L (Cox 1962, Renewal Theory, ch. 4).

A ratio to `rotation` says what blocks do together; one to `blocks` has the rhythm of single blocks in it too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import fft, signal

from stickslip.analysis.stats import student
from stickslip.analysis.stats.clustering import fano, n_windows, own_gaps
from stickslip.analysis.stats.estimates import Estimate, Undefined, jackknife
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.nulls import BlockSteps

POWER, VARIANCE, FANO = "power", "variance", "fano"
ROTATION, BLOCKS = "rotation", "blocks"
SAMPLES = 4096  # of a window: periods from a thousandth of it on are free of aliases
SEGMENTS = 2  # Welch's segments are so much shorter than the window, tapered by Hann and overlapping by half
CHUNK = 256  # blocks whose samples are in memory at once


@dataclass(frozen=True)
class Part:
    """One row of what is measured: a band of periods, or a length of windows; of the variance neither."""

    kind: str
    period: tuple[float, float] | None = None
    length: float | None = None


def parts(periods: Sequence[float], lengths: Sequence[float]) -> list[Part]:
    """The parts of `measure`: bands between neighbouring `periods`, the variance, Fano factors by `lengths`."""
    bands = pairwise(periods)
    return [
        *(Part(POWER, period=band) for band in bands),
        Part(VARIANCE),
        *(Part(FANO, length=one) for one in lengths),
    ]


def measure(steps: BlockSteps, periods: Sequence[float], lengths: Sequence[float]) -> np.ndarray:
    """Of one run: what is observed, and what `rotation` and `blocks` give, for each of `parts`; shape (p, 3).

    Parameters
    ----------
    steps : BlockSteps
        Events of known blocks.
    periods : sequence of float, ascending
        Edges of the bands; the longest at most `longest(span)`.
    lengths : sequence of float
        Lengths of the windows of the Fano factors.

    Raises
    ------
    ValueError
        If a period is longer than a segment or too short for the samples.
    Undefined
        If no block changes, or fewer than two exits are seen.
    """
    dt = steps.span / SAMPLES
    if not (np.diff(periods) > 0).all() or periods[0] < 4 * dt or periods[-1] > longest(steps.span):
        raise ValueError(
            f"periods: expected ascending edges within {4 * dt:g} and {longest(steps.span):g}, got {list(periods)}"
        )
    t, of_block = steps.exits()
    if len(t) < 2:
        raise Undefined("fewer than two exits")
    blocks, index = np.unique(steps.block, return_inverse=True)
    place = np.minimum(np.ceil((steps.t - steps.t_start) / dt).astype(np.int64), SAMPLES)
    first = np.zeros(len(blocks), dtype=np.int64)
    first[index[::-1]] = steps.step[::-1]  # the first step of each block; an exit means that it stuck before
    stuck = np.where(first < 0, steps.span, 0.0) + np.bincount(index, steps.step * (steps.t_stop - steps.t))
    share = stuck / steps.span
    total, own = np.zeros(SAMPLES), np.zeros(SAMPLES // SEGMENTS // 2 + 1)
    for begin in range(0, len(blocks), CHUNK):
        some = slice(begin, begin + CHUNK)
        inside = (index >= begin) & (index < begin + CHUNK)
        shape = len(share[some]), SAMPLES + 1
        at = (index[inside] - begin) * shape[1] + place[inside]
        jumps = np.bincount(at, steps.step[inside].astype(np.float64), shape[0] * shape[1]).reshape(shape)
        jumps[:, 0] += first[some] < 0
        x = np.cumsum(jumps, axis=1)[:, :SAMPLES] - share[some, None]
        total += x.sum(axis=0)
        own += _welch(x, dt).sum(axis=0)
    frequency = np.fft.rfftfreq(SAMPLES // SEGMENTS, dt)
    markov = _Blocks(steps, index, stuck)
    spectra = np.array([_welch(total[None], dt)[0], own, markov.power(frequency)])
    bands = [_band(frequency, spectra, low, high) for low, high in pairwise(periods)]
    gaps = own_gaps(t, of_block, steps.span)
    tiles = [n_windows(length, steps.span) for length in lengths]
    factors = [[fano(t, steps.t_start, steps.t_stop, k), gaps.fano(k), markov.fano(steps.span / k)] for k in tiles]
    win = steps.window()
    variances = [win.time_variance(), float(np.sum(share * (1 - share))), markov.variance()]
    return np.array([*bands, variances, *factors])


def longest(span: float) -> float:
    """The longest period that the segments of a window resolve."""
    return span / SEGMENTS


def _welch(x: np.ndarray, dt: float) -> np.ndarray:
    """One-sided power of each row of x, from which the mean of the whole window has been taken.

    Not that of each segment (`scipy.signal.welch` knows no other): the slowest motion would go with it.
    """
    m = SAMPLES // SEGMENTS
    taper = signal.windows.hann(m, sym=False)
    power = [np.abs(fft.rfft(x[:, k : k + m] * taper)) ** 2 for k in range(0, SAMPLES - m + 1, m // 2)]
    return np.mean(power, axis=0) * (2 * dt / np.sum(taper**2))


def _band(frequency: np.ndarray, spectra: np.ndarray, shortest: float, longest: float) -> np.ndarray:
    """Mean power between two periods, by the trapezoidal rule: a band holds two frequencies or none."""
    low, high = 1 / longest, 1 / shortest
    inside = frequency[(frequency > low) & (frequency < high)]
    nodes = np.concatenate(([low], inside, [high]))
    at = np.array([np.interp(nodes, frequency, one) for one in spectra])
    return np.trapezoid(at, nodes, axis=1) / (high - low)


class _Blocks:
    """Independent blocks with constant rates; sums over blocks in closed form."""

    def __init__(self, steps: BlockSteps, index: np.ndarray, stuck: np.ndarray) -> None:
        exits, entries = (np.bincount(index[steps.step == side], minlength=len(stuck)) for side in (-1, 1))
        known = (exits > 0) & (entries > 0)
        self.a = exits[known] / stuck[known]
        self.b = entries[known] / (steps.span - stuck[known])
        self.l = self.a + self.b
        self.r = self.a * self.b / self.l

    def power(self, frequency: np.ndarray) -> np.ndarray:
        w = 2 * np.pi * frequency[:, None]
        return np.sum(4 * self.r / (self.l**2 + w**2), axis=1)

    def variance(self) -> float:
        return float(np.sum(self.a * self.b / self.l**2))

    def fano(self, length: float) -> float:
        lost = 2 * self.r**2 * (length / self.l - (1 - np.exp(-self.l * length)) / self.l**2)
        return float(np.sum(self.r * length - lost) / np.sum(self.r * length))


@dataclass(frozen=True)
class Effect:
    """One part against one null: observed over null, with the p-value of no effect, by itself and by Holm's rule."""

    part: Part
    null: str
    ratio: Estimate
    p: float | None = None
    p_holm: float | None = None

    @property
    def shown(self) -> float:
        """The size that the interval shows at least, |log ratio|; 0 if it contains 1 or there is none."""
        if self.ratio.low is None or self.ratio.high is None:
            return 0.0
        return float(max(np.log(self.ratio.low), -np.log(self.ratio.high), 0.0))


def effects(which: Sequence[Part], rows: np.ndarray, null: str, confidence: float) -> list[Effect]:
    """Every part against a null, the one of the largest shown effect first.

    The logarithm of (sum over matrices observed / sum over matrices by the null), jackknife-t over matrices.

    Parameters
    ----------
    which : sequence of Part
    rows : ndarray, shape (G, p, 3)
        `measure` of each matrix; of several runs of one, their mean. G >= 2.
    null : str
        `ROTATION` or `BLOCKS`.
    confidence : float

    Raises
    ------
    ValueError
        If there are fewer than two matrices.
    """
    n_matrices = len(rows)
    if n_matrices < 2:
        raise ValueError(f"rows: expected two matrices or more, got {n_matrices}")
    by = 1 + (ROTATION, BLOCKS).index(null)
    found = []
    for k, part in enumerate(which):
        sums = rows[:, k][:, [0, by]]
        try:
            value, error = jackknife(_log_ratio, sums)
        except Undefined as undefined:
            found.append(Effect(part, null, Estimate(reason=str(undefined))))
            continue
        half = student.half_width(confidence, n_matrices - 1) * error
        ratio = Estimate(float(np.exp(value)), float(np.exp(value - half)), float(np.exp(value + half)))
        found.append(Effect(part, null, ratio, student.two_sided(value / error, n_matrices - 1) if error else 1.0))
    p = [one.p for one in found if one.p is not None]
    adjusted = iter(holm(p))
    found = [
        one if one.p is None else Effect(one.part, null, one.ratio, one.p, float(next(adjusted))) for one in found
    ]
    return sorted(found, key=lambda one: one.shown, reverse=True)


def _log_ratio(sums: np.ndarray) -> np.ndarray:
    if (sums <= 0).any():
        raise Undefined("nothing is left to compare")
    return np.log(sums[:, 0] / sums[:, 1])
