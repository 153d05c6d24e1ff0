"""The guide's queries: each of its ten questions is asked of a small dataset, and the answers make sense."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from stickslip.analysis.series.cascades import spans, window
from stickslip.pipeline import parse_scene, query, run_ensemble
from tests.scenes import COULOMB, SIGMOID, ensemble

PAGE = (Path(__file__).parents[2] / "docs" / "guide" / "large-runs.md").read_text()
GUIDE = PAGE.partition("## Ten queries\n")[2]
SECTIONS = re.findall(r"^### (\d+)\. (.*?)\n(.*?)(?=^### |\Z)", GUIDE, flags=re.DOTALL | re.MULTILINE)
SOURCE = ensemble(
    [12, 60],
    80.0,
    4,
    COULOMB,
    f"{SIGMOID}\nthresholds = [0.25, 1.0, 4.0]",
    seed=3,
    rest="[perturbation]\nsizes = [0.01, 0.1]\n[twins]\nsizes = [1e-6]\n"
    "[record]\ncollapse = true\nevents = true\nepisodes = true\nseparation = 5.0",
    analysis="t_burn = 50.0\ndt = 0.5",
).encode()


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("guide") / "out"
    run_ensemble(parse_scene(SOURCE), path, workers=0)
    return path


def block(number: int, language: str) -> str:
    text = SECTIONS[number - 1][2]
    return re.search(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)[1]


@pytest.fixture(scope="module")
def ask(kept):
    return lambda number: query.sql(kept, block(number, "sql"))


@pytest.fixture(scope="module")
def run(kept):
    def answer(number):
        names: dict[str, object] = {}
        exec(compile(block(number, "python").replace("runs/mine", str(kept)), f"question {number}", "exec"), names)
        return names["answer"]

    return answer


def unchanged(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[(frame["perturbation_size"] == 0) & frame["twin_size"].isna()]


def counted(kept) -> pd.DataFrame:
    """The members that a statistic of the report is of."""
    frame = unchanged(query.members(kept))
    return frame[frame["outcome"] == "finished"].set_index("member_id")


def test_the_questions_fit_the_guides_own_scene():
    page = (Path(__file__).parents[2] / "docs" / "guide" / "first-run.md").read_text()
    assert {float(t) for t in re.findall(r"(?:greatest\(t, |t_to > |rise_before > )(\d+)", GUIDE)} == {
        float(re.search(r"^t_burn = (\S+)", page, flags=re.MULTILINE)[1])
    }
    sizes = re.search(r"^n = \[(.*?)\]", page, flags=re.MULTILINE)[1].split(", ")
    assert set(re.findall(r"n = (\d+) ", GUIDE)) <= set(sizes)


def test_there_are_ten_questions_each_with_its_query():
    assert [int(number) for number, *_ in SECTIONS] == list(range(1, 11))
    assert all(question.endswith("?") and "```sql\n" in text for _, question, text in SECTIONS)


def test_the_views_of_the_guide_are_those_of_the_dataset(kept):
    listed = re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", GUIDE, flags=re.MULTILINE)
    views = set(query.sql(kept, "SHOW TABLES")["name"]) - {"shards"}
    assert {name for name, _ in listed} == views
    for name, columns in listed[1:]:
        assert re.findall(r"`(\w+)`", columns) == list(query.sql(kept, f"DESCRIBE {name}")["column_name"])


def test_1_outcomes(ask, run, kept):
    found = ask(1)
    assert found["members"].sum() == len(query.members(kept)) == run(1).sum()
    counted = found.set_index(["n", "engine", "outcome"])["members"]
    assert counted.to_dict() == run(1).to_dict()


def test_2_early_ends(ask, kept):
    found = ask(2)
    frame = query.members(kept)
    assert len(found) == (frame["outcome"] != "finished").sum()
    assert found["t_stop"].is_monotonic_increasing
    assert found["reason"].notna().all()


def test_3_means(ask, kept):
    found, frame = ask(3).set_index(["n", "engine"]), counted(kept)
    for member_id, (t, counts) in query.series(kept).items():
        if member_id in frame.index:
            edges = np.clip(np.append(t, frame.loc[member_id, "t_end"]), 50.0, None)
            frame.loc[member_id, "mean"] = np.average(counts, weights=np.diff(edges))
    other = frame.groupby(["n", "engine"])["mean"].agg(["mean", "sem"])
    np.testing.assert_allclose(found["mean_n_stick"], other["mean"], rtol=1e-12)
    np.testing.assert_allclose(found["standard_error"], other["sem"], rtol=1e-9)
    assert found["matrices"].to_dict() == frame.groupby(["n", "engine"]).size().to_dict()
    assert len(frame) < len(unchanged(query.members(kept)))  # some ended early, and are in no mean
    for (n, _), row in found.iterrows():
        assert 0 <= row["mean_n_stick"] <= n


def test_4_cascades_are_those_of_the_report(ask, kept):
    """The definition `events` of the analysis, in the same window."""
    frame = counted(kept)
    want: dict[tuple[int, str, int], int] = {}
    for member_id, (t, n_stick) in query.series(kept).items():
        if member_id in frame.index:
            n, engine, t_end = frame.loc[member_id, ["n", "engine", "t_end"]]
            for size in spans(window(t, n_stick, 50.0, t_end)).size:
                key = n, engine, int(size)
                want[key] = want.get(key, 0) + 1
    found = ask(4)
    assert found.set_index(["n", "engine", "size"])["cascades"].to_dict() == dict(sorted(want.items()))
    np.testing.assert_allclose(found.groupby(["n", "engine"])["share"].sum(), 1.0)


def test_5_largest(ask, kept):
    found = ask(5)
    assert found["size"].is_monotonic_decreasing
    everyone = query.sql(kept, "SELECT * FROM cascades")
    assert found["size"][0] == everyone[everyone["rise_before"] > 50]["size"].max() <= 60
    assert (found["start"] > 50).all()
    assert (found["duration"] >= 0).all()


def test_6_at_one_time(ask, run):
    assert ask(6).set_index("member_id")["n_stick"].to_dict() == run(6)


def test_7_blocks(ask, kept):
    found = ask(7)
    frame = unchanged(query.members(kept, filters=[("n", "=", 60), ("matrix", "=", 0), ("engine", "=", "coulomb")]))
    assert len(frame) == 1
    assert found["exits"].sum() == frame["n_exits"].iloc[0]  # no block sticks at t = 0: each exit has its entry
    assert found["exits"].is_monotonic_decreasing
    assert set(found["block"]) <= set(range(60))


def test_7_counts_the_first_exit_of_a_block_that_starts_on_its_belt(tmp_path):
    source = ensemble([60], 40.0, 1, COULOMB, rest="[record]\nevents = true").replace("w = -0.4", 'w = "belt"')
    run_ensemble(parse_scene(source.encode()), tmp_path / "out", workers=0)
    (n_exits,) = query.members(tmp_path / "out")["n_exits"]
    assert query.sql(tmp_path / "out", block(7, "sql"))["exits"].sum() == n_exits
    started = query.sql(tmp_path / "out", "SELECT count(DISTINCT block) AS n FROM events WHERE initial_mode = 0")
    assert started["n"][0] > 10


def test_8_twins(ask, kept):
    found = ask(8)
    np.testing.assert_allclose(found[found["t"] == 0]["growth"], 1.0, rtol=1e-6)
    assert set(found["t"]) == {0.0, 10.0, 20.0, 30.0}
    sizes = query.members(kept, ["member_id", "twin_size"]).dropna().set_index("member_id")["twin_size"]
    apart = {name: distance / sizes[name] for name, (_, distance) in query.separations(kept).items() if name in sizes}
    growth = np.array([np.log(factors[2]) for name, factors in apart.items() if "coulomb" in name])
    assert np.exp(growth.mean()) == pytest.approx(
        found[(found["t"] == 10) & (found["engine"] == "coulomb")]["growth"].iloc[0], rel=1e-9
    )


def test_9_changed_constants(ask):
    found = ask(9)
    assert set(found["perturbation_size"]) == {0.01, 0.1}
    assert (found["pairs"] == 8).all()
    assert found["exits_ratio"].between(0.3, 3.0).all()


def test_10_thresholds(ask):
    found = ask(10)
    assert list(found["threshold"]) == [0.25, 1.0, 4.0]
    assert found["mean_n_stick"].is_monotonic_increasing  # who is within a little is within more
