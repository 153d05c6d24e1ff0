"""The table of members: its columns, what is added to them, and members that are alike."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from typing import Any

import pandas as pd

from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number, Numbers
from stickslip.sim.systems.terms import TERMS

OUTCOMES = ("finished", "collapsed", "diverged", "failed")
#: Terms of a system that every table of members says.
_ALWAYS = ("belt_speed", "kappa", "rho")
#: Columns of members that may be left out, as if null: what a scene may sweep or draw.
OPTIONAL = (
    "file",
    "parameters",
    *(term.name for term in TERMS if term.name not in _ALWAYS),
    *("back_slip", "z0", "w0", "drawn"),
)
#: What the units of a group may be.
MATRIX, START, FILE = "matrix", "start", "file"
SYSTEM_KEYS = ("n", "coupling", *_ALWAYS, *OPTIONAL, "t_end", "perturbation_size")
#: Columns that there may not be, of draws, changes and engines that a scene does without.
_NOT_EVERYWHERE = ("step", "ratio_draw", "perturbation_reading", "twin_size", "start_draw", "growth_rate")
TOLERANCES = tuple(name for name, setting in SETTINGS.items() if isinstance(setting, Number) and setting.picked)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
#: Columns that are null unless friction hangs on the speed of slip.
HANG_ON_SPEED = ("eps", *(term.name for term in TERMS if term.table == "weakening"))
REQUIRED = (
    *(key for key in SYSTEM_KEYS if key not in OPTIONAL),
    *(key for key in ENGINE_KEYS if key not in _NOT_EVERYWHERE),
    "member_id",
    "matrix",
    "outcome",
    "reason",
    "t_stop",
)


def completed(members: pd.DataFrame) -> pd.DataFrame:
    """Members with every column: those that may be left out as null, and those that `with_*` add or blank."""
    absent = [name for name in (*OPTIONAL, *_NOT_EVERYWHERE) if name not in members]
    return with_rates(with_starts(with_units(members.assign(**dict.fromkeys(absent)))))


def with_units(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the columns `unit`, a number, and `unit_is`, which of `MATRIX`, `START` and `FILE` it is.

    Where files are the units, `file` and `kappa`, the scale of a file's K, are null: they tell no groups apart.
    """
    found = members.assign(unit=members["matrix"].astype("int64"), unit_is=MATRIX)
    starts = found["start_draw"]
    by = [found["n"], found["file"]]
    is_one = found["matrix"].groupby(by, dropna=False).transform("nunique") == 1
    n_starts = starts.groupby(by, dropna=False).transform("nunique")
    of_file = found["file"].notna()
    of_file &= (is_one & (n_starts <= 1)).groupby([of_file, found["n"]]).transform("all")
    of_start = is_one & (n_starts > 1) & starts.notna()
    found.loc[of_file, "unit_is"], found.loc[of_start, "unit_is"] = FILE, START
    found.loc[of_start, "unit"] = starts[of_start].astype("int64")
    if of_file.any():
        found[["file", "kappa"]] = found[["file", "kappa"]].mask(of_file)
    return found


def with_starts(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the columns `z_start` and `w_start`, where every block starts; null where blocks differ.

    What is drawn tells no groups apart: `z0` and `w0` are null where `drawn` says from what.
    """
    found = members.assign(z_start=members["z0"].astype("float64"), w_start=members["w0"].astype("float64"))
    drawn = found["drawn"].astype("string").fillna("")
    for key, column in (("z", "z0"), ("w", "w0")):
        found[column] = found[column].mask(drawn.str.contains(rf"(?:^|; ){key} = "))
    return found


def with_rates(members: pd.DataFrame) -> pd.DataFrame:
    """Members with `growth_rate` as a number, null where friction hangs on the speed of slip.

    It is the rate of the state in which all blocks slip under constant friction. Smoothing and weakening change it.
    """
    hangs = members[list(HANG_ON_SPEED)].notna().any(axis=1)
    return members.assign(growth_rate=members["growth_rate"].astype("float64").mask(hangs))


def unchanged(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the constants and the start of the original of their matrix; all of them where none has."""
    changed = (members["perturbation_size"] > 0) | members["twin_size"].notna()
    return members if changed.all() else members[~changed]


def split(members: pd.DataFrame, keys: Sequence[str]) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Members alike in some columns, null as None, with the values that they share."""
    # most columns hold one value, which then stands for all
    differ = {name: len(members[name].unique()) > 1 for name in keys}
    short = {name: members[name] if differ[name] else members[name].iloc[:1] for name in keys}
    plain = {name: column.astype(object).where(column.notna(), None) for name, column in short.items()}
    at: dict[tuple[Any, ...], list[int]] = {}
    columns = (plain[name] if differ[name] else repeat(plain[name].iloc[0], len(members)) for name in keys)
    for k, row in enumerate(zip(*columns, strict=True) if len(members) else ()):
        at.setdefault(row, []).append(k)
    return [(dict(zip(keys, row, strict=True)), members.iloc[some]) for row, some in at.items()]
