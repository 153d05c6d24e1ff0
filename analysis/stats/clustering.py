"""Do exits cluster beyond chance? Pairs of exits close in time, Fano factors, spans of cascades, a positive control.

Pairs and Fano factors need no simulation of the null: turning each block's series by a random amount of its own
(`stats.nulls.rotated`) makes the exits of two blocks independent and uniform in the window, and leaves the
gaps within a block as they are, so both have expectations in closed form. Where only n_stick is known, each exit
stands as a block of its own (`steps_of_series`), and the same formulas give two Poisson processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.cascades import Spans, Window, spans
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.nulls import BlockSteps, rotated, triggered


def steps_of_series(win: Window) -> BlockSteps:
    """The changes of n_stick as steps of blocks that are not known: each of its own block."""
    unit = win.unit_steps()
    return BlockSteps(win.t_start, win.t_stop, unit.t, np.arange(len(unit.t)), unit.step)


# ------------------------------------------------------------------------------------------ pairs of exits


def pairs(t: np.ndarray, taus: Sequence[float]) -> np.ndarray:
    """Number of pairs with 0 <= t_j - t_i < tau, i before j, for each tau.

    Parameters
    ----------
    t : ndarray, shape (m,)
        Times, not decreasing.
    taus : sequence of float
    """
    later = np.arange(1, len(t) + 1)
    return np.array([np.sum(np.searchsorted(t, t + tau, side="left") - later) for tau in taus], dtype=np.float64)


def chance_within(taus: Sequence[float], span: float) -> np.ndarray:
    """P(|U - V| < tau) of two independent uniform times in a window of length `span`: 2x - x^2, x = tau / span."""
    x = np.minimum(np.asarray(taus, dtype=np.float64) / span, 1.0)
    return x * (2.0 - x)


def pairs_in_random_order(win: Window, taus: Sequence[float]) -> np.ndarray:
    """Expected pairs of exits if exits and entries fell at random on the observed times of change.

    Each pair of changes is a pair of exits with probability m (m - 1) / (N (N - 1)), m exits among N changes.
    """
    unit = win.unit_steps()
    n, m = len(unit.t), int(np.sum(unit.step < 0))
    return pairs(unit.t, taus) * (m * (m - 1) / (n * (n - 1)) if n > 1 else 0.0)


@dataclass(frozen=True)
class OwnGaps:
    """What the exits of single blocks keep under rotation: numbers a block, and gaps within blocks.

    Attributes
    ----------
    counts : ndarray, shape (b,)
        Exits of each block.
    gaps : ndarray
        t_j - t_i of every pair of exits of one block.
    span : float
    """

    counts: np.ndarray
    gaps: np.ndarray
    span: float

    def pairs(self, taus: Sequence[float]) -> np.ndarray:
        """Expected pairs of exits within tau under rotation.

        Two blocks of m_i and m_j exits have m_i m_j (2x - x^2) pairs, x = tau / span. A gap d within a block is
        cut by the seam with probability d / span, and then stands as span - d.
        """
        total = float(self.counts.sum())
        between = 0.5 * (total**2 - np.sum(self.counts.astype(np.float64) ** 2))
        is_cut = self.gaps / self.span
        own = [np.sum((1 - is_cut)[self.gaps < tau]) + np.sum(is_cut[self.span - self.gaps < tau]) for tau in taus]
        return between * chance_within(taus, self.span) + np.array(own)

    def fano(self, n_windows: int) -> float:
        """Expected Fano factor under rotation, of counts in `n_windows` >= 2 equal windows that tile the span.

        The blocks' counts are uncorrelated, so their variances add; that of a block follows from its gaps d on
        the circle: E c^2 = m / K + 2 sum (L - d)_+ / span, with K windows of length L.
        """
        length = self.span / n_windows
        on_circle = np.minimum(self.gaps, self.span - self.gaps)
        second = self.counts.sum() / n_windows + 2.0 * np.sum(np.maximum(length - on_circle, 0.0)) / self.span
        variance = second - np.sum((self.counts / n_windows) ** 2)
        return float(n_windows / (n_windows - 1) * variance / (self.counts.sum() / n_windows))


def own_gaps(t: np.ndarray, block: np.ndarray, span: float) -> OwnGaps:
    """Gaps between exits of the same block; `t` in order of time."""
    order = np.argsort(block, kind="stable")
    times, blocks = t[order], block[order]
    counts = np.unique(blocks, return_counts=True)[1]
    gaps = [np.zeros(0)]
    for lag in range(1, int(counts.max(initial=0))):
        is_own = blocks[lag:] == blocks[:-lag]
        gaps.append((times[lag:] - times[:-lag])[is_own])
    return OwnGaps(counts, np.concatenate(gaps), span)


def excess(sums: np.ndarray) -> np.ndarray:
    """Pairs observed over pairs by chance, minus one: the cumulative pair correlation g(tau) - 1."""
    if (sums[:, 1] <= 0).any():
        raise Undefined("chance gives no pair of exits so close")
    return sums[:, 0] / sums[:, 1] - 1.0


# ---------------------------------------------------------------------------------------------- Fano factor


def n_windows(length: float, span: float) -> int:
    """How many windows of about `length` tile the span; at least two."""
    return max(2, round(span / length))


def fano(t: np.ndarray, t_start: float, t_stop: float, n_windows: int) -> float:
    """Variance over mean of the numbers of exits in equal windows; 1 for a Poisson process."""
    place = ((t - t_start) * (n_windows / (t_stop - t_start))).astype(np.int64)
    counts = np.bincount(np.minimum(place, n_windows - 1), minlength=n_windows)
    return float(counts.var(ddof=1) / counts.mean())


# --------------------------------------------------------------------------------------- spans of cascades


def moments(values: np.ndarray) -> np.ndarray:
    """Number, sum and sum of squares: the three columns that `variation` reads."""
    return np.array([len(values), values.sum(), np.square(values).sum()], dtype=np.float64)


def variation(sums: np.ndarray) -> np.ndarray:
    """Coefficient of variation, standard deviation over mean: 1 for an exponential distribution."""
    if (sums[:, 0] < 2).any() or (sums[:, 1] <= 0).any():
        raise Undefined("fewer than two of them")
    return np.sqrt(np.maximum(sums[:, 0] * sums[:, 2] / sums[:, 1] ** 2 - 1.0, 0.0))


def variation_difference(sums: np.ndarray) -> np.ndarray:
    """`variation` of columns 0 to 2 minus that of columns 3 to 5, paired matrix by matrix."""
    return variation(sums[:, :3]) - variation(sums[:, 3:6])


def long_durations(found: Spans) -> np.ndarray:
    """Durations of the cascades of two exits and more; a cascade of one has none."""
    return found.duration[found.size > 1]


def independent_variation(n_exits: int, n_entries: int) -> tuple[float, float]:
    """Variation of durations and of waiting times if exits and entries are Poisson processes of rates a and b.

    Changes come at rate a + b, and each is the end of the cascade with probability b / (a + b): the duration of
    a cascade of two exits and more is exponential of rate b, so its variation is 1. From one start to the next
    an entry and then an exit are waited for: the sum of two exponentials of rates b and a, variation
    sqrt(a^2 + b^2) / (a + b), which is 0.71 at equal rates. Exponential waiting times are not what chance gives.
    """
    return 1.0, float(np.hypot(n_exits, n_entries) / (n_exits + n_entries))


# ------------------------------------------------------------------------------------------ of one run


@dataclass(frozen=True)
class Clustering:
    """What a run says about clustering, in sums that add over the runs of a matrix.

    Attributes
    ----------
    pairs : ndarray, shape (len(taus), 2)
        Pairs observed and by rotation.
    fano : ndarray, shape (len(windows), 3)
        Fano factor observed and by rotation, and 1 for the run.
    events : ndarray, shape (4,)
        Total size and number of cascades by `events`, observed and by rotation.
    durations, waits : ndarray, shape (6,)
        `moments` observed and by rotation.
    """

    pairs: np.ndarray
    fano: np.ndarray
    events: np.ndarray
    durations: np.ndarray
    waits: np.ndarray


def measure(
    steps: BlockSteps, taus: Sequence[float], windows: Sequence[float], null: np.ndarray | None = None
) -> Clustering | None:
    """Clustering of the exits of a run, or None with fewer than two exits.

    Parameters
    ----------
    steps : BlockSteps
    taus, windows : sequence of float
    null : ndarray, shape (8,), optional
        `rotated_spans` of the run; zero if left out.
    """
    t, block = steps.exits()
    if len(t) < 2:
        return None
    own = own_gaps(t, block, steps.span)
    tiles = [n_windows(length, steps.span) for length in windows]
    found = spans(steps.window())
    by_chance = np.zeros(8) if null is None else null
    return Clustering(
        pairs=np.column_stack([pairs(t, taus), own.pairs(taus)]),
        fano=np.array([[fano(t, steps.t_start, steps.t_stop, k), own.fano(k), 1.0] for k in tiles]),
        events=np.array([found.size.sum(), len(found.size), *by_chance[:2]]),
        durations=np.concatenate([moments(long_durations(found)), by_chance[2:5]]),
        waits=np.concatenate([moments(found.waiting), by_chance[5:8]]),
    )


def rotated_spans(steps: BlockSteps, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Cascades by `events` over `draws` rotations: total size, number, moments of durations and of waits, (8,)."""
    sums = np.zeros(8)
    for _ in range(draws):
        found = spans(rotated(steps, rng).window())
        sums[:2] += [found.size.sum(), len(found.size)]
        sums[2:5] += moments(long_durations(found))
        sums[5:] += moments(found.waiting)
    return sums


def control(
    steps: BlockSteps,
    shares: Sequence[float],
    delay: float,
    taus: Sequence[float],
    windows: Sequence[float],
    null: np.ndarray,
    repeats: int,
    rng: np.random.Generator,
) -> list[list[Clustering]]:
    """The same measurements on surrogates without coupling in which a share of the exits follows others.

    Parameters
    ----------
    shares : sequence of float
    delay : float
        Mean of the exponential delay after the exit that is followed, in mean gaps between exits.
    null : ndarray, shape (8,)
        `rotated_spans` of the run.
    repeats : int

    Returns
    -------
    list of list of Clustering
        By share, then by repetition; empty lists for a run with fewer than two exits.
    """
    n_exits = int(np.sum(steps.step < 0))
    if n_exits < 2:
        return [[] for _ in shares]
    mean_delay = delay * steps.span / n_exits
    found = []
    for share in shares:
        runs = [measure(triggered(steps, share, mean_delay, rng), taus, windows, null) for _ in range(repeats)]
        found.append([run for run in runs if run is not None])
    return found
