"""Whether t_burn is long enough.

The start still shows if n_stick differs between the first tenth of the window and its last half: J. Geweke, in
Bayesian Statistics 4 (1992) 169-193. There the error comes from the spectrum of one series; here it is known from
systems, which are independent, by Student's t. The runs are those that estimates average: the ones in motion or,
where episodes or numbers of each run are recorded, all that reached t_end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.motion import POINTS, RUNS, early_and_late
from stickslip.analysis.series.runs import Ended, Runs
from stickslip.analysis.series.windows import in_parts, windows
from stickslip.analysis.stats.compare import against
from stickslip.analysis.stats.enough import LEAST_MATRICES
from stickslip.analysis.stats.estimates import Estimate, Undefined
from stickslip.analysis.stats.multiplicity import together


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
            sums = group.by_unit("early", "late", "runs")
        else:
            sums = _by_unit(study, members, study.each(_of_runs, members))
        early, p, reason = _early(sums, level)
        rows.append(
            Tested(
                group.label, study.settings.t_burn, len(sums), len(members), len(group), early, p, None, False, reason
            )
        )
    adjusted = zip(rows, together(row.p_value for row in rows), strict=True)
    return [row._replace(p_adjusted=p, is_short=p is not None and p < 1 - level) for row, p in adjusted]


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


def _difference(sums: np.ndarray) -> np.ndarray:
    return np.asarray((sums[:, 0] - sums[:, 1]) / sums[:, 2])


def _by_unit(study: Study, members: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns of members averaged over the runs of each unit, and 1: every unit has the same weight."""
    units = study.data.table.own["unit"].to_numpy()[members]
    place = np.unique(units, return_inverse=True)[1]
    sums = [np.bincount(place, column) for column in (*columns.T, np.ones(len(members)))]
    return np.column_stack(sums) / np.bincount(place)[:, np.newaxis]


def _of_runs(runs: Runs, ended: Ended) -> np.ndarray:
    """Mean n_stick of each run in the first tenth of its window and in its last half."""
    means, n_done = np.zeros((len(ended), 2)), 0
    for stack in in_parts(runs.stacks(ended.member_id.tolist()), RUNS, POINTS):
        places = slice(n_done, n_done + len(stack))
        means[places] = early_and_late(windows(stack, runs.t_burn, ended.t_end[places]))
        n_done += len(stack)
    return means
