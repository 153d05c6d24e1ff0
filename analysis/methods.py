"""Methods compared: each setting of the same systems with the finest, by statistics and by whole laws."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stickslip.analysis.answer import Row, named
from stickslip.analysis.catalogues import Catalogues
from stickslip.analysis.contrast import Contrast, Statistic, contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Comparison, Family
from stickslip.analysis.models.episodes import DURATION, QUANTITIES, QUIET, RATE, SIZE, SLIP, Catalogue
from stickslip.analysis.models.laws import Difference, difference_of_order, distance_of_shares, largest_gap
from stickslip.analysis.outcomes import Setting
from stickslip.analysis.stats.estimates import Undefined
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
#: Statistics by which methods are compared, by name; their differences are relative.
STATISTICS: Mapping[str, Statistic] = {
    name: Statistic(name, QUANTITIES[name].of) for name in (RATE, SIZE, DURATION, QUIET, SLIP)
}
PRIMARY = (RATE, MAGNITUDES)  # how often and how large: tested before the others


@dataclass(frozen=True)
class Apart:
    """How far a statistic or a law of one setting lies from that of the finest of the same systems.

    Attributes
    ----------
    setting, reference : Catalogues
    name : str
        One of `STATISTICS` or `LAWS`.
    found : Contrast, laws.Difference or str
        Of a statistic; of a law, or why there is none.
    family : Family, optional
        The comparisons that it is judged together with, if it is tested: the primary ones, or the others.
    """

    setting: Catalogues
    reference: Catalogues
    name: str
    found: Contrast | Difference | str
    family: Family | None = None

    @property
    def p(self) -> float | None:
        """The p-value of no difference, alone."""
        return None if isinstance(self.found, str) else self.found.p_different

    @property
    def p_floor(self) -> float:
        """The least p-value that it can have."""
        return self.found.p_floor if isinstance(self.found, Difference) else 0.0

    @property
    def is_shown(self) -> bool:
        """Whether a difference is shown, among all comparisons of its family."""
        return self.family is not None and self.family.p_different < self.family.alpha

    def comparison(self) -> Comparison:
        """A statistic beside that of the reference, for a finding."""
        assert isinstance(self.found, Contrast)
        return Comparison(called(self.reference), replace(self.found, family=self.family).difference)

    def row(self) -> Row:
        """As columns."""
        row: Row = {"setting": self.setting.label, "reference": self.reference.label}
        if isinstance(self.found, Contrast):
            return row | replace(self.found, family=self.family).row()
        row |= {"law": self.name, "p_different_holm": self.family and self.family.p_different}
        if isinstance(self.found, str):
            return row | {"reason": self.found}
        of = {name: getattr(self.found, name) for name in ("at", "below", "p_floor", "p_different")}
        return row | named("size", self.found.size) | of


def compare(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Apart]:
    """Every setting beside the first of the same systems, by statistics and by whole laws."""
    level = study.settings.confidence
    alone = [
        apart
        for reference, *others in by_system if reference.is_judged
        for other in others
        for apart in (
            *(Apart(other, reference, name, contrast(one, reference.sample, other.sample, True, level))
              for name, one in STATISTICS.items()),
            *(Apart(other, reference, name, _law(study, reference, other, name)) for name in LAWS),
        )
    ]  # fmt: skip
    for is_primary in (True, False):
        tested = [k for k, one in enumerate(alone) if one.p is not None and (one.name in PRIMARY) is is_primary]
        able = [
            k for k in tested if alone[k].p_floor * len(tested) < 1 - level
        ]  # few systems: a test can show nothing
        for k, p in zip(able, holm([alone[k].p or 0.0 for k in able]).tolist(), strict=True):
            alone[k] = replace(alone[k], family=Family(len(able), p, alpha=1 - level))
    return alone


def _law(study: Study, first: Catalogues, second: Catalogues, name: str) -> Difference | str:
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
        return law.difference(pairs, study.settings.confidence, study.generator(f"{name} {second.label}"))
    except Undefined as why:
        return str(why)


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


def settings_of(groups: Sequence[Catalogues]) -> list[Setting]:
    """Methods by engine and the number that it is set by, so that ranges of it can be named."""
    methods = [str(group.row["method"]) for group in groups]
    parts = [_SETTING.fullmatch(method) for method in methods]
    is_one = len({part[4] for part in parts if part}) < 2  # what all settings share tells nothing
    return [
        Setting(part[1] + part[4] * (not is_one), part[2], float(part[3])) if part else Setting(method)
        for part, method in zip(parts, methods, strict=True)
    ]


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
