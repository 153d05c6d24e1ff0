"""The dataset: the same bytes however it came about, and every damage found."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stickslip.pipeline import (
    Progress,
    StoreError,
    expand,
    parse_scene,
    query,
    run_ensemble,
    run_member,
    status,
    verify,
)
from stickslip.pipeline.dataset.schema import scalars, schema_of
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.places import directory, object_store, plain
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.running.worker import compute
from stickslip.pipeline.scene.columns import DESIGN, FIXED
from tests.scenes import COULOMB, ensemble


def shards(path):
    return sorted((path / "data").iterdir())


def tables(path):
    return [pq.read_table(file) for file in shards(path)]


# ------------------------------------------------------------------------------------------ what is kept


def test_one_row_a_member_in_order_with_the_written_schema(finished, scene):
    schema = schema_of(scene.recording)
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
            kept = member.row()
            kept.pop("thresholds", None)  # in a column of their own
            for name in kept.keys() - row.keys():  # columns of other scenes
                assert kept.pop(name) is None, name
            assert {name: row[name] for name in kept} == kept
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
            values = values.flatten() if field.name not in scalars(table.schema) else values
            if str(values.type) == "double":
                assert np.isfinite(values.drop_null().to_numpy()).all(), field.name


def test_without_recording_there_are_no_event_columns(source, tmp_path):
    text = source.replace(b"events = true", b"events = false").replace(b"matrices = 3", b"matrices = 1")
    run_ensemble(parse_scene(text), tmp_path / "out", workers=0)
    assert all(table.schema.names == [column.name for column in FIXED] for table in tables(tmp_path / "out"))


# ------------------------------------------------------------------------------------------ crashes


def test_full_disk_is_one_clear_error_and_resumes(scene, finished, content, tmp_path, monkeypatch):
    out = tmp_path / "out"
    fsync, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 11:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match=r"No space left on device.*rerun the scene"):
        run_ensemble(scene, out, workers=0)
    monkeypatch.undo()
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 3.5e-3)
    assert list(out.rglob(".tmp-*")) == []
    assert not (out / ".lock").exists()
    run_ensemble(scene, out, workers=0)
    assert content(out) == content(finished)


def test_content_is_on_the_disk_before_its_name_and_the_name_before_we_go_on(tmp_path, monkeypatch):
    calls = []

    def fsync(descriptor):
        found = os.fstat(descriptor)
        calls.append(("sync", "directory" if stat.S_ISDIR(found.st_mode) else found.st_size))

    replace = os.replace
    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", lambda old, new, **at: (calls.append(("name", new)), replace(old, new, **at)))
    Directory(tmp_path).replace("file", b"x" * 100_000)
    assert calls == [("sync", 100_000), ("name", "file"), ("sync", "directory")]


def test_a_shard_is_there_before_the_manifest_says_so(scene, tmp_path, monkeypatch):
    """Looked at wherever a crash could leave things for good: at each sync."""
    out, fsync, looks = tmp_path / "out", os.fsync, []

    def look(descriptor):
        fsync(descriptor)
        with contextlib.suppress(StoreError):  # not a dataset yet
            looks.append(status(out).n_damaged)

    monkeypatch.setattr(os, "fsync", look)
    run_ensemble(scene, out, workers=0)
    assert len(looks) > len(shards(out))
    assert set(looks) == {0}


def test_a_line_that_a_crash_cut_short_spoils_no_other(tmp_path):
    (tmp_path / "lines").write_bytes(b"one\ntw")
    with Directory(tmp_path).record("lines") as append:
        append(b"three\n")
    assert (tmp_path / "lines").read_bytes() == b"one\nthree\n"


def test_a_line_of_which_the_disk_takes_a_part_is_taken_back(tmp_path, monkeypatch):
    """A disk that is nearly full takes what it has room for, which is no error."""
    write = os.write
    with Directory(tmp_path).record("lines") as append:
        append(b"one\n")
        monkeypatch.setattr(os, "write", lambda descriptor, line: write(descriptor, line[:2]))
        with pytest.raises(OSError, match="No space left on device"):
            append(b"two\n")
        monkeypatch.undo()
        append(b"three\n")
    assert (tmp_path / "lines").read_bytes() == b"one\nthree\n"


def test_a_lock_on_a_file_that_is_replaced_meanwhile_is_none(tmp_path, monkeypatch):
    """Between our opening it and our locking it its owner removes the file, and another process makes it anew."""
    lock, is_locked, tries = tmp_path / ".lock", directory.is_locked, []

    def late(descriptor):
        tries.append(descriptor)
        if len(tries) == 1:
            lock.unlink()
            lock.write_text("")
        return is_locked(descriptor)

    monkeypatch.setattr(directory, "is_locked", late)
    with Directory(tmp_path).own(), open(lock) as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert len(tries) == 2


def test_errors_name_a_file_by_its_path_alone(tmp_path):
    for act in (lambda: os.unlink(tmp_path / "a"), lambda: os.replace(tmp_path / "a", tmp_path / "b")):
        with pytest.raises(FileNotFoundError) as error, plain.filename(Path("there")):
            act()
        assert str(error.value).endswith(": 'there'")


def test_files_have_the_modes_that_their_owner_lets_them_have(scene, tmp_path):
    """As a group has that works in one directory: the next member resumes."""
    before = os.umask(0o002)
    try:
        with Store(tmp_path / "out", scene) as store:
            store.commit(compute(store.todo[0]))
            modes = {file.name: file.stat().st_mode & 0o777 for file in (tmp_path / "out").rglob("*.*")}
    finally:
        os.umask(before)
    assert {".lock", "timings.jsonl"} <= modes.keys()
    assert set(modes.values()) == {0o664}, modes


def test_a_commit_that_fails_is_forgotten(scene, tmp_path, monkeypatch):
    with Store(tmp_path, scene) as store:
        first, second = (compute(batch) for batch in store.todo[:2])
        fsync, calls = os.fsync, []

        def full(descriptor):
            calls.append(descriptor)
            if len(calls) > 2:  # the shard and its name are there
                raise OSError(errno.ENOSPC, "No space left on device")
            fsync(descriptor)

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(StoreError, match="No space left"):
                store.commit(first)
        store.commit(second)
        assert set(store.done) == {second.name}
    assert verify(tmp_path) == []
    assert [file.name for file in shards(tmp_path)] == [second.name]


@pytest.mark.parametrize("at", [0, 1, 2])
def test_shards_that_are_committed_together_are_all_there_or_none(scene, tmp_path, monkeypatch, at):
    """Whichever of the shards is refused; none leaves a file, and the record has no word of it."""
    with Store(tmp_path, scene) as store:
        first, *some = (compute(batch) for batch in store.todo[:4])
        store.commit(first)
        replace = Directory.replace

        def full(place, name, content):
            if name.endswith(some[at].name):
                raise OSError(errno.ENOSPC, "No space left on device")
            replace(place, name, content)

        with monkeypatch.context() as patch:
            patch.setattr(Directory, "replace", full)
            with pytest.raises(StoreError, match="No space left"):
                store.commit(*some)
        assert [file.name for file in shards(tmp_path)] == [first.name]
        assert len((tmp_path / "timings.jsonl").read_bytes().splitlines()) == 1
        store.commit(*some)
        assert set(store.done) == {one.name for one in (first, *some)}
    assert verify(tmp_path) == []


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
def test_damage_is_found_and_only_that_is_computed_again(name, copy, scene, finished, content, caplog):
    spoil, words = DAMAGE[name]
    victim = shards(copy)[3]
    spoil(victim)
    problems = verify(copy)
    assert len(problems) == 1
    assert problems[0].startswith(str(victim))
    assert words in problems[0]
    kept = {file: file.stat().st_mtime_ns for file in shards(copy) if file.name != victim.name}
    run_ensemble(scene, copy, workers=0)
    assert content(copy) == content(finished)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert victim.name in caplog.text


def forge(path, name, **entries):
    """Make the manifest agree with a shard that was changed on purpose."""
    manifest = read_manifest(path)
    content = (path / "data" / name).read_bytes()
    entries = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)} | entries
    manifest.shards[name] = manifest.shards[name].model_copy(update=entries)
    (path / "manifest.json").write_bytes(manifest.to_bytes())


def test_wrong_rows_and_wrong_members_are_found_behind_a_right_sha256(copy):
    first, second, third, fourth, fifth = shards(copy)[:5]
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
    forge(copy, fifth.name, outcomes={"failed": 1})
    rows, members, entry, columns, outcomes = verify(copy)
    assert f"got {pq.read_table(first).num_rows}" in rows
    assert f"member_id of {ids[1]}: expected {ids[1]}, got {ids[2]}" in members
    assert "99" in entry
    assert "expected the columns of schema version 3" in columns
    assert "expected the outcomes {'failed': 1}, got" in outcomes


@pytest.mark.parametrize(
    "change", [{"bytes": 10**400}, {"rows": 10**30}, {"rows": 99}, {"name": "9" * 5000}, {"name": "\u0661" * 5}]
)
def test_numbers_that_no_shard_has_are_refused(copy, change):
    manifest, victim = read_manifest(copy), shards(copy)[0].name
    entry = manifest.shards.pop(victim)
    name = victim.replace("00000", change.pop("name", "00000"))
    manifest.shards[name] = entry.model_copy(update=change)
    (copy / "manifest.json").write_bytes(manifest.to_bytes())
    with pytest.raises(StoreError, match=r"manifest\.json: expected .*, got"):
        status(copy)
    if change != {"rows": 99}:  # else it is read, and named by the audit
        with pytest.raises(StoreError, match=r"manifest\.json: expected a manifest, got something damaged"):
            verify(copy)


def test_page_checksums_catch_a_flipped_bit_that_the_manifest_does_not_know(copy):
    victim = shards(copy)[0]
    column = pq.read_metadata(victim).row_group(0).column(0)
    content = bytearray(victim.read_bytes())
    content[column.dictionary_page_offset + column.total_compressed_size - 3] ^= 1
    victim.write_bytes(content)
    forge(copy, victim.name)
    assert ["CRC checksum" in problem for problem in verify(copy)] == [True]
    with pytest.raises(StoreError, match=r"CRC checksum.*rerun the scene"):
        query.members(copy, columns=["member_id"])
    for more in ("", ", range(20000)"):  # found before the first rows, and after
        with pytest.raises(StoreError, match=r"cannot be read.*CRC checksum.*rerun the scene"):
            query.sql(copy, f"SELECT member_id FROM members{more}")


# ------------------------------------------------------------------------------------------ refusals


def listing(path):
    return {str(file): file.read_bytes() if file.is_file() else None for file in path.rglob("*")}


def test_another_scene_is_refused_with_the_difference(copy, source):
    changed = source.replace(b"seed = 7", b"seed = 8").replace(b"z = -0.7", b"z = -0.8")
    before = listing(copy)
    scene = parse_scene(changed)
    with pytest.raises(StoreError) as caught:
        run_ensemble(scene, copy, workers=0)
    for words in (
        scene.hash[:12],
        parse_scene(source).hash[:12],
        "run.seed: 8 here, 7 there",
        "start.z: -0.8 here",
        "choose another directory",
    ):
        assert words in str(caught.value)
    assert listing(copy) == before


def test_the_key_that_was_changed_comes_before_what_follows_from_it(copy, source):
    changed = source.replace(b"events = true", b"events = false")
    changed = changed.replace(b"[perturbation]\nsizes = [0.05, 0.01]", b"")
    with pytest.raises(StoreError) as caught:
        run_ensemble(parse_scene(changed), copy, workers=0)
    keys = [part.partition(":")[0] for part in str(caught.value).split("; ")[1:]]
    written = ["perturbation.sizes", "record.events"]
    picked = ["engine[0].picked_for", "engine[0].tol", "engine[1].atol"]
    assert keys == [*written, *picked, "and 4 keys more", "choose another directory, or restore what differs"]


def test_title_and_analysis_may_change_without_computing(copy, source, monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)
    changed = source.replace(b'title = "small"', b'title = "new"').replace(b"t_burn = 1.0", b"t_burn = 2.0")
    assert run_ensemble(parse_scene(changed), copy, workers=0).is_complete
    assert (copy / "scene.toml").read_bytes() == changed
    assert verify(copy) == []


def test_a_dataset_keeps_the_packing_that_it_began_with(copy, scene, content, finished, monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 7e-3)
    shards(copy)[2].unlink()
    run_ensemble(scene, copy, workers=0)
    assert content(copy) == content(finished)


def test_shards_of_other_members_are_refused_and_kept(copy, scene):
    manifest, victim = read_manifest(copy), shards(copy)[2]
    foreign = victim.rename(victim.with_name(victim.name.replace("00002", "00099")))
    manifest.shards[foreign.name] = manifest.shards.pop(victim.name)
    (copy / "manifest.json").write_bytes(manifest.to_bytes())
    kept = {file: file.read_bytes() for file in shards(copy)}
    with pytest.raises(StoreError, match=r"got shard-00099.*use the version of stickslip that began it"):
        run_ensemble(scene, copy, workers=0)
    assert {file: file.read_bytes() for file in shards(copy)} == kept
    assert "not a shard of this scene" in "".join(verify(copy))


def test_a_directory_of_something_else_is_refused_and_left_alone(scene, tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(StoreError, match=r"got files \(thesis\.tex\) but no manifest\.json; choose another"):
        run_ensemble(scene, tmp_path, workers=0)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(StoreError, match="expected a directory, got a file"):
        run_ensemble(scene, tmp_path / "thesis.tex", workers=0)
    with pytest.raises(StoreError, match=r"expected a dataset, found no manifest\.json"):
        status(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (
            ".lock",
            "pid 77 of my mail program\n",
            r"\.lock: expected a lock of this program, got something else; remove",
        ),
        (".lock", "precious", r"\.lock: expected a lock of this program"),
        ("timings.jsonl", "precious\nno end", r"timings\.jsonl: expected a record of commits of this program, got"),
        ("timings.jsonl", "no end", r"timings\.jsonl: expected a record of commits"),
        (".tmp-notes", "precious", r"got files \(\.tmp-notes\) but no manifest\.json; choose another directory"),
    ],
)
@pytest.mark.parametrize("has_scene", [False, True])
def test_what_others_left_where_no_dataset_is_stays_as_it_is(
    name, content, words, has_scene, scene, source, tmp_path
):
    """Also where the scene itself lies: its directory may be that of the dataset."""
    (tmp_path / name).write_text(content)
    if has_scene:
        (tmp_path / "scene.toml").write_bytes(source)
    before = listing(tmp_path)
    if has_scene and name not in (".lock", "timings.jsonl"):
        run_ensemble(scene, tmp_path, workers=0)
        assert before.items() <= listing(tmp_path).items()
        return
    for is_dry in (True, False):
        with pytest.raises(StoreError, match=words):
            Store(tmp_path, scene).look() if is_dry else run_ensemble(scene, tmp_path, workers=0)
        assert listing(tmp_path) == before


def test_names_that_this_program_never_makes_are_left_alone_in_a_dataset(copy, scene, source):
    shard, chance = shards(copy)[0].name, "0123456789abcdef"
    theirs = [
        ".tmp-notes",
        "data/shard-notes.parquet",
        "data/.tmp-shard",
        "data/shard-\u0661\u0661\u0661\u0661\u0661-0123456789ab.parquet",
    ]
    ours = [
        f".tmp-manifest.json-here-77-{chance}",
        f"data/.tmp-{shard}-elsewhere-77-{chance}",
        f".tmp-{2 * chance}",  # of a store, in a copy
        "data/shard-00099-0123456789ab.parquet",
    ]
    for name in theirs + ours:
        (copy / name).write_text("precious")
    run_ensemble(scene, copy, workers=0)
    assert [(copy / name).read_text() for name in theirs] == ["precious"] * len(theirs)
    assert not [name for name in ours if (copy / name).exists()]


@pytest.mark.parametrize("lock", ["", "proc", "process 77 on"])
@pytest.mark.parametrize("record", ["", '{"chec', '{"check": "0123", "entr'])
def test_what_a_crash_leaves_before_the_first_commit_is_taken_over(lock, record, scene, tmp_path):
    (tmp_path / ".lock").write_text(lock)
    (tmp_path / "timings.jsonl").write_text(record)
    (tmp_path / ".tmp-manifest.json-here-77-0123456789abcdef").write_text("{")
    with Store(tmp_path, scene) as store:
        assert store.todo
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "datapackage.json", "manifest.json", "scene.toml", "timings.jsonl",
    ]  # fmt: skip
    assert (tmp_path / "timings.jsonl").read_bytes() == b""


@pytest.mark.parametrize("spoil", [
    lambda text: "",
    lambda text: text[: len(text) // 2],
    lambda text: text.replace('"rows"', '"row"', 1),
    lambda text: text.replace('"rows": 3', '"rows": 2', 1),
    lambda text: text.replace('"schema_version": 3', '"schema_version": 7'),
    lambda text: text.replace('"shard-00000-', '"../shard-00000-', 1),
    lambda text: "[]",
    None,
])  # fmt: skip
def test_a_lost_manifest_is_made_again_from_the_record_of_the_commits(
    spoil, copy, scene, source, content, finished, monkeypatch
):
    manifest = copy / "manifest.json"
    if spoil is None:
        manifest.unlink()
    else:
        manifest.write_text(spoil(manifest.read_text()))
    before = listing(copy)
    words = (
        r"found no manifest\.json" if spoil is None else r"manifest\.json: expected a manifest, got something damaged"
    )
    for look in (status, verify, query.members):
        with pytest.raises(StoreError, match=words):
            look(copy)
    changed = source.replace(b"seed = 7", b"seed = 8")
    other = parse_scene(changed)
    with pytest.raises(StoreError):  # of another scene, it is left alone
        run_ensemble(other, copy, workers=0)
    assert listing(copy) == before
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)  # nothing is computed
    run_ensemble(scene, copy, workers=0)
    assert content(copy) == content(finished)
    assert verify(copy) == []


def test_a_lost_manifest_and_a_lost_record_cost_what_they_would_have_confirmed(copy, scene, content, finished):
    (copy / "manifest.json").unlink()
    timings = copy / "timings.jsonl"
    timings.write_bytes(b"\n".join(timings.read_bytes().splitlines()[:3]) + b"\n{")
    kept = {file: file.stat().st_mtime_ns for file in shards(copy)}
    run_ensemble(scene, copy, workers=0)
    assert content(copy) == content(finished)
    assert sum(file.stat().st_mtime_ns == kept[file] for file in kept) == 3


@pytest.mark.parametrize("where", ["{tmp_path}/out", "memory://bucket/written"])
def test_what_is_written_beside_the_shards_grows_as_their_number(where, source, tmp_path, monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 1e-9)  # a member each
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)  # a row that says so
    written = []

    def counting(function, position):
        def counted(*arguments):
            written.append(len(arguments[position]))
            return function(*arguments)

        return counted

    monkeypatch.setattr(directory.Directory, "replace", counting(directory.Directory.replace, 2))
    monkeypatch.setattr(object_store.Prefix, "replace", counting(object_store.Prefix.replace, 2))
    monkeypatch.setattr(directory, "_append", counting(directory._append, 1))
    overhead = {}
    for matrices in (2, 4, 8):
        written.clear()
        grown = source.replace(b"matrices = 3", f"matrices = {matrices}".encode())
        found = run_ensemble(parse_scene(grown), f"{where.format(tmp_path=tmp_path)}{matrices}", workers=0)
        overhead[found.n_shards_done] = sum(written) - found.n_bytes
    print(overhead)  # bytes by number of shards
    few, more, many = overhead.values()
    assert many - more < 2.2 * (more - few)


def test_a_run_that_was_killed_is_told_by_manifest_and_record_together(copy, scene, content, finished):
    whole, record = read_manifest(copy), (copy / "timings.jsonl").read_bytes()
    lines = record.splitlines(keepends=True)
    began = whole.model_copy(update={"shards": {}, "recorded_from": len(lines[0])})
    (copy / "manifest.json").write_bytes(began.to_bytes())
    (copy / "timings.jsonl").write_bytes(record[:-20])  # cut short by a crash
    assert set(read_manifest(copy).shards) == {json.loads(line)["shard"] for line in lines[1:-1]}
    assert len(query.members(copy)) == sum(shard.rows for shard in read_manifest(copy).shards.values())
    deep = b"[" * 200_000 + b"\n"
    for spoilt in (
        record + deep,
        record.replace(b'"rows"', b'"rowz"'),
        record.replace(b'"rows": 3', b'"rows": 2'),
        lines[0][:-5],
    ):
        (copy / "timings.jsonl").write_bytes(spoilt)
        for look in (status, verify, query.members):
            with pytest.raises(StoreError, match=r"timings\.jsonl: expected the commits .*; rerun the scene"):
                look(copy)
    (copy / "timings.jsonl").write_bytes(record.replace(b'"rows"', b'"rowz"', 2))
    run_ensemble(scene, copy, workers=0)
    assert content(copy) == content(finished)
    assert read_manifest(copy).recorded_from is None


def test_a_run_that_was_killed_after_its_last_commit_lacks_its_description_alone(copy, scene, finished):
    whole = read_manifest(copy)
    began = whole.model_copy(update={"shards": {}, "recorded_from": 0, "package": None})
    (copy / "manifest.json").write_bytes(began.to_bytes())
    (copy / "datapackage.json").unlink()
    run_ensemble(scene, copy, workers=0)
    for name in ("manifest.json", "datapackage.json"):
        assert (copy / name).read_bytes() == (finished / name).read_bytes()


def test_the_digest_of_a_dataset_is_of_every_shard_and_its_content(finished):
    manifest = read_manifest(finished)
    assert manifest.digest == read_manifest(finished).digest
    for name, shard in manifest.shards.items():
        rest = {other: one for other, one in manifest.shards.items() if other != name}
        spoilt = rest | {name: shard.model_copy(update={"sha256": shard.sha256[::-1]})}
        for shards_left in (rest, spoilt):
            assert manifest.model_copy(update={"shards": shards_left}).digest != manifest.digest


def test_another_version_of_the_schema_is_refused_and_left_alone(copy, scene):
    manifest = json.loads((copy / "manifest.json").read_text())
    del manifest["check"]  # which version 2 had not
    (copy / "manifest.json").write_text(json.dumps(manifest | {"schema_version": 2}))
    before = listing(copy)
    for look in (status, verify, query.members, lambda path: run_ensemble(scene, path, workers=0)):
        with pytest.raises(StoreError, match=r"expected a dataset of schema version 3, got one of version 2; use"):
            look(copy)
    assert listing(copy) == before


def test_another_version_of_the_program_is_refused_unless_told(copy, scene, content, monkeypatch):
    for room in ("dataset.writer", "running.worker"):
        monkeypatch.setattr(f"stickslip.pipeline.{room}.program", lambda: "9.9.9-0123")
    complete = content(copy)
    assert run_ensemble(scene, copy, workers=0).is_complete  # nothing to compute: nothing to mix
    assert content(copy) == complete
    shards(copy)[1].unlink()
    before = listing(copy)
    with pytest.raises(StoreError, match=r"this version of the program \(9\.9\.9-0123\), got.*--accept-version"):
        run_ensemble(scene, copy, workers=0)
    assert listing(copy) == before
    assert run_ensemble(scene, copy, workers=0, accept_version=True).is_complete
    assert read_manifest(copy).programs[-1] == "9.9.9-0123"
    told = ("manifest.json", "datapackage.json")  # which name the programs
    assert {name: text for name, text in content(copy).items() if name not in told} == {
        name: text for name, text in complete.items() if name not in told
    }


def test_data_that_are_all_gone_are_none_to_mix_with(copy, scene, monkeypatch):
    for room in ("dataset.writer", "running.worker"):
        monkeypatch.setattr(f"stickslip.pipeline.{room}.program", lambda: "9.9.9-0123")
    for shard in shards(copy):
        shard.unlink()
    assert run_ensemble(scene, copy, workers=0).is_complete
    assert read_manifest(copy).programs == ["9.9.9-0123"]


# ------------------------------------------------------------------------------------------ growth and failures

GROWTH = {
    "matrices": (b"matrices = 3", b"matrices = 4"),
    "sizes of the system": (b"n = [5, 3]", b"n = [2, 5, 3]"),
    "sizes of the change": (b"sizes = [0.05, 0.01]", b"sizes = [0.05, 0.02, 0.01]"),
    "draws of the change": (b"sizes = [0.05, 0.02, 0.01]", b"sizes = [0.05, 0.02, 0.01]\ndraws = 2"),
    "draws of the ratios": (b"ratio_draws = 2", b"ratio_draws = 3"),
    "an engine": (b"[perturbation]", b'[[engine]]\nname = "coulomb"\ntol = 1e-6\n\n[perturbation]'),
    "twins": (b"[perturbation]", b"[twins]\nsizes = [1e-3]\n\n[perturbation]"),
}


def rows(path):
    """By name, without the numbers that a row has in a dataset: those of what grew stay."""
    kept = [row for table in tables(path) for row in table.drop_columns([one.name for one in DESIGN]).to_pylist()]
    return {row["member_id"]: row for row in kept}


def test_a_scene_that_grows_extends_its_dataset(copy, scene, source, tmp_path, monkeypatch):
    """By one thing after the other; in the end it has the rows of one that was run anew."""
    text, smaller = source, scene
    for old, new in GROWTH.values():
        assert text.count(old) == 1
        text = text.replace(old, new)
        grown = parse_scene(text)
        kept = {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in shards(copy)}
        seen: list[Progress] = []
        assert run_ensemble(grown, copy, workers=0, on_progress=seen.append).is_complete
        assert seen[0].n_done == smaller.n_members < grown.n_members == seen[-1].n_done
        assert {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in kept} == kept
        with pytest.raises(StoreError, match="or restore what differs"):  # it does not shrink
            run_ensemble(smaller, copy, workers=0)
        smaller = grown
    assert verify(copy) == []
    with monkeypatch.context() as patch:  # a row is the same whatever is in its shard
        patch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 1.0)
        run_ensemble(grown, tmp_path / "anew", workers=0)
    anew = rows(tmp_path / "anew")
    assert rows(copy) == anew
    shards(copy)[-1].unlink()
    shards(copy)[0].unlink()
    assert run_ensemble(grown, copy, workers=0).is_complete
    assert rows(copy) == anew


@pytest.mark.parametrize(
    ("old", "new", "columns"),
    [
        ("friction = [1.0]", "friction = [1.0, {uniform = [0.8, 1.2]}]", "drawn, start_draw"),
        ("[analysis]", '[[engine]]\nname = "moreau"\nstep = 0.1\n\n[analysis]', "step"),
    ],
)
def test_what_needs_columns_that_the_data_lack_is_refused_for_that(old, new, columns, tmp_path):
    text = ensemble("5\nfriction = [1.0]", 8.0, 1, COULOMB)
    assert text.count(old) == 1
    run_ensemble(parse_scene(text.encode()), tmp_path / "out", workers=0)
    before = listing(tmp_path / "out")
    words = f"a scene that adds some with {columns}, which these data lack; run it into another directory"
    grown = parse_scene(text.replace(old, new).encode())
    with pytest.raises(StoreError, match=words):
        run_ensemble(grown, tmp_path / "out", workers=0)
    assert listing(tmp_path / "out") == before


def test_a_scene_that_somebody_put_there_is_not_what_a_dataset_grew_from(copy, source):
    (copy / "scene.toml").write_bytes(source.replace(b"matrices = 3", b"matrices = 2"))
    before = listing(copy)
    with pytest.raises(StoreError, match=r"expected the dataset of this scene .*, or of a part of it, got that of"):
        run_ensemble(parse_scene(source.replace(b"matrices = 3", b"matrices = 4")), copy, workers=0)
    assert listing(copy) == before


def test_a_member_that_raises_is_a_row_and_is_tried_again_when_told(
    scene, tmp_path, finished, content, fragile, monkeypatch
):
    """Its neighbours are untouched."""
    out = tmp_path / "out"
    with fragile(ZeroDivisionError("one\n  two")):
        result = run_ensemble(scene, out, workers=0)
        name = next(name for name, row in rows(out).items() if row["outcome"] == "failed")
        assert run_member(scene, name)["reason"] == "ZeroDivisionError: one two"
    assert result.is_complete
    assert (result.failures, result.outcomes["failed"]) == ({"ZeroDivisionError: one two": 9}, 9)
    assert verify(out) == []
    before, after = rows(finished), rows(out)
    assert list(after) == list(before) == [member.member_id for member in expand(scene)]
    for member_id, row in after.items():
        if row["outcome"] == "failed":
            assert (row["n"], row["engine"], row["t"], row["n_events"]) == (5, "coulomb", None, None)
            assert row["reproduce"] == f"stickslip run scene.toml --only {member_id}"
        else:
            assert row == before[member_id]
    with pytest.raises(query.QueryError, match="which failed: ZeroDivisionError: one two"):
        query.n_stick(out, name)
    assert len(list(query.series(out))) == scene.n_members - 9
    with pytest.raises(ValueError, match="expected a member of the scene, such as 'n3-m000"):
        run_member(scene, "n9")
    with monkeypatch.context() as patch:
        patch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)
        run_ensemble(scene, out, workers=0)  # a failed member is done
    touched = {file: file.stat().st_mtime_ns for file in shards(out)}
    with_failed = {name for name, shard in read_manifest(out).shards.items() if shard.n_failed}
    seen: list[Progress] = []
    assert "failed" not in run_ensemble(scene, out, workers=0, retry_failed=True, on_progress=seen.append).outcomes
    assert seen[0].n_done < seen[-1].n_done == scene.n_members
    assert content(out) == content(finished)
    assert {file.name for file in touched if file.stat().st_mtime_ns != touched[file]} == with_failed


def test_one_writer_at_a_time(copy, scene):
    before = listing(copy)
    with open(copy / ".lock", "w") as lock:
        lock.write("process 1234 on elsewhere")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StoreError, match=r"lock held by process 1234 on elsewhere; wait for it to end"):
            run_ensemble(scene, copy, workers=0)
    assert {name: text for name, text in listing(copy).items() if not name.endswith(".lock")} == before
    assert run_ensemble(scene, copy, workers=0).is_complete  # what a crash leaves is no obstacle
    assert not (copy / ".lock").exists()
