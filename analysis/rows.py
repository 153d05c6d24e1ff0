"""Tables of objects: a row an object, with nullable types, where None and an empty text are null."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import pandas as pd

from stickslip.analysis.stats.estimates import Estimate

T = TypeVar("T")
#: By the name of a column, its type and what it has of an object: str, int, float, bool, list or None. An `Estimate`
#: has three columns: its value and, with ``_low`` and ``_high``, the ends of its interval.
Columns: TypeAlias = Mapping[str, tuple[type, Callable[[T], object]]]
#: A bool is an int.
_TYPES: Mapping[type, Any] = {bool: "boolean", int: "Int64", float: "Float64", str: "string", list: object}


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
        Its fields are str, int, float, bool, `Estimate`, or lists or literals of such.
    """
    return frame_by({name: (_type(hint), attrgetter(name)) for name, hint in get_type_hints(kind).items()}, rows)


def _type(hint: Any) -> type:
    """The type of what a field holds where it is not None."""
    if get_origin(hint) in (Union, UnionType):
        hint = next(option for option in get_args(hint) if option is not NoneType)
    return type(get_args(hint)[0]) if get_origin(hint) is Literal else get_origin(hint) or hint
