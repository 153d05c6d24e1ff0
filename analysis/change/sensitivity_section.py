"""The report's section on short-term sensitivity: tables, statements and the picture of how runs part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from analysis import words
from analysis.change import figures as twin_figures
from analysis.change.pairs import CONSTANTS, START, Comparison, Setting, settings
from analysis.change.sensitivity import (
    BLOCKS,
    CEILING,
    FLOOR,
    Growth,
    amplification_gap,
    growth,
    horizon,
    mean_difference,
    median_interval,
    redraw_difference,
    saturation,
)
from analysis.fits import over_matrices, ratio
from analysis.section import Column, Data, Picture, Section, Separation, Table
from analysis.tables import F, I, S, typed

Rows = list[dict[str, Any]]
WINDOW = 1.0  # width of the windows in which n_stick is compared
_DRAWN = 120  # points of a curve
_PROPORTIONAL = 0.1  # amplifications apart by less than this (of their logarithm) count as equal

_GROWTH = {
    "setting": S, "n": I, "engine": S, "eps": F, "size": F, "n_pairs": I, "n_runaway": I, "n_fitted": I, "rate": F,
    "low": F, "high": F, "between_matrices": F, "slowest": F, "fastest": F, "e_fold": F, "e_fold_low": F,
    "e_fold_high": F, "t_first": F, "t_last": F, "late_minus_early": F, "late_low": F, "late_high": F,
    "amplification_gap": F, "ceiling": F, "is_above_error": "boolean", "n_growing": I, "n_shrinking": I, "n_open": I,
    "runaways": S, "reason": S,
}  # fmt: skip
_RATES = {
    "setting": S, "n": I, "engine": S, "eps": F, "size": F, "matrix": I, "rate": F, "low": F, "high": F, "verdict": S,
}  # fmt: skip
GROWS, SHRINKS, OPEN, RUNAWAY = "grows", "shrinks", "within its error", "run away"  # of one draw
_ABOVE_ERROR = 10.0  # a displacement of so many tolerances of the sigmoid engine stands out from its errors
_PARTING = {
    "setting": S, "kind": S, "reading": S, "size": F, "change": S, "t_from": F, "t_to": F, "n_matrices": I,
    "difference": F, "low": F, "high": F, "redraw": F, "of_redraw": F, "of_late": F,
}  # fmt: skip
_HORIZON = {
    "setting": S, "kind": S, "reading": S, "size": F, "change": S, "n_pairs": I, "n_runaway": I, "n_matrices": I,
    "n_parted": I, "level": F, "median": F, "low": F, "high": F, "statement": S,
}  # fmt: skip


@dataclass(frozen=True)
class _Paths:
    """What a setting's series give: the level of parting, and how two different matrices differ in each window."""

    edges: np.ndarray
    redraw: np.ndarray  # (windows,)
    late: float


def sensitivity_section(
    data: Data,
    *,
    t_burn: float,
    confidence: float,
    level: float = 0.5,
    bands: tuple[float, ...] = (0.0, 20.0, 100.0),
    scale: float | None = None,
) -> Section | None:
    """Short-term sensitivity: how fast changed runs part from their base; None without changed members.

    Parameters
    ----------
    data : Data
        `members`, `series`, and `separations` if recorded (growth rates need them).
    t_burn : float
        From here to t_end two different matrices give the late difference of n_stick.
    confidence : float
    level : float
        A changed run has parted once n_stick differs, in the mean of a unit window, by more than this share of the
        late difference of two different matrices.
    bands : tuple of float
        Starts of the bands of time in which differences are tabulated, ascending; one from t_burn is added.
    scale : float, optional
        At which distances of states saturate; estimated from the largest ones where left out.
    """
    some = [setting for setting in settings(data.members) if setting.comparisons]
    if not some:
        return None
    outcome = dict(zip(data.members["member_id"], data.members["outcome"].astype(str), strict=True))
    growths: Rows = []
    rates: Rows = []
    parting: Rows = []
    horizons: Rows = []
    statements: list[str] = []
    notes: list[str] = []
    panels = []
    scales = {} if scale is not None else _scales(data, some, outcome)
    for setting in some:
        paths = _paths(data, setting, outcome, t_burn)
        at = scales.get(setting.key["n"]) if scale is None else scale
        own_growth, own_rates = _growth_rows(data, setting, outcome, at, confidence)
        own_parting, own_horizons, differences = _parting_rows(
            data, setting, outcome, paths, (t_burn, confidence, level, bands)
        )
        growths += own_growth
        rates += own_rates
        parting += own_parting
        horizons += own_horizons
        answers, less = _statements(setting, own_growth, own_parting, own_horizons, (t_burn, level, confidence))
        statements += answers
        notes += less
        panels.append((setting.label, _distances(data, setting, outcome), differences, paths.late if paths else None))
    across = _across(growths)
    statements = across + statements + notes
    largest = max(some, key=lambda setting: setting.key["n"])  # and of these the first engine
    lead = across + [text for text in statements if text.startswith(f"{largest.label}, ")][:1] or statements[:1]
    return Section(
        title="Short-term sensitivity",
        question="How fast do runs with a changed start, changed constants or stiffness ratios leave their base?",
        statements=tuple(f"{text}." for text in statements),
        lead=tuple(f"{text}." for text in lead),
        method=_method(t_burn, level, confidence),
        tables=_tables(growths, rates, parting, horizons),
        pictures=_pictures(panels, growths, rates),
        of_changes=True,
        assumptions=_assumptions(growths),
    )


def _is_kept(outcome: Mapping[str, str], *member_ids: str) -> bool:
    """Whether all of these runs can be compared to the end: a runaway is kept apart, a failed run has no series."""
    return all(outcome[member] not in ("diverged", "failed") for member in member_ids)


def _paths(data: Data, setting: Setting, outcome: Mapping[str, str], t_burn: float) -> _Paths | None:
    bases = [data.series[base] for base in setting.bases.values() if _is_kept(outcome, base)]
    if len(bases) < 2:
        return None
    edges = np.arange(0.0, float(setting.key["t_end"]) + 0.5 * WINDOW, WINDOW)
    redraw = redraw_difference(bases, edges[:-1] + 0.5 * WINDOW)
    late = redraw[edges[:-1] >= t_burn]
    return _Paths(edges, redraw, float(late.mean()) if len(late) else 0.0)


def _growth_rows(
    data: Data, setting: Setting, outcome: Mapping[str, str], scale: float | None, confidence: float
) -> tuple[Rows, Rows]:
    """Growth rates of displaced starts, and by matrix; the amplification against that of the size to be read."""
    kept = _kept(data, setting, outcome)
    twins = [comparison for comparison in setting.comparisons if comparison.change.kind == START]
    if not twins or not kept or scale is None:
        return [], []
    rtol = setting.key["rtol"]
    above = [one for one in twins if rtol is None or one.change.size >= _ABOVE_ERROR * rtol]
    reference = (above or twins)[0]
    ceiling = CEILING * scale
    rows, rates = [], []
    t_half = float(stats.t.ppf(0.5 + confidence / 2, BLOCKS - 1))
    identity = {"setting": setting.label, **{name: setting.key[name] for name in ("n", "engine", "eps")}}
    for comparison in twins:
        found = growth(comparison, kept, ceiling, confidence)
        size = comparison.change.size
        away = [pair.matrix for pair in comparison.pairs if not _is_kept(outcome, pair.base, pair.changed)]
        draws: Rows = [
            {
                **identity, "size": size, "matrix": matrix, "rate": rate, "low": rate - t_half * found.errors[matrix],
                "high": rate + t_half * found.errors[matrix],
            }
            for matrix, rate in found.rates.items()
        ]  # fmt: skip
        for draw in draws:
            draw["verdict"] = GROWS if draw["low"] > 0 else SHRINKS if draw["high"] < 0 else OPEN
        verdicts = [draw["verdict"] for draw in draws]
        rows.append(
            {
                **identity, "size": size, "n_pairs": len(comparison.pairs), "n_runaway": len(away),
                "runaways": ", ".join(str(matrix) for matrix in away) or None, "ceiling": ceiling,
                "is_above_error": comparison in above,
                "amplification_gap": _gap(reference, comparison, kept, ceiling), **_rate_columns(found),
                "n_growing": verdicts.count(GROWS), "n_shrinking": verdicts.count(SHRINKS),
                "n_open": verdicts.count(OPEN),
            }
        )  # fmt: skip
        rates += draws
        rates += [{**identity, "size": size, "matrix": matrix, "rate": None, "verdict": RUNAWAY} for matrix in away]
    return rows, rates


def _kept(data: Data, setting: Setting, outcome: Mapping[str, str]) -> dict[str, Separation]:
    """Separations by changed member, runaways left out."""
    found = {
        pair.changed: data.separations[pair.changed]
        for comparison in setting.comparisons
        for pair in comparison.pairs
        if _is_kept(outcome, pair.base, pair.changed) and pair.changed in data.separations
    }
    return {member: one for member, one in found.items() if len(one[1])}


def _scales(data: Data, some: Sequence[Setting], outcome: Mapping[str, str]) -> dict[int, float]:
    """By n, the largest over its settings: where growth is slow, no pair of a setting may live to saturate."""
    scales: dict[int, float] = {}
    for setting in some:
        kept = {member: distance for member, (_, distance) in _kept(data, setting, outcome).items()}
        if kept:
            n = int(setting.key["n"])
            scales[n] = max(scales.get(n, 0.0), _scale(setting, kept))
    return scales


def _scale(setting: Setting, distances: Mapping[str, np.ndarray]) -> float:
    """The largest, over the changes, of the distance at which pairs saturate."""
    by_change = [
        [distances[pair.changed] for pair in comparison.pairs if pair.changed in distances]
        for comparison in setting.comparisons
    ]
    return max(saturation(some) for some in by_change if some)


def _gap(first: Comparison, second: Comparison, kept: Mapping[str, Any], ceiling: float) -> float | None:
    if first is second:
        return None
    of_first = {pair.matrix: pair.changed for pair in first.pairs}
    gaps = [
        amplification_gap(kept[of_first[pair.matrix]], kept[pair.changed], ceiling)
        for pair in second.pairs
        if pair.changed in kept and of_first.get(pair.matrix) in kept
    ]
    known = [gap for gap in gaps if gap is not None]
    return max(known) if known else None


def _rate_columns(found: Growth) -> dict[str, Any]:
    rate, values = found.rate, list(found.rates.values())
    row: dict[str, Any] = {
        "n_fitted": len(values), "rate": rate.value, "low": rate.low, "high": rate.high,
        "between_matrices": float(np.std(values, ddof=1)) if len(values) > 1 else None,
        "slowest": min(values, default=None), "fastest": max(values, default=None), "t_first": found.t_first,
        "t_last": found.t_last, "late_minus_early": found.change.value, "late_low": found.change.low,
        "late_high": found.change.high, "reason": rate.reason or None,
    }  # fmt: skip
    if rate.value is not None and rate.value > 0:
        row["e_fold"] = 1 / rate.value
        if rate.low is not None and rate.high is not None and rate.low > 0:
            row["e_fold_low"], row["e_fold_high"] = 1 / rate.high, 1 / rate.low
    return row


def _parting_rows(
    data: Data,
    setting: Setting,
    outcome: Mapping[str, str],
    paths: _Paths | None,
    declared: tuple[float, float, float, tuple[float, ...]],
) -> tuple[Rows, Rows, list[twin_figures.Line]]:
    """Differences of n_stick by band of time, horizons, and curves."""
    t_burn, confidence, level, bands = declared
    t_end = float(setting.key["t_end"])
    edges = paths.edges if paths else np.arange(0.0, t_end + 0.5 * WINDOW, WINDOW)
    starts = [start for start in bands if start < t_burn] + [t_burn]
    parting: Rows = []
    horizons: Rows = []
    curves = []
    for comparison in setting.comparisons:
        change = comparison.change
        identity = {
            "setting": setting.label, "kind": change.kind, "reading": change.reading, "size": change.size or None,
            "change": str(change),
        }  # fmt: skip
        by_matrix: dict[int, list[np.ndarray]] = {}
        for pair in comparison.pairs:
            if _is_kept(outcome, pair.base, pair.changed):
                first, second = data.series[pair.base], data.series[pair.changed]
                by_matrix.setdefault(pair.matrix, []).append(mean_difference(first, second, edges))
        horizons.append(identity | _horizon_row(comparison, by_matrix, paths, edges, (level, confidence)))
        if not by_matrix:
            continue
        gaps = np.array([np.mean(some, axis=0) for some in by_matrix.values()])
        for t_from, t_to in zip(starts, [*starts[1:], t_end], strict=True):
            inside = (edges[:-1] >= t_from) & (edges[:-1] < t_to)
            if inside.any():
                parting.append(identity | _band_row(gaps, inside, paths, (t_from, t_to), confidence))
        step = -(-gaps.shape[1] // _DRAWN)
        whole = gaps.shape[1] // step * step
        coarse = gaps.mean(axis=0)[:whole].reshape(-1, step).mean(axis=1)
        curves.append((_family(comparison), str(change), edges[:whole:step] + 0.5 * step * WINDOW, coarse))
    return parting, horizons, curves


def _band_row(
    gaps: np.ndarray, inside: np.ndarray, paths: _Paths | None, band: tuple[float, float], confidence: float
) -> dict[str, Any]:
    mean = gaps[:, inside].mean(axis=1)
    found = over_matrices(ratio, np.column_stack([mean, np.ones_like(mean)]), confidence)
    redraw = float(paths.redraw[inside].mean()) if paths else None
    assert found.value is not None
    return {
        "t_from": band[0], "t_to": band[1], "n_matrices": len(gaps), "difference": found.value, "low": found.low,
        "high": found.high, "redraw": redraw, "of_redraw": found.value / redraw if redraw else None,
        "of_late": found.value / paths.late if paths and paths.late else None,
    }  # fmt: skip


def _horizon_row(
    comparison: Comparison,
    by_matrix: Mapping[int, Sequence[np.ndarray]],
    paths: _Paths | None,
    edges: np.ndarray,
    declared: tuple[float, float],
) -> dict[str, Any]:
    """Median over matrices (of each, over its draws) of the horizon; what is beyond the run is null."""
    level, confidence = declared
    kept = sum(len(some) for some in by_matrix.values())
    row: dict[str, Any] = {
        "n_pairs": len(comparison.pairs), "n_runaway": len(comparison.pairs) - kept, "n_matrices": len(by_matrix),
    }  # fmt: skip
    if paths is None or not paths.late or not by_matrix:
        why = (
            "fewer than two matrices have a run to compare" if paths is None
            else "late in the run two different matrices do not differ" if not paths.late
            else "no pair reaches its end without running away"
        )  # fmt: skip
        return row | {"statement": f"not enough data: {why}"}
    bar = level * paths.late
    times = [[horizon(gap, edges, bar) for gap in some] for some in by_matrix.values()]
    middle, low, high = median_interval([float(np.median(some)) for some in times], confidence)
    row |= {
        "n_parted": sum(bool(np.isfinite(t)) for some in times for t in some), "level": bar,
        **{
            name: value if value is not None and np.isfinite(value) else None
            for name, value in (("median", middle), ("low", low), ("high", high))
        },
    }  # fmt: skip
    end = f"{edges[-1]:g}"
    if not np.isfinite(middle):
        return row | {"statement": f"n_stick can be foretold to the end, t = {end}, in the median of matrices"}
    if low is None or high is None:
        return row | {"statement": f"parted at t = {middle:.0f} in the median; too few matrices for an interval"}
    upto = f"{high:.0f}" if np.isfinite(high) else f"beyond {end}"
    return row | {"statement": f"parted at t = {middle:.0f} ({low:.0f} to {upto}) in the median of matrices"}


def _distances(data: Data, setting: Setting, outcome: Mapping[str, str]) -> list[twin_figures.Line]:
    """Median distance over the pairs that are still watched, where at least half of them are."""
    lines = []
    for comparison in setting.comparisons:
        some = [
            data.separations[pair.changed]
            for pair in comparison.pairs
            if _is_kept(outcome, pair.base, pair.changed) and pair.changed in data.separations
        ]
        some = [one for one in some if len(one[0])]
        if not some:
            continue
        longest = sorted(some, key=lambda one: len(one[0]))[len(some) // 2]
        m = len(longest[0])
        stack = np.full((len(some), m), np.nan)
        for k, (_, distance) in enumerate(some):
            stack[k, : min(m, len(distance))] = distance[:m]
        middle = np.nanmedian(stack, axis=0)
        pick = np.unique(np.linspace(0, m - 1, _DRAWN).astype(int))
        pick = pick[middle[pick] > 0]
        lines.append((_family(comparison), str(comparison.change), longest[0][pick], middle[pick]))
    return lines


def _family(comparison: Comparison) -> str:
    return f"{comparison.change.kind} {comparison.change.reading}"


def _across(rows: Rows) -> list[str]:
    """Growth rate against n and engine, one sentence; nothing with a single setting that has a rate."""
    read = best(rows)
    if len(read) < 2:
        return []
    parts = [
        f"{row['setting']}: {words.number(row['rate'], 2)}{_within(row)}, {row['n_growing']} of {row['n_fitted']} "
        "draws growing beyond their own error"
        for row in read
    ]
    return ["Growth rate of small displacements, per unit time: " + "; ".join(parts)]


def best(rows: Rows) -> Rows:
    """Of each setting the row to be read: the smallest displacement above the errors has the longest linear range."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["rate"] is not None and row["is_above_error"]:
            found.setdefault(row["setting"], row)
    return list(found.values())


def _within(row: Mapping[str, Any]) -> str:
    return "" if row["low"] is None else f" ({words.interval(row['low'], row['high'])})"


def _statements(
    setting: Setting, growths: Rows, parting: Rows, horizons: Rows, declared: tuple[float, float, float]
) -> tuple[list[str], list[str]]:
    """Answers to the question, then what a reader of them should know."""
    t_burn, level, confidence = declared
    answers: list[str] = []
    notes: list[str] = []
    order = _order(setting, parting, horizons, t_burn, level)
    if order:
        answers.append(order)
    above = [row for row in growths if row["is_above_error"]]
    fitted = best(growths)
    if fitted:
        answers.append(f"{setting.label}: {_rate_words(fitted[0], confidence)}")
        notes += _cause(setting, [row for row in above if row["rate"] is not None])
    elif growths:
        why = above[0]["reason"] if above else "no displacement is well above the tolerance"
        notes.append(f"{setting.label}: no growth rate of displaced starts: {why}")
    n_runaway = sum(row["n_runaway"] for row in horizons)
    if n_runaway:
        pairs = words.count(n_runaway, "pair")
        notes.append(f"{setting.label}: {pairs} in which a run ran away or failed are kept apart from all of this")
    return answers, notes


def _rate_words(row: Mapping[str, Any], confidence: float) -> str:
    text = f"a start displaced by {row['size']:g} moves away at a rate of {words.number(row['rate'], 2)}"
    if row["low"] is None:
        return f"{text} per unit time ({row['reason']})"
    text += f" per unit time ({words.interval(row['low'], row['high'])}, {words.percent(confidence)} interval over "
    text += f"{words.count(row['n_fitted'], 'matrix')}; single ones {words.interval(row['slowest'], row['fastest'])})"
    text += _draw_words(row)
    if row["low"] > 0:
        low, high = row["e_fold_low"], row["e_fold_high"]
        return f"{text}: an e-fold takes {words.number(row['e_fold'], 2)} units ({words.interval(low, high)})"
    return f"{text}: growth is not shown" if row["high"] > 0 else f"{text}: displacements shrink"


def _draw_words(row: Mapping[str, Any]) -> str:
    """What single draws show beyond their own error."""
    parts = [f"{row[f'n_{name}']} {what}" for name, what in _DRAWS.items() if row[f"n_{name}"]]
    away = f"; {row['n_runaway']} ran away and are not among them" if row["n_runaway"] else ""
    return f", of the draws {', '.join(parts)}{away}"


_DRAWS = {"growing": "grow beyond their own error", "shrinking": "shrink", "open": "do neither"}


def _cause(setting: Setting, rows: Rows) -> list[str]:
    """Whether the separation is proportional to the displacement, as integration error would not be."""
    known = [row for row in rows if row["amplification_gap"] is not None]
    if not known:
        return []
    worst = max(known, key=lambda row: row["amplification_gap"])
    gap, sizes = worst["amplification_gap"], [rows[0]["size"], *(row["size"] for row in known)]
    span = f"displacements from {min(sizes):g} to {max(sizes):g}"
    if gap < _PROPORTIONAL:
        return [
            f"{setting.label}: {span} are amplified alike, to {words.percent(np.expm1(gap))} at any time of the "
            "linear "
            "range and in every matrix: the distance is proportional to the displacement, so integration error is "
            "not its cause"
        ]
    return [
        f"{setting.label}: {span} are not amplified alike (by up to a factor {words.number(float(np.exp(gap)), 2)}): "
        "integration error in the smallest, or non-linear growth in the largest, is not excluded"
    ]


def _order(setting: Setting, parting: Rows, horizons: Rows, t_burn: float, level: float) -> str | None:
    """The paper's order, sensitive at first and robust later, set against the paths of the smallest change."""
    some = [row for row in parting if row["kind"] != START and row["of_late"] is not None]
    if not some:
        return None
    kind = CONSTANTS if any(row["kind"] == CONSTANTS for row in some) else some[0]["kind"]
    change = next(row["change"] for row in some if row["kind"] == kind)
    rows = [row for row in some if row["change"] == change]
    first, last = rows[0], rows[-1]
    parted = next(row for row in horizons if row["change"] == change)
    text = (
        f"{setting.label}, {change}: up to t = {first['t_to']:g} n_stick differs from the base by "
        f"{words.number(first['difference'], 2)} blocks, {words.percent(first['of_late'])} of what two different "
        f"matrices show after t = {t_burn:g}, and after that time by {words.number(last['difference'], 2)}, "
        f"{words.percent(last['of_late'])} of it; {parted['statement']}"
    )
    bar = parted["level"]
    if first["low"] is None or last["low"] is None:
        return f"{text}; one matrix does not tell in which order"
    if first["high"] < bar < last["low"]:
        return (
            f'{text}: single runs agree at short times and part at long ones, the reverse of "sensitive in the short '
            'term, robust in the long" as far as paths go; whether statistics stay is a question of its own'
        )
    if last["high"] < bar < first["low"]:
        return f"{text}: paths differ at short times and agree at long ones"
    return f"{text}: paths show no clear order of agreement and parting at the level of {words.percent(level)}"


def _pictures(panels: Sequence[twin_figures.Panel], growths: Rows, rates: Rows) -> tuple[Picture, ...]:
    """How runs part, for the first setting of the largest n with changed constants; growth rates of the draws."""
    drawn = [twin_figures.parting(_chosen(panels))] if panels else []
    read = [
        (row, [one for one in rates if (one["setting"], one["size"]) == (row["setting"], row["size"])])
        for row in best(growths)
    ]
    return (*drawn, twin_figures.growth_rates(read)) if read else tuple(drawn)


def _chosen(panels: Sequence[twin_figures.Panel]) -> list[twin_figures.Panel]:
    """One setting a number of blocks, the one with most changes; of each family of changes the least and the most."""
    by_n: dict[str, twin_figures.Panel] = {}
    for panel in panels:
        n = panel[0].split(", ")[0]
        if n not in by_n or len(panel[2]) > len(by_n[n][2]):
            by_n[n] = panel
    return [
        (label, _least_and_most(distances), _least_and_most(differences), level)
        for label, distances, differences, level in by_n.values()
    ]


def _least_and_most(lines: Sequence[twin_figures.Line]) -> list[twin_figures.Line]:
    families = dict.fromkeys(line[0] for line in lines)
    found = []
    for family in families:
        some = [line for line in lines if line[0] == family]
        found += [some[0], some[-1]] if len(some) > 1 else some
    return found


def _method(t_burn: float, level: float, confidence: float) -> str:
    return (
        "A changed run is set against the base of the same matrix. Growth rate: least-squares slope of the logarithm "
        "of the distance sqrt(mean over blocks of dz^2 + dw^2), from where a displaced start has grown "
        f"{FLOOR:g} times up to {words.percent(CEILING)} of the distance at which runs saturate; one mean slope a "
        f"matrix, {words.percent(confidence)} jackknife interval over matrices. A draw's own error comes from the "
        f"growth rates of {BLOCKS} consecutive blocks of its range. Under the sigmoid only displacements of at least "
        f"{_ABOVE_ERROR:g} tolerances are read, which stand out from its errors. n_stick is compared as the mean of "
        "|difference| "
        f"over windows of {WINDOW:g}; a pair has parted when that first exceeds {words.percent(level)} of what two "
        f"different matrices show after t = {t_burn:g}. Medians have intervals by order statistics over matrices; "
        "several draws of one matrix count as one."
    )


def _assumptions(growths: Rows) -> tuple[str, ...]:
    known = [row for row in growths if row["late_low"] is not None]
    if not known:
        return ("Different matrices look alike early on because they share their start; see the column of a redraw.",)
    bent = [row for row in known if not row["late_low"] <= 0 <= row["late_high"]]
    text = (
        "Growth is exponential in the linear range: no difference between its later and its earlier half is shown in "
    )
    text += f"{len(known) - len(bent)} of {len(known)} rows"
    if bent:
        one = max(bent, key=lambda row: abs(row["late_minus_early"]))
        text += (
            f"; the largest bend is {words.signed(one['late_minus_early'])} ({one['setting']}, size "
            f"{one['size']:g}), so "
            "the rate is a mean over its range of time"
        )
    return (
        f"{text}.",
        "Different matrices look alike early on because they share their start; see the column of a redraw.",
    )


def _tables(growths: Rows, rates: Rows, parting: Rows, horizons: Rows) -> tuple[Table, ...]:
    percent = words.percent
    return (
        Table(
            "growth",
            "Growth rate of displaced starts; draws that grow, shrink, or do neither beyond their own error. Gap: "
            "how far the amplification departs from that of the smallest size above the errors of integration.",
            typed(_GROWTH, growths),
            (
                Column("setting", "setting"), Column("size", "size", show=lambda size: f"{size:g}"),
                Column("pairs", "n_pairs"),
                Column("run away", "runaways"), Column("fitted", "n_fitted"), Column("rate", "rate"),
                Column("interval", ("low", "high")), Column("grow", "n_growing"), Column("shrink", "n_shrinking"),
                Column("neither", "n_open"), Column("between matrices", "between_matrices", 2),
                Column("e-fold time", "e_fold"), Column("later minus earlier half", "late_minus_early", 2),
                Column("gap", "amplification_gap", 2), Column("reason", "reason"),
            ),
        ),
        Table(
            "horizons",
            "Until when n_stick of the base foretells that of the changed run.",
            typed(_HORIZON, horizons),
            (
                Column("setting", "setting"), Column("change", "change"), Column("pairs", "n_pairs"),
                Column("parted", "n_parted"), Column("level, blocks", "level"), Column("horizon", "statement"),
            ),
        ),
        Table(
            "parting",
            "Mean |difference of n_stick| in bands of time, beside that of two different matrices.",
            typed(_PARTING, parting),
            (
                Column("setting", "setting"), Column("change", "change"),
                Column("from", "t_from"), Column("to", "t_to"),
                Column("difference", "difference"), Column("interval", ("low", "high")),
                Column("two matrices", "redraw"), Column("share of that", "of_redraw", show=percent),
                Column("share of late", "of_late", show=percent),
            ),
        ),
        Table(
            "growth_rates",
            "Growth rate by draw of the matrix, with the interval of its own error.",
            typed(_RATES, rates),
            (
                Column("setting", "setting"), Column("size", "size"), Column("matrix", "matrix"),
                Column("rate", "rate"), Column("interval", ("low", "high")), Column("verdict", "verdict"),
            ),
            max_rows=200,
        ),
    )  # fmt: skip
