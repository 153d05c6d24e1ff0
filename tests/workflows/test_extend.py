"""`stickslip extend` as a person meets it: what it prints, what it leaves, its exit codes."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest

from stickslip import Dataset, draw_system, simulate
from stickslip.pipeline import load_scene, query, run_ensemble
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.machine.signals import Interrupted
from stickslip.pipeline.places.manifest import read_manifest
from stickslip.pipeline.running import estimate, extend
from stickslip.workflows.commands import main


@pytest.fixture
def out(dataset, tmp_path):
    """A copy of a finished dataset with events."""
    return shutil.copytree(dataset, tmp_path / "out")


def listing(path):
    return {str(file): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_it_says_what_it_adds_and_where_to_go_from_there(out, capsys):
    members = query.members(out)
    assert main(["extend", str(out), "--record", "waiting", "stick_share", "t_burn=5", "--workers", "1"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[:2] == [
        "columns stick_share, never_slipped, waiting_count, waiting_mean, waiting_cv, n_contacts",
        f"to run  nothing: computed from what is kept of {len(members)} members",
    ]
    assert said[3].startswith(f"scene   {out / 'scene.toml'} has the new keys")
    assert said[4] == f"report  as before; rewrite it with: stickslip report {out}"
    new = query.members(out)
    assert new[members.columns].equals(members)
    assert new.stick_share.between(0, 1).all()
    text = (out / "scene.toml").read_text()
    assert "[record]\nevents = true\nwaiting = true\nstick_share = true\nt_burn = 5\n" in text


def test_a_dry_run_says_what_runs_again_would_take_and_writes_nothing(out, monkeypatch, capsys):
    monkeypatch.setattr(estimate, "PILOT", 0.02)
    before = listing(out)
    assert main(["extend", str(out), "--record", "friction_power", "dt=0.5", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "columns friction_power\nto run  3 of 6 members, again\n" in said  # those of the exact law
    assert re.search(r"time    \d\d:\d\d \(\d\d:\d\d to \d\d:\d\d\) on 1 worker, not counting start", said)
    assert listing(out) == before


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["waitings"], 2, "record.waitings: unknown key of [record]; did you mean 'waiting'?"),
        (
            ["events", "waiting"],
            2,
            "record.events: expected a record that the data lack, got one that they have; leave it out",
        ),
        (
            ["waiting", "t_burn=soon"],
            2,
            "--record: expected a value as a scene has it, such as t_burn=50, got 't_burn=",
        ),
        (["waiting", "waiting"], 2, "--record: expected each key once, got waiting twice; leave one out"),
    ],
)
def test_what_cannot_be_added_is_refused_in_a_line(words, code, said, out, capsys):
    before = listing(out)
    assert main(["extend", str(out), "--record", *words]) == code
    assert said in capsys.readouterr().err
    assert listing(out) == before


def test_what_is_there_is_done_already(out, capsys):
    """Again after the end, or after a kill at the very end: the script that goes on is right to do so."""
    command = ["extend", str(out), "--record", "waiting", "stick_share", "t_burn=5", "--workers", "1"]
    assert main(command) == 0
    before = listing(out)
    capsys.readouterr()
    for more in ([], ["--dry-run"]):
        assert main([*command, *more]) == 0
        assert "to run  nothing: the dataset has these records\n" in capsys.readouterr().out
    assert main(["extend", str(out), "--record", "events", "--workers", "1"]) == 0
    assert main(["extend", str(out), "--give-up"]) == 0
    assert "nothing to give up" in capsys.readouterr().out
    assert listing(out) == before


def test_no_dataset_is_refused(tmp_path, capsys):
    assert main(["extend", str(tmp_path), "--record", "waiting"]) == 1
    assert "expected a dataset, found no manifest.json" in capsys.readouterr().err


def test_after_an_interruption_the_same_command_goes_on(out, monkeypatch, capsys):
    before = query.members(out)
    command = ["extend", str(out), "--record", "waiting", "--workers", "1"]
    with monkeypatch.context() as patch:

        def interrupted(*_):
            raise Interrupted(2)

        patch.setattr(extend, "fill", interrupted)
        assert main(command) == 130
    said = capsys.readouterr().err
    assert "interrupted; the dataset is as it was, and what is done is kept. Go on with:\n" in said
    assert f"\n  stickslip {' '.join(command[:4])}\n" in said
    assert query.members(out).equals(before)
    assert main(["status", str(out)]) == 0
    assert (
        "extend  waiting, 0 of 1 shards: rerun `stickslip extend` with the same keys to go on"
        in capsys.readouterr().out
    )
    left = listing(out)
    assert main(["extend", str(out), "--record", "first_exit", "--dry-run"]) == 1
    assert f"give it up with `stickslip extend {out} --give-up`" in capsys.readouterr().err
    assert listing(out) == left
    assert main(["extend", str(out), "--give-up"]) == 0
    assert "given up; " in capsys.readouterr().out
    assert main(command) == 0
    assert "waiting_mean" in query.members(out)
    assert read_manifest(out).extension is None


def test_from_python(out):
    found = Dataset(out).extend({"first_exit": True}, workers=0, quiet=True)
    assert found.members.first_exit.notna().all()


def test_members_that_failed_are_in_nobodys_way(small_scene, tmp_path, monkeypatch, capsys):
    task = Member.task

    def fragile(member, *rest):
        if member.engine == "coulomb":
            raise ZeroDivisionError
        return task(member, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Member, "task", fragile)
        run_ensemble(load_scene(small_scene), tmp_path / "out", workers=0)
    found = Dataset(tmp_path / "out").extend({"end": True}, workers=0)
    assert found.status.n_failed == 3
    assert "6/6 members, 1/1 shards, 3 failed" in capsys.readouterr().err


def test_a_run_that_goes_on_is_not_one_in_one_piece(rng):
    """Why longer runs are not added: both are right within the tolerance, and no more the same than that."""
    is_same = []
    for _ in range(3):
        system = draw_system("antisymmetric", 60, int(rng.integers(2**31)))
        whole, first = (simulate(system, -0.7, -0.4, t_end, tol=1e-10) for t_end in (40.0, 20.0))
        on = simulate(system, first.z, first.w, 40.0, t_start=20.0, tol=1e-10, modes=first.events.mode_at(20.0))
        np.testing.assert_allclose(on.z, whole.z, rtol=0, atol=1e-8)
        is_same.append(on.z.tobytes() == whole.z.tobytes())
    assert not all(is_same)
