"""How members are numbered in a dataset whose scene grew: what had a number keeps it, and what is new comes after."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias, TypeVar

import numpy as np

from stickslip.pipeline.design.design import Coordinates, Design
from stickslip.pipeline.ensemble.expand import Ensemble

_Listed = TypeVar("_Listed")
#: Numbers that are known, ascending, and what each becomes.
_Table: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Numbering:
    """The members of a scene in a dataset: their design, and their numbers there."""

    ensemble: Ensemble
    before: Numbering | None = None  #: of the scene that it grew from

    @cached_property
    def kept(self) -> np.ndarray:
        """The places in the scene's expansion of the members that it grew from, in the order of theirs.

        Raises `KeyError` if it lacks some of them.
        """
        return np.zeros(0, np.int64) if self.before is None else self.ensemble.places_of(self.before.ensemble)

    @cached_property
    def added(self) -> np.ndarray:
        """The places in the scene's expansion of the members that are new."""
        return np.delete(np.arange(len(self.ensemble)), self.kept)

    def here(self, earlier: Numbering, places: np.ndarray) -> np.ndarray:
        """The places in the scene's expansion of members of an earlier one, by theirs."""
        return places if earlier is self or self.before is None else self.kept[self.before.here(earlier, places)]

    @cached_property
    def _of_design(self) -> Mapping[str, _Table]:
        """The tables of what the design lists, read off one member of each source, point and variant."""
        design = self.ensemble.design
        sizes = {"point": design.n_points, "method": len(design.methods), "change": len(design.changes)}
        firsts = np.zeros(0, np.int64) if self.before is None else self.before.ensemble.firsts
        return self._tables({name: np.arange(size) for name, size in sizes.items()}, firsts)

    @cached_property
    def _of_members(self) -> Mapping[str, _Table]:
        """The tables of what the members themselves differ in."""
        if self.before is None:
            return {}
        places = np.arange(len(self.ensemble))
        numbers = {"unit": np.unique(self.ensemble.coordinates(places).unit), "base": places}
        # the starts of one system are no units any more once there are more systems
        if self.ensemble.unit != self.before.ensemble.unit:
            del numbers["unit"]
        return self._tables(numbers, np.arange(len(self.kept)))

    def _tables(self, listed_numbers: Mapping[str, np.ndarray], places: np.ndarray) -> Mapping[str, _Table]:
        """Of coordinates whose numbers are not those of the scene alone: these, ascending, and what they become."""
        if self.before is None:
            return {}
        now, then = self.ensemble.coordinates(self.kept[places]), self.before.ensemble.coordinates(places)
        tables = {}
        for name, numbers in listed_numbers.items():
            mine, theirs = getattr(now, name), self.before.renumbered(name, getattr(then, name))
            if name == "base":  # a copy may have lost its base, but each has its own number
                mine, theirs = self.kept, self.before.renumbered(name, places)
            if not np.array_equal(mine, theirs):
                tables[name] = numbers, _continued(numbers, mine, theirs)
        return tables

    def renumbered(self, name: str, numbers: np.ndarray) -> np.ndarray:
        """What numbers of a coordinate of the scene alone become in the dataset."""
        tables = self._of_members if name in ("unit", "base") else self._of_design
        if name not in tables:
            return numbers
        old_numbers, become = tables[name]
        return become[np.searchsorted(old_numbers, numbers)]

    def of(self, places: np.ndarray) -> Coordinates:
        """Where members stand in the design, by their places in the scene's expansion, shape (R,)."""
        coordinates = self.ensemble.coordinates(places)
        return Coordinates(*map(self.renumbered, Coordinates._fields, coordinates))

    @cached_property
    def design(self) -> Design:
        """That of the scene, by the numbers of the dataset."""
        design = self.ensemble.design
        return replace(
            design,
            methods=self._in_order("method", design.methods),
            changes=self._in_order("change", design.changes),
            numbers=tuple(self._of_design["point"][1].tolist()) if "point" in self._of_design else (),
        )

    def _in_order(self, name: str, entries: tuple[_Listed, ...]) -> tuple[_Listed, ...]:
        numbers = self.renumbered(name, np.arange(len(entries)))
        return tuple(entries[k] for k in np.argsort(numbers))


def _continued(values: np.ndarray, old_values: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """A number for each of what is known: those of some are given, and the others follow on the largest of these."""
    continued = np.full(len(values), -1)
    continued[np.searchsorted(values, old_values)] = numbers
    is_new = continued < 0
    continued[is_new] = numbers.max() + 1 + np.arange(is_new.sum())
    return continued
