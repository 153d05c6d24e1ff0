"""Scheduling: the same bytes whoever computes, one thread a worker, nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from distributed import LocalCluster

import pipeline
from pipeline import Progress, ScheduleError, expand, parse_scene, run_scene, schedule, status, verify


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_give_the_bytes_of_this_process(workers, scene, source, finished, content, tmp_path):
    environment = dict(os.environ)
    seen: list[Progress] = []
    result = run_scene(scene, source, tmp_path / "out", workers=workers, on_progress=seen.append)
    assert content(tmp_path / "out") == content(finished)
    assert verify(tmp_path / "out") == []
    assert dict(os.environ) == environment
    assert result.is_complete
    assert (seen[0].n_done, seen[0].eta, seen[0].last_shard) == (0, None, None)
    assert [progress.n_done for progress in seen] == sorted({progress.n_done for progress in seen})
    assert seen[-1].n_done == seen[-1].n_members == scene.n_members
    assert seen[-1].cost_done == pytest.approx(sum(member.cost for member in expand(scene)))
    assert seen[-1].eta == pytest.approx(0, abs=1e-9)
    pids = {line.split('"pid": ')[1].split(",")[0] for line in (tmp_path / "out" / "timings.jsonl").open()}
    assert str(os.getpid()) not in pids


def test_a_running_cluster_can_be_used(scene, source, finished, content, tmp_path):
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        run_scene(scene, source, tmp_path / "out", scheduler=cluster.scheduler_address)
    assert content(tmp_path / "out") == content(finished)


def test_libraries_have_one_thread_in_a_worker():
    def threads():
        import ctypes
        import os

        import numba
        import numpy  # noqa: F401  loads its BLAS

        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
        with open("/proc/self/maps") as maps:
            loaded = sorted({line.split()[-1] for line in maps if "openblas" in line})
        counts = []
        for library in map(ctypes.CDLL, loaded):
            for name in (
                "openblas_get_num_threads",
                "scipy_openblas_get_num_threads",
                "scipy_openblas_get_num_threads64_",
            ):
                if hasattr(library, name):
                    counts.append(getattr(library, name)())
        return [os.environ.get(name) for name in names], numba.get_num_threads(), counts

    with schedule._client(1, None) as client:
        variables, numba_threads, blas_threads = client.submit(threads).result()
    assert variables == ["1"] * 4
    assert numba_threads == 1
    assert set(blas_threads) <= {1}  # empty with another BLAS


def test_a_batch_that_kills_its_workers_does_not_take_the_others_along(source, tmp_path, monkeypatch):
    text = source.replace(b"n = [5, 3]", b"n = [3]").replace(b"matrices = 3", b"matrices = 1")
    scene = parse_scene(text)
    original = schedule.compute
    victim = expand(scene)[0].member_id

    def deadly(batch, scene_hash, events):
        import os
        import signal

        if batch.members[0].member_id == victim:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(batch, scene_hash, events)

    monkeypatch.setattr(schedule, "compute", deadly)
    monkeypatch.setattr("pipeline.members.TARGET_COST", 0.0)
    with pytest.raises(ScheduleError, match=rf"got 1 that killed.*{victim}.*all other batches are done"):
        run_scene(scene, text, tmp_path / "out", workers=1)
    monkeypatch.setattr(schedule, "compute", original)
    seen: list[Progress] = []
    assert run_scene(scene, text, tmp_path / "out", workers=0, on_progress=seen.append).is_complete
    assert seen[0].n_done == scene.n_members - 1


def test_no_scheduler_there(scene, source, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.schedule.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(ScheduleError, match=r"scheduler: expected the address.*127\.0\.0\.1:9.*dask scheduler"):
        run_scene(scene, source, tmp_path / "out", scheduler="tcp://127.0.0.1:9")
    with pytest.raises(ValueError, match="workers: expected a count >= 0, got -1"):
        run_scene(scene, source, tmp_path / "other", workers=-1)
    assert not (tmp_path / "other").exists()


def test_ctrl_c_is_answered_by_the_driver_alone(source, tmp_path):
    script = """
import os, signal, sys
from pathlib import Path
from pipeline import members, parse_scene, run_scene
members.TARGET_COST = 3.5e-3
source = Path(sys.argv[1]).read_bytes()
def interrupt(progress):
    if progress.n_done:
        os.killpg(0, signal.SIGINT)  # as a terminal does: to the workers too
if __name__ == "__main__":
    try:
        run_scene(parse_scene(source), source, Path(sys.argv[2]), workers=2, on_progress=interrupt)
    except KeyboardInterrupt:
        print("interrupted")
"""
    (tmp_path / "scene").write_bytes(source)
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "scene"), str(tmp_path / "out")],
        env={**os.environ, "PYTHONPATH": str(Path(pipeline.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=120,
        start_new_session=True,
    )
    assert (done.stdout, done.stderr) == ("interrupted\n", "")
    assert 0 < status(tmp_path / "out").n_done < parse_scene(source).n_members


def test_interrupt_leaves_a_dataset_to_resume(scene, source, finished, content, tmp_path):
    def interrupt(progress):
        if progress.n_done:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_scene(scene, source, tmp_path / "out", workers=0, on_progress=interrupt)
    assert verify(tmp_path / "out") == []
    assert not (tmp_path / "out" / ".lock").exists()
    run_scene(scene, source, tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == content(finished)
