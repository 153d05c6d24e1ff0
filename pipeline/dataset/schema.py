"""What a shard holds: its columns as Arrow has them, and how rows become its bytes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.places.manifest import SCHEMA_VERSION
from stickslip.pipeline.scene.columns import COLUMNS, Recording
from stickslip.version import __version__


def _list(kind: pa.DataType, nullable: bool = False) -> pa.ListType:
    return pa.list_(pa.field("element", kind, nullable))  # Parquet's own name for it


def _struct(**kinds: pa.DataType) -> pa.StructType:
    return pa.struct([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


_NUMBERS, _WHOLES = _list(pa.float64()), _list(pa.int32())
_KINDS = {
    "number": pa.float64(),
    "whole": pa.int32(),
    "count": pa.int64(),
    "yes or no": pa.bool_(),
    "text": pa.string(),
    "numbers": _NUMBERS,
    "numbers or null": _list(pa.float64(), nullable=True),
    "wholes": _WHOLES,
    "counts": _WHOLES,
    "modes": _list(pa.int8()),
    "n_stick by": _list(_struct(threshold=pa.float64(), t=_NUMBERS, n_stick=_WHOLES)),
}


def as_fields(columns: Iterable[Column], recording: Recording | None = None) -> list[pa.Field]:
    """Columns as fields of Arrow; where a recording has units, a value times `scale` is in the `unit`."""
    return [
        pa.field(
            column.name,
            _KINDS[column.kind],
            column.nullable,
            {"description": column.description} | ({} if recording is None else _measured(column, recording)),
        )
        for column in columns
    ]


def _measured(column: Column, recording: Recording) -> dict[str, str]:
    unit = recording.units.of(column.dimension)
    return {"unit": unit, "scale": repr(recording.scale(column))} if unit else {}


def scaled(recording: Recording) -> dict[str, float]:
    """By column, what the values in a shard are multiplied by to be in the units of the scene, if not by one."""
    scales = {column.name: recording.scale(column) for column in recording.columns}
    return {name: scale for name, scale in scales.items() if scale != 1.0}


def in_units(table: pa.Table, recording: Recording) -> pa.Table:
    """Columns of shards in the units of their scene."""
    for name, scale in scaled(recording).items():
        if name in table.column_names:
            column = _times(table[name].combine_chunks(), scale)
            table = table.set_column(table.column_names.index(name), table.schema.field(name), column)
    return table


def _times(array: pa.Array, scale: float) -> pa.Array:
    if not pa.types.is_list(array.type):
        return pc.multiply(array, scale)
    values = pc.multiply(array.values, scale)
    return pa.ListArray.from_arrays(
        array.offsets, values, array.type, mask=array.is_null() if array.null_count else None
    )


def schema_of(recording: Recording) -> pa.Schema:
    """The schema of a dataset's shards."""
    metadata = dict(recording.meaning) | {"schema_version": str(SCHEMA_VERSION), "scene_hash": recording.scene_hash}
    metadata |= {"program": f"stickslip {__version__}", "dataset": "see datapackage.json beside this folder"}
    return pa.schema(as_fields(recording.columns, recording)).with_metadata(metadata)


#: What of a shard's metadata says whose it is.
_IDENTITY = (b"schema_version", b"scene_hash")
_LATER = frozenset(column.name for column in COLUMNS if column.is_later)


def is_of_scene(metadata: Mapping[bytes, bytes] | None, schema: pa.Schema) -> bool:
    """Whether a shard's metadata name the scene and the version of a schema; words may be of another version."""
    return metadata is not None and all(metadata.get(key) == schema.metadata[key] for key in _IDENTITY)


def is_of(columns: pa.Schema, schema: pa.Schema) -> bool:
    """Whether a shard's columns are those of a scene, but for what data of an earlier version lack, and for words."""
    lacked = _LATER - {*columns.names}
    return bool(columns.equals(pa.schema([field for field in schema if field.name not in lacked])))


def scalars(schema: pa.Schema) -> tuple[str, ...]:
    """The columns of the members table."""
    return tuple(field.name for field in schema if not pa.types.is_list(field.type))


#: Endings of Parquet's names for columns whose values never repeat.
_NEVER_AGAIN = tuple(f"{column.name}.list.element" for column in COLUMNS if not column.repeats)


#: The values of a column, from Python or from a shard.
Values: TypeAlias = list[Any] | pa.Array


def encode(columns: Mapping[str, Values], schema: pa.Schema) -> bytes:
    """The Parquet file of some rows, given by column, a pure function of them (for given versions of pyarrow)."""
    kinds = zip(schema.names, schema.types, strict=True)
    arrays = [
        values if isinstance(values := columns[name], pa.Array) else pa.array(values, kind) for name, kind in kinds
    ]
    buffer = pa.BufferOutputStream()
    leaves = [leaf for field in schema for leaf in _leaves(field)]
    times = [leaf for leaf in leaves if leaf.endswith(_NEVER_AGAIN)]
    pq.write_table(
        pa.Table.from_arrays(arrays, schema=schema),
        buffer,
        compression="zstd",
        # times never repeat, so no dictionary; split into bytes they compress, as their high bytes hardly change
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
