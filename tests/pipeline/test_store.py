"""The dataset: the same bytes however it came about, and every damage found."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import pipeline
import sim
from pipeline import Progress, StoreError, expand, parse_scene, query, run_scene, status, verify
from pipeline.manifest import read_manifest
from pipeline.shards import SCALARS, SCHEMA, shard_schema

ROOT = Path(pipeline.__file__).parents[1]


def shards(path):
    return sorted((path / "data").iterdir())


def tables(path):
    return [pq.read_table(file) for file in shards(path)]


# ------------------------------------------------------------------------------------------ what is kept


def test_one_row_a_member_in_order_with_the_written_schema(finished, scene):
    schema = shard_schema(scene.hash, events=True)
    found = []
    for table in tables(finished):
        assert table.schema.equals(schema, check_metadata=True)
        found += table["member_id"].to_pylist()
    assert found == [member.member_id for member in expand(scene)]
    assert (finished / "data").is_dir()
    assert len(found) == status(finished).n_members
    assert verify(finished) == []


def test_rows_hold_parameters_and_results(finished, scene):
    members = {member.member_id: member for member in expand(scene)}
    for table in tables(finished):
        for row in table.to_pylist():
            member = members[row["member_id"]]
            assert {name: row[name] for name in member.__slots__} == {
                name: getattr(member, name) for name in member.__slots__
            }
            assert row["n_events"] == row["n_entries"] + row["n_exits"] + row["n_crossings"] == len(row["event_t"])
            assert row["n_stick_end"] == row["n_stick"][-1]
            assert row["t"][0] == 0.0
            assert all(a < b for a, b in zip(row["t"], row["t"][1:], strict=False))
            assert row["outcome"] in ("finished", "collapsed", "diverged")
            assert (row["reason"] is None) == (row["outcome"] == "finished")


def test_every_column_is_described_and_holds_no_nan(finished):
    for table in tables(finished):
        for field in table.schema:
            assert field.metadata[b"description"], field.name
            values = table[field.name].combine_chunks()
            values = values.flatten() if field.name not in SCALARS else values
            if str(values.type) == "double":
                assert np.isfinite(values.drop_null().to_numpy()).all(), field.name


def test_without_recording_there_are_no_event_columns(source, tmp_path):
    text = source.replace(b"events = true", b"events = false").replace(b"matrices = 3", b"matrices = 1")
    run_scene(parse_scene(text), text, tmp_path / "out", workers=0)
    assert all(table.schema.names == SCHEMA.names for table in tables(tmp_path / "out"))


def test_scene_is_kept_byte_for_byte(finished, source):
    assert (finished / "scene.toml").read_bytes() == source


def test_a_member_that_raises_is_a_row_and_its_neighbours_are_untouched(
    scene, source, tmp_path, finished, monkeypatch
):
    simulate = sim.simulate

    def fragile(system, *args, **settings):
        if system.n == 5 and settings["engine"] == "coulomb":
            raise ZeroDivisionError("one\n  two")
        return simulate(system, *args, **settings)

    monkeypatch.setattr("sim.simulate", fragile)
    result = run_scene(scene, source, tmp_path / "out", workers=0)
    assert result.is_complete
    assert result.outcomes["failed"] == 9
    assert result.failures == {"ZeroDivisionError: one two": 9}
    assert sum(result.outcomes.values()) == scene.n_members
    assert verify(tmp_path / "out") == []
    before = {row["member_id"]: row for table in tables(finished) for row in table.to_pylist()}
    for table in tables(tmp_path / "out"):
        for row in table.to_pylist():
            if row["outcome"] == "failed":
                assert row["n"] == 5
                assert row["engine"] == "coulomb"
                assert row["t"] is None
                assert row["n_events"] is None
            else:
                assert row == before[row["member_id"]]
    with pytest.raises(query.QueryError, match="which failed: ZeroDivisionError: one two"):
        query.n_stick(tmp_path / "out", "n5-m000-coulomb-1e-10")
    assert len(list(query.series(tmp_path / "out"))) == scene.n_members - 9


# ------------------------------------------------------------------------------------------ crashes

# Every file operation of a run in turn, the process dies in it: before it has its effect.
KILLED = """
import os, sys
from pathlib import Path
from pipeline import members, parse_scene, run_scene
members.TARGET_COST = 3.5e-3
source, out = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2])
scene = parse_scene(source)
for moment in map(int, sys.argv[3:]):
    child = os.fork()
    if child == 0:
        calls = 0
        def deadly(operation):
            def call(*args, **kwargs):
                global calls
                calls += 1
                if calls == moment:
                    os.kill(os.getpid(), 9)
                return operation(*args, **kwargs)
            return call
        for name in ("fsync", "replace", "open"):
            setattr(os, name, deadly(getattr(os, name)))
        run_scene(scene, source, out / str(moment), workers=0)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def python(script, *arguments):
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_killed_at_each_step_of_a_commit_then_resumed(scene, source, finished, content, tmp_path):
    (tmp_path / "scene").write_bytes(source)
    moments = [*range(1, 19), 40, 41, 42, 43]
    done = python(KILLED, tmp_path / "scene", tmp_path, *moments)
    assert done.stdout.split() == ["-9"] * len(moments), done.stderr
    leftovers = 0
    for moment in moments:
        out = tmp_path / str(moment)
        leftovers += len(list(out.rglob(".tmp-*")))
        run_scene(scene, source, out, workers=0)
        assert content(out) == content(finished), moment
        timings = [json.loads(line) for line in (out / "timings.jsonl").read_text().splitlines()]
        assert {timing["shard"] for timing in timings} <= set(read_manifest(out).shards)
    assert leftovers >= 4  # some kills hit between the writing of a file and its renaming


DRIVER = """
import os, sys
from pathlib import Path
from pipeline import members, parse_scene, run_scene
members.TARGET_COST = 3.5e-3
source = Path(sys.argv[1]).read_bytes()
scene = parse_scene(source)
def half_way(progress):
    if 2 * progress.n_done >= progress.n_members:
        os.kill(os.getpid(), 9)
if __name__ == "__main__":
    run_scene(scene, source, Path(sys.argv[2]), workers=2, on_progress=half_way)
"""


def test_driver_killed_half_way_then_resumed(scene, source, finished, content, tmp_path):
    (tmp_path / "scene").write_bytes(source)
    out = tmp_path / "out"
    assert python(DRIVER, tmp_path / "scene", out).returncode == -9
    half = status(out)
    assert scene.n_members / 2 <= half.n_done < scene.n_members
    assert not half.is_complete
    assert verify(out) == []
    kept = {file.name: file.stat().st_mtime_ns for file in shards(out)}
    seen: list[Progress] = []
    assert run_scene(scene, source, out, workers=0, on_progress=seen.append).is_complete
    assert seen[0].n_done == half.n_done
    assert seen[0].cost_done == seen[0].cost_resumed > 0
    assert content(out) == content(finished)
    assert all(file.stat().st_mtime_ns == kept.get(file.name, file.stat().st_mtime_ns) for file in shards(out))


def test_full_disk_is_one_clear_error_and_resumes(scene, source, finished, content, tmp_path, monkeypatch):
    out = tmp_path / "out"
    fsync, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 11:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match=r"No space left on device.*run the same scene again"):
        run_scene(scene, source, out, workers=0)
    monkeypatch.undo()
    monkeypatch.setattr("pipeline.members.TARGET_COST", 3.5e-3)
    assert list(out.rglob(".tmp-*")) == []
    assert not (out / ".lock").exists()
    run_scene(scene, source, out, workers=0)
    assert content(out) == content(finished)


# ------------------------------------------------------------------------------------------ damage


def truncate(file):
    os.truncate(file, file.stat().st_size // 2)


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 1
    file.write_bytes(content)


DAMAGE = {
    "truncated": (truncate, "bytes, got"),
    "emptied": (lambda file: os.truncate(file, 0), "bytes, got 0"),
    "flipped bit": (flip, "expected sha256"),
    "missing": (Path.unlink, "missing"),
    "swapped": (lambda file: shutil.copy(shards(file.parents[1])[0], file), "expected "),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found_and_only_that_is_computed_again(name, copy, scene, source, finished, content, caplog):
    spoil, words = DAMAGE[name]
    victim = shards(copy)[3]
    spoil(victim)
    problems = verify(copy)
    assert len(problems) == 1
    assert problems[0].startswith(str(victim))
    assert words in problems[0]
    kept = {file: file.stat().st_mtime_ns for file in shards(copy) if file.name != victim.name}
    run_scene(scene, source, copy, workers=0)
    assert content(copy) == content(finished)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert victim.name in caplog.text


def test_strays_are_found_and_ours_are_removed(copy, scene, source, content, finished):
    strays = [
        copy / "data" / "shard-00099-0123456789ab.parquet",
        copy / "data" / ".tmp-x",
        copy / ".tmp-manifest.json",
    ]
    for stray in strays:
        stray.write_bytes(b"x")
    assert [problem.split(": ")[0] for problem in verify(copy)] == sorted(map(str, strays))
    run_scene(scene, source, copy, workers=0)
    assert content(copy) == content(finished)


def test_a_foreign_file_is_found_and_never_removed(copy, scene, source):
    note = copy / "data" / "notes.txt"
    note.write_text("mine")
    assert verify(copy) == [f"{note}: stray file, not in the manifest"]
    run_scene(scene, source, copy, workers=0)
    assert note.read_text() == "mine"


def forge(path, name, **entries):
    """Make the manifest agree with a shard that was changed on purpose."""
    manifest = json.loads((path / "manifest.json").read_text())
    content = (path / "data" / name).read_bytes()
    manifest["shards"][name] |= {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)} | entries
    (path / "manifest.json").write_text(json.dumps(manifest))


def test_wrong_rows_and_wrong_members_are_found_behind_a_right_sha256(copy):
    first, second, third, fourth = shards(copy)[:4]
    table = pq.read_table(first)
    pq.write_table(table.slice(1), first)
    forge(copy, first.name)
    table = pq.read_table(second)
    ids = table["member_id"].to_pylist()
    order = [0, 2, 1, *range(3, len(ids))]
    pq.write_table(table.take(order), second)
    forge(copy, second.name)
    forge(copy, third.name, rows=99)
    pq.write_table(pq.read_table(fourth).drop_columns("n"), fourth)
    forge(copy, fourth.name)
    rows, members, entry, columns = verify(copy)
    assert f"got {pq.read_table(first).num_rows}" in rows
    assert f"expected member {ids[1]}, got {ids[2]}" in members
    assert "99" in entry
    assert "expected the columns of schema version 2" in columns


def test_page_checksums_catch_a_flipped_bit_that_the_manifest_does_not_know(copy):
    victim = shards(copy)[0]
    column = pq.read_metadata(victim).row_group(0).column(0)
    content = bytearray(victim.read_bytes())
    content[column.dictionary_page_offset + column.total_compressed_size - 3] ^= 1
    victim.write_bytes(content)
    forge(copy, victim.name)
    assert ["CRC checksum" in problem for problem in verify(copy)] == [True]
    with pytest.raises(StoreError, match=r"CRC checksum.*run the scene again"):
        query.members(copy, columns=["member_id"])
    with pytest.raises(query.QueryError):
        query.sql(copy, "SELECT member_id FROM members")


# ------------------------------------------------------------------------------------------ refusals


def listing(path):
    return {str(file): file.read_bytes() if file.is_file() else None for file in path.rglob("*")}


def test_another_scene_is_refused_with_the_difference(copy, source):
    changed = source.replace(b"seed = 7", b"seed = 8").replace(b"z = -0.7", b"z = -0.8")
    before = listing(copy)
    scene = parse_scene(changed)
    with pytest.raises(StoreError) as caught:
        run_scene(scene, changed, copy, workers=0)
    for words in (scene.hash[:12], parse_scene(source).hash[:12], "run.seed: 8 here, 7 there", "start.z: -0.8 here",
                  "choose another directory"):  # fmt: skip
        assert words in str(caught.value)
    assert listing(copy) == before


def test_title_and_analysis_may_change_without_computing(copy, source, monkeypatch):
    monkeypatch.setattr("sim.simulate", None)
    changed = source.replace(b'title = "small"', b'title = "new"').replace(b"t_burn = 1.0", b"t_burn = 2.0")
    assert run_scene(parse_scene(changed), changed, copy, workers=0).is_complete
    assert (copy / "scene.toml").read_bytes() == changed
    assert verify(copy) == []


def test_shards_packed_otherwise_are_refused_and_kept(copy, scene, source, monkeypatch):
    kept = {file: file.read_bytes() for file in shards(copy)}
    monkeypatch.setattr("pipeline.members.TARGET_COST", 7e-3)
    with pytest.raises(StoreError, match=r"go on with the version that began, or choose another directory"):
        run_scene(scene, source, copy, workers=0)
    assert {file: file.read_bytes() for file in shards(copy)} == kept
    assert "not a shard of this scene" in "".join(verify(copy))


def test_a_directory_of_something_else_is_refused_and_left_alone(scene, source, tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(StoreError, match=r"got files but no manifest\.json; choose another directory"):
        run_scene(scene, source, tmp_path, workers=0)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(StoreError, match="expected a directory, got a file"):
        run_scene(scene, source, tmp_path / "thesis.tex", workers=0)
    with pytest.raises(StoreError, match=r"expected a dataset, found no manifest\.json"):
        status(tmp_path)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"rows"', '"row"', 1),
        lambda text: text.replace('"shard-00000-', '"../shard-00000-', 1),
        lambda text: text.replace('"schema_version": 2', '"schema_version": 3'),
        lambda text: "[]",
    ],
)
def test_a_corrupt_manifest_is_a_clear_error_and_nothing_is_lost(spoil, copy, scene, source):
    manifest = copy / "manifest.json"
    manifest.write_text(spoil(manifest.read_text()))
    before = listing(copy)
    for look in (status, verify, query.members, lambda path: run_scene(scene, source, path, workers=0)):
        with pytest.raises(StoreError, match=r"manifest\.json: expected a manifest, got something damaged"):
            look(copy)
    assert listing(copy) == before


def test_one_writer_at_a_time(copy, scene, source):
    before = listing(copy)
    with open(copy / ".lock", "w") as lock:
        lock.write("process 1234 on elsewhere")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StoreError, match=r"lock held by process 1234 on elsewhere; wait for it to end"):
            run_scene(scene, source, copy, workers=0)
    assert {name: text for name, text in listing(copy).items() if not name.endswith(".lock")} == before
    assert run_scene(scene, source, copy, workers=0).is_complete  # what a crash leaves is no obstacle
    assert not (copy / ".lock").exists()
