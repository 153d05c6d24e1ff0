"""Where along a key several things attract one system, and where attraction ends. Part of `fates`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple, TypeVar

import numpy as np

from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Attracting, Basis, Bound, Level, Quantity
from stickslip.analysis.findings.numbers import to_error
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import bound_in_words, listed
from stickslip.analysis.models.attractors import IRREGULAR, PERIODIC, REST, SLIDING, TORUS
from stickslip.analysis.models.fates import is_unstable
from stickslip.analysis.questions.runs.settled import Grid, Setting
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.design import axis_of_numbers, in_words
from stickslip.sim.numerics.arguments import Floats

T = TypeVar("T")
_STICK_SLIP = "stick-slip"
_NOUNS = {REST: "rest", SLIDING: "steady sliding", **dict.fromkeys((PERIODIC, TORUS, IRREGULAR), _STICK_SLIP)}
_MOVES = 0.5  # of the largest amplitude: a block that moves less is not named
_MOST_NAMED = 4


class Stability(NamedTuple):
    """The linear stability of steady sliding at a setting: medians over systems; blocks of one system."""

    setting: str
    n_stable: int
    n_systems: int
    growth_rate: float
    frequency: float
    blocks: str


class Boundary(NamedTuple):
    """An end of attraction beside a setting, between `low` and `high`, and how it was found."""

    setting: str
    key: str
    what: str
    value: float
    low: float
    high: float
    found_by: str


class Stop(NamedTuple):
    """Where a motion or steady sliding ends, within an error on either side, and how that is known."""

    value: float
    error: float
    by: Bound

    def __str__(self) -> str:
        """With as many digits as its error leaves."""
        return to_error(self.value, self.error)


class _Limit(NamedTuple):
    """An end of a stretch in words, how it is known, and as a number where it was refined."""

    words: str
    by: Bound
    stop: Stop | None = None


def stability(study: Study, grid: Grid) -> list[Stability]:
    """Of each setting of which the critical mode is recorded."""
    if "critical_rate" not in study.data.recorded:
        return []
    members, shapes = study.data.table.own, study.data.lists["critical_shape"]
    rows = []
    for setting in grid.settings:
        of_system = np.unique(members["matrix"].to_numpy()[setting.runs.rows], return_index=True)[1]
        systems = setting.runs.rows[of_system]
        rates, frequencies = (study.number(f"critical_{name}")[systems] for name in ("rate", "frequency"))
        if np.isnan(rates).all():
            continue
        n_stable = int(np.sum(~np.isnan(rates) & ~np.asarray(is_unstable(rates))))
        shape = shapes.get(str(members["member_id"].iloc[systems[0]])) if len(systems) == 1 else None
        rate, frequency = (float(np.nanmedian(numbers)) for numbers in (rates, frequencies))
        rows.append(
            Stability(
                str(setting.where), n_stable, len(systems), rate, frequency, _blocks(shape, study.settings.names)
            )
        )
    return rows


def _blocks(shape: Floats | None, names: Sequence[str]) -> str:
    """The blocks that move most in a mode, by name if they have names."""
    if shape is None:
        return ""
    order = [int(block) for block in np.argsort(-shape, kind="stable") if shape[block] >= _MOVES]
    moving = [names[block] if names else str(block) for block in order]
    if len(moving) == len(shape) > 1:
        return "all"
    return listed(moving[:_MOST_NAMED]) + f" and {len(moving) - _MOST_NAMED} more" * (len(moving) > _MOST_NAMED)


def boundaries(study: Study, grid: Grid) -> list[Boundary]:
    """All ends that were refined, of each setting the outermost; of several systems those of the median."""
    rows = []
    for line in _lines(study, grid):
        for setting in line.settings:
            for what, stops, place in (
                ("steady sliding changes its stability", line.crossings(setting), -1),
                ("stick-slip ends below", line.stops(setting, "below"), 0),
                ("stick-slip ends above", line.stops(setting, "above"), -1),
            ):
                if stops:
                    stop = sorted(stops)[place if setting.of_starts else len(stops) // 2]
                    ends = stop.value, stop.value - stop.error, stop.value + stop.error
                    by = bound_in_words(stop.by, study.settings.at(setting.t_end))
                    rows.append(Boundary(str(setting.where), line.key, what, *ends, by))
    return rows


def is_asked(study: Study) -> bool:
    """Whether it is asked where along a key what attracts: ends or stability are recorded, beside attractors."""
    is_recorded = bool({"critical_rate", "stability_changes"} & {*study.data.recorded})
    along = axis_of_numbers(study.data.table.design.axes)
    return is_recorded and along is not None and "attractor" in study.data.table.own


def attracting(study: Study, grid: Grid) -> tuple[list[Attracting], list[Attracting]]:
    """Stretches along the first key at which several things attract one system; and if asked, those of each."""
    several: list[Attracting] = []
    each: list[Attracting] = []
    for line in _lines(study, grid):
        if any(len({*study.data.table.own["matrix"].iloc[setting.runs.rows]}) > 1 for setting in line.settings):
            continue
        at_settings = line.nouns()
        several += [line.between(nouns, *ends) for nouns, *ends in _stretches(at_settings) if len(nouns) > 1]
        in_order = dict.fromkeys(noun for nouns in reversed(at_settings) for noun in reversed(nouns))
        for noun in in_order if is_asked(study) else ():
            attracts = _stretches([noun in nouns for nouns in at_settings])
            each += [line.between((noun,), *ends) for is_there, *ends in attracts if is_there]
    return several, each


class _Line(NamedTuple):
    """Settings along the first key, at one value of each other."""

    study: Study
    key: str
    where: Place
    settings: Sequence[Setting]
    is_refined: bool

    def crossings(self, setting: Setting) -> list[Stop]:
        """Where steady sliding changes its stability above a setting, of each run in which it does."""
        return [Stop(x, 0.0, Bound.STABILITY) for x in self._numbers("stability_changes", setting) if not np.isnan(x)]

    def stops(self, setting: Setting, side: str) -> list[Stop]:
        """Where the stick-slip of a setting ends on one side of it, of each run in which it does."""
        name, members = f"motion_ends_{side}", self.study.data.table.own
        values, errors = self._numbers(name, setting), self._numbers(f"{name}_error", setting)
        rows = setting.runs.rows
        causes = members[f"{name}_cause"].iloc[rows] if f"{name}_cause" in members else [Bound.RUNS.name] * len(rows)
        return [
            Stop(value, error, Bound[cause.upper()])
            for value, error, cause in zip(values.tolist(), errors.tolist(), causes, strict=True)
            if not np.isnan(value)
        ]

    def _numbers(self, name: str, setting: Setting) -> Floats:
        """What was refined beside a setting, of each run; without a value if that was not recorded."""
        is_recorded = self.is_refined and name in self.study.data.recorded
        return self.study.number(name)[setting.runs.rows] if is_recorded else np.full(len(setting.runs.rows), np.nan)

    def is_stable(self, setting: Setting) -> bool | None:
        """Whether steady sliding is linearly stable; None where that is not recorded."""
        if "critical_rate" not in self.study.data.recorded:
            return None
        rates = self.study.number("critical_rate")[setting.runs.rows]
        return None if np.isnan(rates).any() else not np.asarray(is_unstable(rates)).any()

    def nouns(self) -> list[tuple[str, ...]]:
        """What attracts at each setting: what runs settle on, steady sliding that is stable, stick-slip that lasts.

        The last is followed there from a setting beside it, and need not be what runs there settle on.
        """
        kinds = [{_NOUNS[kind] for kind, _ in setting.kinds if kind in _NOUNS} for setting in self.settings]
        for k, setting in enumerate(self.settings):
            kinds[k] |= {_NOUNS[SLIDING]} if self.is_stable(setting) else set()
            for beyond, side in ((k - 1, "below"), (k + 1, "above")):
                n_lasting = self._n_followed(setting) - len(self.stops(setting, side))
                if self.is_refined and 0 <= beyond < len(kinds) and n_lasting > 0:
                    kinds[beyond].add(_STICK_SLIP)
        return [tuple(noun for noun in dict.fromkeys(_NOUNS.values()) if noun in names) for names in kinds]

    def _n_followed(self, setting: Setting) -> int:
        """How many runs of a setting stick and slip for good, each of which is followed."""
        moving = [kind for kind, noun in _NOUNS.items() if noun == _STICK_SLIP]
        return int(np.isin(setting.runs.kinds, moving).sum())

    def between(self, nouns: tuple[str, ...], first: int, last: int) -> Attracting:
        """What attracts from one setting to another, by their places."""
        settings = self.settings[first : last + 1]
        horizon = self.study.settings.at(settings[0].t_end)
        basis = Basis(sum(len(setting.runs.rows) for setting in settings), "run")
        low, high = self._end(nouns, first, -1), self._end(nouns, last, 1)
        levels = [
            self._level(nouns, verb, end.stop, horizon, basis)
            for verb, end in (("begins", low), ("ceases", high))
            if end.stop is not None and len(nouns) == 1
        ]
        stretch = low.words, high.words, low.by, high.by
        return Attracting(nouns, self.key, *stretch, self.where, basis, horizon, tuple(levels))

    def _level(self, nouns: tuple[str, ...], verb: str, stop: Stop, horizon: str, basis: Basis) -> Level:
        """An end as a value, between the two that it lies between."""
        quantity = Quantity("attraction_end", f"{self.key} at which {listed(nouns)} {verb} to attract")
        ends = (stop.value - stop.error, stop.value + stop.error) if stop.error > 0.0 else (None, None)
        where = self.where + Place.words(f"by {bound_in_words(stop.by, horizon)}")
        return Level(quantity, Estimate(stop.value, *ends), where, basis=basis)

    def _end(self, nouns: tuple[str, ...], k: int, step: int) -> _Limit:
        """Where a stretch ends beyond the k-th setting: the nearest end that was refined, or that setting."""
        setting, beyond = self.settings[k], k + step
        value = in_words(setting.at[0])
        if not self.is_refined or not 0 <= beyond < len(self.settings):
            return _Limit(value, Bound.SETTING)
        there = self.settings[beyond]
        stops: list[Stop] = []
        if self.is_stable(there) is False and _NOUNS[SLIDING] in nouns:
            stops += self.crossings(self.settings[min(k, beyond)])[:1]
        ends = self.stops(setting, "above" if step > 0 else "below")
        if _STICK_SLIP in nouns and ends and len(ends) == self._n_followed(setting):
            stops.append(max(ends) if step > 0 else min(ends))
        if stops:
            nearest = min(stops) if step > 0 else max(stops)
            return _Limit(str(nearest), nearest.by, nearest)
        is_open = _STICK_SLIP in nouns and self._n_followed(setting) == 0
        return _Limit(value, Bound.FOLLOWED if is_open else Bound.SETTING)


def _lines(study: Study, grid: Grid) -> Iterator[_Line]:
    """`Grid.recorded_lines`, each with where it is, and whether its ends were refined."""
    refined = axis_of_numbers(study.data.table.design.axes)
    for line in grid.recorded_lines:
        axis, where = grid.axes[0], grid.beside(line[0]) + Place.of(line[0].method)
        is_refined = "stability_changes" in study.data.recorded and refined is not None and refined.keys == axis.keys
        yield _Line(study, axis.name, where, line, is_refined)


def _stretches(values: Sequence[T]) -> Iterator[tuple[T, int, int]]:
    """Equal values that follow on each other, with the places of the first and the last."""
    for value, group in groupby(range(len(values)), values.__getitem__):
        places = [*group]
        yield value, places[0], places[-1]
