"""Fates of runs and how long motion lasts: collapsed, silent, run away, or sustained to the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.pairs import Setting, settings
from stickslip.analysis.report import change_figures, words
from stickslip.analysis.report.section import Column, Data, Picture, Section, Table
from stickslip.analysis.report.tables import F, I, S, typed
from stickslip.analysis.stats.fates import (
    COLLAPSED,
    DIVERGED,
    ENDS,
    FAILED,
    QUIET_SHARE,
    SILENT,
    SUSTAINED,
    Curve,
    fate,
    median,
    survival,
)

TITLE = "Collapse and escape"


def fates(data: Data) -> dict[str, str]:
    """Fate by member_id."""
    table = data.members
    return {
        str(member): fate(str(outcome), data.series[str(member)] if outcome == "finished" else None, float(t_end))
        for member, outcome, t_end in zip(table["member_id"], table["outcome"], table["t_end"], strict=True)
    }


def end_of_motion(data: Data, member_id: str, how: str, t_stop: float, t_end: float) -> float:
    """When a run's motion of stick and slip ended: its last exit; for a runaway, when it left every bound."""
    if how == DIVERGED:
        return t_stop
    return float(data.series[member_id][0][-1]) if how in (COLLAPSED, SILENT) else t_end


_SCHEMA = {
    "setting": S, "n": I, "kappa": F, "kappa_n": F, "engine": S, "n_runs": I, "n_collapsed": I, "n_silent": I,
    "n_diverged": I, "n_sustained": I, "n_failed": I, "t_end": F, "sustained": F, "low": F, "high": F, "collapsed": F,
    "median": F, "first_end": F, "last_end": F, "growth_rate": F, "n_unstable": I, "n_rates": I, "reason": S,
}  # fmt: skip
_DRAWS = {"setting": S, "n": I, "kappa_n": F, "matrix": I, "growth_rate": F, "fate": S}
_CURVE = {"setting": S, "t": F, "survival": F, "low": F, "high": F, COLLAPSED: F, SILENT: F, DIVERGED: F}


def survival_section(data: Data, *, confidence: float) -> Section:
    """Fates of the unchanged runs, one a matrix, and how long self-sustained motion lasts over n and kappa n.

    Parameters
    ----------
    data : Data
        `members` and the `series` of those that did not fail; a column `growth_rate` of the members, the largest
        real part of the eigenvalues of the all-slip state, is set beside the fates.
    confidence : float
    """
    rows: list[dict[str, Any]] = []
    curve_rows: list[dict[str, Any]] = []
    draws: list[dict[str, Any]] = []
    panels = []
    for setting in settings(data.members):
        ids = list(setting.bases.values())
        table = data.members[data.members["member_id"].isin(ids)]
        row, curve = _setting_row(data, setting, table, confidence)
        rows.append(row)
        draws += _draw_rows(data, setting, table)
        if curve is not None:
            panels.append((setting.label, curve, float(row["t_end"])))
            curve_rows += [
                {
                    "setting": setting.label, "t": float(t), "survival": float(curve.survival[k]),
                    "low": float(curve.low[k]), "high": float(curve.high[k]),
                    **{end: float(curve.incidence[end][k]) for end in ENDS},
                }
                for k, t in enumerate(curve.t)
            ]  # fmt: skip
    return Section(
        title=TITLE,
        question="How long does stick-slip sustain itself, and how does it end?",
        statements=tuple(f"{text}." for text in _statements(rows, confidence)),
        lead=tuple(f"{text}." for text in _lead(rows, draws)),
        method=(
            "A run has collapsed when it is certified that no block sticks again; motion then ended at its last "
            "exit. "
            f"Runs in which no block sticks and nothing changes over the last {words.percent(QUIET_SHARE)} without "
            "that certificate are called silent and kept apart, and runaways are an end of their own. Survival is "
            "Kaplan "
            "and Meier's with Greenwood's log-log interval (Wilson's where none or all have ended); each end's share "
            "is Aalen and Johansen's cumulative incidence. One unchanged run a matrix."
        ),
        tables=_tables(rows, curve_rows, draws),
        pictures=_pictures(rows, draws, panels),
        assumptions=(
            "Runs in motion at t_end are censored there: nothing is said of later times, and motion may be "
            "metastable.",
            "Matrices are independent draws, so runs are independent.",
        ),
    )


def _setting_row(
    data: Data, setting: Setting, table: pd.DataFrame, confidence: float
) -> tuple[dict[str, Any], Curve | None]:
    found = fates(replace(data, members=table))
    how = list(found.values())
    n, kappa = setting.key["n"], setting.key["kappa"]
    row: dict[str, Any] = {
        "setting": setting.label, "n": n, "kappa": kappa, "kappa_n": n * kappa, "engine": setting.key["engine"],
        **{f"n_{name}": how.count(name) for name in (*ENDS, SUSTAINED, FAILED)}, "t_end": float(setting.key["t_end"]),
        "n_runs": len(how) - how.count(FAILED), "reason": None,
    }  # fmt: skip
    row |= _growth(table)
    watched = table[[found[str(member)] != FAILED for member in table["member_id"]]]
    if watched.empty:
        return row | {"reason": "every run failed"}, None
    ids = [str(member) for member in watched["member_id"]]
    ends = [found[member] for member in ids]
    stops, t_ends = (watched[name].astype(float).tolist() for name in ("t_stop", "t_end"))
    times = np.array([end_of_motion(data, *of_run) for of_run in zip(ids, ends, stops, t_ends, strict=True)])
    curve = survival(times, ends, confidence)
    ended = curve.t[1:]
    row |= {
        "sustained": float(curve.survival[-1]), "low": float(curve.low[-1]), "high": float(curve.high[-1]),
        "collapsed": float(curve.incidence[COLLAPSED][-1]), "median": median(curve),
        "first_end": float(ended[0]) if len(ended) else None, "last_end": float(ended[-1]) if len(ended) else None,
    }  # fmt: skip
    return row, curve


def _draw_rows(data: Data, setting: Setting, table: pd.DataFrame) -> list[dict[str, Any]]:
    """Fate and linear growth rate of each run; none without the rates."""
    if "growth_rate" not in table:
        return []
    found = fates(replace(data, members=table))
    of_setting = {"setting": setting.label, "n": setting.key["n"], "kappa_n": setting.key["n"] * setting.key["kappa"]}
    return [
        {**of_setting, "matrix": int(matrix), "growth_rate": float(rate), "fate": found[str(member)]}
        for member, matrix, rate in zip(table["member_id"], table["matrix"], table["growth_rate"], strict=True)
        if not pd.isna(rate)
    ]


def _growth(table: pd.DataFrame) -> dict[str, Any]:
    if "growth_rate" not in table or table["growth_rate"].isna().all():
        return {"growth_rate": None, "n_unstable": None, "n_rates": None}
    rates = table["growth_rate"].dropna().astype(float)
    return {"growth_rate": float(rates.mean()), "n_unstable": int((rates > 0).sum()), "n_rates": len(rates)}


def _lead(rows: Sequence[dict[str, Any]], draws: Sequence[dict[str, Any]]) -> list[str]:
    """The fates of all settings in one sentence, settings of one fate together; then what linear theory says."""
    known = [row for row in rows if not row["reason"]]
    if not known:
        return []
    total = sum(row["n_runs"] for row in known)
    t_ends = " or ".join(f"{t:g}" for t in sorted({row["t_end"] for row in known}))
    if sum(row[f"n_{SUSTAINED}"] for row in known) == total:
        of_all = "the one run" if total == 1 else f"all {total} runs"
        return [f"To t = {t_ends} {of_all} stayed in motion; nothing is said of later times", *_linear(draws)]
    alike: dict[str, list[str]] = {}
    for row in known:
        names = {**_SHORT, SUSTAINED: "stayed in motion"}
        ends = [(row[f"n_{end}"], name) for end, name in names.items() if row[f"n_{end}"]]
        said = ", ".join(f"{'all' if k == row['n_runs'] else k} {name}" for k, name in ends)
        alike.setdefault(f"{said} (of {row['n_runs']} each)" if len(ends) > 1 else said, []).append(row["setting"])
    parts = [f"{_listed(settings)}: {said.replace(' each)', ')') if len(settings) == 1 else said}"
             for said, settings in alike.items()]  # fmt: skip
    return [f"To t = {t_ends}, {'; '.join(parts)}; nothing is said of later times", *_linear(draws)]


def _listed(settings: Sequence[str]) -> str:
    """Settings of one engine as numbers of blocks, else as they are called."""
    heads = [setting.partition(", ") for setting in settings]
    if len(settings) > 1 and len({rest for *_, rest in heads}) == 1:
        numbers = [head.removeprefix("n = ") for head, *_ in heads]
        return f"n = {', '.join(numbers[:-1])} and {numbers[-1]}, {heads[0][2]}"
    return " and ".join(settings)


def _linear(draws: Sequence[dict[str, Any]]) -> list[str]:
    """Fates by the sign of the linear growth rate of the all-slip state."""
    parts = []
    for name, some in (
        ("stable", [draw for draw in draws if draw["growth_rate"] <= 0]),
        ("unstable", [draw for draw in draws if draw["growth_rate"] > 0]),
    ):
        if some:
            how = [draw["fate"] for draw in some]
            ends = ", ".join(
                f"{how.count(end)} {name}"
                for end, name in {**_SHORT, SUSTAINED: "stayed in motion", FAILED: "failed"}.items()
                if how.count(end)
            )
            parts.append(f"of the {words.count(len(some), 'draw')} in which it is {name}, {ends}")
    return [f"The linear growth of the state in which all blocks slip goes with the fate: {'; '.join(parts)}"
            if len(parts) > 1 else f"The state in which all blocks slip: {parts[0]}"] if parts else []  # fmt: skip


def _statements(rows: Sequence[dict[str, Any]], confidence: float) -> list[str]:
    found = []
    for row in rows:
        if row["reason"]:
            found.append(f"{row['setting']}: not enough data: {row['reason']}")
            continue
        ends = [f"{row[f'n_{end}']} {_NAMES[end]}" for end in ENDS if row[f"n_{end}"]]
        text = f"{row['setting']}: of {words.count(row['n_runs'], 'run')} to t = {row['t_end']:g}"
        if ends:
            text += f", {', '.join(ends)} (motion ended at t = {words.number(row['first_end'])} to "
            text += f"{words.number(row['last_end'])}), {row['n_sustained']} stayed in motion"
        else:
            text += " all stayed in motion"
        text += f": self-sustained {words.percent(row['sustained'])} ({words.percent(row['low'])} to "
        text += f"{words.percent(row['high'])}, {words.percent(confidence)} interval)"
        if row["median"] is not None:
            text += f"; half had ended by t = {words.number(row['median'])}"
        if row["n_rates"]:
            text += f"; the all-slip state is linearly unstable in {row['n_unstable']} of {row['n_rates']}"
        found.append(text)
    return found


_SHORT = {
    COLLAPSED: "stopped sticking for good (certified)",
    SILENT: "went silent without a certificate",
    DIVERGED: "ran away",
}
_NAMES = {COLLAPSED: "collapsed (certified)", SILENT: "went silent without a certificate", DIVERGED: "ran away"}


def _pictures(
    rows: Sequence[dict[str, Any]], draws: Sequence[dict[str, Any]], panels: Sequence[tuple[str, Curve, float]]
) -> tuple[Picture, ...]:
    if not panels:
        return ()
    curves = change_figures.survival_curves(panels)
    known = [row for row in rows if not row["reason"]]
    return (change_figures.fates(known, draws), curves) if draws else (curves,)


def _tables(
    rows: Sequence[dict[str, Any]], curves: Sequence[dict[str, Any]], draws: Sequence[dict[str, Any]]
) -> tuple[Table, ...]:
    return (
        Table(
            "survival",
            "Fates of unchanged runs, one a matrix; sustained is the share in motion at t_end. kappa n: the scale of "
            "the stiffnesses times the number of blocks.",
            typed(_SCHEMA, rows),
            (
                Column("setting", "setting"), Column("kappa n", "kappa_n"), Column("runs", "n_runs"),
                Column("collapsed", "n_collapsed"), Column("silent", "n_silent"), Column("run away", "n_diverged"),
                Column("sustained", "n_sustained"), Column("share", "sustained", show=words.percent),
                Column("low", "low", show=words.percent), Column("high", "high", show=words.percent),
                Column("half ended by", "median"), Column("all-slip growth rate", "growth_rate"),
            ),
        ),
        Table("survival_curves", "Survival and cumulative incidence over time.", typed(_CURVE, curves)),
        Table("fates", "Fate of each draw, and linear growth rate of its all-slip state.", typed(_DRAWS, draws)),
    )  # fmt: skip
