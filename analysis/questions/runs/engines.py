"""How friction law, smoothing, threshold of sticking and tolerance change each statistic on the same matrices.

The exact engine at its tightest tolerance is the reference for other engines. It is also the reference for further
thresholds of sticking, which are applied to the same runs; if it did not run, the runs' own definition is. The
tightest tolerance of an engine is the reference for its looser ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TypeAlias

import numpy as np

from stickslip.analysis.catalogues import fineness
from stickslip.analysis.contrast import contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Finding, KeyChange, Verdict
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import ENDS, of_windows
from stickslip.analysis.members import ENGINE_KEYS, STEPS, SYSTEM_KEYS, TOLERANCES, WIDTHS, noun
from stickslip.analysis.outcomes import DIFFERENT, forest, in_words, outcomes
from stickslip.analysis.stats.estimates import UnitSums
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.steps import Kind, Section, Setting, Step, few, judged_together
from stickslip.pipeline.design.labels import apart, engine_name
from stickslip.pipeline.design.values import text

#: Smoothing does not explain a difference between engines of more than this many margins, for eps up to _SMOOTH: the
#: sigmoid differs from the exact engine by O(eps), 3% in mean n_stick at eps = 0.03. Above, the limit grows with eps.
_EXPLAINED, _SMOOTH = 2.0, 0.03
#: Nor is it known what smoothing explains for eps beyond this share of the belt's speed: at 0.3 of it the mean
#: n_stick of 200 blocks was a third below the exact law's, at 0.1 a twentieth.
_OF_BELT = 0.15 * (1 + 1e-9)
#: What is set beside a reference, of each kind.
_NOUNS: Mapping[Kind, str] = {
    Kind.LAW: "other method",
    Kind.TOLERANCE: "looser tolerance",
    Kind.THRESHOLD: "other threshold",
}
_BY_THRESHOLD = ("mean", "rate", "gamma")
_METHOD = (
    "Each system is compared with itself. Two settings agree if every statistic with a declared margin differs by"
    " less than its margin and no difference is significant; verdicts are adjusted for the comparisons with one"
    " reference (Holm)."
)
#: What counts as sticking under a smoothed law, where further thresholds are compared.
_CRITERIA = {
    "manifold": " Smoothed blocks stick while they are on the slow manifold; with a threshold, while |w - v| <"
    " threshold eps.",
    "threshold": " Smoothed blocks stick while |w - v| < threshold eps.",
}
#: Sums of each statistic of the runs of a group, by its label, under a further threshold of sticking.
_Thresholds: TypeAlias = Mapping[tuple[str, float], Mapping[str, UnitSums]]


@dataclass(frozen=True)
class _Pair:
    """A group and its reference; `threshold` is a further definition of sticking, applied to the group's runs."""

    kind: Kind
    reference: Group
    group: Group
    threshold: float | None = None


def section(study: Study) -> Section | None:
    """How each statistic depends on the engine and its settings; None where there is only one."""
    thresholds = _thresholds(study)
    labels = [group.name for group in study.groups]
    names = dict(zip(labels, apart(labels), strict=True))
    compared = [
        (pair, step)
        for pair in _pairs(study, thresholds)
        for step in _steps(study, pair, Place.of(names[pair.group.name]), thresholds)
    ]
    if not compared:
        return None
    pairs, unjudged = zip(*compared, strict=True)
    steps = judged_together(unjudged, 1 - study.settings.confidence)
    judged = [(pair, step) for pair, step in zip(pairs, steps, strict=True) if step.contrast.is_known]
    unit, scope = noun(study.unit), ""
    if study.data.episodes is not None:
        scope = "sticking blocks and slip onsets"
    lead, levels, in_figure = list[Finding](), list[Finding](), list[Step]()
    for kind in _NOUNS:
        by_other: dict[str, list[Step]] = {}
        for pair, step in judged:
            if pair.kind is kind:
                by_other.setdefault(_other(pair, study.groups), []).append(step)
        for other, steps_beside in by_other.items():
            steps_beside.sort(key=lambda step: (step.name.name, step.name.symbol, step.name.value or 0.0))
            lead += outcomes(other, steps_beside, unit, _NOUNS[kind], scope)
            steps_beside.sort(key=lambda step: not step.contrast.is_shown)
            levels += [step.level(other, unit) for step in steps_beside]
            in_figure = in_figure or steps_beside
    figures = forest(in_figure, "Differences from the reference")
    lack = few("how far the engines differ", max(step.contrast.n_first for step in steps))
    criteria = {str(pair.group.key["stick"]) for pair in pairs if pair.threshold is not None}
    method = _METHOD + "".join(_CRITERIA.get(stick, "") for stick in sorted(criteria)[:1])
    return Section(lack, steps, lead, levels, _suspects(judged), figures, method=method)


def _steps(study: Study, pair: _Pair, where: Place, thresholds: _Thresholds) -> Iterator[Step]:
    """Each statistic of a pair; one by one, as sums of all take more memory than all that is known of the runs."""
    name, keys, measures = _setting(pair, study.groups), tuple[KeyChange, ...](), [*of_windows(study), *ENDS]
    if pair.kind is Kind.LAW and thresholds and pair.group.key["stick"] == "manifold":
        name = name._replace(name=f"{name.name} (sticking on the slow manifold)")
    if pair.threshold is not None:
        threshold, measures = f"{pair.threshold:g}", of_windows(study, _BY_THRESHOLD)
        keys = (KeyChange(Kind.THRESHOLD.value, "", threshold),)
        where += Place.key(Kind.THRESHOLD.value, threshold)
    for measure in measures:
        before, after = measure.of(pair.reference), measure.of(pair.group)
        second, withheld = after.sums, before.withheld or after.withheld
        if pair.threshold is not None:
            second = thresholds[pair.group.label, pair.threshold][measure.key]
        difference = contrast(
            measure.statistic, before.sums, second, True, study.settings.confidence, withheld=withheld
        )
        yield Step(pair.kind, pair.group.label, pair.reference.label, difference, keys, where, name)


def _other(pair: _Pair, groups: Sequence[Group]) -> str:
    """What a pair is compared with, as a noun phrase."""
    if pair.kind is Kind.TOLERANCE:
        return "the tightest tolerance"
    if pair.kind is Kind.THRESHOLD and pair.reference is pair.group:
        return "its own definition of sticking"
    (name,) = in_words({_engine(pair.reference, groups): DIFFERENT}, DIFFERENT)
    return name


def _setting(pair: _Pair, groups: Sequence[Group]) -> Setting:
    """What is compared: an engine, and what tells it from others of that engine."""
    key = pair.group.key
    engine = engine_name(key["engine"])
    if pair.threshold is not None:
        return Setting(engine, Kind.THRESHOLD.value, pair.threshold)
    if pair.kind is Kind.TOLERANCE:
        tolerance = next(name for name in TOLERANCES if key[name] is not None)
        return Setting(engine, tolerance, float(key[tolerance]))
    return _engine(pair.group, groups)


def _engine(group: Group, groups: Sequence[Group]) -> Setting:
    """An engine, with the number that tells its settings apart, or several."""
    key = group.key
    engine = engine_name(key["engine"])
    alike = [other.key for other in groups if other.key["engine"] == key["engine"]]
    differ = [name for name in (*WIDTHS, *STEPS) if len({other[name] for other in alike}) > 1]
    if len(differ) == 1 and key[differ[0]] is not None:
        return Setting(engine, differ[0], float(key[differ[0]]))
    values = ", ".join(f"{name} = {text(key[name])}" for name in differ if key[name] is not None)
    return Setting(f"{engine} with {values}" if values else engine)


def _thresholds(study: Study) -> _Thresholds:
    """The sums under further thresholds of sticking; one pass over the runs."""
    rows: dict[tuple[str, float], list[tuple[int, list[np.ndarray]]]] = {}
    for group in study.groups if study.data.thresholds else ():
        moving = group.moving
        for unit, member_id, t_end in zip(moving["unit"], moving["member_id"], moving["t_end"], strict=True):
            for threshold, win in study.by_threshold(str(member_id), float(t_end)).items():
                sums = [QUANTITIES[name].sums(win.alone)[0] for name in _BY_THRESHOLD]
                rows.setdefault((group.label, threshold), []).append((int(unit), sums))
    thresholds = {}
    for place, of_runs in rows.items():
        units, sums = zip(*of_runs, strict=True)
        by_name = zip(_BY_THRESHOLD, np.swapaxes(sums, 0, 1), strict=True)
        thresholds[place] = {name: UnitSums.of(units, of_units) for name, of_units in by_name}
    return thresholds


def _pairs(study: Study, thresholds: _Thresholds) -> Iterator[_Pair]:
    """The comparisons, by kind; a looser tolerance is compared with the tightest of its own engine only."""
    systems: dict[tuple[object, ...], list[Group]] = {}
    for group in study.groups:
        systems.setdefault(tuple(group.key[name] for name in SYSTEM_KEYS), []).append(group)
    for groups in systems.values():
        families: dict[tuple[object, ...], list[Group]] = {}
        for group in sorted(groups, key=fineness):
            engine = tuple(group.key[name] for name in ENGINE_KEYS if name not in TOLERANCES)
            families.setdefault(engine, []).append(group)
        tightest = [family[0] for family in families.values()]
        yield from (_Pair(Kind.LAW, tightest[0], group) for group in tightest[1:])
        for first, *looser in families.values():
            yield from (_Pair(Kind.TOLERANCE, first, group) for group in looser)
            exact = tightest[0] if tightest[0].is_exact else first
            values = sorted(threshold for label, threshold in thresholds if label == first.label)
            yield from (_Pair(Kind.THRESHOLD, exact, first, threshold) for threshold in values)


def _suspects(judged: Sequence[tuple[_Pair, Step]]) -> list[Alert]:
    """One alert for each setting that differs from an exact engine by more than smoothing explains."""
    suspects = [
        step for pair, step in judged if _is_suspect(pair, step) and not _agrees_with_less(pair, step, judged)
    ]
    return [
        Alert.of(Code.SUSPECT, what=next(steps).contrast.statistic.quantity.name, where=str(label))
        for label, steps in groupby(suspects, key=lambda step: step.setting)
    ]


def _width(group: Group) -> float | None:
    return next((float(group.key[name]) for name in WIDTHS if group.key[name] is not None), None)


def _is_suspect(pair: _Pair, step: Step) -> bool:
    """Whether a statistic differs between an exact engine and a smoothed law by more than smoothing explains.

    It does if the difference is shown and its whole interval lies beyond `_EXPLAINED` margins times
    max(1, width / _SMOOTH). If one value is zero there is no relative difference: then the statistic is suspect if
    the interval of the other value excludes zero. Two exact or two smoothed settings are not judged, nor what has no
    margin. Nor is static friction above the kinetic, where a smoothed block creeps before it slips and may never
    slip, nor a slow belt, of whose speed the width is more than `_OF_BELT`.
    """
    difference, reference, width = step.contrast, pair.reference, _width(pair.group)
    margin, belt = difference.statistic.margin, pair.group.key["belt_speed"]
    if pair.kind is not Kind.LAW or width is None or _width(reference) is not None or margin is None:
        return False
    is_static = reference.key["static"] is not None or "static" in reference.table.design.values(reference.point)
    if is_static or (belt is not None and width > _OF_BELT * abs(belt)):
        return False
    if (difference.first.value == 0.0) != (difference.second.value == 0.0):
        low = difference.second.low if difference.first.value == 0.0 else difference.first.low
        return low is not None and low > 0.0
    low, high = difference.relative.low, difference.relative.high
    allowed = _EXPLAINED * margin * max(1.0, width / _SMOOTH)
    return difference.is_shown and low is not None and high is not None and (low > allowed or high < -allowed)


def _agrees_with_less(pair: _Pair, step: Step, judged: Sequence[tuple[_Pair, Step]]) -> bool:
    """Whether the same statistic agrees under the same law with less smoothing."""
    width = _width(pair.group) or 0.0
    return any(
        (other.statistic, other.kind, other.reference) == (step.statistic, step.kind, step.reference)
        and other.contrast.verdict in (Verdict.EQUAL, Verdict.SAME)
        and (_width(less.group) or np.inf) < width
        for less, other in judged
    )
