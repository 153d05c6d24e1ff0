"""Pairs of slip onsets close in time, beside those of blocks that ignore each other.

The null is `nulls.rotated`: each block's series is rotated by a random amount of its own. The expected number of
pairs then follows from the number of onsets of each block and from the gaps within blocks, so no draws are needed;
of rotation by whole periods of a force from the phases of onsets as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from stickslip.analysis.series.nulls import BlockSteps, in_order
from stickslip.analysis.stats.estimates import Undefined


def measure(steps: BlockSteps, taus: Sequence[float]) -> np.ndarray:
    """Number of pairs within each gap, and its expectation under rotation, for one run, shape (len(taus), 2).

    Parameters
    ----------
    taus : sequence of float
        At most half the span.

    Raises
    ------
    Undefined
        If there are fewer than two exits.
    """
    t, block = steps.exits
    if len(t) < 2:
        raise Undefined("fewer than two exits")
    gaps = own_gaps(t, block, steps.span, max(taus))
    expected = partial(in_phase, steps, gaps) if steps.n_periods else gaps.pairs
    return np.array([(pairs(t, tau), expected(tau)) for tau in taus])


def in_phase(steps: BlockSteps, own: OwnGaps, tau: float) -> float:
    """Expected number of pairs of exits within tau under rotation by whole periods of a force.

    Of k periods, two exits of different blocks come to lie w apart, but for their phases, with the probability
    (k - |w|) / k^2. The seam, which is between two periods, cuts a gap within a block with a probability 1 / k for
    each such place in it.
    """
    t, block = steps.exits
    n, period = steps.n_periods, steps.span / steps.n_periods
    phase = np.mod(t - steps.t_start, period)
    alone = phase + block * (4.0 * steps.span)  # no other block's exits are near
    most = min(int(tau / period) + 1, n - 1)
    twice = sum(
        (n - abs(w)) / n**2 * (n_within(phase, w * period, tau) - n_within(alone, w * period, tau))
        for w in range(-most, most + 1)
    )
    is_near = own.gaps < tau
    firsts, gaps = (own.firsts[is_near] - steps.t_start) / period, own.gaps[is_near] / period
    n_seams = np.floor(firsts + gaps) - np.floor(firsts)
    return float(0.5 * twice + np.sum(1 - n_seams / n))


def n_within(t: np.ndarray, shift: float, tau: float) -> float:
    """Number of ordered pairs with |t_j - t_i + shift| < tau, and of those with themselves."""
    t = np.sort(t)
    above, below = (np.searchsorted(t, t - shift + tau, "left"), np.searchsorted(t, t - shift - tau, "right"))
    return float(np.sum(above - below))


def pairs(t: np.ndarray, tau: float) -> float:
    """Number of pairs with 0 <= t_j - t_i < tau, i before j, of times that do not decrease."""
    return float(np.sum(np.searchsorted(t, t + tau, side="left") - np.arange(1, len(t) + 1)))


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
    firsts : ndarray
        Times from which they last.
    """

    counts: np.ndarray
    gaps: np.ndarray
    span: float
    firsts: np.ndarray

    def pairs(self, tau: float) -> float:
        """Expected number of pairs of exits within tau under rotation, for tau <= the reach.

        Two blocks with m_i and m_j exits have m_i m_j (2x - x^2) pairs, x = tau / span. The seam cuts a gap g
        within a block with probability g / span, and the gap is then no longer short.
        """
        total, x = float(self.counts.sum()), tau / self.span
        between = 0.5 * (total**2 - np.sum(self.counts.astype(np.float64) ** 2))
        return float(between * x * (2 - x) + np.sum(1 - self.gaps[self.gaps < tau] / self.span))


def own_gaps(t: np.ndarray, block: np.ndarray, span: float, reach: float) -> OwnGaps:
    """Gaps below `reach` between exits of the same block; `t` must be in order, and reach <= span / 2."""
    order = in_order(block)
    times, index, counts = t[order], block[order], np.bincount(block)
    starts, size = (np.cumsum(counts) - counts)[index], counts[index]
    gaps, firsts, places = [np.zeros(0)], [np.zeros(0)], np.arange(len(times))
    for lag in range(1, counts.max(initial=0)):
        following = places + lag
        is_next_round = following >= starts[places] + size[places]
        following -= size[places] * is_next_round
        forward = times[following] - times[places] + span * is_next_round  # grows with the lag
        close = np.flatnonzero((forward < reach) & (lag < size[places]))
        if not len(close):
            break
        gaps.append(forward[close])
        places = places[close]
        firsts.append(times[places])
    return OwnGaps(counts, np.concatenate(gaps), span, np.concatenate(firsts))
