"""Records that are added to a finished dataset: the bytes of a run that had them from the start."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import pytest

from stickslip.pipeline import (
    SceneError,
    StoreError,
    extend,
    parse_scene,
    query,
    run_ensemble,
    status,
    verify,
)
from stickslip.pipeline.dataset.extending import Extending
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import tasks
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.records import RECORDS
from stickslip.pipeline.records.record import Record
from stickslip.pipeline.running import worker
from stickslip.pipeline.running.extend import addition
from stickslip.pipeline.running.kept import Kept
from stickslip.pipeline.scene.adding import with_records
from tests.scenes import COULOMB, SIGMOID, ensemble


def source(*lines: str, n: object = (4, 3), t_end: float = 20.0, matrices: int = 2, engines: tuple = ()) -> bytes:
    """A scene that keeps events, and what more lines under [record] say."""
    record = "\n".join(["[twins]\nsizes = [1e-3]\n\n[record]\nevents = true", *lines])
    engines = engines or (f"{COULOMB}\ntol = 1e-8", f'{SIGMOID}\nratio = "uniform"')
    return ensemble(list(n), t_end, matrices, *engines, seed=7, rest=record).encode()


def lines(keys: dict) -> list[str]:
    return [f"{key} = {str(value).lower()}" for key, value in keys.items()]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A finished dataset with events; not to be changed."""
    path = tmp_path_factory.mktemp("plain") / "out"
    run_ensemble(parse_scene(source()), path, workers=0)
    return path


@pytest.fixture
def out(plain, tmp_path):
    return shutil.copytree(plain, tmp_path / "out")


#: Each added to a dataset that has those before; "run": how many of its 16 members are run for it.
STEPS = (
    ({"waiting": True, "stick_share": True, "first_exit": True, "t_burn": 3.0, "growth_rate": True}, 0),
    ({"friction_power": True, "dt": 0.5}, 8),
    ({"separation": 2.0}, 12),
    ({"end": True, "episodes": True, "amplitude": True, "slip_speed": True}, 16),
    ({"attractor": True, "energy": True}, 0),
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
        # for each of the 12, the one that it is compared with
        assert len(ran) == n_run + ("separation" in keys) * 12
        assert content(out) == content(anew), keys
        assert verify(out) == []


def test_every_record_can_be_added():
    named = {key for keys, _ in STEPS for key in keys} | {"events"}
    assert {record.name for record in RECORDS if record.words} <= named


def test_a_record_that_reads_more_than_it_says_is_refused_and_nothing_is_changed(out, content, monkeypatch):
    before = content(out)

    class Samples(RECORDS[11]):
        def of(self, made):
            return {"first_exit": made.run.samples.t[0]}

    assert Samples.name == "first_exit"
    monkeypatch.setattr(RECORDS[11], "of", Samples.of)
    with pytest.raises(StoreError, match=r"record\.first_exit: expected a value for n3-m000-.*`needs`.*as it was"):
        extend(out, {"first_exit": True}, workers=0)
    assert query.members(out).equals(query.members(out))
    monkeypatch.undo()
    run_ensemble(parse_scene(source()), out, workers=0)
    assert {name: one for name, one in content(out).items() if name != "manifest.json"} == {
        name: one for name, one in before.items() if name != "manifest.json"
    }


def test_by_default_a_record_needs_the_run():
    assert Record.needs == {"run"}
    for record in RECORDS:
        known = {"run", "system", *(one.name for one in RECORDS)}
        assert record.needs <= known, record.name
