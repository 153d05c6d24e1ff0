"""The table of members: its columns, the columns that are derived, and how alike members are found."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.models.attractors import SLIDING
from stickslip.analysis.models.fates import COLLAPSED
from stickslip.analysis.series.runs import by_number
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Coarseness, Number, Numbers
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
_NOT_EVERYWHERE = (
    *(name for name, setting in SETTINGS.items() if not setting.in_all),
    *("ratio_draw", "perturbation_reading", "twin_size", "start_draw", "growth_rate", "seed"),
)


def _that_coarsen(*kinds: Coarseness) -> tuple[str, ...]:
    """The settings of engines that make runs coarse in one of some ways."""
    return tuple(name for name, one in SETTINGS.items() if isinstance(one, Number) and one.coarseness in kinds)


WIDTHS, STEPS = _that_coarsen(Coarseness.WIDTH), _that_coarsen(Coarseness.STEP)
RELATIVE = _that_coarsen(Coarseness.RELATIVE)
TOLERANCES = _that_coarsen(Coarseness.RELATIVE, Coarseness.ABSOLUTE)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
#: Columns that are null unless friction depends on the speed of slip.
SPEED_DEPENDENT = (*WIDTHS, *(term.name for term in TERMS if term.table == "weakening"))
REQUIRED = (
    *(key for key in SYSTEM_KEYS if key not in OPTIONAL),
    *(key for key in ENGINE_KEYS if key not in _NOT_EVERYWHERE),
    "member_id",
    "matrix",
    "outcome",
    "reason",
    "t_stop",
)
#: Columns of `Members.own` that tell how a run ended, and of which setting and unit it is.
_ENDS = ("member_id", "unit", "setting", "outcome", "t_stop", "growth_rate", "attractor")
#: Columns of records that the analysis takes for itself.
READ = ("growth_rate",)


#: Nullable types of pandas, by those of Python.
_TYPES = {int: "Int64", float: "Float64", bool: "boolean", str: "string"}
#: What many members share: what separates their groups, and what tells copies apart.
SHARED = (*SYSTEM_KEYS, *ENGINE_KEYS, "twin_size", "perturbation_reading", "seed")


@dataclass(frozen=True, eq=False)
class Members:
    """The members of an ensemble: what is each one's own, and the settings that many share.

    Attributes
    ----------
    own : DataFrame
        One row a member, numbered from 0 on, so that what is found of them can be told by their number: all columns
        but those of `SHARED`, and `setting`, the place of its setting; `unit`, a number; `growth_rate`, null where
        friction depends on the speed of slip; `z_start` and `w_start`, the start of every block, null where blocks
        differ.
    settings : list of dict
        The values of `SHARED`, None for null, and of `unit_is`, one of `MATRIX`, `START` and `FILE`. Where files are
        the units, `file` and `kappa`, the scale of a file's K, are None, and so are `z0` and `w0` where `drawn` names
        their distribution: they do not separate groups then.
    """

    own: pd.DataFrame
    settings: list[dict[str, Any]]

    @classmethod
    def of(cls, tables: Iterable[pd.DataFrame]) -> Members:
        """The members of some tables, one after the other, each with the columns in `REQUIRED` at least.

        Raises
        ------
        ValueError
            If a column is missing, or there is no member at all; the error names what.
        """
        numbers: dict[tuple[Any, ...], int] = {}
        parts = [_own(table, numbers) for table in tables]
        if not numbers:
            raise ValueError("members: expected at least one row, got none")
        own = joined(parts)
        settings = [dict(zip(SHARED, values, strict=True)) for values in numbers]
        _set_units(own, settings)
        depends = np.array([any(one[name] is not None for name in SPEED_DEPENDENT) for one in settings])
        # what grows need not stick where friction depends on speed, and smoothing changes the rate
        own["growth_rate"] = own["growth_rate"].astype("float64").mask(depends[own["setting"]])
        return cls(own, settings)

    def __len__(self) -> int:
        return len(self.own)

    @cached_property
    def row_of(self) -> dict[str, int]:
        """The row of each member, by member_id."""
        return {name: k for k, name in enumerate(self.own["member_id"])}

    def at(self, rows: np.ndarray) -> Members:
        """Some of them, by their rows, whose numbers they keep."""
        return Members(self.own.iloc[rows], self.settings)

    @property
    def ends(self) -> Members:
        """All of them, with the columns alone that tell how a run ended."""
        return Members(self.own[[name for name in _ENDS if name in self.own]], self.settings)

    def of_each(self, name: str) -> np.ndarray:
        """A value of the settings for each member, shape (R,), of objects."""
        found = np.empty(len(self.settings), dtype=object)
        found[:] = [one[name] for one in self.settings]
        return found[self.own["setting"]]

    @property
    def together(self) -> pd.DataFrame:
        """One row a member, with all columns."""
        kinds = pd.DataFrame({name: _typed([one[name] for one in self.settings]) for name in self.settings[0]})
        shared = kinds.take(self.own["setting"].to_numpy())
        own = self.own.drop(columns="setting").assign(outcome=self.own["outcome"].astype(str))
        return pd.concat([own, shared.set_axis(own.index)], axis="columns")

    @property
    def unchanged(self) -> np.ndarray:
        """Rows of members that are not changed copies, of constants or of the start; all if every one is a copy."""
        is_copy = np.array([one["perturbation_size"] > 0 or one["twin_size"] is not None for one in self.settings])
        copies = is_copy[self.own["setting"]]
        return np.arange(len(self)) if copies.all() else np.flatnonzero(~copies)

    @property
    def known_outcomes(self) -> pd.Series:
        """Outcomes, where a finished run counts as collapsed that is recorded to slide for ever, which is a proof."""
        outcomes = self.own["outcome"]
        if "attractor" not in self.own:
            return outcomes
        return outcomes.mask((outcomes == "finished") & (self.own["attractor"] == SLIDING), COLLAPSED)

    def places(self, keys: Sequence[str], some: np.ndarray) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Some members, by their rows, split by their values of some of `SHARED`: values, and the rows with them."""
        found: dict[tuple[Any, ...], int] = {}
        of_setting = np.array([found.setdefault(tuple(one[k] for k in keys), len(found)) for one in self.settings])
        number = of_setting[self.own["setting"].to_numpy()[some]]
        values = [dict(zip(keys, one, strict=True)) for one in found]
        return [(values[number[own[0]]], some[own]) for own in by_number(number)]


def _typed(values: Sequence[Any]) -> pd.api.extensions.ExtensionArray:
    """Values of one kind with the nullable type of pandas for it; null stands for None."""
    kinds = {type(value) for value in values if value is not None}
    dtypes: list[Any] = [_TYPES.get(kind, object) for kind in kinds] or ["Int8"]
    return pd.array(list(values), dtype=dtypes[0] if len(dtypes) == 1 else object)


def joined(parts: list[pd.DataFrame]) -> pd.DataFrame:
    """Tables with the same columns, one after the other; they lose theirs on the way, so that none is there twice."""
    names = [*parts[0]]
    columns = {name: pd.concat([part.pop(name) for part in parts], ignore_index=True) for name in names}
    return pd.DataFrame(columns, copy=False)


def _own(table: pd.DataFrame, numbers: dict[tuple[Any, ...], int]) -> pd.DataFrame:
    """`Members.own` of a table but for units and rates; enters new settings into `numbers`."""
    if missing := [name for name in REQUIRED if name not in table.columns]:
        raise ValueError(f"members: missing column(s) {', '.join(missing)}")
    unknown = sorted({str(outcome) for outcome in table["outcome"].unique()} - set(OUTCOMES))
    if unknown:
        raise ValueError(f"members: outcome must be one of {', '.join(OUTCOMES)}, got {unknown[0]!r}")
    absent = [name for name in (*OPTIONAL, *_NOT_EVERYWHERE) if name not in table]
    null = pd.array([None] * len(table), dtype="Int8")  # which takes the least memory
    found = table.assign(
        **dict.fromkeys(absent, null), outcome=pd.Categorical(table["outcome"], categories=list(OUTCOMES))
    )
    for key in ("z", "w"):
        found[f"{key}_start"] = found[f"{key}0"].astype("float64")
    if found["drawn"].notna().any():
        drawn = found["drawn"].astype("string").fillna("")
        for key in ("z", "w"):
            found[f"{key}0"] = found[f"{key}0"].mask(drawn.str.contains(rf"(?:^|; ){key} = "))
    # `unit_is` is of a table that `Members.together` made
    own = found.drop(columns=list(SHARED)).drop(columns="unit_is", errors="ignore")
    return own.assign(setting=_numbered(found[list(SHARED)], numbers))


def _numbered(shared: pd.DataFrame, numbers: dict[tuple[Any, ...], int]) -> np.ndarray:
    """The number of each row of values, new ones entered; None stands for null."""
    code = np.zeros(len(shared), dtype=np.int64)
    for name in shared:
        found, values = pd.factorize(shared[name])  # -1 for null
        if (found == found[:1]).all():  # as most are
            continue
        code = np.unique(code * (len(values) + 1) + found + 1, return_inverse=True)[1]
    _, first = np.unique(code, return_index=True)
    kinds = shared.iloc[first].astype(object)
    rows = kinds.where(kinds.notna(), None).itertuples(index=False, name=None)
    return np.array([numbers.setdefault(row, len(numbers)) for row in rows], dtype=np.int32)[code]


def _set_units(own: pd.DataFrame, settings: list[dict[str, Any]]) -> None:
    """Add what the units of members are, and their numbers."""
    kinds = {(one["n"], one["file"]): k for k, one in reversed([*enumerate(settings)])}
    of_setting = np.array([kinds[one["n"], one["file"]] for one in settings])
    by = of_setting[own["setting"]]
    counts = own[["matrix", "start_draw"]].groupby(by).nunique()
    is_one, n_starts = counts["matrix"] == 1, counts["start_draw"]
    unit_is = dict.fromkeys(kinds.values(), MATRIX)
    for n in {n for n, _ in kinds}:
        files = [k for (one, file), k in kinds.items() if one == n and file is not None]
        if files and (is_one[files] & (n_starts[files] <= 1)).all():
            unit_is |= dict.fromkeys(files, FILE)
    unit_is |= dict.fromkeys(n_starts.index[is_one & (n_starts > 1)], START)
    is_drawn = own["start_draw"].groupby(own["setting"]).count() > 0
    for number, (one, k) in enumerate(zip(settings, of_setting.tolist(), strict=True)):
        one["unit_is"] = MATRIX if unit_is[k] == START and not is_drawn[number] else unit_is[k]
        if unit_is[k] == FILE:
            one |= {"file": None, "kappa": None}
    own["unit"] = own["matrix"].astype("int64")
    of_start = np.array([one["unit_is"] == START for one in settings])[own["setting"]] & own["start_draw"].notna()
    if of_start.any():
        own.loc[of_start, "unit"] = own["start_draw"][of_start].astype("int64")
