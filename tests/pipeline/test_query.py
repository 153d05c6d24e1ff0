"""Reading: what went in comes out, and SQL sees the dataset and nothing else."""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pytest

from pipeline import QueryError, StoreError, expand, query
from pipeline.shards import SCALARS


def test_members_table(finished, scene):
    frame = query.members(finished)
    assert list(frame.columns) == list(SCALARS)
    assert list(frame["member_id"]) == [member.member_id for member in expand(scene)]
    assert frame["n"].dtype == np.int32
    assert frame["t_stop"].dtype == np.float64
    assert frame["perturbation_draw"].dtype == pd.Int32Dtype()  # holds nulls, and stays whole
    assert frame["tol"].isna().sum() == (frame["engine"] == "sigmoid").sum()
    assert set(frame.loc[frame["engine"] == "sigmoid", "stick"]) == {"threshold"}


def test_members_filtered_and_chosen(finished, scene):
    wanted = [
        m.member_id for m in expand(scene) if m.n == 5 and m.engine == "coulomb" and m.perturbation_size == 0.05
    ]
    tuples = [("n", "=", 5), ("engine", "=", "coulomb"), ("perturbation_size", "=", 0.05)]
    expression = (pc.field("n") == 5) & (pc.field("engine") == "coulomb") & (pc.field("perturbation_size") == 0.05)
    for filters in (tuples, expression):
        frame = query.members(finished, columns=["member_id"], filters=filters)
        assert list(frame.columns) == ["member_id"]
        assert list(frame["member_id"]) == wanted
    with pytest.raises(
        QueryError, match="columns: expected columns of the dataset, got 'egine'; did you mean 'engine'"
    ):
        query.members(finished, columns=["egine"])
    with pytest.raises(QueryError, match="filters: expected a condition"):
        query.members(finished, filters=[("colour", "=", 5)])


def test_series_are_the_runs_own(finished, scene):
    members = {member.member_id: member for member in expand(scene)}
    seen = []
    for member_id, t, n_stick in query.series(finished):
        seen.append(member_id)
        assert t.dtype == np.float64
        assert n_stick.dtype == np.int32
        if members[member_id].matrix == 1:
            want_t, want = members[member_id].simulate().events.change_points()
            assert np.array_equal(t, want_t)
            assert np.array_equal(n_stick, want)
            one_t, one = query.n_stick(finished, member_id)
            assert np.array_equal(one_t, t)
            assert np.array_equal(one, n_stick)
    assert seen == list(members)


def test_n_stick_holds_from_its_time_on(finished, scene):
    member = expand(scene)[-1]
    t, n_stick = query.n_stick(finished, member.member_id)
    assert len(t) > 1
    middles = (t + np.append(t[1:], member.t_end)) / 2
    events = member.simulate().events
    assert np.array_equal(events.n_stick(middles), n_stick)


def test_events_come_back_whole(finished, scene):
    for member in expand(scene)[::5]:
        want, got = member.simulate().events, query.events(finished, member.member_id)
        for name in ("t", "block", "mode", "initial_mode"):
            assert np.array_equal(getattr(got, name), getattr(want, name))
            assert getattr(got, name).dtype == getattr(want, name).dtype
        assert (got.t_start, got.t_end) == (want.t_start, want.t_end)
        assert got.counts() == want.counts()


def test_unknown_member_and_no_dataset(finished, tmp_path):
    with pytest.raises(QueryError, match="got 'n5-m001-coulomb'; did you mean 'n5-m00"):
        query.n_stick(finished, "n5-m001-coulomb")
    with pytest.raises(StoreError, match=r"found no manifest\.json"):
        query.members(tmp_path)


def test_a_shard_that_is_not_in_the_manifest_is_not_read(copy):
    first = sorted((copy / "data").iterdir())[0]
    (copy / "data" / "shard-00099-0123456789ab.parquet").write_bytes(first.read_bytes())
    assert not query.members(copy)["member_id"].duplicated().any()
    first.unlink()
    with pytest.raises(StoreError, match=r"cannot be read.*run the scene again"):
        query.members(copy)


def test_sql_agrees_with_arrow(finished):
    frame = query.members(finished)
    counted = query.sql(
        finished, "SELECT n, engine, count(*) AS k, sum(n_exits) AS e FROM members GROUP BY ALL ORDER BY ALL"
    )
    want = frame.groupby(["n", "engine"]).agg(k=("n_exits", "size"), e=("n_exits", "sum")).reset_index()
    assert counted.astype(want.dtypes).equals(want)
    long = query.sql(finished, "SELECT * FROM n_stick")
    for member_id, t, n_stick in query.series(finished):
        rows = long[long["member_id"] == member_id]
        assert np.array_equal(rows["t"], t)
        assert np.array_equal(rows["n_stick"], n_stick)
    events = query.sql(finished, "SELECT count(*) AS k FROM events")
    assert events["k"][0] == frame["n_events"].sum()


def test_sql_nulls_are_not_nan(finished):
    drawn = query.sql(finished, "SELECT perturbation_draw AS d FROM members")["d"]
    assert drawn.dtype == pd.Int32Dtype()
    assert drawn.isna().any()


@pytest.mark.parametrize(
    "text",
    [
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
    ],
)
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


def test_sql_errors_are_the_databases_own_words(finished):
    with pytest.raises(QueryError, match=r"query: .*colour"):
        query.sql(finished, "SELECT colour FROM members")
    with pytest.raises(QueryError, match="try SELECT"):
        query.sql(finished, "  ")


def test_without_duckdb_the_way_to_get_it_is_named(finished, monkeypatch):
    monkeypatch.setitem(sys.modules, "duckdb", None)
    with pytest.raises(QueryError, match=r'pip install "stickslip\[sql\]"'):
        query.sql(finished, "SELECT 1")
