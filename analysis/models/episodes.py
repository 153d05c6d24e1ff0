"""Episodes: how often, how large and how regular they are.

The magnitude of an episode is M = log10 |moment|, of which `models.magnitudes` has the law. The sums of runs add over
the runs of a system, and every estimate is a function of sums over systems. All quantities are dimensionless.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.estimates import Statistic, Undefined, ratio


@dataclass(frozen=True)
class Catalogue:
    """Episodes of one run that began on [t_start, t_stop], in order of time.

    Attributes
    ----------
    start, duration, moment : ndarray, shape (m,)
        moment is never zero; it is negative where blocks slip on the whole with the belt, as forces can make them do.
    size : ndarray of int, shape (m,)
    slip : float
        Total slip of all blocks if they slipped as far as the belt travels, n |v| (t_stop - t_start); NaN if v is
        zero or differs between blocks.
    moving : float
        The time in which some block slips, also in episodes that begin before t_start, or do not end.
    carried : ndarray, shape (m,), optional
        How far the belt has carried the blocks when each episode begins, summed over the blocks: their z along its
        motion. Unless given it is not known.
    is_loaded : bool
        Whether loading is adiabatic: durations are then by the clock of the motion, and take no time of the run.
    """

    t_start: float
    t_stop: float
    start: np.ndarray
    duration: np.ndarray
    size: np.ndarray
    moment: np.ndarray
    slip: float
    moving: float = np.nan
    carried: np.ndarray | None = None
    is_loaded: bool = False

    @property
    def travel(self) -> float:
        """The part of `slip` between the begins of the first and the last episode; 0 if these are one, or none."""
        return self.slip * float(np.ptp(self.start)) / (self.t_stop - self.t_start) if len(self.start) else 0.0

    @property
    def slipped(self) -> float:
        """The moments of the episodes but the last, which are the slip in episodes in that time."""
        return float(self.moment[:-1].sum())

    @property
    def stored(self) -> float:
        """What the belt carried the blocks on in that time, which is strain of the springs; NaN if not known."""
        if self.carried is None:
            return np.nan
        return float(self.carried[-1] - self.carried[0]) if len(self.carried) else 0.0

    @property
    def magnitude(self) -> np.ndarray:
        """log10 |moment|, shape (m,)."""
        return np.log10(np.abs(self.moment))

    def halves(self) -> np.ndarray:
        """Number of episodes that begin in the first half and in the second, shape (2,)."""
        is_late = self.start >= 0.5 * (self.t_start + self.t_stop)
        return np.bincount(is_late.astype(np.int64), minlength=2).astype(np.float64)


# ---------------------------------------------------------------------------------------------- quantities


@dataclass(frozen=True)
class Quantity:
    """A statistic of episodes: two sums of a run, from its catalogue, and their statistic."""

    sums: Callable[[Catalogue], tuple[float, float]]
    of: Statistic = ratio


RATE, SLIP = "rate of episodes", "share of slip in episodes"
STORED, CREEP = "share of stored strain", "share of creep"
SIZE, DURATION = "mean size", "mean duration"
OCCUPANCY, BY_WAY = "share of time in episodes", "episodes by block and way"


#: By name.
QUANTITIES: Mapping[str, Quantity] = {
    RATE: Quantity(lambda run: (float(len(run.start)), run.t_stop - run.t_start)),
    SIZE: Quantity(lambda run: (float(run.size.sum()), float(len(run.start)))),
    DURATION: Quantity(lambda run: (float(run.duration.sum()), float(len(run.start)))),
    SLIP: Quantity(lambda run: (run.slipped, run.travel)),
}
#: Where the rest of the belt's travel went, which with `SLIP` is all of it: the belt carried the blocks on, which is
#: strain of the springs, or they crept while all counted as stuck, as they cannot by the exact law.
REST: Mapping[str, Quantity] = {
    STORED: Quantity(lambda run: (run.stored, run.travel)),
    CREEP: Quantity(lambda run: (run.travel - run.slipped - run.stored, run.travel)),
}
#: Quantities that show whether the drive is slow for the chain: episodes then fill little of the time, and their
#: number is proportional to the belt's travel.
SLOW_DRIVE: Mapping[str, Quantity] = {
    OCCUPANCY: Quantity(lambda run: (run.moving, run.t_stop - run.t_start)),
    BY_WAY: Quantity(lambda run: (float(len(run.start)), run.slip)),
}


def rise_of_rate(sums: np.ndarray) -> np.ndarray:
    """Number of episodes in the second half over that in the first, minus 1, from sums of `Catalogue.halves`."""
    if (sums[:, 0] == 0).any():
        raise Undefined("no episode in the first half")
    return sums[:, 1] / sums[:, 0] - 1.0
