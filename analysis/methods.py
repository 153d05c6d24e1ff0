"""Methods compared: each setting of the same systems with the finest, by statistics and by the law of magnitudes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from stickslip.analysis.catalogues import Catalogues
from stickslip.analysis.contrast import Contrast, Statistic, contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Family, Scale
from stickslip.analysis.members import STEPS, WIDTHS
from stickslip.analysis.models.episodes import DURATION, QUANTITIES, RATE, SIZE, SLIP
from stickslip.analysis.models.largest_gap import largest_gap
from stickslip.analysis.stats.estimates import Undefined, ratio
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.steps import Kind, Step, Variant
from stickslip.pipeline.design.labels import Label, Part, engine_name
from stickslip.pipeline.design.labels import apart as labels_apart

MAGNITUDES = "magnitudes"
DISTANCE = Statistic(MAGNITUDES, ratio, title="Kolmogorov-Smirnov distance between magnitudes")
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
    contrast : Contrast
        Of magnitudes, `absolute` is the distance. It is judged together with the primary ones, or with the others.
    p_floor : float
        The least p-value that it can have.
    """

    setting: Catalogues
    reference: Catalogues
    contrast: Contrast
    p_floor: float = 0.0

    @property
    def name(self) -> str:
        """One of `STATISTICS` or `MAGNITUDES`."""
        return self.contrast.statistic.name

    @property
    def is_shown(self) -> bool:
        """Whether a difference is shown, among all comparisons of its family."""
        family = self.contrast.family
        return family is not None and family.p_different < family.alpha

    @property
    def step(self) -> Step:
        """A statistic beside that of the reference."""
        return Step(Kind.LAW, self.setting.label, self.reference.label, self.contrast)


def compare(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Apart]:
    """Every setting beside the first of the same systems."""
    level, pairs = study.settings.confidence, list[Apart]()
    for finest, *looser in by_system:
        for setting in looser if finest.is_judged else ():
            for name, (of, scale) in STATISTICS.items():
                difference = contrast(of, finest.sums[name], setting.sums[name], True, level, scale)
                pairs.append(Apart(setting, finest, difference))
            pairs.append(_of_magnitudes(study, finest, setting))
    for is_primary in (True, False):
        ps = {
            k: p
            for k, pair in enumerate(pairs)
            if (p := pair.contrast.p_different) is not None and (pair.name in PRIMARY) is is_primary
        }
        able = [k for k in ps if pairs[k].p_floor * len(ps) < 1 - level]  # few systems: a test can show nothing
        for k, p in zip(able, holm([ps[k] for k in able]).tolist(), strict=True):
            family = Family(len(able), p, alpha=1 - level)
            pairs[k] = replace(pairs[k], contrast=replace(pairs[k].contrast, family=family))
    return pairs


def _of_magnitudes(study: Study, finest: Catalogues, setting: Catalogues) -> Apart:
    """How far the magnitudes of two groups lie apart on the systems that both ran, or why that is not known."""
    units = sorted(finest.runs.keys() & setting.runs.keys())
    values = [(finest.magnitudes_of(unit), setting.magnitudes_of(unit)) for unit in units]
    bare = Contrast(DISTANCE, len(units), len(units), scale=Scale.ABSOLUTE)
    try:
        gap = largest_gap(values, study.settings.confidence, study.generator(f"{MAGNITUDES} {setting.label}"))
    except Undefined as why:
        return Apart(setting, finest, replace(bare, reason=str(why)))
    return Apart(setting, finest, replace(bare, absolute=gap.size, p_different=gap.p_different), gap.p_floor)


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
