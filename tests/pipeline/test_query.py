"""Reading: what went in comes out, and SQL sees the dataset and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from stickslip.pipeline import QueryError, Scene, StoreError, expand, parse_scene, query, run_ensemble
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.schema import as_fields, scalars
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.query import database
from stickslip.pipeline.scene.columns import FIXED


def test_members_table(finished, scene):
    frame = query.members(finished)
    assert list(frame.columns) == list(scalars(pa.schema(as_fields(FIXED))))
    assert list(frame["member_id"]) == [member.member_id for member in expand(scene)]
    assert frame["n"].dtype == np.int32
    assert frame["t_stop"].dtype == np.float64
    assert frame["perturbation_draw"].dtype == pd.Int32Dtype()  # holds nulls, and stays whole
    assert frame["tol"].isna().sum() == (frame["engine"] == "sigmoid").sum()
    assert set(frame.loc[frame["engine"] == "sigmoid", "stick"]) == {"threshold"}


def test_no_column_says_nan_where_there_is_nothing(finished):
    frame = query.members(finished)
    empty = [name for name in frame if frame[name].isna().any()]
    assert {"reason", "ratio", "stick", "perturbation_reading", "tol"} <= set(empty)
    for name in empty:
        assert {type(value) for value in frame[name] if pd.isna(value)} == {type(pd.NA)}, name
    assert frame["engine"].dtype == pd.Series(["whole"]).dtype


def test_members_filtered_and_chosen(finished, scene):
    wanted = [m.member_id for m in expand(scene) if m.n == 5 and m.engine == "coulomb" and m.change.size == 0.05]
    tuples = [("n", "=", 5), ("engine", "=", "coulomb"), ("perturbation_size", "=", 0.05)]
    expression = (pc.field("n") == 5) & (pc.field("engine") == "coulomb") & (pc.field("perturbation_size") == 0.05)
    for filters in (tuples, expression):
        frame = query.members(finished, columns=["member_id"], filters=filters)
        assert list(frame.columns) == ["member_id"]
        assert list(frame["member_id"]) == wanted


def test_series_are_the_runs_own(finished, scene):
    members = {member.member_id: member for member in expand(scene)}
    seen = []
    for member_id, (t, n_stick) in query.series(finished).items():
        seen.append(member_id)
        assert t.dtype == np.float64
        assert n_stick.dtype == np.int32
        if members[member_id].source.matrix == 1:
            want_t, want = members[member_id].simulate().events.change_points()
            assert np.array_equal(t, want_t)
            assert np.array_equal(n_stick, want)
            one_t, one = query.n_stick(finished, member_id)
            assert np.array_equal(one_t, t)
            assert np.array_equal(one, n_stick)
    assert seen == list(members)


def test_events_come_back_whole(finished, scene):
    for member in expand(scene)[::5]:
        want, got = member.simulate().events, query.events(finished, member.member_id)
        for name in ("t", "block", "mode", "initial_mode"):
            assert np.array_equal(getattr(got, name), getattr(want, name))
            assert getattr(got, name).dtype == getattr(want, name).dtype
        assert (got.t_start, got.t_end) == (want.t_start, want.t_end)
        assert got.counts() == want.counts()


def sql(text):
    return lambda path: query.sql(path, text)


def of_member(name):
    return lambda path: query.n_stick(path, name)


CONDITION = "^filters: expected a condition.*"
MEMBER = "^member_id: expected "
VIEWS = "a query reads shards, members, n_stick, cascades, events, and nothing else"


@pytest.mark.parametrize(("ask", "words"), [
    (lambda path: query.members(path, columns=["egine"]), "^columns: expected .* got 'egine'; did you mean 'engine'"),
    (lambda path: query.dask_members(path, ["colour"]), "^columns: expected columns .* got 'colour'"),
    (lambda path: query.members(path, filters=[("colour", "=", 5)]), CONDITION),
    (lambda path: query.members(path, filters=("n", "==", 5)), CONDITION + "write a list of tuples"),
    (lambda path: query.members(path, filters=5), CONDITION + "write a list of tuples"),
    (of_member("n5-m001-coulomb"), MEMBER + ".* got 'n5-m001-coulomb'; did you mean 'n5-m00"),
    (of_member("x"), MEMBER + r".*there are n3-m000-coulomb.*, \.\.\.$"),
    (of_member(0), MEMBER + "the name of a member, got 0; `members`"),
    (of_member(None), MEMBER + "the name of a member, got None; `members`"),
    (sql("COPY members TO 'x.csv'"), r"expected a SELECT, got COPY: a dataset is read.*--out"),
    (sql("SELECT 1; SELECT 2"), "expected one SELECT, got 2 statements"),
    (sql("  "), "got nothing; try SELECT"),
    (sql("SELECT * FROM read_csv('/etc/passwd')"), VIEWS),
    (sql("SELECT * FROM member"), VIEWS),
    (sql("SELECT colour FROM members"), "query: .*colour"),  # the database's own words
])  # fmt: skip
def test_what_cannot_be_asked_is_refused_in_words_that_help(ask, words, finished):
    with pytest.raises(QueryError, match=words):
        ask(finished)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (".", r"found no manifest\.json"),
        ("nowhere", "nowhere: expected a dataset, found no such directory; name the directory"),
        ("a.parquet", r"a\.parquet: expected a dataset, found a file; name the directory"),
    ],
)
def test_what_is_no_dataset_is_refused(place, words, tmp_path):
    (tmp_path / "a.parquet").touch()
    with pytest.raises(StoreError, match=words):
        query.members(tmp_path / place)


def test_what_was_not_recorded_is_named_with_the_key_that_records_it(source, tmp_path):
    bare = source.replace(b"events = true", b"events = false").replace(b"n = [5, 3]", b"n = 3")
    run_ensemble(parse_scene(bare), tmp_path, workers=0)
    words = "events: expected a dataset with events, got one without; set `events = true` under [record]"
    asked = [
        lambda: query.events(tmp_path, "n3-m000-coulomb-1e-10"),
        lambda: query.sql(tmp_path, "SELECT * FROM Events"),
        lambda: query.sql(tmp_path, "PIVOT events ON mode USING count(*)"),
    ]
    for ask in asked:
        with pytest.raises(QueryError) as caught:
            ask()
        assert str(caught.value) == words
    for part, line in (("separation", r"`separation = 5\.0` under \[record\]"), ("thresholds", r"under \[\[engine")):
        with pytest.raises(QueryError, match=rf"{part}: expected a dataset with {part}, got one without; .*{line}"):
            query.sql(tmp_path, f"SELECT * FROM {part}")


def test_a_shard_that_is_not_in_the_manifest_is_not_read(copy):
    first = sorted((copy / "data").iterdir())[0]
    (copy / "data" / "shard-00099-0123456789ab.parquet").write_bytes(first.read_bytes())
    assert not query.members(copy)["member_id"].duplicated().any()
    first.unlink()
    with pytest.raises(StoreError, match=rf"{first.name}: missing; rerun the scene"):
        query.members(copy)


def last_of(path):
    """A member of the last shard."""
    return [*expand(open_dataset(path).scene).ids()][-1]


READERS = {
    "members": query.members,
    "table": query.table,
    "dask": lambda path: query.dask_members(path).compute(scheduler="threads"),
    "series": lambda path: list(query.series(path).items()),
    "all_events": lambda path: list(query.all_events(path).items()),
    "n_stick": lambda path: query.n_stick(path, last_of(path)),
    "events": lambda path: query.events(path, last_of(path)),
    "sql": lambda path: query.sql(path, "SELECT avg(n_exits) FROM members"),
    "sql, after the first rows": lambda path: query.sql(path, "SELECT member_id FROM members, range(20000)"),
}


def refuse(reader, dataset, spoil):
    """Read a dataset, and again without its last shard, or with what its bytes and another's are spoilt to."""
    READERS[reader](dataset)  # and what was found whole is looked at again
    victim, other = sorted((dataset / "data").iterdir())[-1:-3:-1]
    spoilt = spoil(victim.read_bytes(), other.read_bytes())
    victim.unlink()
    if spoilt:
        victim.write_bytes(spoilt)
    with pytest.raises(StoreError, match=rf"^[^\n]*{victim.name}: (expected|missing)[^\n]*; rerun the scene[^\n]*$"):
        READERS[reader](dataset)


@pytest.mark.parametrize("spoilt", ["another shard", "missing"])
@pytest.mark.parametrize("reader", READERS)
def test_a_shard_is_what_was_written_or_no_answer(spoilt, reader, copy):
    """Nothing in a shard says which it is."""
    refuse(reader, copy, lambda _, other: other if spoilt == "another shard" else b"")


@pytest.mark.parametrize("reader", READERS)
def test_a_flip_in_a_footer_is_no_answer(reader, copy, rng):
    """Parquet's checksums cover its pages alone."""

    def flipped(content, _):
        spoilt = bytearray(content)
        spoilt[-8 - int(rng.integers(int.from_bytes(spoilt[-8:-4], "little")))] ^= 1 << int(rng.integers(8))
        return bytes(spoilt)

    refuse(reader, copy, flipped)


def test_columns_that_share_a_name_are_told_apart(finished):
    once = query.sql(finished, "SELECT * FROM members")
    twice = query.sql(finished, "SELECT member_id, *, n AS member_id_1 FROM members")
    assert list(twice) == ["member_id", "member_id_2", *list(once)[1:], "member_id_1"]
    assert list(twice["member_id"]) == list(twice["member_id_2"]) == list(once["member_id"])
    assert list(query.sql(finished, "SELECT n, n, seed, n FROM members")) == ["n", "n_1", "seed", "n_2"]
    joined = query.sql(finished, "SELECT * FROM n_stick a JOIN n_stick b USING (t) WHERE a.t = 0")
    assert list(joined) == ["member_id", "t", "n_stick", "member_id_1", "n_stick_1"]


def test_sql_agrees_with_arrow(finished):
    frame = query.members(finished)
    counted = query.sql(
        finished, "SELECT n, engine, count(*) AS k, sum(n_exits) AS e FROM members GROUP BY ALL ORDER BY ALL"
    )
    want = frame.groupby(["n", "engine"]).agg(k=("n_exits", "size"), e=("n_exits", "sum")).reset_index()
    assert counted.astype(want.dtypes).equals(want)
    long = query.sql(finished, "SELECT * FROM n_stick")
    for member_id, (t, n_stick) in query.series(finished).items():
        rows = long[long["member_id"] == member_id]
        assert np.array_equal(rows["t"], t)
        assert np.array_equal(rows["n_stick"], n_stick)
    events = query.sql(finished, "SELECT count(*) AS k FROM events")
    assert events["k"][0] == frame["n_events"].sum()


def test_the_initial_mode_beside_an_event_in_sql_is_that_of_its_block(finished, scene):
    """Lists count from one there, and blocks from zero."""
    name = expand(scene)[0].member_id
    events = query.events(finished, name)
    found = query.sql(finished, f"SELECT block, initial_mode FROM events WHERE member_id = '{name}'")
    assert len(found) == len(events) > 0
    assert (found.initial_mode == events.initial_mode[found.block]).all()


def test_sql_nulls_are_not_nan(finished):
    drawn = query.sql(finished, "SELECT perturbation_draw AS d FROM members")["d"]
    assert drawn.dtype == pd.Int32Dtype()
    assert drawn.isna().any()


@pytest.mark.parametrize("text", [
    "SELECT * FROM read_text('{secret}')",
    "SELECT * FROM '{secret}'",
    "SELECT * FROM read_csv('{secret}')",
    "SELECT * FROM read_parquet('{shard}')",
    "SELECT * FROM glob('{folder}/*')",
    "COPY members TO '{folder}/out.csv'",
    "COPY (SELECT 1) TO '{folder}/out.parquet'",
    "ATTACH '{folder}/out.db'",
    "EXPORT DATABASE '{folder}/out'",
    "INSTALL httpfs",
    "LOAD '{secret}'",
    "SET enable_external_access = true",
    "RESET enable_external_access",
    "SET temp_directory = '{folder}'",
    "SET python_enable_replacements = true",
    "SELECT * FROM source",  # a variable of the function that asks
    "SELECT 1; SELECT * FROM read_text('{secret}')",
    "SELECT * FROM read_csv('/etc/passwd')",
    "SELECT getenv('PATH')",
    "SELECT * FROM 'https://example.org/a.csv'",
    "SELECT * FROM 's3://bucket/a.parquet'",
    "LOAD httpfs",
    "CREATE SECRET (TYPE s3)",
    "CREATE TABLE mine AS SELECT 1",
    "CREATE VIEW members AS SELECT 1",
    "DROP VIEW members",
    "PRAGMA database_list",
    "PRAGMA enable_external_access = true",
    "CALL pragma_version()",
    "SET threads = 64",
    "SET memory_limit = '1TB'",
    "IMPORT DATABASE '{folder}'",
    "PREPARE p AS SELECT 1",
    "BEGIN TRANSACTION",
    "VACUUM",
    "CHECKPOINT",
    "USE memory",
])  # fmt: skip
def test_sql_reaches_nothing_outside(text, finished, tmp_path):
    secret = tmp_path / "secret.csv"
    secret.write_text("a,b\n1,2\n")
    shard = next((finished / "data").iterdir())
    with pytest.raises(QueryError, match="query: "):
        query.sql(finished, text.format(secret=secret, folder=tmp_path, shard=shard))
    assert list(tmp_path.iterdir()) == [secret]


def test_sql_changes_nothing(copy, content):
    before = content(copy)
    for text in ("DELETE FROM members", "INSERT INTO members SELECT * FROM members", "UPDATE members SET n = 1"):
        with pytest.raises(QueryError):
            query.sql(copy, text)
    assert content(copy) == before


@pytest.mark.parametrize("text", [
    "EXPLAIN SELECT * FROM members",
    "DESCRIBE n_stick",
    "SUMMARIZE members",
    "SHOW TABLES",
    "VALUES (1)",
    "FROM members",
    "WITH a AS (SELECT 1) SELECT * FROM a;  -- and a comment",
    "PIVOT members ON engine USING count(*) GROUP BY n",
])  # fmt: skip
def test_all_that_reads_is_allowed(text, finished):
    assert len(query.sql(finished, text))


@pytest.mark.parametrize("fault", [BrokenPipeError(32, "gone"), OSError(28, "full"), pa.ArrowInvalid("of a writer")])
def test_what_goes_wrong_where_an_answer_goes_is_no_fault_of_the_dataset(fault, finished):
    with pytest.raises(type(fault)) as caught:
        _fail_on_reading(finished, fault)
    assert caught.value is fault


def _fail_on_reading(path, fault):
    with query.answer(path, "FROM n_stick") as batches:
        next(iter(batches))
        raise fault


def test_what_goes_wrong_in_the_middle_of_an_answer_is_the_querys_fault(finished):
    with pytest.raises(QueryError, match=r"query: .*late"):
        query.sql(finished, "SELECT CASE WHEN range > 2900000 THEN error('late') END FROM range(3000000)")


def test_names_are_only_names(finished, tmp_path):
    """Quotes, semicolons and SQL in a path or a name are letters."""
    odd = tmp_path / 'it\'s "odd"; DROP VIEW members --'
    os.symlink(finished, odd)
    assert len(query.sql(odd, "SELECT * FROM members")) == len(query.members(odd))
    for name in ("x' OR '1'='1", 'a"; DROP VIEW members; --', "%", "\x00", "n5-m00*"):
        with pytest.raises(QueryError, match="expected a member that is done"):
            query.n_stick(odd, name)
        assert query.members(odd, filters=[("member_id", "=", name)]).empty


ENDLESS = "SELECT sum(a.range * b.range) FROM range(1000000) a, range(1000000) b WHERE a.range % 7 = b.range % 5"


@pytest.mark.parametrize("text", [ENDLESS, "SELECT sum(a.t * b.t) FROM n_stick a, n_stick b, n_stick c, n_stick d"])
def test_a_query_without_end_can_be_interrupted(text, finished):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have its background deaf to it
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        query.sql(finished, text)
    timer.join()
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_while_views_are_made_is_one(finished, monkeypatch):
    """What DuckDB is asked in the main thread hears it too, and says in words of its own that it did."""
    monkeypatch.setattr(database, "views", lambda *_: {f"view_{k}": "SELECT * FROM shards" for k in range(100_000)})
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    for _ in range(5):
        timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            query.sql(finished, "SELECT 1")
        timer.join()
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_while_a_query_is_handed_over_ends_it(finished, monkeypatch):
    class Interrupted(ThreadPoolExecutor):
        is_now = False

        def submit(self, work, /, *args):
            handed_over = super().submit(work, *args)
            time.sleep(0.5)
            if not self.is_now and not handed_over.done():
                self.is_now = True
                raise KeyboardInterrupt
            return handed_over

    monkeypatch.setattr(database, "ThreadPoolExecutor", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        query.sql(finished, ENDLESS)


def test_cascades_by_hand(finished):
    """From the definition: walk along n_stick; what falls between a rise and the next rise is one cascade."""
    found = query.sql(finished, "SELECT * FROM cascades")
    assert len(found) > 20
    for member_id, (t, n_stick) in query.series(finished).items():
        want = []
        fall = None
        for k in range(1, len(t)):
            if n_stick[k] > n_stick[k - 1]:
                if fall is not None:
                    want.append((*fall[:2], n_stick[fall[2]] - n_stick[k - 1], t[fall[2]], t[k]))
                fall, rising = None, True
            elif fall is None and k > 1 and rising:
                fall = (t[k], t[k], k - 1)
            elif fall is not None:
                fall = (fall[0], t[k], fall[2])
            rising = n_stick[k] > n_stick[k - 1]
        rows = found[found["member_id"] == member_id]
        columns = ["start", "stop", "size", "rise_before", "rise_after"]
        assert list(rows[columns].itertuples(index=False, name=None)) == want


def test_a_table_holds_the_lists_too(finished):
    table = query.table(finished, filters=[("n", "=", 5)])
    assert isinstance(table, pa.Table)
    assert table.schema.equals(open_dataset(finished).schema)
    t, n_stick = query.n_stick(finished, table["member_id"][3].as_py())
    assert table["t"][3].as_py() == t.tolist()
    assert table["n_stick"][3].as_py() == n_stick.tolist()
    assert query.table(finished, ["n"], pc.field("n") > 99).num_rows == 0


def test_dask_frames_hold_what_pandas_frames_hold(finished, monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.query.frames._ROWS", 6)  # some parts
    columns, filters = ["member_id", "n", "tol", "n_exits", "stick"], [("engine", "=", "coulomb")]
    lazy = query.dask_members(finished, columns, filters)
    assert lazy.npartitions > 2
    whole = lazy.compute(scheduler="sync")
    want = query.members(finished, columns, filters)
    assert whole["n"].dtype == np.int32
    assert whole["tol"].dtype == pd.Float64Dtype()  # may be null elsewhere
    assert dict(lazy.dtypes) == dict(whole.dtypes)
    for name in columns:
        assert list(whole[name].isna()) == list(want[name].isna())
        assert list(whole[name].dropna()) == list(want[name].dropna())
    assert lazy["n_exits"].mean().compute(scheduler="sync") == want["n_exits"].mean()


def test_without_duckdb_the_way_to_get_it_is_named(finished, monkeypatch):
    monkeypatch.setitem(sys.modules, "duckdb", None)
    with pytest.raises(QueryError, match=r'pip install "stickslip\[sql\]"'):
        query.sql(finished, "SELECT 1")


_OFTEN = """
import sys
from stickslip.pipeline import query
for _ in range(100):
    query.sql(sys.argv[1], "SELECT max(n) FROM members")
"""


@pytest.mark.long
def test_no_query_waits_for_the_threads_that_open_its_shards(tmp_path, monkeypatch):
    """With Arrow's own readers, one of some thirty queries of 60 shards waits for ever."""
    monkeypatch.setattr(pack, "TARGET_COST", 1e-9)  # a member each
    tables = {
        "system": {"coupling": "antisymmetric", "n": 3},
        "start": {"z": 0.5, "w": 0.0},
        "run": {"t_end": 2.0, "matrices": 60},
        "engine": {"name": "coulomb"},
        "analysis": {"t_burn": 0.5, "dt": 0.5},
    }
    run_ensemble(Scene(**tables), tmp_path / "out", workers=0)
    subprocess.run([sys.executable, "-c", _OFTEN, str(tmp_path / "out")], check=True, timeout=500)
