"""Episodes: from all blocks stuck to all stuck again.

The quakes of a chain of blocks on a belt that drags them: R. Burridge and L. Knopoff, Bull. Seismol. Soc. Am. 57
(1967) 341-371. While all blocks stick they ride the belt: the change of z from one such interval to the next, less
the travel of the belt, is the slip of the episode between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Run
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.drive import Piecewise, belt


@dataclass(frozen=True, eq=False)
class Episodes:
    """The episodes of a run in order of time (dimensionless), without those cut off by its start or end.

    Attributes
    ----------
    start, end : float64, shape (m,)
        When the first block leaves, and when the last one sticks again.
    size : int32, shape (m,)
        Number of blocks that slipped.
    moment : float64, shape (m,)
        Sum over the blocks of the slip of each on its belt, positive against the mean motion of the belts: negative
        where blocks get ahead of them; slips on belts with opposite motion cancel. On belts at rest it keeps its
        sign.
    first_block : int32, shape (m,)
        The block that left first; of several at one instant the one with the lowest number.
    z_sum : float64, shape (m,)
        Sum of z over the blocks when it begins. From the begin of one episode to that of another the belts' travel is
        the change of this sum, the moments, and creep: what blocks slip while all count as stuck.
    elapsed : float64, shape (m,), or None
        Durations under adiabatic loading, where `start` and `end` are one time of the belt; else None.
    """

    start: Floats
    end: Floats
    size: NDArray[np.int32]
    moment: Floats
    first_block: NDArray[np.int32]
    z_sum: Floats
    elapsed: Floats | None = None

    @property
    def duration(self) -> Floats:
        """Durations, shape (m,)."""
        return self.end - self.start if self.elapsed is None else self.elapsed

    def __len__(self) -> int:
        return len(self.start)

    def __repr__(self) -> str:
        return f"Episodes({len(self)} of up to {self.size.max(initial=0)} blocks)"


def spans(series: EventSeries) -> Floats:
    """Start and end of every episode, shape (m, 2): when the first block leaves, and when the last sticks again."""
    since, until = _stills(series)
    return np.column_stack([until[:-1], since[1:]])


def episodes(run: Run, belt_speed: ArrayLike | Piecewise) -> Episodes:
    """The episodes of a run of an engine that keeps `Run.stills`.

    Parameters
    ----------
    run : Run
    belt_speed : float, array_like, shape (n,), or Piecewise
        v, as of the `System`.

    Raises
    ------
    TypeError, ValueError
        If the speeds are not those of belts of this run, or the run does not know its `stills`.
    """
    series, stills = run.events, run.stills
    if run.loaded is not None:
        t, elapsed, size, moment, first_block, z_sum = run.loaded
        return Episodes(t, t, size, moment, first_block, z_sum, elapsed)
    if stills is None:
        raise ValueError("run: expected one of an engine that keeps `stills`, on which moments hang, got None")
    since, until = _stills(series)
    first, last = np.searchsorted(stills.t, since), np.searchsorted(stills.t, until, side="right") - 1
    rests = first <= last  # else blocks stick so briefly that these are no events
    since, until, first, last = since[rests], until[rests], first[rests], last[rests]
    start, end = until[:-1], since[1:]
    before, after = last[:-1], first[1:]
    moved = _travel(belt(belt_speed, series.n), series.n, stills.t[before], stills.t[after])
    slip = stills.total[after] - stills.total[before] - moved
    slips = np.flatnonzero(series.mode != 0)
    leaves = slips[np.searchsorted(series.t[slips], start)]
    moment = np.where(moved > 0, -slip, slip)
    return Episodes(start, end, _sizes(series, start, end), moment, series.block[leaves], stills.total[before])


def _travel(belt_speed: float | Floats | Piecewise, n: int, since: Floats, until: Floats) -> Floats:
    """The sum of the travels of n belts between two times."""
    if isinstance(belt_speed, Piecewise):
        return np.asarray((belt_speed.integral(until) - belt_speed.integral(since)).sum(axis=-1))
    return np.broadcast_to(belt_speed, n).sum() * (until - since)


def _stills(series: EventSeries) -> tuple[Floats, Floats]:
    """Starts and ends of the all-stuck intervals."""
    t, n_stick = series.change_points()
    is_still = n_stick == series.n
    return t[is_still], np.append(t[1:], series.t_end)[is_still]


def _sizes(series: EventSeries, start: Floats, end: Floats) -> NDArray[np.int32]:
    """How many blocks slip in each of these spans, which do not overlap."""
    slips = series.mode != 0
    t, block = series.t[slips], series.block[slips]
    span = np.searchsorted(start, t, side="right") - 1
    inside = (span >= 0) & (t < np.append(end, np.inf)[span])
    pairs = np.unique(span[inside] * series.n + block[inside])
    return np.bincount(pairs // series.n, minlength=len(start)).astype(np.int32)
