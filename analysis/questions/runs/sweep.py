"""What changes along the keys that a scene sweeps: what `analysis.measures` knows of its runs, and their fates.

Every value of a key is compared with its first, within each unit and each point of the other swept keys, since all
share the random draws. A row of a comparison is a unit, with its runs at all points of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, MaxNLocator

from stickslip.analysis.answer import Answer, F, I, Picture, Row, S, frame, named
from stickslip.analysis.contrast import CHANGES, Contrast, Sample, Share, Statistic, contrast, judged
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Finding,
    KeyChange,
    Lack,
    Level,
    Reason,
    Scale,
    Threshold,
    Verdict,
)
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import capital
from stickslip.analysis.grid import (
    AT_MOST,
    IN_MOTION,
    MOST_SETTINGS,
    Point,
    axes_of,
    dtype,
    estimate,
    point_of,
    points_at,
    settings,
)
from stickslip.analysis.measures import KEYS, Measure, measures
from stickslip.analysis.members import RELATIVE, noun
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET, WATCHED
from stickslip.analysis.questions.runs.fate_figures import FATES, shares
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums
from stickslip.analysis.style import EXACT, GREY, panel
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.labels import Label
from stickslip.pipeline.design.values import Ratio, Value

ROUNDING = 1e-12  # what sums over a run lose to rounding, at any tolerance
MOST_LINES = 6  # in one figure
MOST_FIGURES = 8  # of statistics along a key
MOST_DECADES = 4.0  # of an axis: what lies further below the largest value is below the axis
MOST_LEADING, MOST_ALERTS = 3, 3
_FEW_TICKS = 4  # so few values of a key are its ticks
_LETTERS, _LINES = 36, 20  # of the ticks of a map, side by side and above each other
DECADES = 30.0  # largest over least value from which an axis is logarithmic
MOTION = Share(IN_MOTION, title="share of runs in motion")
_VALUES: Mapping[str, str] = {
    "setting": S, "group": S, "n_units": I, "n_runs": I, **{f"n_{name}": I for name in (*WATCHED, FAILED)},
    **{f"moving{end}": F for end in ("", "_low", "_high")}, "basis": S,
}  # fmt: skip
_MEASURES: Mapping[str, str] = {
    "setting": S, "group": S, "measure": S, "words": S, "estimate": F, "estimate_low": F, "estimate_high": F,
    "n_units": I, "n_runs": I, "n_censored": I, "n_without": I, "reason": S,
}  # fmt: skip
_MISSING: Mapping[str, str] = {"setting": S, "measure": S, "member_id": S, "reason": S}


#: Why gamma is withheld, in words.
_REASONS = {
    enough.FEW_MATRICES: "too few systems", enough.FEW_CASCADES: "too few cascades", enough.DRIFTS: "n_stick drifts",
}  # fmt: skip


class Step(NamedTuple):
    """A statistic at a value of a key beside the first value, and at which points of the other keys.

    Attributes
    ----------
    setting : Label
    axis : Axis
    first, second : tuple of Value
        Values of the axis.
    contrast : Contrast
    places : Place
        At which values of the other keys; everywhere, if it is at all points that there are.
    is_last : bool
        Whether the second is the last value.
    """

    setting: Label
    axis: Axis
    first: tuple[Value, ...]
    second: tuple[Value, ...]
    contrast: Contrast
    places: Place
    is_last: bool

    @property
    def name(self) -> str:
        return self.contrast.statistic.name

    def change(self, where: Place, unit: str) -> Change:
        """As a finding."""
        keys = map(KeyChange, self.axis.keys, _values(self.first), _values(self.second))
        return self.contrast.change(tuple(keys), where + self.places, unit)

    def row(self) -> Row:
        return {
            "kind": "key", "setting": self.setting, "key": self.axis.name, "first_value": in_words(self.first),
            "second_value": in_words(self.second), **self.contrast.row(),
        }  # fmt: skip


def _values(row: tuple[Value, ...]) -> list[str]:
    """The values of an axis in a sentence: of a ratio, how many times what."""
    return [
        f"{in_words((value.factor,))} times {value.of}" if isinstance(value, Ratio) else in_words((value,))
        for value in row
    ]


def answer(study: Study) -> Answer | None:
    """How statistics change with each swept key; None where no key is swept."""
    axes, found = axes_of(study.groups), settings(study.groups)
    if not axes:
        return None
    level = study.settings.confidence
    asked = measures(study)
    points = {name: sorted((point_of(study, group, axes, asked) for group in some), key=Point.rank)
              for name, some in found.items()}  # fmt: skip
    steps = [step for name, some in points.items() for step in _steps(name, axes, some, asked, study)]
    contrasts = judged([step.contrast for step in steps], 1 - level)
    steps = [step._replace(contrast=found) for step, found in zip(steps, contrasts, strict=True)]
    lead = max(points, key=lambda name: sum(int(point.group.is_finished.sum()) for point in points[name]))
    told = [step for step in steps if step.contrast.is_known]
    alerts = _alerts(points, asked, study)
    tables = _tables(points, axes, asked, steps, level)
    if not told:
        n_units = max(len(point.group.units) for some in points.values() for point in some)
        keys = " and ".join(axis.name for axis in axes)
        reason = Reason.FEW_UNITS if n_units else Reason.NO_MOTION
        detail = ""
        if n_units >= enough.LEAST_MATRICES and not any(step.contrast.n_first for step in steps):
            reason, detail = Reason.NOT_RUN, "no two settings differ in one key alone"
        return Answer(findings=[Lack(f"what changes with {keys}", reason, detail)], tables=tables, alerts=alerts)
    leading = _leading(asked, [step for step in told if step.setting == lead] or told)
    findings, n_lead = _findings(points, lead, axes, leading, told, study)
    first = next((step for step in told if step.name == leading[0] and step.setting == lead), told[0])
    in_order = [first.axis, *(axis for axis in axes if axis != first.axis)]
    if len(axes) > 1 and len(in_order[1].rows) > max(MOST_LINES, len(in_order[0].rows)):
        in_order[:2] = in_order[1::-1]  # a line for each of the few values, not of the many
    figures = dict[str, Picture]()
    for k, name in enumerate(_drawn(points, lead) if len(axes) > 1 else [lead]):
        where = name if len(axes) > 1 and len(points) > 1 else ""
        for base, picture in _figures(points, name, in_order, leading, asked, level, where, told).items():
            figures[f"{base}-{k + 1}" if k else base] = picture  # no measure has a hyphen
    return Answer(
        tables=tables, figures=figures, findings=findings, n_lead=n_lead, alerts=alerts[:MOST_ALERTS],
        method=_method(axes, asked, steps, study),
    )  # fmt: skip


def _method(axes: Sequence[Axis], asked: Sequence[Measure], steps: Sequence[Step], study: Study) -> str:
    """How values are compared, and what the first measures are."""
    unit = noun(study.unit)
    others = ", averaged over the values of the other keys at which both are known" if len(axes) > 1 else ""
    n_tests = sum(step.contrast.p_different is not None for step in steps)
    quantities = [measure.statistic.quantity for measure in asked]
    definitions = [f" {capital(one.name)}: {one.definition}." for one in quantities if one.definition]
    return (
        f"All values share their random draws, so each is compared with the first {unit} by {unit}{others}."
        f" Verdicts are adjusted for {n_tests} comparisons (Holm), intervals are not."
        + "".join(definitions[:MOST_LEADING])
    )


def _leading(asked: Sequence[Measure], steps: Sequence[Step]) -> list[str]:
    """Statistics in order: the share in motion first if it changes, and last what is the same everywhere."""
    names = [measure.name for measure in asked]
    is_moved = {step.name for step in steps if step.contrast.is_shown}
    varied = {step.name for step in steps if not step.contrast.is_same}
    in_order = sorted(names, key=lambda name: name not in varied)
    return [IN_MOTION, *in_order] if IN_MOTION in is_moved else [*in_order, IN_MOTION]


def _findings(
    points: Mapping[Label, Sequence[Point]], lead: Label, axes: Sequence[Axis], leading: Sequence[str],
    steps: Sequence[Step], study: Study,
) -> tuple[list[Finding], int]:  # fmt: skip
    """The findings, and how many of them lead: where stick-slip ends, and changes of the leading statistic."""
    unit = noun(study.unit)
    where = {name: Place.of(name) if len(points) > 1 else EVERYWHERE for name in points}
    in_order = sorted(points, key=lambda name: name != lead)
    told = [step for name in in_order for step in steps if step.setting == name]
    found: list[Finding] = [
        threshold for name in in_order for threshold in _thresholds(points[name], axes, where[name], unit)
    ]
    chosen = [
        step
        for statistic in leading[: 2 if leading[0] == IN_MOTION else 1]
        if not (found and statistic == IN_MOTION)
        for name in in_order
        for step in _largest_changes(axes, [s for s in told if (s.name, s.setting) == (statistic, name)])
    ]
    if not (found or chosen):
        chosen = told[:1]
    found += [step.change(where[step.setting], unit) for step in chosen]
    n_lead = min(MOST_LEADING, len(found))
    for name in leading:
        some = [step for step in told if step.name == name]
        if name in leading[:2]:
            found += _levels(points, some, where, unit, study.settings.confidence)
        found += [
            step.change(where[step.setting], unit)
            for step in some
            if step not in chosen and (step.is_last or name in leading[:2])
        ]
    return found, n_lead


def _largest_changes(axes: Sequence[Axis], steps: Sequence[Step]) -> list[Step]:
    """One change of a statistic a key, the largest first: that of its ends or, if none is shown there, one that is.

    And of a key, beside that of its ends, the change to a value at which the statistic is beyond both.
    """
    found = []
    for axis in axes:
        some = [step for step in steps if step.axis == axis]
        if not some:
            continue
        best = max(some, key=lambda step: (step.contrast.is_shown, step.is_last, step.contrast.weight))
        found += [best, *_beyond(best, some)]
    return sorted(found, key=lambda step: step.contrast.weight, reverse=True)


def _beyond(end: Step, steps: Sequence[Step]) -> list[Step]:
    """Of the values between a key's ends, the one at which a statistic is furthest beyond both, if it is at any.

    The intervals of the changes to it and to the last value lie apart.
    """
    low, high = end.contrast.absolute.low, end.contrast.absolute.high
    if not end.is_last or low is None or high is None:
        return []
    found = []
    for step in steps:
        change = step.contrast.absolute
        if change.low is None or change.high is None or change.value is None or not step.contrast.is_shown:
            continue
        if change.low > max(high, 0.0) or change.high < min(low, 0.0):
            found.append((abs(change.value), step))
    return [max(found, key=lambda pair: pair[0])[1]] if found else []


def _thresholds(points: Sequence[Point], axes: Sequence[Axis], where: Place, unit: str) -> Iterator[Threshold]:
    """Between which values of the first key all runs cease to be in motion, or begin to, wherever the others are."""
    axis, *others = axes
    by_place: dict[tuple[tuple[Value, ...], ...], list[Point]] = {}
    for point in points:
        by_place.setdefault(tuple(point.at[other] for other in others), []).append(point)
    for place, some in by_place.items():
        told = [(point.at[axis], _all_or_none(point)) for point in some]
        moves = [is_moving for _, is_moving in told]
        if None in (moves[0], moves[-1]) or moves[0] == moves[-1]:
            continue
        last = max(k for k, is_moving in enumerate(moves) if is_moving == moves[0])
        first = min(k for k, is_moving in enumerate(moves) if is_moving == moves[-1])
        if last > first:
            continue  # more than once
        at = Place(tuple((other.name, in_words(value)) for other, value in zip(others, place, strict=True)))
        n_units = min(point.group.column("unit").nunique() for point in some)
        yield Threshold(
            "stick-slip", bool(moves[0]), axis.name, in_words(told[last][0]), in_words(told[first][0]),
            where + at, Basis(n_units, unit),
        )  # fmt: skip


def _all_or_none(point: Point) -> bool | None:
    """Whether all runs of a point are in motion, or none; None if some are, or if that cannot be told."""
    n_runs = sum(point.fates[name] for name in WATCHED)
    n_moving = sum(point.fates[name] for name in MOVING)
    if not n_runs or 0 < n_moving < n_runs or point.fates[QUIET]:
        return None
    return n_moving == n_runs


def _levels(
    points: Mapping[Label, Sequence[Point]],
    steps: Sequence[Step],
    where: Mapping[Label, Place],
    unit: str,
    level: float,
) -> Iterator[Level]:
    """The value of a statistic at the first value of each key, with which the others are compared."""
    for name, axis in dict.fromkeys((step.setting, step.axis) for step in steps):
        step = next(one for one in steps if (one.setting, one.axis) == (name, axis))
        at = points_at(points[name], axis, step.first)
        value = estimate(step.contrast.statistic, at, level)
        if value.value is not None:
            place = Place.key(axis.name, in_words(step.first)) + where[name]
            yield Level(step.contrast.statistic.quantity, value, place, basis=step.contrast.basis(unit))


def _drawn(points: Mapping[Label, Sequence[Point]], lead: Label) -> list[Label]:
    """The settings with pictures of their own: the one that leads first, then those of the exact law."""
    rest = sorted((name for name in points if name != lead), key=lambda name: not points[name][0].group.is_exact)
    return [lead, *rest][:MOST_SETTINGS]


def _steps(
    setting: Label, axes: Sequence[Axis], points: Sequence[Point], asked: Sequence[Measure], study: Study
) -> Iterator[Step]:
    """Each value of each axis beside the first that has enough units, not judged yet."""
    by_place = {tuple(point.at.values()): point for point in points}
    level = study.settings.confidence
    # a change below it, in units of the largest value of a unit, is of the size of the runs' own errors
    noise = max([ROUNDING, *(point.group.key[name] or 0.0 for point in points for name in RELATIVE)])
    statistics = [*(measure.statistic for measure in asked), MOTION]
    largest = {statistic.name: _largest(statistic.name, points) for statistic in statistics}
    for axis, statistic in product(axes, statistics):
        name = statistic.name
        n_units = {value: _n_units(name, points, axis, value) for value in axis.rows}
        many = [value for value, n in n_units.items() if n >= enough.LEAST_MATRICES]
        base, *others = many if len(many) > 1 else axis.rows
        for value in others:
            pairs = [
                (by_place[before], point)
                for point in points
                if point.at[axis] == value and (before := tuple((point.at | {axis: base}).values())) in by_place
            ]
            is_bounded = name == IN_MOTION
            first, second, kept = _in_common((IN_MOTION, AT_MOST) if is_bounded else (name,), pairs)
            if is_bounded and not _differ(first, second, name):
                continue
            found = contrast(statistic, first, second, True, level, Scale.ABSOLUTE)
            if is_bounded:
                found = _either_way(found, first, second, level)
            elif _is_same(first, second, name, noise * largest[name]):
                # no test: what is the same in each of a few units may differ in others
                found = replace(found, is_same=True, p_different=None, p_equivalent=None)
            yield Step(setting, axis, base, value, found, _places(axis, pairs, kept), value == others[-1])


def _places(axis: Axis, pairs: Sequence[tuple[Point, Point]], kept: Sequence[int]) -> Place:
    """At which points of the other keys a contrast is; empty where it is at all that there are."""
    if len(kept) == len(pairs):
        return EVERYWHERE
    others = [one for one in pairs[0][0].at if one != axis]
    if len(kept) == 1:
        return Place(tuple((one.name, in_words(pairs[kept[0]][0].at[one])) for one in others))
    return Place.words(f"averaged over {len(kept)} of the {len(pairs)} settings of the other keys")


def _is_same(first: Sample, second: Sample, name: str, noise: float) -> bool:
    """Whether a statistic that is known is the same in each unit; not said of shares, which are of few runs."""
    a, b = (some.of(name).rows for some in (first, second))
    return len(a) > 0 and bool((np.abs(a[:, 0] / a[:, 1] - b[:, 0] / b[:, 1]) <= noise).all())


def _either_way(found: Contrast, first: Sample, second: Sample, confidence: float) -> Contrast:
    """What holds of a contrast of shares in motion whatever quiet runs do: a weaker test and a wider interval."""
    statistic = found.statistic
    corners = [
        contrast(
            statistic, Sample({statistic.name: first.of(a)}), Sample({statistic.name: second.of(b)}), True, confidence
        )
        for a, b in ((AT_MOST, IN_MOTION), (IN_MOTION, AT_MOST))
    ]
    low, high = (corner.absolute for corner in corners)
    if found.p_different is None or low.low is None or low.value is None or high.high is None or high.value is None:
        return found
    p_values = [corner.p_different for corner in corners if corner.p_different is not None]
    return replace(
        found,
        first=replace(found.first, high=corners[0].first.high),
        second=replace(found.second, high=corners[1].second.high),
        absolute=replace(found.absolute, low=low.low, high=high.high),
        p_different=1.0 if low.value <= 0.0 <= high.value else max(found.p_different, *p_values),
    )


def _n_units(name: str, points: Sequence[Point], axis: Axis, value: tuple[Value, ...]) -> int:
    """Number of units for which a statistic is known at one value of an axis."""
    return len(UnitSums.together(point.sample.of(name) for point in points_at(points, axis, value)))


def _largest(name: str, points: Sequence[Point]) -> float:
    """The largest size of a statistic of one unit."""
    every = (point.sample.of(name).rows for point in points)
    return max(float(np.abs(rows[:, 0] / rows[:, 1]).max(initial=0.0)) for rows in every)


def _in_common(names: Sequence[str], pairs: Sequence[tuple[Point, Point]]) -> tuple[Sample, Sample, list[int]]:
    """The sums of the first and of the second points of pairs, for the units that both of a pair have.

    And of which pairs units count, by number, for the first name.

    Of several pairs, all units count over the same ones, as far as that leaves enough: else a unit that lacks a pair
    would differ from others by what that pair is like.
    """
    places = [k for k, (a, b) in enumerate(pairs) if a.group.unit == b.group.unit]
    samples = [(pairs[k][0].sample, pairs[k][1].sample) for k in places]
    first, second, counted = Sample(), Sample(), list[list[int]]()
    for name in names:
        sums = [(a.of(name), b.of(name)) for a, b in samples]
        sums = [(a.within(b), b.within(a)) for a, b in sums]
        pairs_kept, units = _without_gaps([a.units for a, _ in sums])
        first.sums[name], second.sums[name] = (
            UnitSums.together(sums[k][which].within(units) for k in pairs_kept) for which in (0, 1)
        )
        counted.append([places[k] for k in pairs_kept if len(sums[k][0].within(units))])
    return first, second, counted[0]


def _without_gaps(have: Sequence[np.ndarray]) -> tuple[list[int], UnitSums]:
    """Pairs, by number, and units that all of these have; all, with their gaps, if too few units are left.

    What lacks most is left out first, be it a pair or a unit.
    """
    every = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *have]))
    has = np.array([np.isin(every, one) for one in have]).reshape(len(have), len(every))
    pairs, units = np.arange(len(have)), every
    while not has.all():
        of_pair, of_unit = has.mean(axis=1), has.mean(axis=0)
        if of_pair.min() <= of_unit.min():
            kept = np.arange(len(pairs)) != of_pair.argmin()
            pairs, has = pairs[kept], has[kept]
        else:
            kept = np.arange(len(units)) != of_unit.argmin()
            units, has = units[kept], has[:, kept]
    n_left = len(units) if len(pairs) else 0
    if n_left < min(len(every), enough.LEAST_MATRICES):
        pairs, units = np.arange(len(have)), every
    return pairs.tolist(), UnitSums(units, np.zeros((len(units), 2)))


def _differ(first: Sample, second: Sample, name: str) -> bool:
    """Whether the runs of both met different ends; otherwise there is nothing to test."""
    rows = np.vstack([first.of(name).rows, second.of(name).rows])
    return bool(0 < rows[:, 0].sum() < rows[:, 1].sum())


def _tables(
    points: Mapping[Label, Sequence[Point]], axes: Sequence[Axis], asked: Sequence[Measure], steps: Sequence[Step],
    level: float,
) -> dict[str, Any]:  # fmt: skip
    """Runs by fate, every measure with its interval, and runs without one, at each point; and the changes."""
    keys = {key: dtype(axis, k) for axis in axes for k, key in enumerate(axis.keys)}
    rows, measured = list[Row](), list[Row]()
    for setting, some in points.items():
        for point in some:
            values = (value if isinstance(value, float) else str(value)
                      for value in chain.from_iterable(point.at.values()))  # fmt: skip
            place: Row = {
                "setting": setting, "group": point.group.label, "n_units": len(point.group.units),
                "n_runs": sum(point.fates[name] for name in WATCHED),
                **dict(zip((key for axis in axes for key in axis.keys), values, strict=True)),
            }  # fmt: skip
            rows.append(place | {f"n_{name}": n for name, n in point.fates.items()}
                        | named("moving", estimate(MOTION, [point], level))
                        | {"basis": point.group.basis(level).code})  # fmt: skip
            measured += [place | _measured(measure, point, level) for measure in asked]
    return {
        "sweep": frame({**_VALUES, **keys}, rows),
        "sweep_measures": frame({**_MEASURES, **keys}, measured),
        "sweep_missing": frame(_MISSING, _missing(points, asked)),
        "changes": frame(CHANGES, [step.row() for step in steps]),
    }


def _measured(measure: Measure, point: Point, level: float) -> Row:
    """A measure at a point: columns of the table `sweep_measures`."""
    values, value = point.values[measure.name], estimate(measure.statistic, [point], level)
    return {
        **named("estimate", value), "measure": measure.name, "words": measure.statistic.definition or None,
        "n_units": len(values.sums), "n_censored": values.n_censored, "n_without": len(values.missing),
        "reason": values.withheld or value.reason or None,
    }  # fmt: skip


def _missing(points: Mapping[Label, Sequence[Point]], asked: Sequence[Measure]) -> Iterator[Row]:
    """Rows of the table `sweep_missing`: each run without a value, and why."""
    for setting, some in points.items():
        for point, one in product(some, asked):
            for member_id, reason in point.values[one.name].missing.items():
                yield {"setting": setting, "measure": one.name, "member_id": member_id, "reason": reason}


def _alerts(points: Mapping[Label, Sequence[Point]], asked: Sequence[Measure], study: Study) -> list[Alert]:
    """Runs of which it is not known whether they stick again, runs without a value, and values that are withheld."""
    every = [point for some in points.values() for point in some]
    n_members = sum(len(point.group) for point in every)
    found = []
    if n_quiet := sum(point.fates[QUIET] for point in every):
        n_runs = sum(point.fates[name] for point in every for name in WATCHED)
        found.append(Alert.of(Code.UNCERTIFIED, n=n_quiet, of=n_runs))
    gaps: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for measure in asked:
        missing = tuple(
            lost
            for point in every
            for lost in point.values[measure.name].missing.items()
            if lost[1] != measure.absent
        )
        gaps.setdefault(missing, []).append(measure.statistic.quantity.name)
    for missing, names in gaps.items():
        if missing:
            what = names[0] if len(names) == 1 else f"{names[0]} nor {len(names) - 1} more"
            found.append(Alert.of(Code.WITHOUT, n=len(missing), of=n_members, what=what, why=missing[0][1]))
    for measure in asked:
        why = [point.values[measure.name].withheld for point in every if point.values[measure.name].withheld]
        if why and (measure.is_recorded or len(why) < len(every)):
            what = capital(measure.statistic.quantity.name)
            reasons = " or ".join(_REASONS.get(reason, reason) for reason in dict.fromkeys(why))
            found.append(Alert.of(Code.WITHHELD, what=what, n=len(why), of=len(every), why=reasons))
    return found


def _figure(measure: Measure) -> str:
    """Name of the figure of a measure along a key."""
    return f"sweep_{measure.key}" if measure.name in KEYS else f"sweep_of_{measure.key}"


def _figures(
    points: Mapping[Label, Sequence[Point]], lead: Label, axes: Sequence[Axis], leading: Sequence[str],
    asked: Sequence[Measure], level: float, where: str, steps: Sequence[Step],
) -> dict[str, Picture]:  # fmt: skip
    """The statistics along the first axis, in the order of `leading`, and a map of the first over two axes."""
    main = points[lead]
    ticks = axes[0].x, axes[0].texts
    by_name = {measure.name: measure for measure in asked}
    may_be_log = any(measure.is_recorded for measure in asked)
    at = f" at {where}" if where else ""
    found: dict[str, Picture] = {}
    for name in leading[:MOST_FIGURES]:
        if name == IN_MOTION:
            at_value = [[point.fates for point in points_at(main, axes[0], value)] for value in axes[0].rows]
            counts = {end: [sum(fates[end] for fates in some) for some in at_value] for end in FATES}
            if any(any(some) for end, some in counts.items() if end not in MOVING):
                caption = f"How runs end, along {axes[0].name}{at}: shares of all runs."
                found["sweep_fates"] = Picture(partial(shares, axes[0].name, ticks[1], counts), caption)
            continue
        statistic = by_name[name].statistic
        title = statistic.quantity.name
        lines = _lines(points, lead, axes, statistic, level)
        if sum(one is not None for _, some in lines for one in some) > 1:
            recipe = partial(curves, title, axes[0].name, *ticks, lines, may_be_log)
            seen = _seen([step for step in steps if (step.name, step.axis, step.setting) == (name, axes[0], lead)])
            caption = f"{capital(title)} {seen} {axes[0].name}{at}. Bars are {100 * level:g}% intervals."
            found[_figure(by_name[name])] = Picture(recipe, caption)
    first = next((by_name[name] for name in leading if name in by_name), None)
    if len(axes) > 1 and first is not None:
        statistic = MOTION if leading[0] == IN_MOTION else first.statistic
        some = _throughout(statistic, main, axes)
        cells = [
            [
                estimate(statistic, points_at(points_at(some, axes[1], y), axes[0], x), level).value
                for x in axes[0].rows
            ]
            for y in axes[1].rows
        ]
        across, up = ((axis.name, axis.texts) for axis in axes[:2])
        if any(value is not None for row in cells for value in row):
            title = statistic.quantity.name
            recipe = partial(heat_map, title, across, up, cells, may_be_log)
            caption = f"{capital(title)} over {axes[0].name} and {axes[1].name}{at}."
            found["sweep_map"] = Picture(recipe, caption)
    return found


def _seen(steps: Sequence[Step]) -> str:
    """What a figure of a statistic along a key shows: a verb and a preposition."""
    verdicts = {step.contrast.verdict for step in steps} & {Verdict.MORE, Verdict.LESS}
    if len(verdicts) != 1:
        return "against"
    return "rises with" if verdicts == {Verdict.MORE} else "falls with"


def _throughout(of: Statistic, points: Sequence[Point], axes: Sequence[Axis]) -> Sequence[Point]:
    """Points at those values of the axes from the third on that have a statistic wherever any have it.

    If there are none, at those that have it at most points: averages over some here and others there would differ
    by what these are like.
    """
    has: dict[tuple[Any, ...], set[tuple[Any, ...]]] = {}
    for point in points:
        if len(point.sample.of(of.name)):
            place = [point.at[axis] for axis in axes]
            has.setdefault(tuple(place[2:]), set()).add(tuple(place[:2]))
    if not has:
        return points
    every = set().union(*has.values())
    kept = {rest for rest, some in has.items() if some == every} or {max(has, key=lambda rest: len(has[rest]))}
    return [point for point in points if tuple(point.at[axis] for axis in axes[2:]) in kept]


def _lines(
    points: Mapping[Label, Sequence[Point]], lead: Label, axes: Sequence[Axis], of: Statistic, level: float
) -> list[tuple[str, list[Estimate | None]]]:
    """Lines along the first axis, one for each value of the second, or for each setting."""
    kept = {lead, *list(points)[: MOST_LINES - 1]}
    parts: list[tuple[str, Sequence[Point]]] = [(name, some) for name, some in points.items() if name in kept]
    if len(axes) > 1:
        along = axes[1]
        n_lines = min(len(along.rows), MOST_LINES)
        drawn = np.linspace(0, len(along.rows) - 1, n_lines).round().astype(int).tolist()
        held = _throughout(of, points[lead], axes)
        parts = [
            (f"{along.name} = {in_words(value)}", points_at(held, along, value))
            for value in (along.rows[k] for k in drawn)
        ]
    found = []
    for name, some in parts[:MOST_LINES]:
        line = [estimate(of, points_at(some, axes[0], value), level) for value in axes[0].rows]
        found.append((name, [one if one.value is not None else None for one in line]))
    return found


@panel()
def curves(
    ax: Axes, what: str, key: str, x: Sequence[float] | None, ticks: Sequence[str],
    lines: Sequence[tuple[str, Sequence[Estimate | None]]], may_be_log: bool = False,
) -> None:  # fmt: skip
    """A statistic against a key, with intervals, one line for each value of another key.

    `x` is None if the key's values are not numbers, and they are then evenly spaced. An axis whose values span
    decades is logarithmic, if it may be.
    """
    at = np.arange(len(ticks), dtype=float) if x is None else np.array(x)
    is_log = may_be_log and x is not None and _spans_decades(at * np.sign(at[0]))
    if is_log and at[0] < 0:  # such as the speed of a belt
        at, key = -at, f"|{key}|"
    values = np.array([one.value for _, line in lines for one in line if one is not None])
    is_decades = may_be_log and _spans_decades(values)
    floor = _floor(values) if is_decades else -np.inf
    colours = [EXACT] if len(lines) == 1 else matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(lines)))
    for k, (name, line) in enumerate(lines):
        seen = [(place, one) for place, one in zip(at, line, strict=True) if one is not None]
        value = np.array([one.value for _, one in seen], dtype=float)
        ends = np.array([[one.low, one.high] for _, one in seen], dtype=float).reshape(-1, 2)  # NaN: no interval
        here, mark = np.array([place for place, _ in seen]), f"{'os^Dv<'[k % 6]}-"
        ax.errorbar(here, value, np.abs(ends - value[:, None]).T, fmt=mark, markersize=3.5, linewidth=0.9,
                    color=colours[k], label=signs(name))  # fmt: skip
        if (value < floor).any():
            ax.plot(here[value < floor], np.full((value < floor).sum(), floor), "v", color=colours[k], markersize=5,
                    markerfacecolor="white")  # fmt: skip
    if x is None:
        ax.set_xticks(at, [*map(signs, ticks)])
    elif not is_log:
        ax.xaxis.set_major_locator(FixedLocator(at.tolist()) if len(at) <= _FEW_TICKS else MaxNLocator(nbins=6))
    margin = 0.05 * (at.max() - at.min())
    ax.set(xlim=(at.min() - margin, at.max() + margin), xlabel=key, ylabel=what)
    if is_log:
        ax.set(xscale="log", xlim=(at.min() / 1.2, 1.2 * at.max()))
    if is_decades:  # an interval that reaches zero goes down to the axis
        ax.set_yscale("log", nonpositive="clip")
        ax.set_ylim(max(values.min(), floor) / 2, 2 * values.max())
        if values.min() < floor:
            ax.set_ylabel(f"{what} (open triangles: less)")
    if len(lines) > 1:
        ax.figure.legend(loc="outside upper center", ncols=min(len(lines), 3), handlelength=1.2)


def _floor(values: np.ndarray) -> float:
    """The least value that an axis reaches: what has decayed to the rounding of a run would take most of it."""
    return float(values.max() / 10.0**MOST_DECADES)


def _spans_decades(values: np.ndarray) -> bool:
    """Whether values are positive and some `DECADES` apart."""
    return bool(values.min() > 0 and values.max() >= DECADES * values.min())


@panel()
def heat_map(
    ax: Axes,
    what: str,
    across: tuple[str, Sequence[str]],
    up: tuple[str, Sequence[str]],
    cells: Sequence[Sequence[float | None]],
    may_be_log: bool = False,
) -> None:
    """A statistic at each point of a grid of two keys, one row for each value of `up`; grey where it has no value."""
    shown = np.array(cells, dtype=float)
    ax.set_facecolor("#d8d8d8")
    known = shown[np.isfinite(shown)]
    is_log = may_be_log and bool(len(known)) and _spans_decades(known)
    norm = LogNorm(max(known.min(), _floor(known)), known.max(), clip=True) if is_log else None
    image = ax.imshow(np.ma.masked_invalid(shown), cmap="viridis", aspect="auto", origin="lower", norm=norm)
    if shown.size <= 80:
        least, most = image.get_clim()
        middle = np.sqrt(least * most) if is_log else 0.5 * (least + most)
        for (row, column), value in np.ndenumerate(shown):
            if np.isfinite(value):
                colour = "white" if value < middle else "black"
                ax.text(column, row, f"{value:.3g}", ha="center", va="center", fontsize=7, color=colour)
    steps = 1 + sum(len(text) + 2 for text in across[1]) // _LETTERS, 1 + len(up[1]) // _LINES
    for axis, (name, ticks), step in zip((ax.xaxis, ax.yaxis), (across, up), steps, strict=True):
        axis.set_label_text(name)
        axis.set_ticks(range(0, len(ticks), step), [*map(signs, ticks[::step])])
    bar = ax.figure.colorbar(image, ax=ax, label=what)
    if not is_log:
        bar.ax.yaxis.set_major_locator(MaxNLocator(nbins=5))
    bar.outline.set_edgecolor(GREY)
