"""Contrasts: how far two groups of runs differ in each statistic, paired where they share their random systems.

Every statistic is a function of two sums over each unit, so one estimator serves all of them. A difference is
relative to the first group, except that shares of runs are subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np

from stickslip.analysis.answer import F, I, Row, S, named
from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Comparison,
    Difference,
    Family,
    Form,
    KeyChange,
    Level,
    Quantity,
    Scale,
    Verdict,
)
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.models.fates import DIVERGED, FAILED, is_all_slip
from stickslip.analysis.models.times import Times, median_difference
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.compare import (
    Compared,
    Inverted,
    bounded_difference,
    bounded_ratio,
    equivalence_test,
    mean_difference,
    mean_within,
    relative_difference,
)
from stickslip.analysis.stats.enough import FEW_MATRICES, LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.quantities import QUANTITIES

_NO_VALUE = Estimate()
SHORT_WINDOW = "short window"  # a reason, like those of `stats.enough` and of the estimates
#: Engines certify a collapse more or less often, so runs are compared by what is seen in all of them: whether a block
#: sticks in the last quarter.
ALL_SLIP, RUN_AWAY = "share of runs with no late stick", "share of runs that run away"
#: What findings call `QUANTITIES`.
TITLES: Mapping[str, str] = {
    "mean": "mean number of sticking blocks",
    "variance": "variance of the number of sticking blocks",
    "rate": "rate of slip onsets",
    "gamma": "decay rate of cascade sizes",
    "correlation_time": "correlation time",
}
THINGS: Mapping[str, str] = {"mean": "sticking blocks", "rate": "slip onsets"}  # which some of them count
#: Columns of a table of contrasts.
SCHEMA: Mapping[str, str] = {
    "quantity": S, "n_first": I, "n_second": I,
    **{f"{name}{end}": F for name in ("first", "second", "difference", "relative") for end in ("", "_low", "_high")},
    "margin": F, "p_equivalent": F, "p_different": F, "p_equivalent_holm": F, "p_different_holm": F, "verdict": S,
    "reason": S,
}  # fmt: skip
#: The table of all contrasts of a report: what `kind` of contrast, of which setting with which.
CHANGES: Mapping[str, str] = {
    "kind": S, "setting": S, "reference": S, "key": S, "first_value": S, "second_value": S, **SCHEMA,
}  # fmt: skip


@dataclass(frozen=True)
class Statistic:
    """A statistic of runs.

    Attributes
    ----------
    name : str
        In tables.
    of : callable
        How it follows from two sums.
    margin : float, optional
        The largest relative difference that the scene declares to be none.
    least, most : float, optional
        What it is never below, and never above.
    title : str
        What it is called in a sentence, a noun phrase without article; empty: its name.
    definition : str
        What it is; empty if the title says it.
    things : str
        As of `Quantity`.
    """

    name: str
    of: estimates.Statistic
    margin: float | None = None
    least: float | None = None
    most: float | None = None
    title: str = ""
    definition: str = ""
    things: str = ""
    is_share: ClassVar[bool] = False

    @property
    def quantity(self) -> Quantity:
        """What a finding about it calls it."""
        form = Form.SHARE if self.is_share else Form.NUMBER
        return Quantity(self.name, self.title or self.name, form, definition=self.definition, things=self.things)

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        """Its value on some units, with an interval over these."""
        return within(over_matrices(self.of, sums.rows, confidence), self.least, self.most)

    def difference(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        """By how much it is larger on the second; raises `Undefined` with a reason."""
        return equivalence_test(*mean_difference(self.of, first.rows, second.rows, paired), self.margin or 0.0)

    def relative(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        """That, in units of the size of the first; raises `Undefined` with a reason."""
        return equivalence_test(*relative_difference(self.of, first.rows, second.rows, paired), self.margin or 0.0)


@dataclass(frozen=True)
class Bounded(Statistic):
    """The mean of what lies between 0 and `most`, as a share of blocks or of time; intervals as of shares."""

    most: float = 1.0
    is_counted: ClassVar[bool] = False

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return mean_within(sums.rows, self.most, confidence, self.is_counted)

    def difference(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        return bounded_difference(first.rows, second.rows, paired, self.margin or 0.0, self.most, self.is_counted)

    def relative(self, first: UnitSums, second: UnitSums, paired: bool) -> Compared | Inverted:
        return bounded_ratio(first.rows, second.rows, paired, self.margin or 0.0, self.most)


@dataclass(frozen=True)
class Share(Bounded):
    """A share of runs, by its runs and all runs of each unit; its differences are in percentage points."""

    name: str
    of: estimates.Statistic = ratio
    is_share: ClassVar[bool] = True
    is_counted: ClassVar[bool] = True


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
        return equivalence_test(*median_difference(first, second, paired, is_relative), self.margin or 0.0)


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
    """The named quantities as statistics, each with its margin if one is declared."""
    return [
        Statistic(
            quantity.label,
            quantity.of,
            margins.get(name),
            least=0.0,
            title=TITLES[name],
            things=THINGS.get(name, ""),
        )
        for name, quantity in QUANTITIES.items()
        if name in of
    ]


def shares() -> list[Statistic]:
    """Shares of runs by how they ended."""
    return [
        Share(ALL_SLIP, title="share of runs without a late stick"),
        Share(RUN_AWAY, title="share of runs whose motion grows without limit"),
    ]


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


@dataclass(frozen=True)
class Contrast:
    """How far the second of two groups of runs lies from the first in a statistic.

    Attributes
    ----------
    statistic : Statistic
    n_first, n_second : int
        Units.
    first, second : Estimate
    absolute, relative : Estimate
        The second less the first; and in units of the size of the first, where that is not zero within its interval.
    p_different, p_equivalent : float, optional
        p-values of the test of no difference, and of that of one beyond the margin, if a margin is declared.
    scale : Scale
        In which the difference is said if no margin is declared.
    is_same : bool
        Whether each unit has the same value in both, to the accuracy of its run.
    family : Family, optional
        The contrasts that it is judged together with.
    reason : str
        Why there is no interval of the difference; empty if there is one.
    """

    statistic: Statistic
    n_first: int = 0
    n_second: int = 0
    first: Estimate = _NO_VALUE
    second: Estimate = _NO_VALUE
    absolute: Estimate = _NO_VALUE
    relative: Estimate = _NO_VALUE
    p_different: float | None = None
    p_equivalent: float | None = None
    scale: Scale = Scale.RELATIVE
    is_same: bool = False
    family: Family | None = None
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether it has a value; a share that is 0 in both groups, or 1 in both, tells nothing."""
        is_plain = (
            self.statistic.is_share and self.first.value == self.second.value and self.first.value in (0.0, 1.0)
        )
        return self.absolute.value is not None and not is_plain

    @property
    def difference(self) -> Difference:
        """By its margin if one is declared, else in its scale, as far as there is a ratio."""
        is_relative = self.relative.value is not None and (
            self.statistic.margin is not None or self.scale is Scale.RELATIVE
        )
        if is_relative:
            return Difference(self.relative, Scale.RELATIVE, self.statistic.margin, self.family, self.is_same)
        return Difference(self.absolute, Scale.ABSOLUTE, None, self.family, self.is_same)

    @property
    def verdict(self) -> Verdict:
        return self.difference.verdict

    @property
    def is_shown(self) -> bool:
        """Whether a difference is shown."""
        return self.verdict in (Verdict.MORE, Verdict.LESS)

    @property
    def has_margin(self) -> bool:
        return self.difference.margin is not None

    @property
    def weight(self) -> tuple[bool, float]:
        """Sorts contrasts: differences that are shown come last, and large ones."""
        estimate = self.difference.estimate
        return self.is_shown, 0.0 if self.is_same or estimate.value is None else abs(estimate.value)

    def level(self, where: Place, other: str, unit: str) -> Level:
        """The second, where it is, compared with the first."""
        return Level(
            self.statistic.quantity, self.second, where, Comparison(other, self.difference), self.basis(unit)
        )

    def change(self, keys: tuple[KeyChange, ...], where: Place, unit: str) -> Change:
        """The change from the first to the second along keys that are swept together."""
        return Change(
            self.statistic.quantity, keys, self.first, self.second, self.difference, where,
            self.basis(unit),
        )  # fmt: skip

    def basis(self, unit: str) -> Basis:
        return Basis(min(self.n_first, self.n_second), unit)

    def row(self) -> Row:
        """Its row in a table with the columns of `SCHEMA`."""
        family = self.family
        return {
            "quantity": self.statistic.name, "n_first": self.n_first, "n_second": self.n_second,
            **named("first", self.first), **named("second", self.second), **named("difference", self.absolute),
            **named("relative", self.relative), "margin": self.difference.margin, "p_different": self.p_different,
            "p_equivalent": self.p_equivalent,
            "p_different_holm": None if family is None else family.p_different,
            "p_equivalent_holm": None if family is None or self.p_equivalent is None else family.p_equivalent,
            "verdict": self.verdict.value, "reason": self.reason or None,
        }  # fmt: skip


def contrast(
    statistic: Statistic, first: Sample, second: Sample, paired: bool, confidence: float,
    scale: Scale = Scale.RELATIVE,
) -> Contrast:  # fmt: skip
    """How far the second group differs from the first in a statistic, by itself.

    Paired contrasts use the units that both groups have.
    """
    mine, theirs = first.of(statistic.name), second.of(statistic.name)
    if paired:
        mine, theirs = mine.within(theirs), theirs.within(mine)
    bare = Contrast(statistic, len(mine), len(theirs), scale=scale)
    is_unjudged = statistic.name in first.unjudged | second.unjudged
    if is_unjudged and not (
        paired and np.array_equal(mine.rows, theirs.rows)
    ):  # the same numbers are the same, whatever they mean
        return replace(bare, reason=SHORT_WINDOW)
    if min(len(mine), len(theirs)) == 0:
        return replace(bare, reason=FEW_MATRICES)
    before, after = (statistic.estimate(sums, confidence) for sums in (mine, theirs))
    bare = replace(bare, first=before, second=after)
    if before.value is None or after.value is None:
        return replace(bare, reason=before.reason or after.reason)
    if min(len(mine), len(theirs)) < LEAST_MATRICES:
        return replace(bare, absolute=Estimate(after.value - before.value), reason=FEW_MATRICES)
    if paired and not statistic.is_share and np.array_equal(mine.rows, theirs.rows):
        return replace(bare, absolute=Estimate(0.0, 0.0, 0.0), relative=Estimate(0.0, 0.0, 0.0), is_same=True)
    try:
        test = statistic.difference(mine, theirs, paired)
    except Undefined as why:
        return replace(bare, reason=str(why))
    relative, ratio_test = _relative(statistic, before, after, mine, theirs, paired, confidence)
    has_margin = statistic.margin is not None
    is_relative = ratio_test is not None and (has_margin or scale is Scale.RELATIVE)  # as `Contrast.difference`
    return replace(
        bare, absolute=_interval(test, confidence), relative=relative,
        p_different=ratio_test.p_different if ratio_test is not None and is_relative else test.p_different,
        p_equivalent=ratio_test.p_equivalent if ratio_test is not None and has_margin else None,
    )  # fmt: skip


def _relative(
    statistic: Statistic, before: Estimate, after: Estimate, mine: UnitSums, theirs: UnitSums, paired: bool,
    confidence: float,
) -> tuple[Estimate, Compared | Inverted | None]:  # fmt: skip
    """The difference in units of the first, and its tests; without where there is none.

    There is none of what is zero within its interval, nor of shares of runs. What is not negative falls by all of it
    at most: an interval beyond is one that the first order cannot give.
    """
    assert before.value is not None
    assert after.value is not None
    is_zero = before.low is not None and before.high is not None and before.low <= 0.0 <= before.high
    if statistic.is_share or is_zero:
        return Estimate(), None
    try:
        test = statistic.relative(mine, theirs, paired)
    except Undefined as why:
        return Estimate(reason=str(why)), None
    found = _interval(test, confidence)
    if found.low is not None and found.low < -1.0 and min(before.value, after.value) >= 0.0:
        return Estimate(reason="the interval goes below zero"), None
    return found, test


def _interval(test: Compared | Inverted, confidence: float) -> Estimate:
    return Estimate(test.difference, *test.interval(confidence))


def judged(contrasts: Sequence[Contrast], alpha: float) -> list[Contrast]:
    """Contrasts as a family: p-values of a difference and of equivalence are adjusted by Holm's rule over all."""
    tested = [k for k, one in enumerate(contrasts) if one.p_different is not None]
    with_margin = [k for k in tested if contrasts[k].p_equivalent is not None]
    different = dict(zip(tested, holm([contrasts[k].p_different or 0.0 for k in tested]), strict=True))
    equivalent = dict(zip(with_margin, holm([contrasts[k].p_equivalent or 0.0 for k in with_margin]), strict=True))
    return [
        replace(one, family=Family(len(tested), float(different[k]), float(equivalent.get(k, 1.0)), alpha))
        if k in different
        else one
        for k, one in enumerate(contrasts)
    ]
