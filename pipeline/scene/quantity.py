"""A key of a scene that holds a value, a list of values, each of them run, or a distribution over the blocks."""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import core_schema

from stickslip.pipeline.design.values import (
    BELT,
    DISTRIBUTIONS,
    END,
    FILE,
    Course,
    Distribution,
    Measured,
    Named,
    Quantity,
    Ratio,
    Value,
    as_written,
)
from stickslip.pipeline.scene.toml import once, shown, unquoted
from stickslip.sim.numerics.arguments import did_you_mean
from stickslip.sim.systems.system import NORMAL_FORCE

#: The schema of two numbers.
PAIR = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}


@dataclass(frozen=True)
class Key:
    """How pydantic reads a quantity: its least value, and the distributions that it may be drawn from.

    `above`: the least value itself is excluded; `in_time`: it may be a `Course`; `ratio_of`: it may be a `Ratio` of
    this, at least 1.
    """

    names: tuple[str, ...] = ()
    least: float | None = None
    words: tuple[Named, ...] = ()
    above: bool = False
    in_time: bool = False
    ratio_of: str = ""

    def read(self, value: object) -> Quantity:
        """A quantity from what the file holds."""
        if not isinstance(value, list | tuple):
            return self._value(value, value)
        return once([self._value(entry, value) for entry in value])

    def _value(self, entry: object, value: object) -> Value:
        if isinstance(entry, Distribution | Course | Measured | Named | Ratio):
            entry = as_written(entry)
        for word in self.words:
            if entry == word.word and entry is value:
                return word
        number = _number(entry)
        if number is not None and self._allows(number):
            return number
        if self.in_time and isinstance(entry, dict) and entry.keys() & {"times", "values", "table"}:
            if isinstance(value, list | tuple):
                raise ValueError(f"expected no course in a list, got {shown(entry)}; write one, without brackets")
            return course(entry)
        if isinstance(entry, dict) and entry.keys() & {"times", "values", "table", "amplitude"}:
            raise ValueError(f"expected a number that is constant in time, got {shown(entry)}; {NORMAL_FORCE}")
        if self.ratio_of and isinstance(entry, dict) and "ratio" in entry:
            return self._ratio(entry)
        if isinstance(entry, dict) and self.names:
            return self._distribution(entry)
        within = f" in {shown(value)}" if entry is not value else ""
        remedy = unquoted(entry) or f"; {self._write}"
        raise ValueError(f"expected {self._expected}, got {shown(entry)}{within}{remedy}")

    def _ratio(self, table: dict[str, object]) -> Ratio:
        factor, value = table["ratio"], None
        if len(table) == 1 and not isinstance(factor, list | tuple):
            with contextlib.suppress(ValueError):  # one message says what may stand here
                value = Key(self.names, 1.0)._value(factor, factor)
        if not isinstance(value, float | Distribution):
            raise ValueError(
                f"expected a ratio to {self.ratio_of} of at least 1, a number or a distribution, got"
                f" {shown(table)}; write e.g. {{ratio = 1.2}} or {{ratio = {{uniform = [1.1, 1.4]}}}}, or a list"
            )
        return Ratio(value, self.ratio_of)

    def _distribution(self, table: dict[str, object]) -> Distribution:
        name = next(iter(table), "")
        if len(table) != 1 or name not in self.names:
            unknown = next((key for key in table if key not in DISTRIBUTIONS), "")
            meant = did_you_mean(unknown, self.names) or f"; {self._write}"
            bound = "" if self.least is None else f", which draw nothing below {self.least}"
            raise ValueError(
                f"expected a distribution with one of the keys {', '.join(self.names)}{bound}, got {shown(table)}"
                + meant
            )
        numbers = table[name]
        match [_number(number) for number in numbers] if isinstance(numbers, list | tuple) else []:
            case [float(first), float(second)] if math.isfinite(second - first):
                if second > 0 if name == "normal" else self._allows(first) and first < second:
                    return Distribution(name, first, second)
        least = "" if self.least is None else f"{self.least} {'<' if self.above else '<='} "
        rule = "a deviation above 0" if name == "normal" else f"{least}low < high"
        raise ValueError(
            f"expected {name} = {DISTRIBUTIONS[name]}, two finite numbers with {rule}, got {shown(numbers)}"
        )

    def _allows(self, number: float) -> bool:
        return self.least is None or number > self.least or (number == self.least and not self.above)

    @property
    def _expected(self) -> str:
        number = "a finite number" + ("" if self.least is None else f" {'>' if self.above else '>='} {self.least}")
        forms = (
            ", or times and values or a table of these" * self.in_time
            + f", or a ratio to {self.ratio_of}" * bool(self.ratio_of)
        )
        return (
            f"{number}, a list of numbers or a distribution{forms}"
            if self.names
            else f"{number} or a list of numbers{forms}"
        )

    @property
    def _write(self) -> str:
        examples = " or ".join(f"{{{name} = [0.8, 1.2]}}" for name in self.names)
        return f"write e.g. 1.0, or [1.0, 2.0] to run each{f', or {examples} to draw each block' if examples else ''}"

    def __get_pydantic_core_schema__(self, _source: Any, _handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        serialization = core_schema.plain_serializer_function_ser_schema(as_written)
        return core_schema.no_info_plain_validator_function(self.read, serialization=serialization)

    def __get_pydantic_json_schema__(
        self, _schema: core_schema.CoreSchema, _handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        bound = "exclusiveMinimum" if self.above else "minimum"
        number: dict[str, Any] = {"type": "number"} | ({} if self.least is None else {bound: self.least})
        tables = [_table(**{name: PAIR}) for name in self.names]
        if self.ratio_of:
            tables.append(_table(ratio={"anyOf": [{"type": "number", "minimum": 1}, *tables]}))
        words = [{"const": word.word} for word in self.words]
        timed = [_table(times=_list({"type": "number"}), values=_list({"type": "number"}))] if self.in_time else []
        return {"anyOf": [number, _list({"anyOf": [number, *tables]}), *tables, *timed, *words]}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    """The schema of a list."""
    return {"type": "array", "items": items, "minItems": 1}


def _table(**properties: Any) -> dict[str, Any]:
    """The schema of a table that has these keys, and no others."""
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def course(table: dict[str, Any]) -> Course | Measured:
    """What changes in time, from the table of its times and values, or of a file that has these."""
    if "table" in table:
        return _measured(table)
    rows = [row if isinstance(row, list | tuple) else [] for row in (table.get("times"), table.get("values"))]
    times, row_values = (tuple(number for number in map(_number, row) if number is not None) for row in rows)
    is_whole = len(table) == 2 and len(rows[0]) == len(rows[1]) == len(times) == len(row_values) > 0
    if not is_whole or any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError(
            f"expected times that increase and as many values, finite numbers, got {shown(table)}; write e.g."
            " {times = [0.0, 100.0], values = [-0.1, -0.2]}"
        )
    return Course(times, row_values)


def _measured(table: dict[str, Any]) -> Measured:
    """What a file says, from what was there when it was looked at."""
    match table:
        case {"table": str(name), "series": {"sha256": str(sha256), "n": int(n), "extremes": [low, high]}} if (
            table.keys() <= {"table", "columns", "series"}
        ):
            return Measured(name, tuple(table.get("columns", ())), sha256, n, (float(low), float(high)))
    raise ValueError(
        f"expected the name of a file of two columns, times and values, and `columns` or none, got {shown(table)};"
        ' write in a scene file e.g. {table = "speed.csv"} or {table = "log.csv", columns = ["t", "v"]}'
    )


def _number(value: object) -> float | None:
    """A finite number as a float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # an integer beyond float64
        return None


AnyNumber = Annotated[Quantity, Key()]
Displacement = Annotated[Quantity, Key(tuple(DISTRIBUTIONS), words=(FILE, END))]
Velocity = Annotated[Quantity, Key(tuple(DISTRIBUTIONS), words=(FILE, BELT, END))]
