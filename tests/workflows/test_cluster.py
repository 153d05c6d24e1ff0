"""On a cluster: what Slurm would be told, a run in its jobs that ends by SIGTERM and goes on, workers by hand."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import shlex
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import Client

from stickslip.pipeline import parse_scene, run_ensemble, status, verify
from stickslip.pipeline.running import slurm
from stickslip.workflows.commands import main
from tests.processes import dask_by_hand, listening, until
from tests.scenes import COULOMB, ensemble

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "large-runs.md"
N_MATRICES = 30
SOURCE = ensemble([100, 5], 300.0, N_MATRICES, COULOMB, seed=11, analysis="t_burn = 20.0\ndt = 1.0").encode()


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


def require_jobqueue():
    """Not imported here: it sets a handler of SIGINT."""
    if importlib.util.find_spec("dask_jobqueue") is None:
        pytest.skip("without dask-jobqueue")


def shards(path):
    return {file.name: file.read_bytes() for file in (path / "data").iterdir()}


def test_what_slurm_is_told(tmp_path, monkeypatch):
    """With dask's pages installed, or what passes for them: they are not to be served."""
    require_jobqueue()
    monkeypatch.setitem(sys.modules, "distributed.dashboard.scheduler", SimpleNamespace(connect=None))
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    options = ["cpus-per-task=8", "mem-per-cpu=3G", "time=90", "partition=long", "--account=blocks", "exclusive"]
    settings = slurm.job_settings(64, [*options, "comment=two words"])
    with slurm.cluster_of_jobs()(**settings, security=slurm.certificate(tmp_path)) as cluster:
        script = cluster.job_script()
        assert cluster.scheduler_address.startswith("tls://")
        assert cluster.scheduler.services == {}  # no web server
        files = re.findall(rf"--tls-\S+ ({tmp_path}/\S+)", script)
        assert [stat.S_IMODE(os.stat(file).st_mode) for file in files] == [0o600] * 3
    assert signal.getsignal(signal.SIGINT) == before
    for line in (
        "#SBATCH --cpus-per-task=8",
        "#SBATCH --time=90",
        "#SBATCH --mem-per-cpu=3G",
        "#SBATCH --partition=long",
        "#SBATCH --account=blocks",
        "#SBATCH --exclusive",
        "#SBATCH --comment='two words'",
        "export OMP_NUM_THREADS=1",
        "export OPENBLAS_NUM_THREADS=1",
        "export MKL_NUM_THREADS=1",
        "export NUMBA_NUM_THREADS=1",
        "export DASK_TEMPORARY_DIRECTORY=$(mktemp -d)",
        "export PYTHONSAFEPATH=1",
        "trap : TERM",
    ):
        assert script.splitlines().count(line) == 1
    assert re.search(r" --nthreads 1 --memory-limit 3\.00GiB --nworkers 8 ", script)
    assert "--mem=" not in script  # sbatch takes one of the two
    assert "--worker-class stickslip.pipeline.running.cluster.QuietWorker" in script


@pytest.mark.parametrize(("above", "mode", "is_there"), [
    (0o755, 0o755, True), (0o755, 0o775, False), (0o777, 0o755, False), (0o1777, 0o700, True), (0o755, 0o1777, True),
])  # fmt: skip
def test_a_certificate_lies_where_nobody_else_can_exchange_it(above, mode, is_there, tmp_path, monkeypatch):
    (here := tmp_path / "above" / "here").mkdir(parents=True)
    here.parent.chmod(above)
    here.chmod(mode)
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert slurm._shared() == (here if is_there else tmp_path)


@pytest.mark.parametrize(
    ("time", "seconds"),
    [("1", 60), ("32", 1920), ("90:30", 5430), ("2:00:00", 7200), ("1-12", 129_600), ("1-12:30:15", 131_415)],
)
def test_workers_leave_before_their_job_ends_and_not_at_once(time, seconds):
    _, lifetime, _, stagger, *_ = slurm.job_settings(64, [f"time={time}"])["worker_extra_args"]
    lifetime, stagger = int(lifetime.rstrip("s")), int(stagger.rstrip("s"))
    assert seconds / 2 <= lifetime - stagger < lifetime + stagger <= seconds - min(300, seconds // 4)


@pytest.mark.parametrize(("job", "expected"), [
    ("time=0", "time: expected a limit such as 120, in minutes"),
    ("time=UNLIMITED", "time: expected a limit"),
    ("mem=much", "mem, mem-per-cpu: expected a size such as 2G, got 'much'"),
    ("cpus-per-task=0", "cpus-per-task: expected the number of processes of a job, got '0'"),
    ("partition=", "expected a long option of sbatch, such as partition=long, got 'partition='"),
    ("-p", "expected a long option of sbatch"),
    ("comment=a\n#SBATCH --uid=0", "expected a long option of sbatch"),
])  # fmt: skip
def test_options_that_cannot_be_read_are_refused(job, expected, scene_file, tmp_path, capsys):
    run = ["run", str(scene_file), "--out", str(tmp_path / "out")]
    assert main([*run, "--slurm", "4", f"--job={job}"]) == 2
    assert f"--job: {expected}" in capsys.readouterr().err
    assert main([*run, "--job", "time=120"]) == 2
    assert "--job: expected with --slurm" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


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
    """The command, with a second between attempts, beside a Slurm in little; and where that keeps its jobs."""
    require_jobqueue()
    (jobs := tmp_path / "jobs").mkdir(exist_ok=True)
    for name, script in (("sbatch", sbatch), ("scancel", SCANCEL)):
        (file := tmp_path / name).write_text(script)
        file.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "JOBS": str(jobs), "TMPDIR": str(tmp_path),
        "DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "1s",
    }  # fmt: skip
    asked = ["run", str(scene_file), "--out", "out", "--slurm", str(n), *more, "--job", "mem-per-cpu=1G"]
    code = f"""
import sys
from stickslip.pipeline.running import slurm
from stickslip.workflows.commands import main
slurm.RETRY = 1
sys.exit(main({asked}))
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as process:
        yield process, jobs


def kill_the_job(tmp_path, jobs):
    """Once it has made a shard."""
    until(lambda: list((tmp_path / "out" / "data").glob("shard-*")))
    (job,) = (int(file.stem) for file in jobs.glob("*.sh"))
    (group,) = {os.getpgid(pid) for pid in children_named(f"{job}.sh")}
    os.killpg(group, signal.SIGKILL)


@pytest.mark.long
def test_a_job_that_ends_is_replaced_and_the_report_is_made_by_the_workers(scene_file, reference, tmp_path):
    with in_little(tmp_path, scene_file, SBATCH, n=2) as (process, jobs):
        kill_the_job(tmp_path, jobs)
        _, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    assert len(list(jobs.glob("*.sh"))) > 1
    assert shards(tmp_path / "out") == reference
    assert (tmp_path / "out" / "report.html").exists()
    assert "Traceback" not in err
    said = [line.partition("waiting for ")[2] for line in err.splitlines()]
    assert "workers" in said
    assert "the first shard" in said


def test_a_slurm_that_takes_no_job_ends_the_run_with_its_words(scene_file, tmp_path):
    with in_little(tmp_path, scene_file, REFUSES, "--no-report") as (process, _):
        _, err = process.communicate(timeout=500)
    assert process.returncode == 1
    assert "expected Slurm to take jobs, got none in: sbatch: error: invalid partition specified: none" in err


#: Is asked, and does not answer.
SILENT = """#!/bin/sh
touch "$JOBS/asked"
exec sleep 5
"""


def test_what_a_killed_driver_left_goes_with_the_next(scene_file, tmp_path):
    with in_little(tmp_path, scene_file, SILENT, "--no-report") as (process, jobs):
        until((jobs / "asked").exists, timeout=120)
        process.kill()
    assert [*tmp_path.glob("stickslip-*")]
    with in_little(tmp_path, scene_file, REFUSES, "--no-report") as (process, _):
        _, err = process.communicate(timeout=120)
    assert process.returncode == 1, err
    assert not [*tmp_path.glob("stickslip-*"), *tmp_path.glob(".dask-*")]


@pytest.mark.long
def test_a_job_that_is_refused_is_submitted_again(scene_file, reference, tmp_path):
    with in_little(tmp_path, scene_file, REFUSES_ONCE, "--no-report") as (process, jobs):
        kill_the_job(tmp_path, jobs)
        _, err = process.communicate(timeout=500)
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
def test_a_run_in_jobs_ends_by_sigterm_with_its_jobs_and_goes_on(scene_file, reference, tmp_path):
    out = tmp_path / "out"
    with in_little(tmp_path, scene_file, SBATCH, "--no-report") as (process, jobs):
        until(lambda: list(out.glob("data/shard-*")))
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=500)
    assert process.returncode == 143, err
    (again,) = re.findall(r"^  (stickslip run .*)$", err, re.MULTILINE)
    expected = ["--slurm", "1", "--job", "mem-per-cpu=1G", "--no-report"]
    assert shlex.split(again)[-len(expected) :] == expected
    (job,) = jobs.glob("*.sh")
    until(lambda: not [*children_named(job.name)])
    assert verify(out) == []
    n_done = status(out).n_done
    assert 0 < n_done < 2 * N_MATRICES
    with in_little(tmp_path, scene_file, SBATCH, "--no-report") as (process, _):
        _, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    assert f"{n_done} of {2 * N_MATRICES} members are there already" in err
    assert shards(out) == reference


def test_without_the_extra_nothing_is_begun(scene_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "dask_jobqueue.slurm", None)
    assert main(["run", str(scene_file), "--out", str(tmp_path / "out"), "--slurm", "4"]) == 1
    assert 'got none; run: pip install "stickslip[cluster]"\n' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_is_complete_needs_no_job(scene_file, reference, tmp_path, monkeypatch):
    require_jobqueue()
    run_ensemble(parse_scene(SOURCE), tmp_path / "out", workers=0)
    monkeypatch.setattr(slurm, "_start", lambda *_: pytest.fail("a job was asked for"))
    run = ["run", str(scene_file), "--out", str(tmp_path / "out"), "--no-report"]
    assert main([*run, "--slurm", "64"]) == 0
    assert shards(tmp_path / "out") == reference


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
            client.wait_for_workers(1, timeout=500)
        command = ["run", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out"), "--scheduler", address]
        assert main([*command, "--no-report"]) == 0
    assert len(shards(tmp_path / "out")) > 3
    assert shards(tmp_path / "out") == shards(tmp_path / "reference")
    assert re.search(r"^dask    http://\S+:\d+/status$", capsys.readouterr().err, re.MULTILINE)
    said = "\n".join(record.getMessage() for record in caplog.records)
    assert [words for words in warned if words not in said] == []
    assert bool(said) == bool(warned)


@contextlib.contextmanager
def started(lines, environment, log):
    """A shell that runs some lines of the guide, in a group of its own."""
    with (
        open(log, "wb") as out,
        subprocess.Popen(
            ["bash", "-euc", lines],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def in_group(group):
    """Numbers of the processes of a group."""
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and os.getpgid(int(entry.name)) == group:
                yield int(entry.name)


@pytest.mark.long
def test_the_commands_of_the_guide_run_a_scene_by_hand_and_nobody_else_is_answered(tmp_path, scene_file, reference):
    """As they stand, on this machine alone: with TLS, and with no port open to other machines."""
    section = GUIDE.read_text().partition("### By hand\n")[2].partition("\n## ")[0]
    certificate, scheduler, workers, run = re.findall(r"^```sh\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    names = {"HEAD": "127.0.0.1", "8786": port, "--nworkers 16": "--nworkers 2", "my-scene.toml": str(scene_file)}
    for name, here in names.items():
        scheduler, workers, run = (lines.replace(name, here) for lines in (scheduler, workers, run))
    (home := tmp_path / "home").mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment |= {
        "HOME": str(home), "TMPDIR": str(tmp_path),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", str(Path.home() / ".cache")),
    }  # fmt: skip
    subprocess.run(["bash", "-euc", certificate], env=environment, check=True, capture_output=True)
    key = home / ".config" / "dask" / "tls" / "key.pem"
    assert (stat.S_IMODE(key.stat().st_mode), stat.S_IMODE(key.parent.stat().st_mode)) == (0o600, 0o700)
    ask = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    stranger = ask | {"env": environment | {"HOME": str(tmp_path)}}
    with started(scheduler, environment, tmp_path / "scheduler.log") as head:
        until(lambda: ("127.0.0.1", int(port)) in listening(in_group(head.pid)))
        with started(workers, environment, tmp_path / "workers.log") as hands:
            refused = subprocess.run(["bash", "-c", run.replace("run ", "run --out foreign ", 1)], **stranger)
            assert refused.returncode == 2, refused.stderr
            assert "certificates in dask's configuration" in refused.stderr
            done = subprocess.run(["bash", "-c", run.replace("run ", "run --out out --no-report ", 1)], **ask)
            assert done.returncode == 0, done.stderr
            opened = {*listening(in_group(head.pid)), *listening(in_group(hands.pid))}
            report = subprocess.run(["bash", "-c", f"stickslip report out {run[run.index('--scheduler') :]}"], **ask)
            assert report.returncode == 0, report.stderr
    obey_the_certificate = re.findall(r"Start worker at: +tls://\S+:(\d+)", (tmp_path / "workers.log").read_text())
    assert {str(place) for host, place in opened if host != "127.0.0.1"} == {*obey_the_certificate}
    assert len(obey_the_certificate) == 2
    assert "expected workers" not in done.stderr  # warnings
    assert shards(tmp_path / "out") == reference
    assert not (tmp_path / "foreign").exists()
