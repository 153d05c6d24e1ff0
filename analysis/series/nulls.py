"""Null models for cascades: what chance gives if one thing is kept and another broken.

=================  =======================================  =============================================
model              kept                                     broken
=================  =======================================  =============================================
fair order         nothing                                  all: each event is an exit or an entry by a fair coin
finite pool        number of blocks, mean n_stick           all else: blocks with constant rates (`models.pool`)
rotation           each block's own series of events        the blocks' timing relative to each other
=================  =======================================  =============================================

Under a periodic force rotation is by whole periods, so that what blocks share of its phase is kept.

With fair order, `events` has P(k) = 2^-k and gamma = ln 2 (`stats.estimates.LN2`). For the finite pool, gamma by
`events` has a closed form too. Rotation is simulated. It is the null of "no coupling": a block still cannot let go
twice without sticking in between, and keeps its own rhythm. `models.pool` says which null answers which question.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stickslip.analysis.series.cascades import Window

LEAST_PERIODS = 10  # of a force: two blocks keep their order in one of so many rotations
SAME_PHASE, MOSTLY = 1e-4, 0.99  # of a period; of events that are a period apart where blocks repeat
_PLACES = 2**31  # in a window, of the events of a surrogate


@dataclass(frozen=True)
class BlockSteps:
    """Exits and entries of each block in (t_start, t_stop], in order of time; crossings are left out.

    Attributes
    ----------
    t : ndarray, shape (m,)
    block : ndarray of int, shape (m,)
    step : ndarray of int, shape (m,)
        -1 for an exit, +1 for an entry.
    n_periods : int
        Of a force, in the window: blocks are rotated by one or more of these; 0: by any time.
    """

    t_start: float
    t_stop: float
    t: np.ndarray
    block: np.ndarray
    step: np.ndarray
    n_periods: int = 0

    @property
    def span(self) -> float:
        return self.t_stop - self.t_start

    @cached_property
    def phases(self) -> tuple[np.ndarray, np.ndarray]:
        """Number of events of each block; and, block by block, their places in the window, uint32, shape (m,).

        Places are whole numbers, which wrap around with the window: the last bit is one for an exit, the others count
        units of span / 2^31.
        """
        places = ((self.t - self.t_start) * (_PLACES / self.span)).astype(np.uint32) << np.uint32(1)
        places |= self.step < 0
        return np.bincount(self.block), places[self.by_block]

    @cached_property
    def repeats(self) -> bool:
        """Whether blocks do the same in each period of a force, so that rotation changes nothing."""
        if not self.n_periods:
            return False
        t, block, step = (column[self.by_block] for column in (self.t, self.block, self.step))
        after = np.arange(len(t)) + np.round(np.bincount(block) / self.n_periods).astype(np.int64)[block]
        now = np.flatnonzero(after < len(t))
        now = now[block[after[now]] == block[now]]
        later, period = after[now], self.span / self.n_periods
        is_alike = (step[later] == step[now]) & (abs(t[later] - t[now] - period) < SAME_PHASE * period)
        return len(now) > 0 and float(is_alike.mean()) > MOSTLY

    @cached_property
    def by_block(self) -> np.ndarray:
        """Places of the events, block by block and each in order of time."""
        return in_order(self.block)

    @cached_property
    def exits(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and blocks of the exits."""
        places = np.flatnonzero(self.step < 0)
        return self.t[places], self.block[places]

    def window(self) -> Window:
        """The changes as a window of n_stick, whose level is not known and set to zero."""
        return Window(self.t_start, self.t_stop, 0, self.t, self.step)


def whole_periods(t_start: float, t_stop: float, period: float) -> tuple[float, int]:
    """The last whole periods of a window: from when on, and how many; all of it, and 0, where none is known."""
    n_periods = int((t_stop - t_start) / period * (1 + 1e-12)) if period > 0 else 0
    return (t_stop - n_periods * period if n_periods else t_start), n_periods


def block_steps(
    t: np.ndarray,
    block: np.ndarray,
    mode: np.ndarray,
    initial_mode: np.ndarray,
    t_start: float,
    t_stop: float,
    period: float = np.nan,
) -> BlockSteps:
    """Exits and entries of each block, from the events of a run, in the last whole periods of a window.

    Parameters
    ----------
    t, block, mode : ndarray, shape (m,)
        Events in order of time: the block's mode (-1, 0, +1) from t on, 0 where it sticks.
    initial_mode : ndarray, shape (n,)
    period : float
        Of the force; NaN if there is none.

    Raises
    ------
    ValueError
        If the times decrease, or lengths differ.
    """
    if not len(t) == len(block) == len(mode):
        raise ValueError(f"t, block, mode: expected one length, got {len(t)}, {len(block)} and {len(mode)}")
    if (t[1:] < t[:-1]).any():
        raise ValueError("t: expected times that do not decrease; sort the events by time")
    by_block = in_order(block)
    sticks = np.asarray(mode) == 0
    stuck = np.empty_like(sticks)
    stuck[by_block[1:]] = sticks[by_block[:-1]]
    is_first = np.concatenate(([True], np.diff(block[by_block]) != 0))[: len(t)]
    firsts = by_block[is_first]
    stuck[firsts] = np.asarray(initial_mode)[block[firsts]] == 0
    t_start, n_periods = whole_periods(t_start, t_stop, period)
    is_inside = (sticks != stuck) & (t > t_start) & (t <= t_stop)
    step = 2 * sticks[is_inside] - 1
    return BlockSteps(float(t_start), float(t_stop), t[is_inside], block[is_inside], step, n_periods)


def in_order(block: np.ndarray) -> np.ndarray:
    """Indices that sort by block and keep the order within a block."""
    is_small = len(block) == 0 or block.max() < 2**16  # sorting small integers takes a tenth of the time
    return np.argsort(block.astype(np.uint16) if is_small else block, kind="stable")


def rotated(steps: BlockSteps, rng: np.random.Generator) -> np.ndarray:
    """A surrogate without coupling: each block's series rotated in the window by a random amount of its own.

    The window counts as periodic. A block keeps its rhythm and the number and order of its events; the phases of the
    blocks relative to each other are drawn anew. Where a block does not end the window as it began it, the seam would
    add one exit or entry that never happened. It is dropped, so that the surrogate has exactly the observed exits and
    entries; its path may then leave 0..n, which does not matter as only falls are counted. In 20 runs of n = 200 over
    400 units the seams would have added 1.3% of changes; with and without them gamma by `events` agreed to 0.0001.

    Times are rounded to span / 2^31: whole numbers of 32 bits are sorted in half the time that floats of 64
    take, and need no remainder. Of two events that are closer than that an entry comes first.

    Returns
    -------
    ndarray of uint32
        Places as of `BlockSteps.phases`, in order of time.
    """
    counts, phases = steps.phases
    n_shifts = steps.n_periods or _PLACES
    shift = (rng.integers(n_shifts, size=len(counts)) * _PLACES // n_shifts).astype(np.uint32) << np.uint32(1)
    places = phases + np.repeat(shift, counts)  # a sum beyond 32 bits begins again at zero
    places.sort()
    return places


def moments(steps: BlockSteps, draws: int, rng: np.random.Generator, least: int = 1) -> np.ndarray:
    """Number, sum and sum of squares of the sizes by `events` in `draws` surrogates of `rotated`, shape (3,).

    Sizes are counted from a least one on, which counts as 1.
    """
    totals = np.zeros(3)
    for _ in range(draws):
        is_exit = (rotated(steps, rng) & np.uint32(1)).astype(bool)
        turns = np.flatnonzero(is_exit[1:] != is_exit[:-1])
        lengths = np.diff(turns)  # of runs of exits and of entries by turns
        size = lengths[0 if len(turns) and is_exit[turns[0] + 1] else 1 :: 2] - (least - 1)
        size = size[size > 0]
        totals += len(size), size.sum(), size @ size
    return totals
