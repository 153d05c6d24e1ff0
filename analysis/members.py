"""The table of members: its columns, the columns that are derived, and how alike members are found."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from typing import Any

import pandas as pd

from stickslip.analysis.models.attractors import SLIDING
from stickslip.analysis.models.fates import COLLAPSED
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number, Numbers
from stickslip.sim.systems.terms import TERMS

OUTCOMES = ("finished", "collapsed", "diverged", "failed")
#: Terms of a system that every table of members has.
_ALWAYS = ("belt_speed", "kappa", "rho")
#: Columns that may be missing and then count as null: what a scene may sweep or draw.
OPTIONAL = (
    "file",
    "parameters",
    *(term.name for term in TERMS if term.name not in _ALWAYS),
    *("back_slip", "z0", "w0", "drawn"),
)
#: The keys that draws depend on: along other keys draws are shared.
DRAWN = ("n", "coupling", "file")
#: What the independent units of a group may be.
MATRIX, START, FILE = "matrix", "start", "file"
SYSTEM_KEYS = ("n", "coupling", *_ALWAYS, *OPTIONAL, "t_end", "perturbation_size")
#: Columns that may be missing because a scene does without some draws, changes or engines.
_NOT_EVERYWHERE = ("step", "ratio_draw", "perturbation_reading", "twin_size", "start_draw", "growth_rate")
TOLERANCES = tuple(name for name, setting in SETTINGS.items() if isinstance(setting, Number) and setting.picked)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
#: Columns that are null unless friction depends on the speed of slip.
SPEED_DEPENDENT = ("eps", *(term.name for term in TERMS if term.table == "weakening"))
REQUIRED = (
    *(key for key in SYSTEM_KEYS if key not in OPTIONAL),
    *(key for key in ENGINE_KEYS if key not in _NOT_EVERYWHERE),
    "member_id",
    "matrix",
    "outcome",
    "reason",
    "t_stop",
)
#: Columns of records that the analysis takes for itself.
READ = ("growth_rate",)


def completed(members: pd.DataFrame) -> pd.DataFrame:
    """Members with every column: missing ones as null, and those that the functions `with_*` add or set to null.

    Rows are numbered from 0 on, so that what is found of them can be told by their number.
    """
    absent = [name for name in (*OPTIONAL, *_NOT_EVERYWHERE) if name not in members]
    null = pd.array([None] * len(members), dtype="Int8")  # which takes the least memory
    return with_rates(with_starts(with_units(members.assign(**dict.fromkeys(absent, null)).reset_index(drop=True))))


def known_outcomes(members: pd.DataFrame) -> pd.Series:
    """Outcomes, where a finished run counts as collapsed that is recorded to slide for ever, which is a proof."""
    outcomes = members["outcome"]
    if "attractor" not in members:
        return outcomes
    return outcomes.mask((outcomes == "finished") & (members["attractor"] == SLIDING), COLLAPSED)


def with_units(members: pd.DataFrame) -> pd.DataFrame:
    """Members with the columns `unit`, a number, and `unit_is`, one of `MATRIX`, `START` and `FILE`.

    Where files are the units, `file` and `kappa`, the scale of a file's K, become null, so that they do not separate
    groups.
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
    """Members with the columns `z_start` and `w_start`, the start of every block; null where blocks differ.

    `z0` and `w0` become null where `drawn` names their distribution, so that draws do not separate groups.
    """
    found = members.assign(z_start=members["z0"].astype("float64"), w_start=members["w0"].astype("float64"))
    drawn = found["drawn"].astype("string").fillna("")
    for key, column in (("z", "z0"), ("w", "w0")):
        found[column] = found[column].mask(drawn.str.contains(rf"(?:^|; ){key} = "))
    return found


def with_rates(members: pd.DataFrame) -> pd.DataFrame:
    """Members with `growth_rate` as a number, null where friction depends on the speed of slip.

    The rate is that of the state in which all blocks slip under constant friction; smoothing and weakening change it.
    """
    depends = members[list(SPEED_DEPENDENT)].notna().any(axis=1)
    return members.assign(growth_rate=members["growth_rate"].astype("float64").mask(depends))


def unchanged(members: pd.DataFrame) -> pd.DataFrame:
    """Members that are not changed copies, of constants or of the start; all members if every one is a copy."""
    changed = (members["perturbation_size"] > 0) | members["twin_size"].notna()
    return members if changed.all() else members[~changed]


def split(members: pd.DataFrame, keys: Sequence[str]) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """Members split by their values of some columns: each set of values, None for null, with its members."""
    return [(key, members.iloc[some]) for key, some in places(members, keys)]


def places(members: pd.DataFrame, keys: Sequence[str]) -> list[tuple[dict[str, Any], list[int]]]:
    """As `split`, with the places of the members in their table instead."""
    # most columns hold one value only, which is then handled once for all members
    differ = {name: len(members[name].unique()) > 1 for name in keys}
    short = {name: members[name] if differ[name] else members[name].iloc[:1] for name in keys}
    plain = {name: column.astype(object).where(column.notna(), None) for name, column in short.items()}
    at: dict[tuple[Any, ...], list[int]] = {}
    columns = (plain[name] if differ[name] else repeat(plain[name].iloc[0], len(members)) for name in keys)
    for k, row in enumerate(zip(*columns, strict=True) if len(members) else ()):
        at.setdefault(row, []).append(k)
    return [(dict(zip(keys, row, strict=True)), some) for row, some in at.items()]
