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
from stickslip.pipeline.errors import QueryError as QueryError
from stickslip.pipeline.places.place import Where

if TYPE_CHECKING:
    from dask.dataframe import DataFrame

Filters: TypeAlias = pc.Expression | list[tuple[Any, ...]]

#: Rows of the members table that are read together, at least.
_ROWS = 50_000

#: Bytes of series, events and lists that are in memory at once: a large dataset is read again and again.
_KEPT = 150_000_000
#: Bytes of a member's name in memory, with its place among the others.
_OF_NAMES = 300
#: But at least this many shards: those of a run and of the one that it is compared with.
_SHARDS_KEPT = 2

#: A dataset, opened before or not, or its shards as other readers keep them.
Source: TypeAlias = "Where | Opened | Shards"
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


def members_in_parts(path: Source, columns: Sequence[str]) -> Iterator[tuple[pd.DataFrame, Coordinates]]:
    """The members table as data frames of some `_ROWS` rows, read one after the other; and where these stand.

    A column has a nullable type where it holds nulls in that part.
    """
    shards = Shards.of(path)
    opened = shards.opened
    for names in opened.in_parts(_ROWS):
        tables = []
        for name, table in shards.stored(columns, names):
            opened.check_members(name, table)
            tables.append(table)
        yield frame(in_units(pa.concat_tables(tables), opened.recording)), opened.coordinates(names)


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
    # nothing happens any more after a collapse: its series is known to the end
    end = row["t_stop"] if row["outcome"].as_py() == "diverged" else row["t_end"]
    t, block, mode, initial_mode = (_array(row[name]) for name in _EVENT_COLUMNS[:4])
    names, unit = scene.system.block_names, scene.unit_names.time
    return sim.EventSeries(t, block, mode, initial_mode, t_start=0.0, t_end=end.as_py(), names=names, unit=unit)


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
    done = [batch for batch in opened.tasks if batch.name in opened.manifest.shards]
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


def series(path: Source) -> Series:
    """t and n_stick as of `n_stick` by member_id. Failed members, which have no series, are left out."""
    return Series(path, ["t", "n_stick"], lambda t, n_stick: (t, n_stick))


def all_events(path: Source) -> Recorded[_Events]:
    """Times, blocks and modes of events, and the modes at t = 0, by member_id; empty if they are not recorded."""
    return Recorded(path, _EVENT_COLUMNS[:4], lambda *columns: columns)


def ends(path: Source) -> Recorded[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """z and w at the end by member_id; empty if they are not recorded."""
    return Recorded(path, ["z_end", "w_end"], lambda z, w: (z, w))


def lists(path: Source, column: str) -> Recorded[NDArray[np.float64]]:
    """A column of lists of numbers by member_id; empty if it is not recorded."""
    return Recorded(path, [column], lambda values: values)


def separations(path: Source) -> Recorded[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Times and distance from the unchanged run by member_id of changed ones; empty if they are not recorded.

    The distance is the root of the mean over blocks of dz^2 + dw^2, as far as both runs go.
    """
    shards = Shards.of(path)
    step = shards.opened.scene.record.separation

    def entry(distance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert step is not None  # there would be no such column
        return step * np.arange(len(distance), dtype=np.float64), distance

    return Recorded(shards, ["separation"], entry)


def by_threshold(path: Source) -> Recorded[dict[float, tuple[NDArray[np.float64], NDArray[np.int32]]]]:
    """t and n_stick by threshold, for further definitions of sticking, by member_id; empty without `thresholds`."""
    shards = Shards.of(path)
    unit = 1.0 if shards.opened.scene.scales is None else shards.opened.scene.scales.time

    def entry(thresholds: pa.ListScalar) -> dict[float, tuple[NDArray[np.float64], NDArray[np.int32]]]:
        return {
            series["threshold"].as_py(): (_array(series["t"]) * unit, _array(series["n_stick"]))
            for series in thresholds.values  # noqa: PD011  an Arrow scalar, no data frame
        }

    return Recorded(shards, ["by_threshold"], entry)


class Shards:
    """The shards of a dataset of which its readers take rows: the last ones stay in memory, `_KEPT` bytes.

    If all is wanted, and as long as there is room, a shard is read once, with what any of the readers asks for.
    """

    def __init__(self, opened: Opened, is_whole: bool = False) -> None:
        self.opened, self.names = opened, sorted(opened.manifest.shards)
        self.columns = list[str]()  #: of all readers
        self._is_whole = is_whole
        self._kept: dict[str, _Shard] = {}  # the last one was read last

    @classmethod
    def of(cls, path: Source) -> Shards:
        """Those of a dataset, or those given."""
        return path if isinstance(path, Shards) else cls(open_dataset(path))

    def stored(self, columns: Sequence[str], names: Sequence[str]) -> Iterator[tuple[str, pa.Table]]:
        """As ``Opened.stored``; what readers ask for is read at once if all of it is."""
        also = ["member_id", *self.columns] if self._is_whole else []
        for name, table in self.opened.stored([*dict.fromkeys([*columns, *also])], names):
            if also:
                self._keep(name, table.select(also))
            yield name, table.select(columns)

    def shard(self, k: int, columns: Sequence[str]) -> _Shard:
        """A shard with these columns at least, by its place."""
        name = self.names[k]
        there = self._kept[name].columns if name in self._kept else {}
        lacking = [column for column in ("member_id", *columns) if column not in there]
        if lacking:
            wanted = ["member_id", *self.columns] if self._is_whole else lacking
            ((_, table),) = self.opened.stored(wanted, [name])
            self._keep(name, table)
        return self._kept[name]

    def _keep(self, name: str, table: pa.Table) -> None:
        scaled = in_units(table, self.opened.recording)
        columns = self._kept.pop(name).columns if name in self._kept else {}
        shard = _Shard({**columns, **{column: joined(scaled[column]) for column in scaled.column_names}})
        n_bytes = shard.n_bytes + sum(kept.n_bytes for kept in self._kept.values())
        while len(self._kept) >= _SHARDS_KEPT and n_bytes > _KEPT:
            n_bytes -= self._kept.pop(next(iter(self._kept))).n_bytes
            self._is_whole = False
        self._kept[name] = shard


class Recorded(Mapping[str, _Value]):
    """What a dataset recorded of its members, by member_id, in order; a shard is read when one of them is asked for.

    Ask in the order of the members: then none is read twice.

    Parameters
    ----------
    columns : sequence of str
        What is read; members without a value of the first are left out.
    entry : callable
        What is given of a member, by its values: arrays of lists of numbers, else Arrow scalars.
    """

    def __init__(self, path: Source, columns: Sequence[str], entry: Callable[..., _Value]) -> None:
        self._shards, self._columns, self._entry = Shards.of(path), columns, entry
        is_there = columns[0] in self._shards.opened.schema.names
        self._numbers = range(len(self._shards.names) if is_there else 0)
        self._shards.columns += columns if is_there else []
        self._last = 0  # the shard of the member that was asked for last

    def _shard(self, k: int) -> _Shard:
        return self._shards.shard(k, self._columns)

    def _rows(self, k: int) -> dict[str, int]:
        return self._shard(k).rows(self._columns[0])

    @cached_property
    def _place(self) -> dict[str, int]:
        """The shard of each member."""
        return {name: k for k in self._numbers for name in self._rows(k)}

    def _shard_of(self, key: str) -> int:
        """That of a member: as long as these are in order, the one before or the next, so that none is looked up."""
        if self._numbers and "_place" not in vars(self):
            for k in (self._last, (self._last + 1) % len(self._numbers)):
                if key in self._rows(k):
                    self._last = k
                    return k
        return self._place[key]

    def __getitem__(self, key: str) -> _Value:
        shard = self._shard(self._shard_of(key))
        return self._entry(*shard.row(shard.rows(self._columns[0])[key], self._columns))

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __iter__(self) -> Iterator[str]:
        return itertools.chain.from_iterable(map(self._rows, self._numbers))

    def __len__(self) -> int:
        return sum(len(self._rows(k)) for k in self._numbers)

    def __bool__(self) -> bool:
        return any(map(self._rows, self._numbers))  # it need not read them all


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
            shard = self._shard(self._shard_of(member_ids[n_done]))
            row_of = shard.rows(self._columns[0])
            waiting = itertools.islice(member_ids, n_done, None)
            rows = [row_of[name] for name in itertools.takewhile(row_of.__contains__, waiting)]
            starts, t, level = shard.together(self._columns, np.array(rows))
            yield starts, t, level
            n_done += len(rows)


class _Shard:
    """Columns of a shard in memory, of which rows are taken quickly."""

    def __init__(self, columns: dict[str, pa.Array]) -> None:
        self.columns, self._rows = columns, dict[str, dict[str, int]]()
        self.n_bytes = sum(array.nbytes for array in columns.values()) + _OF_NAMES * len(columns["member_id"])
        self._lists = {
            name: (array.values.to_numpy(zero_copy_only=False), array.offsets.to_numpy())  # noqa: PD011  of Arrow
            for name, array in columns.items()
            if name != "member_id" and pa.types.is_primitive(array.type.value_type)
        }

    def rows(self, recorded: str) -> dict[str, int]:
        """The row of each member of which a column is known."""
        if recorded not in self._rows:
            is_known = self.columns[recorded].is_valid().to_pylist()
            names = self.columns["member_id"].to_pylist()
            self._rows[recorded] = {name: k for k, name in enumerate(names) if is_known[k]}
        return self._rows[recorded]

    def together(self, columns: Sequence[str], rows: NDArray[np.int64]) -> list[np.ndarray]:
        """Where lists of some rows begin, if they lie one after the other, their length, and the lists of each name.

        Raises `pyarrow.ArrowInvalid` if lists of one row differ in length.
        """
        starts, places, arrays = np.zeros(1, np.int64), np.zeros(0, np.int64), list[np.ndarray]()
        for name in columns:
            values, begins = self._lists[name]
            lengths = begins[rows + 1] - begins[rows]
            bounds = np.concatenate(([0], np.cumsum(lengths)))
            if arrays and not np.array_equal(bounds, starts):
                raise pa.ArrowInvalid(f"Parquet: lists of one row differ in length: {name}")
            starts = bounds
            places = np.repeat(begins[rows] - bounds[:-1], lengths) + np.arange(bounds[-1])
            arrays.append(values[places])
        return [starts, *arrays]

    def row(self, k: int, columns: Sequence[str]) -> Iterator[Any]:
        """What columns hold in one row: arrays of lists of numbers, else Arrow scalars."""
        for name in columns:
            if name in self._lists:
                values, offsets = self._lists[name]
                yield values[offsets[k] : offsets[k + 1]]
            else:
                yield self.columns[name][k]


def _array(entry: pa.ListScalar) -> np.ndarray:
    return entry.values.to_numpy(zero_copy_only=False)  # noqa: PD011  an Arrow scalar, no data frame
