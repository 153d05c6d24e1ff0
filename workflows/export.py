"""An answer of the dataset as a table to read, as CSV, as Parquet or for MATLAB."""

from __future__ import annotations

import contextlib
import io
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from stickslip.analysis.page import AS_TEXT, FORMULA
from stickslip.pipeline import QueryError
from stickslip.pipeline.dataset.opened import frame
from stickslip.pipeline.errors import printable, remedy
from stickslip.pipeline.machine.processes import closed_streams
from stickslip.pipeline.places import plain
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.place import Where
from stickslip.workflows import matlab

Form = Literal["table", "csv", "parquet", "mat"]

#: Most rows of a table that a person may want to read.
_SHOWN = 1000


#: What a table shows where there is no value.
_NULL = "NULL"

#: Form by the ending of a file's name.
_ENDINGS: dict[str, Form] = {".csv": "csv", ".parquet": "parquet", ".mat": "mat", ".txt": "table", "": "table"}


def form_of(asked: Form | None, out: Path | None) -> Form:
    """The form asked for, or else the one that the file's name implies.

    Raises `QueryError` if it says none that an answer can have.
    """
    if asked is not None:
        return asked
    ending = out.suffix.lower() if out is not None else ""
    if ending not in _ENDINGS:
        raise QueryError(
            f"--out: expected a file named .csv, .parquet, .mat or .txt, got {out}; name it so, or say its form by"
            " --format"
        )
    return _ENDINGS[ending]


def write(batches: pa.RecordBatchReader, form: Form, out: Path | None, dataset: Where) -> None:
    """Write an answer to a file, which appears once it is complete, or to the standard output.

    Raises `QueryError` if the file cannot be written or is part of the dataset, or the form cannot hold the answer.
    """
    if form == "csv":
        _flat(batches.schema)
    if out is not None:
        with whole(out, dataset) as stream:
            _write(batches, form, stream)
    elif sys.stdout is None or "stdout" in closed_streams:
        raise QueryError("the standard output is closed; name a file by --out")
    elif form in ("parquet", "mat") and sys.stdout.isatty():
        raise QueryError(f"--format: {form} is not for reading; name a file by --out, or send it to a program by |")
    elif sys.stdout.isatty():
        text = io.BytesIO()
        _write(batches, form, text)
        print(text.getvalue().decode(), end="")  # without what a terminal obeys
    else:
        _write(batches, form, sys.stdout.buffer)


def _write(batches: pa.RecordBatchReader, form: Form, stream: BinaryIO) -> None:
    try:
        if form == "table":
            stream.write(_table(batches).encode())
        elif form == "mat":
            stream.write(matlab.encoded(batches.read_all()))
        elif form == "csv":
            with pa.csv.CSVWriter(stream, batches.schema) as writer:
                for batch in batches:
                    writer.write_batch(_as_texts(batch))
        else:
            with pq.ParquetWriter(stream, batches.schema, compression="zstd", write_page_checksum=True) as file:
                for batch in batches:
                    file.write_batch(batch)
    except pa.ArrowException as error:
        raise QueryError(
            f"--format: expected columns that {form} can hold ({error}); cast them in the query"
        ) from error
    stream.flush()


def _as_texts(batch: pa.RecordBatch) -> pa.RecordBatch:
    """The rows with texts that no spreadsheet takes for formulas, whoever wrote them."""
    columns = [
        pc.replace_substring_regex(column, FORMULA, AS_TEXT)
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
        else column
        for column in batch.columns
    ]
    return pa.RecordBatch.from_arrays(columns, schema=batch.schema)


def _table(batches: pa.RecordBatchReader) -> str:
    """The first rows, aligned; a last line says how many more there are."""
    kept: list[pa.RecordBatch] = []
    n_rows = 0
    for batch in batches:
        if n_rows < _SHOWN:
            kept.append(batch.slice(0, _SHOWN - n_rows))
        n_rows += batch.num_rows
    table = pa.Table.from_batches(kept, batches.schema)
    if not n_rows:
        return printable(f"no rows ({', '.join(batches.schema.names)})\n")
    more = f"... {n_rows - _SHOWN} rows more: --format csv has them all\n" if n_rows > _SHOWN else ""
    shown = frame(table)
    for name in shown.columns[shown.isna().any()]:
        shown[name] = [_NULL if value is None or value is pd.NA else value for value in shown[name]]
    return printable(shown.to_string(index=False, na_rep="NaN")) + "\n" + more


def _flat(schema: pa.Schema) -> None:
    for column in schema:
        if pa.types.is_nested(column.type):
            raise QueryError(
                f"--format: expected plain columns for csv, got {column.name!r}, which holds {column.type}; unnest "
                f"it in the query, or ask for parquet"
            )


@contextlib.contextmanager
def whole(out: Path, dataset: Where, option: str = "--out") -> Iterator[BinaryIO]:
    """A stream to a file beside `out`, which takes its name at the end, or goes if there is none.

    A link is followed; a pipe or a device is refused. What processes that were killed left beside `out` goes too.
    Messages call `out` by the `option` that names it.
    """
    place = place_of(dataset)
    if out.is_dir():
        raise QueryError(f"{option}: expected a file, got the directory {out}; name a file in it")

    def refusal(link: str) -> QueryError:
        return QueryError(f"{option}: expected a file, got {link}; choose another file")

    try:
        with plain.way(out, refusal) as (passed, name, folder):
            file = folder / name
            if isinstance(place, Directory) and file.is_relative_to(place.path.resolve()):
                raise QueryError(
                    f"{option}: expected a file outside the dataset {dataset}, got {out}; choose another"
                )
            state = plain.status(name, passed)
            if state is not None and not stat.S_ISREG(state.st_mode):
                raise QueryError(
                    f"{option}: expected a file, got {out}, a pipe or a device; without --out an answer goes to the"
                    " standard output"
                )
            directory = os.open(".", os.O_RDONLY | os.O_DIRECTORY, dir_fd=passed)
            try:
                plain.remove_left(directory, name)
                with plain.replacing(file, directory) as stream:
                    yield stream
            finally:
                os.close(directory)
    except OSError as error:
        raise QueryError(f"{option}: {out} cannot be written ({error.strerror}); {remedy(error)}") from error
