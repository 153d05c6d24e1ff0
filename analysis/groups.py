"""Members sorted into groups of like members, and what each group's finished runs give.

A group holds the members that differ in the matrix only (and, for the sigmoid, in the draw of the stiffness
ratios). Only members that reached t_end enter a statistic; the others are counted, with outcome and reason.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.report import words
from stickslip.analysis.report.section import Series
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.cascades import Law, Window, laws, sizes_of_path, window
from stickslip.analysis.stats.estimates import Estimate, add_histograms, correlation_time
from stickslip.analysis.stats.nulls import NullTally, draws_each, random_order
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number, Numbers

OUTCOMES = ("finished", "collapsed", "diverged", "failed")
PARTS = 10  # stretches of equal numbers of cascades in a run, for the error of gamma within it
SYSTEM_KEYS = ("n", "coupling", "belt_speed", "kappa", "rho", "t_end", "perturbation_size")
TOLERANCES = tuple(name for name, setting in SETTINGS.items() if isinstance(setting, Number) and setting.picked)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
REQUIRED = (*SYSTEM_KEYS, *ENGINE_KEYS, "member_id", "matrix", "outcome", "reason", "t_stop")


@dataclass
class LawData:
    """Cascades by one definition in one group: a row of sums and a histogram for each matrix."""

    sums: np.ndarray  # (G, 4): total size and number of cascades, the same under random order
    histograms: list[np.ndarray]
    null: NullTally
    parts: list[np.ndarray]  # of each matrix, (b, 2): total size and number in consecutive stretches of its runs


@dataclass
class Group:
    """Members alike in everything but the matrix, with what their finished runs give."""

    label: str
    key: dict[str, Any]
    members: pd.DataFrame
    matrices: list[int] = field(default_factory=list)  # of the finished members, ascending: the rows of all arrays
    by_law: dict[Law, LawData] = field(default_factory=dict)
    means: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))  # whole, 1st half, 2nd half, variance, 1
    taus: list[Estimate] = field(default_factory=list)  # one a run
    n_quiet: int = 0  # finished, but nothing sticks or slips anew after t_burn


def check(members: pd.DataFrame, series: Series, settings: AnalysisSettings) -> None:
    """Refuse input that cannot mean what it says.

    Raises
    ------
    ValueError
        Naming the column, member or setting, what was expected and what came.
    """
    missing = [name for name in REQUIRED if name not in members.columns]
    if missing:
        raise ValueError(f"members: missing column(s) {', '.join(missing)}")
    if members.empty:
        raise ValueError("members: expected at least one row, got none")
    if not members["member_id"].is_unique:
        twice = members.loc[members["member_id"].duplicated(), "member_id"].iloc[0]
        raise ValueError(f"members: member_id {twice!r} occurs more than once")
    unknown = sorted({str(outcome) for outcome in members["outcome"]} - set(OUTCOMES))
    if unknown:
        raise ValueError(f"members: outcome must be one of {', '.join(OUTCOMES)}, got {unknown[0]!r}")
    if settings.t_burn >= members["t_end"].min():
        raise ValueError(
            f"t_burn: expected less than t_end = {members['t_end'].min():g}, got {settings.t_burn:g}; "
            "no time is left for statistics"
        )
    for member_id, outcome in zip(members["member_id"], members["outcome"], strict=True):
        if outcome != "failed" and member_id not in series:
            raise ValueError(
                f"series: no change points for the {outcome} member {member_id!r}; every member that did not fail "
                "has some, be it the start alone"
            )


def split(members: pd.DataFrame, keys: Sequence[str]) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Members alike in some columns, null as None, with the values that they share."""
    plain = [members[name].astype(object).where(members[name].notna(), None) for name in keys]
    at: dict[tuple[Any, ...], list[int]] = {}
    for k, row in enumerate(zip(*plain, strict=True)):
        at.setdefault(row, []).append(k)
    return [(dict(zip(keys, row, strict=True)), members.iloc[some]) for row, some in at.items()]


def groups(members: pd.DataFrame) -> list[Group]:
    """Split members into groups, unperturbed ones first, then by n and engine."""

    def order(part: tuple[dict[str, Any], pd.DataFrame]) -> tuple[Any, ...]:
        key = part[0]
        return (key["perturbation_size"], key["n"], key["engine"], [str(value) for value in key.values()])

    parts = sorted(split(members, (*SYSTEM_KEYS, *ENGINE_KEYS)), key=order)
    keys = [key for key, _ in parts]
    return [
        Group(words.group_label(key, keys), key, alike.sort_values(["matrix", "member_id"])) for key, alike in parts
    ]


def fill(group: Group, series: Series, settings: AnalysisSettings) -> None:
    """Read each finished run of a group once and keep the sums that every table is made of."""
    finished = group.members[group.members["outcome"] == "finished"]
    group.matrices = [int(matrix) for matrix in finished["matrix"].unique()]
    n_rows = len(group.matrices)
    group.means = np.zeros((n_rows, 5))
    draws = draws_each(settings.resamples, len(finished), least=20)
    for law in laws(settings.dt):
        null = NullTally(np.zeros(draws), np.zeros(draws))
        histograms, parts = [np.zeros(1, np.int64)] * n_rows, [np.zeros((0, 2))] * n_rows
        group.by_law[law] = LawData(np.zeros((n_rows, 4)), histograms, null, parts)
    for row, member_id, win in windows(group, series, settings.t_burn):
        _add_run(group, row, win, settings, draws, generator(settings.seed, member_id))


def windows(group: Group, series: Series, t_burn: float) -> Iterator[tuple[int, str, Window]]:
    """Row (matrix), member_id and n_stick on [t_burn, t_end] of each finished run of a filled group.

    Raises
    ------
    ValueError
        If a series is not one, naming the member.
    """
    finished = group.members[group.members["outcome"] == "finished"]
    row_of = {matrix: row for row, matrix in enumerate(group.matrices)}
    for matrix, member_id, t_end in zip(finished["matrix"], finished["member_id"], finished["t_end"], strict=True):
        try:
            win = window(*series[member_id], t_burn, float(t_end))
        except ValueError as error:
            raise ValueError(f"series of member {member_id!r}: {error}") from error
        yield row_of[int(matrix)], str(member_id), win


def generator(seed: int, member_id: str) -> np.random.Generator:
    """Random numbers of a member depend on its name alone, not on its place in the table."""
    words32 = np.frombuffer(hashlib.sha256(member_id.encode()).digest(), dtype="<u4")
    return np.random.default_rng(np.random.SeedSequence([seed, *words32.tolist()]))


def _add_run(
    group: Group, row: int, win: Window, settings: AnalysisSettings, draws: int, rng: np.random.Generator
) -> None:
    middle = 0.5 * (win.t_start + win.t_stop)
    halves = win.part(win.t_start, middle), win.part(middle, win.t_stop)
    group.means[row] += [win.time_mean(), *(half.time_mean() for half in halves), win.time_variance(), 1.0]
    group.taus.append(correlation_time(win))
    group.n_quiet += not win.step.size
    found = sizes_of_path(win.path(), {dt: win.grid_index(dt) for dt in settings.dt})
    null = random_order(win, settings.dt, draws, rng)
    for law, data in group.by_law.items():
        data.sums[row, :2] += [found[law].sum(), len(found[law])]
        data.sums[row, 2:] += [null[law].totals.sum(), null[law].counts.sum()]
        data.histograms[row] = add_histograms(data.histograms[row], np.bincount(found[law]))
        stretches = [(part.sum(), part.size) for part in np.array_split(found[law], PARTS)]
        data.parts[row] = np.vstack([data.parts[row], stretches])
        data.null += null[law]
