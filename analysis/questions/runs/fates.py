"""What became of the runs: how many stay in motion, how and when the others end, whether lasting motion is steady.

Survival is by Kaplan and Meier. Certified runs and runaways ended (`models.fates.ends_at` says when). All others, in
motion, in a lull or quiet, are censored at t_end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from stickslip.analysis import burn_in
from stickslip.analysis.answer import Answer, F, I, Question, Row, S, columns, frame, long, named
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import DRAWN, ENGINE_KEYS, SPEED_DEPENDENT, SYSTEM_KEYS, joined
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
    UNMOVED,
    WATCHED,
    Curve,
    bounded_share,
    ends_at,
    half_ended,
    is_held,
    is_unstable,
    median,
    survival,
)
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.effective import tau
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import BLUE, EXACT, GREEN, GREY, ORANGE, PANEL, PURPLE, panel
from stickslip.pipeline.design.labels import apart, engine_name

MOST_CURVES = 8  # in one figure
MOST_RUNS = 200  # in one figure; more lines hide each other
MOST_STEPS = 2000  # of one curve: each is then a quarter of a dot wide
_LETTERS, _LETTER = 42, 0.05  # below an axis, side by side; inches that one takes, upright
_MOST_TICKS = 40  # upright
_SHORT = 28  # of names in a legend of two columns
BLOCK = 50.0  # units of time that n_stick is averaged over in the figure of all runs
FATES = {
    COLLAPSED: ("slips for good", BLUE, "s"), QUIET: ("quiet", "#56B4E9", "D"),
    SUSTAINED: ("in motion", GREEN, "o"), LULL: ("in a lull", PURPLE, "v"), DIVERGED: ("ran away", ORANGE, "^"),
    UNMOVED: ("not moved", GREY, "x"),
}  # fmt: skip
#: What runs from different starts do at the end: the fates that belong to each kind, its colour and its mark.
KINDS = {
    "no late stick": (SETTLED, BLUE, "s"), "sticks and slips": (MOVING, "#E69F00", "o"),
    "ran away": ((DIVERGED,), GREY, "^"), "does not move": ((UNMOVED,), "#000000", "x"),
}  # fmt: skip
FROM_ZERO = 0.8  # least over largest n_stick up to which its axis begins at 0
_COUNTS = (*(f"n_{name}" for name in (*WATCHED, FAILED)), "n_moving")
_GROUP: Mapping[str, str] = {
    "group": S, "n": I, "kappa_n": F, "engine": S, "n_runs": I, **dict.fromkeys(_COUNTS, I), "n_held": I, "t_end": F,
    **{name + end: F for name in ("moving", "settled", "median", "mean", "drift") for end in ("", "_low", "_high")},
    "median_most": F, "last_end": F, "last_quiet": F, "effective_samples": F, "basis": S,
}  # fmt: skip
_SHIFT: Mapping[str, str] = {
    "setting": S, "reference": S, "n_systems": I, "n_open": I, "shift": F, "shift_low": F, "shift_high": F,
}  # fmt: skip
_CURVE = {"group": S, "t": F, "survival": F, "low": F, "high": F}
_RUN = {
    "group": S, "n": I, "kappa_n": F, "matrix": I, "unit": I, "member_id": S, "fate": S, "t": F, "growth_rate": F,
    "z_start": F, "w_start": F,
}  # fmt: skip


def answer(study: Study) -> Answer:
    """What became of the unchanged runs, and whether what lasts is steady."""
    level = study.settings.confidence
    runs = _runs(study.groups)
    groups, curves = list[Row](), dict[str, Curve]()
    for group in study.groups:
        ran = _Ran.of(group)
        groups.append(_group_row(study, group, ran))
        if len(ran.fates):
            curves[group.label] = _thinned(survival(*ran[:4], level, ran.units))
        del ran  # which takes more memory than what is kept of it
    moving = sorted((row for row in groups if row["n_moving"]), key=lambda row: -row["n"])
    systems = _brief(groups)
    is_one_engine = len({tuple(group.key[name] for name in ENGINE_KEYS) for group in study.groups}) == 1
    members = study.data.table.own
    failed = members[members["outcome"] == FAILED]
    followed = runs[runs["fate"] != FAILED] if len(failed) else runs
    drawn = _of_draws(study.groups, DRAWN, followed, members["unit"])
    shifts = _shifts(study.groups, level)
    averaged = [group for group in study.groups if len(burn_in.averaged(study, group))]
    averaged.sort(key=lambda group: -int(group.key["n"]))
    by_t_burn = burn_in.estimates(study, averaged)
    tested = burn_in.with_enough(burn_in.geweke(study, averaged), by_t_burn, 1 - level)
    short = [row for row in tested if row["is_short"]]
    drawable = burn_in.drawable(by_t_burn)
    facts: dict[str, Any] = {
        "shifts": shifts,
        "short": short,
        "along_t_burn": next(
            (name for name in (*(row["group"] for row in short), *drawable) if name in drawable), None
        ),
        "systems": systems,
        "groups": groups,
        "moving": moving,
        "total": {**_counts(runs["fate"]), "runs": len(followed), "held": sum(row["n_held"] for row in groups)},
        "share": _share(followed["fate"], drawn, MOVING, level),
        "level": f"{100 * level:g}%",
        "n_systems": int(drawn.max(initial=-1)) + 1,
        "has_copies": len(members) > len(runs),
        "t_end": sorted({float(group.key["t_end"]) for group in study.groups}),
        "last_share": LAST_SHARE,
        "failed": {"n": len(failed), "of": len(members), "why": _commonest(failed["reason"])},
        "is_one_engine": is_one_engine,
        "partly": [row for row in systems if 0 < row["n_moving"] < row["n_runs"]],
        "lasting": [row for row in systems if is_one_engine and row["n_moving"] == row["n_runs"]],
        "endless": [row for row in systems if not row["n_collapsed"] and not row["n_diverged"]],
        "linear": _linear(followed, members["growth_rate"]),
        "rated": [row for row in systems if row["is_rated"]],
        "is_certified": "t_collapse" in members,
        "n_on_cycle": _n_on_cycle(study, runs),
        "untold": Counter(runs.loc[runs["fate"] == QUIET, "untold"]),
        "has_ends": bool((runs["fate"].isin(ENDS) & (runs["t"] > 0.0)).any()),
        "basin": None if "attractor" in members else _basin(study.groups, followed, members),  # drawn there
        "few": [row for row in moving if row["basis"] == enough.FEW_MATRICES],
        "drifting": [row for row in moving if row["is_drifting"]],
        "unsure": [row for row in moving if row["basis"] == enough.DRIFT_UNKNOWN],
        "t_burn": study.settings.t_burn,
        "drift_margin": enough.MARGIN,
        "block": BLOCK,
        "most_drawn": MOST_RUNS,
    }
    tables = {
        "fates": frame(_GROUP, groups),
        "survival_curves": pd.concat([frame(_CURVE, []), *(_curve_table(*one) for one in curves.items())]),
        "runs": long(len(runs), partial(_listed, study.groups, runs)),
        "last_events": frame(_SHIFT, shifts),
        "burn_in": frame(burn_in.TESTS, tested),
        "by_t_burn": frame(burn_in.ESTIMATES, by_t_burn),
    }
    figures = _figures(study, facts, runs, curves)
    if facts["along_t_burn"]:
        rows = [row for row in by_t_burn if row["group"] == facts["along_t_burn"]]
        figures["by_t_burn"] = partial(burn_in.by_t_burn, rows, study.settings.t_burn)
    return Answer(facts, tables=tables, figures=figures)


def _figures(
    study: Study, facts: Mapping[str, Any], runs: pd.DataFrame, curves: Mapping[str, Curve]
) -> dict[str, Any]:
    """Shares by fate and times of ends if some runs ended; else n_stick of all runs of the largest group."""
    shown = {}
    if facts["total"]["n_moving"] < facts["total"]["runs"]:
        places = np.linspace(0, max(len(curves) - 1, 0), MOST_CURVES).round().astype(int)
        some = [one for k, one in enumerate(curves.items()) if k in places]
        if len(facts["systems"]) > 1 or facts["linear"]:
            systems = facts["systems"]
            counts = {name: [row[f"n_{name}"] for row in systems] for name in FATES}
            shown["fates"] = partial(shares, *_by_system(systems), counts)
        if facts["has_ends"]:
            shown["survival"] = partial(survival_curves, some, max(facts["t_end"]))
        if facts["linear"]:
            ran = runs[runs["fate"] != FAILED]
            rates = study.data.table.own["growth_rate"].to_numpy()[ran["row"]]
            known = ran[["group", "fate"]].assign(growth_rate=rates)[~np.isnan(rates)]
            shown["growth"] = partial(growth, facts["rated"], known)
        if facts["basin"] is not None:
            shown["basin"] = partial(basin, facts["basin"]["points"])
    else:
        most = max(
            (group for group in study.groups if group.n_runs), key=lambda group: int(group.key["n"]), default=None
        )
        if most is not None:
            first = islice(study.windows(most), MOST_RUNS)
            shown["runs"] = partial(all_runs, [_means(win) for _, _, win in first])
    return shown


def _runs(groups: Sequence[Group]) -> pd.DataFrame:
    """A row a run, group by group: its row among the members, its fate, and until when it was in motion."""
    labels = [group.label for group in groups]
    return joined([_of_group(group, k, labels) for k, group in enumerate(groups)])


def _of_group(group: Group, number: int, labels: Sequence[str]) -> pd.DataFrame:
    fates, size = group.fates, len(group)
    t_stop, rates = (group.column(name).to_numpy(np.float64, na_value=np.nan) for name in ("t_stop", "growth_rate"))
    t, _ = ends_at(fates, group.last[:, 0], t_stop, np.broadcast_to(float(group.key["t_end"]), size))
    is_speed_dependent = any(group.key[name] is not None for name in SPEED_DEPENDENT)
    untold = np.full(size, "law") if is_speed_dependent else np.where(np.isnan(rates), "rate", "stable")
    return pd.DataFrame({
        "row": group.rows.astype(np.int32),
        "t": np.where(fates == FAILED, np.nan, t),
        "group": pd.Categorical.from_codes(np.full(size, number), pd.Index(labels)),
        "fate": pd.Categorical(fates, (*WATCHED, FAILED)),
        "untold": pd.Categorical(untold, ("law", "rate", "stable")),
    }, copy=False)  # fmt: skip


def _listed(groups: Sequence[Group], runs: pd.DataFrame, some: slice) -> pd.DataFrame:
    """Some rows of the table of runs."""
    part = runs.iloc[some]
    own, of_group = groups[0].table.own.iloc[part["row"]], part["group"].cat.codes.to_numpy()
    of_members = {name: own[name].array for name in _RUN if name in own}
    more = {
        "n": np.array([group.key["n"] for group in groups])[of_group],
        "kappa_n": np.array([_kappa_n(group.key) for group in groups], dtype=np.float64)[of_group],
    }
    return columns(_RUN, [part.assign(**of_members, **more)])


def _of_draws(groups: Sequence[Group], keys: Collection[str], followed: pd.DataFrame, drawn: pd.Series) -> np.ndarray:
    """Of each run, the number of the values that its group has of some keys, and of what was drawn for the run."""
    values = [tuple(group.key[name] for name in keys) for group in groups]
    number = np.array([*map(values.index, values)])[followed["group"].cat.codes]
    own = pd.factorize(drawn.to_numpy()[followed["row"]])[0]  # they may be any numbers
    return np.asarray(pd.factorize(number + len(values) * own)[0])


def _thinned(curve: Curve) -> Curve:
    """A curve of survival with at most `MOST_STEPS` of its steps, the first and the last among them."""
    some = np.unique(np.linspace(0, len(curve[0]) - 1, MOST_STEPS).astype(np.int64))
    t, share, low, high = (x[some] for x in curve)
    return t, share, low, high


def _curve_table(label: str, curve: Curve) -> pd.DataFrame:
    return columns(_CURVE, [pd.DataFrame(dict(zip(_CURVE, (label, *curve), strict=True)))])


class _Ran(NamedTuple):
    """The runs of a group that did not fail: their fates, times and units, shape (m,) each."""

    fates: np.ndarray
    t_last: np.ndarray
    t_stop: np.ndarray
    t_end: np.ndarray
    units: np.ndarray

    @classmethod
    def of(cls, group: Group) -> _Ran:
        ran = np.flatnonzero(group.fates != FAILED)
        t_stop, units = (group.column(name).to_numpy(np.float64, na_value=np.nan)[ran] for name in ("t_stop", "unit"))
        t_end = np.broadcast_to(float(group.key["t_end"]), len(ran))
        return cls(group.fates[ran], group.last[ran, 0], t_stop, t_end, pd.factorize(units)[0])


def _kappa_n(key: Mapping[str, Any]) -> float | None:
    """kappa n; None where there is no spring between blocks, or K comes from a file."""
    return None if key["kappa"] is None or key["n"] == 1 else key["n"] * key["kappa"]


def _counts(fates: pd.Series | np.ndarray) -> dict[str, int]:
    """Number of runs of each fate, and of those in motion."""
    how = Counter(pd.Series(fates).value_counts().to_dict())
    return {**{f"n_{name}": how[name] for name in (*WATCHED, FAILED)}, "n_moving": sum(how[name] for name in MOVING)}


def _share(
    fates: pd.Series, drawn: np.ndarray, of: Sequence[str], confidence: float, untold: Sequence[str] = (QUIET,)
) -> Estimate:
    """Share of runs with one of some fates; runs with one number of `drawn`, of one unit, are dependent.

    For the fates in `untold` it is unknown whether the run belongs to them, and the interval covers both cases; with
    () every run counts as it is seen.
    """
    if not len(fates):
        return Estimate(reason="every run failed")
    counts = [np.bincount(drawn, fates.isin(some)) for some in (of, untold)]
    return bounded_share(np.column_stack([*counts, np.bincount(drawn)]), confidence)


def _basin(groups: Sequence[Group], followed: pd.DataFrame, members: pd.DataFrame) -> Row | None:
    """Starts of the runs of one system by what they do at the end (`KINDS`); None if all do the same.

    A start must be given by two numbers, and both must vary; else None. Of several such systems or engines, the one
    with most runs.
    """
    start = members[["z_start", "w_start"]]
    if start.isna().all().any() or (start.min() == start.max()).any():
        return None
    others = [name for name in groups[0].key if name not in ("z0", "w0")]
    setting = _of_draws(groups, others, followed, members["matrix"])
    followed = followed.assign(**{str(name): start[name].to_numpy()[followed["row"]] for name in start})
    start = followed[["z_start", "w_start"]]
    is_known = start.notna().all(axis=1).to_numpy()
    by_setting = start[is_known].groupby(setting[is_known])
    varies = (by_setting.min() < by_setting.max()).all(axis=1)
    found: list[Row] = []
    for one in varies.index[varies]:
        own = followed[setting == one]
        known = own[is_known[setting == one]]
        points = {
            kind: known.loc[known["fate"].isin(fates), ["z_start", "w_start"]].to_numpy()
            for kind, (fates, _, _) in KINDS.items()
        }
        if sum(map(bool, map(len, points.values()))) > 1:
            found.append({"points": points, "n": len(known), "of": len(own), "group": str(known["group"].iloc[0])})
    return max(found, key=lambda one: int(one["n"]), default=None)


def _group_row(study: Study, group: Group, ran: _Ran) -> Row:
    """Row of the table `fates`: the runs of a group by fate, when they end, and their mean n_stick."""
    level, t_end = study.settings.confidence, float(group.key["t_end"])
    mean, drift, basis = group.mean(level), group.drift(level), group.basis(level)
    memory = tau(group.effective)
    fates, t_last, t_stop, ends, unit = ran
    half, most = (
        half_ended(some, t_last, t_stop, ends, level, unit) if len(fates) else Estimate()
        for some in (fates, np.where(fates == QUIET, SUSTAINED, fates))
    )
    t, _ = ends_at(fates, t_last, t_stop, ends)
    n_last = group.last[group.fates != FAILED, 1]
    followed = pd.Series(pd.Categorical(fates, WATCHED))
    share, settled = _share(followed, unit, MOVING, level), _share(followed, unit, SETTLED, level, untold=())
    n_held = np.count_nonzero(is_held(t_last, n_last, int(group.key["n"]), t_end) & (fates == SUSTAINED))
    return {
        "group": group.label, "n": group.key["n"], "kappa_n": _kappa_n(group.key),
        "engine": group.key["engine"], "law": engine_name(group.key["engine"]) + " law" * group.is_exact,
        "n_runs": len(fates), "t_end": t_end,
        **_counts(group.fates), **named("moving", share), **named("settled", settled),
        "n_held": n_held, "is_rated": bool(group.column("growth_rate").notna().any()),
        "half": half, **named("median", half), "median_most": most.value,
        "last_end": _latest(t[np.isin(fates, ENDS)]), "last_quiet": _latest(t_last[fates == QUIET]),
        **named("mean", mean), "drifts": drift, **named("drift", drift),
        "effective_samples": memory and len(group.units) * (t_end - study.settings.t_burn) / (2 * memory),
        "basis": basis.code, "is_drifting": _is_drifting(drift, basis),
    }  # fmt: skip


def _shifts(groups: Sequence[Group], level: float) -> list[Row]:
    """Rows of the table `last_events`: how much later the last event of a system comes under another method.

    Whether a certificate came in time makes no difference to an event, and systems are compared with themselves.
    """
    of_system: dict[tuple[Any, ...], list[Group]] = {}
    for group in sorted(groups, key=fineness):
        of_system.setdefault(tuple(group.key[name] for name in SYSTEM_KEYS), []).append(group)
    found: list[Row] = []
    for reference, *others in of_system.values():
        before = _last_events(reference)
        for other in others:
            both = pd.concat([before, _last_events(other)], axis=1, join="inner").to_numpy()
            known = both[~np.isnan(both).any(axis=1)]
            shifts = known[:, 1] - known[:, 0]
            shift = median(shifts, np.full(len(shifts), True), level)
            if len(shifts):
                shift = replace(shift, value=float(np.median(shifts)))
            found.append({
                "setting": other.label, "reference": reference.label, "is_exact": reference.is_exact,
                "n_systems": len(known),
                "n_open": len(both) - len(known), **named("shift", shift),
            })  # fmt: skip
    return found


def _last_events(group: Group) -> pd.Series:
    """The mean time of the last events of each unit's runs; NaN if one of them goes on, or failed."""
    has_ended = np.isin(group.fates, (*ENDS, QUIET))
    times = pd.Series(np.where(has_ended, group.last[:, 0], np.nan), index=group.column("unit").to_numpy())
    return times.groupby(level=0).agg(lambda some: some.mean(skipna=False))


def _latest(times: np.ndarray) -> float | None:
    """The latest of some times; None if there is none."""
    return float(times.max()) if len(times) else None


def _is_drifting(drift: Estimate, basis: enough.Basis) -> bool:
    """Whether a drift is shown, and is not harmless: few runs may show one of 1e-7."""
    if drift.low is None or drift.high is None or drift.low <= 0 <= drift.high:
        return False
    size = basis.drift.value
    return basis.code != enough.ENOUGH and (size is None or not abs(size) <= enough.MARGIN)


def _brief(groups: Sequence[Row]) -> list[Row]:
    """Groups with runs that did not fail, in order of n and kappa n, named by n and what else tells them apart."""
    names = apart([row["group"] for row in groups], always=1)
    found = [row | {"system": name} for row, name in zip(groups, names, strict=True)]
    return sorted((row for row in found if row["n_runs"]), key=lambda row: (row["n"], row["kappa_n"]))


def _linear(followed: pd.DataFrame, growth_rates: pd.Series) -> list[Row]:
    """Number of runs of each fate where slipping all together is linearly stable, and where it is unstable.

    Empty if no growth rate is known.
    """
    rates = growth_rates.to_numpy(np.float64)[followed["row"]]
    has, is_known = np.asarray(is_unstable(rates)), ~np.isnan(rates)
    parts = {"stable": followed["fate"][is_known & ~has], "unstable": followed["fate"][is_known & has]}
    return [{"state": state, "n_runs": len(some), **_counts(some)} for state, some in parts.items() if len(some)]


def _n_on_cycle(study: Study, runs: pd.DataFrame) -> int:
    """How many quiet runs are on a cycle without exits, where that is recorded; exits are null on none."""
    if "exits_per_period" not in study.data.recorded:
        return 0
    exits = study.data.recorded["exits_per_period"].values  # noqa: PD011  a named tuple, no data frame
    quiet = study.data.table.own["member_id"].iloc[runs.loc[runs["fate"] == QUIET, "row"]]
    return sum(exits.get(name) == 0.0 for name in quiet)


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
    ax.set(xlabel=key, ylabel="share of runs")
    _set_ticks(ax, ticks)
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, handlelength=1.2)


def _by_system(systems: Sequence[Row]) -> tuple[str, list[str]]:
    """Label and ticks of an axis of systems."""
    if len({row["n"] for row in systems}) == len(systems):
        return "blocks, n", [str(row["n"]) for row in systems]
    if len(systems) > _MOST_TICKS:
        return f"{len(systems)} settings", [""] * len(systems)
    texts, same = [str(row["system"]) for row in systems], f"n = {systems[0]['n']}, "
    return "", [text.removeprefix(same) for text in texts] if all(same in text for text in texts) else texts


def _set_ticks(ax: Axes, ticks: Sequence[str]) -> None:
    """One tick a system, its words below each other; upright where there is no room for them side by side.

    Of more than can be told apart there are some.
    """
    ax.set_xlim(-0.6, len(ticks) - 0.4)
    stacked = [text.replace(", ", "\n") for text in ticks]
    widest = max(len(line) for text in stacked for line in text.split("\n"))
    if not widest:
        ax.set_xticks([])
    elif widest * len(ticks) <= _LETTERS:
        ax.set_xticks(range(len(ticks)), stacked)
    else:
        step = -(-len(ticks) // _MOST_TICKS)
        ticks = ticks[::step]
        ax.set_xticks(range(0, step * len(ticks), step), ticks, rotation=90, fontsize=6)
        figure = ax.get_figure(root=True)
        assert figure is not None  # it is drawn on one
        figure.set_figheight(PANEL[1] + _LETTER * max(map(len, ticks)))


@panel()
def growth(ax: Axes, systems: Sequence[Row], runs: pd.DataFrame) -> None:
    """Linear growth rate of the all-slip state of each run, marked by its fate and sorted within a system."""
    in_order = [runs[runs["group"] == system["group"]].sort_values("growth_rate") for system in systems]
    x = [k + 0.6 * (np.arange(len(own)) / max(len(own) - 1, 1) - 0.5) for k, own in enumerate(in_order)]
    drawn = pd.concat(in_order).assign(x=np.concatenate(x))
    ax.axhline(0, color=GREY, linewidth=0.8)
    for name, (label, colour, marker) in FATES.items():
        some = drawn[drawn["fate"] == name]
        if len(some):
            ax.plot(some["x"], some["growth_rate"], marker, color=colour, markersize=3, label=label)
    key, ticks = _by_system(systems)
    ax.set(xlabel=key, ylabel="linear growth rate, all slip")
    _set_ticks(ax, ticks)
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, handlelength=1.2)


@panel()
def basin(ax: Axes, points: Mapping[str, np.ndarray]) -> None:
    """Starts in their plane, one mark a run, by what the run does at the end."""
    size = float(np.clip(120.0 / np.sqrt(sum(map(len, points.values()))), 1.5, 6.0))  # marks fill the plane
    for kind, some in points.items():
        if len(some):
            # of thousands of marks, a bitmap inside the SVG keeps the report small
            ax.plot(*some.T, KINDS[kind][2], color=KINDS[kind][1], markersize=size,
                    markeredgewidth=0, label=kind, rasterized=True)  # fmt: skip
    ax.margins(0.01)
    ax.set(xlabel="displacement z at start", ylabel="velocity w at start")
    ax.figure.legend(loc="outside upper center", ncols=4, fontsize=7, markerscale=4.0 / size, handletextpad=0.2)


@panel()
def survival_curves(ax: Axes, curves: Sequence[tuple[str, Curve]], t_end: float) -> None:
    """Share of runs that have not ended against time, one curve a group, with intervals for one or two groups."""
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(curves)))
    for (label, (times, *shares)), colour in zip(curves, colours, strict=True):
        t = np.append(times, t_end)
        alive, low, high = (np.append(y, y[-1]) for y in shares)
        ax.step(t, alive, where="post", color=colour, label=label)
        if len(curves) <= 2:
            ax.fill_between(t, low, high, step="post", color=colour, alpha=0.15, linewidth=0)
    ax.set(xlim=(0, t_end), ylim=(-0.02, 1.04), xlabel="time t", ylabel="share not ended")
    columns = 2 if max(len(label) for label, _ in curves) <= _SHORT else 1
    ax.figure.legend(loc="outside upper center", ncols=columns, fontsize=7, handlelength=1.2)


@panel()
def all_runs(ax: Axes, paths: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """n_stick of runs, in means over blocks of time."""
    for t, mean in paths:
        ax.plot(t, mean, color=EXACT, alpha=0.35, linewidth=0.7)
    ax.set(xlabel="time t", ylabel="$n_{stick}$")
    least, most = ax.dataLim.intervaly
    if least <= FROM_ZERO * most:  # else it would be a flat line at the top
        ax.set_ylim(0, None)


def _most_have_ended(study: Study) -> bool:
    return bool(study.data.table.own["outcome"].isin(["collapsed", "diverged"]).mean() > 0.5)


QUESTION = Question(answer, share=0.01, rank=3, leads=_most_have_ended, beside=("robustness",))
