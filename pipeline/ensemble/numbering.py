"""How members are numbered in a dataset whose scene grew: what had a number keeps it, and what is new comes after."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from stickslip.pipeline.design.design import Coordinates, Design
from stickslip.pipeline.ensemble.expand import Ensemble

_Listed = TypeVar("_Listed")


@dataclass(frozen=True, eq=False)
class Numbering:
    """The members of a scene in a dataset: their design, and their numbers there.

    Attributes
    ----------
    ensemble : Ensemble
    before : Numbering, optional
        Of the scene that it grew from.
    """

    ensemble: Ensemble
    before: Numbering | None = None

    @cached_property
    def kept(self) -> np.ndarray:
        """The places in the scene's expansion of the members that it grew from, in the order of theirs.

        Raises
        ------
        KeyError
            If it lacks some of them.
        """
        return np.zeros(0, np.int64) if self.before is None else self.ensemble.places_of(self.before.ensemble)

    @cached_property
    def added(self) -> np.ndarray:
        """The places in the scene's expansion of the members that are new."""
        return np.delete(np.arange(len(self.ensemble)), self.kept)

    def places_of(self, earlier: Numbering) -> np.ndarray:
        """The places in the scene's expansion of the members of an earlier one, in the order of theirs."""
        if earlier is self or self.before is None:
            return np.arange(len(self.ensemble))
        return self.kept[self.before.places_of(earlier)]

    @cached_property
    def _tables(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """By coordinate, if its numbers are not those of the scene alone: these, ascending, and what they become."""
        if self.before is None:
            return {}
        design, places = self.ensemble.design, np.arange(len(self.ensemble))
        every, old = self.ensemble.coordinates(places), self.before.of(np.arange(len(self.kept)))
        known = every._replace(
            point=np.arange(design.n_points),
            unit=np.unique(every.unit),
            method=np.arange(len(design.methods)),
            change=np.arange(len(design.changes)),
            base=places,
        )
        before = old._replace(base=self.before.renumbered("base", np.arange(len(self.kept))))
        now = every._replace(base=places).at(self.kept)
        found = {}
        for name, numbers, mine, theirs in zip(Coordinates._fields, known, now, before, strict=True):
            # the starts of one system are no units any more once there are more systems
            is_other = name == "unit" and self.ensemble.unit != self.before.ensemble.unit
            if not is_other and not np.array_equal(mine, theirs):
                found[name] = numbers, _continued(numbers, mine, theirs)
        return found

    def renumbered(self, name: str, numbers: np.ndarray) -> np.ndarray:
        """What numbers of a coordinate of the scene alone become in the dataset."""
        if name not in self._tables:
            return numbers
        known, become = self._tables[name]
        return become[np.searchsorted(known, numbers)]

    def of(self, places: np.ndarray) -> Coordinates:
        """Where members stand in the design, by their places in the scene's expansion, shape (R,)."""
        own = self.ensemble.coordinates(places)
        return Coordinates(*map(self.renumbered, Coordinates._fields, own))

    @cached_property
    def design(self) -> Design:
        """That of the scene, by the numbers of the dataset."""
        own = self.ensemble.design
        return replace(
            own,
            methods=self._in_order("method", own.methods),
            changes=self._in_order("change", own.changes),
            numbers=tuple(self._tables["point"][1].tolist()) if "point" in self._tables else (),
        )

    def _in_order(self, name: str, listed: tuple[_Listed, ...]) -> tuple[_Listed, ...]:
        numbers = self.renumbered(name, np.arange(len(listed)))
        return tuple(listed[k] for k in np.argsort(numbers))


def _continued(known: np.ndarray, some: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """A number for each of what is known: those of some are given, and the others follow on the largest of these."""
    found = np.full(len(known), -1)
    found[np.searchsorted(known, some)] = numbers
    is_new = found < 0
    found[is_new] = numbers.max() + 1 + np.arange(is_new.sum())
    return found
