"""Whether changed systems keep their statistics: each system beside its changed copy, replicates and others.

Replicates of a system are its base and the copies that differ in the start only and have parted from it by t_burn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from stickslip.analysis.answer import Answer
from stickslip.analysis.contrast import contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Basis, Finding, Form, KeyChange, Level, Quantity, Share
from stickslip.analysis.findings.place import Place, told_apart
from stickslip.analysis.measures import of_windows
from stickslip.analysis.members import noun
from stickslip.analysis.models.fates import DIVERGED, FAILED, MOVING, SETTLED
from stickslip.analysis.models.motion import COLUMNS
from stickslip.analysis.outcomes import forest, outcomes
from stickslip.analysis.pairs import START, Comparison, PairSet, follow, level, settings
from stickslip.analysis.stats import components, enough
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums, non_negative
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.stats.shares import share_over_matrices
from stickslip.analysis.stats.survival import median_of_known
from stickslip.analysis.steps import Kind, Step, Variant, few, judged_together, table_of
from stickslip.pipeline.design import design
from stickslip.pipeline.design.design import DEFAULT_READING, Change
from stickslip.pipeline.design.labels import Label

PRIMARY = ("mean", "rate", "gamma")
SHIFT = Quantity(
    "shift",
    "median absolute shift of the last event",
    clause="in half of the runs the last event shifts by more than {}",
    dimension="time",
)
_METHOD = "Each system is compared with its changed copy."
_METHOD_OF_EFFECTS = (
    " Its mean square change is that between the two, without the scatter between starts; it is relative to the mean"
    " square difference between two systems."
)


def answer(study: Study) -> Answer | None:
    """Effect of each change of constants or of stiffness ratios, by itself and beside that of another system."""
    all_copies = [copies for setting in settings(study.data.table) if (copies := _Copies.of(study, setting)).changes]
    if not all_copies:
        return None
    all_copies.sort(key=lambda copies: (not copies.is_enough, -copies.setting.key["n"]))
    unit, confidence = noun(study.unit), study.settings.confidence
    where = told_apart([copies.label for copies in all_copies])
    unjudged = [step for copies in all_copies for step in _steps(study, copies, where[copies.label])]
    steps = judged_together(unjudged, 1 - confidence)
    lead, further, has_effects = list[Finding](), list[Finding](), False
    for copies in all_copies:
        contrasts = [step for step in steps if step.setting == copies.label and step.contrast.is_known]
        effects = list(_effects(study, copies, where[copies.label], unit))
        has_effects |= bool(effects)
        if judged := [step for step in contrasts if not step.contrast.reason]:
            lead += outcomes("the unchanged systems", judged, unit, "change", where=where[copies.label])
            lead += [effect for quantity, effect in effects if quantity == PRIMARY[0]][-1:]
        further += [step.level("the unchanged system", unit) for step in judged]
        further += [effect for _, effect in effects]
    for finding in (end for copies in all_copies for end in _ends(study, copies, where[copies.label], unit)):
        is_empty = isinstance(finding, Share) and finding.estimate.value == 0.0  # all end alike
        (further if is_empty else lead).append(finding)
    in_figure = [step for step in steps if step.contrast.is_known]
    figures = forest(study, in_figure, "differences from the unchanged systems", "robustness")
    lack = few("the effect of a changed system", study.groups)
    method = _METHOD + _METHOD_OF_EFFECTS * has_effects
    findings = [*lead, *further] if lead else [lack]
    return Answer(findings, len(lead), method=method, tables={"changes": table_of(steps)}, figures=figures)


#: The rows of a system's runs that count: its base, with replicates if asked; and its changed copies.
_Sides: TypeAlias = tuple[list[int], list[int]]


@dataclass(frozen=True)
class _Copies:
    """The runs of one setting: its changes, replicates, and sums of each of `PRIMARY`, by row of the member."""

    setting: PairSet
    changes: list[Comparison]
    replicates: list[Comparison]
    sums: Mapping[int, np.ndarray]

    @classmethod
    def of(cls, study: Study, setting: PairSet) -> _Copies:
        changes = [comparison for comparison in setting.comparisons if comparison.change.kind != START]
        if not changes:
            return cls(setting, [], [], {})
        copies = [pair.changed for comparison in setting.comparisons for pair in comparison.pairs]
        moving = [row for row in (*setting.bases.values(), *copies) if study.motion.fates[row] in MOVING]
        sums = {row: of_run for row in moving if (of_run := _sums(study.motion.sums[row])) is not None}
        return cls(setting, changes, _replicates(study, setting), sums)

    @property
    def label(self) -> Label:
        return self.setting.label

    @property
    def is_enough(self) -> bool:
        """Whether a change has an interval: enough systems stay in motion with it and without."""
        return any(len(self.complete(change)) >= enough.LEAST_MATRICES for change in self.changes)

    def complete(self, change: Comparison, starts: Sequence[Comparison] = ()) -> list[_Sides]:
        """Those of each system whose runs, also from other starts, are all in motion at t_end."""
        sets = [
            ([base, *(row for start in starts for row in start.of(unit))], change.of(unit))
            for unit, base in self.setting.bases.items()
        ]
        moving = [sides for sides in sets if self.sums.keys() >= {*sides[0], *sides[1]}]
        full = [max((len(sides[k]) for sides in moving), default=0) for k in (0, 1)]
        return [sides for sides in moving if [*map(len, sides)] == full and sides[1]]

    def values(self, quantity: str, rows: Sequence[Sequence[int]]) -> np.ndarray:
        """A quantity of some runs, in the shape of `rows`."""
        k, statistic = PRIMARY.index(quantity), QUANTITIES[quantity].of
        return np.array([statistic(np.array([self.sums[row][k] for row in of_unit])) for of_unit in rows])

    def of_units(self, quantity: str, rows: Sequence[Sequence[int]]) -> UnitSums:
        """The sums of a quantity, averaged over the runs of each unit."""
        k = PRIMARY.index(quantity)
        means = [np.mean([self.sums[row][k] for row in of_unit], axis=0) for of_unit in rows]
        return UnitSums(np.arange(len(means)), np.array(means).reshape(-1, 2))


def _replicates(study: Study, setting: PairSet) -> list[Comparison]:
    """The displaced starts for which every run has parted from its base by t_burn."""
    starts = [comparison for comparison in setting.comparisons if comparison.change.kind == START]
    far = level(study, setting) if starts else None
    if far is None:
        return []
    followed = follow(study, starts, far, study.settings.t_burn)
    return [comparison for comparison, pairs in zip(starts, followed, strict=True) if pairs.has_parted.all()]


def _sums(motion: np.ndarray) -> np.ndarray | None:
    """Sums of each of `PRIMARY`, shape (3, 2), from a row of `Motion.sums`; None where one of them has no value."""
    rows = np.array([motion[[COLUMNS[column] for column in QUANTITIES[name].parts]] for name in PRIMARY])
    try:
        for name, row in zip(PRIMARY, rows, strict=True):
            QUANTITIES[name].of(row[None])
    except Undefined:
        return None
    return rows


def _steps(study: Study, copies: _Copies, where: Place) -> Iterator[Step]:
    """Each quantity under each change beside that of the unchanged systems."""
    if not copies.sums:
        return
    for comparison in sorted(copies.changes, key=lambda comparison: comparison.change):
        change, sets = comparison.change, copies.complete(comparison)
        place, keys = where + Place.words(str(change)), (KeyChange("", "", str(change)),)
        for measure in of_windows(study, PRIMARY):
            unchanged, changed = (copies.of_units(measure.key, [rows[side] for rows in sets]) for side in (0, 1))
            difference = contrast(measure.statistic, unchanged, changed, True, study.settings.confidence)
            yield Step(Kind.COPY, copies.label, copies.label, difference, keys, place, _named(change))


def _named(change: Change) -> Variant:
    """A change, with its size."""
    if change.kind == design.Kind.RATIOS:
        return Variant("a draw of other stiffness ratios")
    how = "" if change.reading in (None, DEFAULT_READING) else f" ({change.reading})"
    return Variant("", f"a change of all constants{how}", 100.0 * change.size, "%")


def _effects(study: Study, copies: _Copies, where: Place, unit: str) -> Iterator[tuple[str, Level]]:
    """The mean square effect of each change on each quantity, as a share of that of another system.

    An effect that can be told neither from none nor from another system's is not said.
    """
    bases = [base for base in copies.setting.bases.values() if base in copies.sums]
    if not (bases and copies.replicates):
        return
    confidence, sums = study.settings.confidence, study.motion.sums[bases]
    halves = sums[:, [COLUMNS[name] for name in ("first_half", "second_half", "variance")]]
    if enough.basis(halves, int(sums[:, COLUMNS["cascades"]].sum()), confidence).code not in enough.JUDGED:
        return
    for quantity in PRIMARY:
        for comparison in copies.changes:
            sets = copies.complete(comparison, copies.replicates)
            if len(sets) < enough.LEAST_MATRICES:
                continue
            unchanged, changed = (copies.values(quantity, [rows[side] for rows in sets]) for side in (0, 1))
            effect = non_negative(components.against_redraw(unchanged, changed, confidence).theta)
            if effect.low is not None or (effect.high or np.inf) < 1.0:
                name = f"mean square change of the {QUANTITIES[quantity].title} of a system"
                theta = Quantity("theta", f"{name}, relative to that between two systems", Form.SHARE)
                place, basis = where + Place.words(str(comparison.change)), Basis(len(sets), unit)
                yield quantity, Level(theta, effect, place, None, basis)


class _End(NamedTuple):
    """How a run ended: whether it ran away, and the time of that or of its last event."""

    is_away: bool
    t: float


def _end(study: Study, row: int) -> _End | None:
    """The end of a run; None if it goes on or failed. It ends alike with a certificate or without."""
    fate = str(study.motion.fates[row])
    if fate == DIVERGED:
        return _End(True, float(study.data.table.own["t_stop"].iloc[row]))
    return _End(False, float(study.motion.last[row, 0])) if fate in SETTLED else None


def _ends(study: Study, copies: _Copies, where: Place, unit: str) -> Iterator[Finding]:
    """How many copies of runs that ended end differently, and by how much the last event shifts, for each change."""
    bases = {base: end for base in copies.setting.bases.values() if (end := _end(study, base)) is not None}
    if len(bases) < enough.LEAST_MATRICES:
        return
    confidence = study.settings.confidence
    for comparison in copies.changes:
        ends = [
            (pair.matrix, bases[pair.base], _end(study, pair.changed))
            for pair in comparison.pairs
            if pair.base in bases and study.motion.fates[pair.changed] != FAILED
        ]
        if not ends:
            continue
        units, place = np.array([unit_of for unit_of, *_ in ends]), where + Place.words(str(comparison.change))
        is_alike = np.array([copy is not None and copy.is_away == base.is_away for _, base, copy in ends])
        counts = UnitSums.of(units, np.column_stack([~is_alike, np.ones(len(ends))])).rows
        share = Estimate(*share_over_matrices(counts, confidence)[:3])
        names = "otherwise", "changed copies", "end differently from their original"
        yield Share(*names, share, place, basis=Basis(len(counts), unit), n=len(ends))
        if is_alike.any():
            times = np.array([np.nan if copy is None else abs(copy.t - base.t) for _, base, copy in ends])
            shift = median_of_known(times[is_alike], confidence, units[is_alike])
            yield Level(SHIFT, shift, place, None, Basis(len(np.unique(units[is_alike])), unit))
