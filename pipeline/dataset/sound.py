"""Whether what a shard holds can be what its scene gives: its size before it is read, and its values before use.

A sha256 says that a shard is what somebody wrote, not that it was this program.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stickslip.pipeline.dataset.schema import is_of
from stickslip.pipeline.design.column import Column
from stickslip.pipeline.design.design import Coordinates, Design
from stickslip.pipeline.ensemble.expand import Members
from stickslip.pipeline.errors import shortened
from stickslip.pipeline.places.manifest import SCHEMA_VERSION
from stickslip.pipeline.scene.columns import DESIGN
from stickslip.pipeline.scene.scene import Scene
from stickslip.sim.runs.run import Outcome

#: Bytes in memory that a shard may always take, and how many times those of its file: times hardly compress.
_SMALL, _RATIO = 2**28, 1000
#: What a damaged file raises: names and statistics of a footer may be no UTF-8.
DAMAGE = (OSError, pa.ArrowException, UnicodeDecodeError)
#: Bytes in memory for each of a value: Arrow's, NumPy's and a frame's.
_COPIES = 3


def fault_of_file(content: bytes, schema: pa.Schema, n_rows: int) -> str:
    """What is wrong with the head of a shard, of which no value is read; "" if nothing is.

    Parameters
    ----------
    content : bytes
        All of the file.
    schema : pyarrow.Schema
        Of the scene; its metadata are not looked at.
    n_rows : int
        As the manifest has them.
    """
    try:
        with pq.ParquetFile(pa.BufferReader(content)) as file:
            found, head = file.schema_arrow, file.metadata
            if not is_of(found, schema):
                return wrong_columns(found, schema)
            if head.num_rows != n_rows:
                return f"expected {n_rows} rows, got {head.num_rows}"
            return _too_large(head, schema, len(content)) or _too_long_texts(content, head, schema)
    except DAMAGE as error:
        return f"cannot be read ({shortened(str(error), 200)})"


def wrong_columns(found: pa.Schema, schema: pa.Schema) -> str:
    """How columns differ from those of a scene."""
    differing = next((field.name for field in schema if field.name not in found.names), None)
    pairs = zip(found, schema, strict=False)
    differing = differing or next((one.name for one, other in pairs if not one.equals(other)), "more")
    name = shortened(differing, 60)
    return f"expected the columns of schema version {SCHEMA_VERSION} and this scene, got others ({name} first)"


def _chunks(head: pq.FileMetaData) -> Iterator[pq.ColumnChunkMetaData]:
    for k in range(head.num_row_groups):
        group = head.row_group(k)
        yield from (group.column(j) for j in range(group.num_columns))


def _too_large(head: pq.FileMetaData, schema: pa.Schema, n_bytes: int) -> str:
    """Whether values and pages take more than a shard of this size can, or than this machine has."""
    needed = sum(max(8 * chunk.num_values, chunk.total_uncompressed_size) for chunk in _chunks(head))
    return _beyond(needed, n_bytes)


def _beyond(needed: int, n_bytes: int) -> str:
    most = max(_SMALL, _RATIO * n_bytes)
    if needed > most:
        return f"expected at most {most / 1e6:.0f} MB in {n_bytes} bytes, got what takes {needed / 1e6:.0f} MB"
    if _COPIES * needed > _SMALL:  # for less, the memory is not looked up, which loads Dask
        from distributed.system import MEMORY_LIMIT

        if _COPIES * needed > MEMORY_LIMIT:
            return (
                f"expected what this machine can hold, {MEMORY_LIMIT / 1e9:.3g} GB, got what takes "
                f"{_COPIES * needed / 1e9:.3g} GB"
            )
    return ""


def _too_long_texts(content: bytes, head: pq.FileMetaData, schema: pa.Schema) -> str:
    """Whether texts, each stored once, take too much where they are repeated."""
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    size = sum(chunk.total_uncompressed_size for chunk in _chunks(head) if chunk.path_in_schema in texts)
    if head.num_rows * size <= _SMALL:
        return ""
    with pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts) as file:
        table = file.read(texts, use_threads=False)
    needed = sum(
        pc.sum(pc.binary_length(chunk.dictionary).take(chunk.indices)).as_py() or 0
        for name in texts
        for chunk in table[name].chunks
    )
    return _beyond(needed, len(content))


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

    def fault(self, table: pa.Table) -> str:
        """What is wrong with some columns of some rows; "" if nothing is."""
        try:
            table.validate(full=True)  # what is no UTF-8, and lists without an end
            arrays = {name: _joined(table[name]) for name in table.column_names}  # more than an array can hold
        except pa.ArrowException as error:
            return shortened(str(error), 200)
        columns = [self._columns[name] for name in arrays]
        faults = (self._fault(column, arrays[column.name], arrays.get("n")) for column in columns)
        return next((fault for fault in (*faults, self._unequal(columns, arrays), _odd_outcome(arrays)) if fault), "")

    def _fault(self, column: Column, array: pa.Array, n: pa.Array | None) -> str:
        """What is wrong with the values of a column."""
        if column.kind == "text":
            return ""
        if column.kind == "n_stick by":
            return self._fault_of_thresholds(column, array)
        values = _flat(array) if column.is_list else array
        if pa.types.is_floating(values.type) and pc.all(pc.is_finite(values)).as_py() is False:
            return f"{column.name}: expected finite numbers, got others"
        least, most = self._range(column)
        if len(values) > values.null_count:
            low, high = pc.min_max(values).as_py().values()
            if (least is not None and low < least) or (most is not None and high > most):
                bounds = f"from {least:g}" + ("" if most is None else f" to {most:g}") if least is not None else ""
                return f"{column.name}: expected values {bounds}, got {low if low < (least or 0) else high:g}"
        if column.along == "block" and n is not None:
            lengths = pc.list_value_length(array)
            if pc.all(pc.equal(lengths, n)).as_py() is False:
                return f"{column.name}: expected a value for each block, got more or fewer"
        return _disorder(column, array) if column.is_time and column.is_list else ""

    def _range(self, column: Column) -> tuple[float | None, float | None]:
        if column.is_time:
            return 0.0, self.scene.run.t_end
        if column.kind == "modes":
            return -1, 1
        if column.kind == "wholes":
            return 0, self._n - column.is_index
        if column.is_index:
            return 0, self._n - 1
        return column.least, None

    def _fault_of_thresholds(self, column: Column, array: pa.Array) -> str:
        t, level = (pc.struct_field(_flat(array), name) for name in ("t", "n_stick"))
        finite = pc.all(pc.is_finite(_flat(t))).as_py() is not False
        if not finite or not pc.list_value_length(t).equals(pc.list_value_length(level)):
            return f"{column.name}: expected times and values of one length each, got others"
        low, high = pc.min_max(_flat(level)).as_py().values()
        return "" if low is None or 0 <= low <= high <= self._n else f"{column.name}: expected numbers of blocks"

    def _unequal(self, columns: Sequence[Column], arrays: Mapping[str, pa.Array]) -> str:
        """Whether lists that go together differ in length."""
        first: dict[str, Column] = {}
        for column in columns:
            if column.along in ("", "block", "exit"):
                continue
            other = first.setdefault(column.along, column)
            lengths = [pc.list_value_length(arrays[one.name]) for one in (other, column)]
            if pc.all(pc.equal(*lengths)).as_py() is False:
                return f"{column.name}: expected as many values as of {other.name} in each row, got more or fewer"
        return ""


def fault_of_design(said: object, design: Design) -> str:
    """What is wrong with what a manifest says of the design; "" if nothing is, or it is of an earlier version."""
    if said is None or said == design.as_json():
        return ""
    return "expected the design of its scene, got another"


def fault_of_members(table: pa.Table, members: Members, coordinates: Coordinates | None = None) -> str:
    """What is wrong with what rows, in order, say of their members, and of their design; "" if nothing is.

    Rows of an earlier version do not say where members stand in the design.
    """
    if len(table) != len(members):
        return f"expected {len(members)} rows, got {len(table)}"
    kinds, names, matrices, draws = zip(*members.rows(), strict=True)
    distinct = {id(kind): kind for kind in kinds}
    index = pa.array(map({key: k for k, key in enumerate(distinct)}.__getitem__, map(id, kinds)), pa.int32())
    own = {"member_id": names, "matrix": matrices, "start_draw": draws}
    if coordinates is not None:
        said = zip((column.name for column in DESIGN), coordinates, strict=True)
        own |= {
            name: numbers
            for name, numbers in said
            if name in table.schema.names and table[name].null_count < len(table)
        }
    for field in table.schema:
        if field.name in own:
            expected = pa.array(own[field.name], field.type)
        elif any(field.name in kind for kind in distinct.values()):
            expected = pa.array([kind.get(field.name) for kind in distinct.values()], field.type).take(index)
        else:
            continue
        found = _joined(table[field.name])
        if field.name in ("z0", "w0"):  # drawn ones may be told by the run
            found = pc.if_else(pc.is_null(expected), expected, found)
        if not found.equals(expected):
            k = next(k for k, (one, other) in enumerate(zip(found, expected, strict=True)) if one != other)
            return f"{field.name} of {names[k]}: expected {expected[k]}, got {shortened(str(found[k]), 60)}"
    return ""


def fault_of_counts(table: pa.Table) -> str:
    """Whether numbers that say the same of a run differ; "" if they do not."""
    column = {name: _joined(table[name]) for name in table.column_names}
    parts = [column[name] for name in ("n_entries", "n_exits", "n_crossings")]
    if not pc.add(pc.add(parts[0], parts[1]), parts[2]).equals(column["n_events"]):
        return "n_events: expected the sum of entries, exits and crossings, got another"
    kept = pc.list_value_length(column["event_t"]) if "event_t" in column else None
    if kept is not None and not kept.cast(pa.int64()).equals(column["n_events"]):
        return "n_events: expected the number of the events that are kept, got another"
    ends, levels = _offsets(column["n_stick"])[1:], _flat(column["n_stick"])
    of_runs = pc.is_valid(column["n_stick"])
    last = levels.take(pa.array(ends - 1).filter(of_runs))
    if not last.equals(column["n_stick_end"].filter(of_runs)):
        return "n_stick_end: expected the last of n_stick, got another"
    return ""


def fault_of_statistics(table: pa.Table, head: pq.FileMetaData) -> str:
    """Whether what the file says of its values, by which readers skip them, is wrong; "" if it is not."""
    first = 0
    for k in range(head.num_row_groups):
        group = head.row_group(k)
        rows = table.slice(first, group.num_rows)
        first += group.num_rows
        for chunk in (group.column(j) for j in range(group.num_columns)):
            name, told = chunk.path_in_schema, chunk.statistics
            if told is None or name not in table.column_names:
                continue
            values = rows[name]
            if told.has_null_count and told.null_count != values.null_count:
                return f"{name}: expected {values.null_count} nulls in its statistics, got {told.null_count}"
            if told.has_min_max and values.null_count < len(values):
                low, high = pc.min_max(values).as_py().values()
                if told.min > low or told.max < high:
                    return f"{name}: expected statistics from {low} to {high}, got others"
    return ""


def _odd_outcome(arrays: Mapping[str, pa.Array]) -> str:
    """Whether an outcome is unknown, or a run has no series, or one that failed has."""
    if "outcome" not in arrays:
        return ""
    outcomes = arrays["outcome"]
    if pc.all(pc.is_in(outcomes, pa.array([*get_args(Outcome), "failed"]))).as_py() is False:
        return "outcome: expected one that a run can have, got another"
    failed = pc.equal(outcomes, "failed")
    for name in _OF_RUNS & arrays.keys():
        if not pc.is_null(arrays[name]).equals(failed):
            return f"{name}: expected it of each run, and of none that failed, got otherwise"
    return ""


#: Columns that each run has.
_OF_RUNS = {"t", "n_stick", "t_stop", "n_stick_end", "n_events", "event_t", "event_block", "event_mode"}


def _disorder(column: Column, array: pa.Array) -> str:
    """Whether the times of a row go back; those of changes begin at 0, and differ."""
    values, offsets = _flat(array).to_numpy(zero_copy_only=False), _offsets(array)
    steps = np.diff(values)
    is_inner = np.ones(len(steps), bool)
    ends = offsets[1:-1]
    is_inner[ends[(ends > 0) & (ends < len(values))] - 1] = False  # from one row to the next
    if column.along == "change":
        is_run = pc.is_valid(array).to_numpy(zero_copy_only=False)
        if (np.diff(offsets)[is_run] == 0).any() or (values[offsets[:-1][is_run]] != 0.0).any():
            return f"{column.name}: expected series that begin at 0, got others"
        is_wrong = (steps[is_inner] <= 0.0).any()
    else:
        is_wrong = (steps[is_inner] < 0.0).any()
    return f"{column.name}: expected times in order, got others" if is_wrong else ""


def _offsets(array: pa.Array) -> np.ndarray:
    """Where each row begins among the values of `_flat`, and the end of the last."""
    lengths = pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False)
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def _flat(array: pa.Array) -> pa.Array:
    return pc.list_flatten(array)


def _joined(column: pa.ChunkedArray) -> pa.Array:
    joined = column.combine_chunks()
    return joined if isinstance(joined, pa.Array) else pa.concat_arrays(joined.chunks)
