"""Episodes: from all blocks stuck to all stuck again.

The quakes of a chain of blocks on a belt that drags them: R. Burridge and L. Knopoff, Bull. Seismol. Soc. Am. 57
(1967) 341-371. While all blocks stick they ride the belt, and z - v t is constant: what it changes by from one such
stretch to the next is the slip of the episode between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.run import Run
from stickslip.sim.series import EventSeries


@dataclass(frozen=True, eq=False)
class Episodes:
    """The episodes of a run in order of time (dimensionless); those cut off by its start or end are none.

    Attributes
    ----------
    start, end : float64, shape (m,)
    size : int32, shape (m,)
        Number of blocks that slipped.
    moment : float64, shape (m,)
        Sum over the blocks of what each slipped on the belt, counted against the belt's motion.
    """

    start: Floats
    end: Floats
    size: NDArray[np.int32]
    moment: Floats

    @property
    def duration(self) -> Floats:
        """How long each took, shape (m,)."""
        return self.end - self.start

    def __len__(self) -> int:
        return len(self.start)

    def __repr__(self) -> str:
        return f"Episodes({len(self)} of up to {self.size.max(initial=0)} blocks)"


def spans(series: EventSeries) -> Floats:
    """Start and end of every episode, shape (m, 2): when the first block leaves, and when the last sticks again."""
    t, n_stick = series.change_points()
    is_still = n_stick == series.n
    starts, ends = t[1:][is_still[:-1] & ~is_still[1:]], t[1:][~is_still[:-1] & is_still[1:]]
    ends = ends[ends > starts[0]] if len(starts) else ends[:0]
    return np.column_stack([starts[: len(ends)], ends])


def episodes(run: Run, belt_speed: float) -> Episodes:
    """The episodes of a run with samples.

    Parameters
    ----------
    run : Run
        With samples in each stretch in which all blocks stick before and after an episode, such as at its `spans`:
        to sample at these, run again with ``t_eval=spans(run.events).ravel()``. That changes nothing else.
    belt_speed : float
        v.

    Raises
    ------
    ValueError
        If samples are missing; the message says where.
    """
    series, samples = run.events, run.samples
    start, end = spans(series).T
    still_since = series.change_points()[0]
    before, after = np.searchsorted(samples.t, start, side="right") - 1, np.searchsorted(samples.t, end)
    since = still_since[np.searchsorted(still_since, start) - 1]
    until = np.append(still_since, series.t_end)[np.searchsorted(still_since, end, side="right")]
    t = np.append(samples.t, np.inf)  # what lies beyond the samples
    missing = (before < 0) | (t[before] < since) | (t[after] > until)
    if missing.any():
        k = int(np.flatnonzero(missing)[0])
        raise ValueError(
            f"run: expected a sample while all blocks stick, before and after the episode from {start[k]:g} to"
            f" {end[k]:g}, got none; run again with t_eval=spans(run.events).ravel()"
        )
    on_belt = samples.z.sum(axis=1) - series.n * belt_speed * samples.t
    moment = (on_belt[after] - on_belt[before]) * (-1.0 if belt_speed > 0 else 1.0)
    return Episodes(start, end, _sizes(series, start, end), moment)


def _sizes(series: EventSeries, start: Floats, end: Floats) -> NDArray[np.int32]:
    """How many blocks slip in each of these spans, which do not overlap."""
    slips = series.mode != 0
    t, block = series.t[slips], series.block[slips]
    span = np.searchsorted(start, t, side="right") - 1
    inside = (span >= 0) & (t < np.append(end, np.inf)[span])
    pairs = np.unique(span[inside] * series.n + block[inside])
    return np.bincount(pairs // series.n, minlength=len(start)).astype(np.int32)
