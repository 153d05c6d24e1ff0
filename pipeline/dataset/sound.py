"""Whether what a shard holds can be what its scene gives: its size before it is read, and its values before use.

A sha256 says that a shard is what somebody wrote, not that it was this program.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stickslip.pipeline.dataset.pages import UnsoundError, check_pages
from stickslip.pipeline.dataset.schema import is_of
from stickslip.pipeline.design.column import Column
from stickslip.pipeline.design.design import Coordinates
from stickslip.pipeline.ensemble.expand import Members
from stickslip.pipeline.errors import StoreError, printable, shortened
from stickslip.pipeline.machine.memory import COPIES, lack
from stickslip.pipeline.places.manifest import SCHEMA_VERSION
from stickslip.pipeline.scene.columns import DESIGN
from stickslip.pipeline.scene.scene import Scene
from stickslip.sim.engines import SETTINGS
from stickslip.sim.runs.run import Outcome
from stickslip.sim.systems.terms import TERMS

#: Bytes in memory that a shard may always take, and how many times those of its file: times hardly compress.
_SMALL, _RATIO = 2**28, 1000
#: As `_SMALL`, of texts: a table that shows them takes twelve times as much.
_SMALL_TEXTS = 2**25

#: Columns of what a scene says of its members: null where it says nothing.
_WRITTEN = frozenset((*SETTINGS, *(term.name for term in TERMS)))


@contextlib.contextmanager
def told_of(file: str) -> Iterator[None]:
    """Within: what is wrong with the content of a shard is a `StoreError` that names its file."""
    try:
        yield
    except (OSError, pa.ArrowException, ValueError) as error:  # ValueError: a name or a statistic is no UTF-8, too
        is_ours = isinstance(error, UnsoundError)
        words = printable(str(error)) if is_ours else f"cannot be read ({shortened(str(error), 200)})"
        raise StoreError(
            f"{file}: {words}; this program did not write it so: remove it, and rerun the scene to rebuild it"
        ) from error


def check_file(content: bytes, schema: pa.Schema, n_rows: int) -> None:
    """Raise `UnsoundError`, or what Arrow does of a damaged file, if the head of a shard is wrong; no value is read.

    Parameters
    ----------
    content : bytes
        All of the file.
    schema : pyarrow.Schema
        Of the scene; its metadata are not looked at.
    n_rows : int
        As the manifest has them.
    """
    with pq.ParquetFile(pa.BufferReader(content)) as file:
        columns, head = file.schema_arrow, file.metadata
    if not is_of(columns, schema):
        raise wrong_columns(columns, schema)
    groups = [head.row_group(k) for k in range(head.num_row_groups)]
    if not head.num_rows == n_rows == sum(group.num_rows for group in groups):
        raise UnsoundError(f"expected {n_rows} rows, got {head.num_rows}")
    chunks = [(group.column(k), group.num_rows) for group in groups for k in range(group.num_columns)]
    for chunk, n_rows_there in chunks:
        check_pages(content, chunk, n_rows_there)
    _check_room(sum(max(8 * chunk.num_values, chunk.total_uncompressed_size) for chunk, _ in chunks), len(content))
    _check_texts(content, [chunk for chunk, _ in chunks], schema)


def wrong_columns(columns: pa.Schema, schema: pa.Schema) -> UnsoundError:
    """How columns differ from those of a scene."""
    differing = next((field.name for field in schema if field.name not in columns.names), None)
    pairs = zip(columns, schema, strict=False)
    differing = differing or next((column.name for column, expected in pairs if not column.equals(expected)), "more")
    name = shortened(differing, 60)
    return UnsoundError(
        f"expected the columns of schema version {SCHEMA_VERSION} and this scene, got others ({name} first)"
    )


def _check_room(needed: int, n_bytes: int, small: int = _SMALL) -> None:
    """Refuse what takes more than a shard of so many bytes can hold, or than this machine has."""
    limit = max(small, _RATIO * n_bytes)
    if needed > limit:
        raise UnsoundError(
            f"expected at most {limit / 1e6:.0f} MB in {n_bytes} bytes, got what takes {needed / 1e6:.0f} MB"
        )
    if problem := lack(COPIES * needed, "what takes"):
        raise UnsoundError(problem)


def _check_texts(content: bytes, columns: Sequence[pq.ColumnChunkMetaData], schema: pa.Schema) -> None:
    """Refuse texts that, each stored once, take too much where they are repeated."""
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    of_texts = [column for column in columns if column.path_in_schema in texts]
    n_rows = sum(column.num_values for column in of_texts if column.path_in_schema == texts[0])
    if n_rows * sum(column.total_uncompressed_size for column in of_texts) <= _SMALL_TEXTS:
        return
    with pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts) as file:
        table = file.read(texts, use_threads=False)
    needed = sum(
        pc.sum(pc.binary_length(chunk.dictionary).take(chunk.indices)).as_py() or 0
        for name in texts
        for chunk in table[name].chunks
    )
    _check_room(needed, len(content), _SMALL_TEXTS)


@dataclass(frozen=True)
class Sound:
    """What values of a scene's data can be."""

    scene: Scene

    @cached_property
    def _columns(self) -> Mapping[str, Column]:
        return {column.name: column for column in self.scene.recording.columns}

    @cached_property
    def _n(self) -> int:
        return max(n for n, _ in self.scene.sources)

    def check(self, table: pa.Table) -> None:
        """Raise `UnsoundError`, or what Arrow does of odd values, if some columns of some rows cannot be."""
        table.validate(full=True)  # what is no UTF-8, and lists without an end
        arrays = {name: joined(table[name]) for name in table.column_names}
        columns = [self._columns[name] for name in arrays]
        for column in columns:
            self._check_column(column, arrays[column.name], arrays.get("n"))
        self._check_lengths(columns, arrays)
        _check_outcome(arrays)

    def _check_column(self, column: Column, array: pa.Array, n: pa.Array | None) -> None:
        if column.kind == "text":
            return
        if column.kind == "n_stick by":
            self._check_thresholds(column, array)
            return
        values = pc.list_flatten(array) if column.is_list else array
        if pa.types.is_floating(values.type) and pc.all(pc.is_finite(values)).as_py() is False:
            raise UnsoundError(f"{column.name}: expected finite numbers, got others")
        lower, upper = self._range(column)
        if len(values) > values.null_count:
            low, high = pc.min_max(values).as_py().values()
            if (lower is not None and low < lower) or (upper is not None and high > upper):
                bounds = f"from {lower:g}" + ("" if upper is None else f" to {upper:g}") if lower is not None else ""
                got = low if low < (lower or 0) else high
                raise UnsoundError(f"{column.name}: expected values {bounds}, got {got:g}")
        if column.along == "block" and n is not None:
            lengths = pc.list_value_length(array)
            if pc.all(pc.equal(lengths, n)).as_py() is False:
                raise UnsoundError(f"{column.name}: expected a value for each block, got more or fewer")
        if column.is_time and column.is_list:
            _check_order(column, array)

    def _range(self, column: Column) -> tuple[float | None, float | None]:
        if column.is_time:
            return 0.0, self.scene.time(self.scene.run.t_end)
        if column.kind == "modes":
            return -1, 1
        if column.kind == "wholes":
            return 0, self._n - column.is_index
        if column.is_index:
            return 0, self._n - 1
        return column.least, column.most

    def _check_thresholds(self, column: Column, array: pa.Array) -> None:
        t, level = (pc.struct_field(pc.list_flatten(array), name) for name in ("t", "n_stick"))
        finite = pc.all(pc.is_finite(pc.list_flatten(t))).as_py() is not False
        if not finite or not pc.list_value_length(t).equals(pc.list_value_length(level)):
            raise UnsoundError(f"{column.name}: expected times and values of one length each, got others")
        low, high = pc.min_max(pc.list_flatten(level)).as_py().values()
        if low is not None and not 0 <= low <= high <= self._n:
            raise UnsoundError(f"{column.name}: expected numbers of blocks, got others")

    def _check_lengths(self, columns: Sequence[Column], arrays: Mapping[str, pa.Array]) -> None:
        """Lists that go together are of one length."""
        by_dimension: dict[str, Column] = {}
        for column in columns:
            array = arrays[column.name]
            is_lacked = column.is_later and array.null_count == len(array)  # by data of an earlier version
            if is_lacked or column.along in ("", "block", "exit"):
                continue
            sibling = by_dimension.setdefault(column.along, column)
            here, there = (pc.fill_null(pc.list_value_length(arrays[kept.name]), -1) for kept in (column, sibling))
            if not here.equals(there):
                raise UnsoundError(
                    f"{column.name}: expected as many values as of {sibling.name} in each row, got more or fewer"
                )


def check_members(table: pa.Table, members: Members, coordinates: Coordinates | None) -> None:
    """Raise `UnsoundError` if rows, in order, say something else of their members, and of their design.

    Rows of an earlier version do not say where members stand in the design.
    """
    if len(table) != len(members):
        raise UnsoundError(f"expected {len(members)} rows, got {len(table)}")
    kinds, names, matrices, draws = zip(*members.rows(), strict=True)
    distinct = {id(kind): kind for kind in kinds}
    index = pa.array(map({key: k for k, key in enumerate(distinct)}.__getitem__, map(id, kinds)), pa.int32())
    columns = {"member_id": names, "matrix": matrices, "start_draw": draws}
    if coordinates is not None:
        numbers_of = zip((column.name for column in DESIGN), coordinates, strict=True)
        columns |= {
            name: numbers
            for name, numbers in numbers_of
            if name in table.schema.names and table[name].null_count < len(table)
        }
    for field in table.schema:
        if field.name in columns:
            expected = pa.array(columns[field.name], field.type)
        elif field.name in _WRITTEN or any(field.name in kind for kind in distinct.values()):
            expected = pa.array([kind.get(field.name) for kind in distinct.values()], field.type).take(index)
        else:
            continue
        values = joined(table[field.name])
        if field.name in ("z0", "w0"):  # drawn ones may be told by the run
            values = pc.if_else(pc.is_null(expected), expected, values)
        if not values.equals(expected):
            k = next(
                k
                for k, (value, wanted_value) in enumerate(zip(values, expected, strict=True))
                if value != wanted_value
            )
            got = shortened(str(values[k]), 60)
            raise UnsoundError(f"{field.name} of {names[k]}: expected {expected[k]}, got {got}")


def check_counts(table: pa.Table) -> None:
    """Raise `UnsoundError` if numbers that say the same of a run differ."""
    column = {name: joined(table[name]) for name in table.column_names}
    counts = [column[name] for name in ("n_entries", "n_exits", "n_crossings")]
    if not pc.add(pc.add(counts[0], counts[1]), counts[2]).equals(column["n_events"]):
        raise UnsoundError("n_events: expected the sum of entries, exits and crossings, got another")
    n_recorded = pc.list_value_length(column["event_t"]) if "event_t" in column else None
    if n_recorded is not None and not n_recorded.cast(pa.int64()).equals(column["n_events"]):
        raise UnsoundError("n_events: expected the number of the events that are kept, got another")
    ends, levels = _offsets(column["n_stick"])[1:], pc.list_flatten(column["n_stick"])
    of_runs = pc.is_valid(column["n_stick"])
    ends_of_runs = levels.take(pa.array(ends - 1).filter(of_runs))
    if not ends_of_runs.equals(column["n_stick_end"].filter(of_runs)):
        raise UnsoundError("n_stick_end: expected the last of n_stick, got another")


def _check_outcome(arrays: Mapping[str, pa.Array]) -> None:
    """Outcomes are known, and a run has series unless it failed."""
    if "outcome" not in arrays:
        return
    outcomes = arrays["outcome"]
    if pc.all(pc.is_in(outcomes, pa.array([*get_args(Outcome), "failed"]))).as_py() is False:
        raise UnsoundError("outcome: expected one that a run can have, got another")
    failed = pc.equal(outcomes, "failed")
    for name in _OF_RUNS & arrays.keys():
        if not pc.is_null(arrays[name]).equals(failed):
            raise UnsoundError(f"{name}: expected it of each run, and of none that failed, got otherwise")


#: Columns that each run has.
_OF_RUNS = {"t", "n_stick", "t_stop", "n_stick_end", "n_events", "event_t", "event_block", "event_mode"}


def _check_order(column: Column, array: pa.Array) -> None:
    """The times of a row do not go back; those of changes begin at 0, and differ."""
    values, offsets = pc.list_flatten(array).to_numpy(zero_copy_only=False), _offsets(array)
    steps = np.diff(values)
    is_inner = np.ones(len(steps), bool)
    ends = offsets[1:-1]
    is_inner[ends[(ends > 0) & (ends < len(values))] - 1] = False  # from one row to the next
    if column.along == "change":
        is_run = pc.is_valid(array).to_numpy(zero_copy_only=False)
        if (np.diff(offsets)[is_run] == 0).any() or (values[offsets[:-1][is_run]] != 0.0).any():
            raise UnsoundError(f"{column.name}: expected series that begin at 0, got others")
        is_wrong = (steps[is_inner] <= 0.0).any()
    else:
        is_wrong = (steps[is_inner] < 0.0).any()
    if is_wrong:
        raise UnsoundError(f"{column.name}: expected times in order, got others")


def _offsets(array: pa.Array) -> np.ndarray:
    """Where each row begins among the values of all, and the end of the last."""
    lengths = pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False)
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def joined(column: pa.ChunkedArray) -> pa.Array:
    """A column as one array, in which rows are found at once; ArrowInvalid if an array cannot hold so much."""
    array = column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()  # which copies
    return array if isinstance(array, pa.Array) else pa.concat_arrays(array.chunks)
