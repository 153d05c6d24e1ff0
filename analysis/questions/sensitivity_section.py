"""The report's section on short-term sensitivity: tables, statements and the picture of how runs part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stickslip.analysis.pairs import CONSTANTS, START, Setting, settings
from stickslip.analysis.questions.growth_rates import (
    ABOVE_ERROR,
    GROWTH_COLUMNS,
    RATE_COLUMNS,
    best,
    growth_rows,
    saturations,
)
from stickslip.analysis.questions.parting import (
    HORIZON_COLUMNS,
    PARTING_COLUMNS,
    WINDOW,
    distances,
    parting_rows,
    paths_of,
)
from stickslip.analysis.report import change_figures, words
from stickslip.analysis.report.section import Column, Data, Picture, Rows, Section, Table
from stickslip.analysis.report.tables import typed
from stickslip.analysis.stats.sensitivity import BLOCKS, CEILING, FLOOR

_PROPORTIONAL = 0.1  # amplifications apart by less than this (of their logarithm) count as equal


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
    scales = {} if scale is not None else saturations(data, some, outcome)
    for setting in some:
        paths = paths_of(data, setting, outcome, t_burn)
        at = scales.get(setting.key["n"]) if scale is None else scale
        own_growth, own_rates = growth_rows(data, setting, outcome, at, confidence)
        own_parting, own_horizons, differences = parting_rows(
            data, setting, outcome, paths, (t_burn, confidence, level, bands)
        )
        growths += own_growth
        rates += own_rates
        parting += own_parting
        horizons += own_horizons
        answers, less = _statements(setting, own_growth, own_parting, own_horizons, (t_burn, level, confidence))
        statements += answers
        notes += less
        panels.append((setting.label, distances(data, setting, outcome), differences, paths.late if paths else None))
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


def _pictures(panels: Sequence[change_figures.Panel], growths: Rows, rates: Rows) -> tuple[Picture, ...]:
    """How runs part, for the first setting of the largest n with changed constants; growth rates of the draws."""
    drawn = [change_figures.parting(_chosen(panels))] if panels else []
    read = [
        (row, [one for one in rates if (one["setting"], one["size"]) == (row["setting"], row["size"])])
        for row in best(growths)
    ]
    return (*drawn, change_figures.growth_rates(read)) if read else tuple(drawn)


def _chosen(panels: Sequence[change_figures.Panel]) -> list[change_figures.Panel]:
    """One setting a number of blocks, the one with most changes; of each family of changes the least and the most."""
    by_n: dict[str, change_figures.Panel] = {}
    for panel in panels:
        n = panel[0].split(", ")[0]
        if n not in by_n or len(panel[2]) > len(by_n[n][2]):
            by_n[n] = panel
    return [
        (label, _least_and_most(distances), _least_and_most(differences), level)
        for label, distances, differences, level in by_n.values()
    ]


def _least_and_most(lines: Sequence[change_figures.Line]) -> list[change_figures.Line]:
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
        f"{ABOVE_ERROR:g} tolerances are read, which stand out from its errors. n_stick is compared as the mean of "
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
            typed(GROWTH_COLUMNS, growths),
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
            typed(HORIZON_COLUMNS, horizons),
            (
                Column("setting", "setting"), Column("change", "change"), Column("pairs", "n_pairs"),
                Column("parted", "n_parted"), Column("level, blocks", "level"), Column("horizon", "statement"),
            ),
        ),
        Table(
            "parting",
            "Mean |difference of n_stick| in bands of time, beside that of two different matrices.",
            typed(PARTING_COLUMNS, parting),
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
            typed(RATE_COLUMNS, rates),
            (
                Column("setting", "setting"), Column("size", "size"), Column("matrix", "matrix"),
                Column("rate", "rate"), Column("interval", ("low", "high")), Column("verdict", "verdict"),
            ),
            max_rows=200,
        ),
    )  # fmt: skip
