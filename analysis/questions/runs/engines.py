"""How friction law, smoothing, threshold of sticking and tolerance change each statistic on the same matrices.

The exact engine at its tightest tolerance is the reference for other engines. It is also the reference for further
thresholds of sticking, which are applied to the same runs; if it did not run, the runs' own definition is. The
tightest tolerance of an engine is the reference for its looser ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stickslip.analysis.answer import Answer
from stickslip.analysis.by_key import by_key
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.contrast import contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding, KeyChange
from stickslip.analysis.findings.place import Place, told_apart
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import ENDS, of_windows
from stickslip.analysis.members import ENGINE_KEYS, STEPS, TOLERANCES, WIDTHS, noun
from stickslip.analysis.outcomes import DIFFERENT, forest, in_words, outcomes
from stickslip.analysis.stats.estimates import UnitSums
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.steps import Kind, Step, Variant, few, judged_together, table_of
from stickslip.pipeline.design.labels import engine_name, engine_noun
from stickslip.pipeline.design.values import text

#: What is set beside a reference, of each kind.
_NOUNS: Mapping[Kind, str] = {
    Kind.LAW: "other method",
    Kind.TOLERANCE: "looser tolerance",
    Kind.THRESHOLD: "other threshold",
}
_BY_THRESHOLD = ("mean", "rate", "gamma")
_METHOD = (
    "Each system is compared with itself. Two settings agree if every statistic with a declared margin differs by"
    " less than its margin and no difference is significant; p-values are adjusted for the comparisons with one"
    " reference (Holm)."
)
#: What counts as sticking under a smoothed law, where further thresholds are compared.
_CRITERIA = {
    "manifold": " Smoothed blocks stick while they are on the slow manifold; with a threshold, while |w - v| <"
    " threshold \u00d7 eps.",
    "threshold": " Smoothed blocks stick while |w - v| < threshold \u00d7 eps.",
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


def answer(study: Study) -> Answer | None:
    """How each statistic depends on the engine and its settings; None where there is only one."""
    pairs, steps = study.once(compared)
    if not steps:
        return None
    judged = [(pair, step) for pair, step in zip(pairs, steps, strict=True) if step.contrast.is_known]
    unit, scope = noun(study.unit), ""
    if study.data.episodes is not None:
        scope = "the number of sticking blocks"
    lead, levels, in_figure, title = list[Finding](), list[Finding](), list[Step](), ""
    for kind in _NOUNS:
        of_kind = [(pair, step) for pair, step in judged if pair.kind is kind]
        for reference, beside in by_key(of_kind, lambda entry: _other(entry[0], study.groups)).items():
            steps_beside = [step for _, step in beside]
            steps_beside.sort(key=lambda step: (step.name.name, step.name.symbol, step.name.value or 0.0))
            lead += outcomes(reference, steps_beside, unit, _NOUNS[kind], scope)
            steps_beside.sort(key=lambda step: not step.contrast.is_shown)
            levels += [step.level(reference, unit) for step in steps_beside]
            if not in_figure:
                in_figure, title = steps_beside, f"differences from {reference}"
    figures = forest(study, in_figure, title)
    lack = few("how far statistics of motion differ between engines", study.groups)
    criteria = {str(pair.group.key["stick"]) for pair in pairs if pair.threshold is not None}
    method = _METHOD + "".join(_CRITERIA.get(stick, "") for stick in sorted(criteria)[:1])
    findings = [*lead, *levels] if lead else [lack]
    return Answer(findings, len(lead), method=method, tables={"changes": table_of(steps)}, figures=figures)


def compared(study: Study) -> tuple[list[_Pair], list[Step]]:
    """Every statistic of each pair, judged together with what has the same reference."""
    thresholds = _thresholds(study)
    where = told_apart([group.label for group in study.groups])
    pairs, unjudged = list[_Pair](), list[Step]()
    for pair in _pairs(study, thresholds):
        of_pair = [*_steps(study, pair, where[pair.group.label], thresholds)]
        pairs += [pair] * len(of_pair)
        unjudged += of_pair
    return pairs, judged_together(unjudged, 1 - study.settings.confidence)


def between_engines(study: Study, key: str) -> Iterator[Step]:
    """The steps of a quantity of n_stick from one engine or setting of it to another, as `changes` judges them."""
    for step in study.once(compared)[1]:
        is_known = step.contrast.is_known and not step.contrast.reason
        if step.kind is Kind.LAW and step.statistic == QUANTITIES[key].label and is_known:
            yield step


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
        reference, setting = measure.of(pair.reference), measure.of(pair.group)
        second, withheld = setting.sums, reference.withheld or setting.withheld
        if pair.threshold is not None:
            second = thresholds[pair.group.label, pair.threshold][measure.key]
        difference = contrast(
            measure.statistic, reference.sums, second, True, study.settings.confidence, withheld=withheld
        )
        yield Step(pair.kind, pair.group.label, pair.reference.label, difference, keys, where, name)


def _other(pair: _Pair, groups: Sequence[Group]) -> str:
    """What a pair is compared with, as a noun phrase."""
    if pair.kind is Kind.TOLERANCE:
        return "the tightest tolerance"
    if pair.kind is Kind.THRESHOLD and pair.reference is pair.group:
        return "its own definition of sticking"
    (words,) = in_words({_engine(pair.reference, groups): DIFFERENT}, DIFFERENT)
    return engine_noun(pair.reference.key["engine"], words)


def _setting(pair: _Pair, groups: Sequence[Group]) -> Variant:
    """What is compared: an engine, and what tells it from others of that engine."""
    key = pair.group.key
    engine = engine_name(key["engine"])
    if pair.threshold is not None:
        return Variant(engine, Kind.THRESHOLD.value, pair.threshold)
    if pair.kind is Kind.TOLERANCE:
        tolerance = next(name for name in TOLERANCES if key[name] is not None)
        return Variant(engine, tolerance, float(key[tolerance]))
    return _engine(pair.group, groups)


def _engine(group: Group, groups: Sequence[Group]) -> Variant:
    """An engine, with the number that tells its settings apart, or several."""
    key = group.key
    engine = engine_name(key["engine"])
    alike = [sibling.key for sibling in groups if sibling.key["engine"] == key["engine"]]
    differ = [name for name in (*WIDTHS, *STEPS) if len({sibling[name] for sibling in alike}) > 1]
    if len(differ) == 1 and key[differ[0]] is not None:
        return Variant(engine, differ[0], float(key[differ[0]]))
    values = ", ".join(f"{name} = {text(key[name])}" for name in differ if key[name] is not None)
    return Variant(f"{engine} with {values}" if values else engine)


def _thresholds(study: Study) -> _Thresholds:
    """The sums under further thresholds of sticking; one pass over the runs."""
    rows: dict[tuple[str, float], list[tuple[int, np.ndarray]]] = {}
    for group in study.groups if study.data.thresholds else ():
        moving = group.moving
        for unit, member_id, t_end in zip(moving["unit"], moving["member_id"], moving["t_end"], strict=True):
            if (of_run := study.by_threshold(str(member_id), float(t_end))) is not None:
                values, runs = of_run
                sums = np.stack([QUANTITIES[name].sums(runs) for name in _BY_THRESHOLD], axis=1)
                for threshold, of_threshold in zip(values, sums, strict=True):
                    rows.setdefault((group.label, threshold), []).append((int(unit), of_threshold))
    thresholds = {}
    for place, of_runs in rows.items():
        units, of_units = zip(*of_runs, strict=True)
        by_name = zip(_BY_THRESHOLD, np.swapaxes(of_units, 0, 1), strict=True)
        thresholds[place] = {name: UnitSums.of(units, sums) for name, sums in by_name}
    return thresholds


def _pairs(study: Study, thresholds: _Thresholds) -> Iterator[_Pair]:
    """The comparisons, by kind; a looser tolerance is compared with the tightest of its own engine only."""
    engine_keys = [name for name in ENGINE_KEYS if name not in TOLERANCES]
    for groups in by_key(study.groups, lambda group: group.system).values():
        in_order = sorted(groups, key=fineness)
        families = [*by_key(in_order, lambda group: tuple(group.key[name] for name in engine_keys)).values()]
        tightest = [family[0] for family in families]
        yield from (_Pair(Kind.LAW, tightest[0], group) for group in tightest[1:])
        for tight, *looser in families:
            yield from (_Pair(Kind.TOLERANCE, tight, group) for group in looser)
            exact = tightest[0] if tightest[0].is_exact else tight
            values = sorted(threshold for label, threshold in thresholds if label == tight.label)
            yield from (_Pair(Kind.THRESHOLD, exact, tight, threshold) for threshold in values)
