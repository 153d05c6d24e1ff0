"""How friction law, smoothing, threshold of sticking and tolerance change each statistic on the same matrices.

The exact engine at its tightest tolerance is the reference for other engines. It is also the reference for further
thresholds of sticking, which are applied to the same runs; if it did not run, the runs' own definition is. The
tightest tolerance of an engine is the reference for its looser ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from stickslip.analysis.answer import Answer, frame
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.contrast import CHANGES, Contrast, Sample, contrast, judged, sample, shares, statistics
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Finding, Lack, Reason, Verdict
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, STEPS, SYSTEM_KEYS, TOLERANCES, WIDTHS, noun
from stickslip.analysis.outcomes import DIFFERENT, Beside, Setting, forest, in_words, outcomes
from stickslip.analysis.stats.estimates import UnitSums
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.pipeline.design.labels import Label, apart, engine_name
from stickslip.pipeline.design.values import text

FRICTION, TOLERANCE, THRESHOLD = "law", "tolerance", "threshold"
#: Smoothing does not explain a difference between engines of more than this many margins, for eps up to _SMOOTH: the
#: sigmoid differs from the exact engine by O(eps), 3% in mean n_stick at eps = 0.03. Above, the limit grows with eps.
_EXPLAINED, _SMOOTH = 2.0, 0.03
#: Nor is it known what smoothing explains for eps beyond this share of the belt's speed: at 0.3 of it the mean
#: n_stick of 200 blocks was a third below the exact law's, at 0.1 a twentieth.
_OF_BELT = 0.15 * (1 + 1e-9)
_BY_THRESHOLD = ("mean", "rate", "gamma")
_METHOD = (
    "Each system is compared with itself. A setting agrees if each statistic with a margin that the scene declares is"
    " within, and no difference is shown; verdicts are adjusted for the comparisons with one reference (Holm)."
)


@dataclass(frozen=True)
class _Pair:
    """A group and its reference; `threshold` is a further definition of sticking, applied to the group's runs."""

    kind: str
    reference: Group
    other: Group
    threshold: float | None = None


@dataclass(frozen=True)
class _Compared:
    """A pair, and one of its statistics."""

    pair: _Pair
    contrast: Contrast

    @property
    def statistic(self) -> str:
        return self.contrast.statistic.name


def answer(study: Study) -> Answer | None:
    """How each statistic depends on the engine and its settings; None where there is only one."""
    by_threshold = _by_threshold(study)
    pairs = list(_pairs(study, by_threshold))
    if not pairs:
        return None
    found = _judged(study, pairs, by_threshold)
    rows = [
        {"kind": one.pair.kind, "setting": one.pair.other.label, "reference": one.pair.reference.label,
         "key": None if one.pair.threshold is None else THRESHOLD,
         "second_value": None if one.pair.threshold is None else f"{one.pair.threshold:g}", **one.contrast.row()}
        for one in found
    ]  # fmt: skip
    tables = {"changes": frame(CHANGES, rows)}
    known = [one for one in found if one.contrast.is_known]
    if not known:
        n_units = max(one.contrast.n_first for one in found)
        reason = Reason.FEW_UNITS if n_units else Reason.NO_MOTION
        return Answer(findings=[Lack("how far the engines differ", reason)], tables=tables)
    unit = noun(study.unit)
    scope = "" if study.data.episodes is None else "the number of sticking blocks and slip onsets"
    names = _names(study, found)
    lead: list[Finding] = []
    levels: list[Finding] = []
    drawn: list[Beside] = []
    for kind in (FRICTION, TOLERANCE, THRESHOLD):
        of_kind = [one for one in known if one.pair.kind == kind]
        for other, some in _by_reference(of_kind, study.groups):
            placed = {
                setting: [Beside(one.contrast, _where(one.pair, names)) for one in rows] for setting, rows in some
            }
            lead += outcomes(other, placed, unit, scope)
            every = [one for rows in placed.values() for one in rows]
            every.sort(key=lambda one: not one.contrast.is_shown)
            levels += [one.contrast.level(one.where, other, unit) for one in every]
            drawn = drawn or every
    return Answer(
        tables=tables, figures=forest(drawn, "Differences from the reference"), findings=[*lead, *levels],
        n_lead=min(3, len(lead)), alerts=_suspects(known), method=_METHOD,
    )  # fmt: skip


def _judged(
    study: Study, pairs: Sequence[_Pair], by_threshold: Mapping[str, Mapping[float, Sample]]
) -> list[_Compared]:
    """Each statistic of each pair, those with one reference judged together."""
    level = study.settings.confidence
    families: dict[tuple[str, str], list[_Compared]] = {}
    for pair in pairs:
        asked = statistics(study.margins, study.compared & {*_BY_THRESHOLD})
        if pair.threshold is None:
            asked = [*statistics(study.margins, study.compared), *shares()]
        family = families.setdefault((pair.kind, pair.reference.label), [])
        for statistic in asked:  # one by one: sums of all take more memory than all that is known of the runs
            theirs = (
                sample(pair.other, [statistic.name])
                if pair.threshold is None
                else by_threshold[pair.other.label][pair.threshold]
            )
            mine = sample(pair.reference, [statistic.name])
            family.append(_Compared(pair, contrast(statistic, mine, theirs, True, level)))
    return [
        _Compared(one.pair, found)
        for family in families.values()
        for one, found in zip(family, judged([one.contrast for one in family], 1 - level), strict=True)
    ]


def _by_reference(
    found: Sequence[_Compared], groups: Sequence[Group]
) -> Iterator[tuple[str, list[tuple[Setting, list[_Compared]]]]]:
    """Comparisons of one kind by the name of their reference, and by setting, finer ones first."""
    by_other: dict[str, dict[Setting, list[_Compared]]] = {}
    for one in found:
        by_other.setdefault(_other(one.pair, groups), {}).setdefault(_setting(one.pair, groups), []).append(one)
    for other, some in by_other.items():
        in_order = sorted(some.items(), key=lambda item: (item[0].name, item[0].symbol, item[0].value or 0.0))
        yield other, in_order


def _other(pair: _Pair, groups: Sequence[Group]) -> str:
    """What a pair is compared with, as a noun phrase."""
    if pair.kind == TOLERANCE:
        return "the tightest tolerance"
    if pair.kind == THRESHOLD and pair.reference is pair.other:
        return "its own definition of sticking"
    (name,) = in_words({_engine(pair.reference, groups): DIFFERENT}, DIFFERENT)
    return name


def _setting(pair: _Pair, groups: Sequence[Group]) -> Setting:
    """What is compared: an engine, and what tells it from others of that engine."""
    key = pair.other.key
    engine = engine_name(key["engine"])
    if pair.threshold is not None:
        return Setting(engine, THRESHOLD, pair.threshold)
    if pair.kind == TOLERANCE:
        tolerance = next(name for name in TOLERANCES if key[name] is not None)
        return Setting(engine, tolerance, float(key[tolerance]))
    return _engine(pair.other, groups)


def _engine(group: Group, groups: Sequence[Group]) -> Setting:
    """An engine, with the number that tells its settings apart, or several."""
    key = group.key
    engine = engine_name(key["engine"])
    others = [other.key for other in groups if other.key["engine"] == key["engine"]]
    differ = [name for name in (*WIDTHS, *STEPS) if len({other[name] for other in others}) > 1]
    if len(differ) == 1 and key[differ[0]] is not None:
        return Setting(engine, differ[0], float(key[differ[0]]))
    said = ", ".join(f"{name} = {text(key[name])}" for name in differ if key[name] is not None)
    return Setting(f"{engine} with {said}" if said else engine)


def _names(study: Study, found: Sequence[_Compared]) -> dict[str, Label]:
    """What tells each group that is compared from the others, by label."""
    labels = [group.name for group in study.groups]
    of = {one.pair.other.label for one in found}
    return {label: name for label, name in zip(labels, apart(labels), strict=True) if label in of}


def _where(pair: _Pair, names: Mapping[str, Label]) -> Place:
    method = Place.of(names[pair.other.label])
    return method if pair.threshold is None else method + Place.key(THRESHOLD, f"{pair.threshold:g}")


def _by_threshold(study: Study) -> dict[str, dict[float, Sample]]:
    """Samples under further thresholds of sticking, by label of the group and threshold; one pass over the runs."""
    if not study.data.thresholds:
        return {}
    runs = {
        str(member_id): (group.label, int(unit), float(t_end))
        for group in study.groups
        for moving in [group.moving]
        for unit, member_id, t_end in zip(*(moving[name] for name in ("unit", "member_id", "t_end")),
                                            strict=True)
    }  # fmt: skip
    rows: dict[tuple[str, float], list[tuple[int, list[np.ndarray]]]] = {}
    for member_id in study.data.thresholds:
        if member_id in runs:
            label, unit, t_end = runs[member_id]
            for threshold, win in study.by_threshold(member_id, t_end).items():
                sums = [QUANTITIES[name].sums(win.alone)[0] for name in _BY_THRESHOLD]
                rows.setdefault((label, threshold), []).append((unit, sums))
    found: dict[str, dict[float, Sample]] = {}
    for (label, threshold), some in rows.items():
        units, sums = zip(*some, strict=True)
        held = {
            QUANTITIES[name].label: UnitSums.of(units, of)
            for name, of in zip(_BY_THRESHOLD, np.swapaxes(sums, 0, 1), strict=True)
        }
        found.setdefault(label, {})[threshold] = Sample(held)
    return found


def _pairs(study: Study, by_threshold: Mapping[str, Mapping[float, Sample]]) -> Iterator[_Pair]:
    """The comparisons, by kind; a looser tolerance is compared with the tightest of its own engine only."""
    systems: dict[tuple[Any, ...], list[Group]] = {}
    for group in study.groups:
        systems.setdefault(tuple(group.key[name] for name in SYSTEM_KEYS), []).append(group)
    for some in systems.values():
        families: dict[tuple[Any, ...], list[Group]] = {}
        for group in sorted(some, key=fineness):
            kept = tuple(group.key[name] for name in ENGINE_KEYS if name not in TOLERANCES)
            families.setdefault(kept, []).append(group)
        tightest = [family[0] for family in families.values()]
        yield from (_Pair(FRICTION, tightest[0], group) for group in tightest[1:])
        for family in families.values():
            yield from (_Pair(TOLERANCE, family[0], group) for group in family[1:])
            exact = tightest[0] if tightest[0].is_exact else family[0]
            yield from (_Pair(THRESHOLD, exact, family[0], c) for c in sorted(by_threshold.get(family[0].label, ())))


def _suspects(found: Sequence[_Compared]) -> list[Alert]:
    """One alert for each setting that differs from an exact engine by more than smoothing explains."""
    suspect = [one for one in found if _is_suspect(one) and not _agrees_with_less(one, found)]
    alerts = []
    for label, some in groupby(suspect, key=lambda one: one.pair.other.label):
        contrasts = [one.contrast for one in some]
        alerts.append(Alert.of(Code.SUSPECT, what=contrasts[0].statistic.quantity.name, where=str(label)))
    return alerts


def _width(group: Group) -> float | None:
    return next((float(group.key[name]) for name in WIDTHS if group.key[name] is not None), None)


def _is_suspect(one: _Compared) -> bool:
    """Whether a statistic differs between an exact engine and a smoothed law by more than smoothing explains.

    It does if the difference is shown and its whole interval lies beyond `_EXPLAINED` margins times
    max(1, width / _SMOOTH). If one value is zero there is no relative difference: then the statistic is suspect if
    the interval of the other value excludes zero. Two exact or two smoothed settings are not judged, nor what has no
    margin. Nor is static friction above the kinetic, where a smoothed block creeps before it slips and may never
    slip, nor a slow belt, of whose speed the width is more than `_OF_BELT`.
    """
    pair, found = one.pair, one.contrast
    width, margin = _width(pair.other), found.statistic.margin
    reference = pair.reference
    is_static = reference.key["static"] is not None or "static" in reference.table.design.values(reference.point)
    if pair.kind != FRICTION or width is None or _width(reference) is not None or is_static or margin is None:
        return False
    belt = pair.other.key["belt_speed"]
    if belt is not None and width > _OF_BELT * abs(belt):
        return False
    if (found.first.value == 0.0) != (found.second.value == 0.0):
        low = found.second.low if found.first.value == 0.0 else found.first.low
        return low is not None and low > 0.0
    low, high = found.relative.low, found.relative.high
    allowed = _EXPLAINED * margin * max(1.0, width / _SMOOTH)
    return found.is_shown and low is not None and high is not None and (low > allowed or high < -allowed)


def _agrees_with_less(one: _Compared, found: Sequence[_Compared]) -> bool:
    """Whether the same statistic agrees under the same law with less smoothing."""
    width = _width(one.pair.other)
    return any(
        (other.statistic, other.pair.kind, other.pair.reference) == (one.statistic, one.pair.kind, one.pair.reference)
        and other.contrast.verdict in (Verdict.EQUAL, Verdict.SAME)
        and (_width(other.pair.other) or np.inf) < (width or 0.0)
        for other in found
    )
