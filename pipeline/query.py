"""Reading a dataset: members as a data frame, n_stick as arrays, anything by SQL. Nothing here writes."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from numpy.typing import NDArray

import sim
from pipeline.manifest import DATA, StoreError, dataset_scene, read_manifest
from pipeline.shards import SCALARS, shard_schema

# pandas' plain numbers have no null but NaN; these do, and keep integers integers
_NULLABLE = {
    pa.int32(): pd.Int32Dtype(),
    pa.int64(): pd.Int64Dtype(),
    pa.float64(): pd.Float64Dtype(),
    pa.bool_(): pd.BooleanDtype(),
}


class QueryError(ValueError):
    """The question cannot be answered. The message says what was expected and what came."""


def dataset(path: str | Path) -> ds.Dataset:
    """The shards that the manifest lists, as one Arrow dataset, in the order of the members.

    Raises
    ------
    StoreError
        If there is no readable dataset at `path`.
    """
    path = Path(path)
    manifest = read_manifest(path)
    schema = shard_schema(manifest.scene_hash, dataset_scene(path).record.events)
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    with _reading(path):
        return ds.dataset(
            [str(path / DATA / name) for name in sorted(manifest.shards)],
            schema=schema,
            format=ds.ParquetFileFormat(default_fragment_scan_options=checked),
        )


def members(
    path: str | Path,
    columns: Sequence[str] | None = None,
    filters: pc.Expression | list[tuple] | None = None,
) -> pd.DataFrame:
    """The members table, one row a member, sorted as the scene expands.

    Parameters
    ----------
    path : str or Path
        Directory of the dataset.
    columns : sequence of str, optional
        Columns of the schema; all scalar ones if left out.
    filters : pyarrow.compute.Expression or list of tuple, optional
        Which rows, e.g. ``[("n", "=", 200), ("engine", "=", "coulomb")]``; applied while reading.

    Returns
    -------
    pandas.DataFrame
        A column that holds nulls has a nullable type (NA, never NaN).

    Raises
    ------
    QueryError
        If a column is unknown or the filter does not fit the columns.
    StoreError
        If there is no readable dataset.
    """
    source = dataset(path)
    names = list(SCALARS if columns is None else columns)
    for name in names:
        if name not in source.schema.names:
            raise QueryError(
                f"columns: expected columns of the dataset, got {name!r}{_near(name, source.schema.names)}"
            )
    try:
        condition = None if filters is None else pq.filters_to_expression(filters)
        with _reading(path):
            return _frame(source.to_table(columns=names, filter=condition))
    except (pa.ArrowException, ValueError) as error:
        raise QueryError(
            f"filters: expected a condition on the dataset's columns, got {filters!r}: {error}"
        ) from error


def n_stick(path: str | Path, member_id: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The number of sticking blocks of one member.

    Returns
    -------
    t : float64, shape (k,)
        t[0] = 0 and each time n_stick changes (dimensionless).
    n_stick : int32, shape (k,)
        n_stick[j] holds on [t[j], t[j+1]), the last to t_end (to t_stop if the run diverged).

    Raises
    ------
    QueryError
        If there is no such member, or it failed.
    StoreError
        If there is no readable dataset.
    """
    row = _member_row(path, dataset(path), member_id, ["t", "n_stick"])
    return _array(row["t"]), _array(row["n_stick"])


def events(path: str | Path, member_id: str) -> sim.EventSeries:
    """Every event of one member, of a dataset whose scene records them.

    Raises
    ------
    QueryError
        If the scene does not record events, there is no such member, or it failed.
    StoreError
        If there is no readable dataset.
    """
    source = dataset(path)
    if "event_t" not in source.schema.names:
        raise QueryError(
            "events: expected a dataset with events, got one without; set `events = true` under [record]"
        )
    columns = ["event_t", "event_block", "event_mode", "initial_mode", "outcome", "t_stop", "t_end"]
    row = _member_row(path, source, member_id, columns)
    # nothing happens any more after a collapse: its series is known to the end
    end = row["t_stop"] if row["outcome"].as_py() == "diverged" else row["t_end"]
    t, block, mode, initial_mode = (_array(row[name]) for name in columns[:4])
    return sim.EventSeries(t, block, mode, initial_mode, t_start=0.0, t_end=end.as_py())


def _member_row(path: str | Path, source: ds.Dataset, member_id: str, columns: list[str]) -> dict[str, pa.Scalar]:
    with _reading(path):
        rows = source.to_table([*columns, "reason"], filter=pc.field("member_id") == member_id)
        known = [] if rows.num_rows else source.to_table(["member_id"])["member_id"].to_pylist()
    if rows.num_rows == 0:
        raise QueryError(f"member_id: expected a member that is done, got {member_id!r}{_near(member_id, known)}")
    if not rows[columns[0]][0].is_valid:
        raise QueryError(
            f"member_id: expected a member that ran, got {member_id!r}, which failed: {rows['reason'][0]}"
        )
    return {name: rows[name][0] for name in columns}


def series(path: str | Path) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.int32]]]:
    """Each member's id, t and n_stick as of `n_stick`, in order, one shard in memory at a time.

    Failed members, which have no series, are left out: `members` lists them.
    """
    for fragment in dataset(path).get_fragments():
        with _reading(path):
            table = fragment.to_table(columns=["member_id", "t", "n_stick"])
        for member_id, t, counts in zip(*table.columns, strict=True):
            if t.is_valid:
                yield member_id.as_py(), _array(t), _array(counts)


def sql(path: str | Path, query: str) -> pd.DataFrame:
    """Answer a question in SQL (DuckDB), without access to anything but the dataset.

    Views: `members` (the scalar columns), `n_stick` (member_id, t, n_stick; one row a change point) and, if the
    scene records them, `events` (member_id, t, block, mode).

    Raises
    ------
    QueryError
        If DuckDB is not installed, or refuses the query.
    StoreError
        If there is no readable dataset.
    """
    try:
        import duckdb
    except ImportError as error:
        raise QueryError('SQL needs DuckDB, which is not installed; run: pip install "stickslip[sql]"') from error
    source = dataset(path)
    with duckdb.connect(":memory:") as connection:
        connection.register("shards", source)
        views = {
            "members": ", ".join(SCALARS),
            "n_stick": "member_id, unnest(t) AS t, unnest(n_stick) AS n_stick",
        }
        if "event_t" in source.schema.names:
            views["events"] = (
                "member_id, unnest(event_t) AS t, unnest(event_block) AS block, unnest(event_mode) AS mode"
            )
        for name, selection in views.items():
            connection.execute(f"CREATE VIEW {name} AS SELECT {selection} FROM shards")
        # from here on no files, no network, no variables of this process, and no way back
        for setting in (
            "temp_directory = ''",
            "python_enable_replacements = false",
            "enable_external_access = false",
            "lock_configuration = true",
        ):
            connection.execute(f"SET {setting}")
        try:
            answer = connection.sql(query)
            if answer is None:
                raise QueryError("query: expected a statement that returns rows, got none; try SELECT * FROM members")
            return _frame(answer.to_arrow_table())
        except duckdb.Error as error:
            raise QueryError(f"query: {error}") from error


@contextlib.contextmanager
def _reading(path: str | Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:  # a file that is gone, or a page whose checksum is wrong
        raise StoreError(
            f"{path}: a shard cannot be read ({error}); run the scene again to compute it anew"
        ) from error


def _frame(table: pa.Table) -> pd.DataFrame:
    plain = [name for name in table.column_names if table[name].null_count == 0]
    frame = table.to_pandas(types_mapper=_NULLABLE.get)
    types = {name: table.schema.field(name).type for name in plain}
    return frame.astype({name: kind.to_pandas_dtype() for name, kind in types.items() if kind in _NULLABLE})


def _array(entry: pa.ListScalar) -> np.ndarray:
    return entry.values.to_numpy(zero_copy_only=False)  # noqa: PD011  an Arrow scalar, no data frame


def _near(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(known[:10])}"
