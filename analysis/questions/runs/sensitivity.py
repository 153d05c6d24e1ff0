"""How fast changed copies leave their base: growth rates of small displacements, and when runs have parted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Separation, Study
from stickslip.analysis.members import RELATIVE
from stickslip.analysis.models.fates import median
from stickslip.analysis.models.growth import growth
from stickslip.analysis.pairs import START, Comparison, Followed, Setting, follow, level, settings
from stickslip.analysis.series import parting
from stickslip.analysis.stats.compare import UNKNOWN
from stickslip.analysis.style import CYCLE, GREY, panel
from stickslip.pipeline.design.values import shown
from stickslip.sim.engines import ENGINES

GROWS, SHRINKS = "grow", "shrink"
T_FROM, LEAST = 100.0, 100.0  # where the range of a growth rate begins, and the shortest that counts
CEILING = 3e-2  # of distances that still grow in proportion
SMALL = 0.1  # largest displacement of a start for a growth rate, as a share of the ceiling
FLOOR, TOLERANCES = 1e-13, 10.0  # floor of exact engines; that of others is so many times their relative tolerance
_GROWTH: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "size": F, "rate": F, "rate_low": F, "rate_high": F, "e_fold": F,
    "e_fold_low": F, "e_fold_high": F, "t_from": F, "t_to": F, "n_pairs": I, "n_used": I, "n_floor": I,
    "n_ceiling": I, "is_selected": "boolean", "verdict": S,
}  # fmt: skip
_PARTING: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "kind": S, "reading": S, "size": F, "level": F, "n_pairs": I,
    "n_parted": I, "median": F, "median_low": F, "median_high": F,
}  # fmt: skip
_CURVES: Mapping[str, str] = {"setting": S, "change": S, "t": F, "n_pairs": I, "gap": F}


def answer(study: Study) -> Answer | None:
    """Growth rates of displaced starts, and when the copies with each change have parted from their base."""
    found = [one for one in settings(study.data.table) if one.comparisons]
    if not found:
        return None
    growths, partings, curves = [], [], []
    for setting in found:
        for comparison in setting.comparisons:
            if comparison.change.kind == START and comparison.change.size <= SMALL * CEILING:
                growths.append(_growth_row(study, setting, comparison))
        apart = level(study, setting)
        if apart is None:
            continue
        every = follow(study, setting.comparisons, apart, float(setting.key["t_end"]))
        for comparison, followed in zip(setting.comparisons, every, strict=True):
            if len(followed):
                partings.append(_parting_row(study, setting, comparison, followed, apart))
                curves += _curve_rows(setting, comparison, followed, apart)
    growths.sort(key=lambda row: -row["n"])
    tables = {
        "growth": frame(_GROWTH, growths),
        "parting": frame(_PARTING, partings),
        "parting_curves": frame(_CURVES, curves),
    }
    told = [row for row in growths if row["verdict"] != UNKNOWN]
    largest = max((row["n"] for row in (*told, *partings)), default=None)
    facts: dict[str, Any] = {
        "span": parting.SPAN,
        "share": parting.SHARE,
        "t_burn": study.settings.t_burn,
        "ceiling": CEILING,
        "floor": FLOOR,
        "tolerances": TOLERANCES,
        "n_moved": len(growths),
        "n_displaced": sum(row["n_floor"] is not None for row in growths),
    }
    if largest is None:
        return Answer(facts, "no pairs", tables)
    of_first = [row for row in told if row["n"] == largest and row["setting"] == told[0]["setting"]]
    lead = max(of_first, key=lambda row: row["t_to"] - row["t_from"], default=None)
    label = next(row["setting"] for row in (*([lead] if lead else []), *partings) if row["n"] == largest)
    facts |= {
        "lead": lead,
        "setting": label,
        "parting": [row for row in partings if row["setting"] == label],
        "small": SMALL * CEILING,
        "rates": [row for row in growths if row["rate"] is not None],
    }
    some = [row for row in curves if row["setting"] == label]
    facts["has_curves"] = bool(some)
    lines = _distance_lines(study, found, told)
    figures = {"parting": partial(parting_curves, _by_change(some))} if some else {}
    if lines:
        figures["growth"] = partial(distances, lines)
    return Answer(facts, tables=tables, figures=figures)


def _growth_row(study: Study, setting: Setting, comparison: Comparison) -> Row:
    """Growth rate of starts displaced by one size, with its verdict."""
    size = comparison.change.size
    identity = {"setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"], "size": size}
    row: Row = dict.fromkeys(_GROWTH) | identity | {"verdict": UNKNOWN, "n_pairs": len(comparison.pairs), "n_used": 0}
    separations = _separations(study, comparison)
    pairs = [pair for pair in comparison.pairs if len(separations.get(pair.changed, ((),))[0])]
    if not pairs:
        return row
    known = [separations[pair.changed] for pair in pairs]
    times = max((t for t, _ in known), key=len)
    floor = _floor(setting.key)
    found = growth(
        times, [distance for _, distance in known], [pair.matrix for pair in pairs],
        T_FROM, LEAST, (floor, CEILING), study.settings.confidence,
    )  # fmt: skip
    rate = found.rate
    row |= {
        **named("rate", rate), "t_from": found.t_from, "t_to": found.t_to,
        "n_used": found.n_pairs - found.n_floor - found.n_ceiling, "n_floor": found.n_floor,
        "n_ceiling": found.n_ceiling, "is_selected": found.is_selected,
    }  # fmt: skip
    if rate.low is not None and rate.high is not None and rate.value and not rate.low <= 0 <= rate.high:
        ends = sorted((abs(1 / rate.low), abs(1 / rate.high)))
        row |= {"e_fold": abs(1 / rate.value), "e_fold_low": ends[0], "e_fold_high": ends[1]}
        if not found.is_selected:
            row["verdict"] = GROWS if rate.value > 0 else SHRINKS
    return row


def _floor(key: Mapping[str, Any]) -> float:
    """The distance of two runs below which the errors of an engine and its settings hide it."""
    tolerances = [] if ENGINES[key["engine"]].is_exact else [key[name] or 0.0 for name in RELATIVE]
    return max([FLOOR, *(TOLERANCES * tolerance for tolerance in tolerances)])


def _separations(study: Study, comparison: Comparison) -> dict[int, Separation]:
    """What was recorded of the changed members, by their rows."""
    names = study.data.table.own["member_id"].iloc[comparison.changed]
    known = study.data.separations
    return {row: known[name] for row, name in zip(names.index.tolist(), names, strict=True) if name in known}


def _parting_row(study: Study, setting: Setting, comparison: Comparison, followed: Followed, apart: float) -> Row:
    """When half of the matrices' copies have parted."""
    change = comparison.change
    _, first = np.unique(followed.matrix, return_index=True)  # of several draws: matrices are the independent units
    has_parted = followed.has_parted[first]
    times = np.where(has_parted, followed.t[first], followed.t_stop[first])
    half = median(times, has_parted, study.settings.confidence)
    return {
        "setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"], "change": str(change),
        "of": change, "t_end": float(setting.key["t_end"]),
        "kind": change.kind, "reading": change.reading, "size": change.size, "level": apart,
        "n_pairs": len(followed), "n_parted": int(followed.has_parted.sum()), **named("median", half),
    }  # fmt: skip


def _curve_rows(setting: Setting, comparison: Comparison, followed: Followed, apart: float) -> list[Row]:
    """Mean gap over the pairs, in units of the level, in intervals of time whose length grows with time."""
    rows = []
    for t, means in zip(followed.times.tolist(), followed.means.T, strict=True):
        still = means[~np.isnan(means)]
        if 2 * len(still) < len(followed):
            break
        rows.append({
            "setting": setting.label, "change": str(comparison.change), "t": t, "n_pairs": len(still),
            "gap": float(np.mean(still)) / apart,
        })  # fmt: skip
    return rows


Line = tuple[str, np.ndarray, np.ndarray]  # name, times, values
Stretch = tuple[str, np.ndarray, np.ndarray, tuple[float, float]]  # and from when to when its slope is taken


def _by_change(rows: Sequence[Row]) -> list[Line]:
    names = list(dict.fromkeys(row["change"] for row in rows))
    return [(name, *np.array([[row["t"], row["gap"]] for row in rows if row["change"] == name]).T) for name in names]


def _distance_lines(study: Study, found: Sequence[Setting], told: Sequence[Row]) -> list[Stretch]:
    """Median distance of pairs and the range of its slope, at the smallest size with a verdict in each setting."""
    lines: list[Stretch] = []
    for setting in found:
        row = next((row for row in told if row["setting"] == setting.label), None)
        for comparison in setting.comparisons if row is not None else ():
            if comparison.change.kind != START or row is None or comparison.change.size != row["size"]:
                continue
            some = [*_separations(study, comparison).values()]
            m = int(np.median([len(distance) for _, distance in some]))
            times = max((t for t, _ in some), key=len)[:m]
            middle = np.array([np.median([d[k] for _, d in some if len(d) > k]) for k in range(m)])
            label = f"{setting.label}: {shown(row['size'])}"
            lines.append((label, times, middle, (row["t_from"], row["t_to"])))
    return lines


@panel(3.4)
def parting_curves(ax: Axes, lines: Sequence[Line]) -> None:
    """Gap of n_stick between copy and base, over that between two matrices, against time."""
    colours = ("#08306b", "#2171b5", "#6baed6", "#f0a860", "#c4561a", "#8c2d04")
    for k, (name, t, gaps) in enumerate(lines):
        ax.plot(t, gaps, color=colours[k % len(colours)], linestyle="-" if k < len(colours) else ":", label=name)
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=0.9)
    ax.text(0.02, 1.03, "two matrices", color=GREY, fontsize=8, transform=ax.get_yaxis_transform())
    ax.axhline(parting.SHARE, linestyle=":", color=GREY, linewidth=0.9)
    ax.text(0.02, parting.SHARE + 0.03, "apart", color=GREY, fontsize=8, transform=ax.get_yaxis_transform())
    ax.set(xscale="log", ylim=(0, None), xlabel="time t", ylabel="gap (two matrices: 1)")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.figure.legend(loc="outside lower center", ncols=2)


@panel(3.4)
def distances(ax: Axes, lines: Sequence[Stretch]) -> None:
    """Median distance of displaced runs from their base, on a logarithmic axis; heavy where its slope is taken."""
    for k, (name, t, distance, (start, stop)) in enumerate(lines):
        colour, form = CYCLE[k % len(CYCLE)], ("-", "--", ":")[k // len(CYCLE) % 3]
        ax.plot(t, np.maximum(distance, FLOOR), form, color=colour, linewidth=0.8)
        some = (t >= start) & (t <= stop)
        ax.plot(t[some], distance[some], form, color=colour, linewidth=2.2, label=name)
    ax.axhspan(CEILING, 1e3, color=GREY, alpha=0.13, linewidth=0)
    ax.set(yscale="log", ylim=(FLOOR, 10.0), xlabel="time t", ylabel="distance, median of pairs")
    ax.figure.legend(loc="outside lower center", ncols=1, fontsize=7)


QUESTION = Question(answer, share=0.3)
