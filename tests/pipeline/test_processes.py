"""Processes beside this one: they load what it has loaded, and outlive nobody."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stickslip.pipeline import expand
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.machine import processes
from stickslip.pipeline.machine.processes import Child, ChildDied, environment_kept
from stickslip.pipeline.running.isolation import compute_alone
from stickslip.pipeline.running.worker import compute
from tests.processes import is_running, until


def test_a_file_of_the_users_is_no_module_of_ours(scene, tmp_path, monkeypatch):
    """Where a user works there may be a sim.py."""
    for name in ("sim", "pipeline", "pickle"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    batch = Batch(0, expand(scene)[:2], scene.hash)
    here, there = compute(batch, scene.recording), compute_alone(batch, scene.recording)
    assert there.shard == here.shard


def hang(file):
    """In a child: say who it is, and never answer."""
    Path(file).write_text(str(os.getpid()))
    time.sleep(99)


def leave(code):
    os._exit(code)


def test_it_ends_with_its_parent_in_the_middle_of_its_work(tmp_path):
    pid = tmp_path / "pid"
    code = (
        "from stickslip.pipeline.machine.processes import Child; from tests.pipeline.test_processes import hang\n"
        f"Child(hang)({str(pid)!r})"
    )
    with subprocess.Popen([sys.executable, "-c", code], env=processes._environment()) as parent:
        until(lambda: pid.exists() and pid.read_text() != "")
        os.kill(parent.pid, signal.SIGKILL)
    until(lambda: not is_running(int(pid.read_text())))


def test_it_answers_one_question_after_the_other_and_says_how_it_died():
    with Child(math.factorial) as child:
        assert [child(n) for n in range(5)] == [1, 1, 2, 6, 24]
        with pytest.raises(ChildDied, match="exit code 1"):  # it raised
            child("five")
        with pytest.raises(ChildDied, match="exit code 1"):
            child(5)
    with Child(leave) as child, pytest.raises(ChildDied, match="exit code 3"):
        child(3)
    with Child(hang) as child:
        pass
    assert not is_running(child.pid)


FORKING = """
import json, os, signal, sys
sys.path.remove("")  # as in a program that is installed
from stickslip.pipeline.machine.processes import forked_workers, frugal

def about():
    there = dict(os.environ), sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    return os.getppid(), "stickslip.pipeline.running.preload" in sys.modules, *there

before = dict(os.environ)
with frugal(), forked_workers():
    from stickslip.pipeline.running import cluster
    with cluster.local(2) as client:
        found = list(client.run(about).values())
assert dict(os.environ) == before
with cluster.local(1) as client:  # as ever
    print(json.dumps([os.getpid(), found, client.submit(os.getppid).result()]))
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux")
def test_workers_of_a_program_are_forked_from_what_has_loaded_all_and_goes_with_it(tmp_path, monkeypatch):
    for name in ("sim", "numba", "queue", "stickslip"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)\n")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    command = [sys.executable, "-c", FORKING]
    done = subprocess.run(command, cwd=tmp_path, env=processes._environment(), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    driver, found, later = json.loads(done.stdout)
    (server,) = {parent for parent, *_ in found}
    assert server != driver == later
    for _, is_loaded, environment, signals in found:
        assert is_loaded
        assert environment["OMP_NUM_THREADS"] == "1"
        assert signals == sorted([signal.SIGINT, signal.SIGTERM])
    assert not is_running(server)


def test_the_environment_is_as_it_was(monkeypatch):
    monkeypatch.setenv("STICKSLIP_THERE", "1")
    monkeypatch.setenv("STICKSLIP_GONE", "1")
    before = dict(os.environ)
    with environment_kept():
        os.environ |= {"STICKSLIP_THERE": "2", "STICKSLIP_NEW": "3"}
        del os.environ["STICKSLIP_GONE"]
    assert dict(os.environ) == before


def test_the_path_holds_the_working_directory_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "/else"])
    assert processes._environment()["PYTHONPATH"] == f"{tmp_path}{os.pathsep}/else"
