"""Runs of an ensemble, and functions that are put to each of them, here or where the data are."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from stickslip.analysis.series.cascades import Window, window
from stickslip.analysis.series.nulls import BlockSteps, block_steps
from stickslip.analysis.series.windows import ChangePoints

#: Events of a run: t float64, block int32, mode int8 (-1, 0, +1 after the event), each (m,); and initial_mode (n,).
Events = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
T = TypeVar("T")


class Ended(NamedTuple):
    """A member, by its row in the table of members, its unit, and how its run ended; a rate may be NaN or None."""

    row: int
    member_id: str
    unit: int
    outcome: str
    t_end: float
    growth_rate: float | None


@dataclass(frozen=True)
class Run:
    """A run, as a function that is put to each of them is given it.

    Attributes
    ----------
    member_id : str
    win : Window
        n_stick on [t_burn, t_end].
    events : Events or None
        None if the run recorded none.
    seed : int
        Of the analysis.
    """

    member_id: str
    win: Window
    events: Events | None
    seed: int

    @cached_property
    def steps(self) -> BlockSteps | None:
        """Each block's changes in the window; None if the run recorded no events."""
        return None if self.events is None else block_steps(*self.events, self.win.t_start, self.win.t_stop)

    def generator(self) -> np.random.Generator:
        """A new generator of the run's own random numbers."""
        return generator(self.seed, self.member_id)


@dataclass(frozen=True)
class Runs:
    """What runs recorded, by member_id, and the settings under which they are looked at.

    Attributes
    ----------
    series : mapping of str to ChangePoints
    events : mapping of str to Events
        Without those that recorded none.
    t_burn : float
    seed : int
        Of the analysis.
    """

    series: Mapping[str, ChangePoints]
    events: Mapping[str, Events]
    t_burn: float
    seed: int

    def points(self, member_id: str) -> ChangePoints:
        """The change points of n_stick of a run.

        Raises
        ------
        ValueError
            If there are none; the error names the member.
        """
        try:
            return self.series[member_id]
        except KeyError:
            raise ValueError(
                f"series: expected change points of the member {member_id!r}, got none; every member that did not "
                f"fail has at least one, its start"
            ) from None

    def window(self, member_id: str, t_end: float) -> Window:
        """n_stick of a run on [t_burn, t_end].

        Raises
        ------
        ValueError
            If it has no change points, or they are not a series; the error names the member.
        """
        return named_window(self.points(member_id), member_id, self.t_burn, t_end)

    def run(self, one: Ended) -> Run:
        """A run; raises as `window`."""
        return Run(one.member_id, self.window(one.member_id, one.t_end), self.events.get(one.member_id), self.seed)

    def sums(self, some: Sequence[Ended], of: Callable[[Run], np.ndarray | None]) -> dict[int, np.ndarray]:
        """By unit, the sums of what a function gives of some runs, flat, and at the end how many gave something."""
        found: dict[int, np.ndarray] = {}
        for one in some:
            given = of(self.run(one))
            if given is not None:
                found[one.unit] = found.get(one.unit, 0.0) + np.append(given, 1.0)
        return found


class Put(Protocol):
    """Puts a function to some runs, here or elsewhere, in parts: the places of the runs of each part, and its result.

    The parts depend on the data alone; a function that works elsewhere is pickled, and so is what it gives.
    """

    def __call__(
        self, of: Callable[[Runs, Sequence[Ended]], T], some: Sequence[Ended]
    ) -> Sequence[tuple[Sequence[int], T]]: ...


def named_window(points: ChangePoints, member_id: str, t_start: float, t_stop: float) -> Window:
    """`window`, whose errors name the member."""
    try:
        return window(*points, t_start, t_stop)
    except ValueError as error:
        raise no_series(member_id, error) from error


def no_series(member_id: str, why: ValueError) -> ValueError:
    """The error for change points of a member that are not a series."""
    return ValueError(f"series of member {member_id!r}: {why}")


def generator(seed: int, name: str) -> np.random.Generator:
    """Random numbers that depend on a seed and a name alone."""
    words = np.frombuffer(hashlib.sha256(name.encode()).digest(), dtype="<u4")
    return np.random.default_rng(np.random.SeedSequence([seed, *words.tolist()]))
