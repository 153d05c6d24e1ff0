"""Planted tables as ensembles with a design: each key whose values differ is an axis by itself."""

import numpy as np
import pandas as pd

from stickslip import analysis
from stickslip.analysis.ensemble import Numbers
from stickslip.analysis.members import Members, records
from stickslip.analysis.series.windows import Stack
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
from stickslip.pipeline.design.values import Named, rank
from stickslip.sim.engines import SETTINGS
from stickslip.sim.systems.terms import TERMS

KEYS = {**{term.name: term.name for term in TERMS}, "z0": "z", "w0": "w"}
DRAWS = ["matrix", "seed", "start_draw", "ratio_draw"]
CHANGES = ["twin_size", "perturbation_reading", "perturbation_size"]
DRAWN = Named("drawn")


class Given(dict):
    """Change points that are in memory."""

    def stacks(self, member_ids):
        stack = Stack.of([self[name] for name in member_ids])
        yield stack.first, stack.t, stack.n_stick


class Data(analysis.Data):
    """An ensemble from a table, a row a member, and from dictionaries; a table's cell may hold a distribution."""

    def __post_init__(self):
        if isinstance(self.table, pd.DataFrame):
            object.__setattr__(self, "table", members(self.table))
        if isinstance(self.series, dict):
            object.__setattr__(self, "series", Given(self.series))
        recorded = {
            name: one._replace(values=Numbers.of(self.table, one.values)) if isinstance(one.values, dict) else one
            for name, one in self.recorded.items()
        }
        object.__setattr__(self, "recorded", recorded)


def numbered(table):
    """The number of each row among those that differ, and these."""
    places = {}
    rows = (tuple(row.values()) for row in records(table))
    return np.array([places.setdefault(row, len(places)) for row in rows]), [*places]


def members(table, unit=None, parameters=()):
    """The members of a table; starts are the units of one system, unless another unit is named.

    `parameters` are columns of keys beside the terms.
    """
    table = table.reset_index(drop=True)
    needed = ["file", "back_slip", *KEYS, *DRAWS, *CHANGES]
    table = table.assign(**{name: None for name in needed if name not in table})
    has_draw = table["start_draw"].notna()
    if unit is None:
        unit = Unit.START if has_draw.sum() > 1 and len(set(table["matrix"])) == 1 else Unit.MATRIX
    of_units = ["file", "kappa"] if unit is Unit.FILE else []
    keys = table[[*KEYS, *parameters]].astype(object).rename(columns=KEYS)
    keys.loc[has_draw, ["z", "w"]] = DRAWN
    if keys["w"].equals(table["belt_speed"].astype(object)):
        keys["w"] = None  # all start on the belt
    keys = keys.drop(columns=of_units, errors="ignore")
    axes = [Axis((key,), tuple((value,) for value in sorted(set(keys[key]), key=rank)))
            for key in keys if keys[key].notna().all() and len({*map(str, keys[key])}) > 1]  # fmt: skip
    swept = [axis.keys[0] for axis in axes]
    others = table[["n", "file", "coupling", "back_slip", "t_end"]].drop(columns=of_units, errors="ignore")
    source, sources = numbered(pd.concat([others, keys.drop(columns=swept)], axis="columns"))
    rows = [keys[axis.keys[0]].map({value: k for k, (value,) in enumerate(axis.rows)}) for axis in axes]
    shape = (len(sources), *(len(axis.rows) for axis in axes))
    point = np.ravel_multi_index(np.array([source, *rows], dtype=int), shape)
    method, methods = numbered(table[["engine", *(name for name in SETTINGS if name in table)]])
    names = [name for name in SETTINGS if name in table]
    changed, changes = numbered(table[CHANGES])
    listed = [Change(), *(change for change in map(change_of, changes) if change != Change())]
    change = np.array([listed.index(change_of(one)) for one in changes])[changed]
    draw, _ = numbered(table[DRAWS].assign(point=point, method=method))
    base = dict(zip(draw[change == 0], np.flatnonzero(change == 0), strict=True))
    is_alone = (table["twin_size"].notna() & (table["perturbation_size"] > 0)).to_numpy()
    coordinates = Coordinates(
        point, np.where(has_draw & (unit is Unit.START), table["start_draw"].fillna(0), table["matrix"]).astype(int),
        method, change, np.array([k if is_alone[k] else base.get(draw[k], k) for k in range(len(table))]),
    )  # fmt: skip
    design = Design(
        tuple(axes),
        tuple((key, keys[key].iloc[0]) for key in keys if key not in swept and keys[key].notna().all()),
        tuple(Source(int(n), None if unit is Unit.FILE else file, unit) for n, file, *_ in sources),
        frozenset(int(k) for k in set(point[~has_draw] % np.prod(shape[1:], dtype=int)) if unit is Unit.START),
        tuple(Method(engine, tuple(pair for pair in zip(names, said, strict=True) if pair[1] is not None))
              for engine, *said in methods),
        tuple(listed),
    )  # fmt: skip
    table[[name for name, key in KEYS.items() if key in keys]] = table[
        [name for name, key in KEYS.items() if key in keys]
    ].map(lambda value: value if isinstance(value, int | float) else None)
    return Members.of([table.drop(columns=[*parameters]).assign(**coordinates._asdict())], design)


def change_of(moved):
    twin, reading, size = moved
    if twin:
        return Change(Kind.START, None, float(twin))
    return Change(Kind.CONSTANTS, reading or DEFAULT_READING, float(size)) if size else Change()
