"""Tables of objects: a row an object, with nullable types, where None and an empty text are null."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from typing import Any, TypeAlias, TypeVar, get_args, get_type_hints

import pandas as pd

from stickslip.analysis.stats.estimates import Estimate

T = TypeVar("T")
#: By the name of a column, its type and what it has of an object: str, int, float, bool or None. An `Estimate` has
#: three columns: its value and, with ``_low`` and ``_high``, the ends of its interval.
Columns: TypeAlias = Mapping[str, tuple[type, Callable[[T], object]]]
_TYPES: Mapping[type, Any] = {bool: "boolean", int: "Int64", float: "Float64", str: "string"}  # a bool is an int


def frame_by(columns: Columns[T], rows: Iterable[T]) -> pd.DataFrame:
    """A data frame of objects, a column for each of `columns`."""
    objects = list(rows)
    frame: dict[str, Any] = {}
    for name, (kind, value_of) in columns.items():
        values: list[Any] = [value_of(row) for row in objects]
        if kind is Estimate:
            frame[name] = pd.array([value.value for value in values], dtype="Float64")
            frame[f"{name}_low"] = pd.array([value.low for value in values], dtype="Float64")
            frame[f"{name}_high"] = pd.array([value.high for value in values], dtype="Float64")
        else:
            nullable = [None if isinstance(value, str) and not value else value for value in values]
            frame[name] = pd.array(nullable, dtype=next(_TYPES[base] for base in _TYPES if issubclass(kind, base)))
    return pd.DataFrame(frame)


def frame_of(kind: type[T], rows: Iterable[T]) -> pd.DataFrame:
    """A data frame of the objects of a dataclass or a NamedTuple, a column a field, each with None or without.

    Parameters
    ----------
    kind : type
        Its fields are str, int, float, bool or `Estimate`.
    """
    columns: dict[str, tuple[type, Callable[[T], object]]] = {}
    for name, hint in get_type_hints(kind).items():
        field_type = next(hinted for hinted in (*get_args(hint), hint) if hinted is not type(None))
        columns[name] = field_type, attrgetter(name)
    return frame_by(columns, rows)
