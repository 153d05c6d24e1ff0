"""The design of an ensemble: what differs between its members, and what they share.

A member has five coordinates. Its *point* is a place on the grid that lists span, of systems from one source; its
*unit* is what is independent; its *method* is an engine with its settings; its *change* is how it was moved away from
its *base*, the member that is the same but for that. Members that share point, method and change differ only in what
is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from stickslip.pipeline.design.values import Value, as_written, shown, text

#: The values that the keys of an axis have together.
Row: TypeAlias = tuple[Value, ...]

#: How a perturbation is read if nothing else is said: it moves every constant by up to a share of its scale.
DEFAULT_READING = "scale"


class Unit(StrEnum):
    """What is independent: random systems, starts of one system, or files of one system each."""

    MATRIX = "matrix"
    START = "start"
    FILE = "file"


class Kind(StrEnum):
    """What is changed of a copy: nothing, its start, its constants, or the draw of its stiffness ratios."""

    NOTHING = "nothing"
    START = "start"
    CONSTANTS = "constants"
    RATIOS = "ratios"


@dataclass(frozen=True)
class Axis:
    """Keys that are swept in step, and the values that they have together, in ascending order."""

    keys: tuple[str, ...]
    rows: tuple[Row, ...]

    @property
    def name(self) -> str:
        """Its keys."""
        return " with ".join(self.keys)

    @property
    def x(self) -> list[float] | None:
        """The values of the first key as numbers; None where one is something else."""
        values = [row[0] for row in self.rows]
        numbers = [value for value in values if isinstance(value, float)]
        return numbers if len(numbers) == len(values) else None

    @property
    def texts(self) -> list[str]:
        """The values in words."""
        return [*map(in_words, self.rows)]

    def __str__(self) -> str:
        return f"{len(self.rows)} {self.name}"


def axis_of_numbers(axes: Iterable[Axis]) -> Axis | None:
    """The axis with most values, of systems rather than starts, of those that are numbers alone; None: there is none.

    What is recorded between its values is said along it.
    """
    numeric = [
        axis
        for axis in axes
        if len(axis.rows) > 1
        and not {*axis.keys} & {"z", "w", "seed"}
        and all(isinstance(value, float) for row in axis.rows for value in row)
    ]
    return max(numeric, key=lambda axis: len(axis.rows), default=None)


def in_words(row: Row) -> str:
    """A value of an axis as pages have it."""
    return text(row[0]) if len(row) == 1 else " with ".join(map(text, row))


class Source(NamedTuple):
    """Where systems come from: the number of blocks, and the file where each is a point; and what units are."""

    n: int
    file: str | None
    unit: Unit


@dataclass(frozen=True)
class Point:
    """A point of a design: its source, the number of blocks and the file there, the rows of axes, and its units."""

    source: int
    n: int
    file: str | None
    at: tuple[Row, ...]
    unit: Unit


@dataclass(frozen=True)
class Method:
    """An engine and its settings; `ratio` is "one" or "uniform"."""

    engine: str
    settings: tuple[tuple[str, Any], ...]


@dataclass(frozen=True, order=True)
class Change:
    """How a copy differs from its base: the kind, how `size` is read (for constants), and the size."""

    kind: Kind = Kind.NOTHING
    reading: str | None = None
    size: float = 0.0

    def __str__(self) -> str:
        match self.kind:
            case Kind.START:
                return f"start moved by {shown(self.size)}"
            case Kind.RATIOS:
                return "ratios redrawn"
        how = "" if self.reading in (None, DEFAULT_READING) else f" ({self.reading})"
        return f"all constants changed by up to {100 * self.size:.3g}%{how}"


class Coordinates(NamedTuple):
    """Where some members stand in a design, int64, shape (R,) each."""

    point: np.ndarray  #: number of `Design.point`
    #: Members that have the same share what is drawn of the system, or of the start where that is the unit.
    unit: np.ndarray
    method: np.ndarray  #: number in `Design.methods`
    change: np.ndarray  #: number in `Design.changes`; 0 is none
    base: np.ndarray  #: the number of the member that each is a changed copy of; its own if it is none

    def at(self, rows: slice | np.ndarray) -> Coordinates:
        """Those of some of the members."""
        return Coordinates(*(column[rows] for column in self))

    @classmethod
    def joined(cls, pieces: Iterable[Coordinates]) -> Coordinates:
        """Those of members one after the other."""
        return cls(*map(np.concatenate, zip(*pieces, strict=True)))


@dataclass(frozen=True)
class Design:
    """What an ensemble was made to differ in."""

    #: Of the grid, in the scene's order, the last one fastest; without seeds, which make other units.
    axes: tuple[Axis, ...]
    constants: tuple[tuple[str, Value], ...]  #: the keys that are not swept
    sources: tuple[Source, ...]  #: the grid is run for each
    #: Points of the grid, by number, whose start is not drawn although the units are starts: there, matrices are.
    fixed: frozenset[int]
    methods: tuple[Method, ...]
    changes: tuple[Change, ...]
    #: The number of each point in the order of the grid, if that is another order: what was numbered before a scene
    #: grew keeps its number.
    numbers: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of sources, and of rows on each axis."""
        return (len(self.sources), *(len(axis.rows) for axis in self.axes))

    @property
    def n_points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @cached_property
    def _place(self) -> np.ndarray:
        return np.argsort(self.numbers)

    def point(self, number: int) -> Point:
        """A point by its number."""
        place = int(self._place[number]) if self.numbers else number
        source, *rows = (int(k) for k in np.unravel_index(place, self.shape))
        n, file, unit = self.sources[source]
        unit = Unit.MATRIX if place % math.prod(self.shape[1:]) in self.fixed else unit
        return Point(source, n, file, tuple(axis.rows[k] for axis, k in zip(self.axes, rows, strict=True)), unit)

    def swept(self, point: Point) -> dict[str, Value]:
        """What a point has of the keys of the axes."""
        pairs = zip(self.axes, point.at, strict=True)
        return {key: value for axis, row in pairs for key, value in zip(axis.keys, row, strict=True)}

    def values(self, point: Point) -> dict[str, Value]:
        """What a point has of all keys."""
        return dict(self.constants) | self.swept(point)

    def as_json(self) -> dict[str, Any]:
        """As plain values, in which JSON says it."""
        plain: dict[str, Any] = {
            "axes": [
                {"keys": [*axis.keys], "rows": [[*map(as_written, row)] for row in axis.rows]} for axis in self.axes
            ],
            "constants": {key: as_written(value) for key, value in self.constants},
            "sources": [{"n": n, "file": file, "unit": str(unit)} for n, file, unit in self.sources],
            "methods": [
                {"engine": method.engine} | {name: as_written(value) for name, value in method.settings}
                for method in self.methods
            ],
            "changes": [
                {"kind": str(change.kind), "reading": change.reading, "size": change.size} for change in self.changes
            ],
        }
        return (
            plain
            | ({"fixed": sorted(self.fixed)} if self.fixed else {})
            | ({"points": [*self.numbers]} if self.numbers else {})
        )
