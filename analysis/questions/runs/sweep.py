"""What changes along the keys that a scene sweeps: what `analysis.measures` knows of its runs, and their fates.

Every value of a key is compared with its first, within each unit and each point of the other swept keys, since all
share the random draws. A row of a comparison is a unit, with its runs at all points of the grid.
"""

from __future__ import annotations

from collections import ChainMap, Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, product
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, MaxNLocator

from stickslip.analysis import contrast
from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.contrast import Sample, Share, Statistic
from stickslip.analysis.ensemble import Study
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
from stickslip.analysis.measures import AXES, GAMMA, KEYS, MEAN, Measure, measures
from stickslip.analysis.members import RELATIVE
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET, WATCHED
from stickslip.analysis.questions.runs.fate_figures import FATES, shares
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.compare import UNKNOWN, WITHIN, Words
from stickslip.analysis.stats.estimates import Estimate, UnitSums, ratio
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.style import EXACT, GREY, panel
from stickslip.pipeline.design.design import Axis, in_words
from stickslip.pipeline.design.values import Value

ROUNDING = 1e-12  # what sums over a run lose to rounding, at any tolerance
RISES, FALLS, SAME = "rises", "falls", "the same in all"
MOST_LINES = 6  # in one figure
MOST_COLUMNS = 5  # of measures in the table of values
MOST_FIGURES = 8  # of statistics along a key
MOST_DECADES = 4.0  # of an axis: what lies further below the largest value is below the axis
_FEW_TICKS = 4  # so few values of a key are its ticks
_LETTERS, _LINES = 36, 20  # of the ticks of a map, side by side and above each other
DECADES = 30.0  # largest over least value from which an axis is logarithmic
_ESTIMATES = {f"{name}{end}": F for name in ("mean", "gamma", "moving") for end in ("", "_low", "_high")}
_VALUES: Mapping[str, str] = {
    "setting": S, "group": S, "n_units": I, "n_runs": I, **{f"n_{name}": I for name in (*WATCHED, FAILED)},
    **_ESTIMATES, "basis": S,
}  # fmt: skip
_MEASURES: Mapping[str, str] = {
    "setting": S, "group": S, "measure": S, "words": S, "estimate": F, "estimate_low": F, "estimate_high": F,
    "n_units": I, "n_runs": I, "n_censored": I, "n_without": I, "reason": S,
}  # fmt: skip
_MISSING: Mapping[str, str] = {"setting": S, "measure": S, "member_id": S, "reason": S}
_CONTRASTS: Mapping[str, str] = {"setting": S, "key": S, "first_value": S, "second_value": S, **contrast.SCHEMA}


def answer(study: Study) -> Answer | None:
    """How statistics change with each swept key; None where no key is swept."""
    axes, found = axes_of(study.groups), settings(study.groups)
    if not axes:
        return None
    level = study.settings.confidence
    asked = measures(study)
    points = {name: sorted((point_of(study, group, axes, asked) for group in some), key=Point.rank)
              for name, some in found.items()}  # fmt: skip
    rows = [_value_row(point, name, axes, asked, level) for name, some in points.items() for point in some]
    contrasts = [row for name, some in points.items() for row in _contrasts(name, axes, some, asked, study)]
    subjects = {one.name: (one.subject, "" if one.says_it else one.words) for one in asked if one.name not in KEYS}
    for row in contrasts:  # a change from zero is a change, although it has no ratio
        has_interval = row["first_low"] is not None and row["first_high"] is not None
        if not row["is_share"] and has_interval and row["first_low"] <= 0 <= row["first_high"]:
            row |= dict.fromkeys(("relative", "relative_low", "relative_high", "p_equivalent"))
        row |= {"p_different": row["p_absolute"], "p_equivalent": _known(row["p_equivalent"], row["p_absolute"])}
        if row["is_same"] and row["difference_low"] is not None:
            # no test: what is the same in each of a few units may differ in others
            row |= {"p_equivalent": None, "p_different": None, "verdict": SAME}
        row["subject"], row["words"] = subjects.get(row["quantity"], ("", ""))
        row.setdefault("is_few", False)
    contrast.judge(contrasts, 1 - level, Words(WITHIN, RISES, FALLS))
    for row in contrasts:
        row["is_told"] = row["verdict"] != UNKNOWN or bool(row["open"])
        row["beyond"] = _beyond(row, contrasts)
        row["at_places"] = row["places"] and "{n} of {of}".format(**row["places"])
    keys = {key: dtype(axis, k) for axis in axes for k, key in enumerate(axis.keys)}
    tables = {"sweep": frame({**_VALUES, **keys}, rows), "sweep_changes": frame(_CONTRASTS, contrasts)}
    recorded = [one for one in asked if one.is_recorded]
    if recorded:
        tables["sweep_measures"] = frame({**_MEASURES, **keys}, _measured(rows, asked))
        tables["sweep_missing"] = frame(_MISSING, _missing(points, asked))
    lead = max(points, key=lambda name: sum(int(point.group.is_finished.sum()) for point in points[name]))
    own = [
        row
        for row in contrasts
        if row["setting"] == lead and (row["p_different"] is not None or row["is_few"] or row["verdict"] == SAME)
    ]
    facts: dict[str, Any] = {
        "setting": lead,
        "n_settings": len(points),
        "is_by_n": len({some[0].group.key["n"] for some in points.values()}) == len(points),
        "axes": [{"name": axis.name, "keys": axis.keys, "values": axis.texts} for axis in axes],
        "rows": [row for row in rows if row["setting"] == lead] + [row for row in rows if row["setting"] != lead],
        "columns": [(key, key, "g" if kind == F else None) for key, kind in keys.items()],
        "n_tests": sum(row["p_different"] is not None for row in contrasts),
        "n_quiet": sum(row[f"n_{QUIET}"] for row in rows),
        "n_runs": sum(row["n_runs"] for row in rows),
        "n_members": sum(len(point.group) for some in points.values() for point in some),
        "unjudged": [row for row in rows if row["basis"] not in enough.JUDGED],
        "t_burn": study.settings.t_burn,
        **(_facts(points, asked) if recorded else {"measures": [], "gaps": [], "withheld": []}),
    }
    if not own:
        few = max(rows, key=lambda row: row["n_units"])
        return Answer(facts | {"few": few}, lack=enough.FEW_MATRICES, tables=tables)
    leading = (*_by_change(asked, own), IN_MOTION) if recorded else _leading(own)
    still = {one.name for one in asked} - {row["quantity"] for row in contrasts if not row["is_same"]}
    told = _told(own, axes, leading, bool(recorded))
    for row in own:
        row |= _everywhere([one for one in contrasts if _place(one) == _place(row)], len(points))
    most = max(own, key=lambda row: (row["quantity"] == leading[0], row["is_last"], _weight(row)))["key"]
    in_order = [most, *(row["key"] for row in told), *(axis.name for axis in axes)]
    in_order = sorted(axes, key=lambda axis: in_order.index(axis.name))
    if len(axes) > 1 and len(in_order[1].rows) > max(MOST_LINES, len(in_order[0].rows)):
        in_order[:2] = in_order[1::-1]  # a line for each of the few values, not of the many
    drawn = [name for name in leading if name not in still] or leading[:1]
    each = _drawn(points, lead) if len(axes) > 1 else [lead]
    figures, shown_at = dict[str, Any](), dict[str, Row]()
    for k, name in enumerate(each):
        for base, figure in _figures(points, name, in_order, drawn, asked, level).items():
            key = f"{base}-{k + 1}" if k else base  # no measure has a hyphen
            figures[key] = figure
            shown_at[key] = {"figure": base, "setting": name if len(axes) > 1 and len(points) > 1 else ""}
    facts |= {
        "changes": sorted(_ends(own, axes), key=lambda row: row["is_same"]),
        "ends": [row for row in contrasts if row["is_last"] and row["first"] is not None],
        "told": told,
        "figures": list(figures),
        "shown_at": shown_at,
        "n_drawn": len(each),
        "is_mixed": _is_mixed(study),
        "along": in_order[0].name,
        "lines": _lines_drawn(in_order),
        "mapped": next((_figure(one) for one in asked if one.name == leading[0]), ""),
    }
    return Answer(facts, tables=tables, figures=figures)


def _drawn(points: Mapping[str, Sequence[Point]], lead: str) -> list[str]:
    """The settings with pictures of their own: the one that leads first, then those of the exact law."""
    rest = sorted((name for name in points if name != lead), key=lambda name: not points[name][0].group.is_exact)
    return [lead, *rest][:MOST_SETTINGS]


def _is_mixed(study: Study) -> bool:
    """Whether it is recorded that runs settle on different things."""
    own = study.data.table.own
    return "attractor" in own and own["attractor"].nunique() > 1


def _contrasts(
    setting: str, axes: Sequence[Axis], points: Sequence[Point], asked: Sequence[Measure], study: Study
) -> Iterator[Row]:
    """Contrasts of each value of each axis with the first that has enough units, not judged yet."""
    by_place = {tuple(point.at.values()): point for point in points}
    level, recorded = study.settings.confidence, {one.name for one in asked} - {*KEYS}
    # a change below it, in units of the largest value of a unit, is of the size of the runs' own errors
    noise = max([ROUNDING, *(point.group.key[name] or 0.0 for point in points for name in RELATIVE)])
    statistics = [*(one.statistic for one in asked), Share(IN_MOTION)]
    largest = {one.name: _largest(one.name, points) for one in statistics}
    for axis, one in product(axes, statistics):
        n_units = {value: _n_units(one.name, points, axis, value) for value in axis.rows}
        many = [value for value, n in n_units.items() if n >= enough.LEAST_MATRICES]
        base, *others = many if len(many) > 1 else axis.rows
        for value in others:
            pairs = [
                (by_place[before], point)
                for point in points
                if point.at[axis] == value and (before := tuple((point.at | {axis: base}).values())) in by_place
            ]
            is_bounded = one.name == IN_MOTION
            first, second, n_pairs = _in_common((IN_MOTION, AT_MOST) if is_bounded else (one.name,), pairs)
            if is_bounded and not _differ(first, second, one.name):
                continue
            row = contrast.contrast(one, first, second, paired=True, confidence=level)
            if is_bounded:
                row |= _either_way(row, one, first, second, level)
            if one.name in recorded and row["reason"] == enough.FEW_MATRICES:
                row |= _of_few(one, first, second, level)
            yield row | {
                "setting": setting, "key": axis.name, "first_value": in_words(base), "second_value": in_words(value),
                "last_value": in_words(axis.rows[-1]), "is_last": value == others[-1],
                "is_same": not one.is_share and _is_same(first, second, one.name, noise * largest[one.name]),
                "is_part": not one.is_share and row["n_first"] < max(n_units[base], n_units[value]),
                "places": _places(axis, pairs, n_pairs),
            }  # fmt: skip


def _places(axis: Axis, pairs: Sequence[tuple[Point, Point]], n_pairs: int) -> Row | None:
    """At how many points of the other keys a contrast is, of how many; None where it is at all that there are."""
    if n_pairs == len(pairs):
        return None
    others = [one for one in pairs[0][0].at if one != axis]
    if len(others) == 1:
        return {"n": n_pairs, "of": len(others[0].rows), "name": others[0].name}
    return {"n": n_pairs, "of": len(pairs), "name": ""}


def _is_same(first: Sample, second: Sample, name: str, noise: float) -> bool:
    """Whether a statistic that is known is the same in each unit; not said of shares, which are of few runs."""
    a, b = (some.of(name).rows for some in (first, second))
    return len(a) > 0 and bool((np.abs(a[:, 0] / a[:, 1] - b[:, 0] / b[:, 1]) <= noise).all())


def _either_way(row: Row, one: Statistic, first: Sample, second: Sample, confidence: float) -> Row:
    """What holds of a contrast of shares in motion whatever quiet runs do: weaker tests and a wider interval."""
    corners = [
        contrast.contrast(
            one, Sample({one.name: first.of(a)}), Sample({one.name: second.of(b)}), paired=True,
            confidence=confidence,
        )
        for a, b in ((AT_MOST, IN_MOTION), (IN_MOTION, AT_MOST))
    ]  # fmt: skip
    if row["difference"] is None or any(corner["difference"] is None for corner in corners):
        return {}
    found: Row = {name: max(corner[name] for corner in corners) for name in ("p_absolute", "difference_high")}
    found["difference_low"] = min(corner["difference_low"] for corner in corners)
    found |= {"first_high": corners[0]["first_high"], "second_high": corners[1]["second_high"]}
    found |= {f"relative_{end}": found[f"difference_{end}"] for end in ("low", "high")}
    if corners[0]["difference"] <= 0 <= corners[1]["difference"]:
        found["p_absolute"] = 1.0
    return found | {"p_equivalent": max((_known(corner["p_equivalent"], corner["p_absolute"]) for corner in corners),
                                        key=lambda p: -1.0 if p is None else p)}  # fmt: skip


def _of_few(one: Statistic, first: Sample, second: Sample, confidence: float) -> Row:
    """Values for a contrast of too few units, which has no test; nothing where there is no unit at all."""
    before, after = (one.estimate(some.of(one.name), confidence) for some in (first, second))
    if before.value is None or after.value is None:
        return {}
    return (
        named("first", before) | named("second", after) | {"difference": after.value - before.value, "is_few": True}
    )


def _n_units(name: str, points: Sequence[Point], axis: Axis, value: tuple[Value, ...]) -> int:
    """Number of units for which a statistic is known at one value of an axis."""
    return len(UnitSums.together(point.sample.of(name) for point in points_at(points, axis, value)))


def _largest(name: str, points: Sequence[Point]) -> float:
    """The largest size of a statistic of one unit."""
    every = (point.sample.of(name).rows for point in points)
    return max(float(np.abs(rows[:, 0] / rows[:, 1]).max(initial=0.0)) for rows in every)


def _in_common(names: Sequence[str], pairs: Sequence[tuple[Point, Point]]) -> tuple[Sample, Sample, int]:
    """The sums of the first and of the second points of pairs, for the units that both of a pair have.

    And of how many pairs units count, for the first name.

    Of several pairs, all units count over the same ones, as far as that leaves enough: else a unit that lacks a pair
    would differ from others by what that pair is like.
    """
    samples = [(a.sample, b.sample) for a, b in pairs if a.group.unit == b.group.unit]
    first, second, n_pairs = Sample(), Sample(), list[int]()
    for name in names:
        sums = [(a.of(name), b.of(name)) for a, b in samples]
        sums = [(a.within(b), b.within(a)) for a, b in sums]
        pairs_kept, units = _without_gaps([a.units for a, _ in sums])
        first.sums[name], second.sums[name] = (
            UnitSums.together(sums[k][which].within(units) for k in pairs_kept) for which in (0, 1)
        )
        n_pairs.append(sum(len(sums[k][0].within(units)) > 0 for k in pairs_kept))
    return first, second, n_pairs[0]


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
    return 0 < rows[:, 0].sum() < rows[:, 1].sum()


def _ends(rows: Sequence[Row], axes: Sequence[Axis]) -> list[Row]:
    """The contrasts of the last value of each axis with its first."""
    return [row for axis in axes for row in rows if row["key"] == axis.name and row["is_last"]]


def _told(rows: Sequence[Row], axes: Sequence[Axis], leading: Sequence[str], is_recorded: bool) -> list[Row]:
    """One contrast a key, the largest change first: that of its ends or, if they show none, one that is shown.

    Where something is recorded, it is that of the first of `leading`, whatever changes besides.
    """

    def order(row: Row) -> tuple[Any, ...]:
        is_shown = row["verdict"] in (RISES, FALLS)
        place = leading.index(row["quantity"])
        return place if is_recorded else 0, not is_shown, place, not row["is_last"], -_weight(row)

    by_axis = [[row for row in rows if row["key"] == axis.name] for axis in axes]
    found = [min(some, key=order) for some in by_axis if some]
    return sorted(found, key=lambda row: (row["verdict"] not in (RISES, FALLS), -_weight(row)))


def _beyond(end: Row, rows: Sequence[Row]) -> Row | None:
    """Of the values between a key's ends, the one at which a statistic is furthest beyond both, if it is at any.

    That is judged against the first value by its verdict, and against the last as the intervals of both changes lie
    apart.
    """
    low, high = end["difference_low"], end["difference_high"]
    if not end["is_last"] or end["is_share"] or low is None:
        return None
    alike = [row for row in rows if all(row[name] == end[name] for name in ("setting", "quantity", "key"))]
    above = [row for row in alike if row["verdict"] == RISES and row["difference_low"] > max(high, 0.0)]
    below = [row for row in alike if row["verdict"] == FALLS and row["difference_high"] < min(low, 0.0)]
    return max([*above, *below], key=lambda row: abs(row["difference"]), default=None)


def _place(row: Row) -> tuple[Any, ...]:
    """What identifies a change in every setting."""
    return tuple(row[name] for name in ("quantity", "key", "first_value", "second_value"))


def _everywhere(rows: Sequence[Row], n_settings: int) -> Row:
    """Least and largest relative change over several settings, and the verdicts; None if a setting has no value."""
    known = sorted((row for row in rows if row["relative"] is not None), key=lambda row: row["relative"])
    if not len(known) == n_settings > 1 or any(row["places"] != known[0]["places"] for row in known):
        return {"everywhere": None}
    verdicts = Counter(row["verdict"] for row in known).most_common()
    return {"everywhere": {"ends": [known[0]["relative"], known[-1]["relative"]], "verdicts": verdicts}}


def _weight(row: Row) -> float:
    """Size of a change in units of its margin; infinite for a change from zero, 0 where it was not tested."""
    if row["p_different"] is None or row["is_same"]:
        return 0.0
    return np.inf if row["relative"] is None else contrast.weight(row)


def _known(*p: float | None) -> float | None:
    """The first p-value; 1, which shows nothing, if it is missing but the second is known."""
    return p[0] if p[0] is not None or p[1] is None else 1.0


def _by_change(asked: Sequence[Measure], rows: Sequence[Row]) -> list[str]:
    """Measures in order, last those that are the same everywhere, as the energy of a start."""
    moved = {row["quantity"] for row in rows if row["difference"] is not None and not row["is_same"]}
    return sorted((one.name for one in asked), key=lambda name: name not in moved)


def _leading(rows: Sequence[Row]) -> tuple[str, ...]:
    """The statistics in order: shares of runs come first if one changes beyond its margin, else mean n_stick."""
    moved = [row for row in rows if row["is_share"] and row["verdict"] in (RISES, FALLS) and _weight(row) > 1]
    return (IN_MOTION, MEAN, GAMMA) if moved else (MEAN, GAMMA, IN_MOTION)


def _value_row(point: Point, setting: str, axes: Sequence[Axis], asked: Sequence[Measure], confidence: float) -> Row:
    """What is known at a point: its place, its runs by fate, and its estimates; of measures, by their place."""
    names = [key for axis in axes for key in axis.keys]
    values = (value if isinstance(value, float) else str(value) for value in chain.from_iterable(point.at.values()))
    keys = dict(zip(names, values, strict=True))
    estimates = [named(name, estimate(of, [point], confidence)) for name, of in _OF.items()]
    measured = [estimate(one.statistic, [point], confidence) for one in asked]
    return {
        "setting": setting, "group": point.group.label, "at": ", ".join(map(in_words, point.at.values())), **keys,
        "n_units": len(point.group.units), "n_runs": sum(point.fates[name] for name in WATCHED),
        **{f"n_{name}": n for name, n in point.fates.items()},
        **ChainMap(*estimates),
        "basis": point.group.basis(confidence).code,
        **ChainMap(*(named(_cell(k), one) for k, one in enumerate(measured))),
        "reasons": [one.reason for one in measured],
        **{f"{_cell(k)}_runs": len(point.group) - len(point.values[one.name].missing) for k, one in enumerate(asked)},
        **{f"{_cell(k)}_censored": point.values[one.name].n_censored for k, one in enumerate(asked)},
        "values": [point.values[one.name] for one in asked],
    }  # fmt: skip


def _cell(k: int) -> str:
    """Where a row has the estimate of the k-th measure; no key of a scene has a space."""
    return f"measure {k}"


def _measured(rows: Sequence[Row], asked: Sequence[Measure]) -> Iterator[Row]:
    """Rows of the table `sweep_measures`: each measure at each point."""
    for row in rows:
        for k, (one, values, why) in enumerate(zip(asked, row["values"], row["reasons"], strict=True)):
            yield row | {f"estimate{end}": row[f"{_cell(k)}{end}"] for end in ("", "_low", "_high")} | {
                "measure": one.name, "words": one.words or None, "n_units": len(values.sums),
                "n_censored": values.n_censored, "n_without": len(values.missing),
                "reason": values.withheld or why or None,
            }  # fmt: skip


def _missing(points: Mapping[str, Sequence[Point]], asked: Sequence[Measure]) -> Iterator[Row]:
    """Rows of the table `sweep_missing`: each run without a value, and why."""
    for setting, some in points.items():
        for point, one in product(some, asked):
            for member_id, reason in point.values[one.name].missing.items():
                yield {"setting": setting, "measure": one.name, "member_id": member_id, "reason": reason}


def _facts(points: Mapping[str, Sequence[Point]], asked: Sequence[Measure]) -> dict[str, Any]:
    """Measures in words, and the runs and the points that have no value of one."""
    every = [point for some in points.values() for point in some]
    gaps: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for one in asked:
        missing = tuple(
            found for point in every for found in point.values[one.name].missing.items() if found[1] != one.absent
        )
        gaps.setdefault(missing, []).append(one.axis)
    known = [(k, one) for k, one in enumerate(asked) if any(len(point.values[one.name].sums) for point in every)]
    shown = [
        (one.name, _cell(k), any(point.values[one.name].n_censored for point in every),
         any(point.values[one.name].missing for point in every))
        for k, one in known[:MOST_COLUMNS]
    ]  # fmt: skip
    return {
        "measures": [
            {"subject": one.subject, "words": "" if one.says_it else one.words, "definition": one.words,
             "axis": one.axis, "figure": _figure(one)}
            for one in asked
            if one.name not in KEYS
        ],
        "n_beyond": len(known) - len(shown),
        "gaps": [{"of": of, "runs": runs} for runs, of in gaps.items() if runs],
        "withheld": [
            {"subject": one.subject, "why": why, "at": [point.group.label for point in some]}
            for one in asked
            if one.name not in KEYS  # an alert of their own says it
            for why, some in _withheld(one, every).items()
        ],
        "cells": [cell for name, key, is_cut, lacks in shown
                  for cell in ((name, key, "#"), ("interval", (f"{key}_low", f"{key}_high"), "#"),
                               *[("cut off", f"{key}_censored", "n")] * is_cut,
                               *[("of runs", f"{key}_runs", "n")] * lacks)],
    }  # fmt: skip


def _withheld(one: Measure, points: Sequence[Point]) -> dict[str, list[Point]]:
    """The points at which a measure is not given although runs have it, by the reason."""
    found: dict[str, list[Point]] = {}
    for point in points:
        if why := point.values[one.name].withheld:
            found.setdefault(why, []).append(point)
    return found


_OF = {
    "mean": Statistic(MEAN, ratio, 0.0, least=0.0),
    "gamma": Statistic(GAMMA, QUANTITIES["gamma"].of, 0.0, least=0.0),
    "moving": Share(IN_MOTION),
}


def _figure(one: Measure) -> str:
    """Name of the figure of a measure along a key."""
    return f"sweep_{one.key}" if one.name in KEYS else f"sweep_of_{one.key}"


def _figures(
    points: Mapping[str, Sequence[Point]], lead: str, axes: Sequence[Axis], leading: Sequence[str],
    asked: Sequence[Measure], level: float,
) -> dict[str, Any]:  # fmt: skip
    """A map over the first two axes, and the statistics along the first, in the order of `leading`."""
    main = points[lead]
    ticks = axes[0].x, axes[0].texts
    statistics = {of.name: of for of in _OF.values()} | {one.name: one.statistic for one in asked}
    names = {name: f"sweep_{key}" for name, key in KEYS.items()} | {one.name: _figure(one) for one in asked}
    labels = {**AXES, IN_MOTION: IN_MOTION} | {one.name: one.axis for one in asked}
    may_be_log = any(one.is_recorded for one in asked)
    found: dict[str, Any] = {}
    if len(axes) > 1:
        of = statistics[leading[0] if may_be_log or leading[0] == IN_MOTION else MEAN]
        some = _throughout(of, main, axes)
        cells = [
            [estimate(of, points_at(points_at(some, axes[1], y), axes[0], x), level).value for x in axes[0].rows]
            for y in axes[1].rows
        ]
        across, up = ((axis.name, axis.texts) for axis in axes[:2])
        if any(value is not None for row in cells for value in row):
            found["sweep_map"] = partial(heat_map, labels[of.name], across, up, cells, may_be_log)
    for name in leading[:MOST_FIGURES]:
        if name == IN_MOTION:
            at_value = [[point.fates for point in points_at(main, axes[0], value)] for value in axes[0].rows]
            counts = {end: [sum(fates[end] for fates in some) for some in at_value] for end in FATES}
            if any(any(some) for end, some in counts.items() if end not in MOVING):
                found["sweep_fates"] = partial(shares, axes[0].name, ticks[1], counts)
            continue
        lines = _lines(points, lead, axes, statistics[name], level)
        if sum(one is not None for _, some in lines for one in some) > 1:
            found[names[name]] = partial(curves, labels[name], axes[0].name, *ticks, lines, may_be_log)
    return found


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


def _lines_drawn(axes: Sequence[Axis]) -> dict[str, Any]:
    """How many values of the second axis have a line, of how many; nothing if there is none."""
    if len(axes) < 2:
        return {}
    return {"name": axes[1].name, "of": len(axes[1].rows), "n": min(len(axes[1].rows), MOST_LINES)}


def _lines(
    points: Mapping[str, Sequence[Point]], lead: str, axes: Sequence[Axis], of: Statistic, level: float
) -> list[tuple[str, list[Estimate | None]]]:
    """Lines along the first axis, one for each value of the second, or for each setting."""
    kept = {lead, *list(points)[: MOST_LINES - 1]}
    parts: list[tuple[str, Sequence[Point]]] = [(name, some) for name, some in points.items() if name in kept]
    if len(axes) > 1:
        along = axes[1]
        drawn = np.linspace(0, len(along.rows) - 1, _lines_drawn(axes)["n"]).round().astype(int).tolist()
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
                    color=colours[k], label=name)  # fmt: skip
        if (value < floor).any():
            ax.plot(here[value < floor], np.full((value < floor).sum(), floor), "v", color=colours[k], markersize=5,
                    markerfacecolor="white")  # fmt: skip
    if x is None:
        ax.set_xticks(at, ticks)
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
        ax.figure.legend(loc="outside upper center", ncols=min(len(lines), 3), fontsize=7, handlelength=1.2)


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
        axis.set_ticks(range(0, len(ticks), step), ticks[::step])
    bar = ax.figure.colorbar(image, ax=ax, label=what)
    if not is_log:
        bar.ax.yaxis.set_major_locator(MaxNLocator(nbins=5))
    bar.outline.set_edgecolor(GREY)


QUESTION = Question(answer, share=0, rank=1)
