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

import numpy as np
from scipy import fft

from stickslip.analysis.series.nulls import BlockSteps, in_order
from stickslip.analysis.stats.estimates import Undefined
from stickslip.sim.numerics.arguments import apart

POWER, VARIANCE, FANO, PAIRS = "power", "variance", "fano", "pairs"
SAMPLES = 4096  # of a window: periods above a thousandth of it are free of aliasing
SEGMENTS = 2  # window over Welch's segment; segments have a Hann taper and overlap by half
CHUNK = 256  # blocks whose samples are in memory at a time


@dataclass(frozen=True)
class Part:
    """A quantity to be measured.

    Attributes
    ----------
    kind : str
        `POWER`, the mean over a band of periods; `VARIANCE` in time; `FANO`, the variance over the mean of the number
        of exits in windows; `PAIRS`, the number of pairs of exits close in time.
    upto : float, optional
        Longest period (`POWER`); length of the windows (`FANO`); largest gap of a pair (`PAIRS`).
    above : float, optional
        Shortest period (`POWER`).
    """

    kind: str
    upto: float | None = None
    above: float | None = None


def measure(steps: BlockSteps, parts: Sequence[Part]) -> np.ndarray:
    """Observed value and expectation under rotation of each part, for one run, shape (p, 2).

    Parameters
    ----------
    steps : BlockSteps
    parts : sequence of Part
        Their periods must be within `periods(span)`.

    Raises
    ------
    ValueError
        If a period is longer than a segment or too short for the samples, or if a gap or a window is longer than half
        of the run's window.
    Undefined
        If there are fewer than two exits.
    """
    t, block = steps.exits()
    if len(t) < 2:
        raise Undefined("fewer than two exits")
    reach = max((part.upto or 0.0 for part in parts if part.kind in (FANO, PAIRS)), default=0.0)
    if 2 * reach > steps.span:
        most, got = apart(steps.span / 2, reach)
        raise ValueError(f"parts: expected gaps and windows of at most {most}, got {got}")
    own = own_gaps(
        t, block, steps.span, min(1.5 * reach, steps.span / 2)
    )  # room for windows that are stretched to tile the span
    kinds = {part.kind for part in parts}
    share = _share_stuck(steps) if kinds & {POWER, VARIANCE} else np.zeros(0)
    spectra = _spectra(steps, share) if POWER in kinds else None
    found = []
    for part in parts:
        if part.kind == POWER:
            assert spectra is not None
            found.append(_band(*spectra, *_checked(part, steps.span)))
        elif part.kind == VARIANCE:
            found.append(np.array([steps.window().time_variance(), np.sum(share * (1 - share))]))
        elif part.kind == FANO:
            k = n_windows(part.upto or steps.span, steps.span)
            found.append(np.array([fano(t, steps.t_start, steps.t_stop, k), own.fano(k)]))
        else:
            tau = part.upto or 0.0
            found.append(np.array([pairs(t, tau), own.pairs(tau)]))
    return np.array(found)


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
    size, start = counts[index], (np.cumsum(counts) - counts)[index]
    place = np.arange(len(times)) - start
    gaps, lag = [np.zeros(0)], 1
    while lag < counts.max(initial=0):
        forward = (times[start + (place + lag) % size] - times) % span  # grows with the lag
        near = (forward < reach) & (lag < size)
        if not near.any():
            break
        gaps.append(forward[near])
        lag += 1
    return OwnGaps(counts, np.concatenate(gaps), span)


# ------------------------------------------------------------------------------------------ power and variance


def periods(span: float) -> tuple[float, float]:
    """Shortest and longest period that the power of a window resolves."""
    return 4 * span / SAMPLES, span / SEGMENTS


def _checked(part: Part, span: float) -> tuple[float, float]:
    """The band of a part; ValueError if the window does not resolve it."""
    shortest, longest = periods(span)
    if part.above is None or part.upto is None or not shortest <= part.above < part.upto <= longest:
        raise ValueError(f"parts: expected a band of periods within {shortest:g} and {longest:g}, got {part}")
    return part.above, part.upto


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
    dt = steps.span / SAMPLES
    index, first = steps.block, _first_steps(steps)
    place = np.minimum(np.ceil((steps.t - steps.t_start) / dt).astype(np.int64), SAMPLES)
    total, own = np.zeros(SAMPLES), np.zeros(SAMPLES // SEGMENTS // 2 + 1)
    for begin in range(0, len(share), CHUNK):
        some = slice(begin, begin + CHUNK)
        inside = (index >= begin) & (index < begin + CHUNK)
        shape = len(share[some]), SAMPLES + 1
        at = (index[inside] - begin) * shape[1] + place[inside]
        jumps = np.bincount(at, steps.step[inside].astype(np.float64), shape[0] * shape[1]).reshape(shape)
        jumps[:, 0] += first[some] < 0
        x = np.cumsum(jumps, axis=1)[:, :SAMPLES] - share[some, None]
        total += x.sum(axis=0)
        own += _welch(x, dt).sum(axis=0)
    return np.fft.rfftfreq(SAMPLES // SEGMENTS, dt), np.array([_welch(total[None], dt)[0], own])


def _welch(x: np.ndarray, dt: float) -> np.ndarray:
    """One-sided power of each row of x, from which the mean over the whole window has been subtracted.

    Welch's method subtracts the mean of each segment instead, which would remove the slowest motion.
    """
    m = SAMPLES // SEGMENTS
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(m) / m)
    starts = range(0, SAMPLES - m + 1, m // 2)
    power = np.zeros((len(x), m // 2 + 1))
    for k in starts:
        found = fft.rfft(x[:, k : k + m] * taper)
        power += found.real**2 + found.imag**2
    return power * (2 * dt / (len(starts) * np.sum(taper**2)))


def _band(frequency: np.ndarray, spectra: np.ndarray, shortest: float, longest: float) -> np.ndarray:
    """Mean power between two periods by the trapezoidal rule, which works for bands with few frequencies or none."""
    low, high = 1 / longest, 1 / shortest
    inside = frequency[(frequency > low) & (frequency < high)]
    nodes = np.concatenate(([low], inside, [high]))
    at = np.array([np.interp(nodes, frequency, one) for one in spectra])
    return np.trapezoid(at, nodes, axis=1) / (high - low)
