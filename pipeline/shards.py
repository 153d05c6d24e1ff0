"""What a shard holds: the schema, the rows of a batch, and their bytes."""

from __future__ import annotations

import os
import socket
import time
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import sim
from pipeline.members import Batch, Member

#: Version of the schema below; kept in every shard and in the manifest.
SCHEMA_VERSION: Final = 2


def _column(name: str, kind: pa.DataType, description: str, nullable: bool = True) -> pa.Field:
    return pa.field(name, kind, nullable, {"description": description})


def _list(kind: pa.DataType) -> pa.ListType:
    return pa.list_(pa.field("element", kind, nullable=False))  # Parquet's own name for it


_RECORDED = [
    _column("event_t", _list(pa.float64()), "times of the events, never decreasing"),
    _column("event_block", _list(pa.int32()), "block of each event"),
    _column("event_mode", _list(pa.int8()), "the block's mode from the event on: -1 or +1 slips, 0 sticks"),
    _column("initial_mode", _list(pa.int8()), "mode of each block at t = 0"),
]

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
        _column("engine", pa.string(), "coulomb or sigmoid", False),
        _column("tol", pa.float64(), "truncation error of a step (coulomb)"),
        _column("eps", pa.float64(), "width of the sigmoid"),
        _column("ratio", pa.string(), "stiffness ratios r_i: one, or uniform in (0, 1] (sigmoid)"),
        _column("ratio_draw", pa.int32(), "number of the draw of the r_i (sigmoid, uniform)"),
        _column("rtol", pa.float64(), "relative tolerance (sigmoid)"),
        _column("atol", pa.float64(), "absolute tolerance (sigmoid)"),
        _column("stick", pa.string(), "what counts as sticking: manifold or threshold (sigmoid)"),
        _column("threshold", pa.float64(), "a block sticks when |w - v| < threshold r_i eps (sigmoid, threshold)"),
        _column("picked_for", pa.string(), "what a tolerance was picked for: statistics or paths; null: all given"),
        _column("z0", pa.float64(), "displacement of every block at t = 0", False),
        _column("w0", pa.float64(), "velocity of every block at t = 0", False),
        _column("t_end", pa.float64(), "end of the run as asked for", False),
        _column("seed", pa.int64(), "root of the scene's random draws", False),
        _column("outcome", pa.string(), "finished, collapsed, diverged or failed", False),
        _column("reason", pa.string(), "why the outcome is not finished"),
        _column(
            "t_stop",
            pa.float64(),
            "where the integration stopped; a collapsed run is known to t_end all the same; null if failed",
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

#: The scalar columns, those of the members table.
SCALARS = tuple(field.name for field in SCHEMA if not pa.types.is_list(field.type))

_PARAMETERS = tuple(field.name for field in fields(Member))


def shard_schema(scene_hash: str, events: bool) -> pa.Schema:
    """The schema of a dataset's shards: `SCHEMA`, with the events if the scene records them."""
    schema = pa.schema([*SCHEMA, *_RECORDED]) if events else SCHEMA
    return schema.with_metadata({"schema_version": str(SCHEMA_VERSION), "scene_hash": scene_hash})


@dataclass(frozen=True)
class Result:
    """A computed batch: the shard's bytes, and beside them what is not data."""

    name: str
    shard: bytes
    member_ids: tuple[str, ...]
    n_failed: int
    seconds: float
    host: str
    pid: int


def compute(batch: Batch, scene_hash: str, events: bool) -> Result:
    """Run a batch's members and encode their rows; a member that raises becomes a row that says so."""
    start = time.perf_counter()
    rows = [_row(member, events) for member in batch.members]
    return Result(
        name=batch.name,
        shard=encode(rows, shard_schema(scene_hash, events)),
        member_ids=tuple(member.member_id for member in batch.members),
        n_failed=sum(row["outcome"] == "failed" for row in rows),
        seconds=time.perf_counter() - start,
        host=socket.gethostname(),
        pid=os.getpid(),
    )


def _row(member: Member, events: bool) -> dict[str, Any]:
    parameters = {name: getattr(member, name) for name in _PARAMETERS}
    try:
        return parameters | _measured(member.simulate(), events)
    except Exception as error:  # noqa: BLE001  whatever went wrong is this member's outcome, not its neighbours'
        message = " ".join(str(error).split())
        return parameters | {"outcome": "failed", "reason": f"{type(error).__name__}: {message}"}


def _measured(run: sim.Run, events: bool) -> dict[str, Any]:
    t, n_stick = run.events.change_points()
    if not np.isfinite(t).all():
        raise FloatingPointError("the engine returned an event at a time that is not finite")
    row = {
        "outcome": run.outcome,
        "reason": run.reason or None,
        "t_stop": run.t_end,
        "n_stick_end": n_stick[-1],
        **run.events.counts(),
        "n_events": run.stats.n_events,
        "n_steps": run.stats.n_steps,
        "n_rejected": run.stats.n_rejected,
        "n_products": run.stats.n_products,
        "t": t,
        "n_stick": n_stick,
    }
    if events:
        row |= {
            "event_t": run.events.t,
            "event_block": run.events.block,
            "event_mode": run.events.mode,
            "initial_mode": run.events.initial_mode,
        }
    return row


def encode(rows: list[dict[str, Any]], schema: pa.Schema) -> bytes:
    """The Parquet file of some rows, a pure function of them (for given versions of pyarrow)."""
    columns = [pa.array([row.get(field.name) for row in rows], field.type) for field in schema]
    buffer = pa.BufferOutputStream()
    times = [f"{name}.list.element" for name in ("t", "event_t") if name in schema.names]
    pq.write_table(
        pa.Table.from_arrays(columns, schema=schema),
        buffer,
        compression="zstd",
        # times never repeat: no dictionary; their high bytes hardly change: split, they compress
        use_dictionary=[_leaf(field) for field in schema if _leaf(field) not in times],
        column_encoding=dict.fromkeys(times, "BYTE_STREAM_SPLIT"),
        write_page_checksum=True,
    )
    return buffer.getvalue().to_pybytes()


def _leaf(field: pa.Field) -> str:
    return f"{field.name}.list.element" if pa.types.is_list(field.type) else field.name
