"""`stickslip extend` as a person meets it: what it prints, what it leaves, its exit codes."""

from __future__ import annotations

import re

import numpy as np
import pytest

from stickslip import draw_system, simulate
from stickslip.pipeline import query
from stickslip.pipeline.machine.signals import Interrupted
from stickslip.pipeline.running import driver, estimate
from stickslip.workflows.commands import main


def listing(path):
    return {str(file): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_it_makes_a_dataset_with_its_report_and_goes_on_after_an_interruption(dataset, tmp_path, monkeypatch, capsys):
    out, before = str(tmp_path / "out"), query.members(dataset)
    words = ["extend", str(dataset), "--record", "waiting", "stick_share", "t_burn=5", "--out", out, "--workers", "1"]
    with monkeypatch.context() as patch:

        def interrupted(*_):
            raise Interrupted(2)

        patch.setattr(driver, "_Filling", interrupted)
        assert main(words) == 130
    again = f"interrupted; finished work is kept. Resume with:\n  stickslip {' '.join(words)}\n"
    assert again in capsys.readouterr().err
    for _ in range(2):  # the script that goes on is right to do so
        assert main(words) == 0
    assert f"report  {out}/report.html, unchanged\n" in capsys.readouterr().out
    new = query.members(out)
    assert new[before.columns].equals(before)
    assert new.stick_share.between(0, 1).all()


def test_a_dry_run_says_what_is_run_again_and_writes_nothing(dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(estimate, "PILOT", 0.02)
    before = listing(dataset)
    for record, n_run in ((["friction_power", "dt=0.5"], 3), (["waiting"], 0)):  # those of the exact law
        out = tmp_path / str(n_run)
        assert main(["extend", str(dataset), "--record", *record, "--out", str(out), "--dry-run"]) == 0
        said = capsys.readouterr().out
        assert f"to run  {n_run} of 6 members; what is kept suffices for the others\n" in said
        assert bool(re.search(r"time    \d\d:\d\d \(\d\d:\d\d to \d\d:\d\d\) on 1 worker", said)) == (n_run > 0)
        assert not out.exists()
    assert listing(dataset) == before


@pytest.mark.parametrize(("words", "said"), [
    (["waitings"], "record.waitings: unknown key of [record]; did you mean 'waiting'?"),
    (["waiting", "t_burn=soon"], "--record: expected a value as a scene has it, such as t_burn=50, got 't_burn="),
    (["waiting", "waiting"], "--record: expected each key once, got waiting twice; leave one out"),
])  # fmt: skip
def test_what_cannot_be_added_is_refused_in_a_line(words, said, dataset, tmp_path, capsys):
    assert main(["extend", str(dataset), "--record", *words, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_scene_with_more_members_and_records(here, dataset, small_scene, tmp_path, capsys):
    more = tmp_path / "more.toml"
    more.write_text(small_scene.read_text().replace("events = true", "events = true\nwaiting = true"))
    words = ["--scene", str(more), "--out", str(tmp_path / "out"), "--workers", "1", "--no-report"]
    assert main(["extend", str(dataset), *words]) == 0
    assert "waiting_mean" in query.members(tmp_path / "out")


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
