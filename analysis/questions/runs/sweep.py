"""What changes along the keys that a scene sweeps: what `analysis.measures` knows of its runs, and their fates.

Every value of a key is compared with its first, within each unit and each point of the other swept keys, since all
share the random draws. A row of a comparison is a unit, with its runs at all points of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd

from stickslip.analysis.answer import Answer
from stickslip.analysis.by_key import by_key
from stickslip.analysis.catalogues import bent, read
from stickslip.analysis.contrast import Contrast, contrast, turns
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code, uncertified
from stickslip.analysis.findings.finding import (
    Basis,
    Finding,
    KeyChange,
    Lack,
    Level,
    Reason,
    Scale,
    Threshold,
    Turn,
    Verdict,
)
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import capital
from stickslip.analysis.grid import Point, Sweep, axes_of, balanced, estimate, is_negative, points_at
from stickslip.analysis.measures import MOTION, STICKING, B, Measure
from stickslip.analysis.members import RELATIVE, noun
from stickslip.analysis.models.fates import MOVING, QUIET, WATCHED
from stickslip.analysis.questions.runs.coexistence import is_asked
from stickslip.analysis.questions.runs.sweep_figures import figures
from stickslip.analysis.rows import Columns, frame_by
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums
from stickslip.analysis.steps import Kind, Step, few, judged_together, table_of
from stickslip.pipeline.design.design import Axis, Unit, in_words
from stickslip.pipeline.design.design import Row as KeyValues
from stickslip.pipeline.design.labels import Label
from stickslip.pipeline.design.values import Ratio

ROUNDING = 1e-12  # what sums over a run lose to rounding, at any tolerance
MOST_DEFINED = 3  # measures whose definitions the method says
#: Why a measure is withheld, in words.
_REASONS = {
    enough.FEW_MATRICES: "too few systems",
    enough.FEW_CASCADES: "too few cascades",
    enough.DRIFTS: "the number of sticking blocks drifts",
    enough.FEW_BLOCKS: "no cascade has more than two blocks",
}


@dataclass(frozen=True, kw_only=True)
class KeyStep(Step):
    """A statistic at a value of an axis beside the first value, `base`; `is_last` if that is the last value."""

    axis: Axis
    base: KeyValues
    is_last: bool


def answer(study: Study) -> Answer | None:
    """How statistics change with each swept key; None where no key is swept."""
    if not axes_of(study.groups):
        return None
    grid, unit = Sweep.of(study), noun(study.unit)
    unjudged = [step for setting in grid.settings for step in _steps(grid, setting)]
    steps = judged_together(unjudged, 1 - grid.confidence)
    judged = [step for step in steps if step.contrast.is_known or step.turns]
    order = _order(grid, [step for step in judged if step.setting == grid.settings[0]] or judged)
    # where stick-slip ends is said better by `fates`, if it is asked there
    ends = [] if is_asked(study) else [end for setting in grid.settings for end in _thresholds(grid, setting, unit)]
    lead = _lead(grid, ends, order, judged, unit)
    further = [finding for finding in _rest(grid, order, judged, unit) if finding not in lead]
    pictures = figures(grid, order, [*judged], study.settings.units) if judged else {}
    tables = {"changes": table_of(steps), "sweep_measures": _table(grid)}
    findings = [*lead, *further] if lead else [_lack(grid, steps)]
    method = _method(grid, steps, unit)
    alerts = _alerts(study, grid) + (bent(study.once(read)) if order[0] == B else [])
    return Answer(findings, len(lead), alerts, method, tables=tables, figures=pictures)


def _lack(grid: Sweep, steps: Sequence[Step]) -> Lack:
    what = f"what changes with {' and '.join(axis.name for axis in grid.axes)}"
    n_units = max(len(point.group.units) for point in grid.every)
    if n_units >= enough.LEAST_MATRICES and not any(step.contrast.n_first for step in steps):
        return Lack(what, Reason.NOT_RUN, "no two settings differ in one key alone")
    return few(what, (point.group for point in grid.every))


def _method(grid: Sweep, steps: Sequence[Step], unit: str) -> str:
    """How values are compared, and what the first measures are."""
    averages = ", averaged over the values of the other keys at which both are known" if len(grid.axes) > 1 else ""
    is_of_files = any(point.group.unit is Unit.FILE for point in grid.every)
    drawn = (
        ", as files of one realisation share what is drawn" if is_of_files else ", as all share their random draws"
    )
    n_tests = sum(step.contrast.p_different is not None for step in steps)
    quantities = [measure.statistic.quantity for measure in grid.asked]
    defined = [quantity for quantity in quantities if quantity.definition][:MOST_DEFINED]
    adjusted = f" Verdicts are adjusted for {n_tests} comparisons (Holm), intervals are not." * (n_tests > 0)
    return f"Each value is compared with the first {unit} by {unit}{averages}{drawn}.{adjusted}" + "".join(
        f" {capital(quantity.name)}: {quantity.definition}." for quantity in defined
    )


# ---------------------------------------------------------------------------------------------------- steps


def _steps(grid: Sweep, setting: Label) -> Iterator[KeyStep]:
    """Each value of each axis beside the first that has enough units, not judged yet."""
    points = grid.points[setting]
    # a change below it, in units of the largest value of a unit, is of the size of the runs' own errors
    noise = max([ROUNDING, *(point.group.key[name] or 0.0 for point in points for name in RELATIVE)])
    for axis, measure in product(grid.axes, (*grid.asked, MOTION)):
        base, *further = _known_at(measure.name, points, axis)
        along, alike = dict[int, KeyStep](), set[int]()
        for place, value in enumerate(further, 1):
            pairs = _pairs(points, axis, base, value)
            common = _in_common(measure.name, pairs)
            reasons = (point.measured[measure.name].withheld for pair in pairs for point in pair)
            withheld = "" if common.counted else next(filter(None, reasons), "")
            difference = _contrast(measure, common, grid.confidence, withheld)
            if measure is MOTION and not _differ(common):
                alike.add(place)
                difference = replace(difference, p_different=None)
            if measure is not MOTION and _is_same(common, noise * _largest(measure.name, points)):
                # no test: what is the same in each of a few units may differ in others
                difference = replace(difference, is_same=True, p_different=None)
            ends_of_keys = zip(axis.keys, _values(base), _values(value), base, value, strict=True)
            keys = tuple(
                KeyChange(key, first, second, is_negative(*ends)) for key, first, second, *ends in ends_of_keys
            )
            where = grid.where[setting] + _places(axis, pairs, common.counted)
            is_last = value == further[-1]
            along[place] = KeyStep(
                Kind.KEY, setting, "", difference, keys, where, axis=axis, base=base, is_last=is_last
            )
        if len(alike) == len(along):
            continue
        turning = _turns(grid, measure, points, axis, [base, *further]) if axis.x is not None else []
        for place, step in along.items():
            turns_before = tuple(turn for turn, since in turning if since <= place)
            if turns_before or place not in alike:
                yield replace(step, turns=turns_before)


def _pairs(points: Sequence[Point], axis: Axis, first: KeyValues, second: KeyValues) -> list[tuple[Point, Point]]:
    """Points at two values of an axis that are at the same of all others."""
    by_place = {tuple(point.place.values()): point for point in points}
    return [
        (by_place[reference], point)
        for point in points_at(points, axis, second)
        if (reference := tuple((point.place | {axis: first}).values())) in by_place
    ]


def _contrast(measure: Measure, common: _Common, confidence: float, withheld: str = "") -> Contrast:
    return contrast(
        measure.statistic, common.first, common.second, True, confidence, Scale.ABSOLUTE, withheld=withheld
    )


def _turns(
    grid: Sweep, measure: Measure, points: Sequence[Point], axis: Axis, rows: Sequence[KeyValues]
) -> list[tuple[Turn, int]]:
    """Where a measure is shown to turn along an axis, with intervals for all pairs of values of all that is asked.

    Each with the place of the value at which that shows.
    """
    levels = [estimate(measure.statistic, points_at(points, axis, row), grid.confidence) for row in rows]
    known = [k for k, level in enumerate(levels) if level.value is not None]
    n_asked = (len(grid.asked) + 1) * len(grid.axes) * len(grid.settings)  # and the share that sticks late
    n_pairs = n_asked * len(known) * (len(known) - 1) // 2
    level = 1.0 - (1.0 - grid.confidence) / max(n_pairs, 1)

    def verdict(i: int, j: int) -> Verdict:
        pairs = _pairs(points, axis, rows[known[i]], rows[known[j]])
        return _contrast(measure, _in_common(measure.name, pairs), level).verdict

    places = turns([levels[k].value or 0.0 for k in known], verdict)
    is_of_size = len(axis.keys) == 1 and is_negative(*(row[0] for row in axis.rows))

    def near(extreme: range) -> Place:
        first, last = (in_words(rows[known[k]]) for k in (extreme[0], extreme[-1]))
        change = KeyChange(axis.name, first, last, is_of_size).said
        value = change.second if len(extreme) == 1 else type(change.second)(f"{change.first} to {change.second}")
        return Place.key(change.key, value)

    return [
        (Turn(course, levels[known[extreme[0]]], near(extreme)), known[since]) for course, extreme, since in places
    ]


def _known_at(name: str, points: Sequence[Point], axis: Axis) -> Sequence[KeyValues]:
    """The values of an axis at which enough units have a measure, or all if they are fewer than two."""
    values = []
    for value in axis.rows:
        sums = UnitSums.together(point.sums(name) for point in points_at(points, axis, value))
        if len(sums) >= enough.LEAST_MATRICES:
            values.append(value)
    return values if len(values) > 1 else axis.rows


def _values(row: KeyValues) -> list[str]:
    """The values of an axis in a sentence: of a ratio, how many times what."""
    return [
        f"{in_words((value.factor,))} times {value.of}" if isinstance(value, Ratio) else in_words((value,))
        for value in row
    ]


class _Common(NamedTuple):
    """The sums of the first and of the second points of pairs, for units that both have; which pairs count."""

    first: UnitSums
    second: UnitSums
    counted: list[int]


def _in_common(name: str, pairs: Sequence[tuple[Point, Point]]) -> _Common:
    """Of several pairs, all units count over the same ones, as far as that leaves enough."""
    places = [k for k, (reference, changed) in enumerate(pairs) if reference.group.unit == changed.group.unit]
    sums = [(pairs[k][0].sums(name), pairs[k][1].sums(name)) for k in places]
    sums = [(reference.within(changed), changed.within(reference)) for reference, changed in sums]
    rows, units = balanced([reference for reference, _ in sums])
    reference_sums, second = (UnitSums.together(sums[k][side].within(units) for k in rows) for side in (0, 1))
    return _Common(reference_sums, second, [places[k] for k in rows if len(sums[k][0].within(units))])


def _places(axis: Axis, pairs: Sequence[tuple[Point, Point]], counted: Sequence[int]) -> Place:
    """At which points of the other keys a contrast is; empty where it is at all that there are."""
    if len(counted) == len(pairs):
        return EVERYWHERE
    if len(counted) != 1:
        return Place.words(f"averaged over {len(counted)} of the {len(pairs)} settings of the other keys")
    place = pairs[counted[0]][0].place
    return Place(
        tuple((further_axis.name, in_words(value)) for further_axis, value in place.items() if further_axis != axis)
    )


def _is_same(common: _Common, noise: float) -> bool:
    """Whether a statistic that is known is the same in each unit; not said of shares, which are of few runs."""
    reference, changed = common.first.rows, common.second.rows
    return len(reference) > 0 and bool(
        (np.abs(reference[:, 0] / reference[:, 1] - changed[:, 0] / changed[:, 1]) <= noise).all()
    )


def _largest(name: str, points: Sequence[Point]) -> float:
    """The largest size of a statistic of one unit."""
    sums = (point.sums(name).rows for point in points)
    return max(float(np.abs(rows[:, 0] / rows[:, 1]).max(initial=0.0)) for rows in sums)


def _differ(common: _Common) -> bool:
    """Whether runs met different ends; otherwise there is nothing to test."""
    n_moving, n_runs = (common.first.rows.sum(axis=0) + common.second.rows.sum(axis=0)).tolist()
    return bool(0 < n_moving < n_runs)


# ---------------------------------------------------------------------------------------------------- what leads


def _order(grid: Sweep, steps: Sequence[Step]) -> list[str]:
    """Measures in order: what is recorded, the share that sticks late if it changes, others, what is the same."""
    varied = {step.statistic for step in steps if not step.contrast.is_same}
    names = sorted((measure.name for measure in grid.asked), key=lambda name: name not in varied)
    if not any(step.statistic == STICKING and step.contrast.is_shown for step in steps):
        return [*names, STICKING]
    recorded = {measure.name for measure in grid.asked if measure.is_recorded} & varied
    first = names[:1] if names[0] in recorded else []
    return [*first, STICKING, *names[len(first) :]]


def _lead(
    grid: Sweep, thresholds: Sequence[Threshold], order: Sequence[str], steps: Sequence[KeyStep], unit: str
) -> list[Finding]:
    """Where stick-slip ends, and changes of the first measure; if none of these is shown, one that is too."""
    leading = order[:2] if order[0] == STICKING else order[:1]
    significant = {step.statistic for step in steps if step.contrast.is_shown}
    if significant.isdisjoint(leading):
        leading = [*leading, *[name for name in order if name in significant][:1]]
    chosen = [
        step
        for name in leading
        if not (thresholds and name == STICKING)
        for setting in grid.settings
        for step in _largest_changes([step for step in steps if (step.statistic, step.setting) == (name, setting)])
    ]
    if not (thresholds or chosen):
        chosen = [*steps[:1]]
    return [*thresholds, *(step.change(unit) for step in chosen)]


def _largest_changes(steps: Sequence[KeyStep]) -> list[KeyStep]:
    """One change of a statistic a key, the largest first: that of its ends, or one that is shown.

    A statistic that turns on the way is said with its turns; one that goes further on the way than to its last value,
    from the first value to there.
    """
    chosen = []
    for along in by_key(steps, lambda step: step.axis).values():
        if (last := along[-1]).turns:
            chosen.append(last)
            continue
        significant = [step for step in along if step.contrast.is_shown] or along
        further = [step for step in significant if _goes_further(step.contrast, last.contrast)]
        at_end = [step for step in significant if step.is_last]
        chosen.append(max(further or at_end or significant, key=lambda step: step.contrast.weight))
    return sorted(chosen, key=lambda step: step.contrast.weight, reverse=True)


def _goes_further(inner: Contrast, last: Contrast) -> bool:
    """Whether a statistic goes further than to its last value, which lies outside its interval there."""
    first, end, there = inner.first.value, last.second.value, inner.second
    if first is None or end is None or there.low is None or there.high is None:
        return False
    return first > end > there.high or first < end < there.low


def _rest(grid: Sweep, order: Sequence[str], steps: Sequence[KeyStep], unit: str) -> Iterator[Finding]:
    """Of each measure the change to the last value of a key; of the first two all changes, and the first value."""
    for name in order:
        of_name = [step for step in steps if step.statistic == name]
        for setting, axis in product(grid.settings, grid.axes) if name in order[:2] else ():
            along = [step for step in of_name if (step.setting, step.axis) == (setting, axis)]
            for step in along[:1]:
                points = points_at(grid.points[setting], axis, step.base)
                value = estimate(step.contrast.statistic, points, grid.confidence)
                if value.value is not None:
                    where = Place.key(axis.name, in_words(step.base)) + grid.where[setting]
                    yield Level(step.contrast.statistic.quantity, value, where, basis=step.contrast.basis(unit))
        for step in of_name:
            if step.is_last or name in order[:2]:
                yield step.change(unit)


def _thresholds(grid: Sweep, setting: Label, unit: str) -> Iterator[Threshold]:
    """Between which values of the first key all runs cease to be in motion, or begin to, wherever the others are."""
    axis, *axes = grid.axes
    by_place = by_key(grid.points[setting], lambda point: tuple(point.place[further] for further in axes))
    for place, points in by_place.items():
        moves = [_all_or_none(point) for point in points]
        if None in (moves[0], moves[-1]) or moves[0] == moves[-1]:
            continue
        end = max(k for k, is_moving in enumerate(moves) if is_moving == moves[0])
        begin = moves.index(moves[-1])
        if end > begin:
            continue  # more than once
        keys = tuple((further_axis.name, in_words(value)) for further_axis, value in zip(axes, place, strict=True))
        where = grid.where[setting] + Place(keys)
        n_units = min(point.group.column("unit").nunique() for point in points)
        ends = [in_words(points[k].place[axis]) for k in (end, begin)]
        yield Threshold("stick-slip", bool(moves[0]), axis.name, ends[0], ends[1], where, Basis(n_units, unit))


def _all_or_none(point: Point) -> bool | None:
    """Whether all runs of a point are in motion, or none; None if some are, or if that cannot be told."""
    n_runs = sum(point.fates[name] for name in WATCHED)
    n_moving = sum(point.fates[name] for name in MOVING)
    if not n_runs or 0 < n_moving < n_runs or point.fates[QUIET]:
        return None
    return n_moving == n_runs


# ---------------------------------------------------------------------------------------------------- what is left


def _alerts(study: Study, grid: Sweep) -> list[Alert]:
    """Runs of which it is not known whether they stick again, runs without a value, and values that are withheld."""
    points, alerts, withheld = grid.every, list[Alert](), list[Alert]()
    if n_quiet := sum(point.fates[QUIET] for point in points):
        n_runs = sum(point.fates[name] for point in points for name in WATCHED)
        alerts.append(uncertified(n_quiet, n_runs, study.proofs))
    gaps: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for measure in grid.asked:
        values = [point.measured[measure.name] for point in points]
        missing = [lost for value in values for lost in value.missing.items() if lost[1] != measure.absent]
        if missing:
            gaps.setdefault(tuple(missing), []).append(measure.statistic.quantity.name)
        reasons = [value.withheld for value in values if value.withheld]
        if reasons and (measure.is_recorded or len(reasons) < len(points)):
            why = " or ".join(_REASONS.get(reason, reason) for reason in dict.fromkeys(reasons))
            what = capital(measure.statistic.quantity.name)
            withheld.append(Alert.of(Code.WITHHELD, what=what, n=len(reasons), of=len(points), why=why))
    n_members = sum(len(point.group) for point in points)
    for lost, (member, *names) in gaps.items():
        what = f"{member} nor {len(names)} more" if names else member
        alerts.append(Alert.of(Code.WITHOUT, n=len(lost), of=n_members, what=what, why=lost[0][1]))
    return alerts + withheld


class _Cell(NamedTuple):
    """A measure at a point of a setting."""

    setting: str
    point: Point
    measure: Measure
    estimate: Estimate


_COLUMNS: Columns[_Cell] = {
    "setting": (str, lambda cell: cell.setting),
    "group": (str, lambda cell: cell.point.group.label),
    "measure": (str, lambda cell: cell.measure.name),
    "words": (str, lambda cell: cell.measure.statistic.definition),
    "estimate": (Estimate, lambda cell: cell.estimate),
    "n_units": (int, lambda cell: len(cell.point.measured[cell.measure.name].sums)),
    "n_runs": (int, lambda cell: sum(cell.point.fates[name] for name in WATCHED)),
    "n_censored": (int, lambda cell: cell.point.measured[cell.measure.name].n_censored),
    "n_without": (int, lambda cell: len(cell.point.measured[cell.measure.name].missing)),
    "reason": (str, lambda cell: cell.point.measured[cell.measure.name].withheld or cell.estimate.reason),
}


def _table(grid: Sweep) -> pd.DataFrame:
    """Each measure, and the share of runs that stick late, with its interval at each point."""
    cells = [
        _Cell(setting, point, measure, estimate(measure.statistic, [point], grid.confidence))
        for setting, points in grid.points.items()
        for point in points
        for measure in (*grid.asked, MOTION)
    ]
    columns = dict(_COLUMNS)
    for axis in grid.axes:
        for k, key in enumerate(axis.keys):
            kind = float if all(isinstance(row[k], float) for row in axis.rows) else str
            columns[key] = kind, partial(_key_of, axis, k, kind)
    return frame_by(columns, cells)


def _key_of(axis: Axis, k: int, kind: type, cell: _Cell) -> object:
    """The value of a key of an axis at the point of a cell."""
    return kind(cell.point.place[axis][k])
