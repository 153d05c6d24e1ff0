"""The map gamma(dt, c): every definition of a cascade over a grid of steps and thresholds, and what chance gives.

Always from the recorded series: those of the members, and n_stick under further thresholds |w - v| < c r_i eps
where the scene records them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.groups import Group, generator, windows
from stickslip.analysis.report import chance_figures, words
from stickslip.analysis.report.section import Column, Data, Picture, Row, Section, Table
from stickslip.analysis.report.tables import F, I, S, records, typed
from stickslip.analysis.stats.cascades import SAMPLED, Law, Window, cluster_sizes, laws, sizes_of_path
from stickslip.analysis.stats.estimates import Estimate, Undefined, gamma, gamma_difference, over_matrices
from stickslip.analysis.stats.nulls import (
    NullTally,
    block_steps,
    draws_each,
    independent_sums,
    random_order,
    rotations,
)

SCHEMA: Mapping[str, Any] = {
    "group": S, "n": I, "engine": S, "definition": S, "dt": F, "tau": F, "threshold": F, "n_cascades": I,
    "n_matrices": I, "mean_size": F, "gamma": F, "gamma_low": F, "gamma_high": F, "gamma_independent": F,
    "null": S, "gamma_null": F, "gamma_null_error": F, "difference": F, "difference_low": F, "difference_high": F,
    "verdict": S, "statement": S,
}  # fmt: skip
ROTATION, ORDER = "rotation of blocks", "random order"


@dataclass
class Cell:
    """Sums of one law in one group, a row a matrix, shape (G, 2) each: total size and number of cascades."""

    observed: np.ndarray
    independent: np.ndarray
    null: np.ndarray
    tally: NullTally | None = None


@dataclass
class Sheet:
    """All laws of one group under one definition of sticking; `threshold` is None for the members' own."""

    group: Group
    threshold: float | None
    null: str
    cells: dict[Law, Cell] = field(default_factory=dict)


def every_size(win: Window, dts: Sequence[float], taus: Sequence[float]) -> dict[Law, np.ndarray]:
    """Sizes by each definition, step and gap at once."""
    found = sizes_of_path(win.path(), {dt: win.grid_index(dt) for dt in dts})
    exits = win.exits()
    for tau in taus:
        found[Law("clusters", tau=tau)] = cluster_sizes(exits, tau, win.t_start, win.t_stop)
    return found


def sheets(
    data: Data,
    found: Sequence[Group],
    *,
    t_burn: float,
    dt: Sequence[float],
    taus: Sequence[float],
    resamples: int,
    seed: int,
) -> list[Sheet]:
    """Observed and chance cascades of every group, for its own definition of sticking and each threshold.

    The null against which a difference is taken is rotation of blocks where the data have events, random order
    of the changes otherwise; for further thresholds only the closed form is given, since events are recorded
    under the members' own definition.
    """
    every = laws(tuple(dt), tuple(taus))
    made = []
    for group in found:
        thresholds = sorted({c for member_id, c in data.thresholds if member_id in set(group.members["member_id"])})
        own = _empty(group, None, ROTATION, every)
        draws = draws_each(resamples, len(group.taus), least=10)
        for row, member_id, win in windows(group, data.series, t_burn):
            _add(own, row, win, dt, taus)
            rng = generator(seed, f"{member_id} map")
            if member_id in data.events:
                steps = block_steps(*data.events[member_id], win.t_start, win.t_stop)
                tallies = rotations(steps, tuple(dt), draws, rng, tuple(taus))
            else:
                own.null = ORDER
                tallies = random_order(win, tuple(dt), draws, rng, tuple(taus))
            for law, tally in tallies.items():
                cell = own.cells[law]
                cell.null[row] += tally.sums().sum(axis=0)
                if cell.tally is None:
                    cell.tally = tally
                else:
                    cell.tally += tally
        made.append(own)
        for threshold in thresholds:
            sheet = _empty(group, threshold, "", every)
            series = {name: points for name, points in _of_threshold(data, threshold)}
            for row, _, win in windows(_part(group, series), series, t_burn):
                _add(sheet, row, win, dt, taus)
            made.append(sheet)
    return made


def _of_threshold(data: Data, threshold: float) -> Iterable[tuple[str, Any]]:
    return ((name, data.thresholds[name, c]) for name, c in data.thresholds if c == threshold)


def _part(group: Group, series: dict[str, Any]) -> Group:
    """The group with the members that have this threshold, its rows as they were."""
    kept = group.members[group.members["member_id"].isin(list(series))]
    return Group(group.label, group.key, kept, group.matrices)


def _empty(group: Group, threshold: float | None, null: str, every: Iterable[Law]) -> Sheet:
    shape = (len(group.matrices), 2)
    return Sheet(
        group, threshold, null, {law: Cell(np.zeros(shape), np.zeros(shape), np.zeros(shape)) for law in every}
    )


def _add(sheet: Sheet, row: int, win: Window, dt: Sequence[float], taus: Sequence[float]) -> None:
    n_exits, n_entries = (int(np.maximum(sign * win.step, 0).sum()) for sign in (-1, 1))
    for law, sizes in every_size(win, dt, taus).items():
        cell = sheet.cells[law]
        cell.observed[row] += [sizes.sum(), len(sizes)]
        cell.independent[row] += independent_sums(law, n_exits, n_entries, win.t_stop - win.t_start)


def map_table(made: Sequence[Sheet], confidence: float) -> pd.DataFrame:
    """One row a group, threshold and law: gamma with its interval, what chance gives, and the difference."""
    rows = [_row(sheet, law, cell, confidence) for sheet in made for law, cell in sheet.cells.items()]
    return typed(SCHEMA, rows)


def _row(sheet: Sheet, law: Law, cell: Cell, confidence: float) -> dict[str, object]:
    kept = cell.observed[:, 1] > 0
    rate = over_matrices(gamma, cell.observed[kept], confidence)
    n_cascades = int(cell.observed[:, 1].sum())
    gamma_null, error = _rate(cell.tally)
    row = {
        "group": sheet.group.label, "n": sheet.group.key["n"], "engine": sheet.group.key["engine"],
        "definition": law.definition, "dt": law.dt, "tau": law.tau, "threshold": sheet.threshold,
        "n_cascades": n_cascades, "n_matrices": int(kept.sum()),
        "mean_size": float(cell.observed[:, 0].sum() / n_cascades) if n_cascades else None,
        "gamma": rate.value, "gamma_low": rate.low, "gamma_high": rate.high,
        "gamma_independent": _value(cell.independent[kept]),
        "null": sheet.null or None, "gamma_null": gamma_null, "gamma_null_error": error,
        "difference": None, "difference_low": None, "difference_high": None, "verdict": None, "statement": None,
    }  # fmt: skip
    if sheet.null:
        against = Estimate(reason="no complete cascade after t_burn in any finished run")
        if kept.any():
            against = over_matrices(gamma_difference, np.hstack([cell.observed, cell.null])[kept], confidence)
        row |= {"difference": against.value, "difference_low": against.low, "difference_high": against.high}
        row["verdict"], row["statement"] = words.verdict(against, gamma_null, confidence)
    return row


def _rate(tally: NullTally | None) -> tuple[float | None, float | None]:
    try:
        return (None, None) if tally is None else tally.rate()
    except Undefined:  # the difference is then undefined too and says why
        return None, None


def _value(sums: np.ndarray) -> float | None:
    try:
        return float(gamma(sums.sum(axis=0, keepdims=True))[0])
    except Undefined:
        return None


# ---------------------------------------------------------------------------------------------- the section


def map_section(
    data: Data,
    found: Sequence[Group],
    *,
    t_burn: float,
    dt: Sequence[float],
    taus: Sequence[float] = (),
    resamples: int = 20,
    confidence: float = 0.95,
    seed: int = 0,
) -> Section:
    """What gamma is by every definition, over sampling steps and thresholds, and what chance gives.

    Parameters
    ----------
    data : Data
        `events` (for rotation) and `thresholds` (for the map) are used where there are any.
    found : sequence of Group
        Filled groups.
    t_burn : float
    dt, taus : sequence of float
        The declared grid of sampling steps, and gaps of `clusters`.
    resamples : int
        Draws of the null model a member, at least 2; fewer in large groups (`draws_each`).
    confidence : float
    seed : int
    """
    shown = list(found)
    made = sheets(data, shown, t_burn=t_burn, dt=dt, taus=taus, resamples=resamples, seed=seed)
    frame = map_table(made, confidence)
    rows = records(frame)
    own = [row for row in rows if row["threshold"] is None]
    is_own = frame["threshold"].isna()
    tables = [Table("gamma_by_definition", "gamma by definition and step.", frame[is_own], _columns(own), 60)]
    if not is_own.all():
        tables.append(Table("gamma_map", "gamma by definition, step and threshold.", frame[~is_own]))
    nulls = list(dict.fromkeys(sheet.null for sheet in made if sheet.null))
    return Section(
        title="gamma by definition, step and threshold",
        question="How much of gamma is the definition of a cascade, and how much would chance give?",
        statements=tuple(_statements(rows, [group.label for group in shown])),
        lead=(),
        method=(
            "gamma = -log(1 - 1/mean size) by each definition, on the recorded series after t_burn, with intervals "
            "over matrices. Chance: independent Poisson exits and entries at the observed rates, sampled the same "
            f"way (closed form); and {' or '.join(nulls) or 'none'} on the same runs (up to {resamples} draws each), "
            "against which the difference is taken, paired by matrix."
        ),
        tables=tuple(tables),
        pictures=tuple(_pictures(rows, own)),
        assumptions=(_check(own, nulls, confidence),),
    )


def _columns(rows: Sequence[Row]) -> tuple[Column, ...]:
    def has(key: str) -> bool:
        return any(row[key] is not None for row in rows)

    columns = (
        Column("group", "group"), Column("definition", "definition"), Column("dt", "dt"), Column("tau", "tau"),
        Column("cascades", "n_cascades"), Column("gamma", "gamma"),
        Column("interval", ("gamma_low", "gamma_high")), Column("independent", "gamma_independent"),
        Column("null", "gamma_null"), Column("verdict", "verdict"),
    )  # fmt: skip
    return tuple(column for column in columns if not isinstance(column.key, str) or has(column.key))


def _statements(rows: Sequence[Row], labels: Sequence[str]) -> list[str]:
    lines = []
    # groups with many cascades first: long lists are folded on the page
    n_cascades = {
        label: max((row["n_cascades"] for row in rows if row["group"] == label), default=0) for label in labels
    }
    for label in sorted(labels, key=lambda label: -n_cascades[label]):
        own = [row for row in rows if row["group"] == label and row["threshold"] is None]
        known = [row for row in own if row["gamma"] is not None and row["definition"] in SAMPLED]
        if not known:
            said = ["not enough data: no sampled definition has a gamma"]
        else:
            under = [row for row in rows if row["group"] == label and row["threshold"] is not None]
            said = [_range(known), _paper(known), _against(own)] + ([_by_threshold(under)] if under else [])
        lines += [f"{label}: {words.sentence(text)}" for text in said]
    return lines


def _law(row: Row) -> str:
    return str(Law(row["definition"], row["dt"], row["tau"]))


def _range(known: Sequence[Row]) -> str:
    least, most = (pick(known, key=lambda row: row["gamma"]) for pick in (min, max))
    text = (
        f"on samples gamma runs from {words.number(least['gamma'])} ({_law(least)}) to "
        f"{words.number(most['gamma'])} ({_law(most)})"
    )
    chance = [row["gamma_independent"] for row in known if row["gamma_independent"] is not None]
    if chance:
        text += (
            f"; independent exits and entries sampled the same way give from {words.number(min(chance))} to "
            f"{words.number(max(chance))}"
        )
    spread = {
        name: [row["gamma"] for row in known if row["definition"] == name]
        for name in dict.fromkeys(row["definition"] for row in known)
    }
    calm = min(spread, key=lambda name: max(spread[name]) / min(spread[name]))
    least_and_most = words.interval(min(spread[calm]), max(spread[calm]))
    return f"{text}. The step matters least to {calm} ({least_and_most})"


def _paper(known: Sequence[Row]) -> str:
    """Where each definition, and chance by it, has the paper's value."""
    parts, by_chance = [], 0
    for name in SAMPLED:
        some = [row for row in known if row["definition"] == name]
        seen, chance = (crossings(some, key, words.PAPER_GAMMA) for key in ("gamma", "gamma_independent"))
        by_chance += bool(chance)
        if seen or chance:
            parts.append(f"by {name} {_at(seen)} (chance {_at(chance)})")
    if not parts:
        return f"no sampled definition passes the paper's {words.PAPER_GAMMA} on this grid, nor does chance"
    text = f"the paper's {words.PAPER_GAMMA} is passed {', '.join(parts)}"
    return f"{text}: without dt and threshold the value may be chance's as well" if by_chance else text


def _at(steps: Sequence[float]) -> str:
    return "nowhere" if not steps else "at dt = " + " and ".join(f"{step:.2g}" for step in steps)


def crossings(rows: Sequence[Row], key: str, level: float) -> list[float]:
    """Steps dt at which a value passes `level`, by interpolation in log dt between the grid's steps."""
    points = sorted((np.log(row["dt"]), row[key] - level) for row in rows if row[key] is not None)
    found = []
    for (x0, y0), (x1, y1) in pairwise(points):
        if (y0 < 0) != (y1 < 0):
            found.append(float(np.exp(x0 + (x1 - x0) * y0 / (y0 - y1))))
    return found


def _against(own: Sequence[Row]) -> str:
    judged = [row for row in own if row["difference_low"] is not None and row["gamma_null"]]
    if not judged:
        return "no difference from chance can be judged"
    differ = [row for row in judged if row["verdict"] == "differs"]
    text = (
        f"of {words.count(len(judged), 'pair')} of definition and step, {len(differ)} differ from {judged[0]['null']}"
    )
    if differ:
        worst = max(differ, key=lambda row: abs(row["difference"]) / row["gamma_null"])
        text += (
            f", the most by {words.percent(abs(worst['difference']) / worst['gamma_null'])} of its gamma "
            f"({_law(worst)}: {words.number(worst['gamma'])} where chance gives {words.number(worst['gamma_null'])})"
        )
    return text


def _by_threshold(under: Sequence[Row]) -> str:
    parts = []
    for name in SAMPLED:
        some = [row for row in under if row["definition"] == name and row["gamma"] is not None]
        factors = {
            dt: [row["gamma"] for row in some if row["dt"] == dt] for dt in dict.fromkeys(row["dt"] for row in some)
        }
        if factors:
            most = max(factors, key=lambda dt: max(factors[dt]) / min(factors[dt]))
            parts.append(f"{name} up to {max(factors[most]) / min(factors[most]):.2g} times at dt = {most:g}")
    low, high = (pick(row["threshold"] for row in under) for pick in (min, max))
    if not parts:
        return f"thresholds from {low:g} to {high:g}: not enough data for any definition"
    return f"the threshold, from c = {low:g} to {high:g}, moves gamma by {', by '.join(parts)}"


def _check(own: Sequence[Row], nulls: Sequence[str], confidence: float) -> str:
    judged = [row for row in own if row["difference_low"] is not None]
    luck = words.number(len(judged) * (1 - confidence), 2)
    is_null = "is" if ROTATION in nulls else "would, with events recorded, be"
    return (
        "Independence in the closed form takes no account of blocks having to stick before they let go: at steps "
        f"long against their time of sticking it fails without any coupling. The null to read there {is_null} "
        "rotation of blocks: each block's own series turned in time by a random amount. The definitions share their "
        f"data; of {words.count(len(judged), 'comparison')} about {luck} would differ by luck."
    )


def _pictures(rows: Sequence[Row], own: Sequence[Row]) -> Iterable[Picture]:
    if any(row["gamma"] is not None and row["definition"] in SAMPLED for row in own):
        yield Picture(
            partial(chance_figures.gamma_curves, own),
            "gamma against the sampling step (the gap for clusters), with intervals over matrices. Dashed: "
            "independent exits and entries at the same rates, sampled the same way.",
            "Curves of gamma over dt by definition, beside chance and the paper's value.",
        )
    for label in dict.fromkeys(row["group"] for row in rows):
        some = [row for row in rows if row["group"] == label and row["threshold"] is not None]
        if any(row["gamma"] is not None and row["dt"] is not None for row in some):
            yield Picture(
                partial(chance_figures.gamma_map, some),
                f"{label}: gamma over dt and the threshold c of |w - v| < c r eps. White: the paper's "
                f"{words.PAPER_GAMMA}; dashed: where chance gives it.",
                "Maps of gamma over dt and threshold by definition, with the paper's value as a contour.",
            )
