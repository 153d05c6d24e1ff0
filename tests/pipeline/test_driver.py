"""Scheduling: the same bytes whoever computes, one thread a worker, nothing left behind."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from distributed import KilledWorker
from distributed.comm import CommClosedError

from stickslip.pipeline import Progress, ScheduleError, expand, run_ensemble, status, verify
from stickslip.pipeline.dataset.status import Pace, Tally
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.machine.processes import ONE_THREAD
from stickslip.pipeline.running import cluster, driver, executor, submit, worker
from stickslip.sim.engines import ENGINES
from tests.pipeline.conftest import SOURCE
from tests.processes import is_running, python, until


def test_workers_give_the_bytes_of_this_process(scene, finished, content, tmp_path):
    environment = dict(os.environ)
    seen: list[Progress] = []
    result = run_ensemble(scene, tmp_path / "out", workers=2, on_progress=seen.append)
    assert content(tmp_path / "out") == content(finished)
    assert verify(tmp_path / "out") == []
    assert dict(os.environ) == environment
    assert result.is_complete
    assert (seen[0].n_done, seen[0].eta, seen[0].last_shard) == (0, None, None)
    counts = [progress.n_done for progress in seen if progress.waiting is None]
    assert counts == sorted({*counts})
    assert seen[0].waiting == "workers"
    first = next(k for k, progress in enumerate(seen) if progress.n_done)
    assert {progress.waiting for progress in seen[1:first]} <= {"workers", "the first shard"}
    assert {progress.waiting for progress in seen[first:]} == {None}
    assert seen[-1].n_done == seen[-1].n_members == scene.n_members
    assert seen[-1].cost_done == pytest.approx(sum(member.cost for member in expand(scene)))
    assert seen[-1].eta == pytest.approx(0, abs=1e-9)


def test_a_running_cluster_can_be_used(scene, finished, content, tmp_path):
    with cluster.local(1) as client:
        run_ensemble(scene, tmp_path / "out", scheduler=client)
    assert content(tmp_path / "out") == content(finished)


def test_libraries_have_one_thread_in_a_worker(monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name)

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

    with cluster.connect(1, None) as client:
        variables, numba_threads, blas_threads = client.submit(threads).result()
    assert variables == ["1"] * 4
    assert numba_threads == 1
    assert set(blas_threads) <= {1}  # empty with another BLAS


def test_workers_are_counted_from_none(scene, tmp_path):
    with pytest.raises(ValueError, match="workers: expected a count >= 0, got -1"):
        run_ensemble(scene, tmp_path / "out", workers=-1)
    assert not (tmp_path / "out").exists()


def test_a_script_that_every_worker_runs_is_told_so(source, tmp_path):
    (tmp_path / "small.toml").write_bytes(source)
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from stickslip.pipeline import load_scene, run_ensemble\n"
        "file = Path('small.toml')\n"
        "run_ensemble(load_scene(file), 'out')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = python(script, cwd=tmp_path, env=environment)
    assert done.returncode == 1
    assert 'run it under if __name__ == "__main__":' in done.stderr.splitlines()[-1]
    assert 'expected a scene to be run under if __name__ == "__main__":, got a script' in done.stderr


@pytest.mark.long
def test_a_batch_whose_workers_died_is_run_again(scene, finished, content, tmp_path, monkeypatch):
    compute = driver.compute_there

    def dies(order):
        if order[0].name.startswith("shard-00002"):
            os._exit(1)
        return compute(order)

    monkeypatch.setattr(driver, "compute_there", dies)
    with cluster.local(1) as client:
        result = run_ensemble(scene, tmp_path / "out", workers=0, scheduler=client)
    assert result.is_complete
    assert content(tmp_path / "out") == content(finished)


def test_interrupt_leaves_a_dataset_to_resume(scene, finished, content, tmp_path):
    def interrupt(progress):
        if progress.n_done:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_ensemble(scene, tmp_path / "out", workers=0, on_progress=interrupt)
    assert verify(tmp_path / "out") == []
    assert not (tmp_path / "out" / ".lock").exists()
    before = content(tmp_path / "out")
    planned, to_go = Store(tmp_path / "out", scene).look()
    assert to_go == planned[1:]
    assert content(tmp_path / "out") == before
    run_ensemble(scene, tmp_path / "out", workers=0)
    assert content(tmp_path / "out") == content(finished)


def test_without_workers_a_run_gives_up_but_at_an_address_says_that_it_waits(monkeypatch):
    said = []
    monkeypatch.setattr(submit, "LOST_TIMEOUT", 0.5)
    monkeypatch.setattr(submit.log, "warning", lambda words, *_: said.append(words))
    with cluster.connect(1, None) as client:
        client.cluster.scale(0)
        submit.Watch(client, client, "go on").until(lambda: len(said) > 1)
        with pytest.raises(ScheduleError, match="expected workers, got none for"):
            submit.Watch(client, None, "go on").until(lambda: False)
    assert all(words.startswith("waiting for workers: ") for words in said)


class Running(list):
    """In place of `as_completed`: all that is added is done."""

    add, count = list.append, list.__len__

    def is_empty(self):
        return not self

    def has_ready(self):
        return bool(self)

    def __next__(self):
        return self.pop(0)


class Done:
    """A task that is done, and fails as it is told to."""

    def __init__(self, function, part, version, fails=None):
        self.answer, self._fails = lambda: executor.call_there(function, part, version), fails

    def result(self, timeout):
        if self._fails is not None:
            raise self._fails
        return self.answer()

    def release(self):
        pass


def cluster_of(done, monkeypatch):
    """In place of a cluster, one where all is done at once."""
    monkeypatch.setattr(submit, "as_completed", lambda loop: Running())
    send = lambda call, function, part, version, pure: done(function, part, version)  # noqa: E731
    return SimpleNamespace(loop=None, submit=send, cluster=None, status="running", nthreads=dict)


def test_no_more_are_in_flight_than_the_window_holds(monkeypatch):
    """A batch is in flight until its result is released."""
    in_flight, most = set(), []

    class Flying(Done):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            most.append(len(in_flight))
            in_flight.add(self)

        def release(self):
            in_flight.discard(self)

    workers = submit.Dask(cluster_of(Flying, monkeypatch), None, "go on")
    assert [pair for pairs in workers.map(abs, range(10)) for pair in pairs] == [(k, k) for k in range(10)]
    assert max(most) == submit.WINDOW - 1


def test_what_came_in_is_kept_though_the_scheduler_is_lost(monkeypatch):
    """Three results are there at once, and while the third is fetched nobody answers."""
    fails = iter([None, None, CommClosedError()])
    workers = submit.Dask(cluster_of(lambda *task: Done(*task, next(fails)), monkeypatch), None, "go on")
    results = workers.map(abs, range(3))
    assert next(results) == [(0, 0), (1, 1)]
    with pytest.raises(ScheduleError, match="scheduler to stay until the end, lost it; start it again, then go on"):
        next(results)


def test_parts_whose_workers_died_are_computed_alone_and_given_up_in_the_end(monkeypatch):
    functions = []

    def done(function, part, version):
        functions.append(function)
        return Done(function, part, version, KilledWorker("", None, 3) if pickle.loads(part) == -1 else None)

    workers = submit.Dask(cluster_of(done, monkeypatch), None, "go on", alone=int)
    results = workers.map(abs, [1, -1])
    assert next(results) == [(0, 1)]
    with pytest.raises(ScheduleError, match=r"got 1 parts whose workers died 4 times.*go on"):
        next(results)
    assert functions == [abs, abs, int, int, int]


def test_workers_of_another_version_are_refused(monkeypatch):
    versions = iter(["theirs", "ours", "ours"])
    client = cluster_of(Done, monkeypatch)
    workers = submit.Dask(client, None, "go on", version=lambda: next(versions))
    with pytest.raises(
        ScheduleError, match=r"this version of the program \(ours\), got theirs on .*install the same"
    ):
        next(workers.map(abs, range(3)))


def test_workers_are_counted_once_a_second(monkeypatch):
    """A look names each of a thousand workers: one for each result would take longer than the result."""
    clock, looks = [0.0], []
    count = lambda: looks.append(clock[0]) or dict.fromkeys(range(len(looks)), 1)  # noqa: E731
    client = SimpleNamespace(nthreads=count, cluster=None, status="running")
    monkeypatch.setattr(submit.time, "monotonic", lambda: clock[0])
    watch, found = submit.Watch(client, client, "go on"), []
    for clock[0] in (5.0, 5.5, 5.9, 6.1, 7.0, 7.2):
        watch.look()
        found.append(watch.n_workers)
    assert (looks, found) == ([5.0, 6.1, 7.2], [1, 1, 1, 2, 2, 3])


def test_the_pace_is_that_of_the_work_since_workers_came():
    """Sixteen workers of 10 s a shard came after an hour's wait: 1,600 shards are done 1000 s after that."""
    tally = Tally(1600, 0, {}, 1600, 0, 1, 1600.0, 0.0)

    def at(n_done):
        return replace(tally, n_done=n_done, n_shards_done=n_done, cost_done=float(n_done))

    assert at(1).pace(None, 3610.0) == (None, None)
    first_round = Pace(3610.0, 16, 16.0, 16, 16)
    assert at(31).pace(first_round, 3620.0) == (None, None)
    assert at(32).pace(first_round, 3620.0) == (pytest.approx(1.6), pytest.approx(1568 / 1.6))
    more = Pace(3630.0, 64, 64.0, 64, 32)  # workers have doubled
    assert at(95).pace(more, 3640.0) == (None, None)
    assert at(96).pace(more, 3640.0) == (pytest.approx(3.2), pytest.approx(1504 / 3.2))
    assert at(1600).pace(first_round, 4600.0)[1] == 0.0
    assert Pace.parse(more.line.removeprefix("pace ")) == more


def test_the_pace_begins_once_each_worker_has_had_a_shard(scene, tmp_path, monkeypatch):
    """The first ones take as long as starting and compiling do; here this process is the one worker."""
    seen, noted = [], []
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 1e-9)
    monkeypatch.setattr(Store, "note", lambda self, line: noted.append(line.split()))
    run_ensemble(scene, tmp_path / "out", workers=0, on_progress=seen.append)
    (pace,) = (words for words in noted if words[0] == "pace")
    assert pace[2] == pace[4] == "1"
    assert [progress.eta is None for progress in seen[:4]] == [True, True, False, False]


def test_a_run_says_what_it_waits_for_and_asks_a_worker_what_is_to_be_compiled(scene, tmp_path, monkeypatch):
    """Workers come after a while; kernels that the first has not are said to be compiled."""
    seen = []

    def compute(task):
        time.sleep(2.5)
        raise ZeroDivisionError

    with cluster.local(1) as client:
        client.run(exec, f"import os; os.environ['NUMBA_CACHE_DIR'] = {str(tmp_path / 'kernels')!r}")
        monkeypatch.setattr(driver, "compute_there", compute)
        with pytest.raises(ZeroDivisionError):
            run_ensemble(scene, tmp_path / "out", scheduler=lambda: client, on_progress=seen.append)
    waiting = [progress.waiting for progress in seen]
    assert waiting[0] == "workers"
    assert waiting[-1] == "coulomb and sigmoid to be compiled, once: half a minute of a core"
    assert [progress.eta for progress in seen] == [None] * len(seen)


def test_cold_engines_are_those_whose_kernels_are_missing(finished, tmp_path, monkeypatch):
    assert worker.cold_engines(("coulomb", "sigmoid")) == ()  # those of `finished`
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert {*worker.cold_engines(ENGINES)} == {name for name, engine in ENGINES.items() if engine.kernels}
    monkeypatch.setattr(ENGINES["coulomb"], "kernels", "")
    assert worker.cold_engines(["coulomb"]) == ()


@pytest.mark.long
def test_each_kernel_is_compiled_once(tmp_path):
    """Two processes that need a kernel at once: one compiles, the other waits and loads what it kept."""
    command = [
        sys.executable,
        "-c",
        f"""
import sys
from numba.core import event
from stickslip.pipeline import expand, parse_scene
from stickslip.pipeline.running import worker
members = [member for member in expand(parse_scene({SOURCE!r})) if member.engine == "coulomb"]
with event.install_recorder("numba:compile") as compiled:
    worker.load_kernels(members)
worker.load_kernels(members)
print(any("advance" in str(e.data["dispatcher"]) for _, e in compiled.buffer), worker.cold_engines(["coulomb"]))
""",
    ]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    running = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=500)[0].split() for process in running]
    assert sorted(said) == [["False", "()"], ["True", "()"]]
    assert len(list(tmp_path.rglob("*.nbc"))) == 1


# ------------------------------------------------------------------------------------------ workers that cannot start

#: What a process that is to become a worker, or the one that workers are forked from, does before all else.
ENDS = {
    "dies": "print('its last words', file=sys.stderr, flush=True); os._exit(5)",
    "is killed": "print('its last words', file=sys.stderr, flush=True); os.kill(os.getpid(), 9)",
    "hangs": "open(os.environ['STARTED'], 'w').write(str(os.getpid())); time.sleep(999)",
}


@pytest.fixture
def no_start(tmp_path, monkeypatch):
    """Have processes of `multiprocessing` end in a way of `ENDS`."""

    def ends(how):
        (site := tmp_path / "site").mkdir()
        (site / "sitecustomize.py").write_text(
            "import os, sys, time\n"
            "if any('import forkserver' in one or 'import spawn_main' in one or 'forkserver import main' in one"
            f" for one in sys.orig_argv):\n    {ENDS[how]}\n"
        )
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *filter(None, sys.path)]))
        monkeypatch.setattr(sys, "path", [str(site), *sys.path])
        monkeypatch.setenv("STARTED", str(tmp_path / "started"))
        return tmp_path / "started"

    return ends


def run_command(out, source):
    """The command itself, whose workers are forked."""
    out.parent.joinpath("small.toml").write_bytes(source)
    return subprocess.Popen(
        [sys.executable, "-m", "stickslip", "run", "small.toml", "--out", str(out), "--workers", "2", "--no-report"],
        cwd=out.parent, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


@pytest.mark.parametrize("how", ["dies", "is killed"])
def test_workers_that_die_as_they_start_end_the_run_with_their_last_words(how, no_start, scene, tmp_path):
    no_start(how)
    with pytest.raises(ScheduleError, match=r"on this machine, could not start them \(.*\)\n    its last words"):
        run_ensemble(scene, tmp_path / "out", workers=2)
    assert status(tmp_path / "out").n_done == 0


def test_workers_have_some_time_to_start(no_start, scene, tmp_path, monkeypatch):
    file = no_start("hangs")
    monkeypatch.setattr(cluster, "_START_TIMEOUT", 0.0)
    with pytest.raises(ScheduleError, match=r"could not start them \(they did not within 3 s\)"), cluster.local(1):
        pass
    if file.exists():  # else it was killed before
        until(lambda: not is_running(int(file.read_text() or 0)))


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux")
@pytest.mark.parametrize("how", ["dies", "is killed"])
def test_a_server_of_workers_that_dies_ends_the_command_with_its_last_words(how, no_start, source, tmp_path):
    no_start(how)
    _, err = (process := run_command(tmp_path / "out", source)).communicate(timeout=500)
    assert process.returncode == 1, err
    assert "could not start them (the process that they are forked from has died)\n    its last words" in err
    assert "Traceback" not in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_ends_a_command_whose_workers_never_start(number, no_start, source, tmp_path):
    file = no_start("hangs")
    process = run_command(tmp_path / "out", source)
    until(lambda: (tmp_path / "out" / "manifest.json").exists() and file.exists() and file.read_text() != "")
    process.send_signal(number)
    _, err = process.communicate(timeout=500)
    assert process.returncode == 128 + number, err
    assert "Resume with:" in err
    until(lambda: not is_running(int(file.read_text())))


def test_little_memory_is_refused_in_a_line(source, tmp_path):
    (tmp_path / "small.toml").write_bytes(source)
    words = f'ulimit -v 700000; exec "{sys.executable}" -m stickslip run small.toml --out out --workers 2'
    done = subprocess.run(["sh", "-c", words], cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert done.returncode == 1
    assert "(`ulimit -v`); raise it" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
