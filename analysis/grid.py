"""The grid of a sweep: its axes, the point of each group, and statistics over some of the points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stickslip.analysis.answer import F, S
from stickslip.analysis.contrast import Sample, Statistic
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import FIXED, Group, Order, Value, by_value, labels, short
from stickslip.analysis.measures import GAMMA, MEAN, Measure, Values, of_gamma, of_mean
from stickslip.analysis.members import ENGINE_KEYS
from stickslip.analysis.models.fates import FAILED, MOVING, QUIET, WATCHED, bounded_share
from stickslip.analysis.stats.estimates import Estimate, UnitSums

IN_MOTION = "share in motion"
MOST_SETTINGS = 3  # that have pictures of their own
AT_MOST = "share in motion or quiet"  # whether a quiet run is in motion cannot be told


@dataclass(frozen=True)
class Axis:
    """Keys that change together, as a scene names them, and their values in ascending order."""

    keys: tuple[str, ...]
    values: tuple[tuple[Value, ...], ...]

    @property
    def name(self) -> str:
        return " with ".join(self.keys)

    @property
    def x(self) -> list[float] | None:
        """The values as numbers; None where one is a distribution."""
        found = [value[0] for value in self.values]
        return [one for one in found if isinstance(one, float)] if all(isinstance(v, float) for v in found) else None

    @property
    def texts(self) -> list[str]:
        """The values in words."""
        return [as_text(value) for value in self.values]

    def place(self, value: tuple[Value, ...]) -> int:
        """The place of a value among them."""
        return self.values.index(value)

    def dtype(self, k: int) -> str:
        """Type of a column of the values of its k-th key: numbers, or texts where one is a distribution."""
        return F if all(isinstance(value[k], float) for value in self.values) else S


@dataclass
class Point:
    """A group on the grid: its value on each axis, the sums of its units, its runs by fate, its values by measure."""

    group: Group
    at: dict[Axis, tuple[Value, ...]]
    sample: Sample = field(default_factory=Sample)
    fates: dict[str, int] = field(default_factory=dict)
    values: dict[str, Values] = field(default_factory=dict)

    def rank(self) -> list[list[Order]]:
        """Sorts points along the axes, in the order of their values."""
        return [order(value) for value in self.at.values()]


def settings(groups: Iterable[Group]) -> dict[str, list[Group]]:
    """Groups that differ only in keys that may be swept, by the name of what they share."""
    found: dict[tuple[Any, ...], list[Group]] = {}
    for group in groups:
        found.setdefault(tuple(group.key[name] for name in (*FIXED, *ENGINE_KEYS)), []).append(group)
    keys = [dict(zip((*FIXED, *ENGINE_KEYS), values, strict=True)) for values in found]
    return dict(zip(labels(keys), found.values(), strict=True))


def axes_of(found: Mapping[str, Sequence[Group]]) -> list[Axis]:
    """The axes of a sweep, the longest first; keys whose values change together share an axis."""
    by_setting = [[group.at for group in some] for some in found.values()]
    points = [point for some in by_setting for point in some]
    keys = [key for key in dict.fromkeys(key for point in points for key in point)
            if any(len({point.get(key) for point in some}) > 1 for some in by_setting)]  # fmt: skip
    keys = [key for key in keys if all(key in point for point in points)]
    if all(point.get("w") == point.get("belt_speed") for point in points):
        keys = [key for key in keys if key != "w"]  # all start on the belt
    together: list[list[str]] = []
    for key in keys:
        n_values = len({point[key] for point in points})
        for some in together:
            pairs = {(point[some[0]], point[key]) for point in points}
            if len(pairs) == n_values == len({first for first, _ in pairs}):
                some.append(key)
                break
        else:
            together.append([key])
    axes = [Axis(tuple(some), tuple(sorted({tuple(point[key] for key in some) for point in points}, key=order)))
            for some in together]  # fmt: skip
    return sorted(axes, key=lambda axis: -len(axis.values))


def place_of(axes: Sequence[Axis], group: Group) -> dict[Axis, tuple[Value, ...]]:
    """The value of a group on each axis."""
    own = group.at
    return {axis: tuple(own[key] for key in axis.keys) for axis in axes}


def as_text(value: Sequence[Value]) -> str:
    """A value of an axis as text."""
    return " with ".join(one if isinstance(one, str) else short(one) for one in value)


def order(value: Sequence[Value]) -> list[Order]:
    """Sorts values: numbers before distributions."""
    return [by_value(one) for one in value]


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


def points_at(points: Iterable[Point], axis: Axis, value: tuple[Value, ...]) -> list[Point]:
    """The points at one value of an axis."""
    return [point for point in points if point.at[axis] == value]
