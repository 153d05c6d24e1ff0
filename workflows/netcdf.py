"""A dataset as one NetCDF file: the contiguous ragged array of the CF conventions (section 9.3.3).

A member has its scalars along `member`. What a run has many of lies end to end along a dimension of its own, and a
count says how many of these are whose. Null is the fill value of a number, and an empty text.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stickslip.pipeline import QueryError, StoreError
from stickslip.pipeline.dataset.opened import Opened, open_dataset, reading
from stickslip.pipeline.dataset.schema import in_units, scalars
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

    Columns with a value a member are read one after the other, and lists shard by shard: memory is that of a column
    or of a shard.

    Raises
    ------
    QueryError
        If netCDF4 is not installed, or the file cannot be written.
    StoreError
        If there is no readable dataset.
    """
    try:
        import netCDF4
    except ImportError as error:
        raise QueryError(
            'NetCDF needs netCDF4, which is not installed; run: pip install "stickslip[netcdf]"'
        ) from error
    opened = open_dataset(path)
    source = opened.shards()
    lists = [name for name in _SAMPLES if name in source.schema.names]
    with whole(out, opened.place, "--netcdf") as stream:
        try:
            with netCDF4.Dataset(f"/dev/fd/{stream.fileno()}", "w") as file:
                _fill(file, opened, source, lists)
        except StoreError:
            raise
        except (OSError, RuntimeError) as error:  # HDF5 does not say why, or wrongly; of a full disk the system does
            stream.seek(0, os.SEEK_END)
            stream.write(bytes(_ROOM))
            stream.flush()
            raise QueryError(f"--netcdf: {out} cannot be written ({error}); choose another file") from error


def _fill(file: Any, opened: Opened, source: Any, lists: list[str]) -> None:
    scene = opened.scene
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
    file.createDimension("member", sum(shard.rows for shard in opened.manifest.shards.values()))
    for name in scalars(source.schema):
        with reading(opened.place):
            values = in_units(opened.checked(source.to_table(columns=[name])), scene.recording)[name]
        _scalar(file, source.schema.field(name), values)
    for dimension in dict.fromkeys(_SAMPLES[name] for name in lists):
        _along(file, opened, source, dimension, [name for name in lists if _SAMPLES[name] == dimension])


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
        fill = np.nan if pa.types.is_floating(field.type) else np.iinfo(kind).min
        plain, null = values.fill_null(fill).to_numpy(), fill if values.null_count else None
        variable = file.createVariable(field.name, kind, ("member",), compression="zlib", fill_value=null)
    if len(plain):
        variable[:] = plain
    variable.setncatts(about)  # the last: it would have the characters encoded


def _along(file: Any, opened: Opened, source: Any, dimension: str, names: list[str]) -> None:
    """Lists that have one length each member, or are null, end to end, and their lengths; a null one is all NaN."""
    file.createDimension(dimension, None)
    variables = {}
    for name in names:
        field = source.schema.field(name)
        kind = field.type.value_type.to_pandas_dtype()
        variables[name] = file.createVariable(name, kind, (dimension,), compression="zlib", chunksizes=(_ROWS,))
        variables[name].setncatts(_about(field) | {"coordinates": "member_id"})
    counts = file.createVariable(f"{dimension}_row_size", "i8", ("member",))
    counts.setncatts({"long_name": f"number of values along {dimension}", "sample_dimension": dimension})
    row = written = 0
    for fragment in source.get_fragments():
        with reading(opened.place):
            shard = in_units(opened.checked(fragment.to_table(columns=["n", *names])), opened.scene.recording)
        lengths = {name: pc.fill_null(pc.list_value_length(shard[name]), 0).to_numpy() for name in names}
        sizes = np.max([*lengths.values()], axis=0)
        more = int(sizes.sum())
        counts[row : row + len(sizes)] = sizes
        for name in names if more else ():
            kind = shard[name].type.value_type.to_pandas_dtype()
            values = np.full(more, np.nan if np.issubdtype(kind, np.floating) else np.iinfo(kind).min, dtype=kind)
            values[np.repeat(lengths[name] > 0, sizes)] = pc.list_flatten(shard[name]).to_numpy()
            variables[name][written : written + more] = values
        row, written = row + len(sizes), written + more


def _about(field: pa.Field) -> dict[str, str]:
    words = {"long_name": field.metadata[b"description"].decode()}
    unit = field.metadata.get(b"unit", b"1").decode()
    return words if pa.types.is_string(field.type) else words | {"units": unit}
