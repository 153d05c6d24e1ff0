"""What a key of a scene holds in one run: a number, what it is drawn from, a ratio, a course in time, a word."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from stickslip.sim.numerics.arguments import Floats

#: The least width of a range of magnitudes that b is of.
LEAST_RANGE = 0.5
#: The distributions, by what their two numbers are.
DISTRIBUTIONS = {"uniform": "[low, high]", "normal": "[mean, standard deviation]"}


@dataclass(frozen=True, slots=True)
class Distribution:
    """What a number is drawn from for each block: a name in `DISTRIBUTIONS` and its two numbers."""

    name: str
    first: float
    second: float

    def draw(self, seed: np.random.SeedSequence, n: int) -> Floats:
        """One number a block, shape (n,); a seed's draws of one distribution differ by scale and shift only."""
        rng = np.random.default_rng(seed)
        return (rng.uniform if self.name == "uniform" else rng.normal)(self.first, self.second, n)

    @property
    def middle(self) -> float:
        """The mean."""
        return 0.5 * (self.first + self.second) if self.name == "uniform" else self.first

    @property
    def size(self) -> float:
        """About the largest number that is drawn."""
        spread = 0.0 if self.name == "uniform" else abs(self.first) + abs(self.second)
        return max(abs(self.first), abs(self.second), spread)

    @property
    def word(self) -> str:
        """What stands in a member's name: the distribution and its numbers."""
        return f"{self.name}{short(self.first)}_{short(self.second)}"

    def __str__(self) -> str:
        return f"{self.name}({short(self.first)}, {short(self.second)})"


class InTime:
    """A number that changes in time."""

    __slots__ = ()

    @property
    def extremes(self) -> tuple[float, float]:
        """The least and the greatest value."""
        raise NotImplementedError

    @property
    def size(self) -> float:
        """The largest absolute value."""
        return max(map(abs, self.extremes))

    @property
    def word(self) -> str:
        """What would stand in a member's name; a course is not swept."""
        return "course"


@dataclass(frozen=True, slots=True)
class Course(InTime):
    """A number that changes in time: linear between values at given times, constant before and after."""

    times: tuple[float, ...]
    values: tuple[float, ...]

    @property
    def extremes(self) -> tuple[float, float]:
        """The least and the greatest value."""
        return min(self.values), max(self.values)

    def __str__(self) -> str:
        return " to ".join(f"{short(x)} at {short(t)}" for t, x in zip(self.times, self.values, strict=True))


@dataclass(frozen=True, slots=True)
class Measured(InTime):
    """A number that changes in time as two columns of a file say, times and values: as a `Course`.

    `table` is the file beside the scene, with the sha256 of its bytes, how many values it holds and between which;
    `columns` names the two of several.
    """

    table: str
    columns: tuple[str | int, ...]
    sha256: str
    n_values: int
    extremes: tuple[float, float]
    at: str = field(default="", compare=False)  #: where it lies

    def __str__(self) -> str:
        low, high = map(short, self.extremes)
        return f"{self.n_values} values of {self.table} from {low} to {high}"


@dataclass(frozen=True, slots=True)
class OnBlocks:
    """Some blocks, by number: those that a force acts on, or that have friction."""

    numbers: tuple[int, ...]

    def among(self, n: int) -> np.ndarray:
        """Which of n blocks these are, shape (n,)."""
        return np.isin(np.arange(n), self.numbers)

    def __str__(self) -> str:
        return ", ".join(map(str, self.numbers))


@dataclass(frozen=True, slots=True)
class Push:
    """One of several forces: amplitude cos(frequency t + phase), numbers or drawn by block, or a course."""

    harmonic: tuple[Any, ...]
    course: Course | Measured | None
    blocks: OnBlocks | None

    def __str__(self) -> str:
        words = [str(number) if isinstance(number, Distribution) else short(number) for number in self.harmonic]
        shape = f"({self.course})" if self.course else "{} cos({} t + {})".format(*words)
        return shape + (f" on blocks {self.blocks}" if self.blocks else "")


@dataclass(frozen=True, slots=True)
class Pushes:
    """A sum of forces."""

    parts: tuple[Push, ...]

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts))


@dataclass(frozen=True, slots=True)
class Named:
    """A number for each block that a word stands for."""

    word: str
    size: float = 0.0

    def __str__(self) -> str:
        return self.word


#: What the file of the system holds; the speed of the belt; where the same member of another dataset ended.
FILE, BELT, END = Named("file"), Named("belt"), Named("end")


@dataclass(frozen=True, slots=True)
class Ratio:
    """A number for each block: a factor, which may be drawn, of another that the block has."""

    factor: float | Distribution
    of: str

    @property
    def size(self) -> float:
        """The largest factor, as far as it is known."""
        return size(self.factor)

    @property
    def word(self) -> str:
        """What stands in a member's name."""
        return f"ratio_{word(self.factor)}"

    def __str__(self) -> str:
        return f"{self.factor if isinstance(self.factor, Distribution) else short(self.factor)} {self.of}"


#: The value of a key in one run.
Value: TypeAlias = float | int | Distribution | Course | Measured | Named | Ratio

#: What a key holds: a tuple is a list in the file, each of whose values is run.
Quantity: TypeAlias = Value | tuple[Value, ...]


def short(value: float) -> str:
    """Shortest text that gives the float back: 1e-06 -> 1e-6, 1.0 -> 1. Distinct floats stay distinct."""
    mantissa, _, exponent = repr(value).partition("e")
    return mantissa.removesuffix(".0") + (f"e{int(exponent)}" if exponent else "")


def word(value: Value) -> str:
    """A value in a member's name."""
    return short(value) if isinstance(value, float | int) else value.word


def values(quantity: Quantity | None) -> tuple[Value, ...]:
    """All that a key holds."""
    return quantity if isinstance(quantity, tuple) else () if quantity is None else (quantity,)


def size(quantity: Quantity) -> float:
    """The largest absolute value of a quantity."""
    return max(abs(value) if isinstance(value, float | int) else value.size for value in values(quantity))


def lowest(value: Value) -> float:
    """The smallest number that a value can be, if it is never below zero."""
    return float(value) if isinstance(value, float | int) else value.first if isinstance(value, Distribution) else 0.0


def as_written(quantity: Quantity) -> Any:
    """A quantity as TOML and JSON have it."""
    if isinstance(quantity, tuple):
        return [as_written(value) for value in quantity]
    if isinstance(quantity, Named):
        return str(quantity)
    if isinstance(quantity, Course):
        return {"times": list(quantity.times), "values": list(quantity.values)}
    if isinstance(quantity, Measured):
        columns = {"columns": list(quantity.columns)} if quantity.columns else {}
        facts = {"sha256": quantity.sha256, "n": quantity.n_values, "extremes": list(quantity.extremes)}
        return {"table": quantity.table, **columns, "series": facts}
    if isinstance(quantity, Ratio):
        return {"ratio": as_written(quantity.factor)}
    return {quantity.name: [quantity.first, quantity.second]} if isinstance(quantity, Distribution) else quantity


def order(row: tuple[Value, ...]) -> list[tuple[str, float, float]]:
    """Sorts members: numbers before distributions, and ratios last. Never change it: stored data have this order."""

    def place(value: Value) -> tuple[str, float, float]:
        if isinstance(value, Ratio):
            name, *numbers = place(value.factor)
            return f"~{name}", numbers[0], numbers[1]
        if isinstance(value, Distribution):
            return value.name, value.first, value.second
        return "", value if isinstance(value, float | int) else 0.0, 0.0

    return [place(one) for one in row]


# ---------------------------------------------------------------------------------------------- on pages

#: Numbers that differ by less, relatively, are shown as one.
_ROUNDING = 1e-14
#: Smaller numbers are shown as powers of ten.
_SMALL = 0.01
#: A number in a name, whose sign is no hyphen.
_NUMBER = re.compile(r"(?:(?<!\w)[-+])?\d+(?:\.\d+)?(?:e[-+]?\d+)?")

#: Sorts values on pages.
Rank: TypeAlias = tuple[int, str, tuple[float, ...]]


def shown(value: float) -> str:
    """A number in few digits, but in all that it has, such as 3e-4: more than rounding is never lost."""
    text = f"{value:g}"
    if abs(float(text) - value) > _ROUNDING * abs(value):
        text = f"{value:.15g}"
    if not 0.0 < abs(value) < _SMALL:
        return text
    digits = len(text.partition("e")[0].replace(".", "").lstrip("-0"))
    mantissa, _, exponent = f"{value:.{max(digits, 1) - 1}e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


class Amount(str):
    """The text of a number, or of what numbers are drawn from, which has the unit of its key."""


def text(value: object) -> str:
    """A value as pages have it."""
    if isinstance(value, float | Distribution):
        return Amount(shown(value) if isinstance(value, float) else value)
    return str(value)


def rank(value: object) -> Rank:
    """Sorts values: numbers, none, distributions by their width, ratios, names by the numbers in them."""
    if isinstance(value, int | float | np.number):
        return 0, "", (float(value),)
    if value is None:
        return 1, "", ()
    if isinstance(value, Distribution):
        width = round(value.second - value.first, 12) if value.name == "uniform" else value.second
        return 2, value.name, (width, value.first)
    if isinstance(value, Ratio):
        _, name, numbers = rank(value.factor)
        return 3, name, numbers
    return 4, _NUMBER.sub("", str(value)), tuple(map(float, _NUMBER.findall(str(value))))


def ranks(row: Iterable[object]) -> list[Rank]:
    """Sorts rows of values."""
    return [*map(rank, row)]


class Values(tuple[tuple[str, Value], ...]):
    """What some keys hold, by name."""

    def __str__(self) -> str:
        return "; ".join(f"{key} = {text(value)}" for key, value in self)
