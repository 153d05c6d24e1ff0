"""What a run gives to its group: its fate, its last change of n_stick, and the sums of its motion after t_burn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.models.counting import lulls
from stickslip.analysis.models.fates import FAILED, MOVING, fate
from stickslip.analysis.series.runs import Ended, Runs, no_series
from stickslip.analysis.series.windows import ChangePoints, NoSeries, Windows, windows
from stickslip.analysis.stats import effective, enough
from stickslip.analysis.stats.quantities import QUANTITIES

#: Change points and runs that are worked on at once.
_POINTS, _RUNS = 1 << 19, 1 << 13
_LENGTHS = {**dict.fromkeys(QUANTITIES, 2), "means": 5, "stuck": 2, "effective": 4, "short": 1}


def _columns() -> Iterator[tuple[str, slice]]:
    k = 0
    for name, length in _LENGTHS.items():
        yield name, slice(k, k + length)
        k += length


#: Columns of `Motion.sums`: those of `QUANTITIES`; the time mean, `enough.halves` and 1; the integral of n_stick and
#: the time without lulls; `effective.rows`; and whether the window is too short for a correlation time or has none.
COLUMNS: Mapping[str, slice] = dict(_columns())
N_COLUMNS = sum(_LENGTHS.values())


@dataclass(frozen=True)
class Motion:
    """Some runs, in order, R of them.

    Attributes
    ----------
    fates : list of str
        From `models.fates.fate`.
    last : ndarray, shape (R, 2)
        Time of the last change of n_stick, and n_stick from then on; NaN if a run failed.
    sums : ndarray, shape (R, C)
        `COLUMNS` over the window of a run in motion; 0 for others.
    sizes : ndarray of int, shape (S, 3)
        Run, size and number of its complete cascades of that size, by the definition `events`.
    """

    fates: list[str]
    last: np.ndarray
    sums: np.ndarray
    sizes: np.ndarray

    def in_order(self, order: np.ndarray) -> Motion:
        """All runs in another order, `sizes` too; `order` holds their places."""
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        sizes = np.column_stack([place[self.sizes[:, 0]], self.sizes[:, 1:]])
        sizes = sizes[np.argsort(sizes[:, 0], kind="stable")]
        return Motion([self.fates[k] for k in order], self.last[order], self.sums[order], sizes)

    def part(self, first: int, end: int) -> Motion:
        """Neighbouring runs of which `sizes` is in their order, as `in_order` leaves it."""
        at, to = np.searchsorted(self.sizes[:, 0], (first, end))
        sizes = self.sizes[at:to] - np.array([first, 0, 0])
        return Motion(self.fates[first:end], self.last[first:end], self.sums[first:end], sizes)


def joined(parts: Sequence[Motion]) -> Motion:
    """The runs of several, one after the other."""
    first = np.cumsum([0, *(len(one.fates) for one in parts[:-1])])
    sizes = [one.sizes + np.array([k, 0, 0]) for k, one in zip(first, parts, strict=True)]
    return Motion(
        [how for one in parts for how in one.fates],
        np.concatenate([one.last for one in parts]),
        np.concatenate([one.sums for one in parts]),
        np.concatenate(sizes),
    )


def motion(runs: Runs, some: Sequence[Ended]) -> Motion:
    """What some runs give, at least one; each is read once.

    Raises
    ------
    ValueError
        If a member that did not fail has no change points, or they are not a series; the error names the member.
    """
    found: list[Motion] = []
    read: list[tuple[Ended, ChangePoints | None]] = []
    n_points = 0
    for one in some:
        points = None if one.outcome == FAILED else runs.points(one.member_id)
        read.append((one, points))
        n_points += 0 if points is None else len(points[0])
        if n_points > _POINTS or len(read) == _RUNS:
            found.append(_together(read, runs.t_burn))
            read, n_points = [], 0
    return joined([*found, _together(read, runs.t_burn)] if read else found)


def _together(some: Sequence[tuple[Ended, ChangePoints | None]], t_burn: float) -> Motion:
    fates = [fate(one.outcome, points, one.t_end, one.growth_rate) for one, points in some]
    last = np.array([(np.nan, np.nan) if points is None else (points[0][-1], points[1][-1]) for _, points in some])
    sums = np.zeros((len(some), N_COLUMNS))
    moving = np.array([k for k, how in enumerate(fates) if how in MOVING], dtype=int)
    if not len(moving):
        return Motion(fates, last, sums, np.zeros((0, 3), int))
    in_motion = [
        (one, points) for (one, points), how in zip(some, fates, strict=True) if points is not None and how in MOVING
    ]
    try:
        runs = windows([points for _, points in in_motion], t_burn, [one.t_end for one, _ in in_motion])
    except NoSeries as error:
        raise no_series(in_motion[error.place][0].member_id, error) from error
    sums[moving] = _sums(runs)
    run, depth = runs.falls
    sizes, n_times = np.unique(np.column_stack([moving[run], depth]), axis=0, return_counts=True)
    return Motion(fates, last, sums, np.column_stack([sizes, n_times]))


def _sums(runs: Windows) -> np.ndarray:
    """`COLUMNS` of each run, shape (R, C)."""
    given = {name: quantity.sums(runs) for name, quantity in QUANTITIES.items()}
    tau = given["correlation_time"][:, 0]
    halves = enough.halves(runs)
    stuck = np.column_stack([halves[:, :2].mean(axis=1) * runs.span, runs.span - runs.total(lulls(runs))])
    is_short = (tau == 0) | effective.is_short(runs, tau)
    means = np.column_stack([runs.mean, halves, np.ones(len(runs))])
    return np.column_stack([*given.values(), means, stuck, effective.rows(runs, tau), is_short])
