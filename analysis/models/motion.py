"""What a run gives to its group: its fate, its last change of n_stick, and the sums of its motion after t_burn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.models.fates import FAILED, MOVING, fates
from stickslip.analysis.series.runs import Ended, Runs, no_series
from stickslip.analysis.series.windows import NoSeries, Windows, in_parts, windows
from stickslip.analysis.stats import effective, enough
from stickslip.analysis.stats.quantities import SUMS

LULL = 20.0  # dimensionless: longer than a period of the slowest block of the paper's systems, about 15
#: Change points and runs that are worked on at once.
POINTS, RUNS = 1 << 17, 1 << 13
#: Columns of `Motion.sums` by name: those of `quantities.SUMS`; n_stick in the two halves of the window, and
#: `early_and_late`; its integral and the time without lulls; and whether the window is too short for a correlation
#: time or has none.
COLUMNS: Mapping[str, int] = {
    name: k for k, name in enumerate((
        *(name for names in SUMS for name in names),
        "first_half", "second_half", "early", "late", "stuck", "active", "short",
    ))
}  # fmt: skip


def lulls(runs: Windows, unit: float = 1.0) -> np.ndarray:
    """Length of each lull at its place among the levels of n_stick, shape (M,), and 0 elsewhere."""
    return np.where((runs.lasted > LULL * unit) & (runs.level == 0), runs.lasted, 0.0)


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
        begin, stop = np.searchsorted(self.sizes[:, 0], (first, end))
        sizes = self.sizes[begin:stop] - np.array([first, 0, 0])
        return Motion(self.fates[first:end], self.last[first:end], self.sums[first:end], sizes)


def joined(parts: Sequence[Motion]) -> Motion:
    """The runs of several, one after the other."""
    firsts = np.cumsum([0, *(len(chunk.fates) for chunk in parts)])
    sizes = [chunk.sizes + np.array([k, 0, 0]) for k, chunk in zip(firsts.tolist(), parts, strict=False)]
    return Motion(
        np.concatenate([np.zeros(0, object), *(chunk.fates for chunk in parts)]),
        np.concatenate([np.zeros((0, 2)), *(chunk.last for chunk in parts)]),
        np.concatenate([np.zeros((0, len(COLUMNS))), *(chunk.sums for chunk in parts)]),
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
    last_changes, sums = np.full((len(some), 2), np.nan), np.zeros((len(some), len(COLUMNS)))
    fates_of = np.full(len(some), FAILED, dtype=object)
    sizes = [np.zeros((0, 3), dtype=np.int64)]
    ran = np.flatnonzero(some.outcome != FAILED)
    n_done = 0
    for stack in in_parts(runs.stacks(some.member_id[ran].tolist()), RUNS, POINTS):
        places = ran[n_done : n_done + len(stack)]
        stack_runs = some.take(places)
        last_changes[places] = np.column_stack(stack.last)
        fates_of[places] = fates(
            stack_runs.outcome, *stack.last, stack_runs.t_end, stack_runs.growth_rate, stack_runs.n
        )
        moves = np.flatnonzero(np.isin(fates_of[places], MOVING))
        if len(moves):
            try:
                stack_windows = windows(stack.take(moves), runs.t_burn, stack_runs.t_end[moves])
            except NoSeries as error:
                raise no_series(stack_runs.member_id[moves[error.place]], error) from error
            sums[places[moves]] = _sums(stack_windows, stack_runs.period[moves], is_brief, runs.unit)
            sizes.append(_sizes(stack_windows, places[moves]))
        n_done += len(stack)
    return Motion(fates_of, last_changes, sums, np.concatenate(sizes))


def _sizes(runs: Windows, names: np.ndarray) -> np.ndarray:
    """`Motion.sizes` of some runs, by their numbers."""
    run, depth = runs.falls
    width = int(depth.max(initial=0)) + 1
    n_times = np.bincount(run * width + depth, minlength=len(runs) * width)
    codes = np.flatnonzero(n_times)
    return np.column_stack([names[codes // width], codes % width, n_times[codes]])


TENTH = 0.1  # of a window: its first part, where the start shows longest


def early_and_late(runs: Windows, period: np.ndarray) -> np.ndarray:
    """Time means of n_stick in the first tenth and in the last half of each window, shape (R, 2).

    `period` as of `enough.over_periods`.
    """
    tenths = runs.means(10)
    means = np.column_stack([tenths[:, 0], tenths[:, 5:].mean(axis=1)])
    return enough.over_periods(runs, period, means, TENTH, np.ceil)


def _sums(runs: Windows, period: np.ndarray, is_brief: bool, unit: float) -> np.ndarray:
    """`COLUMNS` of each run, shape (R, C)."""
    sums = np.zeros((len(runs), len(COLUMNS)))

    def put(names: Sequence[str], columns: np.ndarray) -> None:
        sums[:, [COLUMNS[name] for name in names]] = columns

    for names, function in SUMS.items():
        if not (is_brief and "tau" in names):
            put(names, function(runs))
    put(("first_half", "second_half"), enough.halves(runs, period)[:, :2])
    if is_brief:
        return sums
    put(("early", "late"), early_and_late(runs, period))
    tau = sums[:, COLUMNS["tau"]]
    active = runs.span - runs.total(lulls(runs, unit))
    put(("stuck", "active"), np.column_stack([runs.mean * runs.span, active]))
    put(("short",), ((tau == 0) | effective.is_short(runs, tau))[:, None])
    return sums
