"""Methods compared: each setting of the same systems with the finest, by statistics and by whole laws."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.answer import Row, named
from stickslip.analysis.catalogues import Catalogues
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Comparison, Family
from stickslip.analysis.findings.finding import Difference as FoundDifference
from stickslip.analysis.models.episodes import DURATION, QUANTITIES, QUIET, RATE, SIZE, SLIP, SLOW_DRIVE, Catalogue
from stickslip.analysis.models.laws import Difference, difference_of_order, distance_of_shares, largest_gap
from stickslip.analysis.stats.compare import equivalence_test, relative_difference
from stickslip.analysis.stats.enough import FEW_MATRICES, LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums
from stickslip.analysis.stats.multiplicity import holm
from stickslip.pipeline.design.labels import Label, Part
from stickslip.pipeline.design.values import text
from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.contract import Engine, Number

#: From which on a number is not shown as a power of ten.
_SMALL = 0.01


@dataclass(frozen=True)
class Compared:
    """A law by which methods are compared.

    Attributes
    ----------
    of : callable
        From the catalogue of a run and the number of blocks to values.
    difference : callable
        Of the values of pairs of runs, one of `models.laws`.
    join : callable
        Joins the values of the runs of one system.
    """

    of: Callable[[Catalogue, int], np.ndarray]
    difference: Callable[[list[tuple[np.ndarray, np.ndarray]], float, np.random.Generator], Difference]
    join: Callable[[list[np.ndarray]], np.ndarray] = np.concatenate


MAGNITUDES = "magnitudes"
LAWS: Mapping[str, Compared] = {
    MAGNITUDES: Compared(lambda run, _: run.magnitude, largest_gap),
    "sizes": Compared(lambda run, _: run.size, largest_gap),
    "quiet times": Compared(lambda run, _: run.quiet, largest_gap),
    "first blocks": Compared(Catalogue.first_blocks, distance_of_shares, lambda runs: np.sum(runs, axis=0)),
    "order in time": Compared(lambda run, _: run.sizes_and_quiets, difference_of_order),
}
STATISTICS = (RATE, SIZE, DURATION, QUIET, SLIP)  # by which methods are compared
PRIMARY = (RATE, MAGNITUDES)  # how often and how large: tested before the others


@dataclass(frozen=True)
class Apart:
    """How far a statistic or a law of one setting lies from that of the finest of the same systems.

    Attributes
    ----------
    setting, reference : Catalogues
    name : str
        One of `STATISTICS` or `LAWS`.
    estimate : Estimate
    p, p_adjusted : float, optional
        Of no difference, alone and in its family by Holm's rule; None if there is no test.
    n_tests : int
        Comparisons of its family: the primary ones are one, the others another.
    law : laws.Difference, optional
    """

    setting: Catalogues
    reference: Catalogues
    name: str
    estimate: Estimate
    p: float | None = None
    p_adjusted: float | None = None
    n_tests: int = 0
    law: Difference | None = None

    def is_shown(self, level: float) -> bool:
        """Whether a difference is shown, among all comparisons of its family."""
        return self.p_adjusted is not None and self.p_adjusted < 1 - level

    def comparison(self) -> Comparison:
        """A statistic beside that of the reference, for a finding."""
        family = Family(self.n_tests, 1.0 if self.p_adjusted is None else self.p_adjusted)
        return Comparison(called(self.reference), FoundDifference(self.estimate, family=family))

    def row(self) -> Row:
        """As columns."""
        row: Row = {"setting": self.setting.label, "reference": self.reference.label}
        row |= {"p_different": self.p, "p_different_holm": self.p_adjusted, "reason": self.estimate.reason or None}
        if self.name not in LAWS:
            return row | {"quantity": self.name} | named("relative", self.estimate)
        of = {name: self.law and getattr(self.law, name) for name in ("at", "below", "p_floor")}
        return row | {"law": self.name} | named("size", self.estimate) | of


def compare(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Apart]:
    """Every setting beside the first of the same systems, by statistics and by whole laws."""
    alone = [
        apart
        for reference, *others in by_system if reference.is_judged
        for other in others
        for apart in (*(_statistic(study, reference, other, name) for name in STATISTICS),
                      *(_law(study, reference, other, name) for name in LAWS))
    ]  # fmt: skip
    for is_primary in (True, False):
        family = [k for k, one in enumerate(alone) if one.p is not None and (one.name in PRIMARY) is is_primary]
        for k, p in zip(family, holm([alone[k].p or 0.0 for k in family]).tolist(), strict=True):
            alone[k] = replace(alone[k], p_adjusted=p, n_tests=len(family))
    return alone


def _statistic(study: Study, first: Catalogues, second: Catalogues, name: str) -> Apart:
    """The relative difference of a statistic on the systems that both ran."""
    a, b = first.sample.of(name), second.sample.of(name)
    change = relative_change(name, a.within(b), b.within(a), True, study.settings.confidence)
    return Apart(second, first, name, *change)


def relative_change(
    name: str, first: UnitSums, second: UnitSums, is_paired: bool, level: float
) -> tuple[Estimate, float | None]:
    """The relative difference of a statistic of episodes, and its p-value."""
    of = {**QUANTITIES, **SLOW_DRIVE}[name].of
    if min(len(first), len(second)) < LEAST_MATRICES:
        return Estimate(reason=FEW_MATRICES), None
    try:
        value, error, dof = relative_difference(of, first.rows, second.rows, is_paired)
    except Undefined as why:
        return Estimate(reason=str(why)), None
    test = equivalence_test(value, error, dof, 0.0)
    return Estimate(value, *test.interval(level)), test.p_different


def _law(study: Study, first: Catalogues, second: Catalogues, name: str) -> Apart:
    """How far a law of two groups lies apart on the systems that both ran."""
    law, n = LAWS[name], int(first.group.key["n"])
    pairs = [
        (
            law.join([law.of(run, n) for run in first.runs[unit]]),
            law.join([law.of(run, n) for run in second.runs[unit]]),
        )
        for unit in sorted(first.runs.keys() & second.runs.keys())
    ]
    try:
        difference = law.difference(pairs, study.settings.confidence, study.generator(f"{name} {second.label}"))
    except Undefined as why:
        return Apart(second, first, name, Estimate(reason=str(why)))
    return Apart(second, first, name, difference.size, difference.p_different, law=difference)


#: A method's name: engine, symbol and value of its setting, and the rest.
_SETTING = re.compile(r"(.*?) (\S+) = ([^\s,]+)(.*)")


def called(reference: Catalogues) -> str:
    """What others are compared with."""
    method = str(reference.row["method"])
    return (
        "exact events"
        if method == ENGINES[reference.group.key["engine"]].title and reference.group.is_exact
        else method
    )


def grouped(chosen: Collection[str], methods: Sequence[tuple[str, str]]) -> list[str]:
    """Names of some methods: "time steps up to h = 0.3" where they are the finest settings of an engine.

    Parameters
    ----------
    chosen : collection of str
        The methods to name.
    methods : sequence of (str, str)
        Engine and method of all that are compared on some systems, from the finest on.
    """
    texts: list[str] = []
    for _, group in itertools.groupby(methods, key=lambda pair: pair[0]):
        every = [method for _, method in group]
        some = [method for method in every if method in chosen]
        parts = [_SETTING.fullmatch(method) for method in every]
        is_row = None not in parts and len({part and part.group(1, 2, 4) for part in parts}) == 1
        if not is_row or len(some) < 2:
            texts += [_SETTING.sub(r"\1 \2 = \3", method) if is_row else method for method in some]
        elif some == every:
            texts.append(_SETTING.sub(r"\1 at every \2", some[0]))
        elif some == every[: len(some)]:
            texts.append(_SETTING.sub(r"\1 up to \2 = \3", some[-1]))
        elif some == every[-len(some) :]:
            texts.append(_SETTING.sub(r"\1 from \2 = \3 on", some[0]))
        else:
            texts += some
    return texts


def names(found: Sequence[Catalogues]) -> list[str]:
    """Names of groups by what distinguishes them: method, place in a sweep and number of blocks."""
    of_one_size = len({one.group.key["n"] for one in found}) == 1
    engines = {ENGINES[one.group.key["engine"]] for one in found}
    shared = {("", engine.title) for engine in engines if engine.is_exact and len(engines) == 1}
    return [_method(one.group.name, ENGINES[one.group.key["engine"]], of_one_size, shared) for one in found]


def _method(label: Label, engine: type[Engine], of_one_size: bool, shared: Collection[Part]) -> str:
    """Name of a method from the label of its group, without what all groups share."""
    numbers = {name: one.symbol for name, one in engine.settings().items() if isinstance(one, Number) and one.symbol}
    words: list[str] = []
    for name, value in label.parts:
        if (name, value) in shared or (name == "n" and of_one_size):
            continue
        said = numbers.get(name, name)
        if name in numbers and words and words[-1] == engine.title:  # one word for both
            said = f"{engine.method} {said}"
            words.pop()
        shown = _power(float(value)) if numbers.get(name) == "\u03b5" else value
        words.append(f"{said} = {shown}".replace("e-0", "e-") if name else value)
    return ", ".join(words) or engine.title


def _power(number: float) -> str:
    """A number, below a hundredth as a power of ten, such as 2.5e-4."""
    if number >= _SMALL:
        return text(number)
    exponent = math.floor(math.log10(number))
    return f"{number / 10.0**exponent:g}e{exponent}"
