"""What became of the runs: how many stay in motion, how and when the others end, whether lasting motion is steady.

Survival is by Kaplan and Meier. Certified runs and runaways ended (`models.fates.ends_at` says when). All others, in
motion, in a lull or quiet, are censored at t_end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import DRAWN, ENGINE_KEYS, SPEED_DEPENDENT
from stickslip.analysis.models.fates import (
    COLLAPSED,
    DIVERGED,
    ENDS,
    FAILED,
    LAST_SHARE,
    LULL,
    MOVING,
    QUIET,
    SETTLED,
    SUSTAINED,
    WATCHED,
    Curve,
    bounded_share,
    ends_at,
    half_ended,
    is_held,
    is_unstable,
    survival,
)
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.effective import tau
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import BLUE, EXACT, GREEN, GREY, ORANGE, PURPLE, panel

MOST_CURVES = 8  # in one figure
MOST_STEPS = 2000  # drawn of one curve: each is then a quarter of a dot wide
BLOCK = 50.0  # units of time that n_stick is averaged over in the figure of all runs
FATES = {
    COLLAPSED: ("slips for good", BLUE, "s"), QUIET: ("quiet", "#56B4E9", "D"),
    SUSTAINED: ("in motion", GREEN, "o"), LULL: ("in a lull", PURPLE, "v"), DIVERGED: ("ran away", ORANGE, "^"),
}  # fmt: skip
#: What runs from different starts do at the end: the fates that belong to each kind, its colour and its mark.
KINDS = {
    "no late stick": (SETTLED, BLUE, "s"), "sticks and slips": (MOVING, "#E69F00", "o"),
    "ran away": ((DIVERGED,), GREY, "^"),
}  # fmt: skip
_COUNTS = (*(f"n_{name}" for name in (*WATCHED, FAILED)), "n_moving")
_GROUP: Mapping[str, str] = {
    "group": S, "n": I, "kappa_n": F, "engine": S, "n_runs": I, **dict.fromkeys(_COUNTS, I), "n_held": I, "t_end": F,
    **{name + end: F for name in ("moving", "settled", "median", "mean", "drift") for end in ("", "_low", "_high")},
    "median_least": F, "last_end": F, "last_quiet": F, "effective_samples": F, "basis": S,
}  # fmt: skip
_CURVE = {"group": S, "t": F, "survival": F, "low": F, "high": F}
_RUN = {
    "group": S, "n": I, "kappa_n": F, "matrix": I, "unit": I, "member_id": S, "fate": S, "t": F, "growth_rate": F,
    "z_start": F, "w_start": F,
}  # fmt: skip


def answer(study: Study) -> Answer:
    """What became of the unchanged runs, and whether what lasts is steady."""
    level = study.settings.confidence
    runs = [row for group in study.groups for row in _runs(group)]
    curves = {group.label: curve for group in study.groups if (curve := _curve(runs, group, level))}
    groups = [_group_row(study, group, runs) for group in study.groups]
    moving = sorted((row for row in groups if row["n_moving"]), key=lambda row: -row["n"])
    systems = _brief(groups)
    is_one_engine = len({tuple(group.key[name] for name in ENGINE_KEYS) for group in study.groups}) == 1
    members = study.data.members
    failed = members[members["outcome"] == FAILED]
    followed = [row for row in runs if row["fate"] != FAILED]
    facts: dict[str, Any] = {
        "systems": systems,
        "groups": groups,
        "moving": moving,
        "total": {**_counts(runs), "runs": len(followed), "held": sum(row["n_held"] for row in groups)},
        "share": _share(followed, MOVING, level),
        "level": f"{100 * level:g}%",
        "n_systems": len({row["drawn"] for row in followed}),
        "has_copies": len(members) > len(runs),
        "t_end": sorted({float(group.key["t_end"]) for group in study.groups}),
        "last_share": LAST_SHARE,
        "failed": {"n": len(failed), "of": len(members), "why": _commonest(failed["reason"])},
        "is_one_engine": is_one_engine,
        "partly": [row for row in systems if 0 < row["n_moving"] < row["n_runs"]],
        "lasting": [row for row in systems if is_one_engine and row["n_moving"] == row["n_runs"]],
        "endless": [row for row in systems if not row["n_collapsed"] and not row["n_diverged"]],
        "linear": _linear(followed),
        "rated": [row for row in systems if row["is_rated"]],
        "is_certified": "t_collapse" in study.data.members,
        "untold": Counter(row["untold"] for row in runs if row["fate"] == QUIET),
        "has_ends": any(row["fate"] in ENDS for row in runs),
        "basin": _basin(followed),
        "few": [row for row in moving if row["basis"] == enough.FEW_MATRICES],
        "drifting": [row for row in moving if row["is_drifting"]],
        "unsure": [row for row in moving if row["basis"] == enough.DRIFT_UNKNOWN],
        "t_burn": study.settings.t_burn,
        "drift_margin": enough.MARGIN,
        "block": BLOCK,
    }
    tables = {
        "fates": frame(_GROUP, groups),
        "survival_curves": frame(
            _CURVE,
            [
                dict(zip(_CURVE, (label, *row), strict=True))
                for label, curve in curves.items()
                for row in zip(*curve, strict=True)
            ],
        ),
        "runs": frame(_RUN, runs),
    }
    return Answer(facts, tables=tables, figures=_figures(study, facts, runs, curves))


def _figures(
    study: Study, facts: Mapping[str, Any], runs: Sequence[Row], curves: Mapping[str, Curve]
) -> dict[str, Any]:
    """Shares by fate and times of ends if some runs ended; else n_stick of all runs of the largest group."""
    shown = {}
    if facts["total"]["n_moving"] < facts["total"]["runs"]:
        some = [(label, curves[label]) for label in list(curves)[:MOST_CURVES]]
        if len(facts["systems"]) > 1 or facts["linear"]:
            systems = facts["systems"]
            counts = {name: [row[f"n_{name}"] for row in systems] for name in FATES}
            shown["fates"] = partial(shares, *_by_system(systems), counts)
        if facts["has_ends"]:
            shown["survival"] = partial(survival_curves, some, max(facts["t_end"]))
        if facts["linear"]:
            known = [row for row in runs if row["growth_rate"] is not None and row["fate"] != FAILED]
            shown["growth"] = partial(growth, facts["rated"], known)
        if facts["basin"] is not None:
            shown["basin"] = partial(basin, facts["basin"]["points"])
    else:
        most = max(
            (group for group in study.groups if group.n_runs), key=lambda group: int(group.key["n"]), default=None
        )
        if most is not None:
            shown["runs"] = partial(all_runs, [_means(win) for _, _, win in study.windows(most)])
    return shown


def _runs(group: Group) -> Iterator[Row]:
    """Fate of each run, with the time at which its motion ended or up to which it was followed."""
    table = group.members
    setting = tuple(value for name, value in group.key.items() if name not in ("z0", "w0"))
    is_speed_dependent = any(group.key[name] is not None for name in SPEED_DEPENDENT)
    columns = ("member_id", "matrix", "unit", "t_end", "t_stop", "growth_rate", "z_start", "w_start")
    rows = zip(*(table[name] for name in columns), group.fates, group.last, strict=True)
    for member_id, matrix, unit, t_end, t_stop, rate, z, w, how, last in rows:
        times = (0.0, 0.0, 0.0) if how == FAILED else (float(last[0]), float(t_stop), float(t_end))
        yield {
            "group": group.label, "n": group.key["n"], "kappa_n": _kappa_n(group.key),
            "matrix": int(matrix), "unit": int(unit), "member_id": str(member_id), "fate": how,
            "times": times, "t": None if how == FAILED else ends_at(how, *times)[0],
            "growth_rate": None if pd.isna(rate) else float(rate),
            "untold": "law" if is_speed_dependent else "rate" if pd.isna(rate) else "stable",
            "is_held": how == SUSTAINED and is_held((last[0], last[1]), int(group.key["n"]), float(t_end)),
            "drawn": (*(group.key[name] for name in DRAWN), int(unit)),
            "setting": (*setting, int(matrix)),
            "z_start": None if pd.isna(z) else float(z), "w_start": None if pd.isna(w) else float(w),
        }  # fmt: skip


def _curve(runs: Sequence[Row], group: Group, confidence: float) -> Curve | None:
    """Survival of the first run of each unit of a group."""
    followed = _followed(runs, group)
    return survival(*followed, confidence) if followed else None


def _half(
    runs: Sequence[Row], group: Group, confidence: float, ends: Mapping[str, str] = MappingProxyType({})
) -> Estimate:
    """When half of the runs of `_curve` have ended; `ends` maps fates to those that they are counted as."""
    followed = _followed(runs, group)
    if not followed:
        return Estimate()
    hows, t_last, t_stop, t_end = followed
    return half_ended([ends.get(how, how) for how in hows], t_last, t_stop, t_end, confidence)


def _followed(runs: Sequence[Row], group: Group) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray] | None:
    """Fates and times of the first run of each unit of a group that did not fail; None if all failed."""
    first: dict[int, Row] = {}
    for row in runs:
        if row["group"] == group.label and row["fate"] != FAILED:
            first.setdefault(row["unit"], row)
    if not first:
        return None
    t_last, t_stop, t_end = np.array([row["times"] for row in first.values()]).T
    return [row["fate"] for row in first.values()], t_last, t_stop, t_end


def _kappa_n(key: Mapping[str, Any]) -> float | None:
    """kappa n; None where there is no spring between blocks, or K comes from a file."""
    return None if key["kappa"] is None or key["n"] == 1 else key["n"] * key["kappa"]


def _counts(runs: Sequence[Row]) -> dict[str, int]:
    """Number of runs of each fate, and of those in motion."""
    how = Counter(row["fate"] for row in runs)
    return {**{f"n_{name}": how[name] for name in (*WATCHED, FAILED)}, "n_moving": sum(how[name] for name in MOVING)}


def _share(
    followed: Sequence[Row], of: Sequence[str], confidence: float, untold: Sequence[str] = (QUIET,)
) -> Estimate:
    """Share of runs with one of some fates, where the runs of one unit, over all points of a grid, are dependent.

    For the fates in `untold` it is unknown whether the run belongs to them, and the interval covers both cases; with
    () every run counts as it is seen.
    """
    if not followed:
        return Estimate(reason="every run failed")
    counts: dict[tuple[object, ...], list[int]] = {}
    for row in followed:
        held = counts.setdefault(row["drawn"], [0, 0, 0])
        held[0] += row["fate"] in of
        held[1] += row["fate"] in untold
        held[2] += 1
    return bounded_share(np.array(list(counts.values())), confidence)


def _basin(followed: Sequence[Row]) -> Row | None:
    """Starts of the runs of one system by what they do at the end (`KINDS`); None if all do the same.

    A start must be given by two numbers, and both must vary; else None. Of several such systems or engines, the one
    with most runs.
    """
    by_setting: dict[tuple[object, ...], list[Row]] = {}
    for row in followed:
        by_setting.setdefault(row["setting"], []).append(row)
    found = []
    for rows in by_setting.values():
        known = [row for row in rows if row["z_start"] is not None and row["w_start"] is not None]
        points = {
            kind: [(row["z_start"], row["w_start"]) for row in known if row["fate"] in fates]
            for kind, (fates, _, _) in KINDS.items()
        }
        varies = all(len({row[name] for row in known}) > 1 for name in ("z_start", "w_start"))
        if varies and sum(map(bool, points.values())) > 1:
            found.append({"points": points, "n": len(known), "of": len(rows), "group": known[0]["group"]})
    return max(found, key=lambda one: one["n"], default=None)


def _group_row(study: Study, group: Group, runs: Sequence[Row]) -> Row:
    """Row of the table `fates`: the runs of a group by fate, when they end, and their mean n_stick."""
    level = study.settings.confidence
    own = [row for row in runs if row["group"] == group.label]
    followed = [row for row in own if row["fate"] != FAILED]
    mean, drift, basis = group.mean(level), group.drift(level), group.basis(level)
    span = float(group.key["t_end"]) - study.settings.t_burn
    memory = tau(group.effective)
    half, least = _half(runs, group, level), _half(runs, group, level, {QUIET: COLLAPSED})
    ended = [row for row in followed if row["fate"] in ENDS]
    share, settled = _share(followed, MOVING, level), _share(followed, SETTLED, level, untold=())
    return {
        "group": group.label, "n": group.key["n"], "kappa_n": _kappa_n(group.key),
        "engine": group.key["engine"], "n_runs": len(followed), "t_end": float(group.key["t_end"]),
        **_counts(own), **named("moving", share), **named("settled", settled),
        "n_held": sum(row["is_held"] for row in own), "is_rated": any(row["growth_rate"] is not None for row in own),
        "half": half, **named("median", half), "median_least": least.value,
        "last_end": max((row["t"] for row in ended), default=None),
        "last_quiet": max((row["times"][0] for row in followed if row["fate"] == QUIET), default=None),
        **named("mean", mean), "drifts": drift, **named("drift", drift),
        "effective_samples": memory and len(group.units) * span / (2 * memory),
        "basis": basis.code, "is_drifting": _is_drifting(drift, basis),
    }  # fmt: skip


def _is_drifting(drift: Estimate, basis: enough.Basis) -> bool:
    """Whether a drift is shown, and is not harmless: few runs may show one of 1e-7."""
    if drift.low is None or drift.high is None or drift.low <= 0 <= drift.high:
        return False
    size = basis.drift.value
    return basis.code != enough.ENOUGH and (size is None or not abs(size) <= enough.MARGIN)


def _brief(groups: Sequence[Row]) -> list[Row]:
    """Groups with runs that did not fail, in order of n and kappa n, named by n and what else tells them apart."""
    parts = [row["group"].split(", ") for row in groups]
    shared = set.intersection(*map(set, parts)) if parts else set()
    found = [
        row | {"system": ", ".join(part for k, part in enumerate(own) if not k or part not in shared)}
        for row, own in zip(groups, parts, strict=True)
    ]
    return sorted((row for row in found if row["n_runs"]), key=lambda row: (row["n"], row["kappa_n"]))


def _linear(followed: Sequence[Row]) -> list[Row]:
    """Number of runs of each fate where slipping all together is linearly stable, and where it is unstable.

    Empty if no growth rate is known.
    """
    known = [row for row in followed if row["growth_rate"] is not None]
    found = []
    for state, has in (("stable", False), ("unstable", True)):
        some = [row for row in known if is_unstable(row["growth_rate"]) == has]
        if some:
            found.append({"state": state, "n_runs": len(some), **_counts(some)})
    return found


def _commonest(reasons: pd.Series) -> str:
    return str(reasons.value_counts().index[0]) if len(reasons) else ""


def _means(win: Window) -> tuple[np.ndarray, np.ndarray]:
    """Middles of blocks of `BLOCK` units of time, and the means of n_stick over them."""
    n_blocks = max(int((win.t_stop - win.t_start) // BLOCK), 1)
    return win.t_start + (np.arange(n_blocks) + 0.5) * (win.t_stop - win.t_start) / n_blocks, win.means(n_blocks)


@panel()
def shares(ax: Axes, key: str, ticks: Sequence[str], counts: Mapping[str, Sequence[int]]) -> None:
    """Shares of runs by fate, one bar for each value of a key; `counts` are the runs at each value, by fate."""
    total, floor = np.maximum(np.sum([*counts.values()], axis=0), 1), np.zeros(len(ticks))
    for name, some in counts.items():
        if any(some):
            label, colour, _ = FATES[name]
            ax.bar(range(len(ticks)), some / total, 0.7, floor, color=colour, label=label)
            floor += some / total
    ax.set(xlim=(-0.6, len(ticks) - 0.4), xlabel=key, ylabel="share of runs")
    ax.set_xticks(range(len(ticks)), ticks)
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, handlelength=1.2)


def _by_system(systems: Sequence[Row]) -> tuple[str, list[str]]:
    """Label and ticks of an axis of systems."""
    if len({row["n"] for row in systems}) == len(systems):
        return "blocks, n", [str(row["n"]) for row in systems]
    return "", [str(row["system"]).replace(", ", "\n") for row in systems]


@panel()
def growth(ax: Axes, systems: Sequence[Row], runs: Sequence[Row]) -> None:
    """Linear growth rate of the all-slip state of each run, marked by its fate and sorted within a system."""
    points: dict[str, list[tuple[float, float]]] = {}
    for k, system in enumerate(systems):
        own = sorted((row for row in runs if row["group"] == system["group"]), key=lambda row: row["growth_rate"])
        for rank, row in enumerate(own):
            x = k + 0.6 * (rank / max(len(own) - 1, 1) - 0.5)
            points.setdefault(row["fate"], []).append((x, row["growth_rate"]))
    ax.axhline(0, color=GREY, linewidth=0.8)
    for name, (label, colour, marker) in FATES.items():
        if name in points:
            ax.plot(*zip(*points[name], strict=True), marker, color=colour, markersize=3, label=label)
    key, ticks = _by_system(systems)
    ax.set(xlim=(-0.6, len(ticks) - 0.4), xlabel=key, ylabel="linear growth rate, all slip")
    ax.set_xticks(range(len(ticks)), ticks)
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, handlelength=1.2)


@panel()
def basin(ax: Axes, points: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Starts in their plane, one mark a run, by what the run does at the end."""
    size = float(np.clip(120.0 / np.sqrt(sum(map(len, points.values()))), 1.5, 6.0))  # marks fill the plane
    for kind, some in points.items():
        if some:
            # of thousands of marks, a bitmap inside the SVG keeps the report small
            ax.plot(*zip(*some, strict=True), KINDS[kind][2], color=KINDS[kind][1], markersize=size,
                    markeredgewidth=0, label=kind, rasterized=True)  # fmt: skip
    ax.margins(0.01)
    ax.set(xlabel="displacement z at start", ylabel="velocity w at start")
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, markerscale=4.0 / size, handletextpad=0.2)


@panel()
def survival_curves(ax: Axes, curves: Sequence[tuple[str, Curve]], t_end: float) -> None:
    """Share of runs that have not ended against time, one curve a group, with intervals for one or two groups."""
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(curves)))
    for (label, (times, *shares)), colour in zip(curves, colours, strict=True):
        some = np.unique(np.linspace(0, len(times) - 1, MOST_STEPS).astype(np.int64))
        t = np.append(times[some], t_end)
        alive, low, high = (np.append(y[some], y[-1]) for y in shares)
        ax.step(t, alive, where="post", color=colour, label=label)
        if len(curves) <= 2:
            ax.fill_between(t, low, high, step="post", color=colour, alpha=0.15, linewidth=0)
    ax.set(xlim=(0, t_end), ylim=(-0.02, 1.04), xlabel="time t", ylabel="share not ended")
    ax.figure.legend(loc="outside upper center", ncols=2, fontsize=7, handlelength=1.2)


@panel()
def all_runs(ax: Axes, paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """n_stick of every run, in means over blocks of time."""
    for t, mean in paths:
        ax.plot(t, mean, color=EXACT, alpha=0.35, linewidth=0.7)
    ax.set(xlabel="time t", ylabel="$n_{stick}$", ylim=(0, None))


def _most_have_ended(study: Study) -> bool:
    return bool(study.data.members["outcome"].isin(["collapsed", "diverged"]).mean() > 0.5)


QUESTION = Question(answer, share=0.01, rank=3, leads=_most_have_ended, beside=("robustness",))
