"""Episodes: how often, how large; the law of their moments; how much all this depends on the method.

An episode lasts from all blocks stuck to all stuck again. Those that begin within [t_burn, t_end] count. Every method
is compared with the finest on the same systems, by the magnitudes too: a mean may be right where the law is not.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from stickslip.analysis.answer import Answer, Picture, Question
from stickslip.analysis.catalogues import Catalogues, bent, fineness, read, systems
from stickslip.analysis.contrast import Contrast, Statistic, contrast
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code, drift
from stickslip.analysis.findings.finding import (
    Basis,
    Change,
    Comparison,
    Difference,
    Finding,
    Fit,
    Form,
    KeyChange,
    Lack,
    Law,
    Level,
    Outcomes,
    Quantity,
    Reason,
    Scale,
)
from stickslip.analysis.findings.numbers import number
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import capital, listed, plural
from stickslip.analysis.members import DRAWN, noun
from stickslip.analysis.methods import MAGNITUDES, PRIMARY, Apart, compare, names, settings_of
from stickslip.analysis.models.episodes import (
    BY_WAY,
    CREEP,
    DURATION,
    OCCUPANCY,
    QUANTITIES,
    RATE,
    REST,
    SIZE,
    SLIP,
    SLOW_DRIVE,
    STORED,
    Catalogue,
)
from stickslip.analysis.models.magnitudes import WIDTH, misfit
from stickslip.analysis.models.magnitudes import Picture as Kind
from stickslip.analysis.models.recurrence import Bin
from stickslip.analysis.outcomes import DIFFERENT, UNDECIDED, in_words
from stickslip.analysis.questions.runs.engines import between_engines
from stickslip.analysis.rows import Columns, frame_by, frame_of
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, within
from stickslip.analysis.steps import table_of
from stickslip.analysis.style import GREY, hues, panel

ROUNDING = 1e-9  # of the belt's travel: what ten million steps of one rounding each may leave of it
SLOW = 0.05  # largest share of time in episodes if the drive is slow for the chain
CLASS = 0.1  # width of a class of magnitudes, as catalogues round them
MOST_DRAWN = 8  # groups in the figure of magnitudes
FEWEST_IN_BIN = 5  # events in a bin of times, if any, for it to be drawn
_METHOD = (
    "An episode lasts from all blocks stuck to all stuck again; its size is the number of blocks that slip, its"
    " moment the sum of their slips, its magnitude log10 of that. Methods are compared on the same systems: a method"
    " differs if its rate, mean size or mean duration of episodes, its rate of slip onsets (t tests), if these have"
    " times, or its distribution of magnitudes (permutation test) does. p-values are adjusted (Holm) for the tests of"
    " rates and magnitudes, and for others. A power law is fitted on the widest range on which the distribution"
    " functions of data and law differ by less than 2%, or by chance; b of two datasets can be compared on one range,"
    " [analysis] magnitude_range."
)
#: What follows the name of a power law in a sentence, and that of one whose cut-off is shown.
BEYOND: Mapping[Kind, str] = {Kind.POWER: "", Kind.CUT_OFF: "", Kind.PEAK: ", below a peak,"}
POWER_LAW, WITH_CUT_OFF = "power law", "power law with an exponential cut-off"
#: What is said of each group, in this order.
WORDS: Mapping[str, Quantity] = {
    RATE: Quantity("rate", "rate of episodes", things="episodes", dimension="frequency"),
    SIZE: Quantity("size", "mean size of episodes"),
    DURATION: Quantity(
        "duration", "mean duration of episodes", more="longer than", less="shorter than", dimension="time"
    ),
    SLIP: Quantity("slip", "share of the belt's travel that is slip in episodes", Form.SHARE),
    STORED: Quantity("stored", "share of the belt's travel that is stored as strain", Form.SHARE),
    CREEP: Quantity("creep", "share of the belt's travel that is creep of stuck blocks", Form.SHARE),
    OCCUPANCY: Quantity("occupancy", "share of the time in which at least one block slips", Form.SHARE),
}
_SCOPE, _AND_ONSETS = "the rate, size, duration and magnitudes of episodes", ", and the rate of slip onsets"
ONSETS = "rate of slip onsets"
_BY = (RATE, ONSETS, SIZE, DURATION, MAGNITUDES)  # what a method may differ in: the first that it does is said
_RELATIVE = (RATE, SIZE, DURATION, ONSETS)  # what differs in per cent
IN_RANGE = Quantity("in_range", "share of episodes in the range of b", Form.SHARE)
BELOW = Quantity("below_range", "share of episodes below the range of b", Form.SHARE)
ATOM = Quantity("atom", "share of episodes with the smallest moment", Form.SHARE)
MISFIT = Quantity("misfit", "largest difference of distribution functions, data and law", Form.SHARE)
PEAK = Quantity("peak", "share of episodes in the peak", Form.SHARE)
PEAK_MOMENT = Quantity("peak_moment", "share of the moment in the peak", Form.SHARE)
M_CUT = Quantity("cut_off", "magnitude of the cut-off")
WHOLE = Quantity("whole", "share of episodes that take all blocks", Form.SHARE)
BETWEEN = Quantity("between", "mean time between large events", more="longer than", less="shorter than")
REGULARITY = Quantity("large_cv", "coefficient of variation of times between large events")
SLIP_PREDICTABLE = Quantity("before", "rank correlation of large moments with the time before")
TIME_PREDICTABLE = Quantity("after", "rank correlation of large moments with the time after")
B_POSITIVE = Quantity("b_positive", "b-value from rises alone (b-positive)")
B_VALUE = Quantity("b", "b-value")
B_WITH_CUT_OFF = replace(B_VALUE, name=f"b-value of a {WITH_CUT_OFF}")
MOMENT = Quantity("moment", "mean moment", dimension="length")
BY_TRAVEL = Quantity("by_travel", "number of episodes per block and unit of belt travel")
_POISSON = "1, that of a Poisson process"
_REASONS: Mapping[str, Reason] = {
    enough.FEW_MATRICES: Reason.FEW_UNITS,
    enough.FEW_CASCADES: Reason.FEW_EPISODES,
    enough.DRIFTS: Reason.DRIFT,
}


def _known(number: float) -> float | None:
    return None if np.isnan(number) else number


def _estimate(name: str, group: Catalogues) -> Estimate:
    """A quantity of a group."""
    return group.estimates[name]


_GROUPS: Columns[Catalogues] = {
    "group": (str, lambda group: group.label),
    "method": (str, lambda group: group.method),
    "n_systems": (int, lambda group: len(group.runs)),
    "n_episodes": (int, lambda group: group.n_episodes),
    "picture": (str, lambda group: group.law.picture),
    "why": (str, lambda group: group.law.why),
    "least": (float, lambda group: _known(group.law.least)),
    "most": (float, lambda group: _known(group.law.most)),
    "n_fitted": (int, lambda group: group.law.n_fitted),
    "b": (Estimate, lambda group: group.law.b),
    "b_positive": (Estimate, lambda group: group.b_positive),
    "cut_off": (Estimate, lambda group: group.law.cut_off),
    "in_range": (Estimate, lambda group: group.in_range),
    "below_range": (Estimate, lambda group: group.below_range),
    "misfit": (Estimate, lambda group: group.misfit),
    "over_log_normal": (Estimate, lambda group: group.law.ratios.get("log-normal", Estimate())),
    "over_exponential": (Estimate, lambda group: group.law.ratios.get("exponential", Estimate())),
    "atom": (Estimate, lambda group: group.in_atom),
    "peak_begins": (float, lambda group: group.law.begins),
    "peak": (Estimate, lambda group: group.in_peak[0]),
    "peak_moment": (Estimate, lambda group: group.in_peak[1]),
    "whole": (Estimate, lambda group: group.whole),
    **{name: (Estimate, partial(_estimate, name)) for name in (*QUANTITIES, *REST, *SLOW_DRIVE)},
    "drift": (Estimate, lambda group: group.basis.drift),
    "stuck_below": (float, lambda group: group.stuck_below),
    "basis": (str, lambda group: group.basis.code),
}
_RECURRENCE: Columns[Catalogues] = {
    "group": (str, lambda group: group.label),
    "least": (float, lambda group: group.recurrence.least),
    "n_times": (int, lambda group: group.recurrence.n_times),
    "n_cut": (int, lambda group: group.recurrence.n_cut),
    "mean": (Estimate, lambda group: group.recurrence.mean),
    "cv": (Estimate, lambda group: group.recurrence.cv),
    "before": (Estimate, lambda group: group.recurrence.before),
    "after": (Estimate, lambda group: group.recurrence.after),
    "reason": (str, lambda group: group.recurrence.cv.reason),
}
_METHODS: Columns[Apart] = {
    "setting": (str, lambda apart: apart.setting.label),
    "reference": (str, lambda apart: apart.reference.label),
    "size": (Estimate, lambda apart: apart.contrast.absolute),
    "p_floor": (float, lambda apart: apart.p_floor),
    "p_different": (float, lambda apart: apart.contrast.p_different),
    "p_different_holm": (float, lambda apart: apart.contrast.family and apart.contrast.family.p_different),
    "reason": (str, lambda apart: apart.contrast.reason),
}


class Hazard(NamedTuple):
    """A bin of `models.recurrence`, of a group."""

    group: str
    what: str
    low: float
    high: float
    n_events: int
    relative: Estimate


class Upper(NamedTuple):
    """b on the part of a range from a magnitude on."""

    group: str
    least: float
    n_episodes: int
    b: Estimate


class Frequency(NamedTuple):
    """A class of magnitudes: its share of episodes per unit of magnitude, and what lies from it on.

    `rate` is the number of episodes of at least `magnitude` per unit time.
    """

    group: str
    magnitude: float
    density: float
    n_episodes: int
    rate: Estimate


def answer(study: Study) -> Answer | None:
    """What the episodes of an ensemble are like; None where none were recorded."""
    if study.data.episodes is None:
        return None
    groups, level = study.once(read), study.settings.confidence
    if not any(len(group.magnitudes()) for group in groups):
        why = "at least one block slips all the time, or none ever does" if groups else ""
        return Answer(findings=[Lack("episodes", Reason.NOTHING_COUNTED, why)])
    for group, method in zip(groups, names(groups), strict=True):
        group.method = method
        group.misfit = misfit(group.law, level, study.generator(f"misfit {group.label}"))
    counted = [group for group in groups if not _is_blurred(group)]
    by_system, judged = systems(counted), [group for group in counted if group.is_judged]
    tables = {"episodes": frame_by(_GROUPS, groups)}
    alerts = _alerts(study, groups, [reference for reference, *_ in by_system])
    if not judged:
        return Answer(findings=[_lack(study, counted)], alerts=alerts, tables=tables)
    lead = _lead(judged)
    leaders = [reference for reference, *_ in by_system if reference.is_judged] or [lead]
    pairs = [*compare(study, by_system), *_of_onsets(study, by_system)]
    rates = _rates(counted, leaders)
    tables |= {
        "episode_contrasts": table_of(pair.step for pair in pairs if pair.name not in (MAGNITUDES, ONSETS)),
        "episode_methods": frame_by(_METHODS, [pair for pair in pairs if pair.name == MAGNITUDES]),
        "episode_b": frame_of(Upper, [Upper(group.label, *row) for group in leaders for row in group.by_least]),
        "episode_rates": frame_of(Frequency, rates),
        "episode_recurrence": frame_by(_RECURRENCE, leaders),
        "episode_hazard": frame_of(
            Hazard, [Hazard(group.label, *row) for group in leaders for row in group.recurrence.bins]
        ),
    }
    basis = noun(study.unit)
    is_told = len(leaders) > 1 or lead is not by_system[0][0]
    places = {group.label: Place.of(group.method) if is_told else EVERYWHERE for group in leaders}
    in_order = sorted(leaders, key=lambda group: group is not lead)
    pictures = [_picture(study, group, places[group.label]) for group in in_order]
    outcomes = [
        outcome
        for reference, *settings in by_system
        if settings and reference.is_judged
        for outcome in _outcomes(reference, settings, pairs, basis)
    ]
    (law, *beside), changes = pictures[0], _changes(leaders, level, basis)
    rate, distances = _level(lead, RATE, pairs, basis), _distances(pairs, outcomes, basis)
    others = [*itertools.chain(*pictures[1:])]
    findings: list[Finding] = [law, *beside, rate, *others, *distances]
    if outcomes:
        findings = [*outcomes, rate, *distances, *changes, law, *beside, *others]
    elif changes:
        findings = [*changes, law, rate, *beside, *others, *distances]
    of_lead = () if study.data.is_loaded else (OCCUPANCY,)
    findings += [level for level in _levels(groups, lead, pairs, basis, of_lead) if level not in findings]
    return Answer(
        findings=findings,
        n_lead=min(3, len(outcomes) or 3),
        alerts=alerts,
        method=_METHOD,
        tables=tables,
        figures=_figures(study, counted, in_order, rates),
    )


# ------------------------------------------------------------------------------------------------ findings


def _lack(study: Study, groups: Sequence[Catalogues]) -> Lack:
    """Why no group can be judged: that with the most episodes."""
    if not groups:
        return Lack("the statistics of episodes", Reason.CREEP)
    richest = max(groups, key=lambda group: group.n_episodes)
    detail = f"{plural(len(richest.runs), noun(study.unit))}, {plural(richest.n_episodes, 'episode')}"
    return Lack("the statistics of episodes", _REASONS[richest.basis.code], detail)


def _level(group: Catalogues, name: str, apart: Sequence[Apart], unit: str) -> Level:
    """A statistic of a group, beside that of its reference."""
    estimate = group.estimates[name]
    beside = next((pair for pair in apart if pair.setting is group and pair.name == name), None)
    reference = None if beside is None else Comparison(beside.reference.noun, beside.contrast.difference)
    basis = Basis(len(group.sums[name].counted), unit)
    if name == CREEP and max(abs(end or 0.0) for end in (estimate.value, estimate.low, estimate.high)) < ROUNDING:
        estimate = Estimate(high=ROUNDING)
    return Level(WORDS[name], estimate, Place.of(group.method), reference, basis)


def _levels(
    groups: Sequence[Catalogues], lead: Catalogues, apart: Sequence[Apart], unit: str, of_lead: Sequence[str]
) -> list[Level]:
    """Statistics of all groups, with what the belt's travel of each consists of together."""
    counted = [group for group in groups if not _is_blurred(group)]
    several = [(name, group) for name in (SIZE, DURATION) for group in counted]
    travel = [(name, lead) for name in (SLIP, STORED, CREEP)]
    further = [(name, group) for group in groups if group is not lead for name in (SLIP, CREEP)]
    compared = [id(pair.setting) for pair in apart]
    rates = [(RATE, group) for group in counted if group is not lead and id(group) not in compared]
    return [
        _level(group, name, apart, unit)
        for name, group in (*rates, *travel, *several, *further, *((name, lead) for name in of_lead))
        if group.estimates[name].value is not None
        # without the strain, which may fall, slip in episodes is no share of the travel
        and (name != SLIP or (group.estimates[STORED].value is not None and not _is_blurred(group)))
        and (name != CREEP or not group.group.is_exact)
    ]


def _distances(pairs: Sequence[Apart], outcomes: Sequence[Outcomes], unit: str) -> list[Level]:
    """Each setting beside its reference: first what is said of outcomes, then what is shown to differ."""
    shown_first = sorted(pairs, key=lambda pair: not pair.is_shown)
    rows = [row for pair in shown_first if pair.name in (*PRIMARY, ONSETS) and (row := _beside(pair, unit))]
    return [*dict.fromkeys([*(outcome.largest for outcome in outcomes if outcome.largest), *rows])]


def _beside(pair: Apart, unit: str) -> Level | None:
    """A statistic beside its reference's, or the distance of magnitudes from the reference's; None if not known."""
    where, name, contrast = Place.of(pair.setting.method), pair.reference.noun, pair.contrast
    if pair.name == ONSETS:
        return contrast.level(where, name, unit)
    if pair.name != MAGNITUDES:
        return _level(pair.setting, pair.name, [pair], unit)
    if contrast.reason:
        return None
    return Level(contrast.statistic.quantity, contrast.absolute, where, Comparison(name), contrast.basis(unit))


def _of_onsets(study: Study, by_system: Sequence[Sequence[Catalogues]]) -> list[Apart]:
    """How far rates of slip onsets lie apart: a method may keep the episodes, and lose slip onsets in them."""
    contrasts = {(step.setting, step.reference): step.contrast for step in between_engines(study, "rate")}
    return [
        Apart(setting, reference, replace(contrast, statistic=replace(contrast.statistic, name=ONSETS)))
        for reference, *others in by_system
        for setting in others
        if (contrast := contrasts.get((setting.label, reference.label))) is not None
    ]


def _outcomes(
    reference: Catalogues, others: Sequence[Catalogues], apart: Sequence[Apart], unit: str
) -> list[Outcomes]:
    """Settings by the first of `_BY` that is shown to differ, with the largest difference in it, or of all."""
    differing = {(id(pair.setting), pair.name) for pair in apart if pair.is_shown}
    settings = dict(zip(settings_of(others), others, strict=True))
    come_out = {
        setting: next((name for name in _BY if (id(group), name) in differing), "")
        for setting, group in settings.items()
    }
    outcomes = []
    for name in (*_BY, ""):
        by_id = {id(group): setting for setting, group in settings.items() if come_out[setting] == name}
        apart_most = max(
            (pair for pair in apart if id(pair.setting) in by_id and pair.name in ([name] if name else _RELATIVE)),
            key=_size,
            default=None,
        )
        if not by_id or apart_most is None:
            continue
        level, setting = _beside(apart_most, unit), by_id[id(apart_most.setting)]
        (in_short,) = in_words({setting: ""}, "")
        words, method = in_words(come_out, name), reference.noun
        further = in_words(come_out | {setting: "-"}, name)
        has_onsets = all(group.group.has_onsets for setting, group in settings.items() if come_out[setting] == name)
        outcome = Outcomes(method, undecided=words, scope=_SCOPE + _AND_ONSETS * has_onsets)
        if name:
            alike = [pair for pair in apart if id(pair.setting) in by_id and pair.name == name != MAGNITUDES]
            sizes = [pair.contrast.difference for pair in alike if pair is not apart_most and pair.is_shown]
            outcome = Outcomes(method, different=words, others=further, second=sizes[0] if len(sizes) == 1 else None)
        outcomes.append(replace(outcome, largest=level, at_largest=in_short))
    return outcomes


def _size(pair: Apart) -> float:
    """How far a setting lies from its reference."""
    return abs(pair.contrast.difference.estimate.value or 0.0)


def _is_blurred(group: Catalogues) -> bool:
    """Whether blocks that creep slower than the belt may count as stuck, so that episodes cannot be counted."""
    return (group.stuck_below or 0.0) > 1.0


def _changes(leaders: Sequence[Catalogues], level: float, unit: str) -> list[Change]:
    """From the first of a row of systems to the last: mean size, and episodes per travel of the belt."""
    smallest, largest = leaders[0], leaders[-1]
    ends = [dict(group.group.label.parts) for group in (smallest, largest)]
    keys = [key for key in ends[0] if key and ends[0][key] != ends[1].get(key)]
    if len(keys) != 1:
        return []
    changes = []
    for name, quantity in ((SIZE, WORDS[SIZE]), (BY_WAY, BY_TRAVEL)):
        difference = along(smallest, largest, name, level)
        if difference.is_known:
            old, new = (end[keys[0]] for end in ends)
            changes.append(
                replace(difference.change((KeyChange(keys[0], old, new),), EVERYWHERE, unit), quantity=quantity)
            )
    return changes


def along(first: Catalogues, last: Catalogues, name: str, level: float) -> Contrast:
    """How a statistic of two groups differs: paired if both share their random draws."""
    draws = [[group.group.unit, *(group.group.key[key] for key in DRAWN)] for group in (first, last)]
    statistic = Statistic(name, {**QUANTITIES, **SLOW_DRIVE}[name].of)
    return contrast(statistic, first.sums[name], last.sums[name], draws[0] == draws[1], level)


def _picture(study: Study, group: Catalogues, where: Place) -> list[Finding]:
    """What the magnitudes of a group are like: the law with its b, and its cut-off, its peak and how far it goes."""
    law, basis = group.law, Basis(len(group.runs), noun(study.unit))
    moments = "moments of episodes"
    if law.picture is Kind.OPEN:
        return [Lack(f"the law of moments{where.tail}", Reason.NOT_SHOWN, law.why)]
    scope = Level(IN_RANGE, group.in_range, where, basis=basis)
    span = f"M = {law.least:.1f} to {law.most:.1f}"
    has_cut_off = law.cut_off.value is not None
    name, b_value = (WITH_CUT_OFF, B_WITH_CUT_OFF) if has_cut_off else (POWER_LAW, B_VALUE)
    if law.picture is Kind.NONE:
        moment = group.ratio(lambda run: (np.abs(run.moment).sum(), len(run.moment)))
        mean = Level(MOMENT, moment, where, basis=basis)
        b = Level(b_value, law.b, where + Place.words(span), basis=basis)
        far = b if law.b.high is not None and law.b.high <= 0.0 else None
        findings: list[Finding] = [Law(moments, f"follow a power law, since {law.why}", mean, Fit.FAILS, far)]
    elif law.picture is Kind.DECLARED:
        declared = where + Place.words(f"{span}, as declared")
        findings = [replace(level, where=declared) for level in (Level(B_VALUE, law.b, basis=basis), scope)]
    else:
        b, predicate = Level(b_value, law.b, where, basis=basis), f"follow a {name}{BEYOND[law.picture]} from {span}"
        findings = [Law(moments, predicate, b, called=B_VALUE.name, scope=scope, things="episodes")]
    large = where if law.begins is None else where + Place.words(f"M \u2265 {law.begins:.2f}")
    of_peak, moment_of_peak = group.in_peak
    findings += [
        Level(quantity, estimate, place, basis=basis)
        for quantity, estimate, place in (
            (PEAK_MOMENT, moment_of_peak, large),
            (M_CUT, law.cut_off, where),
            (ATOM, group.in_atom, where),
            (PEAK, of_peak, large),
            (BELOW, group.below_range, where),
            (MISFIT, group.misfit, where),
        )
        if estimate.value is not None
    ]
    findings += _times_between(group, where, basis)
    if law.has_b and group.b_positive.value is not None:
        findings.append(Level(B_POSITIVE, group.b_positive, where, basis=basis))
    if group.whole.value:
        findings.append(Level(WHOLE, group.whole, where, basis=basis))
    return findings


def _times_between(group: Catalogues, where: Place, basis: Basis) -> list[Finding]:
    """How regular large events are, how far apart, and whether their size tells of the time before or after."""
    times = group.recurrence
    large = where + Place.words(f"M \u2265 {times.least:.2f}")
    poisson = Comparison(_POISSON, Difference(times.cv.under(lambda value: value - 1.0), Scale.ABSOLUTE))
    quantities = (
        (REGULARITY, times.cv, poisson),
        (BETWEEN, times.mean, None),
        (SLIP_PREDICTABLE, times.before, None),
        (TIME_PREDICTABLE, times.after, None),
    )
    return [
        Level(quantity, estimate, large, comparison, basis)
        for quantity, estimate, comparison in quantities
        if estimate.value is not None
    ]


def _alerts(study: Study, groups: Sequence[Catalogues], references: Sequence[Catalogues]) -> list[Alert]:
    """What numbers of episodes are wrong, and what they refer to: those of the worst group each."""
    alerts = []
    drifting = [str(group.method) for group in groups if group.basis.code == enough.DRIFTS]
    if drifting:
        alerts.append(drift("The rate of episodes", drifting, study.settings.t_burn))
    fast = max(references or groups, key=_occupancy)
    if _occupancy(fast) > SLOW:
        share = number(_occupancy(fast), Form.SHARE, 0)
        alerts.append(Alert.of(Code.OVERLAP, share=share, where=str(fast.method)))
    if any(map(_is_blurred, groups)):
        come_out = [DIFFERENT if _is_blurred(group) else UNDECIDED for group in groups]
        methods = in_words(dict(zip(settings_of(groups), come_out, strict=True)), DIFFERENT)
        alerts.append(Alert.of(Code.BLURRED, what=capital(" and ".join(methods))))
    spanning = [group for group in groups if (group.whole.value or 0.0) > 0.5 and group in references]
    if spanning:
        share = number(spanning[0].whole.value or 0.0, Form.SHARE, 0)
        alerts.append(Alert.of(Code.SPANNING, share=share, n=int(spanning[0].group.key["n"])))
    return alerts + bent(groups)


def _lead(judged: Sequence[Catalogues]) -> Catalogues:
    """The group that leads: the finest setting, and the largest n, where the ends of a chain matter least."""
    finest = fineness(judged[0].group)
    return max(
        (group for group in judged if fineness(group.group) == finest), key=lambda group: int(group.group.key["n"])
    )


def _occupancy(group: Catalogues) -> float:
    return group.estimates[OCCUPANCY].value or 0.0


def _at_least(magnitude: float, run: Catalogue) -> tuple[float, float]:
    """Number of episodes of at least a magnitude, and the time in which they were counted."""
    return float(np.sum(run.magnitude >= magnitude)), run.t_stop - run.t_start


def _rates(groups: Sequence[Catalogues], leaders: Sequence[Catalogues]) -> list[Frequency]:
    """Episodes in each class of magnitudes, from the smallest of those that lead, and per unit time from it on."""
    first_edge = CLASS * np.floor(min(float(group.magnitudes().min()) for group in leaders) / CLASS)
    rates: list[Frequency] = []
    for group in groups:
        magnitudes = group.magnitudes()
        n_classes = int((magnitudes.max() - first_edge) / CLASS) + 1 if len(magnitudes) else 0
        for edge in first_edge + CLASS * np.arange(n_classes):
            above = magnitudes[magnitudes >= edge]
            density = np.count_nonzero(above < edge + CLASS) / (len(magnitudes) * CLASS)
            rate = group.ratio(partial(_at_least, edge))
            rates.append(Frequency(group.label, float(edge), density, len(above), within(rate, 0.0)))
    return rates


# ------------------------------------------------------------------------------------------------- figures


def _figures(
    study: Study, groups: Sequence[Catalogues], leaders: Sequence[Catalogues], rates: Sequence[Frequency]
) -> dict[str, Picture]:
    """The magnitudes of all settings, those that lead first, and what happens around large events."""
    shown = [*leaders, *(group for group in groups if group not in leaders)][:MOST_DRAWN]
    colours = hues(study, [group.label for group in shown])
    laws = [Drawn.of(*entry) for entry in zip(shown, colours, strict=True)]
    peak = " Dashed: where the peak begins." * any(law.begins is not None for law in laws)
    lines = "Lines: power laws, each on its range." if any(len(law.at) for law in laws) else "No power law is shown."
    figures = {
        "magnitudes": Picture(
            partial(magnitudes, rates, laws),
            f"{lines} Above: share of episodes per unit of magnitude, M = log10 moment. Below: episodes per unit time"
            f" of at least each magnitude.{peak}",
        )
    }
    if any(group.recurrence.bins for group in leaders):
        large = listed([f"M \u2265 {group.recurrence.least:.2f}, {group.method}" for group in leaders], "or")
        cv = leaders[0].recurrence.cv
        come = "in clusters, unlike" if (cv.low or 1.0) > 1.0 else "at times not told from those of"
        come = "at more regular times than" if (cv.high or 1.0) < 1.0 else come
        bins = [(str(group.method), hue, group.recurrence.bins) for group, hue in zip(leaders, colours, strict=False)]
        figures["recurrence"] = Picture(
            partial(hazards, bins),
            f"Large events ({large}) come {come} a Poisson process. Above: rate of the next large event, by the"
            " time since the last. Below: rate of small events before and after a large one. Both over their mean,"
            " which a Poisson process has at all times (dashed); bars: intervals.",
        )
    return figures


class Drawn(NamedTuple):
    """What is drawn of the law of a group; shape (K,) each."""

    label: str
    name: str
    hue: str
    at: np.ndarray
    density: np.ndarray
    begins: float | None

    @classmethod
    def of(cls, group: Catalogues, hue: str) -> Drawn:
        law, at, density = group.law, np.zeros(0), np.zeros(0)
        if law.fit is not None and law.has_b:
            at = law.least + WIDTH * (law.fit.sizes - 0.5)
            density = law.fit.shares() * law.n_fitted / (group.n_episodes * WIDTH)
        return cls(group.label, str(group.method), hue, at, density, law.begins)


@panel(4.6, nrows=2, sharex=True)
def magnitudes(axes: np.ndarray, rates: Sequence[Frequency], drawn: Sequence[Drawn]) -> None:
    """Density of magnitudes with the fitted laws, and rates from each magnitude on; one hue a group."""
    above, below = axes
    for marker, law in zip(itertools.cycle("osDv^P"), drawn):
        rows = [rate for rate in rates if rate.group == law.label]
        full = [(rate.magnitude + CLASS / 2, rate.density) for rate in rows if rate.density > 0]
        if not full:
            continue
        look: dict[str, Any] = {"color": law.hue, "marker": marker, "markersize": 3, "linestyle": ""}
        above.plot(*zip(*full, strict=True), label=law.name, **look)
        above.plot(law.at, law.density, color=law.hue)
        below.plot([rate.magnitude for rate in rows], [rate.rate.value for rate in rows], **look)
        if law.begins is not None:
            for ax in axes:
                ax.axvline(law.begins, color=law.hue, linestyle="--", linewidth=0.8)
    above.set(ylabel="density", yscale="log")
    below.set(xlabel=r"magnitude, M = $\log_{10}$ moment", ylabel=r"episodes per unit time, $\geq$ M", yscale="log")
    if len(drawn) > 1:
        widest = max(len(law.name) for law in drawn)
        above.figure.legend(loc="outside upper center", ncols=2 if widest < 26 else 1)


@panel(4.6, nrows=2)
def hazards(axes: np.ndarray, groups: Sequence[tuple[str, str, Sequence[Bin]]]) -> None:
    """Rate of large events since the last, and of small ones around large, in units of the mean time between."""
    above, below = axes
    for name, hue, bins in groups:
        for bar in bins:
            middle, relative = (bar.low + bar.high) / 2, bar.relative
            if relative.value is None or 0 < bar.n_events < FEWEST_IN_BIN:
                continue
            ax, x = (above, middle) if bar.what == "hazard" else (below, middle * (-1 if bar.what == "before" else 1))
            ax.plot(x, relative.value, "o", color=hue, markersize=3, label=name if bar is bins[0] else None)
            if relative.low is not None:
                ax.vlines(x, relative.low, relative.high, color=hue, linewidth=0.9)
    for ax, words, rate in (
        (above, "time since a large event / mean time between", "hazard"),
        (below, "time from a large event / mean time between", "small events"),
    ):
        ax.axhline(1.0, color=GREY, linestyle="--", linewidth=1)
        ax.set(xlabel=words, ylabel=f"{rate} / mean", ylim=(0.0, None))
    if len(groups) > 1:
        above.figure.legend(loc="outside upper center", ncols=2)


QUESTION = Question(answer, title="How often and how large are episodes?", share=0.8, rank=2)
