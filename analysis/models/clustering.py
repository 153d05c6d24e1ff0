"""Whether exits cluster and blocks move together: quantities of a run beside those of blocks that ignore each other.

n_stick is the sum of the blocks' series x_i (1 where block i sticks). Its power, its variance, the variance of the
number of exits in a window and the number of pairs of exits close in time are therefore sums over pairs of blocks.
The null is `nulls.rotated`: each block's series rotated by a random amount of its own. Then the expectation of a term
of two different blocks depends only on their numbers of events, a term of one block does not change, and no draws are
needed:

    power      sum_i |X_i(f)|^2          variance   sum_i var x_i          Fano, pairs   `OwnGaps`.

Pairs show what happens within a mean gap between exits, power what happens over hundreds of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy import fft

from stickslip.analysis.series.nulls import BlockSteps, in_order
from stickslip.analysis.stats.estimates import Undefined

SAMPLES = 4096  # of a window: periods above a thousandth of it are free of aliasing
SEGMENTS = 2  # window over Welch's segment; segments have a Hann taper and overlap by half
CHUNK = 16  # blocks whose samples are in memory, and in the processor's cache, at a time


class Kind(StrEnum):
    """What is measured."""

    POWER = "power"  #: its mean over a band of periods
    VARIANCE = "variance"  #: in time
    FANO = "fano"  #: variance over mean of the number of exits in windows
    PAIRS = "pairs"  #: number of pairs of exits close in time


@dataclass(frozen=True)
class Part:
    """A quantity to be measured.

    Attributes
    ----------
    kind : Kind
    upto : float
        Longest period (`POWER`); length of the windows (`FANO`); largest gap of a pair (`PAIRS`).
    above : float
        Shortest period (`POWER`).
    """

    kind: Kind
    upto: float = 0.0
    above: float = 0.0


def measure(steps: BlockSteps, parts: Sequence[Part]) -> np.ndarray:
    """Observed value and expectation under rotation of each part, for one run, shape (p, 2).

    Parameters
    ----------
    steps : BlockSteps
    parts : sequence of Part
        Their periods are within `periods(span)`, and gaps and windows at most half the span.

    Raises
    ------
    Undefined
        If there are fewer than two exits.
    """
    t, block = steps.exits
    if len(t) < 2:
        raise Undefined("fewer than two exits")
    kinds = {part.kind for part in parts}
    reach = max((part.upto for part in parts if part.kind in (Kind.FANO, Kind.PAIRS)), default=0.0)
    # with room for windows that are stretched to tile the span
    own = own_gaps(t, block, steps.span, min(1.5 * reach, steps.span / 2))
    share = _share_stuck(steps) if kinds & {Kind.POWER, Kind.VARIANCE} else np.zeros(0)
    frequency, power = _spectra(steps, share) if Kind.POWER in kinds else (np.zeros(0), np.zeros((2, 0)))

    def of(part: Part) -> tuple[float, float]:
        match part.kind:
            case Kind.POWER:
                return _band(frequency, power, part.above, part.upto)
            case Kind.VARIANCE:
                return steps.window().time_variance(), float(np.sum(share * (1 - share)))
            case Kind.FANO:
                k = n_windows(part.upto, steps.span)
                return fano(t, steps.t_start, steps.t_stop, k), own.fano(k)
            case Kind.PAIRS:
                return pairs(t, part.upto), own.pairs(part.upto)

    return np.array([of(part) for part in parts])


# ------------------------------------------------------------------------------------------ pairs and counts


def pairs(t: np.ndarray, tau: float) -> float:
    """Number of pairs with 0 <= t_j - t_i < tau, i before j, of times that do not decrease."""
    return float(np.sum(np.searchsorted(t, t + tau, side="left") - np.arange(1, len(t) + 1)))


def n_windows(length: float, span: float) -> int:
    """Number of windows of about `length` that tile the span; at least two."""
    return max(2, round(span / length))


def fano(t: np.ndarray, t_start: float, t_stop: float, n_windows: int) -> float:
    """Variance over mean of the numbers of exits in equal windows; 1 for a Poisson process."""
    place = ((t - t_start) * (n_windows / (t_stop - t_start))).astype(np.int64)
    counts = np.bincount(np.minimum(place, n_windows - 1), minlength=n_windows)
    return float(counts.var(ddof=1) / counts.mean())


@dataclass(frozen=True)
class OwnGaps:
    """What rotation keeps of the exits: their number in each block, and the gaps within blocks.

    Attributes
    ----------
    counts : ndarray, shape (b,)
        Exits of each block.
    gaps : ndarray
        Gaps between exits of one block, on the window closed to a circle; those below a reach of at most half the
        span.
    span : float
    """

    counts: np.ndarray
    gaps: np.ndarray
    span: float

    def pairs(self, tau: float) -> float:
        """Expected number of pairs of exits within tau under rotation, for tau <= the reach.

        Two blocks with m_i and m_j exits have m_i m_j (2x - x^2) pairs, x = tau / span. The seam cuts a gap g
        within a block with probability g / span, and the gap is then no longer short.
        """
        total, x = float(self.counts.sum()), tau / self.span
        between = 0.5 * (total**2 - np.sum(self.counts.astype(np.float64) ** 2))
        return float(between * x * (2 - x) + np.sum(1 - self.gaps[self.gaps < tau] / self.span))

    def fano(self, n_windows: int) -> float:
        """Expected Fano factor under rotation of counts in `n_windows` equal windows of length L <= the reach.

        The blocks' counts are uncorrelated, so their variances add. The variance of a block follows from its gaps g:
        with K windows, E c^2 = m / K + 2 sum (L - g)_+ / span.
        """
        length = self.span / n_windows
        second = self.counts.sum() / n_windows + 2.0 * np.sum(np.maximum(length - self.gaps, 0.0)) / self.span
        variance = second - np.sum((self.counts / n_windows) ** 2)
        return float(n_windows / (n_windows - 1) * variance / (self.counts.sum() / n_windows))


def own_gaps(t: np.ndarray, block: np.ndarray, span: float, reach: float) -> OwnGaps:
    """Gaps below `reach` between exits of the same block; `t` must be in order, and reach <= span / 2."""
    order = in_order(block)
    times, index, counts = t[order], block[order], np.bincount(block)
    first, size = (np.cumsum(counts) - counts)[index], counts[index]
    gaps, at = [np.zeros(0)], np.arange(len(times))
    for lag in range(1, counts.max(initial=0)):
        following = at + lag
        is_next_round = following >= first[at] + size[at]
        following -= size[at] * is_next_round
        forward = times[following] - times[at] + span * is_next_round  # grows with the lag
        near = np.flatnonzero((forward < reach) & (lag < size[at]))
        if not len(near):
            break
        gaps.append(forward[near])
        at = at[near]
    return OwnGaps(counts, np.concatenate(gaps), span)


# ------------------------------------------------------------------------------------------ power and variance


def periods(span: float) -> tuple[float, float]:
    """Shortest and longest period that the power of a window resolves."""
    return 4 * span / SAMPLES, span / SEGMENTS


def _share_stuck(steps: BlockSteps) -> np.ndarray:
    """Share of the window during which each block sticks; 0 for blocks without changes, which contribute nothing."""
    stuck = np.where(_first_steps(steps) < 0, steps.span, 0.0)
    return (stuck + np.bincount(steps.block, steps.step * (steps.t_stop - steps.t))) / steps.span


def _first_steps(steps: BlockSteps) -> np.ndarray:
    """First step of each block, 0 if it has none; an exit means that the block stuck before."""
    first = np.zeros(int(steps.block.max(initial=-1)) + 1, dtype=np.int64)
    first[steps.block[::-1]] = steps.step[::-1]
    return first


def _spectra(steps: BlockSteps, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, shape (m,), with the power of n_stick and the sum of the blocks' powers, shape (2, m)."""
    dt, n_blocks, width = steps.span / SAMPLES, len(share), SAMPLES + 1
    begins = (_first_steps(steps) < 0) - share
    block, step = steps.block[steps.by_block], steps.step[steps.by_block]
    place = np.minimum(np.ceil((steps.t - steps.t_start) / dt).astype(np.int64), SAMPLES)[steps.by_block]
    total, own = np.zeros(SAMPLES), np.zeros(SAMPLES // SEGMENTS // 2 + 1)
    for first in range(0, n_blocks, CHUNK):
        last = min(first + CHUNK, n_blocks)
        part = slice(*np.searchsorted(block, (first, last)))
        cell = (block[part] - first) * width + place[part]
        jumps = np.bincount(cell, step[part], (last - first) * width).reshape(-1, width)
        jumps[:, 0] += begins[first:last]
        x = np.cumsum(jumps, axis=1)[:, :SAMPLES]
        total += x.sum(axis=0)
        own += _welch(x, dt)
    return np.fft.rfftfreq(SAMPLES // SEGMENTS, dt), np.array([_welch(total[None], dt), own])


def _welch(x: np.ndarray, dt: float) -> np.ndarray:
    """One-sided power, added up over the rows of x, from which their means over the whole window are subtracted.

    Welch's method subtracts the mean of each segment instead, which would remove the slowest motion.
    """
    m = SAMPLES // SEGMENTS
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(m) / m)
    starts = range(0, SAMPLES - m + 1, m // 2)
    power = np.zeros(m // 2 + 1)
    for k in starts:
        parts = fft.rfft(x[:, k : k + m] * taper).view(np.float64)  # real and imaginary by turns
        power += np.einsum("ij,ij->j", parts, parts).reshape(-1, 2).sum(axis=1)
    return power * (2 * dt / (len(starts) * np.sum(taper**2)))


def _band(frequency: np.ndarray, spectra: np.ndarray, shortest: float, longest: float) -> tuple[float, float]:
    """Mean power between two periods by the trapezoidal rule, which works for bands with few frequencies or none."""
    low, high = 1 / longest, 1 / shortest
    inside = frequency[(frequency > low) & (frequency < high)]
    nodes = np.concatenate(([low], inside, [high]))
    total, own = (np.trapezoid(np.interp(nodes, frequency, power), nodes) / (high - low) for power in spectra)
    return float(total), float(own)
