"""How friction law, smoothing, threshold of sticking and tolerance change each statistic on the same matrices.

The exact engine at its tightest tolerance is the reference for other engines. It is also the reference for further
thresholds of sticking, which are applied to the same runs; if it did not run, the runs' own definition is. The
tightest tolerance of an engine is the reference for its looser ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, B, F, Question, Row, S, frame
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.contrast import (
    SCHEMA,
    Sample,
    contrast,
    judge,
    sample,
    shares,
    statistics,
    told,
    weight,
)
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, STEPS, SYSTEM_KEYS, TOLERANCES, WIDTHS
from stickslip.analysis.stats.compare import AGREE, DIFFER, UNKNOWN
from stickslip.analysis.stats.estimates import UnitSums
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.style import BLUE, GREY, ORANGE, panel
from stickslip.pipeline.design.labels import engine_name
from stickslip.sim.engines import symbol

FRICTION, TOLERANCE, THRESHOLD = "law", "tolerance", "threshold"
#: Smoothing does not explain a difference between engines of more than this many margins, for eps up to _SMOOTH: the
#: sigmoid differs from the exact engine by O(eps), 3% in mean n_stick at eps = 0.03. Above, the limit grows with eps.
_EXPLAINED, _SMOOTH = 2.0, 0.03
#: Nor is it known what smoothing explains for eps beyond this share of the belt's speed: at 0.3 of it the mean
#: n_stick of 200 blocks was a third below the exact law's, at 0.1 a twentieth.
_OF_BELT = 0.15 * (1 + 1e-9)
_BY_THRESHOLD = ("mean", "rate", "gamma")
_MARKS = {AGREE: ("o", BLUE), DIFFER: ("s", ORANGE), UNKNOWN: ("D", GREY)}
_WIDEST = 3.0  # margins to each side in the figure: showing more would leave no room for the other statistics
_TABLE: Mapping[str, str] = {
    "kind": S, "setting": S, "reference": S, "threshold": F, **SCHEMA, "is_suspect": B,
}  # fmt: skip


@dataclass(frozen=True)
class _Pair:
    """A group and its reference; `threshold` is a further definition of sticking, applied to the group's runs."""

    kind: str
    reference: Group
    other: Group
    threshold: float | None = None


def answer(study: Study) -> Answer | None:
    """How each statistic depends on the engine and its settings; None where there is only one."""
    by_threshold = _by_threshold(study)
    pairs = list(_pairs(study, by_threshold))
    if not pairs:
        return None
    level, margins = study.settings.confidence, study.margins
    families: dict[tuple[str, str], list[Row]] = {}
    for pair in pairs:
        asked = statistics(margins) + shares() if pair.threshold is None else statistics(margins, _BY_THRESHOLD)
        of_pair = {
            "kind": pair.kind, "reference": pair.reference.label, "setting": pair.other.label,
            "threshold": pair.threshold, "n": pair.other.key["n"], "of_reference": _engine(pair.reference),
            "of_setting": _engine(pair.other),
        }  # fmt: skip
        rows = families.setdefault((pair.kind, pair.reference.label), [])
        for one in asked:  # one by one: sums of all take more memory than all that is known of the runs
            theirs = (
                sample(pair.other, [one.name])
                if pair.threshold is None
                else by_threshold[pair.other.label][pair.threshold]
            )
            rows.append(of_pair | contrast(one, sample(pair.reference, [one.name]), theirs, True, level))
    for rows in families.values():
        judge(rows, 1 - level)
        for row in rows:
            row["is_suspect"] = _is_suspect(row) and not _agrees_with_less(row, rows)
    found = [row for rows in families.values() for row in rows]
    tables, facts = {"engines": frame(_TABLE, found)}, _facts(found)
    if not any(facts.values()):
        lack = next((row["reason"] for row in found if row["reason"]), "nothing to count")
        return Answer(facts | {"n_matrices": min(row["n_first"] for row in found)}, lack=lack, tables=tables)
    facts["with_episodes"] = study.data.episodes is not None
    drawn = [one["rows"] for one in facts["laws"] or facts["tolerances"]]
    return Answer(facts, tables=tables, figures={"contrasts": partial(contrasts, drawn[0])} if drawn else {})


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


def _engine(group: Group) -> Row:
    static = group.key["static"] is not None or "static" in group.table.design.values(group.point)
    known = {name: group.key[name] for name in (*WIDTHS, *STEPS) if group.key[name] is not None}
    return {
        "engine": engine_name(group.key["engine"]), "static": static, "belt_speed": group.key["belt_speed"],
        "width": next((value for name, value in known.items() if name in WIDTHS), None),
        "settings": ", ".join(f"{symbol(name)} = {value:g}" for name, value in known.items()),
    }  # fmt: skip


def _is_suspect(row: Mapping[str, Any]) -> bool:
    """Whether a statistic differs between an exact engine and a smoothed law by more than smoothing explains.

    It does if the difference is significant after adjustment and its whole interval lies beyond `_EXPLAINED` margins
    times max(1, width / _SMOOTH). If one value is zero there is no relative difference: then the statistic is suspect
    if the interval of the other value excludes zero. Two exact or two smoothed settings are not judged. Nor is static
    friction above the kinetic, where a smoothed block creeps before it slips and may never slip, nor a slow belt, of
    whose speed the width is more than `_OF_BELT`.
    """
    width, reference = row["of_setting"]["width"], row["of_reference"]
    if row["kind"] != FRICTION or width is None or reference["width"] is not None or reference["static"]:
        return False
    belt = row["of_setting"]["belt_speed"]
    if belt is not None and float(width) > _OF_BELT * abs(belt):
        return False
    if not row["is_share"] and (row["first"] == 0.0) != (row["second"] == 0.0):
        low = row["second_low"] if row["first"] == 0.0 else row["first_low"]
        return low is not None and low > 0.0
    if row["verdict"] != DIFFER:
        return False
    allowed = _EXPLAINED * row["margin"] * max(1.0, float(width) / _SMOOTH)
    return bool(row["relative_low"] > allowed or row["relative_high"] < -allowed)


def _agrees_with_less(row: Row, rows: Sequence[Row]) -> bool:
    """Whether the same statistic agrees under the same law with less smoothing."""
    return any(
        other["quantity"] == row["quantity"]
        and other["verdict"] == AGREE
        and (other["of_setting"]["width"] or np.inf) < row["of_setting"]["width"]
        for other in rows
    )


def _facts(found: Sequence[Row]) -> dict[str, Any]:
    """Facts for the page, by kind of comparison; the largest systems come first."""
    by_kind = {
        kind: sorted((row for row in found if row["kind"] == kind), key=lambda row: -row["n"])
        for kind in (FRICTION, TOLERANCE, THRESHOLD)
    }
    laws = []
    for rows in _parted(by_kind[FRICTION], "setting"):
        shown = told(rows)
        if shown:
            of = {"setting": rows[0]["setting"], "reference": rows[0]["reference"]}
            of["n_moving"], of["n_runs"] = (max(row["n_first"] for row in rows if row["is_share"] is which)
                                            for which in (False, True))  # fmt: skip
            laws.append(summary(shown) | of | {"first": rows[0]["of_reference"], "second": rows[0]["of_setting"]})
    return {
        "laws": laws,
        "tolerances": [one for rows in _parted(by_kind[TOLERANCE], "reference") if (one := _sufficient(rows))],
        "thresholds": [one for rows in _parted(by_kind[THRESHOLD], "setting") if (one := _moved(rows))],
        "suspects": [
            some[0] | {"n_more": len(some) - 1}
            for rows in _parted(by_kind[FRICTION], "setting")
            if (some := [row for row in rows if row["is_suspect"]])
        ],
    }


def _parted(rows: Sequence[Row], key: str) -> list[list[Row]]:
    """Rows split by the value of a key, in the order in which the values first occur."""
    return [[row for row in rows if row[key] == name] for name in dict.fromkeys(row[key] for row in rows)]


def summary(shown: Sequence[Row]) -> Row:
    """Contrasts by verdict; `worst` is the largest that differs, else of those unknown, else of those that agree.

    Differences whose interval excludes zero come before others.
    """
    by = {verdict: [row for row in shown if row["verdict"] == verdict] for verdict in (DIFFER, UNKNOWN, AGREE)}
    return {
        "rows": shown,
        "n_tests": shown[0]["n_tests"],
        "differ": by[DIFFER],
        "unknown": by[UNKNOWN],
        "agree": by[AGREE],
        "worst": max(next(some for some in by.values() if some), key=_shown_first),
    }


def _shown_first(row: Row) -> tuple[bool, float]:
    return not row["relative_low"] <= 0 <= row["relative_high"], weight(row)


def _sufficient(rows: Sequence[Row]) -> Row | None:
    """The loosest tolerance at which, and at all tighter ones, every statistic agrees with the reference."""
    by_setting = _parted(rows, "setting")  # from the tightest to the loosest
    known = told(rows)
    if not known:
        return None
    enough = None
    for some in by_setting:
        if {row["verdict"] for row in told(some)} != {AGREE}:
            break
        enough = some[0]["setting"]
    settings = [some[0]["setting"] for some in by_setting]
    return {
        "reference": rows[0]["reference"],
        "sufficient": enough,
        "n_looser": len(settings) - (settings.index(enough) + 1 if enough else 0),
        "rows": known,
        "worst": max(known, key=weight),
    }


def _moved(rows: Sequence[Row]) -> Row | None:
    """Least and largest relative difference of each statistic over thresholds, and at how many it agrees."""
    known = told(rows)
    moved = [
        {"quantity": some[0]["quantity"], "low": min(row["relative"] for row in some),
         "high": max(row["relative"] for row in some), "n": len(some),
         "n_agree": sum(row["verdict"] == AGREE for row in some),
         "n_differ": sum(row["verdict"] == DIFFER for row in some)}
        for some in _parted(known, "quantity")
    ]  # fmt: skip
    thresholds = [row["threshold"] for row in known]
    if not known:
        return None
    of = {"setting": rows[0]["setting"], "second": rows[0]["of_setting"], "first": rows[0]["of_reference"]}
    return of | {"least": min(thresholds), "most": max(thresholds), "moved": moved}


@panel()
def contrasts(ax: Axes, rows: Sequence[Row]) -> None:
    """Relative differences in units of their margins, one line a statistic.

    Bars are the intervals of the equivalence tests. An arrowhead marks a difference beyond the axis.
    """
    ax.axvspan(-1, 1, color=GREY, alpha=0.13, linewidth=0)
    ax.axvline(0, color=GREY, linewidth=0.8)
    ends = [abs(row[end]) / row["margin"] for row in rows for end in ("narrow_low", "narrow_high")]
    widest = min(max(1.3, *(1.08 * end for end in ends)), _WIDEST)
    for y, row in enumerate(rows):
        mark, colour = _MARKS[row["open"] or row["verdict"]]
        x, *bar = (row[name] / row["margin"] for name in ("relative", "narrow_low", "narrow_high"))
        if abs(x) > widest:
            mark = ">" if x > 0 else "<"
        ax.plot(bar, [y, y], color=colour, linewidth=1.4)
        ax.plot([min(max(x, -widest), widest)], [y], mark, color=colour, markersize=4, clip_on=False)
    ax.set(xlim=(-widest, widest), ylim=(len(rows) - 0.5, -0.5), xlabel="difference / margin")
    ax.set_yticks(range(len(rows)), [row["quantity"] for row in rows])
    ax.tick_params(axis="y", length=0)


QUESTION = Question(answer, share=0.05)
