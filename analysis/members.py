"""The table of members: its columns, the columns that are derived, and how alike members are found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.models.attractors import SLIDING
from stickslip.analysis.models.fates import COLLAPSED
from stickslip.analysis.series.runs import by_number
from stickslip.analysis.tables import designed, records
from stickslip.pipeline.design.design import Design, Unit
from stickslip.pipeline.design.values import BELT
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
MATRIX, START, FILE = Unit
SYSTEM_KEYS = ("n", "coupling", *_ALWAYS, *OPTIONAL, "t_end", "perturbation_size")
#: Columns that may be missing because a scene does without some draws, changes or engines.
_NOT_EVERYWHERE = (
    *(name for name, setting in SETTINGS.items() if not setting.in_all),
    *("ratio_draw", "perturbation_reading", "twin_size", "start_draw", "growth_rate", "seed"),
)


def noun(unit: str) -> str:
    """The noun for an independent unit in a sentence: "system" or "start"."""
    return "start" if unit == START else "system"


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
_NONE = "members: expected at least one row, got none"
#: Columns of records that the analysis takes for itself.
READ = ("growth_rate",)


#: Nullable types of pandas, by those of Python.
_TYPES = {int: "Int64", float: "Float64", bool: "boolean", str: "string"}
#: What many members share: what separates their groups, and what tells copies apart.
SHARED = (*SYSTEM_KEYS, *ENGINE_KEYS, "twin_size", "perturbation_reading", "seed")
#: Where a setting stands in the design.
POINT = ("point", "method", "change")


@dataclass(frozen=True, eq=False)
class Members:
    """The members of an ensemble: what is each one's own, the settings that many share, and the design.

    Attributes
    ----------
    own : DataFrame
        One row a member, numbered from 0 on, so that what is found of them can be told by their number: all columns
        but those of `SHARED`, and `setting`, the place of its setting; `unit` and `base`, as of `Coordinates`;
        `growth_rate`, null where friction depends on the speed of slip; `z_start` and `w_start`, the start of every
        block, null where blocks differ.
    settings : list of dict
        The values of `SHARED`, None for null, and of `POINT`. Where files are the units, `file` and `kappa`, the
        scale of a file's K, are None, and so are `z0` and `w0` where they are drawn.
    design : Design
    """

    own: pd.DataFrame
    settings: list[dict[str, Any]]
    design: Design

    @classmethod
    def of(cls, tables: Iterable[pd.DataFrame], design: Design | None = None) -> Members:
        """The members of some tables, one after the other, each with the columns in `REQUIRED` at least.

        Parameters
        ----------
        tables : iterable of DataFrame
            With the columns of `Coordinates`, if there is a design.
        design : Design, optional
            If it is left out, each column that differs is taken for a key that was swept, as in
            `stickslip.analysis.tables`.

        Raises
        ------
        ValueError
            If a column is missing, or there is no member at all; the error names what.
        """
        if design is None:
            table = _complete(pd.concat([*tables], ignore_index=True))
            if table.empty:
                raise ValueError(_NONE)
            coordinates, design = designed(table)
            tables = [table.assign(**coordinates._asdict())]
        settings: dict[tuple[Any, ...], dict[str, Any]] = {}
        parts = [_own(_complete(table), design, settings) for table in tables]
        if not settings:
            raise ValueError(_NONE)
        found = [*settings.values()]
        own = joined(parts)
        depends = np.array([any(one[name] is not None for name in SPEED_DEPENDENT) for one in found])
        # what grows need not stick where friction depends on speed, and smoothing changes the rate
        own["growth_rate"] = own["growth_rate"].astype("float64").mask(depends[own["setting"]])
        return cls(own, found, design)

    def __len__(self) -> int:
        return len(self.own)

    @cached_property
    def row_of(self) -> dict[str, int]:
        """The row of each member, by member_id."""
        return {name: k for k, name in enumerate(self.own["member_id"])}

    def at(self, rows: np.ndarray) -> Members:
        """Some of them, by their rows, whose numbers they keep."""
        return replace(self, own=self.own.iloc[rows])

    @property
    def ends(self) -> Members:
        """All of them, with the columns alone that tell how a run ended."""
        return replace(self, own=self.own[[name for name in _ENDS if name in self.own]])

    def of_each(self, name: str) -> np.ndarray:
        """A value of the settings for each member, shape (R,), of objects."""
        found = np.empty(len(self.settings), dtype=object)
        found[:] = [one[name] for one in self.settings]
        return found[self.own["setting"]]

    @property
    def together(self) -> pd.DataFrame:
        """One row a member, with all columns."""
        kinds = pd.DataFrame({name: _typed([one[name] for one in self.settings]) for name in SHARED})
        shared = kinds.take(self.own["setting"].to_numpy())
        own = self.own.drop(columns="setting").assign(outcome=self.own["outcome"].astype(str))
        return pd.concat([own, shared.set_axis(own.index)], axis="columns")

    @property
    def unchanged(self) -> np.ndarray:
        """Rows of members that are not changed copies, of constants or of the start; all if every one is a copy."""
        copies = np.array([one["change"] > 0 for one in self.settings])[self.own["setting"]]
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


def _complete(table: pd.DataFrame) -> pd.DataFrame:
    """A table with all columns that may be missing."""
    if missing := [name for name in REQUIRED if name not in table.columns]:
        raise ValueError(f"members: missing column(s) {', '.join(missing)}")
    unknown = sorted({str(outcome) for outcome in table["outcome"].unique()} - set(OUTCOMES))
    if unknown:
        raise ValueError(f"members: outcome must be one of {', '.join(OUTCOMES)}, got {unknown[0]!r}")
    absent = [name for name in (*OPTIONAL, *_NOT_EVERYWHERE) if name not in table]
    null = pd.array([None] * len(table), dtype="Int8")  # which takes the least memory
    outcomes = pd.Categorical(table["outcome"], categories=list(OUTCOMES))
    return table.assign(**dict.fromkeys(absent, null), outcome=outcomes)


def _own(table: pd.DataFrame, design: Design, settings: dict[tuple[Any, ...], dict[str, Any]]) -> pd.DataFrame:
    """`Members.own` of a table but for rates; enters new settings."""
    of_seed, seeds = pd.factorize(table["seed"])  # -1 for null
    shape = design.n_points, len(design.methods), len(design.changes), len(seeds) + 1
    codes = np.ravel_multi_index((*(table[name].to_numpy() for name in POINT), of_seed + 1), shape)
    _, first, code = np.unique(codes, return_index=True, return_inverse=True)
    numbers = {key: k for k, key in enumerate(settings)}
    of_code = []
    for row in records(table[[*SHARED, *POINT]].iloc[first]):
        key = tuple(row[name] for name in (*POINT, "seed"))
        settings.setdefault(key, row | _of_point(design, row))
        of_code.append(numbers.setdefault(key, len(numbers)))
    starts = {f"{key}_start": table[f"{key}0"].astype("float64") for key in ("z", "w")}
    own = table.drop(columns=[*SHARED, *POINT], errors="ignore").drop(columns="unit_is", errors="ignore")
    return own.assign(**starts, setting=np.array(of_code, dtype=np.int32)[code])


def _of_point(design: Design, row: Mapping[str, Any]) -> dict[str, Any]:
    """What all members of a setting share by their point, in place of what the row of one says."""
    point = design.point(int(row["point"]))
    values = design.values(point)
    found: dict[str, Any] = {"unit_is": point.unit}
    for key in ("z", "w"):
        is_belt = values.get(key) == BELT and row[f"{key}0"] == row["belt_speed"]
        if not (isinstance(values.get(key, 0.0), float) or is_belt):
            found[f"{key}0"] = None
    return found | ({"file": None, "kappa": None} if point.unit is Unit.FILE else {})
