"""How the columns of a table of numbers, truths and texts are shown on a page, by what they hold."""

from __future__ import annotations

import numpy as np
import pandas as pd

from stickslip.analysis.report.formats import Column

_WIDE = 1e4  # ratio of two numbers of a column that are not shown with the same decimals
_SHORT = 4  # digits of numbers that are shown as they are


def columns_of(table: pd.DataFrame) -> list[Column]:
    """Columns of a table with nullable types; `x_low` and `x_high` are the interval of `x`."""
    names = [str(name) for name in table]
    numeric = {str(name) for name in table if str(table[name].dtype) in ("Float64", "Int64")}
    ends = {name: (f"{name}_low", f"{name}_high") for name in names}
    ends = {name: both for name, both in ends.items() if {name, *both} <= numeric}
    hidden = {end for both in ends.values() for end in both}
    columns: list[Column] = []
    for name in names:
        if name not in hidden:
            form = _form(table[[name, *ends.get(name, ())]])
            columns.append((name.replace("_", " "), name, form))
            columns += [("interval", ends[name], form)] if name in ends else []
    return columns


def _form(table: pd.DataFrame) -> int | str | None:
    """How the numbers of a column, and of its interval, are shown."""
    dtype = str(table.dtypes.iloc[0])
    if dtype != "Float64":
        return {"string": None, "boolean": "yes", "Int64": "n" if table.shape[1] == 1 else "#"}.get(dtype)
    sizes = np.abs([size for column in table for size in table[column].dropna() if size])
    if table.shape[1] == 1 and all(float(f"{size:.{_SHORT}g}") == size for size in sizes):
        return "g"  # a setting, say
    return "#" if len(sizes) and sizes.max() > _WIDE * sizes.min() else 3
