"""The members of an ensemble as the statistics see them: what is each one's own, and the settings that many share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from stickslip.analysis.models.attractors import SLIDING
from stickslip.analysis.models.fates import COLLAPSED
from stickslip.pipeline.design.design import Design, Unit
from stickslip.pipeline.design.values import BELT, InTime, Pushes, Value, Values
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Coarseness, Number, Numbers
from stickslip.sim.systems.terms import TERMS

OUTCOMES = ("finished", "collapsed", "diverged", "failed")
#: The keys that draws depend on: along other keys draws are shared.
DRAWN = ("n", "coupling", "file")
#: What the independent units of a group may be.
MATRIX, START, FILE = Unit
#: Terms that names of settings begin with.
_FIRST = ("belt_speed", "kappa", "rho")
#: What members of a setting share of the system; `values` is what it has of keys without a number in their column.
SYSTEM_KEYS = (
    *("n", "coupling", *_FIRST, "file"),
    *(term.name for term in TERMS if term.name not in _FIRST),
    *("back_slip", "z0", "w0", "values", "t_end", "perturbation_size"),
)
#: Columns of records that the analysis takes for itself.
READ = ("growth_rate",)


def noun(unit: str) -> str:
    """The noun for an independent unit in a sentence: "system", "start" or "file"."""
    return "system" if unit == MATRIX else unit


def _that_coarsen(*kinds: Coarseness) -> tuple[str, ...]:
    """The settings of engines that make runs coarse in one of some ways."""
    return tuple(
        name for name, setting in SETTINGS.items() if isinstance(setting, Number) and setting.coarseness in kinds
    )


WIDTHS, STEPS = _that_coarsen(Coarseness.WIDTH), _that_coarsen(Coarseness.STEP)
RELATIVE = _that_coarsen(Coarseness.RELATIVE)
TOLERANCES = _that_coarsen(Coarseness.RELATIVE, Coarseness.ABSOLUTE)
ENGINE_KEYS = (
    "engine",
    *(name for name, setting in SETTINGS.items() if name not in TOLERANCES and not isinstance(setting, Numbers)),
    *TOLERANCES,
)
_WEAKENING = tuple(term.name for term in TERMS if term.table == "weakening")
#: Columns that are null unless friction depends on the speed of slip.
_SPEED_DEPENDENT = (*WIDTHS, *_WEAKENING)
#: What members of a setting share, and what tells copies and systems of different seeds apart.
SHARED = (*SYSTEM_KEYS, *ENGINE_KEYS, "twin_size", "perturbation_reading", "seed")
#: The values of these, by name.
Shared: TypeAlias = Mapping[str, Any]
#: Nullable types of pandas, by those of Python.
_TYPES: dict[type, Any] = {int: "Int64", float: "Float64", bool: "boolean", str: "string"}
#: Where a setting stands in the design.
POINT = ("point", "method", "change")


class Proofs(StrEnum):
    """Why it is not proved of runs that slide that no block sticks again."""

    SOUGHT = "there is no proof that no block does"
    SOUGHT_WHERE_IT_SAVES_TIME = (
        "a proof that no block does was sought only where it saves time (set collapse = true under [record])"
    )
    NONE_EXISTS = "no proof exists where forces or belts change, belts differ, or friction weakens with speed"


@dataclass(frozen=True, eq=False)
class Members:
    """The members of an ensemble: what is each one's own, the settings that many share, and the design.

    Attributes
    ----------
    own : DataFrame
        One row a member, numbered from 0 on, so that what is found of them can be told by their number: all columns
        but those of `SHARED`, and `setting`, the place of its setting; `unit` and `base`, as of `Coordinates`;
        `growth_rate`, null where friction depends on the speed of slip; `z_start` and `w_start`, the start of every
        block, null where blocks differ; `system`, what one from a file is called.
    settings : list of dict
        The values of `SHARED`, None for null, and of `POINT`. Where files are the units, `file` and `kappa`, the
        scale of a file's K, are None, and so are `z0` and `w0` where they are drawn.
    """

    own: pd.DataFrame
    settings: list[dict[str, Any]]
    design: Design

    @classmethod
    def of(cls, tables: Iterable[pd.DataFrame], design: Design) -> Members:
        """The members of some tables, one after the other, as a dataset has them, with the columns of `Coordinates`.

        Raises
        ------
        ValueError
            If there is no member at all.
        """
        settings: dict[tuple[Any, ...], dict[str, Any]] = {}
        pieces = [_own(table, design, settings) for table in tables]
        if not settings:
            raise ValueError("members: expected at least one row, got none")
        shared, entire = [*settings.values()], joined(pieces)
        depends = np.array([any(setting[name] is not None for name in _SPEED_DEPENDENT) for setting in shared])
        # what grows need not stick where friction depends on speed, and smoothing changes the rate
        entire["growth_rate"] = entire["growth_rate"].astype("float64").mask(depends[entire["setting"]])
        return cls(entire, shared, design)

    def __len__(self) -> int:
        return len(self.own)

    @cached_property
    def row_of(self) -> dict[str, int]:
        """The row of each member, by member_id."""
        return {name: k for k, name in enumerate(self.own["member_id"])}

    @cached_property
    def windows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The number of blocks, the end and the period of the force of the runs of each setting, shape (S,) each."""
        columns = zip(*((key["n"], key["t_end"], force_period(key)) for key in self.settings), strict=True)
        n, t_end, period = map(np.array, columns)
        return n, t_end, period

    def at(self, rows: np.ndarray) -> Members:
        """Some of them, by their rows, whose numbers they keep."""
        return replace(self, own=self.own.iloc[rows])

    def unit_of(self, member_id: str) -> str:
        """What the independent unit of a member is called: by its file, or else by its number."""
        member = self.own.iloc[self.row_of[member_id]]
        is_of_file = "system" in member and self.settings[member["setting"]]["unit_is"] is not Unit.START
        return str(member["system" if is_of_file else "unit"])

    @property
    def together(self) -> pd.DataFrame:
        """One row a member, with all columns."""
        shared = pd.DataFrame({name: _typed([setting[name] for setting in self.settings]) for name in SHARED})
        shared = shared.take(self.own["setting"].to_numpy()).set_axis(self.own.index)
        table = self.own.drop(columns="setting").assign(outcome=self.own["outcome"].astype(str))
        return pd.concat([table, shared], axis="columns")

    @property
    def unchanged(self) -> np.ndarray:
        """Rows of members that are not changed copies, of constants or of the start; all if every one is a copy."""
        is_copy = np.array([setting["change"] > 0 for setting in self.settings])[self.own["setting"]]
        return np.arange(len(self)) if is_copy.all() else np.flatnonzero(~is_copy)


def frequencies(setting: Shared) -> list[Any]:
    """Those of the harmonic forces of a setting: numbers, or what they are drawn from."""
    values = dict(setting["values"])
    several = values.get("forces")
    if isinstance(several, Pushes):
        return [push.harmonic[_FREQUENCY] for push in several.parts if push.course is None]
    frequency = values.get("force_frequency", setting["force_frequency"])
    return [] if frequency is None else [frequency]


def force_period(setting: Shared) -> float:
    """The period of the harmonic forces of a setting; NaN where there is none, or one is drawn.

    Of several the one that they share or, where that is not a few periods of the slowest, that of the slowest.
    """
    slowest, n_shared = _periods(setting)
    return slowest * max(n_shared, 1)


def shift_unit(setting: Shared) -> float:
    """By whole multiples of what blocks may be shifted in time, each by itself: 0 where nothing changes in time.

    It is the period that all forces share, which so keep their phases; NaN where there is none, or something else
    changes.
    """
    if has_course(setting):
        return np.nan
    slowest, n_shared = _periods(setting)
    return (slowest * n_shared if n_shared else np.nan) if any(frequencies(setting)) else 0.0


def has_course(setting: Shared) -> bool:
    """Whether a belt, a force or any other number changes in time otherwise than harmonically."""
    values = dict(setting["values"])
    pushes = values["forces"].parts if isinstance(values.get("forces"), Pushes) else ()
    return any(isinstance(course, InTime) for course in (*values.values(), *(push.course for push in pushes)))


def _periods(setting: Shared) -> tuple[float, int]:
    """The period of the slowest force, NaN where none is known, and how many of these all forces share, 0 if none."""
    of_forces = [frequency for frequency in frequencies(setting) if frequency != 0.0]
    if not of_forces or not all(isinstance(frequency, float) for frequency in of_forces):
        return np.nan, 0
    turning = np.abs(of_forces)
    ratios = np.outer(np.arange(1, _MOST_PERIODS + 1), turning / turning.min())
    is_shared = (abs(ratios - ratios.round()) < _ROUNDING * ratios).all(axis=1)
    n_shared = 1 + int(is_shared.argmax()) if is_shared.any() else 0
    return float(2.0 * np.pi / turning.min()), n_shared


def may_be_proved(setting: Shared) -> bool:
    """Whether it may be proved that no block sticks again.

    There are proofs on one belt of constant speed under constant forces, where friction does not weaken with speed.
    """
    is_constant = not has_course(setting) and not any(frequencies(setting))
    return (
        is_constant
        and "belt_speed" not in dict(setting["values"])
        and all(setting[name] is None for name in _WEAKENING)
    )


_FREQUENCY = 1  # of the numbers of a harmonic force
_MOST_PERIODS, _ROUNDING = 12, 1e-9  # of the slowest force, that several may share; of their ratios


def known_outcomes(own: pd.DataFrame) -> pd.Series:
    """Outcomes, where a finished run counts as collapsed that is recorded to slide for ever, which is a proof."""
    outcomes = own["outcome"]
    if "attractor" not in own:
        return outcomes
    return outcomes.mask((outcomes == "finished") & (own["attractor"] == SLIDING), COLLAPSED)


def _typed(values: Sequence[Any]) -> pd.api.extensions.ExtensionArray:
    """Values of one kind with the nullable type of pandas for it; null stands for None."""
    kinds = {type(value) for value in values if value is not None}
    dtypes = [_TYPES.get(kind, object) for kind in kinds] or ["Int8"]
    return pd.array(list(values), dtype=dtypes[0] if len(dtypes) == 1 else object)


def joined(parts: list[pd.DataFrame]) -> pd.DataFrame:
    """Tables with the same columns, one after the other; they lose theirs on the way, so that none is there twice."""
    names = [*parts[0]]
    columns = {name: pd.concat([table.pop(name) for table in parts], ignore_index=True) for name in names}
    return pd.DataFrame(columns, copy=False)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as dictionaries of plain Python values, None for null."""
    plain = table.astype(object)
    rows = plain.where(plain.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def _own(table: pd.DataFrame, design: Design, settings: dict[tuple[Any, ...], dict[str, Any]]) -> pd.DataFrame:
    """`Members.own` of a table but for rates; enters new settings."""
    null = pd.array([None] * len(table), dtype="Int8")  # which takes the least memory
    columns = (*SHARED, "start_draw", "ratio_draw", "growth_rate")
    table = table.assign(
        **dict.fromkeys((name for name in columns if name not in table), null),
        outcome=pd.Categorical(table["outcome"], categories=list(OUTCOMES)),
    )
    of_seed, seeds = pd.factorize(table["seed"])  # -1 for null
    shape = design.n_points, len(design.methods), len(design.changes), len(seeds) + 1
    codes = np.ravel_multi_index((*(table[name].to_numpy() for name in POINT), of_seed + 1), shape)
    _, places, code = np.unique(codes, return_index=True, return_inverse=True)
    numbers = {key: k for k, key in enumerate(settings)}
    of_code = []
    for row in records(table[[*SHARED, *POINT]].iloc[places]):
        key = tuple(row[name] for name in (*POINT, "seed"))
        settings.setdefault(key, row | _of_point(design, row))
        of_code.append(numbers.setdefault(key, len(numbers)))
    starts = {f"{key}_start": table[f"{key}0"].astype("float64") for key in ("z", "w")}
    table_own = table.drop(columns=[*SHARED, *POINT])
    return table_own.assign(**starts, setting=np.array(of_code, dtype=np.int32)[code])


def _of_point(design: Design, row: dict[str, Any]) -> dict[str, Any]:
    """What all members of a setting share by their point, in place of what the row of one says."""
    point = design.point(int(row["point"]))
    values = design.values(point)
    shared: dict[str, Any] = {"unit_is": point.unit}
    for key in ("z", "w"):
        is_belt = values.get(key) == BELT and row[f"{key}0"] == row["belt_speed"]
        if not (isinstance(values.get(key, 0.0), float) or is_belt):
            shared[f"{key}0"] = None
    if point.unit is Unit.FILE:
        shared |= {"file": None, "kappa": None}
    columns = {name.removesuffix("0"): value for name, value in (row | shared).items()}
    swept = design.swept(point)

    def is_beside(key: str, value: Value) -> bool:
        """Whether no column has it; a number in the scene says nothing where a file or a function has its own."""
        return columns.get(key) is None and (key in swept or key not in columns or not isinstance(value, float))

    return shared | {"values": Values(pair for pair in values.items() if is_beside(*pair))}
