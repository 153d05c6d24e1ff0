"""Reading a dataset, in the units of its scene: members as Arrow, pandas or dask frames, n_stick as arrays.

Nothing writes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from stickslip import sim
from stickslip.pipeline.dataset.opened import Opened, frame, near, not_recorded, open_dataset
from stickslip.pipeline.dataset.schema import in_units, scalars
from stickslip.pipeline.dataset.sound import joined
from stickslip.pipeline.design.design import Coordinates
from stickslip.pipeline.errors import QueryError
from stickslip.pipeline.places.place import Where

if TYPE_CHECKING:
    from dask.dataframe import DataFrame

__all__ = [
    "QueryError",
    "all_events",
    "by_threshold",
    "clusters",
    "dask_members",
    "ends",
    "episodes",
    "events",
    "lists",
    "members",
    "members_in_parts",
    "n_stick",
    "profiles",
    "scalar_names",
    "separations",
    "series",
    "table",
]

Filters: TypeAlias = pc.Expression | list[tuple[Any, ...]]

#: Rows of the members table that are read together, at least.
_ROWS = 50_000

#: Bytes of series that are in memory at once: a small dataset is read once, a large one again and again.
_KEPT = 100_000_000
#: Bytes of a member's name in memory, with its place among the others.
_OF_NAMES = 300
#: But at least this many shards: those of a run and of the one that it is compared with.
_SHARDS_KEPT = 2

_Value = TypeVar("_Value", covariant=True)

_Events: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

#: What an event series is made of.
_EVENT_COLUMNS = ["event_t", "event_block", "event_mode", "initial_mode", "outcome", "t_stop", "t_end"]


def table(path: Where | Opened, columns: Sequence[str] | None = None, filters: Filters | None = None) -> pa.Table:
    """The dataset, or a part of it, as an Arrow table: one row a member, sorted as the scene expands.

    Parameters
    ----------
    path : str, Path, Place or Opened
        Directory or address of the dataset (see `stickslip.pipeline.places.place`), or the dataset opened before.
    columns : sequence of str, optional
        Columns of the dataset; all, the lists too, if left out.
    filters : pyarrow.compute.Expression or list of tuple, optional
        Which rows, e.g. ``[("n", "=", 200), ("engine", "=", "coulomb")]``; applied while reading.

    Raises
    ------
    QueryError
        If a column is unknown or the filter does not fit the columns.
    StoreError
        If there is no readable dataset.
    """
    opened = open_dataset(path)
    return _chosen(opened, _known(opened.schema, columns), filters)


def members(
    path: Where | Opened, columns: Sequence[str] | None = None, filters: Filters | None = None
) -> pd.DataFrame:
    """The members table as a data frame; as `table`, but all scalar columns if `columns` is left out.

    A column that holds nulls has a nullable type (NA, never NaN).
    """
    opened = open_dataset(path)
    return frame(_chosen(opened, _known(opened.schema, columns, scalars(opened.schema)), filters))


def scalar_names(path: Where | Opened) -> tuple[str, ...]:
    """The names of the columns of `members`."""
    return scalars(open_dataset(path).schema)


def members_in_parts(path: Where | Opened, columns: Sequence[str]) -> Iterator[tuple[pd.DataFrame, Coordinates]]:
    """The members table as data frames of some `_ROWS` rows, read one after the other; and where these stand.

    A column has a nullable type where it holds nulls in that part.
    """
    opened = open_dataset(path)
    for shards in opened.in_parts(_ROWS):
        tables = []
        for name, table in opened.stored(columns, shards):
            opened.check_members(name, table)
            tables.append(table)
        yield frame(in_units(pa.concat_tables(tables), opened.recording)), opened.coordinates(shards)


def dask_members(
    path: Where | Opened, columns: Sequence[str] | None = None, filters: Filters | None = None
) -> DataFrame:
    """The members table as a dask frame, each part read where it is computed; arguments as of `members`.

    A column that may hold nulls has a nullable type in every part, whether it does there or not.
    """
    import dask.dataframe  # takes a second to load

    opened = open_dataset(path)
    names = _known(opened.schema, columns, scalars(opened.schema))
    empty = frame(opened.schema.empty_table().select(names), _nullable(opened, names))
    parts, address = opened.in_parts(_ROWS) or [[]], str(opened.place)
    return dask.dataframe.from_map(
        _part, parts, path=address, names=names, filters=filters, meta=empty, label="members"
    )


def _part(shards: list[str], path: str, names: list[str], filters: Filters | None) -> pd.DataFrame:
    """One part of a dask frame."""
    opened = open_dataset(path)
    return frame(_chosen(opened, names, filters, shards), _nullable(opened, names))


def _nullable(opened: Opened, names: Sequence[str]) -> list[str]:
    return [name for name in names if opened.schema.field(name).nullable]


def _known(schema: pa.Schema, columns: Sequence[str] | None, default: Sequence[str] | None = None) -> list[str]:
    names = list(columns if columns is not None else schema.names if default is None else default)
    for name in names:
        if name not in schema.names:
            raise QueryError(f"columns: expected columns of the dataset, got {name!r}{near(name, schema.names)}")
    return names


def _chosen(
    opened: Opened, names: list[str], filters: Filters | None, shards: Sequence[str] | None = None
) -> pa.Table:
    """Some columns of some rows."""
    try:
        condition = None if filters is None else pq.filters_to_expression(filters)
        return opened.table(names, condition, shards)
    except (pa.ArrowException, ValueError, TypeError) as error:
        raise QueryError(
            f"filters: expected a condition on the dataset's columns, got {filters!r}: {error}; write a list of"
            ' tuples, [("n", "=", 200)], or an expression of pyarrow.compute'
        ) from error


def n_stick(path: Where | Opened, member_id: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The number of sticking blocks of one member.

    Returns
    -------
    t : float64, shape (k,)
        t[0] = 0 and each time n_stick changes, in the scene's units.
    n_stick : int32, shape (k,)
        n_stick[j] holds on [t[j], t[j+1]), the last to t_end (to t_stop if the run diverged).

    Raises
    ------
    QueryError
        If there is no such member, or it failed.
    StoreError
        If there is no readable dataset.
    """
    opened = open_dataset(path)
    row = _member_row(opened, member_id, ["t", "n_stick"])
    return _array(row["t"]), _array(row["n_stick"])


def events(path: Where | Opened, member_id: str) -> sim.EventSeries:
    """Every event of one member, of a dataset whose scene records them.

    Raises
    ------
    QueryError
        If the scene does not record events, there is no such member, or it failed.
    StoreError
        If there is no readable dataset.
    """
    opened = open_dataset(path)
    if "event_t" not in opened.schema.names:
        raise not_recorded("events")
    row, scene = _member_row(opened, member_id, _EVENT_COLUMNS), opened.scene
    return _event_series(row, scene.system.block_names, scene.unit_names.time)


def episodes(path: Where | Opened) -> pd.DataFrame:
    """All episodes of a dataset whose scene records them, a row each, by member as the scene expands, then by time.

    Returns
    -------
    DataFrame
        `member_id`; `start`, when the first block leaves after a time in which all stick, and `end`, when all stick
        again; `size`, the number of blocks that slipped; `moment`, the sum over the blocks of what each slipped on
        the belt, counted against the belt's motion; `first_block`, which left first; `z_sum`, the sum of z over the
        blocks when it begins. NA in a column that data of an earlier version lack.

    Raises
    ------
    QueryError
        If the scene does not record them.
    StoreError
        If there is no readable dataset.
    """
    return _table(path, "episodes", "episode_")


def clusters(path: Where | Opened) -> pd.DataFrame:
    """The parts of episodes that springs connect, a row each, by member as the scene expands, then by episode.

    Returns
    -------
    DataFrame
        `member_id`; `episode`, the number of the episode among those of the member; `start`, `end`; `first_block`,
        the nucleation site; `size`, the number of blocks; `moment`; `stress_drop`; see `sim.episodes.Clusters`.

    Raises as `episodes`.
    """
    return _table(path, "clusters", "cluster_")


def profiles(path: Where | Opened) -> pd.DataFrame:
    """The slip of each block of each of the `clusters`: member_id, `cluster`, its number, `block`, `slip`.

    Raises as `episodes`.
    """
    return _table(path, "clusters", "profile_")


def _table(path: Where | Opened, record: str, prefix: str) -> pd.DataFrame:
    """Lists of members that begin with a prefix, end to end."""
    opened = open_dataset(path)
    names = [name for name in opened.schema.names if name.startswith(prefix)]
    if not names:
        raise not_recorded(record)
    rows = opened.table(["member_id", *names], pc.field(names[0]).is_valid()).combine_chunks()
    row_numbers = pc.list_parent_indices(rows[names[0]].combine_chunks()) if len(rows) else pa.array([], pa.int64())
    columns = {
        name.removeprefix(prefix): pc.list_flatten(rows[name])
        if rows[name].null_count < len(rows)
        else pa.nulls(len(row_numbers), rows[name].type.value_type)
        for name in names
    }
    return frame(pa.table({"member_id": rows["member_id"].take(row_numbers), **columns}))


def _member_row(opened: Opened, member_id: str, columns: list[str]) -> dict[str, pa.Scalar]:
    if not isinstance(member_id, str):
        raise QueryError(f"member_id: expected the name of a member, got {member_id!r}; `members` lists them")
    done = [batch for batch, _ in opened.tasks if batch.name in opened.manifest.shards]
    shard = next(([batch.name] for batch in done if member_id in batch.members.ids()), [])
    rows = opened.table([*columns, "reason"], pc.field("member_id") == member_id, shard)
    if rows.num_rows == 0:
        names = list(itertools.chain.from_iterable(batch.members.ids() for batch in done))
        raise QueryError(f"member_id: expected a member that is done, got {member_id!r}{near(member_id, names)}")
    if not rows[columns[0]][0].is_valid:
        raise QueryError(
            f"member_id: expected a member that ran, got {member_id!r}, which failed: {rows['reason'][0]}"
        )
    return {name: rows[name][0] for name in columns}


def series(path: Where | Opened) -> Series:
    """t and n_stick as of `n_stick` by member_id. Failed members, which have no series, are left out."""
    return Series(open_dataset(path), "t", ["t", "n_stick"], lambda row: (row("t"), row("n_stick")))


def all_events(path: Where | Opened) -> Recorded[_Events]:
    """Times, blocks and modes of events, and the modes at t = 0, by member_id; empty if they are not recorded."""
    t, block, mode, initial_mode = names = _EVENT_COLUMNS[:4]

    def entry(row: _Row) -> _Events:
        return row(t), row(block), row(mode), row(initial_mode)

    return Recorded(open_dataset(path), t, names, entry)


def ends(path: Where | Opened) -> Recorded[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """z and w at the end by member_id; empty if they are not recorded."""
    return Recorded(open_dataset(path), "z_end", ["z_end", "w_end"], lambda row: (row("z_end"), row("w_end")))


def lists(path: Where | Opened, column: str) -> Recorded[NDArray[np.float64]]:
    """A column of lists of numbers by member_id; empty if it is not recorded."""
    return Recorded(open_dataset(path), column, [column], lambda row: row(column))


def separations(path: Where | Opened) -> Recorded[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Times and distance from the unchanged run by member_id of changed ones; empty if they are not recorded.

    The distance is the root of the mean over blocks of dz^2 + dw^2, as far as both runs go.
    """
    opened = open_dataset(path)
    step = opened.scene.record.separation

    def entry(row: _Row) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert step is not None  # there would be no such column
        distance: NDArray[np.float64] = row("separation")
        return step * np.arange(len(distance), dtype=np.float64), distance

    return Recorded(opened, "separation", ["separation"], entry)


def by_threshold(path: Where | Opened) -> Recorded[dict[float, tuple[NDArray[np.float64], NDArray[np.int32]]]]:
    """t and n_stick by threshold, for further definitions of sticking, by member_id; empty without `thresholds`."""

    def entry(row: _Row) -> dict[float, tuple[NDArray[np.float64], NDArray[np.int32]]]:
        entries = row("by_threshold").values  # noqa: PD011  an Arrow scalar, no data frame
        return {
            series["threshold"].as_py(): (_array(series["t"]) * unit, _array(series["n_stick"])) for series in entries
        }

    opened = open_dataset(path)
    unit = 1.0 if opened.scene.scales is None else opened.scene.scales.time
    return Recorded(opened, "by_threshold", ["by_threshold"], entry)


#: What a column holds in one row: an array where it is a list of numbers, else an Arrow scalar.
_Row = Callable[[str], Any]


class Recorded(Mapping[str, _Value]):
    """What a dataset recorded of its members, by member_id, in order; a shard is read when one of them is asked for.

    The last shards stay in memory, `_KEPT` bytes of them: ask in the order of the members.
    """

    def __init__(self, opened: Opened, recorded: str, columns: list[str], entry: Callable[[_Row], _Value]) -> None:
        self._opened, self._recorded, self._columns, self._entry = opened, recorded, columns, entry
        self._names = sorted(opened.manifest.shards) if recorded in opened.schema.names else []
        self._kept: dict[int, _Shard] = {}  # the last one was read last
        self._next = (0, 0)  # shard and row after those that were asked for last

    def _shard(self, k: int) -> _Shard:
        if k not in self._kept:
            ((_, stored),) = self._opened.stored(["member_id", *self._columns], [self._names[k]])
            table = in_units(stored, self._opened.recording)
            table = table.filter(pc.is_valid(table[self._recorded]))
            while len(self._kept) >= _SHARDS_KEPT and self._n_bytes() + table.nbytes > _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[k] = _Shard(table)
        return self._kept[k]

    def _n_bytes(self) -> int:
        return sum(shard.n_bytes for shard in self._kept.values())

    def _at(self, k: int, row: int) -> _Value:
        return self._entry(self._shard(k).row(row))

    @cached_property
    def _place(self) -> dict[str, tuple[int, int]]:
        """Shard and row of each member."""
        names = (self._shard(k).member_ids for k in range(len(self._names)))
        return {name: (k, row) for k, ids in enumerate(names) for row, name in enumerate(ids)}

    def __getitem__(self, key: str) -> _Value:
        k, row = self._next  # in the order of the members no place has to be looked up
        while k < len(self._names) and row == len(self._shard(k).member_ids):
            k, row = k + 1, 0
        if k == len(self._names) or self._shard(k).member_ids[row] != key:
            k, row = self._place[key]
        self._next = k, row + 1
        return self._at(k, row)

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __iter__(self) -> Iterator[str]:
        return itertools.chain.from_iterable(self._shard(k).member_ids for k in range(len(self._names)))

    def __len__(self) -> int:
        return len(self._place)

    def __bool__(self) -> bool:
        return any(self._shard(k).member_ids for k in range(len(self._names)))  # it need not read them all


class Series(Recorded[tuple[NDArray[np.float64], NDArray[np.int32]]]):
    """As `series`, and of many members together."""

    def stacks(
        self, member_ids: Sequence[str]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]]:
        """t and n_stick of some members, in their order, one after the other: a part for each shard that is read.

        Raises `KeyError` if a member is unknown or failed; its argument is the member.

        Yields
        ------
        first : int64, shape (m + 1,)
            Where the members of the part begin, and the length of what follows.
        t : float64, shape (first[-1],)
        n_stick : int32, shape (first[-1],)
        """
        n_done = 0
        while n_done < len(member_ids):
            k = next((k for k in self._likely() if member_ids[n_done] in self._shard(k).rows), None)
            if k is None:
                k, _ = self._place[member_ids[n_done]]
            self._next = k, 0
            shard, rows = self._shard(k), list[int]()
            for name in itertools.islice(member_ids, n_done, None):
                if name not in shard.rows:
                    break
                rows.append(shard.rows[name])
            starts, t, level = shard.together(np.array(rows))
            yield starts, t, level
            n_done += len(rows)

    def _likely(self) -> range:
        """The shard that was read last and the one after it: in the order of the members no place is looked up."""
        return range(self._next[0], min(self._next[0] + 2, len(self._names)))


class _Shard:
    """Columns of a shard in memory, of which rows are taken quickly."""

    def __init__(self, table: pa.Table) -> None:
        self.n_bytes = table.nbytes + _OF_NAMES * len(table)
        columns = {name: joined(table[name]) for name in table.column_names}
        self.member_ids: list[str] = columns.pop("member_id").to_pylist()
        self._lists, self._others = dict[str, tuple[np.ndarray, np.ndarray]](), dict[str, pa.Array]()
        for name, column in columns.items():
            if pa.types.is_primitive(column.type.value_type):
                values = column.values.to_numpy(zero_copy_only=False)  # noqa: PD011  an Arrow array, no data frame
                self._lists[name] = values, column.offsets.to_numpy()
            else:
                self._others[name] = column

    @cached_property
    def rows(self) -> dict[str, int]:
        """The row of each member."""
        return {name: k for k, name in enumerate(self.member_ids)}

    def together(self, rows: NDArray[np.int64]) -> list[np.ndarray]:
        """Where lists of some rows begin, if they lie one after the other, their length, and the lists of each name.

        Raises `pyarrow.ArrowInvalid` if lists of one row differ in length.
        """
        starts, places, arrays = np.zeros(1, np.int64), np.zeros(0, np.int64), list[np.ndarray]()
        for name, (values, begins) in self._lists.items():
            lengths = begins[rows + 1] - begins[rows]
            bounds = np.concatenate(([0], np.cumsum(lengths)))
            if arrays and not np.array_equal(bounds, starts):
                raise pa.ArrowInvalid(f"Parquet: lists of one row differ in length: {name}")
            starts = bounds
            places = np.repeat(begins[rows] - bounds[:-1], lengths) + np.arange(bounds[-1])
            arrays.append(values[places])
        return [starts, *arrays]

    def row(self, k: int) -> _Row:
        def at(name: str) -> Any:
            if name not in self._lists:
                return self._others[name][k]
            values, offsets = self._lists[name]
            return values[offsets[k] : offsets[k + 1]]

        return at


def _event_series(row: dict[str, pa.Scalar], names: tuple[str, ...], unit: str) -> sim.EventSeries:
    # nothing happens any more after a collapse: its series is known to the end
    end = row["t_stop"] if row["outcome"].as_py() == "diverged" else row["t_end"]
    t, block, mode, initial_mode = (_array(row[name]) for name in _EVENT_COLUMNS[:4])
    return sim.EventSeries(t, block, mode, initial_mode, t_start=0.0, t_end=end.as_py(), names=names, unit=unit)


def _array(entry: pa.ListScalar) -> np.ndarray:
    return entry.values.to_numpy(zero_copy_only=False)  # noqa: PD011  an Arrow scalar, no data frame
