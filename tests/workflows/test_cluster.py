"""On a cluster: what Slurm would be told, a run of the script that ends by SIGTERM and goes on, workers by hand."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from distributed import Client

from stickslip.pipeline import parse_scene, run_ensemble, status, verify
from stickslip.workflows.commands import main
from tests.processes import dask_by_hand, until
from tests.scenes import COULOMB, ensemble

SCRIPT = Path(__file__).parents[2] / "workflows" / "guide" / "slurm.py"
N_MATRICES = 30
SOURCE = ensemble([100, 5], 300.0, N_MATRICES, COULOMB, seed=11, analysis="t_burn = 20.0\ndt = 1.0").encode()


@pytest.fixture(scope="module")
def slurm():
    specification = importlib.util.spec_from_file_location("slurm", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("scene") / "mine.toml"
    file.write_bytes(SOURCE)
    return file


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = tmp_path_factory.mktemp("reference") / "out"
    run_ensemble(parse_scene(SOURCE), path, workers=0)
    return shards(path)


def shards(path):
    return {file.name: file.read_bytes() for file in (path / "data").iterdir()}


def test_what_slurm_is_told(slurm, tmp_path, monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    jobqueue = pytest.importorskip("dask_jobqueue.slurm")
    signal.signal(signal.SIGINT, before)  # it sets one of its own
    asked = ["mine.toml", "--out", "x", "--per-job", "8", "--memory", "3", "--minutes", "90", "--queue", "long"]
    arguments = slurm.parser().parse_args([*asked, "--account", "blocks"])
    monkeypatch.chdir(tmp_path)
    with jobqueue.SLURMCluster(**slurm.slurm_settings(arguments)) as cluster:
        script = cluster.job_script()
        assert cluster.scheduler_address.startswith("tls://")
        assert cluster.scheduler.services == {}  # no web server
        files = re.findall(rf"--tls-\S+ ({tmp_path}/\S+)", script)
        assert [stat.S_IMODE(os.stat(file).st_mode) for file in files] == [0o600] * 3
    for line in (
        "#SBATCH --cpus-per-task=8",
        "#SBATCH -t 01:30:00",
        "#SBATCH -p long",
        "#SBATCH -A blocks",
        "export OMP_NUM_THREADS=1",
        "export OPENBLAS_NUM_THREADS=1",
        "export MKL_NUM_THREADS=1",
        "export NUMBA_NUM_THREADS=1",
        "export DASK_TEMPORARY_DIRECTORY=$(mktemp -d)",
    ):
        assert line in script.splitlines()
    assert re.search(r" --nthreads 1 .*--nworkers 8 ", script)
    memory = int(re.search(r"--mem=(\d+)G", script)[1])
    assert memory in (22, 23, 24)  # of 24 GB, in the units of Slurm
    lifetime, stagger = (int(re.search(rf"--{name} (\d+)s", script)[1]) for name in ("lifetime", "lifetime-stagger"))
    assert lifetime + stagger < 90 * 60 - 60  # the last worker leaves before the job ends
    assert "--worker-class stickslip.pipeline.running.cluster.QuietWorker" in script


@pytest.mark.parametrize("minutes", [1, 10, 20, 32, 120])
def test_workers_leave_before_their_job_ends_and_not_at_once(slurm, minutes):
    arguments = slurm.parser().parse_args(["mine.toml", "--out", "x", "--minutes", str(minutes)])
    _, lifetime, _, stagger, *_ = slurm.slurm_settings(arguments)["worker_extra_args"]
    lifetime, stagger = int(lifetime.rstrip("s")), int(stagger.rstrip("s"))
    assert 30 * minutes <= lifetime - stagger < lifetime + stagger <= 60 * minutes - min(300, 15 * minutes)


#: Slurm in little: a job is a group of processes, known by the first one's number.
SBATCH = """#!/bin/sh
cp "$1" "$JOBS/$$.sh"
setsid sh "$JOBS/$$.sh" > "$JOBS/$$.log" 2>&1 &
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
kill -KILL -- "-$1"
"""


REFUSES = """#!/bin/sh
echo "sbatch: error: invalid partition specified: none" >&2
exit 1
"""
#: Takes one job, refuses the next, and takes further ones.
REFUSES_ONCE = """#!/bin/sh
echo >> "$JOBS/asked"
if [ "$(wc -l < "$JOBS/asked")" = 2 ]; then echo "sbatch: error: controller is away" >&2; exit 1; fi
""" + SBATCH.removeprefix("#!/bin/sh\n")


@contextlib.contextmanager
def in_little(tmp_path, scene_file, sbatch, *more, n=1):
    """The script, with a second between attempts, beside a Slurm in little; and where that keeps its jobs."""
    pytest.importorskip("dask_jobqueue")
    (jobs := tmp_path / "jobs").mkdir()
    for name, script in (("sbatch", sbatch), ("scancel", SCANCEL)):
        (file := tmp_path / name).write_text(script)
        file.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "JOBS": str(jobs),
        "DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "1s",
    }  # fmt: skip
    asked = [str(scene_file), "--out", "out", "--workers", str(n), "--per-job", str(n), "--memory", "1", *more]
    code = f"import sys; sys.path.insert(0, {str(SCRIPT.parent)!r}); import slurm; slurm.RETRY = 1"
    command = [sys.executable, "-c", f"{code}; sys.exit(slurm.main({asked}))"]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as process:
        yield process, jobs


def kill_the_job(tmp_path, jobs):
    """Once it has made a shard."""
    until(lambda: list((tmp_path / "out" / "data").glob("shard-*")), timeout=120)
    (job,) = (int(file.stem) for file in jobs.glob("*.sh"))
    (group,) = {os.getpgid(pid) for pid in children_named(f"{job}.sh")}
    os.killpg(group, signal.SIGKILL)


@pytest.mark.long
def test_a_job_that_ends_is_replaced_and_the_report_is_made_by_the_workers(scene_file, reference, tmp_path):
    with in_little(tmp_path, scene_file, SBATCH, "--report", n=2) as (process, jobs):
        kill_the_job(tmp_path, jobs)
        _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert len(list(jobs.glob("*.sh"))) > 1
    assert shards(tmp_path / "out") == reference
    assert (tmp_path / "out" / "report.html").exists()
    assert "Traceback" not in err


def test_a_slurm_that_takes_no_job_ends_the_script_with_its_words(scene_file, tmp_path):
    with in_little(tmp_path, scene_file, REFUSES) as (process, _):
        _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "slurm.py: Slurm takes no job: sbatch: error: invalid partition specified: none" in err


@pytest.mark.long
def test_a_job_that_is_refused_is_submitted_again(scene_file, reference, tmp_path):
    with in_little(tmp_path, scene_file, REFUSES_ONCE) as (process, jobs):
        kill_the_job(tmp_path, jobs)
        _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "a job was refused and is submitted again in 1 s: sbatch: error: controller is away" in err
    assert shards(tmp_path / "out") == reference


def children_named(name):
    """Numbers of the processes that were started with a file of that name."""
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and name.encode() in (entry / "cmdline").read_bytes():
                yield int(entry.name)


@pytest.mark.long
def test_the_script_ends_by_sigterm_and_goes_on(slurm, scene_file, reference, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [str(scene_file), "--out", str(out), "--local", "--workers", "1"]
    with subprocess.Popen([sys.executable, SCRIPT, *arguments], stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not list(out.glob("data/shard-*")):
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert "rerun the same command to resume" in err
    assert verify(out) == []
    n_done = status(out).n_done
    assert 0 < n_done < 2 * N_MATRICES
    assert slurm.main(arguments) == 0
    assert f"{n_done} of {2 * N_MATRICES} members are there already" in capsys.readouterr().err
    assert shards(out) == reference


@pytest.mark.long
@pytest.mark.parametrize(
    ("worker", "warned"),
    [
        (["--nthreads", "1"], []),
        (
            ["--nthreads", "2", "--no-nanny"],
            ["expected workers of one thread each", "libraries have one thread each", "nobody else may write"],
        ),
    ],
)
def test_a_scheduler_and_workers_by_hand(worker, warned, tmp_path, monkeypatch, capsys, caplog):
    """Threads that run members side by side, in one process, get the same bytes, and the driver says it is slow.

    And that somebody else made the directory in which dask looks for modules, so that they may write there.
    """
    scratch = tmp_path / "scratch" / "dask-scratch-space"
    scratch.mkdir(parents=True)
    scratch.chmod(0o777 if warned else 0o700)
    monkeypatch.setattr("stickslip.pipeline.ensemble.pack.TARGET_COST", 0.005)
    source = SOURCE.replace(b"[100, 5]", b"[20, 5]").replace(b"matrices = 30", b"matrices = 6")
    (tmp_path / "mine.toml").write_bytes(source)
    run_ensemble(parse_scene(source), tmp_path / "reference", workers=0)
    with dask_by_hand(tmp_path, *worker, DASK_TEMPORARY_DIRECTORY=str(scratch.parent)) as (address, _):
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=120)
        command = ["run", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out"), "--scheduler", address]
        assert main([*command, "--no-report"]) == 0
    assert len(shards(tmp_path / "out")) > 3
    assert shards(tmp_path / "out") == shards(tmp_path / "reference")
    assert re.search(r"^dask    http://\S+:\d+/status$", capsys.readouterr().err, re.MULTILINE)
    said = "\n".join(record.getMessage() for record in caplog.records)
    assert [words for words in warned if words not in said] == []
    assert bool(said) == bool(warned)
