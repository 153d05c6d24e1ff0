"""A dataset in an object store: the same bytes as in a directory, one writer, and what cannot be asked for."""

from __future__ import annotations

import shutil
import sys
import threading
import time

import fsspec
import pytest

from stickslip.pipeline import Progress, StoreError, query, run_ensemble, status, verify
from stickslip.pipeline.dataset.status import running
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.places import object_store
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.place import this_process
from tests.processes import until

OUT = "memory://bucket/out"


@pytest.fixture
def memory():
    """An object store in this process, by key; empty, and emptied after."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield system.store
    system.store.clear()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(object_store, "PAUSES", (0.0, 0.0, 0.0))
    monkeypatch.setattr(object_store, "SETTLE", 0.3)


def objects_of(memory, prefix="/bucket/out/"):
    names = {key.removeprefix(prefix): file.getvalue() for key, file in memory.items() if key.startswith(prefix)}
    return {name: content for name, content in names.items() if not name.startswith("timings")}


@pytest.fixture
def stored(finished, memory):
    """The finished dataset, copied there as it is."""
    fsspec.filesystem("memory").put(f"{finished}/", "/bucket/out/", recursive=True)
    return OUT


# ------------------------------------------------------------------------------------------ the same dataset


def test_same_bytes_as_in_a_directory_and_every_question_answered_alike(scene, finished, content, memory):
    assert run_ensemble(scene, OUT, workers=0).is_complete
    assert objects_of(memory) == content(finished)
    assert verify(OUT) == []
    here, there = status(finished), status(OUT)
    assert there.path == OUT
    assert (there.outcomes, there.n_bytes, there.n_shards) == (here.outcomes, here.n_bytes, here.n_shards)
    assert query.members(OUT).equals(query.members(finished))
    assert query.table(OUT, filters=[("n", "=", 5)]).equals(query.table(finished, filters=[("n", "=", 5)]))
    asked = "SELECT engine, count(*) AS many FROM cascades JOIN members USING (member_id) GROUP BY ALL ORDER BY ALL"
    assert query.sql(OUT, asked).equals(query.sql(finished, asked))
    there_by_dask = query.dask_members(OUT, ["n_exits"]).compute(scheduler="synchronous")
    assert there_by_dask["n_exits"].sum() == query.members(finished)["n_exits"].sum()
    assert list(query.series(OUT)) == list(query.series(finished))


def test_an_address_of_this_machine_is_a_directory(finished):
    assert status(f"file://{finished}").path == str(finished)
    assert verify(f"file://{finished}/") == []


def test_damage_is_found_and_only_that_is_computed_again(scene, finished, content, stored, memory):
    names = sorted(name for name in objects_of(memory) if name.startswith("data/"))
    store = fsspec.filesystem("memory")
    store.pipe_file(f"/bucket/out/{names[1]}", b"x")
    store.rm_file(f"/bucket/out/{names[3]}")
    store.pipe_file("/bucket/out/data/shard-00099-0123456789ab.parquet", b"x")
    store.pipe_file("/bucket/out/data/notes.txt", b"mine")
    found = [line.split(": ")[0] for line in verify(stored)]
    assert found == [
        f"{OUT}/{name}" for name in (names[1], names[3], "data/notes.txt", "data/shard-00099-0123456789ab.parquet")
    ]
    with pytest.raises(StoreError, match=r"shard-00001-.* expected \d+ bytes, got 1; rerun the scene"):
        query.members(stored)
    seen: list[Progress] = []
    run_ensemble(scene, stored, workers=0, on_progress=seen.append)
    assert sum(progress.last_shard is not None for progress in seen) == 2
    assert objects_of(memory) == content(finished) | {"data/notes.txt": b"mine"}


def test_a_store_that_is_lost_before_shards_are_counted_is_told(stored, monkeypatch):
    def failing(*_):
        raise OSError(5, "Service is unable to handle request")

    monkeypatch.setattr(object_store.Prefix, "sizes", failing)
    words = r"memory://bucket/out: shards cannot be read \(Service is .*\); check the address.*, then try again"
    with pytest.raises(StoreError, match=words):
        status(stored)


def test_a_lost_manifest_is_made_again_from_the_record(scene, finished, content, memory, monkeypatch):
    run_ensemble(scene, OUT, workers=0)
    del memory["/bucket/out/manifest.json"]
    with pytest.raises(StoreError, match=r"memory://bucket/out: expected a dataset, found no manifest\.json"):
        status(OUT)
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)  # nothing is computed
    run_ensemble(scene, OUT, workers=0)
    assert objects_of(memory) == content(finished)


def test_a_dataset_is_the_same_wherever_it_is_copied(scene, finished, content, memory, tmp_path, monkeypatch):
    run_ensemble(scene, OUT, workers=0)
    fsspec.filesystem("memory").get("/bucket/out/", f"{tmp_path}/", recursive=True)
    assert content(tmp_path) == content(finished)
    (tmp_path / "manifest.json").unlink()
    monkeypatch.setattr("stickslip.pipeline.ensemble.member.Member.task", None)
    assert run_ensemble(scene, tmp_path, workers=0).is_complete


def test_files_of_something_else_are_refused_and_left_alone(scene, memory):
    fsspec.filesystem("memory").pipe_file("/bucket/out/thesis.tex", b"all of it")
    with pytest.raises(StoreError, match=r"got files \(.+\) but no manifest\.json; choose another directory"):
        run_ensemble(scene, OUT, workers=0)
    assert objects_of(memory) == {"thesis.tex": b"all of it"}


# ------------------------------------------------------------------------------------------ one writer


def leave_lock(seconds, owner="process 1234 on elsewhere"):
    """What a driver leaves that was killed; its lease has so many seconds to go."""
    lock = f"{owner}\nlease {time.time() + seconds:.3f} 0123\nbegan {time.time():.3f} 0 0.0\n"
    fsspec.filesystem("memory").pipe_file("/bucket/out/.lock", lock.encode())


def test_a_lock_that_holds_is_a_refusal_that_says_until_when(scene, stored, memory):
    leave_lock(42.4)
    before = objects_of(memory)
    assert running(stored).owner == "process 1234 on elsewhere"
    with pytest.raises(StoreError, match=r"held by process 1234 on elsewhere; .*its lease ends in 42 s"):
        run_ensemble(scene, stored, workers=0)
    assert objects_of(memory) == before


def test_a_lock_that_ran_out_is_taken_over(scene, stored, memory, impatient):
    leave_lock(-0.1)
    assert running(stored) is None
    assert run_ensemble(scene, stored, workers=0).is_complete
    assert ".lock" not in objects_of(memory)


def test_of_many_that_take_over_one_does(memory, impatient):
    leave_lock(-0.1)
    owner, got, ended = place_of(OUT), [], threading.Event()

    def contend():
        try:
            with owner.own():
                got.append(True)
                ended.wait(60)
        except StoreError as error:
            got.append(str(error))
            if len(got) == 8:
                ended.set()

    drivers = [threading.Thread(target=contend) for _ in range(8)]
    for driver in drivers:
        driver.start()
    until(lambda: len(got) == 8)
    ended.set()
    for driver in drivers:
        driver.join()
    assert sorted(word is True for word in got) == [False] * 7 + [True]
    assert all("expected to be its only writer" in word for word in got if word is not True)
    assert ".lock" not in objects_of(memory)


def test_a_lock_is_renewed_as_long_as_its_owner_lives(memory, impatient, monkeypatch):
    monkeypatch.setattr(object_store, "LEASE", 8.0)  # renewed after 2 s
    with place_of(OUT).own() as hold:
        hold.note("began 0 0 0")
        noted = memory["/bucket/out/.lock"].getvalue()
        until(lambda: memory["/bucket/out/.lock"].getvalue() != noted)
        assert running(OUT).owner == this_process()
        with pytest.raises(StoreError, match="expected to be its only writer"), place_of(OUT).own():
            pass
        hold.check()


def test_who_lost_the_lock_commits_nothing_more_and_leaves_the_other_be(
    scene, finished, content, memory, impatient, monkeypatch
):
    monkeypatch.setattr(object_store, "LEASE", 0.2)

    def taken_over():
        leave_lock(60.0, "process 77 on elsewhere")
        time.sleep(0.25)
        return memory["/bucket/out/.lock"].getvalue().startswith(b"process 77")  # or a renewal was under way

    def stopped_for_a_while(progress):
        if progress.n_shards_done == 2:
            until(taken_over)

    with pytest.raises(StoreError, match=r"lost the lock to process 77 on elsewhere.*rerun the scene when"):
        run_ensemble(scene, OUT, workers=0, on_progress=stopped_for_a_while)
    assert memory["/bucket/out/.lock"].getvalue().startswith(b"process 77")
    assert status(OUT).n_shards_done == 2
    leave_lock(-0.1)
    run_ensemble(scene, OUT, workers=0)
    assert objects_of(memory) == content(finished)


def test_a_store_that_overwrites_where_it_is_told_to_create_is_refused(scene, memory, monkeypatch):
    """As some S3 servers do, and s3fs before 2024.12."""
    system = type(fsspec.filesystem("memory"))
    put = system.pipe_file
    monkeypatch.setattr(system, "pipe_file", lambda self, path, value, mode="overwrite": put(self, path, value))
    with pytest.raises(StoreError, match=r"expected a store that refuses to create .* got one that overwrites"):
        run_ensemble(scene, OUT, workers=0)
    assert objects_of(memory) == {}


def test_a_store_is_not_blamed_for_who_took_over_between_its_two_puts(memory, monkeypatch):
    """The probe's object goes with the leftovers of a driver that was stopped for longer than its lease."""
    create = object_store.Prefix.create

    def stopped_meanwhile(self, name, content):
        create(self, name, content)
        if name != ".lock":
            self.remove(name)
            leave_lock(60.0, "process 77 on elsewhere")

    monkeypatch.setattr(object_store.Prefix, "create", stopped_meanwhile)
    with pytest.raises(StoreError, match="lost the lock to process 77"), place_of(OUT).own():
        pass


def test_a_lock_given_back_as_it_was_met_is_a_refusal(memory, impatient, monkeypatch):
    def met(self, name, content):
        raise FileExistsError(17, "At least one of the pre-conditions you specified did not hold", name)

    monkeypatch.setattr(object_store.Prefix, "create", met)
    with pytest.raises(StoreError, match="got a lock held by another process"), place_of(OUT).own():
        pass


# ------------------------------------------------------------------------------------------ requests that fail


class Fate(dict):
    """What becomes of puts: an error by the number of the put; `calls` are the keys that were put."""

    calls: list[str]


@pytest.fixture
def requests(monkeypatch):
    """What becomes of puts: `fate[k]`, an error, meets the k-th one, after it took effect if `late`."""
    system = type(fsspec.filesystem("memory"))
    put, fate, calls = system.pipe_file, Fate(), []
    fate.calls = calls

    def pipe_file(self, path, value, mode="overwrite", **kwargs):
        calls.append(path)
        error, is_late = fate.get(len(calls), fate.get("from now on", (None, False)))
        if error is None or is_late:
            put(self, path, value, mode=mode)
        if error is not None:
            raise error

    monkeypatch.setattr(system, "pipe_file", pipe_file)
    return fate


@pytest.mark.parametrize("is_late", [False, True])
def test_what_fails_in_passing_is_tried_again(is_late, scene, finished, content, memory, impatient, requests):
    requests |= {k: (OSError(5, "busy"), is_late) for k in range(1, 60, 2)}
    assert run_ensemble(scene, OUT, workers=0).is_complete
    assert objects_of(memory) == content(finished)


def test_what_goes_on_failing_is_one_clear_error_and_resumes(scene, finished, content, memory, impatient, requests):
    def lost(progress):
        if progress.n_shards_done == 3:
            requests["from now on"] = (TimeoutError("no answer"), False)

    with pytest.raises(StoreError, match=r"shard-00003-.* cannot be written \(no answer\).*rerun the scene"):
        run_ensemble(scene, OUT, workers=0, on_progress=lost)
    requests.clear()
    assert status(OUT).n_shards_done == 3
    run_ensemble(scene, OUT, workers=0)
    assert objects_of(memory) == content(finished)


@pytest.mark.parametrize("error", [PermissionError("Access Denied"), FileNotFoundError("no such bucket")])
def test_what_is_refused_is_not_asked_again(error, scene, memory, requests):
    requests["from now on"] = (error, False)
    with pytest.raises(StoreError, match=rf"memory://bucket/out/\.lock: cannot be written \({error}\)"):
        run_ensemble(scene, OUT, workers=0)
    assert requests.calls == ["/bucket/out/.lock"]


def test_what_cannot_be_opened_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(StoreError, match=r'package for s3://, got none; run: pip install "stickslip\[s3\]"'):
        status("s3://bucket/out")
    with pytest.raises(StoreError, match=r"got one that fsspec cannot open \(Protocol not known: nowhere\)"):
        status("nowhere://bucket/out")


def test_the_second_signal_takes_no_longer_than_it_may(scene, finished, stored, impatient, monkeypatch):
    monkeypatch.setattr("stickslip.pipeline.dataset.writer._LAST_SECONDS", 0.1)
    answered, listed = threading.Event(), []
    with Store(stored, scene) as store:
        monkeypatch.setattr(object_store.Prefix, "names", lambda self: listed.append(answered.wait(60)) or [])
        store._sweep()
        assert listed == []
        answered.set()
        until(lambda: listed)
        monkeypatch.undo()


def test_a_copy_of_a_directory_with_its_lock_is_no_obstacle(scene, finished, tmp_path, memory, impatient):
    out = shutil.copytree(finished, tmp_path / "out")
    (out / ".lock").write_text("process 1 on elsewhere\n")
    fsspec.filesystem("memory").put(f"{out}/", "/bucket/out/", recursive=True)
    assert run_ensemble(scene, OUT, workers=0).is_complete
