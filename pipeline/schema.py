"""What a shard holds: its columns, and how rows become its bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.pipeline.scene import Scene
from stickslip.sim.engines import ENGINES, SETTINGS
from stickslip.sim.engines.contract import Choice, Number, Ratios

#: Version of the schema below; kept in every shard and in the manifest.
SCHEMA_VERSION: Final = 3


def _column(name: str, kind: pa.DataType, description: str, nullable: bool = True) -> pa.Field:
    return pa.field(name, kind, nullable, {"description": description})


def _list(kind: pa.DataType, nullable: bool = False) -> pa.ListType:
    return pa.list_(pa.field("element", kind, nullable))  # Parquet's own name for it


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
                yield _column(name, pa.float64(), setting.column or f"{setting.words} ({owners})")
            case Choice():
                yield _column(name, pa.string(), setting.column or f"{setting.words} ({owners})")
            case Ratios():
                yield _column(name, pa.string(), f"{setting.words}: one, or uniform in (0, 1] ({owners})")
                yield _column(f"{name}_draw", pa.int32(), f"number of the draw of the r_i ({owners}, uniform)")


#: What a scene may ask for beside n_stick; the first ones by its keys in [system] and [start].
RECORDED = {
    "file": [_column("file", pa.string(), "file that K is read from, as named beside the scene", False)],
    "function": [],  # its parameters, which each scene names itself
    "graph": [
        _column("leaf", pa.float64(), "stiffness of every block's leaf spring; null if drawn"),
        _column("degree", pa.float64(), "mean number of neighbours; null if not a network"),
    ],
    "damping": [_column("damping", pa.float64(), "damping R of every block; null if drawn")],
    "static": [_column("static", pa.float64(), "static friction of every block; null if drawn")],
    "mass": [_column("mass", pa.float64(), "mass of every block; null if drawn")],
    "belts": [],  # speeds that differ, or change in time: null in their column
    "force": [
        _column("force_amplitude", pa.float64(), "amplitude of the force on every block; null if drawn"),
        _column("force_frequency", pa.float64(), "frequency of the force, in radians a unit of time; null if drawn"),
        _column("force_phase", pa.float64(), "phase of the force at t = 0; null if drawn"),
    ],
    "weakening": [
        _column("weakening_rate", pa.float64(), "rate at which friction falls with slip; null if not rational"),
        _column("weakening_speed", pa.float64(), "speed of slip over which it falls; null if not Stribeck's"),
    ],
    "back_slip": [_column("back_slip", pa.string(), "barred: no block gets ahead of its belt")],
    "drawn": [
        _column("drawn", pa.string(), "which parameters are drawn for each block, and from what; theirs is null"),
        _column("start_draw", pa.int32(), "number of the draw of the start; null if it is not drawn"),
    ],
    "step": [_column("step", pa.float64(), "longest step (moreau)")],
    "end": [
        _column("z_end", _list(pa.float64()), "displacement of each block at the end of the run, t_end or earlier"),
        _column("w_end", _list(pa.float64()), "velocity of each block then"),
        _column("mode_end", _list(pa.int8()), "mode of each block then: -1 or +1 slips, 0 sticks"),
    ],
    "growth_rate": [
        _column(
            "growth_rate",
            pa.float64(),
            "largest real part of the eigenvalues of the system with all blocks slipping; below 0 it comes to rest",
        ),
    ],
    "events": [
        _column("event_t", _list(pa.float64()), "times of the events, never decreasing"),
        _column("event_block", _list(pa.int32()), "block of each event"),
        _column("event_mode", _list(pa.int8()), "the block's mode from the event on: -1 or +1 slips, 0 sticks"),
        _column("initial_mode", _list(pa.int8()), "mode of each block at t = 0"),
    ],
    "episodes": [
        _column("episode_start", _list(pa.float64()), "when the first block leaves, after a time when all stick"),
        _column("episode_end", _list(pa.float64()), "when all stick again; what is cut off by an end is no episode"),
        _column("episode_size", _list(pa.int32()), "number of blocks that slipped in each episode"),
        _column("episode_moment", _list(pa.float64()), "sum of their slips on the belt, against the belt's motion"),
        _column("episode_first_block", _list(pa.int32()), "the block that left first"),
    ],
    "energy": [
        _column(
            "kinetic_energy_start",
            pa.float64(),
            "sum of m w^2 / 2 at t = 0; null, as all below, if diverged or not the exact law",
        ),
        _column("kinetic_energy_end", pa.float64(), "sum of m w^2 / 2 at t_end"),
        _column("elastic_energy_start", pa.float64(), "z K z / 2 at t = 0"),
        _column("elastic_energy_end", pa.float64(), "z K z / 2 at t_end"),
        _column("belt_work", pa.float64(), "what the belt gave, by friction"),
        _column("force_work", pa.float64(), "what the force from outside gave"),
        _column("coupling_work", pa.float64(), "what couplings gave that are not reciprocal, the skew part of K"),
        _column("damping_loss", pa.float64(), "what damping took"),
        _column("friction_loss", pa.float64(), "what slip on the belt took, as heat"),
    ],
    "episode_energy": [
        _column(
            "episode_energy",
            _list(pa.float64(), nullable=True),
            "what damping and friction took in each episode; null if diverged or not the exact law",
        ),
    ],
    "separation": [
        _column(
            "separation",
            _list(pa.float64()),
            "distance from the unchanged run at k times the step that the scene gives, as far as both go: the root of"
            " the mean over blocks of dz^2 + dw^2; null for an unchanged run",
        ),
    ],
    "thresholds": [
        _column(
            "by_threshold",
            _list(_struct(threshold=pa.float64(), t=_list(pa.float64()), n_stick=_list(pa.int32()))),
            "t and n_stick of the same run where a block sticks if |w - v| < threshold r_i eps; null if not sigmoid",
        ),
    ],
}

#: By which line, in which of its tables, a scene asks for each.
ASKED_BY = {
    "file": '`coupling = "file"` under [system]',
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
        _column("member_id", pa.string(), "name of the run, unique in the dataset", False),
        _column("n", pa.int32(), "number of blocks", False),
        _column("coupling", pa.string(), "ensemble that K and R are drawn from", False),
        _column("kappa", pa.float64(), "scale of the stiffnesses", False),
        _column("rho", pa.float64(), "scale of the dampings", False),
        _column("friction", pa.float64(), "kinetic friction mu of every block", False),
        _column("belt_speed", pa.float64(), "speed v of the belt", False),
        _column(
            "matrix",
            pa.int32(),
            "number of the random system; runs with the same n and matrix share it",
            False,
        ),
        _column(
            "perturbation_size",
            pa.float64(),
            "relative change of the system's constants; 0: unchanged",
            False,
        ),
        _column("perturbation_draw", pa.int32(), "number of the random change; null if unchanged"),
        _column(
            "perturbation_reading",
            pa.string(),
            "what the size is relative to: scale, relative or damping matrix; null if unchanged",
        ),
        _column("twin_size", pa.float64(), "how far the start is moved, as a distance like `separation`; null: not"),
        _column("engine", pa.string(), f"method of integration: {', '.join(ENGINES)}", False),
        *_of_engines(),
        _column("picked_for", pa.string(), "what a tolerance was picked for: statistics or paths; null: all given"),
        _column("z0", pa.float64(), "displacement of every block at t = 0", False),
        _column("w0", pa.float64(), "velocity of every block at t = 0", False),
        _column("t_end", pa.float64(), "end of the run as asked for", False),
        _column("seed", pa.int64(), "root of the scene's random draws", False),
        _column("outcome", pa.string(), "finished, collapsed, diverged or failed", False),
        _column("reason", pa.string(), "why the outcome is not finished"),
        _column(
            "reproduce",
            pa.string(),
            "command that runs a failed member alone, given in the dataset's directory; null if not failed",
        ),
        _column(
            "t_stop",
            pa.float64(),
            "end of a diverged run; from when on it is certain that a collapsed one does not stick again; else t_end;"
            " null if failed",
        ),
        _column("n_stick_end", pa.int32(), "number of sticking blocks at t_stop; null if failed"),
        _column("n_events", pa.int64(), "entries, exits and crossings together; null if failed"),
        _column("n_entries", pa.int64(), "events slip -> stick; null if failed"),
        _column("n_exits", pa.int64(), "events stick -> slip; null if failed"),
        _column("n_crossings", pa.int64(), "events from slipping one way to the other; null if failed"),
        _column("n_steps", pa.int64(), "steps of the engine; null if failed"),
        _column("n_rejected", pa.int64(), "steps repeated with a smaller size; null if failed"),
        _column("n_products", pa.int64(), "products of K with a vector; null if failed"),
        _column("t", _list(pa.float64()), "t[0] = 0 and each time at which n_stick changes; null if failed"),
        _column(
            "n_stick",
            _list(pa.int32()),
            "number of sticking blocks; n_stick[k] holds on [t[k], t[k+1]); null if failed",
        ),
    ]
)


#: All columns that there may be.
COLUMNS = (*SCHEMA.names, *(column.name for columns in RECORDED.values() for column in columns))


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
        own = [_column(name, pa.float64(), "parameter of the function that makes the systems", False)
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
