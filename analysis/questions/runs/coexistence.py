"""Where along a key several things attract one system, and where attraction ends. Part of `fates`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple, TypeVar

import numpy as np

from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Attracting, Bound
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.models.attractors import IRREGULAR, PERIODIC, REST, SLIDING, TORUS
from stickslip.analysis.models.fates import is_unstable
from stickslip.analysis.questions.runs.settled import Grid, Setting
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
    """An end of attraction beside a setting, and how it was found."""

    setting: str
    key: str
    what: str
    value: float
    found_by: str


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
    """All ends that were refined, of each setting the outermost; of several systems their medians."""
    rows = []
    for line in _lines(study, grid):
        for setting in line.settings:
            for what, name, of in (
                ("steady sliding changes its stability", "stability_changes", np.nanmedian),
                ("stick-slip ends below", "motion_ends_below", np.nanmin),
                ("stick-slip ends above", "motion_ends_above", np.nanmax),
            ):
                if not np.isnan(numbers := line.numbers(name, setting)).all():
                    by = Bound.STABILITY if name == "stability_changes" else Bound.RUNS
                    value = float(of(numbers) if setting.of_starts else np.nanmedian(numbers))
                    rows.append(Boundary(str(setting.where), line.key, what, value, by.value))
    return rows


def attracting(study: Study, grid: Grid) -> tuple[list[Attracting], list[Attracting]]:
    """Stretches along the first key at which several things attract one system; and where steady sliding does."""
    several: list[Attracting] = []
    sliding: list[Attracting] = []
    for line in _lines(study, grid):
        if all(len({*study.data.table.own["matrix"].iloc[setting.runs.rows]}) == 1 for setting in line.settings):
            several += line.several()
            sliding += line.sliding()
    return several, sliding


class _Line(NamedTuple):
    """Settings along the first key, at one value of each other."""

    study: Study
    key: str
    where: Place
    settings: Sequence[Setting]
    x: Sequence[float]
    is_refined: bool

    def numbers(self, name: str, setting: Setting) -> Floats:
        """What was refined beside a setting, of each run; empty if nothing was."""
        return self.study.number(name)[setting.runs.rows] if self.is_refined else np.empty(0)

    def is_stable(self, setting: Setting) -> bool | None:
        """Whether steady sliding is linearly stable; None where that is not recorded."""
        if "critical_rate" not in self.study.data.recorded:
            return None
        rates = self.study.number("critical_rate")[setting.runs.rows]
        return None if np.isnan(rates).any() else not np.asarray(is_unstable(rates)).any()

    def nouns(self, setting: Setting) -> tuple[str, ...]:
        """What attracts at a setting: what runs settle on, and steady sliding where it is stable."""
        kinds = {_NOUNS[kind] for kind, _ in setting.kinds if kind in _NOUNS}
        kinds |= {_NOUNS[SLIDING]} if self.is_stable(setting) else set()
        return tuple(noun for noun in dict.fromkeys(_NOUNS.values()) if noun in kinds)

    def several(self) -> Iterator[Attracting]:
        for nouns, first, last in _stretches([self.nouns(setting) for setting in self.settings]):
            if len(nouns) > 1:
                yield self._between(nouns, first, last)

    def sliding(self) -> Iterator[Attracting]:
        for is_stable, first, last in _stretches([self.is_stable(setting) for setting in self.settings]):
            if is_stable:
                yield self._between((_NOUNS[SLIDING],), first, last)

    def _between(self, nouns: tuple[str, ...], first: int, last: int) -> Attracting:
        low, low_by = self._end(nouns, first, -1)
        high, high_by = self._end(nouns, last, 1)
        return Attracting(nouns, self.key, low, high, low_by, high_by, self.where)

    def _end(self, nouns: tuple[str, ...], k: int, step: int) -> tuple[str, Bound]:
        """Where a stretch ends beyond the k-th setting: the nearest end that was refined, or that setting."""
        setting, beyond = self.settings[k], k + step
        if not self.is_refined or not 0 <= beyond < len(self.settings):
            return in_words(setting.at[0]), Bound.SETTING
        there, nearest = self.settings[beyond], min if step > 0 else max
        ends: list[tuple[float, Bound]] = []
        if self.is_stable(there) is False and _NOUNS[SLIDING] in nouns:
            crossings = self.numbers("stability_changes", self.settings[min(k, beyond)])
            ends += [(float(x), Bound.STABILITY) for x in crossings[~np.isnan(crossings)][:1]]
        if _STICK_SLIP in nouns and _STICK_SLIP not in self.nouns(there):
            followed = np.isin(setting.runs.kinds, [kind for kind, noun in _NOUNS.items() if noun == _STICK_SLIP])
            name = "motion_ends_above" if step > 0 else "motion_ends_below"
            stops = self.numbers(name, setting)[followed]
            # one that is followed all the way attracts beyond, though no run began near it
            lasts = np.isnan(stops).any()
            furthest = self.x[beyond] if lasts else float(stops.max() if step > 0 else stops.min())
            ends.append((furthest, Bound.RUNS))
        if not ends:
            return in_words(setting.at[0]), Bound.SETTING
        value, by = nearest(ends, key=lambda end: end[0])
        return f"{value:.4g}", by


def _lines(study: Study, grid: Grid) -> Iterator[_Line]:
    """Lines of settings, along numbers, of which it is recorded what their runs settle on."""
    if not grid.axes or (axis := grid.axes[0]).x is None:
        return
    refined = axis_of_numbers(study.data.table.design.axes)
    is_refined = "stability_changes" in study.data.recorded and refined is not None and refined.keys == axis.keys
    number_of = dict(zip(axis.rows, axis.x, strict=True))
    for method, settings in grid.methods.items():
        recorded = [setting for setting in settings if setting.is_recorded]
        for line in grid.lines(recorded) if recorded else ():
            x = [number_of[setting.at[0]] for setting in line]
            yield _Line(study, axis.name, grid.beside(line[0]) + Place.of(method), line, x, is_refined)


def _stretches(values: Sequence[T]) -> Iterator[tuple[T, int, int]]:
    """Equal values that follow on each other, with the places of the first and the last."""
    for value, group in groupby(range(len(values)), values.__getitem__):
        places = [*group]
        yield value, places[0], places[-1]
