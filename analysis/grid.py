"""The grid of a sweep: its axes, the point of each group, and statistics over some of the points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from stickslip.analysis.answer import F, S
from stickslip.analysis.contrast import Sample, Statistic
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import GAMMA, MEAN, Measure, Values, of_gamma, of_mean
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET, WATCHED, bounded_share
from stickslip.analysis.stats.estimates import Estimate, UnitSums
from stickslip.pipeline.design.design import Axis, Row
from stickslip.pipeline.design.labels import Label, labels
from stickslip.pipeline.design.values import Rank, ranks

#: What the name of a setting says, beside its method.
FIXED = ("n", "coupling", "file", "back_slip", "t_end", "perturbation_size")
#: The order of keys on pages, in which parameters come first.
_PLACE = {name.removesuffix("0"): k for k, name in enumerate(SYSTEM_KEYS)}
IN_MOTION = "share in motion"
MOST_SETTINGS = 3  # that have pictures of their own
AT_MOST = "share in motion or quiet"  # whether a quiet run is in motion cannot be told


@dataclass
class Point:
    """A group on the grid: its value on each axis, the sums of its units, its runs by fate, its values by measure."""

    group: Group
    at: dict[Axis, Row]
    sample: Sample = field(default_factory=Sample)
    fates: dict[str, int] = field(default_factory=dict)
    values: dict[str, Values] = field(default_factory=dict)

    def rank(self) -> list[list[Rank]]:
        """Sorts points along the axes, in the order of their values."""
        return [*map(ranks, self.at.values())]


def settings(groups: Iterable[Group]) -> dict[Label, list[Group]]:
    """Groups that differ only in keys that are swept, by the name of what they share."""
    found: dict[tuple[int, int], list[Group]] = {}
    for group in groups:
        found.setdefault((group.point.source, group.setting["method"]), []).append(group)
    keys = [{name: some[0].key[name] for name in (*FIXED, *ENGINE_KEYS)} for some in found.values()]
    return dict(zip(labels(keys), found.values(), strict=True))


def axes_of(groups: Sequence[Group]) -> list[Axis]:
    """The axes of a sweep along which some groups differ, the longest first; rows are in the order of pages."""
    found = []
    for k, axis in enumerate(groups[0].table.design.axes):
        rows = {group.point.at[k] for group in groups}
        if len(rows) > 1:
            found.append(Axis(axis.keys, tuple(sorted(rows, key=ranks))))
    return sorted(found, key=lambda axis: (-len(axis.rows), _PLACE.get(axis.keys[0], -1)))


def place_of(axes: Sequence[Axis], group: Group) -> dict[Axis, Row]:
    """The row of a group on each axis."""
    swept = group.table.design.swept(group.point)
    return {axis: tuple(swept[key] for key in axis.keys) for axis in axes}


def dtype(axis: Axis, k: int) -> str:
    """Type of a column of the values of an axis' k-th key: numbers, or texts where one is something else."""
    return F if all(isinstance(row[k], float) for row in axis.rows) else S


def point_of(study: Study, group: Group, axes: Sequence[Axis], of: Iterable[Measure] = ()) -> Point:
    """The point of a group, with what its runs give, measured by `of` too."""
    found = Point(
        group, place_of(axes, group), fates={name: int((group.fates == name).sum()) for name in (*WATCHED, FAILED)}
    )
    ran = group.fates != FAILED
    units, fates = group.column("unit").to_numpy()[ran], group.fates[ran]
    for name, has in ((IN_MOTION, MOVING), (AT_MOST, (*MOVING, QUIET))):
        found.sample.sums[name] = UnitSums.of(units, np.column_stack([np.isin(fates, has), np.ones(len(fates))]))
    found.values |= {one.name: one.of(group) for one in of}
    n_stick = {MEAN: of_mean(group), GAMMA: of_gamma(study.settings.confidence, group)}
    found.sample.sums.update({name: values.sums for name, values in (n_stick | found.values).items()})
    return found


def estimate(of: Statistic, points: Iterable[Point], confidence: float) -> Estimate:
    """A statistic over some points of a grid, taken together."""
    some = list(points)
    sums = UnitSums.together(point.sample.of(of.name) for point in some)
    if of.name == IN_MOTION and len(sums):
        rows, at_most = sums.rows, UnitSums.together(point.sample.of(AT_MOST) for point in some).rows[:, 0]
        return bounded_share(np.column_stack([rows[:, 0], at_most - rows[:, 0], rows[:, 1]]), confidence)
    return of.estimate(sums, confidence)


def points_at(points: Iterable[Point], axis: Axis, value: Row) -> list[Point]:
    """The points at one value of an axis."""
    return [point for point in points if point.at[axis] == value]
