"""Methods compared: each setting of the same systems with the finest, by statistics and by the law of magnitudes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from stickslip.analysis.catalogues import Catalogues
from stickslip.analysis.contrast import Contrast, Statistic, contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Comparison, Family, Scale
from stickslip.analysis.members import STEPS, WIDTHS
from stickslip.analysis.models.episodes import DURATION, QUANTITIES, RATE, SIZE, SLIP
from stickslip.analysis.models.largest_gap import Difference, largest_gap
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.steps import Kind, Step, Variant
from stickslip.pipeline.design.labels import Label, Part, engine_name
from stickslip.pipeline.design.labels import apart as labels_apart

MAGNITUDES = "magnitudes"
#: Statistics by which methods are compared, by name; differences of a share are in percentage points.
STATISTICS: Mapping[str, tuple[Statistic, Scale]] = {
    name: (Statistic(name, QUANTITIES[name].of), Scale.ABSOLUTE if name == SLIP else Scale.RELATIVE)
    for name in (RATE, SIZE, DURATION, SLIP)
}
PRIMARY = (RATE, MAGNITUDES)  # how often and how large: tested before the others


@dataclass(frozen=True)
class Apart:
    """How far a statistic or the magnitudes of one setting lie from those of the finest of the same systems.

    Attributes
    ----------
    name : str
        One of `STATISTICS` or `MAGNITUDES`.
    found : Contrast, laws.Difference or str
        Of a statistic; of magnitudes, or why there is none.
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
    def law(self) -> Difference | None:
        """How far two laws lie apart, if they were compared."""
        return self.found if isinstance(self.found, Difference) else None

    @property
    def p_floor(self) -> float:
        """The least p-value that it can have."""
        return 0.0 if self.law is None else self.law.p_floor

    @property
    def is_shown(self) -> bool:
        """Whether a difference is shown, among all comparisons of its family."""
        return self.family is not None and self.family.p_different < self.family.alpha

    @property
    def step(self) -> Step:
        """A statistic beside that of the reference."""
        assert isinstance(self.found, Contrast)
        return Step(Kind.LAW, self.setting.label, self.reference.label, replace(self.found, family=self.family))

    def comparison(self) -> Comparison:
        """A statistic beside that of the reference, for a finding."""
        return Comparison(self.reference.noun, self.step.contrast.difference)


def compare(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Apart]:
    """Every setting beside the first of the same systems."""
    level = study.settings.confidence
    pairs = [
        pair
        for finest, *looser in by_system
        if finest.is_judged
        for setting in looser
        for pair in (
            *(
                Apart(setting, finest, name, contrast(of, finest.sums[name], setting.sums[name], True, level, scale))
                for name, (of, scale) in STATISTICS.items()
            ),
            Apart(setting, finest, MAGNITUDES, _of_magnitudes(study, finest, setting)),
        )
    ]
    for is_primary in (True, False):
        tested = [k for k, pair in enumerate(pairs) if pair.p is not None and (pair.name in PRIMARY) is is_primary]
        able = [
            k for k in tested if pairs[k].p_floor * len(tested) < 1 - level
        ]  # few systems: a test can show nothing
        for k, p in zip(able, holm([pairs[k].p or 0.0 for k in able]).tolist(), strict=True):
            pairs[k] = replace(pairs[k], family=Family(len(able), p, alpha=1 - level))
    return pairs


def _of_magnitudes(study: Study, first: Catalogues, second: Catalogues) -> Difference | str:
    """How far the magnitudes of two groups lie apart on the systems that both ran, or why that is not known."""
    units = sorted(first.runs.keys() & second.runs.keys())
    pairs = [(first.magnitudes_of(unit), second.magnitudes_of(unit)) for unit in units]
    try:
        return largest_gap(pairs, study.settings.confidence, study.generator(f"{MAGNITUDES} {second.label}"))
    except Undefined as why:
        return str(why)


def settings_of(groups: Sequence[Catalogues]) -> list[Variant]:
    """Methods by engine and the number that it is set by, so that ranges of it can be named."""
    shared = set.intersection(*(set(group.method.parts) for group in groups))
    return [_setting(group.method, shared) for group in groups]


def _setting(method: Label, shared: Collection[Part]) -> Variant:
    """A method, without what it shares with all others but its engine and the number that it is set by."""
    numbers = [piece for piece in method.parts if piece[0] in (*WIDTHS, *STEPS)]
    symbols = [piece for piece in method.parts if piece not in numbers and (not piece[0] or piece not in shared)]
    if len(numbers) != 1:
        return Variant(method)
    ((symbol, value),) = numbers
    return Variant(Label.of(symbols), symbol, float(value))


def names(groups: Sequence[Catalogues]) -> list[Label]:
    """Names of groups by what tells them apart; what all share is told by none."""
    return [
        name if name else Label.of([("", engine_name(group.group.key["engine"]))])
        for group, name in zip(groups, labels_apart([group.group.label for group in groups]), strict=True)
    ]
