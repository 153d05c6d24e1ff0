"""The columns of a dataset as plain data, and the names that they leave to functions of a user's own.

A row has what a member is, the parameters of its function, what belongs to the parts that its scene has, and what is
kept of its run. Terms, settings of engines and records declare their own columns.
"""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.pipeline.records import ALWAYS, RECORDS
from stickslip.pipeline.records.record import Record
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Choice, Number, Numbers, Ratios
from stickslip.sim.systems.scales import Scales
from stickslip.sim.systems.terms import TERMS, Term


class Part(NamedTuple):
    """A part of a dataset that depends on its scene: columns, and which others may be null then."""

    asked_by: str  #: the line of a scene that asks for it
    columns: tuple[Column, ...] = ()  #: its own
    nulls: tuple[str, ...] = ()  #: columns of every dataset that may be null with it


def _column(term: Term, nullable: bool = True) -> Column:
    """The column of a term, which is as the scene has it."""
    return Column("number", term.name, term.described, nullable, dimension=term.dimension, is_written=True)


_BY_BLOCK = ("rho", "friction", "z0", "w0")
_OF_TERMS = {
    part: tuple(_column(term) for term in TERMS if term.part == part)
    for part in dict.fromkeys(term.part for term in TERMS)
    if part
}


def _of_term(name: str) -> Part:
    """The part that a scene has with a term of that part."""
    term = next(term for term in TERMS if term.part == name)
    return Part(f"`{term.table or term.key}` under [system]", _OF_TERMS[name])


#: Settings of engines whose columns are in the datasets that have such an engine.
OF_SETTINGS = tuple(
    name for name, setting in SETTINGS.items() if not setting.in_all and not isinstance(setting, Numbers)
)


def _owners(name: str) -> list[str]:
    """The engines that have a setting."""
    return [engine.name for engine in ENGINES.values() if name in engine.settings()]


def _engines_with(name: str) -> str:
    """The lines of a scene that ask for the columns of a setting."""
    return " or ".join(f'`[[engine]] name = "{owner}"`' for owner in _owners(name))


def _of_setting(name: str) -> Iterator[Column]:
    """The columns of a setting, whichever engines have it."""
    setting, owners = SETTINGS[name], ", ".join(_owners(name))
    match setting:
        case Number():
            yield Column("number", name, setting.column or f"{setting.words} ({owners})")
        case Choice():
            yield Column("text", name, setting.column or f"{setting.words} ({owners})")
        case Ratios():
            yield Column("text", name, f"{setting.words}: one, or uniform in (0, 1] ({owners})")
            yield Column("whole", f"{name}_draw", f"number of the draw of the r_i ({owners}, uniform)")


#: In the order of their columns; parts of terms that are not named here come last.
PARTS = {
    "file": Part(
        '`coupling = "file"` under [system]',
        (Column("text", "file", "file that K is read from, as named beside the scene", False),),
    ),
    # numbers of 64 bits in the column `matrix`
    "long_matrix": Part("`version = 2` of the files under [system], for which `matrix` has 64 bits"),
    # columns that each scene names itself
    "function": Part(
        "`parameters` under [system], each a column of numbers by its name",
        nulls=("kappa", "rho", "friction", "belt_speed", "w0"),
    ),
    "graph": Part('`coupling = "chain"`, or another graph, under [system]', _OF_TERMS["graph"]),
    "damping": Part("`damping` under [system], or in its file", _OF_TERMS["damping"], _BY_BLOCK),
    "rayleigh": _of_term("rayleigh")._replace(nulls=("rho",)),
    "static": _of_term("static"),
    "mass": _of_term("mass"),
    # speeds that differ, or change in time: null in their column
    "belts": Part(
        "a distribution, or times and values, of `belt_speed` under [system], or arrays of a file",
        nulls=("belt_speed", "w0"),
    ),
    "force": _of_term("force"),
    "weakening": _of_term("weakening"),
    "load": Part(
        '`load = "adiabatic"` under [run]',
        (Column("text", "load", "adiabatic: the belt waits while a block slips, t is its travel over |v|", False),),
    ),
    "back_slip": Part(
        "`back_slip = false` under [system]",
        (Column("text", "back_slip", "barred: no block gets ahead of its belt"),),
    ),
    "drawn": Part(
        "a distribution in [system] or [start], or arrays of a file",
        (
            Column("text", "drawn", "which parameters are drawn for each block, and from what; theirs is null"),
            Column("whole", "start_draw", "number of the draw of the start; null if it is not drawn"),
        ),
        _BY_BLOCK,
    ),
    **{name: Part(_engines_with(name), tuple(_of_setting(name))) for name in OF_SETTINGS},
}
PARTS |= {part: _of_term(part) for part in _OF_TERMS if part not in PARTS}


#: What a member is, in every dataset.
MEMBER = (
    Column("text", "member_id", "name of the run, unique in the dataset", False),
    Column("whole", "n", "number of blocks", False),
    Column("text", "coupling", "ensemble that K and R are drawn from", False),
    *(_column(term, False) for term in TERMS if not term.part),
    Column(
        "whole", "matrix", "number of the random system; runs with the same n and matrix share what is drawn", False
    ),
    Column("number", "perturbation_size", "relative change of the system's constants; 0: unchanged", False),
    Column("whole", "perturbation_draw", "number of the random change; null if unchanged"),
    Column(
        "text",
        "perturbation_reading",
        "what the size is relative to: scale, relative or damping matrix; null if unchanged",
    ),
    Column("number", "twin_size", "how far the start is moved, as a distance like `separation`; null: not"),
    Column("text", "engine", f"method of integration: {', '.join(ENGINES)}", False),
    *(column for name, setting in SETTINGS.items() if setting.in_all for column in _of_setting(name)),
    Column("text", "picked_for", "what a tolerance was picked for: statistics or paths; null: all given"),
    Column("number", "z0", "displacement of every block at t = 0", False, dimension="length", is_written=True),
    Column("number", "w0", "velocity of every block at t = 0", False, dimension="speed", is_written=True),
    Column("number", "t_end", "end of the run as asked for", False, dimension="time"),
    Column("count", "seed", "root of the scene's random draws", False),
)

#: Where a member stands in the design of its ensemble (`pipeline.design`), in the order of `Coordinates`.
DESIGN = (
    Column("whole", "design_point", "number of the point of the grid that lists span", is_later=True),
    Column(
        "count", "design_unit", "number of what is independent: matrix, start of one system or file", is_later=True
    ),
    Column("whole", "design_method", "number of the engine with its settings", is_later=True),
    Column("whole", "design_change", "number of the kind and size of change; 0: none", is_later=True),
    Column("count", "design_base", "number of the member that it is a changed copy of; else its own", is_later=True),
)

#: In every dataset.
FIXED = (*MEMBER, *DESIGN, *ALWAYS.columns)

#: What a scene may ask for, by name: the line that asks, and the columns.
ON_DEMAND = {name: (part.asked_by, part.columns) for name, part in PARTS.items()} | {
    record.name: (record.asked_by, record.columns) for record in RECORDS
}

#: All columns that there may be.
COLUMNS = (*FIXED, *(column for _, columns in ON_DEMAND.values() for column in columns))


@dataclass(frozen=True)
class Recording:
    """What a scene keeps of its members."""

    scene_hash: str
    parts: tuple[str, ...] = ()  #: of `PARTS`
    records: tuple[Record, ...] = ()
    parameters: tuple[str, ...] = ()  #: of a function, each a column
    units: Units = DIMENSIONLESS  #: those of the scene
    scales: Scales | None = None  #: what one dimensionless unit is in these; None: all is dimensionless
    #: What the numbers mean, in words by key: see `stickslip.pipeline.scene.meaning`.
    meaning: tuple[tuple[str, str], ...] = ()

    def scale(self, column: Column) -> float:
        """What a value of a column is multiplied by to be in the units of the scene."""
        if self.scales is None or column.is_written or not column.dimension:
            return 1.0
        return float(getattr(self.scales, column.dimension))

    @property
    def columns(self) -> tuple[Column, ...]:
        """In the order of a shard."""
        null = {name for part in self.parts for name in PARTS[part].nulls}
        fixed = [column._replace(nullable=column.nullable or column.name in null) for column in FIXED]
        if "long_matrix" in self.parts:
            fixed = [column._replace(kind="count") if column.name == "matrix" else column for column in fixed]
        words = "parameter of the function or the file that systems come from"
        parameter_columns = [Column("number", name, words, False) for name in self.parameters]
        of_parts = [
            column for part in self.parts for column in PARTS[part].columns if column.name not in self.parameters
        ]
        return (*fixed, *parameter_columns, *of_parts, *(column for record in self.records for column in record.kept))


# ---------------------------------------------------------------------------------------------- names

#: Columns of the tables of a dataset, as SQL and data frames have them.
_OF_TABLES = (
    *("start", "stop", "size", "rise_before", "rise_after", "t", "n_stick", "block", "mode", "distance", "threshold"),
    *(column.name.removeprefix("episode_") for column in COLUMNS if column.along == "episode"),
)
#: Dimensions in NetCDF: as they grow, no variable can have their names (`stickslip.workflows.netcdf`).
_DIMENSIONS = dict.fromkeys(column.along for column in COLUMNS if column.along)
#: Names that no parameter or column of a function can have, in lower case, as SQL ignores case, and what has each.
TAKEN = {
    "rng": "the function's generator",
    **dict.fromkeys(_DIMENSIONS, "a dimension in NetCDF"),
    **dict.fromkeys(("z", "w", "force_course", *(term.name for term in TERMS)), "a key of the scene"),
    **dict.fromkeys((name.lower() for name in (*(one.name for one in COLUMNS), *_OF_TABLES)), "a column of the data"),
}
#: Bytes of the longest name that is written to NetCDF and read from it again.
_LONGEST_NAME = 255


#: Terms of graphs that are drawn: graphs of files and functions may say theirs, and have the columns then.
OF_GRAPHS = ("degree", "rewiring")


def misnamed(
    names: Iterable[str], parameters: Iterable[str] = (), twin: str = "another parameter"
) -> tuple[str, str] | None:
    """The first name that no column of a scene's own can have, and why; None: all are good.

    `parameters` are those beside them, and `twin` is what has a name that comes twice.
    """
    owners = TAKEN | {name.lower(): "a parameter of the function" for name in parameters}
    for name in names:
        if not name.isidentifier() or keyword.iskeyword(name) or unicodedata.normalize("NFKC", name) != name:
            return name, "it is no name for an argument in Python"
        if len(name.encode()) > _LONGEST_NAME:
            return name, f"it has more than the {_LONGEST_NAME} bytes that NetCDF takes"
        if name.startswith("__"):
            return name, "names with this beginning are reserved for Arrow"
        if name.lower().endswith("_row_size"):
            return name, "names with this ending are reserved for counts in NetCDF"
        if name.lower() in owners:
            return name, f"{owners[name.lower()]} has it, in upper or lower case"
        owners[name.lower()] = twin
    return None
