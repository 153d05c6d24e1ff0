"""Whether t_burn is long enough, and what estimates are with others.

The start still shows if n_stick differs between the first tenth of the window and its last half: J. Geweke, in
Bayesian Statistics 4 (1992) 169-193. There the error comes from the spectrum of one series; here it is known from
systems, which are independent, by Student's t. The runs are those that estimates average: the ones in motion or,
where episodes or numbers of each run are recorded, all that reached t_end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import B, F, I, Row, S, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.motion import POINTS, RUNS, early_and_late
from stickslip.analysis.series.runs import Ended, Runs
from stickslip.analysis.series.windows import in_parts, windows
from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.enough import LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Statistic, Undefined, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.multiplicity import holm
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.style import CYCLE, GREY, panel

#: Other values of t_burn that estimates are made with: shares of the chosen one, and of the time after it.
BEFORE, AFTER = (0.0, 0.5), (0.125, 0.25, 0.5)
MOST_GROUPS, MOST_RUNS = 8, 200  # of which estimates are made again
EPISODES = "rate of episodes"
_OF_N_STICK = ("mean", "rate", "gamma")
TESTS: Mapping[str, str] = {
    "group": S, "t_burn": F, "n_systems": I, "n_runs": I, "n_members": I, "early": F, "early_low": F,
    "early_high": F, "p_value": F, "p_adjusted": F, "is_short": B, "t_enough": F, "reason": S,
}  # fmt: skip
ESTIMATES: Mapping[str, str] = {
    "group": S, "t_burn": F, "is_chosen": B, "quantity": S, "n_systems": I, "value": F, "value_low": F,
    "value_high": F, "ratio": F, "ratio_low": F, "ratio_high": F, "p_value": F,
}  # fmt: skip


def averaged(study: Study, group: Group) -> np.ndarray:
    """Rows of the runs of a group that estimates average, ascending."""
    is_of_all = study.data.episodes is not None or not study.data.recorded.keys() <= {*READ}
    return np.sort(group.rows[group.is_finished if is_of_all else group.is_moving])


def geweke(study: Study, groups: Sequence[Group]) -> list[Row]:
    """Rows of the table `burn_in`: by group the first tenth of the window less its last half, and whether that shows.

    p-values are adjusted for the number of groups by Holm's rule; a group whose runs are all at rest has none.
    `t_enough` is left open: see `estimates`.
    """
    level, rows = study.settings.confidence, list[Row]()
    for group in groups:
        members = averaged(study, group)
        if len(members) == group.n_moving:
            sums = group.by_unit("early", "late", "runs")
        else:
            early, late = study.each(_early_and_late, members).T
            sums = _by_unit(_units(study, members), early, late, np.ones(len(members)))
        rows.append({
            "group": group.label, "t_burn": study.settings.t_burn, "n_systems": len(sums), "n_runs": len(members),
            "n_members": len(group), "is_short": False, **_early(sums, level),
        })  # fmt: skip
    known = [row for row in rows if row["p_value"] is not None]
    for row, p in zip(known, holm([row["p_value"] for row in known]), strict=True):
        row |= {"p_adjusted": float(p), "is_short": bool(p < 1 - level)}
    return rows


def estimates(study: Study, groups: Sequence[Group]) -> list[Row]:
    """Rows of the table `by_t_burn`: estimates of the first runs of the first groups with several t_burn.

    The quantities are those of n_stick, or the rate of episodes where these are recorded. p_value is that of `geweke`
    for n_stick with each t_burn; ratios are to the estimate with the chosen one, paired by unit.
    """
    return [row for group in groups[:MOST_GROUPS] for row in _of_group(study, group)]


def _of_group(study: Study, group: Group) -> list[Row]:
    level, t_end = study.settings.confidence, float(group.key["t_end"])
    members = averaged(study, group)[:MOST_RUNS]
    times = _times(study.settings.t_burn, t_end)
    found = study.each(partial(_of_runs, times), members).reshape(len(members), len(times), -1)
    units, ones = _units(study, members), np.ones(len(members))
    # every unit has the same weight, however many of its runs are averaged
    sums_of: dict[float, dict[str, np.ndarray]] = {}
    for k, t_burn in enumerate(times):
        mean, rate, slipped, cascades, *_ = found[:, k].T
        sums_of[t_burn] = {
            "mean": _by_unit(units, mean, ones), "rate": _by_unit(units, rate, ones),
            "gamma": UnitSums.of(units, np.column_stack([slipped, cascades])).rows,
        }  # fmt: skip
        if study.data.episodes is not None:
            n_episodes = _episodes(study, members, t_burn)
            sums_of[t_burn] = {EPISODES: _by_unit(units, n_episodes, ones * (t_end - t_burn))}
    rows: list[Row] = []
    for k, t_burn in enumerate(times):
        test = _early(_by_unit(units, *found[:, k, 4:].T, ones), level)
        for name, sums in sums_of[t_burn].items():
            of = QUANTITIES["gamma"].of if name == "gamma" else ratio
            both = np.hstack([sums, sums_of[study.settings.t_burn][name]])
            paired = over_matrices(partial(_quotient, of), both, level)
            rows.append({
                "group": group.label, "t_burn": t_burn, "is_chosen": t_burn == study.settings.t_burn,
                "quantity": name, "n_systems": len(sums),
                **named("value", within(over_matrices(of, sums, level), 0.0)),
                **named("ratio", within(paired, 0.0)), "p_value": test["p_value"],
            })  # fmt: skip
    return rows


def _quotient(of: Statistic, both: np.ndarray) -> np.ndarray:
    """A statistic of the first two columns over that of the last two, paired by unit."""
    chosen = of(both[:, 2:])
    if (chosen == 0).any():
        raise Undefined("the estimate with the chosen t_burn is zero")
    return of(both[:, :2]) / chosen


def drawable(rows: Sequence[Row]) -> list[str]:
    """Groups of which a quantity has ratios with intervals, which are drawn."""
    return [row["group"] for row in rows if row["is_chosen"] and row["ratio_low"] is not None]


def with_enough(rows: Sequence[Row], by_t_burn: Sequence[Row], alpha: float) -> list[Row]:
    """Rows of `geweke` with `t_enough` where t_burn is too short: the first one from which on nothing is shown."""
    found: list[Row] = []
    for row in rows:
        p_values = {
            other["t_burn"]: other["p_value"]
            for other in by_t_burn
            if other["group"] == row["group"] and other["t_burn"] > row["t_burn"]
        }
        last_shown = max((t for t, p in p_values.items() if p is not None and p < alpha), default=row["t_burn"])
        later = (t for t in p_values if t > last_shown)
        found.append(row | {"t_enough": min(later, default=None) if row["is_short"] else None})
    return found


def _times(t_burn: float, t_end: float) -> tuple[float, ...]:
    """The chosen t_burn and others, ascending."""
    later = (t_burn + share * (t_end - t_burn) for share in AFTER)
    return tuple(sorted({*(share * t_burn for share in BEFORE), t_burn, *later}))


def _early(sums: np.ndarray, level: float) -> Row:
    """The difference of the first tenth from the last half with its test, from sums over units, shape (G, 3)."""
    row: Row = named("early", Estimate()) | {"p_value": None, "reason": None}
    if len(sums) < LEAST_MATRICES:
        return row | {"reason": "few matrices"}
    if (sums[:, 0] == sums[:, 1]).all():
        return row | {"early": 0.0, "reason": "at rest"}
    try:
        test = against(_difference, sums, 0.0)
    except Undefined as why:
        return row | {"reason": str(why)}
    return row | named("early", Estimate(test.difference, *test.interval(level))) | {"p_value": test.p_different}


def _difference(sums: np.ndarray) -> np.ndarray:
    return np.asarray((sums[:, 0] - sums[:, 1]) / sums[:, 2])


def _units(study: Study, members: np.ndarray) -> np.ndarray:
    return study.data.table.own["unit"].to_numpy()[members]


def _early_and_late(runs: Runs, some: Ended) -> np.ndarray:
    """`early_and_late` of each run."""
    return _of_runs((runs.t_burn,), runs, some)[:, -2:]


def _by_unit(units: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Columns averaged over the runs of each unit, shape (G, number of columns)."""
    place = np.unique(units, return_inverse=True)[1]
    return np.column_stack([np.bincount(place, column) for column in columns]) / np.bincount(place)[:, np.newaxis]


def _of_runs(t_burns: Sequence[float], runs: Runs, some: Ended) -> np.ndarray:
    """Of each run with each t_burn the sums of `_OF_N_STICK` and the means of the first tenth and the last half."""
    found, done = np.zeros((len(some), len(t_burns), 6)), 0
    for stack in in_parts(runs.stacks(some.member_id.tolist()), RUNS, POINTS):
        places = slice(done, done + len(stack))
        for k, t_burn in enumerate(t_burns):
            own = windows(stack, t_burn, some.t_end[places])
            mean, rate, gamma = (QUANTITIES[name].sums(own) for name in _OF_N_STICK)
            found[places, k] = np.column_stack([mean[:, 0], rate[:, 0], gamma, early_and_late(own)])
        done += len(stack)
    return found.reshape(len(some), -1)


def _episodes(study: Study, members: np.ndarray, t_burn: float) -> np.ndarray:
    """Number of episodes of some members that begin at t_burn or later."""
    episodes = study.data.episodes
    assert episodes is not None
    late = episodes.loc[episodes["start"] >= t_burn, "member_id"].value_counts()
    return late.reindex(study.data.table.own["member_id"].iloc[members], fill_value=0).to_numpy(np.float64)


@panel()
def by_t_burn(ax: Axes, rows: Sequence[Row], t_burn: float) -> None:
    """Ratios of the estimates of one group to those with the chosen t_burn, with their intervals."""
    ax.axhline(1.0, color=GREY, linewidth=0.8)
    ax.axvline(t_burn, color=GREY, linewidth=0.8, linestyle="--")
    for k, name in enumerate(dict.fromkeys(row["quantity"] for row in rows)):
        own = [row for row in rows if row["quantity"] == name and row["ratio_low"] is not None]
        if not own:
            continue
        columns = ("t_burn", "ratio", "ratio_low", "ratio_high")
        t, value, low, high = np.array([[row[key] for key in columns] for row in own]).T
        bars = np.where(t == t_burn, np.nan, [value - low, high - value])  # the chosen one has ratio 1 to itself
        label = name if name == EPISODES else QUANTITIES[name].title
        t = t + 0.01 * k * np.ptp(t)  # beside each other
        ax.errorbar(t, value, yerr=bars, fmt="o-", color=CYCLE[k], markersize=3, linewidth=0.8, label=label)
    ax.set(xlabel="$t_{burn}$", ylabel="ratio to the estimate\nwith the chosen $t_{burn}$")
    ax.figure.legend(loc="outside upper left", ncols=1)
