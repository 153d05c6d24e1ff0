"""A dataset with more records than another: the bytes of a run that had them from the start, and few runs."""

from __future__ import annotations

import pickle

import pytest

from stickslip.pipeline import SceneError, StoreError, extend, load_scene, parse_scene, query, run_ensemble, verify
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.record import Record
from stickslip.pipeline.records.slips.first_exit import FirstExit
from stickslip.pipeline.running import worker
from stickslip.pipeline.running.extend import with_records
from stickslip.pipeline.running.taken_over import KeptRows
from stickslip.pipeline.running.worker import compute_alone
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
def ran(monkeypatch):
    """The members that are run, by name."""
    task, names = Member.task, []
    monkeypatch.setattr(Member, "task", lambda member, *rest: names.append(member.member_id) or task(member, *rest))
    return names


def data(content: dict) -> dict:
    """The shards and the manifest: where a scene is written anew, its file has other words."""
    return {name: text for name, text in content.items() if name != "scene.toml"}


#: Each added to a dataset that has those before, and how many runs that takes: of its 8 members, and for `separation`
#: of the ones that 6 of them are compared with.
STEPS = (
    ({"waiting": True, "stick_share": True, "first_exit": True, "t_burn": 3.0, "growth_rate": True}, 0),
    ({"friction_power": True, "dt": 0.5}, 4),
    ({"separation": 2.0}, 12),
    ({"end": True, "episodes": True, "clusters": True, "amplitude": True, "slip_speed": True}, 14),
    ({"attractor": True, "critical_mode": True, "energy": True, "constants": True, "structure": True}, 0),
)


def test_an_extended_dataset_has_the_bytes_of_one_that_had_all_from_the_start(plain, tmp_path, content, ran):
    there: dict = {}
    before = plain
    for step, (keys, n_run) in enumerate(STEPS):
        there |= keys
        anew, out = tmp_path / f"anew{step}", tmp_path / f"out{step}"
        run_ensemble(parse_scene(source(*lines(there))), anew, workers=0)
        worker._states.cache_clear()
        ran.clear()
        assert extend(before, keys, out, workers=0).is_complete
        assert len(ran) == n_run
        assert data(content(out)) == data(content(anew)), keys
        assert verify(out) == []
        before = out


def test_every_record_can_be_added():
    named = {key for keys, _ in STEPS for key in keys} | {"events"}
    tested_apart = {"own", "refine"} | {record.name for record in RECORDS if record.is_certified}
    assert {record.name for record in RECORDS if record.words} - tested_apart <= named
    known = {"run", "system", *(record.name for record in RECORDS)}
    assert all(record.needs <= known for record in RECORDS)
    assert Record.needs == {"run"}


def test_runs_of_which_more_are_tested_for_collapse_are_made_again(tmp_path, content, ran):
    texts = [ensemble([20], 150.0, 1, f"{COULOMB}\ntol = 1e-8", rest=f"[record]\nevents = true\n{more}").encode()
             for more in ("", "collapse = true\n", "collapse = true\nend = true\n")]  # fmt: skip
    for name, text in zip("abc", texts, strict=True):
        run_ensemble(parse_scene(text), tmp_path / name, workers=0)
    ran.clear()
    extend(tmp_path / "a", {"collapse": True}, tmp_path / "b2", workers=0)
    extend(tmp_path / "b", {"end": True}, tmp_path / "c2", workers=0)
    assert len(ran) == 2
    for name in "bc":
        assert data(content(tmp_path / f"{name}2")) == data(content(tmp_path / name))


OWN = """from typing import Annotated, NamedTuple
from stickslip.sim.episodes import episodes

class Measured(NamedTuple):
    n_late: Annotated[int, "events after t_burn"]
    reach: Annotated[float, "largest |z| at the end"]

def measured(run, system, window) -> Measured:
    return Measured(int((run.events.t >= window[0]).sum()), float(abs(run.z).max()))

class Counted(NamedTuple):
    n_episodes: Annotated[int, "episodes of all blocks"]

def counted(run, system, window) -> Counted:
    return Counted(len(episodes(run, system.belt_speed)))
"""


@pytest.mark.parametrize(
    ("function", "had", "n_run"), [("measured", "end", 0), ("measured", "events", 8), ("counted", "end", 8)]
)
def test_a_function_of_ones_own_reads_what_is_kept_or_a_run(function, had, n_run, tmp_path, content, ran):
    """`episodes` reads more of a run than any row holds."""
    (tmp_path / "mine.py").write_text(OWN)
    record = ["end = true"] * (had == "end")
    for name, more in (("part", []), ("whole", ["t_burn = 3.0", f'own = ["mine:{function}"]'])):
        (tmp_path / f"{name}.toml").write_bytes(source(*record, *more))
        run_ensemble(load_scene(tmp_path / f"{name}.toml"), tmp_path / name, workers=0)
    ran.clear()
    extend(tmp_path / "part", {"own": [f"mine:{function}"], "t_burn": 3.0}, tmp_path / "out", workers=0)
    assert len(ran) == n_run
    assert data(content(tmp_path / "out")) == data(content(tmp_path / "whole"))


def test_what_has_changed_is_computed_anew(tmp_path, content):
    """Another time, another function; and what is left out goes."""
    (tmp_path / "mine.py").write_text(OWN)
    before, after = ([f"t_burn = {t_burn}", "end = true", 'own = "mine:measured"'] for t_burn in (3.0, 5.0))
    (tmp_path / "a.toml").write_bytes(source("stick_share = true", *before))
    (tmp_path / "b.toml").write_bytes(source(*after))
    run_ensemble(load_scene(tmp_path / "a.toml"), tmp_path / "a", workers=0)
    (tmp_path / "mine.py").write_text(OWN.replace("max", "min"))
    run_ensemble(load_scene(tmp_path / "b.toml"), tmp_path / "b", workers=0)
    run_ensemble(load_scene(tmp_path / "b.toml"), tmp_path / "out", workers=0, kept=tmp_path / "a")
    assert content(tmp_path / "out") == content(tmp_path / "b")


def test_members_and_records_are_added_together_and_what_is_not_the_same_is_run(tmp_path, content, ran):
    """Rows come from several shards of a dataset that has grown; a coarser run is another member."""
    part = tmp_path / "part"
    for matrices in (1, 2):
        run_ensemble(parse_scene(source(n=(3, 2), matrices=matrices, t_end=4.0)), part, workers=0)
    for k, (engines, n_run) in enumerate(
        [((), 8), ((f"{COULOMB}\ntol = 1e-9", f'{SIGMOID}\nratio = "uniform"'), 16)]
    ):
        scene = parse_scene(source("waiting = true", n=(3, 2), matrices=3, t_end=4.0, engines=engines))
        run_ensemble(scene, tmp_path / f"whole{k}", workers=0)
        ran.clear()
        run_ensemble(scene, tmp_path / f"out{k}", workers=0, kept=part)
        assert len(ran) == n_run
        assert content(tmp_path / f"out{k}") == content(tmp_path / f"whole{k}")


def test_workers_get_the_rows_and_give_the_same_bytes(plain, tmp_path):
    opened = open_dataset(plain)
    rows = KeptRows(opened)
    for batch in Store(tmp_path / "out", with_records(opened, {"waiting": True, "end": True})).look()[1][:1]:
        order = (batch, rows.of(batch))
        here, there, alone = (
            worker.compute(*order),
            worker.compute_there(pickle.loads(pickle.dumps(order))),
            compute_alone(order),
        )
        assert here.shard == there.shard == alone.shard


def test_members_that_failed_are_run_again(tmp_path, fragile, content):
    with fragile(ZeroDivisionError(), lambda member: member.engine == "coulomb"):
        assert run_ensemble(parse_scene(source()), tmp_path / "part", workers=0).n_failed == 4
    opened = open_dataset(tmp_path / "part")
    rows, tasks = KeptRows(opened), Store(tmp_path / "out", with_records(opened, KEYS)).look()[1]
    assert sum(len(rows.left(batch)) for batch in tasks) == 4
    run_ensemble(parse_scene(source("waiting = true")), tmp_path / "whole", workers=0)
    assert extend(tmp_path / "part", KEYS, tmp_path / "out", workers=0).n_failed == 0
    assert data(content(tmp_path / "out")) == data(content(tmp_path / "whole"))


def test_the_dataset_stays_as_it_is_and_what_broke_off_goes_on(plain, tmp_path, content):
    class Killed(BaseException):
        pass

    def progress(state):
        if state.n_shards_done == 3:
            raise Killed

    before = content(plain)
    with pytest.raises(Killed):
        extend(plain, KEYS, tmp_path / "out", workers=0, on_progress=progress)
    seen: list = []
    assert extend(plain, KEYS, tmp_path / "out", workers=0, on_progress=seen.append).is_complete
    assert seen[0].n_shards_done == 3
    end = content(tmp_path / "out")
    assert extend(plain, KEYS, tmp_path / "out", workers=0).is_complete
    assert content(tmp_path / "out") == end
    assert content(plain) == before


def test_from_an_object_store_into_a_directory_and_back(plain, tmp_path):
    place = place_of("memory://bucket/extended")
    for file in filter(lambda file: file.is_file(), plain.rglob("*")):
        place.replace(str(file.relative_to(plain)), file.read_bytes())
    extend(place, KEYS, tmp_path / "out", workers=0)
    extend(plain, KEYS, "memory://bucket/other", workers=0)
    one, other = (query.table(path) for path in (tmp_path / "out", "memory://bucket/other"))
    assert one.equals(other)
    assert verify("memory://bucket/other") == []


# ------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(("keys", "words"), [
    ({"waitings": True}, r"record\.waitings: unknown key of \[record\].*did you mean 'waiting'"),
    ({"waiting": True, "dt": 0.1}, r"record\.dt: expected only with some of"),
    ({"amplitude": True}, r"record\.dt: expected with `amplitude`, found nothing"),
    ({"events": True}, r"record: expected a record that the data lack, got events, which they have; name"),
    ({"waiting": True, "t_burn": 90.0}, r"record\.t_burn: expected less than run\.t_end"),
])  # fmt: skip
def test_keys_that_cannot_be_added_are_refused_and_nothing_is_written(keys, words, plain, tmp_path):
    with pytest.raises(SceneError, match=words):
        extend(plain, keys, tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()


def test_a_damaged_dataset_is_refused_and_one_is_not_extended_in_place(plain, tmp_path, content):
    out = tmp_path / "out"
    scene = parse_scene(source("waiting = true"))
    before = content(plain)
    with pytest.raises(
        StoreError, match=r"n_contacts, which these data lack; choose another directory than that of other data"
    ):
        run_ensemble(scene, plain, workers=0, kept=plain)
    assert content(plain) == before
    extend(plain, KEYS, out, workers=0)
    shard = sorted((out / "data").iterdir())[0]
    text = bytearray(shard.read_bytes())
    text[len(text) // 2] ^= 1
    shard.write_bytes(text)
    with pytest.raises(StoreError, match=rf"{shard.name}: expected sha256 .*; rerun the scene to rebuild it"):
        extend(out, {"end": True}, tmp_path / "more", workers=0)
    assert not (tmp_path / "more").exists()


def test_another_version_of_the_program_is_refused_unless_told(plain, tmp_path, monkeypatch):
    for room in ("dataset.writer", "running.worker"):
        monkeypatch.setattr(f"stickslip.pipeline.{room}.program", lambda: "9.9.9-0123")
    with pytest.raises(StoreError, match=r"this version of the program \(9\.9\.9-0123\), got.*--accept-version"):
        extend(plain, KEYS, tmp_path / "out", workers=0)
    assert extend(plain, KEYS, tmp_path / "out", workers=0, accept_version=True).is_complete
    assert read_manifest(tmp_path / "out").programs == [*read_manifest(plain).programs, "9.9.9-0123"]


def test_a_record_that_reads_more_than_it_says_is_of_a_run(plain, tmp_path, monkeypatch, ran):
    monkeypatch.setattr(FirstExit, "of", lambda record, made: {"first_exit": float(made.run.samples.t.sum())})
    extend(plain, {"first_exit": True}, tmp_path / "out", workers=0)
    assert len(ran) == 8


def test_tolerances_stay_what_they_were_picked_for(tmp_path):
    """Attractors are of paths, for which a scene that does not say more has finer tolerances."""
    text = ensemble(3, 5.0, 1, COULOMB)
    run_ensemble(parse_scene(text.encode()), tmp_path / "a", workers=0)
    before = query.members(tmp_path / "a")
    extend(tmp_path / "a", {"attractor": True}, tmp_path / "b", workers=0)
    assert open_dataset(tmp_path / "b").scene.run.purpose == "statistics"
    assert query.members(tmp_path / "b")[before.columns].equals(before)
    assert parse_scene(f"{text}[record]\nattractor = true\n".encode()).purpose == "paths"


def test_longer_runs_are_refused_with_what_to_do(plain):
    with pytest.raises(StoreError, match=r"so these are not lengthened: another scene can start at their ends"):
        run_ensemble(parse_scene(source(t_end=40.0)), plain, workers=0)
