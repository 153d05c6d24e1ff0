"""What a shard holds: its columns, and how rows become its bytes."""

from __future__ import annotations

import keyword
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.pipeline.scene import Scene
from stickslip.pipeline.system_table import QUANTITIES
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Choice, Number, Ratios

#: Version of the schema below; kept in every shard and in the manifest.
SCHEMA_VERSION: Final = 3


def _of(kind: pa.DataType, name: str, description: str, nullable: bool = True) -> pa.Field:
    return pa.field(name, kind, nullable, {"description": description})


def _list(kind: pa.DataType, nullable: bool = False) -> pa.ListType:
    return pa.list_(pa.field("element", kind, nullable))  # Parquet's own name for it


_number, _whole, _count, _text = (partial(_of, kind) for kind in (pa.float64(), pa.int32(), pa.int64(), pa.string()))
_numbers, _wholes, _modes = (partial(_of, _list(kind)) for kind in (pa.float64(), pa.int32(), pa.int8()))


def _struct(**kinds: pa.DataType) -> pa.StructType:
    return pa.struct([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


def _of_engines() -> Iterator[pa.Field]:
    """The columns of the engines' settings, each once, whichever engines have it."""
    for name, setting in SETTINGS.items():
        if name in RECORDED:
            continue
        owners = ", ".join(engine.name for engine in ENGINES.values() if name in engine.settings())
        match setting:
            case Number():
                yield _number(name, setting.column or f"{setting.words} ({owners})")
            case Choice():
                yield _text(name, setting.column or f"{setting.words} ({owners})")
            case Ratios():
                yield _text(name, f"{setting.words}: one, or uniform in (0, 1] ({owners})")
                yield _whole(f"{name}_draw", f"number of the draw of the r_i ({owners}, uniform)")


#: What a scene may ask for beside n_stick; the first ones by its keys in [system] and [start].
RECORDED = {
    "file": [_text("file", "file that K is read from, as named beside the scene", False)],
    "long_matrix": [],  # numbers of 64 bits in the column `matrix`
    "function": [],  # its parameters, which each scene names itself
    "graph": [
        _number("leaf", "stiffness of every block's leaf spring; null if drawn"),
        _number("degree", "mean number of neighbours; null if not a network"),
    ],
    "damping": [_number("damping", "damping R of every block; null if drawn")],
    "static": [_number("static", "static friction of every block; null if drawn")],
    "mass": [_number("mass", "mass of every block; null if drawn")],
    "belts": [],  # speeds that differ, or change in time: null in their column
    "force": [
        _number("force_amplitude", "amplitude of the force on every block; null if drawn"),
        _number("force_frequency", "frequency of the force, in radians a unit of time; null if drawn"),
        _number("force_phase", "phase of the force at t = 0; null if drawn"),
    ],
    "weakening": [
        _number("weakening_rate", "rate at which friction falls with slip; null if not rational"),
        _number("weakening_speed", "speed of slip over which it falls; null if not Stribeck's"),
    ],
    "back_slip": [_text("back_slip", "barred: no block gets ahead of its belt")],
    "drawn": [
        _text("drawn", "which parameters are drawn for each block, and from what; theirs is null"),
        _whole("start_draw", "number of the draw of the start; null if it is not drawn"),
    ],
    "step": [_number("step", "longest step (moreau)")],
    "end": [
        _numbers("z_end", "displacement of each block at the end of the run, t_end or earlier"),
        _numbers("w_end", "velocity of each block then"),
        _modes("mode_end", "mode of each block then: -1 or +1 slips, 0 sticks"),
    ],
    "growth_rate": [
        _number(
            "growth_rate",
            "largest real part of the eigenvalues of the system with all blocks slipping; below 0 it comes to rest",
        ),
    ],
    "events": [
        _numbers("event_t", "times of the events, never decreasing"),
        _wholes("event_block", "block of each event"),
        _modes("event_mode", "the block's mode from the event on: -1 or +1 slips, 0 sticks"),
        _modes("initial_mode", "mode of each block at t = 0"),
    ],
    "episodes": [
        _numbers("episode_start", "when the first block leaves, after a time when all stick"),
        _numbers("episode_end", "when all stick again; what is cut off by an end is no episode"),
        _wholes("episode_size", "number of blocks that slipped in each episode"),
        _numbers("episode_moment", "sum of their slips on the belt, against the belt's motion"),
        _wholes("episode_first_block", "the block that left first"),
    ],
    "energy": [
        _number(
            "kinetic_energy_start",
            "sum of m w^2 / 2 at t = 0; null, as all below, if diverged, not the exact law, or too long to sum",
        ),
        _number("kinetic_energy_end", "sum of m w^2 / 2 at t_end"),
        _number("elastic_energy_start", "z K z / 2 at t = 0"),
        _number("elastic_energy_end", "z K z / 2 at t_end"),
        _number("belt_work", "what the belt gave, by friction"),
        _number("force_work", "what the force from outside gave"),
        _number("coupling_work", "what couplings gave that are not reciprocal, the skew part of K"),
        _number("damping_loss", "what damping took"),
        _number("friction_loss", "what slip on the belt took, as heat"),
    ],
    "episode_energy": [
        _of(
            _list(pa.float64(), nullable=True),
            "episode_energy",
            "what damping and friction took in each episode; null if diverged, not the exact law, or too long to sum",
        ),
    ],
    "separation": [
        _numbers(
            "separation",
            "distance from the unchanged run at k times the step that the scene gives, as far as both go: the root of"
            " the mean over blocks of dz^2 + dw^2; null for an unchanged run",
        ),
    ],
    "thresholds": [
        _of(
            _list(_struct(threshold=pa.float64(), t=_list(pa.float64()), n_stick=_list(pa.int32()))),
            "by_threshold",
            "t and n_stick of the same run where a block sticks if |w - v| < threshold r_i eps; null if not sigmoid",
        ),
    ],
}

#: By which line, in which of its tables, a scene asks for each.
ASKED_BY = {
    "file": '`coupling = "file"` under [system]',
    "long_matrix": "`version = 2` of the files under [system], for which `matrix` has 64 bits",
    "function": "`parameters` under [system], each a column of numbers by its name",
    "graph": '`coupling = "chain"`, or another graph, under [system]',
    "damping": "`damping` under [system], or in its file",
    "static": "`static` under [system]",
    "mass": "`mass` under [system]",
    "belts": "a distribution, or times and values, of `belt_speed` under [system], or arrays of a file",
    "force": "`force` under [system]",
    "weakening": "`weakening` under [system]",
    "back_slip": "`back_slip = false` under [system]",
    "drawn": "a distribution in [system] or [start], or arrays of a file",
    "step": '`[[engine]] name = "moreau"`',
    "end": "`end = true` under [record]",
    "growth_rate": "`growth_rate = true` under [record]",
    "events": "`events = true` under [record]",
    "episodes": "`episodes = true` under [record]",
    "energy": "`energy = true` under [record]",
    "episode_energy": "both, `episodes` and `energy`",
    "separation": "`separation = 5.0` under [record]",
    "thresholds": '`thresholds = [0.5, 1.0, 2.0]` under [[engine]] name = "sigmoid"',
}

#: What is null where a scene gives `damping`, or a distribution, and where a function makes the systems.
_MAY_BE_NULL = {
    "damping": {"rho", "friction", "z0", "w0"},
    "drawn": {"rho", "friction", "z0", "w0"},
    "belts": {"belt_speed", "w0"},
    "function": {"kappa", "rho", "friction", "belt_speed", "w0"},
}

#: One row a member; null where a value does not apply. All quantities are dimensionless.
SCHEMA = pa.schema(
    [
        _text("member_id", "name of the run, unique in the dataset", False),
        _whole("n", "number of blocks", False),
        _text("coupling", "ensemble that K and R are drawn from", False),
        _number("kappa", "scale of the stiffnesses", False),
        _number("rho", "scale of the dampings", False),
        _number("friction", "kinetic friction mu of every block", False),
        _number("belt_speed", "speed v of the belt", False),
        _whole("matrix", "number of the random system; runs with the same n and matrix share it", False),
        _number("perturbation_size", "relative change of the system's constants; 0: unchanged", False),
        _whole("perturbation_draw", "number of the random change; null if unchanged"),
        _text(
            "perturbation_reading",
            "what the size is relative to: scale, relative or damping matrix; null if unchanged",
        ),
        _number("twin_size", "how far the start is moved, as a distance like `separation`; null: not"),
        _text("engine", f"method of integration: {', '.join(ENGINES)}", False),
        *_of_engines(),
        _text("picked_for", "what a tolerance was picked for: statistics or paths; null: all given"),
        _number("z0", "displacement of every block at t = 0", False),
        _number("w0", "velocity of every block at t = 0", False),
        _number("t_end", "end of the run as asked for", False),
        _count("seed", "root of the scene's random draws", False),
        _text("outcome", "finished, collapsed, diverged or failed", False),
        _text("reason", "why the outcome is not finished"),
        _text(
            "reproduce",
            "command that runs a failed member alone, given in the dataset's directory; null if not failed",
        ),
        _number(
            "t_stop",
            "end of a diverged run; from when on it is certain that a collapsed one does not stick again; else t_end;"
            " null if failed",
        ),
        _whole("n_stick_end", "number of sticking blocks at t_stop; null if failed"),
        _count("n_events", "entries, exits and crossings together; null if failed"),
        _count("n_entries", "events slip -> stick; null if failed"),
        _count("n_exits", "events stick -> slip; null if failed"),
        _count("n_crossings", "events from slipping one way to the other; null if failed"),
        _count("n_steps", "steps of the engine; null if failed"),
        _count("n_rejected", "steps repeated with a smaller size; null if failed"),
        _count("n_products", "products of K with a vector; null if failed"),
        _numbers("t", "t[0] = 0 and each time at which n_stick changes; null if failed"),
        _wholes("n_stick", "number of sticking blocks; n_stick[k] holds on [t[k], t[k+1]); null if failed"),
    ]
)


#: All columns that there may be.
COLUMNS = (*SCHEMA.names, *(column.name for columns in RECORDED.values() for column in columns))

#: Columns of the other tables of a dataset, as SQL and data frames have them; a series by its own name.
_OF_TABLES = (
    *("start", "stop", "size", "rise_before", "rise_after", "t", "n_stick", "block", "mode", "distance", "threshold"),
    *(field.name.removeprefix("episode_") for name in ("episodes", "episode_energy") for field in RECORDED[name]),
)
#: Dimensions in NetCDF, which keep no variable of their names as they grow (`stickslip.workflows.netcdf`).
_DIMENSIONS = ("change", "event", "block", "separation_step", "episode")
#: What a parameter of a function cannot be called, in lower case, as SQL knows no other, and what has the name.
TAKEN = {
    "rng": "the function's generator",
    **dict.fromkeys(_DIMENSIONS, "a dimension in NetCDF"),
    **dict.fromkeys(("z", "w", *(name.lower() for name in QUANTITIES)), "a key of the scene"),
    **dict.fromkeys((name.lower() for name in (*COLUMNS, *_OF_TABLES)), "a column of the data"),
}


#: Bytes of the longest name that is written to NetCDF and read from it again.
_LONGEST_NAME = 255


def misnamed(names: Iterable[str]) -> tuple[str, str] | None:
    """The first name that no parameter of a function can have, and why; None: all are good."""
    known = dict(TAKEN)
    for name in names:
        if not name.isidentifier() or keyword.iskeyword(name) or unicodedata.normalize("NFKC", name) != name:
            return name, "Python does not take it for an argument"
        if len(name.encode()) > _LONGEST_NAME:
            return name, f"it has more than the {_LONGEST_NAME} bytes that NetCDF takes"
        if name.startswith("__"):
            return name, "what begins so is kept for Arrow"
        if name.lower().endswith("_row_size"):
            return name, "what ends so is kept for counts in NetCDF"
        if name.lower() in known:
            return name, f"{known[name.lower()]} has it, in upper or lower case"
        known[name.lower()] = "another parameter"
    return None


def scalars(schema: pa.Schema) -> tuple[str, ...]:
    """The columns of the members table."""
    return tuple(field.name for field in schema if not pa.types.is_list(field.type))


@dataclass(frozen=True)
class Recording:
    """What a scene keeps of its members.

    `parts` beside n_stick; `separation`, every how long the distance from a twin; `parameters` of a function.
    """

    scene_hash: str
    parts: tuple[str, ...]
    separation: float | None
    parameters: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene) -> Recording:
        return cls(scene.hash, scene.records, scene.record.separation, tuple(scene.system.parameters or ()))

    @property
    def schema(self) -> pa.Schema:
        """The schema of the dataset's shards: `SCHEMA` and the parts."""
        null = set().union(*(_MAY_BE_NULL.get(name, set()) for name in self.parts))
        fixed = [field.with_nullable(True) if field.name in null else field for field in SCHEMA]
        if "long_matrix" in self.parts:
            fixed = [field.with_type(pa.int64()) if field.name == "matrix" else field for field in fixed]
        own = [_number(name, "parameter of the function that makes the systems", False)
               for name in self.parameters]  # fmt: skip
        schema = pa.schema([*fixed, *own, *(column for name in self.parts for column in RECORDED[name])])
        return schema.with_metadata({"schema_version": str(SCHEMA_VERSION), "scene_hash": self.scene_hash})


def encode(columns: Mapping[str, list[Any]], schema: pa.Schema) -> bytes:
    """The Parquet file of some rows, given by column, a pure function of them (for given versions of pyarrow)."""
    kinds = zip(schema.names, schema.types, strict=True)
    arrays = [pa.array(columns[name], kind) for name, kind in kinds]
    buffer = pa.BufferOutputStream()
    leaves = [leaf for field in schema for leaf in _leaves(field)]
    floats: tuple[str, ...] = ("t.list.element", "event_t.list.element", "separation.list.element")
    floats += tuple(f"episode_{name}.list.element" for name in ("start", "end", "moment", "energy"))
    times = [leaf for leaf in leaves if leaf.endswith(floats)]
    pq.write_table(
        pa.Table.from_arrays(arrays, schema=schema),
        buffer,
        compression="zstd",
        # times never repeat: no dictionary; their high bytes hardly change: split, they compress
        use_dictionary=[leaf for leaf in leaves if leaf not in times],
        column_encoding=dict.fromkeys(times, "BYTE_STREAM_SPLIT"),
        write_page_checksum=True,
    )
    return buffer.getvalue().to_pybytes()


def _leaves(field: pa.Field, above: str = "") -> list[str]:
    """Parquet's names of the columns that a field is kept in."""
    path = above + field.name
    if pa.types.is_list(field.type):
        return _leaves(field.type.value_field, f"{path}.list.")
    if pa.types.is_struct(field.type):
        return [leaf for part in field.type for leaf in _leaves(part, f"{path}.")]
    return [path]
