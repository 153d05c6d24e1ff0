"""What a run gives to its group: its fate, its last change of n_stick, and the sums of its motion after t_burn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.models.counting import lulls
from stickslip.analysis.models.fates import FAILED, MOVING, fates
from stickslip.analysis.series.runs import Ended, Runs, no_series
from stickslip.analysis.series.windows import NoSeries, Windows, in_parts, windows
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
    fates : ndarray of str, shape (R,)
        From `models.fates.fates`.
    last : ndarray, shape (R, 2)
        Time of the last change of n_stick, and n_stick from then on; NaN if a run failed.
    sums : ndarray, shape (R, C)
        `COLUMNS` over the window of a run in motion; 0 for others.
    sizes : ndarray of int, shape (S, 3)
        Run, size and number of its complete cascades of that size, by the definition `events`.
    """

    fates: np.ndarray
    last: np.ndarray
    sums: np.ndarray
    sizes: np.ndarray

    def in_order(self, order: np.ndarray) -> Motion:
        """All runs in another order, `sizes` too; `order` holds their places."""
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        sizes = np.column_stack([place[self.sizes[:, 0]], self.sizes[:, 1:]])
        sizes = sizes[np.argsort(sizes[:, 0], kind="stable")]
        return Motion(self.fates[order], self.last[order], self.sums[order], sizes)

    def part(self, first: int, end: int) -> Motion:
        """Neighbouring runs of which `sizes` is in their order, as `in_order` leaves it."""
        at, to = np.searchsorted(self.sizes[:, 0], (first, end))
        sizes = self.sizes[at:to] - np.array([first, 0, 0])
        return Motion(self.fates[first:end], self.last[first:end], self.sums[first:end], sizes)


def joined(parts: Sequence[Motion]) -> Motion:
    """The runs of several, one after the other."""
    first = np.cumsum([0, *(len(one.fates) for one in parts)])
    sizes = [one.sizes + np.array([k, 0, 0]) for k, one in zip(first.tolist(), parts, strict=False)]
    return Motion(
        np.concatenate([np.zeros(0, object), *(one.fates for one in parts)]),
        np.concatenate([np.zeros((0, 2)), *(one.last for one in parts)]),
        np.concatenate([np.zeros((0, N_COLUMNS)), *(one.sums for one in parts)]),
        np.concatenate([np.zeros((0, 3), np.int64), *sizes]),
    )


def motion(runs: Runs, some: Ended, is_brief: bool = False) -> Motion:
    """What some runs give; each is read once.

    In brief, `sums` are those of quantities other than the correlation time, and of means; the rest, which takes most
    of the time, is 0.

    Raises
    ------
    ValueError
        If a member that did not fail has no change points, or they are not a series; the error names the member.
    """
    last, sums = np.full((len(some), 2), np.nan), np.zeros((len(some), N_COLUMNS))
    fates_of = np.full(len(some), FAILED, dtype=object)
    sizes = [np.zeros((0, 3), dtype=np.int64)]
    ran = np.flatnonzero(some.outcome != FAILED)
    done = 0
    for stack in in_parts(runs.stacks(some.member_id[ran].tolist()), _RUNS, _POINTS):
        places = ran[done : done + len(stack)]
        own = some.take(places)
        last[places] = np.column_stack(stack.last)
        fates_of[places] = fates(own.outcome, *stack.last, own.t_end, own.growth_rate)
        moves = np.flatnonzero(np.isin(fates_of[places], MOVING))
        if len(moves):
            try:
                found = windows(stack.take(moves), runs.t_burn, own.t_end[moves])
            except NoSeries as error:
                raise no_series(own.member_id[moves[error.place]], error) from error
            sums[places[moves]] = _sums(found, is_brief)
            sizes.append(_sizes(found, places[moves]))
        done += len(stack)
    return Motion(fates_of, last, sums, np.concatenate(sizes))


def _sizes(runs: Windows, names: np.ndarray) -> np.ndarray:
    """`Motion.sizes` of some runs, by their numbers."""
    run, depth = runs.falls
    width = int(depth.max(initial=0)) + 1
    n_times = np.bincount(run * width + depth, minlength=len(runs) * width)
    found = np.flatnonzero(n_times)
    return np.column_stack([names[found // width], found % width, n_times[found]])


def _sums(runs: Windows, is_brief: bool) -> np.ndarray:
    """`COLUMNS` of each run, shape (R, C)."""
    found = np.zeros((len(runs), N_COLUMNS))
    for name, quantity in QUANTITIES.items():
        if not (is_brief and name == "correlation_time"):
            found[:, COLUMNS[name]] = quantity.sums(runs)
    halves = enough.halves(runs)
    found[:, COLUMNS["means"]] = np.column_stack([runs.mean, halves, np.ones(len(runs))])
    if is_brief:
        return found
    tau = found[:, COLUMNS["correlation_time"]][:, 0]
    stuck = np.column_stack([halves[:, :2].mean(axis=1) * runs.span, runs.span - runs.total(lulls(runs))])
    found[:, COLUMNS["stuck"]], found[:, COLUMNS["effective"]] = stuck, effective.rows(runs, tau)
    found[:, COLUMNS["short"]] = ((tau == 0) | effective.is_short(runs, tau))[:, None]
    return found
