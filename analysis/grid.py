"""The grid of a sweep: its axes, the point of each group, and statistics over some of the points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stickslip.analysis.by_key import by_key
from stickslip.analysis.contrast import Statistic
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.place import Place, told_apart
from stickslip.analysis.groups import Group
from stickslip.analysis.measures import MOTION, Measure, Values, measures
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS
from stickslip.analysis.models.fates import FAILED, WATCHED
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums
from stickslip.pipeline.design.design import Axis
from stickslip.pipeline.design.design import Row as KeyValues
from stickslip.pipeline.design.labels import Label, labels
from stickslip.pipeline.design.values import Rank, Value, ranks

#: What the name of a setting says, beside its method.
FIXED = ("n", "coupling", "file", "back_slip", "t_end", "perturbation_size")
#: The order of keys on pages, in which parameters come first.
_PLACE = {name.removesuffix("0"): k for k, name in enumerate(SYSTEM_KEYS)}


@dataclass
class Point:
    """A group on the grid: its value on each axis, its runs by fate, and its values by measure."""

    group: Group
    place: dict[Axis, KeyValues]
    fates: dict[str, int]
    measured: dict[str, Values]

    @classmethod
    def of(cls, group: Group, axes: Sequence[Axis], asked: Sequence[Measure]) -> Point:
        """The point of a group, with what its runs give, whether they stick late too."""
        fates = {name: int((group.fates == name).sum()) for name in (*WATCHED, FAILED)}
        values = {measure.name: measure.of(group) for measure in (*asked, MOTION)}
        swept = group.table.design.swept(group.point)
        place = {axis: tuple(swept[key] for key in axis.keys) for axis in axes}
        return cls(group, place, fates, values)

    def sums(self, name: str) -> UnitSums:
        """The sums of a measure, without units in which nothing was counted."""
        return self.measured[name].sums.counted

    def rank(self) -> list[list[Rank]]:
        """Sorts points along the axes, in the order of their values."""
        return [*map(ranks, self.place.values())]


def settings(groups: Iterable[Group]) -> dict[Label, list[Group]]:
    """Groups that differ only in keys that are swept, by the name of what they share."""
    by_source = by_key(groups, lambda group: (group.point.source, group.setting["method"]))
    keys = [{name: groups[0].key[name] for name in (*FIXED, *ENGINE_KEYS)} for groups in by_source.values()]
    return dict(zip(labels(keys), by_source.values(), strict=True))


def axes_of(groups: Sequence[Group]) -> list[Axis]:
    """The axes of a sweep along which some groups differ, the longest first; rows are in the order of pages."""
    axes = []
    for k, axis in enumerate(groups[0].table.design.axes):
        rows = {group.point.at[k] for group in groups}
        if len(rows) > 1:
            axes.append(Axis(axis.keys, tuple(sorted(rows, key=ranks))))
    return sorted(axes, key=lambda axis: (-len(axis.rows), _PLACE.get(axis.keys[0], -1)))


def estimate(statistic: Statistic, points: Iterable[Point], confidence: float) -> Estimate:
    """A statistic over some points of a grid, taken together."""
    return statistic.estimate(UnitSums.together(point.sums(statistic.name) for point in points), confidence)


def is_negative(*values: Value) -> bool:
    """Whether all values are negative numbers, which are said by their size: a belt's speed is how fast it is."""
    return all(isinstance(value, float) and value < 0.0 for value in values)


def points_at(points: Iterable[Point], axis: Axis, value: KeyValues) -> list[Point]:
    """The points at one value of an axis."""
    return [point for point in points if point.place[axis] == value]


@dataclass(frozen=True)
class Sweep:
    """What a sweep has: its axes, the points of each setting along them, and what is measured there.

    Attributes
    ----------
    asked : list of Measure
        In the order in which they lead.
    points : dict of Label to list of Point
        By setting, in the order of the values of the axes.
    """

    axes: list[Axis]
    asked: list[Measure]
    points: dict[Label, list[Point]]
    confidence: float

    @classmethod
    def of(cls, study: Study) -> Sweep:
        """That of a study."""
        axes, measured = axes_of(study.groups), measures(study)
        points = {
            name: sorted((Point.of(group, axes, measured) for group in groups), key=Point.rank)
            for name, groups in settings(study.groups).items()
        }
        return cls(axes, measured, points, study.settings.confidence)

    @property
    def every(self) -> list[Point]:
        """The points of all settings."""
        return [point for points in self.points.values() for point in points]

    @cached_property
    def settings(self) -> list[Label]:
        """The settings, the one with the most finished runs first: it leads."""
        lead = max(
            self.points, key=lambda name: sum(int(point.group.is_finished.sum()) for point in self.points[name])
        )
        return sorted(self.points, key=lambda name: name != lead)

    def along(self, measure: Measure, points: Sequence[Point], axis: Axis) -> list[Estimate]:
        """A measure at each value of an axis, over those of some points that lie there."""
        return [estimate(measure.statistic, points_at(points, axis, row), self.confidence) for row in axis.rows]

    @cached_property
    def where(self) -> dict[str, Place]:
        """What tells each setting from the others."""
        return told_apart([*self.points])


def balanced(sums: Sequence[UnitSums]) -> tuple[list[int], UnitSums]:
    """Of several sums over units, by number, and of their units those such that all that are left have all.

    What lacks most is left out first, be it sums or a unit: a unit that lacks some would differ from others by what
    these are like. If too few units are left all count, with their gaps.
    """
    units = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(unit_sums.units for unit_sums in sums)]))
    has = np.array([np.isin(units, unit_sums.units) for unit_sums in sums]).reshape(len(sums), len(units))
    rows, columns = np.arange(len(sums)), np.arange(len(units))
    while not (is_known := has[np.ix_(rows, columns)]).all():
        of_row, of_column = is_known.mean(axis=1), is_known.mean(axis=0)
        if of_row.min() <= of_column.min():
            rows = np.delete(rows, of_row.argmin())
        else:
            columns = np.delete(columns, of_column.argmin())
    if len(columns) * bool(len(rows)) < min(len(units), enough.LEAST_MATRICES):
        rows, columns = np.arange(len(sums)), np.arange(len(units))
    return rows.tolist(), UnitSums(units[columns], np.zeros((len(columns), 2)))
