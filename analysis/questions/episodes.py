"""Episodes: how often, how large, how regular; the law of their moments; by how much all this hangs on the method.

An episode runs from all blocks stuck to all stuck again. Those that begin within [t_burn, t_end] count. Every method
is held against exact events on the same systems, by whole laws: a mean may be right where the law is not.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.contrast import SCHEMA, Sample, Statistic, contrast, judge
from stickslip.analysis.ensemble import SYSTEM_KEYS, TOLERANCES, Group, Study
from stickslip.analysis.models.episodes import (
    BY_WAY,
    CLASS,
    DRIVE,
    FITTED,
    OCCUPANCY,
    QUANTITIES,
    QUIET,
    RATE,
    SIZE,
    WINDOWS,
    BValue,
    Catalogue,
    b_values,
    completeness,
    drift,
    follows,
    in_classes,
    laws_of_moments,
)
from stickslip.analysis.models.laws import Difference, difference_of_order, distance_of_shares, largest_gap
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.compare import AGREE, DIFFER, Words, against, relative_difference
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio
from stickslip.analysis.stats.families import Fit, maximise, parameter
from stickslip.analysis.stats.goodness import REJECTED, goodness
from stickslip.analysis.stats.student import half_width
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel

MARGIN = 0.1  # of every statistic, relative, and of Poisson's CV: what some twenty systems can exclude
POWER, CUT_OFF, EXPONENTIAL, NONE, UNKNOWN = (
    "power law", "cut-off power law", "exponential", "none of these", "cannot be told",
)  # fmt: skip
REGULAR, CLUSTERED, AS_POISSON = "more regular", "less regular", "as Poisson"
#: By which a law may be off: a distribution function by three in a hundred of the episodes; shares of first blocks by
#: a quarter of them; a correlation by 0.1. Twenty systems of a thousand episodes each exclude as much.
GAP, DISTANCE, CORRELATION = 0.03, 0.25, 0.1
SLOW = 0.05  # of the time in episodes, at most, where the drive is slow for the chain
FEWEST = 30  # episodes from a magnitude on for its rate to be drawn
_STEP = 2  # classes from point to point of the figures
MOST_OVER = 2.5  # times the reference's rate that a figure shows
_ENGINES = ("coulomb", "sigmoid", "moreau")  # the exact one first, which is what the others are held against
_GROUPS: Mapping[str, str] = {
    "group": S, "method": S, "n_systems": I, "n_episodes": I, "least": F, "largest": F, "whole": F,
    **{f"{name}{end}": F for name in (*QUANTITIES, *DRIVE) for end in ("", "_low", "_high")},
    "drift": F, "drift_low": F, "drift_high": F, "stuck_below": F, "basis": S,
}  # fmt: skip
_CONTRASTS: Mapping[str, str] = {"setting": S, "reference": S, **SCHEMA}
_METHODS: Mapping[str, str] = {
    "setting": S, "reference": S, "law": S, "size": F, "size_low": F, "size_high": F, "at": F, "below": F,
    "margin": F, "p_equivalent": F,
    "p_different": F, "p_equivalent_holm": F, "p_different_holm": F, "verdict": S, "reason": S,
}  # fmt: skip
_B_VALUES: Mapping[str, str] = {
    "group": S, "magnitude": F, "n_episodes": I, "b": F, "b_low": F, "b_high": F,
    "predicted": F,
}  # fmt: skip
_SIZES: Mapping[str, str] = {
    "group": S, "size": I, "n_episodes": I, "share": F, "share_low": F, "share_high": F,
}  # fmt: skip
_LAWS: Mapping[str, str] = {
    "law": S, "parameters": S, "gain": F, "gap": F, "p_value": F, "fit": S, "reason": S,
}  # fmt: skip
_RATES: Mapping[str, str] = {
    "group": S, "magnitude": F, "n_episodes": I, "rate": F, "rate_low": F, "rate_high": F, "over": F, "over_low": F,
    "over_high": F,
}  # fmt: skip


@dataclass
class _Of:
    """A group with the episodes of its runs that reached t_end, by unit; and what they come to."""

    group: Group
    runs: dict[int, list[Catalogue]]
    sample: Sample
    row: Row

    @property
    def label(self) -> str:
        return self.group.label

    @property
    def is_judged(self) -> bool:
        return self.row["basis"] in enough.JUDGED

    def each(self) -> Iterator[Catalogue]:
        for some in self.runs.values():
            yield from some

    def magnitudes(self) -> np.ndarray:
        return np.concatenate([one.magnitude for one in self.each()] or [np.zeros(0)])


@dataclass(frozen=True)
class _Law:
    """A law by which methods are compared: what a run of n blocks gives, and how the runs of a system are joined."""

    of: Callable[[Catalogue, int], np.ndarray]
    apart: Callable[[list[tuple[np.ndarray, np.ndarray]], float, float, np.random.Generator], Difference]
    margin: float
    join: Callable[[list[np.ndarray]], np.ndarray] = np.concatenate


_COMPARED: Mapping[str, _Law] = {
    "magnitudes": _Law(lambda run, _: run.magnitude, largest_gap, GAP),
    "sizes": _Law(lambda run, _: run.size, largest_gap, GAP),
    "quiet times": _Law(lambda run, _: run.quiet, largest_gap, GAP),
    "first blocks": _Law(Catalogue.first_blocks, distance_of_shares, DISTANCE, lambda runs: np.sum(runs, axis=0)),
    "order in time": _Law(lambda run, _: run.sizes_and_quiets, difference_of_order, CORRELATION),
}


def answer(study: Study) -> Answer | None:
    """What the episodes of an ensemble are like; None where none were recorded."""
    table = study.data.episodes
    if table is None:
        return None
    of_member = {str(name): some for name, some in table.groupby("member_id", sort=False)}
    found = [_Of(group, _runs(study, group, of_member), Sample(), {}) for group in sorted(study.groups, key=_order)]
    found = [one for one in found if one.runs]
    level = study.settings.confidence
    systems = _systems(found)
    if not any(len(one.magnitudes()) for one in found):
        return Answer({"n_systems": max((len(one.runs) for one in found), default=0)}, lack="no episode")
    for some in systems:
        least = _least(some)
        for one in some:
            _fill(one, least, level)
    for one, method in zip(found, _methods(found), strict=True):
        one.row["method"] = method
    judged = [one for one in found if one.is_judged]
    tables = {"episodes": frame(_GROUPS, [one.row for one in found])}
    if not judged:
        best = max(found, key=lambda one: one.row["n_episodes"]).row
        return Answer({"best": best, "t_burn": study.settings.t_burn}, lack=best["basis"], tables=tables)
    first = _order(judged[0].group)  # of several sizes the largest: what ends of a chain do is least there
    lead = max((one for one in judged if _order(one.group) == first), key=lambda one: int(one.group.key["n"]))
    least = float(lead.row["least"])
    contrasts = _contrasts(systems, level)
    compared = _compared(study, systems)
    rates = _rates(systems, lead, least - CLASS, level)  # from the fullest class on: no law is asked of a rate
    laws, moments = _laws(study, lead)
    b = {one.label: _b_values(one, level) for one in judged}
    b_rows = [_b_row(label, at) for label, some in b.items() for at in some]
    sizes = [row for first, *_ in systems if first.is_judged for row in _sizes(first, level)]
    methods = {one.label: str(one.row["method"]) for one in found}
    settings = [_setting(rows, compared, methods) for rows in contrasts]
    leaders = [first for first, *_ in systems if first.is_judged]
    references = [one.row for one in leaders]
    changes = _changes(leaders, level)
    facts = {
        "lead": lead.row, "rows": [one.row for one in found], "laws": laws, "moments": moments, "least": least,
        "class": CLASS, "fitted": FITTED, "windows": WINDOWS, "margin": MARGIN,
        "window": (float(lead.group.key["t_end"]) - study.settings.t_burn) * (1 - lead.row[OCCUPANCY]) / WINDOWS,
        "margins": {name: law.margin for name, law in _COMPARED.items()},
        "settings": settings, "agree": [one for one in settings if one["verdict"] == AGREE],
        "differ": _by_laws(settings),
        "untold": [one for one in settings if one["verdict"] == UNKNOWN and one["rows"]],
        "farthest": max((one for one in settings if one["rate"]["verdict"] == DIFFER), key=_rate_off, default=None),
        "t_burn": study.settings.t_burn, "n_tests": sum(row["p_equivalent"] is not None for row in compared),
        "refused": [one.row for one in found if not one.is_judged], "n_blocks": lead.group.key["n"],
        "ends": (references[0], references[-1]), "changes": changes, "b": b[lead.label], "slow": SLOW,
        "has_b": follows(b[lead.label], len(lead.runs), level),
        "most_over": MOST_OVER if any((row["over"] or 0.0) > MOST_OVER for row in rates) else None,
        "fast": [row for row in references if row[OCCUPANCY] > SLOW],
    }  # fmt: skip
    tables |= {
        "episode_contrasts": frame(_CONTRASTS, [row for rows in (*contrasts, changes) for row in rows]),
        "episode_methods": frame(_METHODS, compared),
        "episode_laws": frame(_LAWS, laws),
        "episode_rates": frame(_RATES, rates),
        "episode_sizes": frame(_SIZES, sizes),
        "b_values": frame(_B_VALUES, b_rows),
    }
    labels = {one.label: (str(one.group.key["engine"]), methods[one.label]) for one in found}
    figures = {"episode_rates": partial(frequencies, rates, labels)}
    if b_rows:
        shown = {label: labels[label] for label, some in b.items() if some}
        figures["b_values"] = partial(b_by_least, b_rows, shown, lead.label)
    if settings:
        figures["episode_rates_over"] = partial(over_reference, rates, labels)
    elif len(references) > 1:
        figures["episode_sizes"] = partial(
            shares_of_sizes, sizes, {row["group"]: labels[row["group"]] for row in references}
        )
    else:
        run = next(one for one in lead.each() if len(one.start))
        figures["one_catalogue"] = partial(one_catalogue, run.start, run.magnitude)
    facts |= {
        "has_pairs": bool(settings), "has_sizes": "episode_sizes" in figures,
        "n_settings": len(contrasts), "is_sweep": len(systems) > 1,
        "references": {rows[0]["reference"] for rows in contrasts},
    }  # fmt: skip
    return Answer(facts, tables=tables, figures=figures)


def _order(group: Group) -> tuple[Any, ...]:
    """Exact events first, then by engine, from the finest setting to the coarsest."""
    fineness = [float(group.key[name] or 0.0) for name in ("eps", "step", *TOLERANCES)]
    return (_ENGINES.index(group.key["engine"]), *fineness)


def _runs(study: Study, group: Group, of_member: Mapping[str, Any]) -> dict[int, list[Catalogue]]:
    """By unit; a run that recorded no episode has none."""
    found: dict[int, list[Catalogue]] = {}
    t_start, n, v = study.settings.t_burn, int(group.key["n"]), group.key["belt_speed"]
    table = (group.finished[name] for name in ("unit", "member_id", "t_end"))
    for unit, member_id, t_end in zip(*table, strict=True):
        columns = np.zeros((5, 0))
        if member_id in of_member:
            columns = of_member[member_id][["start", "end", "size", "moment", "first_block"]].to_numpy(np.float64).T
            columns = columns[:, (columns[0] >= t_start) & (columns[3] != 0)]
        start, end, size, moment, first_block = columns
        slip = np.nan if not v else n * abs(float(v)) * (float(t_end) - t_start)
        whole = (size.astype(np.int64), moment, slip, first_block.astype(np.int64))
        one = Catalogue(t_start, float(t_end), start, end - start, *whole)
        found.setdefault(int(unit), []).append(one)
    return found


def _least(some: Sequence[_Of]) -> float:
    """Completeness of the first group of the same systems that has episodes: one for all, so that they compare."""
    for one in some:
        if len(magnitudes := one.magnitudes()):
            return completeness(magnitudes)
    return 0.0


def _fill(one: _Of, least: float, level: float) -> None:
    """The statistics of a group, each with its interval over units, as columns and, in `of`, as estimates."""
    quantities = {**QUANTITIES, **DRIVE}
    for unit, runs in one.runs.items():
        for run in runs:
            for name, quantity in quantities.items():
                sums = quantity.sums(run, least)
                if np.isfinite(sums).all():
                    one.sample.add(name, unit, sums)
    halves = np.array([sum(run.halves() for run in runs) for runs in one.runs.values()])
    n_episodes = int(halves.sum())
    basis = enough.basis(halves, n_episodes, level, drift)
    sizes = np.concatenate([run.size for run in one.each()])
    one.row = {
        "group": one.label, "least": least, "stuck_below": _stuck_below(one.group),
        "n_systems": len(one.runs), "n_episodes": n_episodes,
        "basis": basis.code, "n_matrices": len(one.runs), "n_cascades": n_episodes, **named("drift", basis.drift),
        "largest": float(one.magnitudes().max()) if n_episodes else None,
        "whole": float(np.mean(sizes == one.group.key["n"])) if n_episodes else None,
    }  # fmt: skip
    one.row["of"] = {
        name: over_matrices(quantity.of, one.sample.rows(name)[1], level) for name, quantity in quantities.items()
    }
    for name, estimate in one.row["of"].items():
        one.row |= named(name, estimate)
    one.row["regularity"] = _regularity(one.sample.rows(QUIET)[1], level) if one.is_judged else UNKNOWN


def _stuck_below(group: Group) -> float | None:
    """Speed on the belt, in units of the belt's, below which a smoothed block may count as stuck."""
    key = group.key
    if key["stick"] != "manifold" or key["ratio"] != "one" or not key["belt_speed"]:
        return None
    return float(-key["eps"] * np.log(key["eps"]) / abs(key["belt_speed"]))


def _regularity(sums: np.ndarray, level: float) -> str:
    try:
        test = against(lambda of: QUANTITIES[QUIET].of(of) - 1.0, sums, MARGIN)
    except Undefined:
        return UNKNOWN
    return test.verdict(level, Words(AS_POISSON, CLUSTERED, REGULAR))


def _systems(found: Sequence[_Of]) -> list[list[_Of]]:
    """Groups of the same systems together, in their order: the first is what the others are held against."""
    systems: dict[tuple[Any, ...], list[_Of]] = {}
    for one in found:
        systems.setdefault(tuple(one.group.key[name] for name in SYSTEM_KEYS), []).append(one)
    return list(systems.values())


def _contrasts(systems: Sequence[Sequence[_Of]], level: float) -> list[list[Row]]:
    """Of each setting against the first of the same systems, judged together."""
    statistics = [Statistic(name, quantity.of, MARGIN) for name, quantity in QUANTITIES.items()]
    made = []
    for reference, *others in systems:
        if not reference.is_judged:
            continue
        some = [
            [
                {"setting": other.label, "reference": reference.label}
                | contrast(statistic, reference.sample, other.sample, True, level)
                for statistic in statistics
            ]
            for other in others
        ]
        judge([row for rows in some for row in rows], 1 - level)
        made += some
    return made


def _changes(leaders: Sequence[_Of], level: float) -> list[Row]:
    """From the first to the last of some systems: mean size, and the number of episodes by way of the belt."""
    first, last = leaders[0], leaders[-1]
    if first is last:
        return []
    asked = [Statistic(SIZE, QUANTITIES[SIZE].of, MARGIN), Statistic(BY_WAY, DRIVE[BY_WAY].of, MARGIN)]
    rows: list[Row] = [
        {"setting": last.label, "reference": first.label} | contrast(one, first.sample, last.sample, False, level)
        for one in asked
    ]
    judge(rows, 1 - level)
    for row in rows:
        row["is_shown"] = row["p_different"] is not None and row["p_different_holm"] < 1 - level
    return rows


def _compared(study: Study, systems: Sequence[Sequence[_Of]]) -> list[Row]:
    """Every law of each setting against that of the first of the same systems, judged together; by setting."""
    made: list[Row] = []
    for reference, *others in systems:
        rows = [
            {"setting": other.label, "reference": reference.label, "law": name}
            | _apart(study, reference, other, name, law)
            for other in others if reference.is_judged
            for name, law in _COMPARED.items()
        ]  # fmt: skip
        judge(rows, 1 - study.settings.confidence)
        made += rows
    return made


def _apart(study: Study, first: _Of, second: _Of, name: str, law: _Law) -> Row:
    n, both = int(first.group.key["n"]), sorted(first.runs.keys() & second.runs.keys())
    pairs = [
        (
            law.join([law.of(run, n) for run in first.runs[unit]]),
            law.join([law.of(run, n) for run in second.runs[unit]]),
        )
        for unit in both
    ]
    row: Row = {"margin": law.margin, "verdict": UNKNOWN, "reason": None}
    row |= dict.fromkeys(("at", "below", "p_equivalent", "p_different"))
    try:
        found = law.apart(pairs, law.margin, study.settings.confidence, study.generator(f"{name} {second.label}"))
    except Undefined as why:
        return row | named("size", Estimate()) | {"reason": str(why)}
    return row | named("size", found.size) | {
        "at": found.at, "below": found.below, "relative": found.size.value, "p_equivalent": found.p_equivalent,
        "p_different": found.p_different,
    }  # fmt: skip


def _setting(contrasts: Sequence[Row], compared: Sequence[Row], methods: Mapping[str, str]) -> Row:
    """A setting by its laws, its rate, and what those that could be compared come to; no rows if none could be."""
    label = contrasts[0]["setting"]
    rows = [row | {"method": methods[label]} for row in compared if row["setting"] == label]
    known = [row for row in rows if row["p_equivalent"] is not None]
    by = {verdict: [row["law"] for row in known if row["verdict"] == verdict] for verdict in (AGREE, DIFFER, UNKNOWN)}
    return {
        "setting": label, "method": methods[label], "rows": rows if known else [], "n_known": len(known),
        "agree": by[AGREE], "differ": by[DIFFER], "open": by[UNKNOWN],
        "verdict": DIFFER if by[DIFFER] else AGREE if known and len(by[AGREE]) == len(known) else UNKNOWN,
        "rate": next(row for row in contrasts if row["quantity"] == RATE),
    }  # fmt: skip


def _by_laws(settings: Sequence[Row]) -> list[Row]:
    """Methods that differ, together where it is in the same laws, or in all that could be compared."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for one in settings:
        if one["differ"]:
            every = len(one["differ"]) == one["n_known"]
            found.setdefault(() if every else tuple(one["differ"]), []).append(one)
    return [
        {
            "laws": laws, "methods": [one["method"] for one in some],
            "is_all": all(one["n_known"] == len(one["rows"]) for one in some),
            "alone": next((row for row in some[0]["rows"] if row["law"] in laws), None) if len(some) == len(laws) == 1
            else None,
        }
        for laws, some in found.items()
    ]  # fmt: skip


def _rate_off(one: Row) -> float:
    """How far the rate is off; a setting without any episode is said apart."""
    off = float(one["rate"]["relative"])
    return abs(off) if off > -1 else -1.0


def _b_row(label: str, one: BValue) -> Row:
    return {
        "group": label, "magnitude": one.least, "n_episodes": one.n_episodes, **named("b", one.b),
        "predicted": one.predicted,
    }  # fmt: skip


def _sizes(one: _Of, level: float) -> list[Row]:
    """Shares of the episodes that take at least so many blocks, at sizes half as large again each."""
    rows: list[Row] = []
    runs = [np.concatenate([run.size for run in some]) for some in one.runs.values()]
    most = max(int(some.max(initial=0)) for some in runs)
    for size in np.unique((1.5 ** np.arange(np.log(most) / np.log(1.5))).astype(int)):
        sums = np.array([[np.count_nonzero(some >= size), len(some)] for some in runs], dtype=np.float64)
        if sums[:, 0].sum() >= FEWEST:
            share = named("share", over_matrices(ratio, sums, level))
            rows.append({"group": one.label, "size": int(size), "n_episodes": int(sums[:, 0].sum()), **share})
    return rows


# ---------------------------------------------------------------------------------------------- the law


def _in_classes(one: _Of) -> np.ndarray:
    """Magnitudes of each unit in classes from the least to the largest, shape (G, K)."""
    least, by_unit = one.row["least"], [np.concatenate([run.magnitude for run in runs]) for runs in one.runs.values()]
    n_classes = int(np.floor((one.magnitudes().max() - least) / FITTED + 1e-9)) + 1
    return np.array([in_classes(some, least, max(n_classes, 0)) for some in by_unit], dtype=np.float64)


def _fits(one: _Of, counts: np.ndarray) -> list[Fit]:
    """Of each law of moments; none where there is no maximum of the likelihood."""
    magnitudes, least = one.magnitudes(), one.row["least"]
    if magnitudes.max() < least:
        return []
    laws = laws_of_moments(least, float(np.mean(10.0 ** magnitudes[magnitudes >= least])))
    try:
        return [maximise(law, np.arange(1.0, counts.shape[1] + 1), counts.sum(axis=0)) for law in laws]
    except Undefined:
        return []


def _b_values(one: _Of, level: float) -> list[BValue]:
    fits = _fits(one, _in_classes(one))
    of_units = list(one.runs.values())
    return b_values(of_units, fits[0], one.row["least"], enough.LEAST_CASCADES, level) if fits else []


def _laws(study: Study, lead: _Of) -> tuple[list[Row], Row]:
    """Each law beside the moments of a group, its gain over the power law; which they follow, and its exponents."""
    level, counts = study.settings.confidence, _in_classes(lead)
    fits = _fits(lead, counts)
    if not fits:
        return [], {"exponent": Estimate(), "b": Estimate(), "law": UNKNOWN}
    base, with_cut_off, _ = fits
    rows: list[Row] = []
    for fit in fits:
        name = fit.family.name
        good = goodness(fit.sizes, counts, level, study.generator(f"moment {name}"), fit.family)
        rows.append({
            "law": name, "parameters": ", ".join(f"{key} = {value:.3g}" for key, value in fit.parameters.items()),
            "gain": None if fit is base else (fit.log_likelihood - base.log_likelihood) / counts.sum(),
            "gap": good.gap, "p_value": good.p_value, "fit": good.verdict(1 - level), "reason": good.reason or None,
        })  # fmt: skip
    exponent, cut_off = (parameter(with_cut_off, which, counts, level) for which in (0, 1))
    bounded = parameter(base, 0, counts, level)
    return rows, {"exponent": exponent, "b": bounded, "law": _verdict(rows[1]["fit"], exponent, cut_off)}


def _verdict(fit: str, exponent: Estimate, cut_off: Estimate) -> str:
    """Of the power law with a cut-off, which holds the two others: without cut-off, and at the exponent -1."""
    if fit == REJECTED:
        return NONE
    if cut_off.value == 0.0:
        return POWER
    if cut_off.low is None or exponent.low is None or exponent.high is None:
        return UNKNOWN
    if exponent.low <= -1.0 <= exponent.high:
        return EXPONENTIAL if cut_off.low > 0 else UNKNOWN
    return CUT_OFF if cut_off.low > 0 else POWER


# ---------------------------------------------------------------------------------------------- how often, how large


def _rates(systems: Iterable[Sequence[_Of]], lead: _Of, first_edge: float, level: float) -> list[Row]:
    """Episodes per unit time from each magnitude on, and over those of the first setting of the same systems."""
    rows: list[Row] = []
    edges = first_edge + CLASS * np.arange(0, int((lead.magnitudes().max() - first_edge) / CLASS) + _STEP, _STEP)
    for first, *others in systems:
        reference = {edge: _exceeding(first, edge) for edge in edges}
        for one, edge in itertools.product((first, *others), edges):
            before = reference[edge]
            sums = before if one is first else _exceeding(one, edge)
            n_episodes = int(sum(row[0] for row in sums.values()))
            if n_episodes < FEWEST:
                continue
            rate = over_matrices(ratio, np.array([*sums.values()]), level)
            over = Estimate()
            both = sorted(sums.keys() & before.keys())
            if one is not first and len(both) > 1 and sum(row[0] for row in before.values()) >= FEWEST:
                known, found = (np.array([of[unit] for unit in both]) for of in (before, sums))
                over = _over(known, found, level)
            rows.append({
                "group": one.label, "magnitude": float(edge), "n_episodes": n_episodes, "rate": rate.value,
                "rate_low": None if rate.low is None else max(rate.low, 0.0), "rate_high": rate.high,
                **named("over", over),
            })  # fmt: skip
    return rows


def _exceeding(one: _Of, magnitude: float) -> dict[int, np.ndarray]:
    """By unit: episodes of at least that magnitude, and the time in which they were counted."""
    return {
        unit: np.array([
            sum(np.count_nonzero(run.magnitude >= magnitude) for run in runs),
            sum(run.t_stop - run.t_start for run in runs),
        ], dtype=np.float64)
        for unit, runs in one.runs.items()
    }  # fmt: skip


def _over(first: np.ndarray, second: np.ndarray, level: float) -> Estimate:
    try:
        value, error, dof = relative_difference(ratio, first, second, True)
    except Undefined as why:
        return Estimate(reason=str(why))
    half = half_width(level, dof) * error
    return Estimate(1 + value, 1 + value - half, 1 + value + half)


def _look(labels: Mapping[str, tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """A colour an engine, a line a setting."""
    seen: dict[str, int] = {}
    looks = {}
    for label, (engine, _) in labels.items():
        k = seen[engine] = seen.get(engine, -1) + 1
        colour = {"coulomb": EXACT, "sigmoid": SMOOTHED}.get(engine, GREEN)
        looks[label] = {
            "color": colour, "linestyle": ("-", "--", "-.", ":")[k % 4], "marker": "osDv"[k % 4], "markersize": 3,
            "markerfacecolor": colour if engine == "coulomb" else "white", "linewidth": 0.9,
        }  # fmt: skip
    return looks


def _methods(found: Sequence[_Of]) -> list[str]:
    """Groups by what tells them apart: their method, place in a sweep and number of blocks."""
    of_one_size = len({one.group.key["n"] for one in found}) == 1
    return [_method(one.label, of_one_size, all("exact" in one.label for one in found)) for one in found]


def _method(label: str, of_one_size: bool, are_exact: bool) -> str:
    bare = label.partition(", ")[2] if of_one_size else label
    if are_exact:
        bare = ", ".join(word for word in bare.split(", ") if word != "exact") or "exact"
    bare = bare.replace("moreau, step", "time steps h").replace("sigmoid, eps", "sigmoid \u03b5")
    bare = re.sub(r"\beps\b", "\u03b5", bare)
    bare = re.sub(r"(?<=\u03b5 = )0\.00\d+", _power, bare)
    return re.sub(r"e-0(?=\d)", "e-", bare).replace(" = ", "\u00a0=\u00a0")


def _power(number: re.Match[str]) -> str:
    """Such as 2.5e-04."""
    digits, _, exponent = f"{float(number[0]):e}".partition("e")
    return f"{float(digits):g}e{exponent}"


def _lines(
    ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]], key: str, by: str = "magnitude"
) -> None:
    for (label, (_, method)), look in zip(labels.items(), _look(labels).values(), strict=True):
        some = [row for row in rows if row["group"] == label and row[key] is not None]
        if not some:
            continue
        x, y = (np.array([row[name] for row in some]) for name in (by, key))
        ax.plot(x, y, label=method, **look)
        known = [row for row in some if row[f"{key}_low"] is not None]
        low, high = (np.array([row[f"{key}{end}"] for row in known]) for end in ("_low", "_high"))
        ax.fill_between([row[by] for row in known], low, high, color=look["color"], alpha=0.12, linewidth=0)
    ax.set_xlabel("magnitude, M = $\\log_{10}$ moment")
    if len(labels) > 1:
        widest = max(len(method) for _, method in labels.values())
        ax.figure.legend(
            loc="outside upper center",
            ncols=3 if widest < 24 else 2 if widest < 38 else 1,
            fontsize=6.5,
            handlelength=2.2,
        )


@panel()
def frequencies(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """Episodes per unit time from each magnitude on, a line a group, bands of their intervals.

    Rows are those of the table `episode_rates`; labels are (engine, method) by group.
    """
    _lines(ax, rows, labels, "rate")
    ax.set_yscale("log")
    lows = [row["rate"] for row in rows if row["rate"]]
    ax.set(ylabel="rate of episodes, $\\geq$ M", ylim=(0.5 * min(lows), 2 * max(lows)))


@panel()
def over_reference(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """The same over the reference's, on the same systems, up to `MOST_OVER`; parameters as of `frequencies`."""
    ax.axhspan(1 - MARGIN, 1 + MARGIN, color=GREY, alpha=0.13, linewidth=0)
    ax.axhline(1.0, color=EXACT, linewidth=1)
    _lines(ax, rows, labels, "over")
    seen = [row["over"] for row in rows if row["over"] is not None]
    ax.set(ylabel="rate / exact rate", ylim=(0, min(MOST_OVER, max([1.4, *(1.15 * x for x in seen)]))))


@panel()
def b_by_least(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]], lead: str) -> None:
    """b against the magnitude from which it is taken, and what is predicted for it of the group `lead`.

    Rows are those of the table `b_values`; labels as of `frequencies`.
    """
    some = [row for row in rows if row["group"] == lead]
    ax.plot([row["magnitude"] for row in some], [row["predicted"] for row in some], "--", color=GREY, linewidth=1)
    _lines(ax, rows, labels, "b")
    ax.set(xlabel="least magnitude, $M_c$", ylabel="b by Aki", ylim=(0, None))


@panel()
def shares_of_sizes(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """Shares of episodes by least size; rows of the table `episode_sizes`, labels as of `frequencies`."""
    _lines(ax, rows, labels, "share", "size")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set(xlabel="size, blocks that slip", ylabel="share of episodes, $\\geq$ size")


@panel()
def one_catalogue(ax: Axes, t: np.ndarray, magnitude: np.ndarray) -> None:
    """Magnitude against time of the episodes of one run, each (m,)."""
    floor = float(magnitude.min()) - 0.1
    ax.vlines(t, floor, magnitude, color=EXACT, linewidth=0.6)
    ax.plot(t, magnitude, "o", color=EXACT, markersize=2)
    ax.set(xlabel="time t", ylabel="magnitude, M", ylim=(floor, None))


QUESTION = Question(answer, share=0.8, rank=2)
