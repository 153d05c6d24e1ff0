"""Contrasts: how far a statistic of some units lies from that of others, paired where they are the same systems.

Every statistic is a function of two sums over each unit, so one estimator serves all of them. A difference is
relative to the first group, except that shares of runs are subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Comparison,
    Course,
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
from stickslip.analysis.models.times import Times, median_difference
from stickslip.analysis.stats import estimates
from stickslip.analysis.stats.compare import (
    Compared,
    Test,
    bounded_difference,
    bounded_ratio,
    mean_difference,
    relative_difference,
)
from stickslip.analysis.stats.enough import FEW_MATRICES, LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.multiplicity import together
from stickslip.analysis.stats.shares import mean_share, mean_within

_NO_VALUE = Estimate()


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
    least : float, optional
        What it is never below.
    title : str
        What it is called in a sentence, a noun phrase without article; empty: its name.
    definition : str
        What it is; empty if the title says it.
    things, dimension : str
        As of `Quantity`.
    """

    name: str
    of: estimates.Statistic
    margin: float | None = None
    least: float | None = None
    title: str = ""
    definition: str = ""
    things: str = ""
    dimension: str = ""
    is_share: ClassVar[bool] = False

    @property
    def quantity(self) -> Quantity:
        """What a finding about it calls it."""
        form = Form.SHARE if self.is_share else Form.NUMBER
        title, said = self.title or self.name, {"things": self.things, "dimension": self.dimension}
        return Quantity(self.name, title, form, definition=self.definition, **said)

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        """Its value on some units, with an interval over these."""
        return within(over_matrices(self.of, sums.rows, confidence), self.least)

    def test(self, first: UnitSums, second: UnitSums, paired: bool, is_relative: bool) -> Test:
        """By how much the second is larger, or that in units of the first's size; may raise `Undefined`."""
        difference = relative_difference if is_relative else mean_difference
        return difference(self.of, first.rows, second.rows, paired)


@dataclass(frozen=True)
class Bounded(Statistic):
    """The mean of what lies between 0 and `most`; intervals as of shares."""

    most: float = 1.0
    is_counted: ClassVar[bool] = False

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return mean_within(sums.rows, self.most, confidence, self.is_counted)

    def test(self, first: UnitSums, second: UnitSums, paired: bool, is_relative: bool) -> Test:
        if is_relative:
            return bounded_ratio(first.rows, second.rows, paired, self.most)
        return bounded_difference(first.rows, second.rows, paired, self.most, self.is_counted)


@dataclass(frozen=True)
class MeanShare(Bounded):
    """The mean of a share of blocks or of time."""

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return mean_share(sums.rows, self.most, confidence)


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
        return over_matrices(lambda rows: np.log(self.of(rows)), sums.rows, confidence).under(np.exp)


@dataclass(frozen=True)
class Median(Statistic):
    """The median of a time that the end of a run may cut off; its sums are `models.times.Times`."""

    def estimate(self, sums: UnitSums, confidence: float) -> Estimate:
        return sums.median(confidence) if isinstance(sums, Times) else super().estimate(sums, confidence)

    def test(self, first: UnitSums, second: UnitSums, paired: bool, is_relative: bool) -> Compared:
        assert isinstance(first, Times)
        assert isinstance(second, Times)
        return median_difference(first, second, paired, is_relative)


@dataclass(frozen=True)
class Contrast:
    """How far the second of two groups of runs lies from the first in a statistic.

    Attributes
    ----------
    n_first, n_second : int
        Units.
    absolute, relative : Estimate
        The second less the first; and in units of the size of the first, where that is not zero within its interval.
    p_different : float, optional
        p-value of the test of no difference.
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
    scale: Scale = Scale.RELATIVE
    is_same: bool = False
    family: Family | None = None
    reason: str = ""

    @property
    def is_known(self) -> bool:
        """Whether it has a value; a share that is 0 in both groups, or 1 in both, tells nothing."""
        values = {self.first.value, self.second.value}
        is_plain = self.statistic.is_share and values in ({0.0}, {1.0})
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

    def level(self, where: Place, other: str, unit: str, is_alone: bool = False) -> Level:
        """The second, where it is, compared with the first; with the value of the first if that `is_alone`."""
        comparison = Comparison(other, self.difference, self.first if is_alone else None)
        return Level(self.statistic.quantity, self.second, where, comparison, self.basis(unit))

    def change(self, keys: tuple[KeyChange, ...], where: Place, unit: str) -> Change:
        """The change from the first to the second along keys that are swept together."""
        ends = self.first, self.second
        return Change(self.statistic.quantity, keys, *ends, self.difference, where, self.basis(unit))

    def basis(self, unit: str) -> Basis:
        return Basis(min(self.n_first, self.n_second), unit)


def contrast(
    statistic: Statistic,
    first: UnitSums,
    second: UnitSums,
    paired: bool,
    confidence: float,
    scale: Scale = Scale.RELATIVE,
    withheld: str = "",
) -> Contrast:
    """How far a statistic of some units lies from that of others, by itself.

    Parameters
    ----------
    first, second : UnitSums
        Units in which nothing was counted are left out; of paired ones, all that not both have.
    scale : Scale
        In which the difference is said if no margin is declared.
    withheld : str
        Why it is not judged, unless both are the same to the last digit: these are the same, whatever they mean.
    """
    reference, changed = first.counted, second.counted
    if paired:
        reference, changed = reference.within(changed), changed.within(reference)
    n_units = min(len(reference), len(changed))
    bare = Contrast(statistic, len(reference), len(changed), scale=scale)
    is_equal = paired and n_units > 0 and np.array_equal(reference.rows, changed.rows)
    if withheld and not is_equal:
        return replace(bare, reason=withheld)
    if n_units == 0:
        return replace(bare, reason=FEW_MATRICES)
    bare = replace(
        bare, first=statistic.estimate(reference, confidence), second=statistic.estimate(changed, confidence)
    )
    if bare.first.value is None or bare.second.value is None:
        return replace(bare, reason=bare.first.reason or bare.second.reason)
    if n_units < LEAST_MATRICES:
        return replace(bare, absolute=Estimate(bare.second.value - bare.first.value), reason=FEW_MATRICES)
    if is_equal and not statistic.is_share:
        return replace(bare, absolute=Estimate(0.0, 0.0, 0.0), relative=Estimate(0.0, 0.0, 0.0), is_same=True)
    try:
        test = statistic.test(reference, changed, paired, is_relative=False)
    except Undefined as why:
        return replace(bare, reason=str(why))
    relative, of_ratio = _relative(bare, reference, changed, paired, confidence)
    has_margin = statistic.margin is not None
    is_relative = of_ratio is not None and (has_margin or scale is Scale.RELATIVE)  # as `Contrast.difference`
    return replace(
        bare,
        absolute=_interval(test, confidence),
        relative=relative,
        p_different=of_ratio.p_different if of_ratio is not None and is_relative else test.p_different,
    )


def _relative(
    bare: Contrast, reference: UnitSums, changed: UnitSums, paired: bool, confidence: float
) -> tuple[Estimate, Test | None]:
    """The difference in units of the first, and its tests; without where there is none.

    There is none of what is zero within its interval, nor of shares of runs. What is not negative falls by all of it
    at most: an interval beyond is one that the first order cannot give.
    """
    first, second = bare.first, bare.second
    is_zero = first.low is not None and first.high is not None and first.low <= 0.0 <= first.high
    if bare.statistic.is_share or is_zero:
        return _NO_VALUE, None
    try:
        test = bare.statistic.test(reference, changed, paired, is_relative=True)
    except Undefined as why:
        return Estimate(reason=str(why)), None
    relative = _interval(test, confidence)
    is_positive = min(first.value or 0.0, second.value or 0.0) >= 0.0
    if is_positive and relative.low is not None and relative.low < -1.0:
        return Estimate(reason="the interval goes below zero"), None
    return relative, test


def _interval(test: Test, confidence: float) -> Estimate:
    return Estimate(test.difference, *test.interval(confidence))


def turns(values: Sequence[float], verdict: Callable[[int, int], Verdict]) -> list[tuple[Course, range, int]]:
    """Where a statistic turns along a key.

    It rises, or falls, until a pair of its values shows the opposite; it turned at the extreme value before. Empty if
    it is consistent with one that rises, or falls, all along.

    Parameters
    ----------
    values : sequence of float
        The estimates along the key.
    verdict : callable
        On the second less the first of two values, by place, with an interval as wide as the number of pairs asks.

    Returns
    -------
    list of (Course, range, int)
        Whether it has a minimum or a maximum; the places of the extreme value, which neighbours may share, as none of
        all runs; and that of the value by which it shows.
    """
    places, begin, course = list[tuple[Course, range, int]](), 0, 0
    for j in range(1, len(values)):
        for i in range(begin, j):
            if course * (values[j] - values[i]) > 0.0:
                continue  # goes on as before
            side = _SIDES.get(verdict(i, j), 0)
            if course * side < 0:
                begin = max(range(begin + 1, j), key=lambda k: course * values[k])
                last = begin
                while last + 1 < j and values[last + 1] == values[begin]:
                    last += 1
                places.append((Course.MAXIMUM if course > 0 else Course.MINIMUM, range(begin, last + 1), j))
                course = side
                break
            course = course or side
    return places


_SIDES = {Verdict.MORE: 1, Verdict.LESS: -1}


def judged(contrasts: Sequence[Contrast], alpha: float) -> list[Contrast]:
    """Contrasts as a family: p-values of a difference are adjusted by Holm's rule over all."""
    p_values = together(contrast.p_different for contrast in contrasts)
    n_tests = sum(p is not None for p in p_values)
    return [
        contrast if p is None else replace(contrast, family=Family(n_tests, p, alpha))
        for contrast, p in zip(contrasts, p_values, strict=True)
    ]
