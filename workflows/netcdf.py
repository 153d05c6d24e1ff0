"""A dataset as one NetCDF file: the contiguous ragged array of the CF conventions (section 9.3.3).

A member has its scalars along `member`. What a run has many of lies end to end along a dimension of its own, and a
count says how many of these are whose. Null is the fill value of a number, and an empty text.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stickslip.pipeline import QueryError, StoreError
from stickslip.pipeline.dataset.opened import Opened, open_dataset
from stickslip.pipeline.dataset.schema import scalars
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.scene.columns import COLUMNS
from stickslip.version import __version__
from stickslip.workflows.export import whole

#: Along which dimension the lists of a dataset lie; `by_threshold`, lists of lists, is not written.
_SAMPLES = {column.name: column.along for column in COLUMNS if column.along}
_ROWS = 65_536  # of a chunk
_ROOM = 2**20  # bytes that a disk has not got which has no room for what HDF5 writes at once


def write(path: Where, out: Path) -> None:
    """Write the dataset at `path` to a file, which appears once it is complete.

    Lists are read shard by shard: memory is that of the members table and of a shard.

    Raises `QueryError` if netCDF4 is not installed, or the file cannot be written; `StoreError` if there is no
    readable dataset.
    """
    try:
        import netCDF4
    except ImportError as error:
        raise QueryError(
            'NetCDF needs netCDF4, which is not installed; run: pip install "stickslip[netcdf]"'
        ) from error
    opened = open_dataset(path)
    with whole(out, opened.place, "--netcdf") as stream:
        try:
            with netCDF4.Dataset(f"/dev/fd/{stream.fileno()}", "w") as file:
                _fill(file, opened)
        except StoreError:
            raise
        except (OSError, RuntimeError) as error:  # HDF5 does not say why, or wrongly; of a full disk the system does
            stream.seek(0, os.SEEK_END)
            stream.write(bytes(_ROOM))
            stream.flush()
            raise QueryError(f"--netcdf: {out} cannot be written ({error}); choose another file") from error


def _fill(file: Any, opened: Opened) -> None:
    scene, schema = opened.scene, opened.schema
    file.setncatts(
        {
            "Conventions": "CF-1.11",
            "featureType": "timeSeries",
            "title": scene.title,
            "source": f"stickslip {__version__}",
            "scene_hash": scene.hash,
            "comment": f"{f'in {scene.unit_names}' if scene.units else 'dimensionless'}: no clock, no place on Earth",
        }
    )
    file.createDimension("member", opened.n_done)
    members = opened.table(scalars(schema))
    for name in members.column_names:
        _scalar(file, schema.field(name), members[name])
    lists = {name: dimension for name, dimension in _SAMPLES.items() if name in schema.names}
    for dimension in dict.fromkeys(lists.values()):
        file.createDimension(dimension, None)
        counts = file.createVariable(f"{dimension}_row_size", "i8", ("member",))
        counts.setncatts({"long_name": f"number of values along {dimension}", "sample_dimension": dimension})
    for name, dimension in lists.items():
        kind = schema.field(name).type.value_type.to_pandas_dtype()
        variable = file.createVariable(name, kind, (dimension,), compression="zlib", chunksizes=(_ROWS,))
        variable.setncatts(_about(schema.field(name)) | {"coordinates": "member_id"})
    row, ends = 0, Counter[str]()
    for table in opened.rows([*lists]):
        for dimension in dict.fromkeys(lists.values()):
            columns = {name: table[name] for name, along in lists.items() if along == dimension}
            sizes = np.max([_lengths(column) for column in columns.values()], axis=0)
            file[f"{dimension}_row_size"][row : row + len(table)] = sizes
            start, ends[dimension] = ends[dimension], ends[dimension] + int(sizes.sum())
            for name, column in columns.items() if ends[dimension] > start else ():
                file[name][start : ends[dimension]] = _end_to_end(column, sizes)
        row += len(table)


def _scalar(file: Any, field: pa.Field, values: pa.ChunkedArray) -> None:
    """One value a member; texts as characters, which compress."""
    about = _about(field) | ({"cf_role": "timeseries_id"} if field.name == "member_id" else {})
    if pa.types.is_string(field.type):
        texts = np.array([text.encode() for text in values.fill_null("").to_pylist()], dtype=np.bytes_)
        width = max(texts.dtype.itemsize, 1)
        plain, about = texts.astype(f"S{width}").view("S1").reshape(-1, width), about | {"_Encoding": "utf-8"}
        file.createDimension(f"{field.name}_length", width)
        variable = file.createVariable(field.name, "S1", ("member", f"{field.name}_length"), compression="zlib")
    else:
        if pa.types.is_boolean(field.type):
            field, values = field.with_type(pa.int8()), values.cast(pa.int8())
        kind = field.type.to_pandas_dtype()
        plain, null = values.fill_null(_fill_value(kind)).to_numpy(), _fill_value(kind) if values.null_count else None
        variable = file.createVariable(field.name, kind, ("member",), compression="zlib", fill_value=null)
    if len(plain):
        variable[:] = plain
    variable.setncatts(about)  # the last: it would have the characters encoded


def _fill_value(kind: Any) -> Any:
    """What stands for null among numbers of a type."""
    return np.nan if np.issubdtype(kind, np.floating) else np.iinfo(kind).min


def _lengths(column: pa.ChunkedArray) -> np.ndarray:
    """How many values each member has in lists; none where there is no list."""
    return np.asarray(pc.fill_null(pc.list_value_length(column), 0).to_numpy())


def _end_to_end(column: pa.ChunkedArray, sizes: np.ndarray) -> np.ndarray:
    """The lists of members end to end; a null one is all NaN."""
    kind = column.type.value_type.to_pandas_dtype()
    values = np.full(sizes.sum(), _fill_value(kind), dtype=kind)
    values[np.repeat(_lengths(column) > 0, sizes)] = pc.list_flatten(column).to_numpy()
    return values


def _about(field: pa.Field) -> dict[str, str]:
    words = {"long_name": field.metadata[b"description"].decode()}
    unit = field.metadata.get(b"unit", b"1").decode()
    return words if pa.types.is_string(field.type) else words | {"units": unit}
