"""Runs of an ensemble, and functions that are put to each of them, here or where the data are."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from stickslip.analysis.series.cascades import Window, window
from stickslip.analysis.series.nulls import BlockSteps, block_steps
from stickslip.analysis.series.windows import ChangePoints, NoSeries, Stack

#: Events of a run: t float64, block int32, mode int8 (-1, 0, +1 after the event), each (m,); and initial_mode (n,).
Events = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Ended:
    """Some members and how their runs ended, R of them; each attribute has shape (R,).

    Attributes
    ----------
    row : ndarray of int
        Of the table of members.
    t_end, t_stop : ndarray, float64
        Until when it was to be followed, and was; NaN where it failed.
    growth_rate : ndarray, float64
        NaN where it is not known.
    n : ndarray of int
        Number of blocks.
    period : ndarray, float64
        Of the force; NaN where none is known.
    """

    row: np.ndarray
    member_id: np.ndarray
    unit: np.ndarray
    outcome: np.ndarray
    t_end: np.ndarray
    t_stop: np.ndarray
    growth_rate: np.ndarray
    n: np.ndarray
    period: np.ndarray

    def __len__(self) -> int:
        return len(self.row)

    def take(self, some: np.ndarray | slice) -> Ended:
        """Some of them, by their places."""
        return Ended(*(getattr(self, column.name)[some] for column in fields(self)))


def by_number(numbers: np.ndarray) -> list[np.ndarray]:
    """The places of equal numbers, those of the smallest first, each in their order."""
    order = np.argsort(numbers, kind="stable")
    return np.array_split(order, np.flatnonzero(np.diff(numbers[order])) + 1) if len(order) else []


class Series(Protocol):
    """The change points of runs, by member_id: a mapping that also gives those of many runs together."""

    def __getitem__(self, member_id: str, /) -> ChangePoints: ...
    def __iter__(self) -> Iterator[str]: ...
    def __len__(self) -> int: ...
    def items(self) -> Iterable[tuple[str, ChangePoints]]: ...
    def stacks(self, member_ids: Sequence[str]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """The attributes of a `Stack` of some members, in their order, in parts of any length.

        Raises `KeyError` if there are none of a member; its argument is the member; `NoSeries` if some are not of the
        form of change points; it names the place of the member among `member_ids`.
        """
        ...


@dataclass(frozen=True)
class Run:
    """A run, as a function that is put to each of them is given it; what it recorded is looked up when asked for."""

    runs: Runs
    member_id: str
    t_end: float
    period: float = np.nan  #: of the force; NaN where none is known

    @cached_property
    def win(self) -> Window:
        """n_stick on [t_burn, t_end]; raises as `Runs.window`."""
        return self.runs.window(self.member_id, self.t_end)

    @cached_property
    def steps(self) -> BlockSteps | None:
        """Each block's changes in the window, in whole periods of the force; None if the run recorded no events."""
        events = self.runs.events.get(self.member_id)
        return None if events is None else block_steps(*events, self.runs.t_burn, self.t_end, self.period)

    @property
    def shiftable(self) -> BlockSteps | None:
        """`steps`, where it makes a difference to shift blocks in time."""
        return None if self.steps is None or self.steps.repeats else self.steps

    def generator(self) -> np.random.Generator:
        """A new generator of the run's own random numbers."""
        return generator(self.runs.seed, self.member_id)


@dataclass(frozen=True)
class Runs:
    """What runs recorded, by member_id, and the settings under which they are looked at.

    Attributes
    ----------
    events : mapping of str to Events
        Without those that recorded none.
    seed : int
        Of the analysis.
    unit : float
        One dimensionless unit of time, in the unit of the series.
    """

    series: Series
    events: Mapping[str, Events]
    t_burn: float
    seed: int
    unit: float = 1.0

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
            raise _lacking(member_id) from None

    def dimensionless(self, member_id: str) -> ChangePoints:
        """As `points`, at dimensionless times."""
        t, level = self.points(member_id)
        return t / self.unit, level

    def stacks(self, member_ids: Sequence[str]) -> Iterator[Stack]:
        """The change points of some runs, in parts; raises as `points`, and if they are of another form."""
        try:
            for stack in self.series.stacks(member_ids):
                yield Stack(*stack)
        except KeyError as error:
            raise _lacking(error.args[0]) from None
        except NoSeries as error:
            raise no_series(member_ids[error.place], error) from error

    def window(self, member_id: str, t_end: float) -> Window:
        """n_stick of a run on [t_burn, t_end].

        Raises
        ------
        ValueError
            If it has no change points, or they are not a series; the error names the member.
        """
        points = self.points(member_id)
        try:
            return window(*points, self.t_burn, t_end)
        except ValueError as error:
            raise no_series(member_id, error) from error

    def sums(self, some: Ended, of: Callable[[Run], np.ndarray | None]) -> dict[int, np.ndarray]:
        """By unit, the sums of what a function gives of some runs, flat, and at the end how many gave something."""
        totals: dict[int, np.ndarray] = {}
        columns = some.member_id, some.unit.tolist(), some.t_end.tolist(), some.period.tolist()
        for member_id, unit, t_end, period in zip(*columns, strict=True):
            values = of(Run(self, str(member_id), t_end, period))
            if values is not None:
                totals[unit] = totals.get(unit, 0.0) + np.append(values, 1.0)
        return totals


class Put(Protocol):
    """Puts a function to some runs, here or elsewhere, in parts: the places of the runs of each part, and its result.

    The parts depend on the data alone; a function that works elsewhere is pickled, and so is what it gives. With
    `beside`, one run for each of `some`, it is given those of each part too.
    """

    def __call__(
        self, of: Callable[..., T], some: Ended, beside: Ended | None = None
    ) -> Sequence[tuple[Sequence[int], T]]: ...


def _lacking(member_id: str) -> ValueError:
    return ValueError(
        f"series: expected change points of the member {member_id!r}, got none; every member that did not fail has "
        f"at least one, its start"
    )


def no_series(member_id: str, why: ValueError) -> ValueError:
    """The error for change points of a member that are not a series."""
    return ValueError(f"series of member {member_id!r}: {why}")


def generator(seed: int, name: str) -> np.random.Generator:
    """Random numbers that depend on a seed and a name alone."""
    words = np.frombuffer(hashlib.sha256(name.encode()).digest(), dtype="<u4")
    return np.random.default_rng(np.random.SeedSequence([seed, *words.tolist()]))
