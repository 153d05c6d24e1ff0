"""Contrasts: how far two groups of runs differ in each statistic, paired where they share their random systems.

Every statistic is a function of two sums over each unit, so one estimator serves all of them. A difference is
relative to the first group, except that shares of runs are subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from stickslip.analysis.answer import F, I, Row, S, named
from stickslip.analysis.groups import Group
from stickslip.analysis.models.fates import DIVERGED, FAILED, is_all_slip
from stickslip.analysis.models.times import Times, median_difference
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.compare import (
    ALIKE,
    UNKNOWN,
    Compared,
    Inverted,
    Words,
    bounded_difference,
    bounded_ratio,
    equivalence_test,
    mean_difference,
    mean_within,
    relative_difference,
    verdict,
)
from stickslip.analysis.stats.enough import FEW_MATRICES, LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.quantities import QUANTITIES

SHORT_WINDOW = "short window"  # a reason, like those of `stats.enough` and of the estimates
#: Margin of shares of runs, for which a scene declares none: one run in five, which twenty matrices can resolve.
SHARE_MARGIN = 0.2
#: Engines certify a collapse more or less often, so runs are compared by what is seen in all of them: whether a block
#: sticks in the last quarter.
ALL_SLIP, RUN_AWAY = "share of runs with no late stick", "share of runs that run away"
#: Columns of a table of contrasts.
SCHEMA: Mapping[str, str] = {
    "quantity": S, "n_first": I, "n_second": I,
    **{f"{name}{end}": F for name in ("first", "second", "difference", "relative") for end in ("", "_low", "_high")},
    "margin": F, "p_equivalent": F, "p_different": F, "p_equivalent_holm": F, "p_different_holm": F, "verdict": S,
    "reason": S,
}  # fmt: skip


@dataclass(frozen=True)
class Statistic:
    """A statistic: its name, how it follows from two sums, its margin, and what it is never below."""

    name: str
    of: estimates.Statistic
    margin: float
    least: float | None = None
    most: float | None = None
    is_share: ClassVar[bool] = False

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        """Its value on some units, with an interval over these."""
        return within(over_matrices(self.of, sums.rows, confidence), self.least, self.most)

    def difference(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        """By how much it is larger on the second; raises `Undefined` with a reason."""
        return equivalence_test(*mean_difference(self.of, first.rows, second.rows, paired), self.margin)

    def relative(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        """That, in units of the size of the first; raises `Undefined` with a reason."""
        return equivalence_test(*relative_difference(self.of, first.rows, second.rows, paired), self.margin)


@dataclass(frozen=True)
class Bounded(Statistic):
    """The mean of what lies between 0 and `most`, as a share of blocks or of time; intervals as of shares."""

    most: float = 1.0
    is_counted: ClassVar[bool] = False

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return mean_within(sums.rows, self.most, confidence, self.is_counted)

    def difference(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        return bounded_difference(first.rows, second.rows, paired, self.margin, self.most, self.is_counted)

    def relative(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        return bounded_ratio(first.rows, second.rows, paired, self.margin, self.most)


@dataclass(frozen=True)
class Share(Bounded):
    """A share of runs, by its runs and all runs of each unit; its differences are in points, relative ones too."""

    name: str
    of: estimates.Statistic = ratio
    margin: float = SHARE_MARGIN
    is_share: ClassVar[bool] = True
    is_counted: ClassVar[bool] = True
    relative = Bounded.difference


@dataclass(frozen=True)
class PerEvent(Statistic):
    """Time per event, by the events per unit of time of each unit, and 1.

    Its interval is the inverse of that of the rate, both on a logarithmic scale: few events leave it positive.
    """

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        found = over_matrices(lambda rows: np.log(self.of(rows)), sums.rows, confidence)
        value, low, high = (
            end if end is None else float(np.exp(end)) for end in (found.value, found.low, found.high)
        )
        return Estimate(value, low, high, found.reason)


@dataclass(frozen=True)
class Median(Statistic):
    """The median of a time that the end of a run may cut off; its sums are `models.times.Times`."""

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return sums.median(confidence) if isinstance(sums, Times) else super().estimate(sums, confidence)

    def difference(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared:
        return self._difference(first, second, paired, is_relative=False)

    def relative(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared:
        return self._difference(first, second, paired, is_relative=True)

    def _difference(self, first: UnitSums, second: UnitSums, paired: bool, is_relative: bool) -> Compared:
        assert isinstance(first, Times)
        assert isinstance(second, Times)
        return equivalence_test(*median_difference(first, second, paired, is_relative), self.margin)


@dataclass(frozen=True)
class Sample:
    """The sums of one group, from which its statistics follow.

    Attributes
    ----------
    sums : dict of str to UnitSums
        By statistic. Only runs that reached t_end enter. Shares are the exception: there all runs of a unit that
        did not fail enter.
    unjudged : set of str
        Statistics for which most windows are too short.
    """

    sums: dict[str, UnitSums] = field(default_factory=dict)
    unjudged: set[str] = field(default_factory=set)

    def of(self, name: str) -> UnitSums:
        """The sums of a statistic, without units in which nothing was counted."""
        return self.sums.get(name, UnitSums()).counted


def statistics(margins: Mapping[str, float], of: Collection[str] = tuple(QUANTITIES)) -> list[Statistic]:
    """The named quantities for which a margin is declared, as statistics."""
    return [
        Statistic(one.label, one.of, margins[name], least=0.0)
        for name, one in QUANTITIES.items()
        if name in {*of} & {*margins}
    ]


def shares() -> list[Statistic]:
    """Shares of runs by how they ended."""
    return [Share(name) for name in (ALL_SLIP, RUN_AWAY)]


def sample(group: Group, of: Collection[str] | None = None) -> Sample:
    """The sums of the runs of a filled group, of all statistics or of those that are named."""
    made: dict[str, Callable[[], UnitSums]] = {name: partial(_share_of, group, name) for name in (ALL_SLIP, RUN_AWAY)}
    made |= {one.label: partial(group.sums, name) for name, one in QUANTITIES.items()}
    found = Sample({name: make() for name, make in made.items() if of is None or name in of})
    if 2 * group.n_short > group.n_runs:
        found.unjudged.add(QUANTITIES["correlation_time"].label)
    return found


def _share_of(group: Group, name: str) -> UnitSums:
    """Runs of each unit that ran away, or in which no block sticks late, and those that did not fail."""
    fates, (t_last, n_last) = group.fates, group.last.T
    ran = np.flatnonzero(fates != FAILED)
    has = fates[ran] == DIVERGED
    if name == ALL_SLIP:
        has = ~has & is_all_slip(t_last[ran], n_last[ran], float(group.key["t_end"]))
    return UnitSums.of(group.column("unit").to_numpy()[ran], np.column_stack([has, np.ones(len(has))]))


def contrast(one: Statistic, first: Sample, second: Sample, paired: bool, confidence: float) -> Row:
    """How far the second group differs from the first in one statistic, not judged yet.

    Paired contrasts use the units that both groups have.
    """
    mine, theirs = first.of(one.name), second.of(one.name)
    if paired:
        mine, theirs = mine.within(theirs), theirs.within(mine)
    row: Row = dict.fromkeys((*SCHEMA, "narrow_low", "narrow_high", "p_absolute")) | {
        "quantity": one.name, "n_first": len(mine), "n_second": len(theirs), "margin": one.margin,
        "is_share": one.is_share, "verdict": UNKNOWN,
    }  # fmt: skip
    is_unjudged = one.name in first.unjudged | second.unjudged
    if is_unjudged and not (
        paired and np.array_equal(mine.rows, theirs.rows)
    ):  # the same numbers are the same, whatever they mean
        return row | {"reason": SHORT_WINDOW}
    if min(len(mine), len(theirs)) < LEAST_MATRICES:
        return row | {"reason": FEW_MATRICES}
    before, after = (one.estimate(sums, confidence) for sums in (mine, theirs))
    row |= named("first", before) | named("second", after)
    if before.value is None or after.value is None:
        return row | {"reason": before.reason or after.reason}
    try:
        absolute = one.difference(mine, theirs, paired)
        row |= named("difference", _interval(absolute, confidence))
        row["p_absolute"] = absolute.p_different
        test = one.relative(mine, theirs, paired)
    except Undefined as why:
        return row | {"reason": str(why)}
    narrow = _interval(test, 2 * confidence - 1)
    return (
        row
        | named("relative", _interval(test, confidence))
        # within the margins just when equivalence is shown
        | {"narrow_low": narrow.low, "narrow_high": narrow.high}
        | {"p_equivalent": test.p_equivalent, "p_different": test.p_different}
    )


def _interval(test: Compared | Inverted, confidence: float) -> Estimate:
    return Estimate(test.difference, *test.interval(confidence))


def judge(rows: Sequence[Row], alpha: float, words: Words = ALIKE) -> None:
    """Write verdicts into the contrasts that were tested.

    The p-values of equivalence and those of a difference are each adjusted by Holm's rule over all `n_tests`.
    `relative` is compared with the margin. `open` is the word of a difference that is shown, but neither to be beyond
    the margin nor within; else empty.
    """
    for row in rows:
        row["open"] = ""
    tested = [row for row in rows if row["p_equivalent"] is not None]
    for name in ("p_equivalent", "p_different"):
        for row, adjusted in zip(tested, holm([row[name] for row in tested]), strict=True):
            row[f"{name}_holm"] = float(adjusted)
    for row in tested:
        p_values = row["p_equivalent_holm"], row["p_different_holm"]
        size = np.copysign(np.inf, row["difference"]) if row["relative"] is None else row["relative"]  # from zero
        row |= {"verdict": verdict(*p_values, alpha, size, row["margin"], words), "n_tests": len(tested)}
        if row["verdict"] == UNKNOWN and row["p_different_holm"] < alpha:
            row["open"] = words.more if size > 0 else words.less


def told(rows: Iterable[Row]) -> list[Row]:
    """The contrasts to report: those with a value, except shares that are 0 in both groups or 1 in both."""
    return [row for row in rows if row["relative"] is not None and not _is_plain(row)]


def _is_plain(row: Row) -> bool:
    return bool(row["is_share"] and row["first"] == row["second"] and row["first"] in (0.0, 1.0))


def weight(row: Mapping[str, Any]) -> float:
    """Size of a difference in units of its margin."""
    return abs(float(row["relative"])) / float(row["margin"])
