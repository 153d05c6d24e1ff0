"""Records that are added to a finished dataset: the bytes of a run that had them from the start."""

from __future__ import annotations

import os
import pickle
import re
import shutil

import pytest

from stickslip.pipeline import (
    SceneError,
    StoreError,
    extend,
    load_scene,
    parse_scene,
    query,
    run_ensemble,
    status,
    verify,
)
from stickslip.pipeline.dataset.extending import Extending, give_up
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.places.directory import Directory
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.record import Record
from stickslip.pipeline.records.slips.first_exit import FirstExit
from stickslip.pipeline.running import worker
from stickslip.pipeline.running.extend import addition
from stickslip.pipeline.running.isolation import compute_alone
from stickslip.pipeline.running.kept import Kept
from stickslip.pipeline.scene.adding import with_records
from stickslip.pipeline.scene.columns import DESIGN
from tests.scenes import COULOMB, SIGMOID, ensemble


def source(*lines: str, n: object = (3,), t_end: float = 15.0, matrices: int = 2, engines: tuple = ()) -> bytes:
    """A scene that keeps events, and what more lines under [record] say."""
    record = "\n".join(["[twins]\nsizes = [1e-3]\n\n[record]\nevents = true", *lines])
    engines = engines or (f"{COULOMB}\ntol = 1e-8", f'{SIGMOID}\nratio = "uniform"')
    return ensemble(list(n), t_end, matrices, *engines, seed=7, rest=record).encode()


def lines(keys: dict) -> list[str]:
    return [f"{key} = {str(value).lower()}" for key, value in keys.items()]


KEYS = {"waiting": True}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A finished dataset with events; not to be changed."""
    path = tmp_path_factory.mktemp("plain") / "out"
    run_ensemble(parse_scene(source()), path, workers=0)
    return path


@pytest.fixture
def out(plain, tmp_path):
    return shutil.copytree(plain, tmp_path / "out")


#: Each added to a dataset that has those before; "run": how many of its 8 members are run for it.
STEPS = (
    ({"waiting": True, "stick_share": True, "first_exit": True, "t_burn": 3.0, "growth_rate": True}, 0),
    ({"friction_power": True, "dt": 0.5}, 4),
    ({"separation": 2.0}, 6),
    ({"end": True, "episodes": True, "amplitude": True, "slip_speed": True}, 8),
    ({"attractor": True, "energy": True, "constants": True}, 0),
)


def test_an_extended_dataset_has_the_bytes_of_one_that_had_all_from_the_start(out, tmp_path, content, monkeypatch):
    there: dict = {}
    task, ran = Member.task, []
    monkeypatch.setattr(Member, "task", lambda member, *rest: ran.append(member.member_id) or task(member, *rest))
    for keys, n_run in STEPS:
        there |= keys
        anew = tmp_path / f"anew{len(there)}"
        run_ensemble(parse_scene(source(*lines(there))), anew, workers=0)
        worker._states.cache_clear()
        assert addition(out, keys).n_again == n_run
        ran.clear()
        assert extend(out, keys, workers=0).is_complete
        # for each of the 6, the one that it is compared with
        assert len(ran) == n_run + ("separation" in keys) * 6
        assert content(out) == content(anew), keys
        assert verify(out) == []


def test_every_record_can_be_added():
    named = {key for keys, _ in STEPS for key in keys} | {"events"}
    others = {"own"} | {record.name for record in RECORDS if record.is_certified}  # they have tests of their own
    assert {record.name for record in RECORDS if record.words} - others <= named
    known = {"run", "system", *(record.name for record in RECORDS)}
    assert all(record.needs <= known for record in RECORDS)
    assert Record.needs == {"run"}


def test_a_record_that_changes_outcomes_is_no_extension(out):
    with pytest.raises(SceneError, match=r"record\.collapse: .* changes no other column"):
        extend(out, {"collapse": True}, workers=0)


def test_runs_whose_collapse_is_certified_are_made_again_as_they_were(tmp_path):
    engine = f"{COULOMB}\ntol = 1e-8"
    before, after = (ensemble([20], 150.0, 1, engine, rest=f"[record]\ncollapse = true{more}").encode()
                     for more in ("", "\nevents = true"))  # fmt: skip
    run_ensemble(parse_scene(before), tmp_path / "out", workers=0)
    run_ensemble(parse_scene(after), tmp_path / "anew", workers=0)
    assert query.members(tmp_path / "out")["outcome"].tolist() == ["collapsed"]
    extend(tmp_path / "out", {"events": True}, workers=0)
    assert query.members(tmp_path / "out").equals(query.members(tmp_path / "anew"))
    assert verify(tmp_path / "out") == []


OWN = """from typing import Annotated, NamedTuple

class Measured(NamedTuple):
    n_late: Annotated[int, "events after t_burn"]
    reach: Annotated[float, "largest |z| at the end"]

def measured(run, system, window) -> Measured:
    return Measured(int((run.events.t >= window[0]).sum()), float(abs(run.z).max()))
"""


@pytest.mark.parametrize("has_end", [True, False])
def test_a_function_of_ones_own_is_added_from_what_is_kept_or_by_running_again(has_end, tmp_path, content):
    (tmp_path / "mine.py").write_text(OWN)
    had = ["end = true"] if has_end else []
    for name, lines in (("part", had), ("whole", [*had, "t_burn = 3.0", 'own = ["mine:measured"]'])):
        (tmp_path / f"{name}.toml").write_bytes(source(*lines))
        run_ensemble(load_scene(tmp_path / f"{name}.toml"), tmp_path / name, workers=0)
    keys = {"own": ["mine:measured"], "t_burn": 3.0}
    assert addition(tmp_path / "part", keys).n_again == (0 if has_end else 8)
    extend(tmp_path / "part", keys, workers=0)
    part, whole = (content(tmp_path / name) for name in ("part", "whole"))
    assert [part[name] == whole[name] for name in whole if name.startswith("data")] == [True] * len(
        whole.keys() - OTHERS
    )
    assert parse_scene(part["scene.toml"]).hash == parse_scene(whole["scene.toml"]).hash
    assert verify(tmp_path / "part") == []


OTHERS = {"manifest.json", "scene.toml"}


def test_what_is_there_is_not_added_again_unless_its_function_has_changed(tmp_path, content):
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "part.toml").write_bytes(source())
    out = tmp_path / "part"
    run_ensemble(load_scene(tmp_path / "part.toml"), out, workers=0)
    for keys in ({"own": ["mine:measured"], "t_burn": 3.0, "end": True}, {"end": True}, {"own": "mine:measured"}):
        assert extend(out, keys, workers=0).is_complete
        before = content(out)
        assert extend(out, keys, workers=0).is_complete
        assert content(out) == before
    (tmp_path / "mine.py").write_text(OWN.replace("max", "min"))
    with pytest.raises(SceneError, match=r"record\.own: expected a record that the data lack"):
        extend(out, {"own": ["mine:measured"]}, workers=0)
    assert content(out) == before


def test_a_grown_dataset_is_extended_and_an_extended_one_grows(tmp_path, content):
    """Members of one shard come from several then; and members that are added have the new columns."""
    path, anew, grown = (tmp_path / name for name in ("path", "anew", "grown"))
    for matrices in (2, 3):
        run_ensemble(parse_scene(source(n=(3, 2), matrices=matrices, t_end=4.0)), path, workers=0)
    assert extend(path, KEYS, workers=0).n_members == 24
    run_ensemble(parse_scene(source("waiting = true", n=(3, 2), matrices=3, t_end=4.0)), anew, workers=0)
    assert content(path) == content(anew)
    more = parse_scene(source("waiting = true", n=(3, 2), matrices=4, t_end=4.0))
    run_ensemble(more, path, workers=0)
    run_ensemble(more, grown, workers=0)
    one, other = (query.members(each).sort_values("member_id", ignore_index=True) for each in (path, grown))
    one, other = (table.drop(columns=[column.name for column in DESIGN]) for table in (one, other))
    assert one.equals(other)
    assert verify(path) == []


def test_workers_get_the_rows_and_give_the_same_bytes(out):
    opened = open_dataset(out)
    scene = with_records(opened.scene, {"waiting": True, "end": True})
    with Extending(opened, scene) as store:
        for batch, recording in store.todo[:1]:
            order = (batch, recording, Kept(store.rows(batch), opened.scene.records))
            here, there, alone = (
                worker.compute(*order),
                worker.compute_packed(pickle.dumps(order)),
                compute_alone(*order),
            )
            assert here.shard == there.shard == alone.shard
    assert verify(out) == []
    assert status(out).extension.n_shards_done == 0


def test_members_that_failed_stay_so_and_are_not_run(tmp_path, monkeypatch):
    task = Member.task

    def fragile(member, *rest):
        if member.n == 3 and member.engine == "coulomb":
            raise ZeroDivisionError
        return task(member, *rest)

    monkeypatch.setattr(Member, "task", fragile)
    run_ensemble(parse_scene(source()), tmp_path / "out", workers=0)
    run_ensemble(parse_scene(source("waiting = true", "end = true")), tmp_path / "anew", workers=0)
    monkeypatch.undo()
    assert extend(tmp_path / "out", {"waiting": True, "end": True}, workers=0).n_failed == 4
    one, other = (query.table(tmp_path / name) for name in ("out", "anew"))
    assert one.equals(other)


# ------------------------------------------------------------------------------------------ crashes


def left_by_kills(path, act, monkeypatch):
    """What lies at `path` before and after each call of the system that may change it: what a kill there leaves."""
    seen: dict = {}

    def look():
        files = {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
        seen.setdefault(tuple(files.items()), files)

    def watched(function):
        def call(*arguments, **options):
            look()
            try:
                return function(*arguments, **options)
            finally:
                look()

        return call

    with monkeypatch.context() as patch:
        for name in ("fsync", "replace", "write", "unlink", "truncate"):
            patch.setattr(os, name, watched(getattr(os, name)))
        act()
    return list(seen.values())


def put(files, path):
    for name, text in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(text)
    return path


def test_a_kill_at_any_moment_leaves_the_old_dataset_or_the_new_and_can_be_gone_on_from(
    out, tmp_path, content, rng, monkeypatch
):
    old = query.members(out)
    found = left_by_kills(out, lambda: extend(out, KEYS, workers=0), monkeypatch)
    new, end = query.members(out), content(out)
    seen = []
    for k, files in enumerate(found):
        left = put(files, tmp_path / str(k))
        there = query.members(left)
        assert there.equals(old) or there.equals(new)
        assert status(left).is_complete
        seen.append("waiting_mean" in there)
    first = seen.index(True)
    assert seen == [False] * first + [True] * (len(seen) - first)
    assert first > 2 * len(end)
    ending = [k for k in range(first, len(found)) if read_manifest(tmp_path / str(k)).scene is not None]
    assert len(ending) > 3
    for k in {0, *rng.choice(first, 6, replace=False).tolist(), first - 1, *ending, len(found) - 1}:
        assert extend(tmp_path / str(k), KEYS, workers=0).is_complete
        assert content(tmp_path / str(k)) == end, k
        assert verify(tmp_path / str(k)) == []


def begun(out):
    """Begin an extension that ends after its third commit."""

    class Killed(BaseException):
        pass

    def progress(one):
        if one.n_shards_done == 3:
            raise Killed

    with pytest.raises(Killed):
        extend(out, KEYS, workers=0, on_progress=progress)


def test_what_was_begun_is_gone_on_with_and_lost_only_by_giving_it_up(out, tmp_path, content):
    before = query.table(out)
    begun(out)
    found = status(out).extension
    assert (found.records, found.n_shards_done) == (("waiting",), 3)
    assert query.table(out).equals(before)
    assert verify(out) == []
    assert run_ensemble(parse_scene(source()), out, workers=0).extension == found  # there is nothing to do
    damaged, grown, other = (shutil.copytree(out, tmp_path / name) for name in ("damaged", "grown", "other"))
    seen: list = []
    assert extend(out, KEYS, workers=0, on_progress=seen.append).is_complete
    assert (seen[0].n_shards_done, seen[0].n_shards) == (3, found.n_shards)
    assert status(out).extension is None
    (damaged / "data" / next(iter(read_manifest(damaged).shards))).write_bytes(b"")
    for path, go_on in (
        (damaged, lambda path: run_ensemble(parse_scene(source()), path, workers=0)),
        (grown, lambda path: run_ensemble(parse_scene(source(matrices=3)), path, workers=0)),
        (other, lambda path: extend(path, {"first_exit": True}, workers=0)),
    ):
        left = content(path)
        words = re.escape(f"by waiting, of which 3 of {found.n_shards} shards are done; finish it with `stickslip")
        with pytest.raises(StoreError, match=rf"{words} extend \S+ --record waiting`, or .* --give-up`"):
            go_on(path)
        assert content(path) == left
        give_up(open_dataset(path))
        assert status(path).extension is None
        with pytest.raises(StoreError, match="got none; there is nothing to give up"):
            give_up(open_dataset(path))
        assert go_on(path).is_complete
        assert verify(path) == []


def test_in_an_object_store_it_is_the_same(out):
    place = place_of("memory://bucket/extended")
    for name in content_of(Directory(out)):
        place.replace(name, (out / name).read_bytes())
    for path in (place, out):
        assert extend(path, KEYS, workers=0).is_complete
        assert verify(path) == []
    assert content_of(place) == content_of(Directory(out))


def content_of(place):
    names = [name for name in place.names() if "." in name and not name.startswith("timings")]
    return {name: place.read(name) for name in names}


# ------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"waitings": True}, r"record\.waitings: unknown key of \[record\].*did you mean 'waiting'"),
        (
            {"events": True, "waiting": True},
            r"record\.events: expected a record that the data lack, got one that they have; leave",
        ),
        ({"waiting": True, "dt": 0.1}, r"record\.dt: expected only with some of"),
        ({"amplitude": True}, r"record\.dt: expected with `amplitude`, found nothing"),
        ({"waiting": False}, r"record: expected a record that the data lack, got none; name one"),
        ({"events": False, "waiting": True}, r"record\.events: expected records that the data lack, .* leave it out"),
        ({"seed": [0, 1]}, r"record\.seed: expected a key under \[record\], got one under \[run\]; change it in"),
        ({"waiting": True, "t_burn": 90.0}, r"record\.t_burn: expected less than run\.t_end"),
    ],
)
def test_keys_that_cannot_be_added_are_refused_and_nothing_is_written(keys, words, plain, content):
    before = content(plain)
    with pytest.raises(SceneError, match=words):
        extend(plain, keys, workers=0)
    assert content(plain) == before


def test_a_record_of_the_exact_law_needs_an_engine_of_it(tmp_path):
    run_ensemble(parse_scene(source(engines=(SIGMOID,), n=(3,), t_end=2.0)), tmp_path, workers=0)
    with pytest.raises(SceneError, match=r"record\.energy: expected an engine of the exact law, got 'sigmoid' alone"):
        extend(tmp_path, {"energy": True}, workers=0)


def test_what_is_kept_is_not_measured_from_another_time(out):
    extend(out, {"stick_share": True}, workers=0)
    with pytest.raises(SceneError, match=r"stick_share: expected what the data have, t_burn = 1\.0, got .* = 3\.0"):
        extend(out, {"waiting": True, "t_burn": 3.0}, workers=0)


def test_data_that_are_not_whole_are_refused(out, content):
    shard = sorted((out / "data").iterdir())[0]
    text = bytearray(shard.read_bytes())
    text[len(text) // 2] ^= 1
    shard.write_bytes(text)
    before = content(out)
    with pytest.raises(StoreError, match=rf"{shard.name}: expected sha256 .*; rerun the scene to rebuild it"):
        extend(out, KEYS, workers=0)
    assert content(out) == before
    manifest = read_manifest(out)
    del manifest.shards[shard.name]
    (out / "manifest.json").write_bytes(manifest.to_bytes())
    with pytest.raises(StoreError, match=r"expected a finished dataset, got \d of \d shards; rerun its scene first"):
        extend(out, KEYS, workers=0)


def test_another_version_of_the_program_is_refused_unless_told(out, monkeypatch):
    for room in ("dataset.writer", "running.worker", "running.driver"):
        monkeypatch.setattr(f"stickslip.pipeline.{room}.program", lambda: "9.9.9-0123")
    with pytest.raises(StoreError, match=r"this version of the program \(9\.9\.9-0123\), got.*--accept-version"):
        extend(out, KEYS, workers=0)
    assert extend(out, KEYS, workers=0, accept_version=True).is_complete
    assert read_manifest(out).programs[-1] == "9.9.9-0123"


def test_a_run_that_is_not_the_one_that_was_kept_is_refused(out, monkeypatch):
    before, start = query.table(out), Member.start

    def beside(member, *rest):
        z, w = start(member, *rest)
        return z + 1e-9, w

    monkeypatch.setattr(Member, "start", beside)
    words = r"n3-m000-\S+: expected the run that is kept, got another \(\w+\); the dataset is as it was: extend it on"
    with pytest.raises(StoreError, match=words):
        extend(out, {"end": True}, workers=0)
    assert query.table(out).equals(before)


def test_a_record_that_reads_more_than_it_says_is_refused(out, monkeypatch):
    monkeypatch.setattr(FirstExit, "of", lambda record, made: {"first_exit": made.run.samples.t[0]})
    with pytest.raises(StoreError, match=r"record\.first_exit: expected a value for n3-m000-.*`needs`.*as it was"):
        extend(out, {"first_exit": True}, workers=0)
    assert "first_exit" not in query.members(out)


# ------------------------------------------------------------------------------------------ scenes


def test_tolerances_stay_what_they_were_picked_for(tmp_path):
    """Attractors are of paths, for which a scene that does not say more has finer tolerances."""
    text = ensemble(3, 5.0, 1, COULOMB)
    run_ensemble(parse_scene(text.encode()), tmp_path, workers=0)
    before = query.members(tmp_path)
    extend(tmp_path, {"attractor": True}, workers=0)
    assert open_dataset(tmp_path).scene.run.purpose == "statistics"
    assert query.members(tmp_path)[before.columns].equals(before)
    assert parse_scene(f"{text}[record]\nattractor = true\n".encode()).purpose == "paths"


@pytest.mark.parametrize(
    "text",
    [
        "[record]\nevents = true\n",
        "[record]  # what to keep\nevents = true  # all\n\n# the end\n",
        "record = {events = true}\n",
        "record.events = true\n",
        "[record]\nevents = true\nwaiting = false\n[perturbation]\nsizes = 0.1\n",
        "[perturbation]\nsizes = 0.1\n",
    ],
)
def test_a_scene_keeps_its_words_where_it_can(text):
    lines = ensemble(3, 5.0, 1, COULOMB)
    scene = parse_scene((text + lines if text.startswith("record") else lines + text).encode())
    found = with_records(scene, {"waiting": True, "t_burn": 2.5})
    assert found.record.waiting
    assert found.record.t_burn == 2.5
    assert scene.engines == found.engines
    assert set(scene.records) < set(found.records)
    assert ("# what to keep" in text) <= ("# what to keep" in found.source)


def test_a_scene_that_asks_for_more_is_told_how_to_get_it(out):
    for matrices in (2, 3):
        scene = parse_scene(source("waiting = true", "t_burn = 2.0", matrices=matrices))
        words = (
            rf"waiting_cv, n_contacts, which these data lack; add these with `stickslip extend {out} --record waiting"
            " t_burn=2"
        )
        with pytest.raises(StoreError, match=words):
            run_ensemble(scene, out, workers=0)


def test_longer_runs_are_refused_with_what_to_do(out):
    words = r"one in one piece, so these are not lengthened: another scene can start at their ends"
    with pytest.raises(
        StoreError, match=rf"{words}, with `dataset` under \[start\], once `.* --record end` has kept"
    ):
        run_ensemble(parse_scene(source(t_end=40.0)), out, workers=0)
    extend(out, {"end": True}, workers=0)
    with pytest.raises(StoreError, match=rf"{words}, with `dataset` under \[start\]$"):
        run_ensemble(parse_scene(source("end = true", t_end=40.0)), out, workers=0)
