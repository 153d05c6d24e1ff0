"""SQL over a dataset, by DuckDB: one question at a time, and nothing but the dataset within its reach."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from itertools import count
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds

from stickslip.pipeline.dataset.opened import Opened, frame, not_recorded, open_dataset
from stickslip.pipeline.dataset.schema import scalars
from stickslip.pipeline.errors import QueryError, StoreError, printable
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.records import TABLES
from stickslip.sim.numerics.arguments import did_you_mean

#: Rows of a batch of an answer.
_ROWS = 100_000

# EXPLAIN shows how a SELECT would be answered; PIVOT comes as several statements in one
_READ = {"SELECT", "EXPLAIN", "MULTI"}

# Between an n_stick that rose to a maximum and the next minimum, from which it rises again, lies one cascade.
# Row by row of the dataset: no sorting, whatever its size.
_CASCADES = """
WITH turns AS (
    SELECT member_id, t, n_stick,
        [k for k in range(2, len(n_stick)) if n_stick[k - 1] < n_stick[k] and n_stick[k] > n_stick[k + 1]] AS tops,
        [k for k in range(2, len(n_stick)) if n_stick[k - 1] > n_stick[k] and n_stick[k] < n_stick[k + 1]] AS feet
    FROM shards
), whole AS (
    SELECT member_id, t, n_stick, tops, [k for k in feet if k > tops[1]] AS feet FROM turns
), paired AS (
    SELECT member_id, t, n_stick, tops[:len(feet)] AS tops, feet FROM whole
)
SELECT member_id,
    unnest(list_select(t, [k + 1 for k in tops])) AS start,
    unnest(list_select(t, feet)) AS stop,
    unnest(list_select(n_stick, tops)) - unnest(list_select(n_stick, feet)) AS size,
    unnest(list_select(t, tops)) AS rise_before,
    unnest(list_select(t, [k + 1 for k in feet])) AS rise_after
FROM paired
"""


def quoted(name: str) -> str:
    """A name as SQL takes any: words of SQL itself, too."""
    return '"' + name.replace('"', '""') + '"'


def views(schema: pa.Schema, step: float | None, names: Sequence[str] = (), time: float = 1.0) -> dict[str, str]:
    """The views of a dataset, each as the SELECT from its shards, which are in the units of the scene.

    `step` is the scene's ``record.separation``, `names` are those of the blocks, and `time` is what a dimensionless
    unit of time is in these units.
    """
    selections = {
        "members": f"SELECT {', '.join(map(quoted, scalars(schema)))} FROM shards",
        "n_stick": "SELECT member_id, unnest(t) AS t, unnest(n_stick) AS n_stick FROM shards",
        "cascades": _CASCADES,
    }
    if names:
        selections["blocks"] = " UNION ALL ".join(
            f"SELECT {k} AS block, '{name}' AS name" for k, name in enumerate(names)
        )
    if "event_t" in schema.names:
        selections["events"] = (
            "SELECT member_id, unnest(event_t) AS t, unnest(event_block) AS block, unnest(event_mode) AS mode,"
            " unnest([initial_mode[k + 1] for k in event_block]) AS initial_mode FROM shards"
        )
    for prefix in ("episode_", "cluster_", "profile_"):
        if lists := [field.name for field in schema if field.name.startswith(prefix)]:
            columns = (f"unnest({quoted(name)}) AS {quoted(name.removeprefix(prefix))}" for name in lists)
            selections[f"{prefix[:-1]}s"] = f"SELECT member_id, {', '.join(columns)} FROM shards"
    if "separation" in schema.names:
        selections["separation"] = (
            f"SELECT member_id, {step!r}::DOUBLE * unnest(range(len(separation))) AS t,"
            " unnest(separation) AS distance FROM shards"
        )
    if "by_threshold" in schema.names:
        selections["thresholds"] = (
            "WITH runs AS (SELECT member_id, unnest(by_threshold) AS run FROM shards)"
            f" SELECT member_id, run.threshold AS threshold, unnest(run.t) * {time!r}::DOUBLE AS t,"
            " unnest(run.n_stick) AS n_stick FROM runs"
        )
    return selections


def sql(path: Where | Opened, query: str) -> pd.DataFrame:
    """Answer a question in SQL as a data frame; see `answer`."""
    with answer(path, query) as batches:
        return frame(batches.read_all())


@contextlib.contextmanager
def answer(path: Where | Opened, query: str) -> Iterator[pa.RecordBatchReader]:
    """Answer a question in SQL (DuckDB), without access to anything but the dataset, some rows at a time.

    Views: `members` (the scalar columns), `n_stick` (member_id, t, n_stick; one row a change point), `cascades`
    (member_id, start, stop, size, rise_before, rise_after; one row a complete cascade by the definition `events`:
    n_stick falls from its first exit, `start`, to its last, `stop`, and rises before and after it) and, where the
    scene records them, `events` (member_id, t, block, mode, initial_mode: that of the block at t = 0), `episodes`
    (the columns of `stickslip.pipeline.query.episodes`), `clusters` and `profiles` (those of the functions of these
    names), `separation` (member_id, t, distance), `thresholds` (member_id, threshold, t, n_stick), and `blocks`
    (block, name) where blocks have names. Where columns of an answer share a name, as in ``SELECT member_id, *``, the
    second is called `member_id_1`.

    Raises
    ------
    QueryError
        If DuckDB is not installed, or refuses the query.
    StoreError
        If there is no readable dataset, or a shard of it cannot be read.
    KeyboardInterrupt
        If the user ends a query that takes too long.
    """
    try:
        import duckdb
    except ImportError as error:
        raise QueryError('SQL needs DuckDB, which is not installed; run: pip install "stickslip[sql]"') from error
    opened = open_dataset(path)
    scene, shards = opened.scene, _Shards(opened)
    selections = views(
        opened.schema,
        scene.record.separation,
        scene.system.block_names,
        1.0 if scene.scales is None else scene.scales.time,
    )
    with duckdb.connect(":memory:") as connection, _aside(connection) as aside:

        def ask(work: Callable[[], Any]) -> Any:
            # around what reads alone: what goes wrong where the answer goes is no fault of the dataset
            with _explained(duckdb, shards, list(selections)):
                return aside.submit(work).result()

        aside.submit(_prepare, connection, shards, selections).result()
        ask(lambda: _check(connection.extract_statements(query)))
        batches = ask(lambda: _reader(connection.sql(query)))
        schema = _named_apart(batches.schema)
        # the first rows come here: what is wrong with a query shows before anything is handed over
        first_batch = ask(lambda: next(iter(batches), None))

        def rest() -> Iterator[pa.RecordBatch]:
            batch = first_batch
            while batch is not None:
                yield pa.RecordBatch.from_arrays(batch.columns, schema=schema)
                batch = ask(lambda: next(iter(batches), None))

        yield pa.RecordBatchReader.from_batches(schema, rest())


class _Shards(ds.InMemoryDataset):  # type: ignore[misc]  # Arrow says no types
    """The shards of a dataset as DuckDB reads them: some columns of some rows, one shard after the other."""

    def __init__(self, opened: Opened) -> None:
        super().__init__(opened.schema.empty_table())
        self._opened = opened
        #: What was wrong with a shard: DuckDB hands on its words alone.
        self.fault: StoreError | None = None

    def scanner(self, columns: list[str] | None = None, filter: Any = None, **_: Any) -> _Scan:
        names = self._opened.schema.names if columns is None else columns
        return _Scan(pa.schema([self._opened.schema.field(name) for name in names]), self._batches(names, filter))

    def _batches(self, names: list[str], condition: Any) -> Iterator[pa.RecordBatch]:
        try:
            for table in self._opened.rows(names, condition):
                yield from table.to_batches()
        except StoreError as error:
            self.fault = error
            raise


class _Scan(NamedTuple):
    """What DuckDB asks of a scanner."""

    schema: pa.Schema
    batches: Iterator[pa.RecordBatch]

    def to_reader(self) -> pa.RecordBatchReader:
        return pa.RecordBatchReader.from_batches(self.schema, self.batches)


def _prepare(connection: Any, shards: _Shards, selections: dict[str, str]) -> None:
    """The views of a dataset, and nothing else within reach."""
    connection.register("shards", shards)
    for name, selection in selections.items():
        connection.execute(f"CREATE VIEW {quoted(name)} AS {selection}")
    # from here on no files, no network, no variables of this process, and no way back
    for setting in (
        "temp_directory = ''",
        "python_enable_replacements = false",
        "enable_external_access = false",
        "lock_configuration = true",
    ):
        connection.execute(f"SET {setting}")


def _named_apart(schema: pa.Schema) -> pa.Schema:
    """The columns of an answer; of those that share a name, the second is `name_1`, as DuckDB calls it in a table."""
    used, names = set(schema.names), list[str]()
    for name in schema.names:
        free = (f"{name}_{k}" for k in count(1))
        names.append(name if name not in names else next(candidate for candidate in free if candidate not in used))
        used.add(names[-1])
    return pa.schema([field.with_name(name) for field, name in zip(schema, names, strict=True)])


@contextlib.contextmanager
def _aside(connection: Any) -> Iterator[Executor]:
    """A thread for queries, so that an interrupt reaches this one whatever DuckDB is doing; it ends the query."""
    with ThreadPoolExecutor(1) as aside:
        aside.submit(int).result()  # nobody waits for a thread that starts while an interrupt comes
        try:
            yield aside
        finally:
            final = aside.submit(lambda: None)
            while wait([final], timeout=0.1).not_done:
                connection.interrupt()  # again, if it came before the query had begun


def _reader(relation: Any) -> pa.RecordBatchReader:
    if relation is None:
        raise QueryError("query: expected a statement that returns rows, got one that returns none")
    # the name changed on the way from DuckDB 1 to 2
    reader = getattr(relation, "to_arrow_reader", None) or relation.fetch_record_batch
    return reader(_ROWS)


def _check(statements: list[Any]) -> None:
    if not statements:
        raise QueryError("query: expected a SELECT, got nothing; try SELECT * FROM members")
    kinds = [statement.type.name for statement in statements]
    if len(kinds) > 1:
        raise QueryError(f"query: expected one SELECT, got {len(kinds)} statements; ask them one by one")
    if kinds[0] not in _READ:
        raise QueryError(
            f"query: expected a SELECT, got {kinds[0]}: a dataset is read, never changed, and an answer goes to a "
            f"file by --out"
        )


@contextlib.contextmanager
def _explained(duckdb: Any, shards: _Shards, names: list[str]) -> Iterator[None]:
    """Turn the database's refusals into ours; what is wrong with a shard it hands on without its kind."""
    try:
        yield
    except (duckdb.Error, pa.ArrowException, OSError) as error:  # once rows are coming, Arrow hands on an OSError
        if shards.fault is not None:
            raise shards.fault from None
        message, views_there = printable(str(error).strip()), ["shards", *names]
        if match := re.search(r"Table with name (\w+) does not exist", message):
            name = match[1].lower()
            if name in TABLES and name not in names:
                raise not_recorded(name) from error
            # DuckDB's hint names tables of its own
            message = f"expected a view of the dataset, got {match[1]}{did_you_mean(name, {*views_there, *TABLES})}"
        unknown = isinstance(error, duckdb.PermissionException | duckdb.CatalogException)
        words = f"; a query reads {', '.join(views_there)}, and nothing else" if unknown else ""
        raise QueryError(f"query: {message}{words}") from error
