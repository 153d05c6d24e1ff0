"""Whether t_burn is long enough, and what the mean is with others.

The start still shows if n_stick differs between the first tenth of the window and its last half: J. Geweke, in
Bayesian Statistics 4 (1992) 169-193. There the error comes from the spectrum of one series; here it is known from
systems, which are independent, by Student's t. Under a harmonic force both parts are whole periods of it. The runs
are those that estimates average: the ones in motion or, where episodes or numbers of each run are recorded, all that
reached t_end. A difference that moves the mean by less than the digits of its interval show is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.motion import POINTS, RUNS, TENTH, early_and_late
from stickslip.analysis.series.runs import Ended, Runs
from stickslip.analysis.series.windows import in_parts, windows
from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.enough import LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio, with_ends, within
from stickslip.analysis.stats.multiplicity import together
from stickslip.analysis.style import EXACT, GREY, bars, panel

#: Other values of t_burn that estimates are made with: shares of the chosen one, and of the time after it.
BEFORE, AFTER = (0.0, 0.5), (0.125, 0.25, 0.5)
#: The least shift of the mean that its digits show, in half-widths of its interval.
SHOWS, UNSEEN = 0.05, "less than the mean's digits show"
MOST_RUNS = 200  # of which estimates are made again
MEAN = "mean number of sticking blocks"


class Tested(NamedTuple):
    """A row of the table `burn_in`: the first tenth of the window less its last half, and whether that shows."""

    group: str
    t_burn: float
    n_systems: int
    n_runs: int
    n_members: int
    early: Estimate
    p_value: float | None
    p_adjusted: float | None
    is_short: bool
    reason: str


class AtBurn(NamedTuple):
    """A row of the table `by_t_burn`: an estimate with one t_burn; `p_value` is that of `geweke` with it."""

    group: str
    t_burn: float
    is_chosen: bool
    quantity: str
    n_systems: int
    value: Estimate
    p_value: float | None


def averaged(study: Study, group: Group) -> np.ndarray:
    """Rows of the runs of a group that estimates average, ascending."""
    is_of_all = study.data.episodes is not None or not study.data.recorded.keys() <= {*READ}
    return np.sort(group.rows[group.is_finished if is_of_all else group.is_moving])


def geweke(study: Study, groups: Sequence[Group]) -> list[Tested]:
    """Whether the start shows, by group.

    p-values are adjusted for the number of groups by Holm's rule; a group whose runs are all at rest has none.
    """
    level, rows = study.settings.confidence, list[Tested]()
    for group in groups:
        members = averaged(study, group)
        if len(members) == group.n_moving:
            sums, mean = group.by_unit("early", "late", "runs"), group.mean(level)
        else:
            means = study.each(partial(_of_runs, (study.settings.t_burn,)), members)
            sums = _by_unit(study, members, means[:, 1:])
            mean = over_matrices(ratio, _by_unit(study, members, means[:, :1]), level)
        early, p, reason = _early(sums, level)
        is_seen = p is not None and _shows(early, mean)
        if p is not None and not is_seen:
            reason = UNSEEN
        numbers = study.settings.t_burn, len(sums), len(members), len(group)
        rows.append(Tested(group.label, *numbers, early, p, None, is_seen, reason))
    adjusted = zip(rows, together(row.p_value for row in rows), strict=True)
    return [
        row._replace(p_adjusted=p, is_short=row.is_short and p is not None and p < 1 - level) for row, p in adjusted
    ]


def estimates(study: Study, group: Group) -> list[AtBurn]:
    """Mean n_stick of the first runs of a group with several t_burn."""
    level, t_burn, t_end = study.settings.confidence, study.settings.t_burn, float(group.key["t_end"])
    members = averaged(study, group)[:MOST_RUNS]
    later = (t_burn + share * (t_end - t_burn) for share in AFTER)
    times = tuple(sorted({*(share * t_burn for share in BEFORE), t_burn, *later}))
    means = study.each(partial(_of_runs, times), members).reshape(len(members), len(times), 3)
    rows = []
    for k, time in enumerate(times):
        _, p_value, _ = _early(_by_unit(study, members, means[:, k, 1:]), level)
        sums = _by_unit(study, members, means[:, k, :1])
        value = within(over_matrices(ratio, sums, level), 0.0)
        rows.append(AtBurn(group.label, time, time == t_burn, MEAN, len(sums), value, p_value))
    return rows


def _early(sums: np.ndarray, level: float) -> tuple[Estimate, float | None, str]:
    """The difference of the first tenth from the last half, its p-value, or why there is none.

    From sums over units, shape (G, 3).
    """
    if len(sums) < LEAST_MATRICES:
        return Estimate(), None, "few matrices"
    if (sums[:, 0] == sums[:, 1]).all():
        return Estimate(0.0), None, "at rest"
    try:
        test = against(_difference, sums)
    except Undefined as why:
        return Estimate(), None, str(why)
    return Estimate(test.difference, *test.interval(level)), test.p_different, ""


def _shows(early: Estimate, mean: Estimate) -> bool:
    """Whether the difference of the first tenth moves the mean by what its digits show, if it has an interval."""
    if early.value is None or mean.low is None or mean.high is None:
        return True
    return TENTH * abs(early.value) >= SHOWS * (mean.high - mean.low) / 2


def _difference(sums: np.ndarray) -> np.ndarray:
    return np.asarray((sums[:, 0] - sums[:, 1]) / sums[:, 2])


def _by_unit(study: Study, members: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns of members averaged over the runs of each unit, and 1: every unit has the same weight."""
    units = study.data.table.own["unit"].to_numpy()[members]
    place = np.unique(units, return_inverse=True)[1]
    sums = [np.bincount(place, column) for column in (*columns.T, np.ones(len(members)))]
    return np.column_stack(sums) / np.bincount(place)[:, np.newaxis]


def _of_runs(t_burns: Sequence[float], runs: Runs, ended: Ended) -> np.ndarray:
    """Mean n_stick of each run with each t_burn, and the means of the first tenth and the last half."""
    means, n_done = np.zeros((len(ended), len(t_burns), 3)), 0
    for stack in in_parts(runs.stacks(ended.member_id.tolist()), RUNS, POINTS):
        places = slice(n_done, n_done + len(stack))
        for k, t_burn in enumerate(t_burns):
            window = windows(stack, t_burn, ended.t_end[places])
            means[places, k] = np.column_stack([window.mean, early_and_late(window, ended.period[places])])
        n_done += len(stack)
    return means.reshape(len(ended), -1)


@panel()
def by_t_burn(ax: Axes, rows: Sequence[AtBurn], t_burn: float) -> None:
    """The estimates of one group with several t_burn, with their intervals; the chosen one is dashed."""
    ax.axvline(t_burn, color=GREY, linewidth=0.8, linestyle="--")
    t = [row.t_burn for row in rows]
    bars(ax, t, with_ends(row.value for row in rows), fmt="o-", color=EXACT, markersize=3, linewidth=0.8)
    ax.set(xlabel="$t_{burn}$", ylabel=rows[0].quantity)
