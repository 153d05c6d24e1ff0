"""The design of members that no scene made, from a table of values: each column that differs is a key by itself.

Keys that go together are two axes then, and points that were not run are gaps in a grid: a table does not say more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from stickslip.pipeline.design.design import (
    DEFAULT_READING,
    Axis,
    Change,
    Coordinates,
    Design,
    Kind,
    Method,
    Source,
    Unit,
)
from stickslip.pipeline.design.values import Value, rank, read
from stickslip.sim.engines import SETTINGS
from stickslip.sim.systems.terms import TERMS

#: What tells sources apart, beside keys that some members do without.
_SOURCE = ("n", "coupling", "file", "back_slip", "t_end")
#: Columns of keys that may be swept, and of texts that name such keys.
_SWEPT, _TEXTS = (*(term.name for term in TERMS), "z0", "w0"), ("parameters", "drawn")
_CHANGE = ("twin_size", "perturbation_reading", "perturbation_size")


def designed(table: pd.DataFrame) -> tuple[Coordinates, Design]:
    """Where the members of a table stand, and their design.

    Parameters
    ----------
    table : DataFrame
        With all columns that `analysis.members` knows.
    """
    unit_of = _units(table)
    is_file = unit_of == Unit.FILE
    system = table[[*_SOURCE, *_SWEPT, *_TEXTS]].assign(has_draw=table["start_draw"].notna(), unit=unit_of)
    place, systems = _distinct(system.assign(**{name: table[name].mask(is_file) for name in ("file", "kappa")}))
    method, methods = _distinct(table[["engine", *(name for name in SETTINGS if name in table)]])
    moved, moves = _distinct(table[[*_CHANGE]])
    point, design = _grid(systems)
    changes = [_change(move) for move in moves]
    listed = sorted(set(changes) | {Change()}, key=lambda change: (change.kind != Kind.NOTHING, change))
    change = np.array([listed.index(one) for one in changes])[moved]
    drawn = table[["matrix", "seed", "start_draw", "ratio_draw"]]
    draws, _ = _distinct(drawn.assign(point=point[place], method=method))
    own = np.arange(len(table))
    base = np.full(draws.max() + 1, -1)
    base[draws[change == 0]] = own[change == 0]
    is_alone = (base[draws] < 0) | (table["twin_size"].notna() & (table["perturbation_size"] > 0)).to_numpy()
    is_start = (unit_of == Unit.START) & table["start_draw"].notna().to_numpy()
    starts = table["start_draw"].to_numpy(np.float64, na_value=-1.0).astype(np.int64)
    unit = np.where(is_start, starts, table["matrix"].to_numpy(np.int64))
    coordinates = Coordinates(point[place], unit, method, change, np.where(is_alone, own, base[draws]))
    of_methods = tuple(Method(one.pop("engine"), tuple(pair for pair in one.items() if pair[1] is not None))
                       for one in methods)  # fmt: skip
    return coordinates, Design(**design, methods=of_methods, changes=tuple(listed))


def _units(table: pd.DataFrame) -> np.ndarray:
    """What the units of each member are, shape (R,): starts of one system, files of one system each, or matrices."""
    kind, kinds = _distinct(table[["n", "file"]])
    n_matrices, n_starts = table[["matrix", "start_draw"]].groupby(kind).nunique().to_numpy().T
    of_files = [one["n"] for one in kinds if one["file"] is not None]
    several = [one["n"] for one, *n in zip(kinds, n_matrices, n_starts, strict=True) if max(n) > 1]
    units = [
        Unit.START if n == 1 and starts > 1
        else Unit.FILE if one["n"] in {*of_files} - {*several} and one["file"] is not None
        else Unit.MATRIX
        for one, n, starts in zip(kinds, n_matrices, n_starts, strict=True)
    ]  # fmt: skip
    return np.array(units, dtype=object)[kind]


def _distinct(table: pd.DataFrame) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """The number of each row among rows that differ, shape (R,), and these; None stands for null."""
    code = np.zeros(len(table), dtype=np.int64)
    for name in table:
        found, values = pd.factorize(table[name])  # -1 for null
        code = np.unique(code * (len(values) + 1) + found + 1, return_inverse=True)[1]
    _, first = np.unique(code, return_index=True)
    return code, records(table.iloc[first])


def _grid(systems: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, dict[str, Any]]:
    """The number of each system's point, and the axes, constants, sources and fixed starts of a design."""
    at = [_values(one) for one in systems]
    named = dict.fromkeys(key for one in at for key in one)
    if all(one.get("w") == one.get("belt_speed") for one in at):
        named.pop("w", None)  # all start on the belt
    alike: dict[tuple[Any, ...], list[dict[str, Value]]] = {}
    for one, values in zip(systems, at, strict=True):
        alike.setdefault(tuple(one[name] for name in _SOURCE), []).append(values)
    keys = [key for key in named if all(key in one for one in at)
            and any(len({one[key] for one in some}) > 1 for some in alike.values())]  # fmt: skip
    values_of = {key: sorted({one[key] for one in at}, key=rank) for key in keys}
    axes = tuple(Axis((key,), tuple((value,) for value in some)) for key, some in values_of.items())
    found = []
    for one, values in zip(systems, at, strict=True):
        unit = Unit.MATRIX if one["unit"] == Unit.START and not one["has_draw"] else one["unit"]
        rest = tuple(values.get(key) for key in named if key not in keys)
        found.append(((*(one[name] for name in _SOURCE), rest), Source(int(one["n"]), one["file"], unit)))
    numbers = {one: k for k, one in enumerate(dict.fromkeys(found))}
    places = [
        [numbers[one], *(axis.rows.index((values[key],)) for axis, key in zip(axes, keys, strict=True))]
        for one, values in zip(found, at, strict=True)
    ]
    shape = (len(numbers), *(len(axis.rows) for axis in axes))
    constants = tuple((key, at[0][key]) for key in named if all(one.get(key) == at[0].get(key) for one in at))
    sources = tuple(source for _, source in numbers)
    design = {"axes": axes, "constants": constants, "sources": sources, "fixed": frozenset[int]()}
    return np.ravel_multi_index(np.array(places).T, shape), design


def _values(system: Mapping[str, Any]) -> dict[str, Value]:
    """What a system has of each key that a scene may sweep, by its name there."""
    found: dict[str, Value] = {key: value for text in _TEXTS for key, value in read(system[text] or "").items()}
    for column in _SWEPT:
        if system[column] is not None and not (column == "kappa" and system["file"] is not None):
            found.setdefault(column.removesuffix("0"), float(system[column]))
    return found


def _change(move: Mapping[str, Any]) -> Change:
    twin, reading, size = (move[name] for name in _CHANGE)
    if twin:
        return Change(Kind.START, None, float(twin))
    return Change(Kind.CONSTANTS, reading or DEFAULT_READING, float(size)) if size else Change()


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as dictionaries of plain Python values, None for null."""
    nulls = table.isna().to_numpy().T.tolist()
    columns = [
        [None if is_null else value for value, is_null in zip(column.tolist(), of_column, strict=True)]
        for (_, column), of_column in zip(table.items(), nulls, strict=True)
    ]
    names = [str(name) for name in table]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
