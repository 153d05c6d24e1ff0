"""Workers as jobs of Slurm: asked for once there is work, replaced when their time is over, and cancelled at the end.

The scheduler is in this process. It and the workers obey only a certificate that is made for the one run, and open no
page. Workers find the certificate in files that only their owner can read, in a directory of its own in the one in
which the run was started, or in the home directory where others may write that one.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import os
import re
import shlex
import signal
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed import Client, Security, SpecCluster
from distributed.core import Status

from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.machine.processes import ONE_THREAD
from stickslip.pipeline.machine.scratch import scratch
from stickslip.pipeline.machine.signals import unbroken
from stickslip.pipeline.running.cluster import QuietScheduler, QuietWorker
from stickslip.sim.kernels.cache import is_ours, others_write

log = logging.getLogger(__name__)

#: Options of a job that are not given: sixteen processes at most, two hours, 2 GiB for each process.
PROCESSES, TIME, MEMORY = 16, "120", "2G"

#: Seconds that a worker leaves before its job ends, to hand over what it holds, and by how much more or less some do:
#: workers that started together are not all replaced at once. In short jobs, at most these parts of their time.
MARGIN, STAGGER = (300, 1 / 4), (240, 1 / 8)

#: Seconds until a job that was refused is submitted again.
RETRY = 60.0

#: Where the unit of Slurm's memory is left out, it is M; all are powers of 1024.
_MEMORY = re.compile(r"(\d+)([KMGT])?B?", re.IGNORECASE)
#: Slurm's forms of a time: minutes, minutes:seconds, hours:minutes:seconds, days-hours, and so on.
_TIME = re.compile(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?")


#: Who shows dask's certificate.
_ROLES = ("client", "scheduler", "worker")


@contextlib.contextmanager
def jobs(workers: int, settings: dict[str, Any]) -> Iterator[Callable[[], Client]]:
    """Jobs of Slurm for the time of a with-block: a function that submits them, and returns their workers' client.

    Called again, it returns the same client; if it is not called, no job is submitted. Raises `ScheduleError` if
    dask-jobqueue is not installed.

    Parameters
    ----------
    workers : int
        Processes in all, of one thread each.
    settings : dict
        As of `job_settings`.
    """
    kind, n_jobs = cluster_of_jobs(), -(-workers // settings["processes"])
    with contextlib.ExitStack() as opened:
        yield functools.cache(lambda: _start(kind, settings, n_jobs, opened))


def job_settings(workers: int, options: Sequence[str]) -> dict[str, Any]:
    """Settings of dask-jobqueue: jobs of single-threaded processes that leave before their time is over.

    Raises `ValueError` if an option cannot be read.

    Parameters
    ----------
    workers : int
        Processes in all.
    options : sequence of str
        Options of `sbatch` for each job, as ``partition=long`` or ``exclusive``. Those that are not given are
        `PROCESSES` (cpus-per-task, one process each), `TIME` (time) and `MEMORY` (mem-per-cpu).
    """
    options_of_job = {"cpus-per-task": str(min(PROCESSES, workers)), "time": TIME, "mem-per-cpu": MEMORY}
    for option in options:
        name, is_valued, value = option.lstrip("-").partition("=")
        if not re.fullmatch(r"[a-z][a-z0-9-]+", name) or not value.isprintable() or (is_valued and not value):
            raise ValueError(f"expected a long option of sbatch, such as partition=long, got {option!r}")
        options_of_job[name] = value
        if name == "mem":
            options_of_job.pop("mem-per-cpu", None)
    processes = options_of_job["cpus-per-task"]
    if not processes.isdecimal() or int(processes) < 1:
        raise ValueError(f"cpus-per-task: expected the number of processes of a job, got {processes!r}")
    n_processes = int(processes)
    memory = (
        _bytes(options_of_job["mem"])
        if "mem" in options_of_job
        else n_processes * _bytes(options_of_job["mem-per-cpu"])
    )
    seconds = _seconds(options_of_job["time"])
    margin, stagger = (min(limit, int(share * seconds)) for limit, share in (MARGIN, STAGGER))
    how_long = ["--lifetime", f"{seconds - margin - stagger}s", "--lifetime-stagger", f"{stagger}s"]
    no_pages = ["--no-dashboard", "--worker-class", f"{QuietWorker.__module__}.{QuietWorker.__qualname__}"]
    prologue = [f"export {name}={value}" for name, value in ONE_THREAD.items()]
    prologue += ["export PYTHONSAFEPATH=1"]  # `python -m` runs whatever module lies where the job starts
    # of its own: workers look for modules there, and the shared one belongs to whoever came first
    prologue += ["export DASK_TEMPORARY_DIRECTORY=$(mktemp -d)", "trap 'rm -rf \"$DASK_TEMPORARY_DIRECTORY\"' EXIT"]
    prologue += ["trap : TERM"]  # which all of a job are sent: first end the workers, which still use it
    return {
        "job_name": "stickslip",
        "cores": n_processes,
        "processes": n_processes,
        "memory": str(memory),
        # each is said below, with the others
        "job_directives_skip": ["--mem=", "--cpus-per-task=", "-t "],
        "job_extra_directives": [
            f"--{name}={shlex.quote(value)}" if value else f"--{name}" for name, value in options_of_job.items()
        ],
        "job_script_prologue": prologue,
        "worker_extra_args": [*how_long, *no_pages],
        "scheduler_cls": QuietScheduler,
    }


def _bytes(memory: str) -> int:
    match = _MEMORY.fullmatch(memory)
    if match is None:
        raise ValueError(f"mem, mem-per-cpu: expected a size such as 2G, got {memory!r}")
    return int(match[1]) * 1024 ** ("KMGT".index((match[2] or "M").upper()) + 1)


def _seconds(time: str) -> int:
    match = _TIME.fullmatch(time)
    if match is None or not any(map(int, filter(None, match.groups()))):
        raise ValueError(f"time: expected a limit such as 120, in minutes, 2:00:00 or 1-12, got {time!r}")
    days, *numbers = (int(number or 0) for number in match.groups())
    if match[1] is None and match[4] is None:  # minutes come first
        numbers = [0, *numbers[:2]]
    return sum(unit * number for unit, number in zip((86_400, 3600, 60, 1), (days, *numbers), strict=True))


def _start(kind: type[Any], settings: dict[str, Any], n_jobs: int, opened: contextlib.ExitStack) -> Client:
    # of its own, as above: this process, which has the scheduler, looks for modules there too
    directory = opened.enter_context(scratch())
    opened.enter_context(dask.config.set({"temporary-directory": directory.pinned}))
    security = certificate(Path(opened.enter_context(scratch(str(_shared()))).path))
    with unbroken():  # a cluster that is half built, or half closed, would leave its jobs behind
        cluster = kind(**settings, security=security)
        opened.callback(_close, cluster)
    # not `scale`: what is adapted is also replaced, when a job's time is over or its node fails
    cluster.adapt(minimum_jobs=n_jobs, maximum_jobs=n_jobs)
    return opened.enter_context(Client(cluster, set_as_default=False))


def _shared() -> Path:
    """A directory that jobs see too, in which nobody else can exchange one of this user's for another."""
    here = Path.cwd()
    for folder in map(os.stat, (here, *here.parents)):
        if not is_ours(folder) or (others_write(folder) and not folder.st_mode & stat.S_ISVTX):
            return Path.home()
    return here


def certificate(directory: Path) -> Security:
    """A certificate for one run, in files: what dask-jobqueue writes of it, a driver that is killed would leave."""
    content = Security.temporary()
    files = {"cert": directory / "cert.pem", "key": directory / "key.pem"}
    for part, text in (("cert", content.tls_worker_cert), ("key", content.tls_worker_key)):
        files[part].touch(0o600)
        files[part].write_text(text)
    of_roles = {f"tls_{role}_{part}": str(file) for part, file in files.items() for role in _ROLES}
    return Security(require_encryption=True, tls_ca_file=str(files["cert"]), **of_roles)


def cluster_of_jobs() -> type[Any]:
    """dask-jobqueue's cluster for Slurm, as `Jobs`."""
    answer = signal.getsignal(signal.SIGINT)
    try:
        from dask_jobqueue.slurm import SLURMCluster  # it sets a handler of SIGINT
    except ImportError as error:
        raise ScheduleError(
            'expected the package dask-jobqueue for jobs of Slurm, got none; run: pip install "stickslip[cluster]"'
        ) from error
    with contextlib.suppress(ValueError):  # not in the main thread, where it could not set one either
        signal.signal(signal.SIGINT, answer)
    return type("JobsOfSlurm", (Jobs, SLURMCluster), {})


class Jobs(SpecCluster):
    """A cluster of jobs that submits another once the last worker of one has left.

    Dask's own looks for a job by the name of the worker. Where jobs have several, each has a name of its own, as
    SLURMCluster-1-0 of SLURMCluster-1, and no job would ever be missed.
    """

    #: what Slurm said last of a job that it refused, and how many it has taken
    refused, n_accepted = "", 0
    _next: asyncio.TimerHandle | None = None

    async def _correct_state_internal(self) -> None:
        """As dask does; but a job that is refused is submitted again later, whereas dask counts it as running."""
        before = {*self.workers}
        try:
            await super()._correct_state_internal()
        except (RuntimeError, OSError) as error:  # of sbatch, or there is none
            self._again(error)
        self.n_accepted += len({*self.workers} - before)

    def _again(self, error: Exception) -> None:
        for name, job in [*self.workers.items()]:
            if job.job_id is None:
                job.status = Status.failed
                del self.workers[name]
        words = str(error)
        self.refused = " ".join((words.partition("stderr:")[2] or words).split())
        is_due = self._next is None or self._next.when() <= asyncio.get_running_loop().time()
        if is_due and (self.n_accepted or self.workers):
            log.warning("a job was refused and is submitted again in %g s: %s", RETRY, self.refused)
            self._next = asyncio.get_running_loop().call_later(RETRY, self._correct_state)

    def _update_worker_status(self, op: str, message: Any) -> None:
        if op != "remove":
            super()._update_worker_status(op, message)  # type: ignore[no-untyped-call]
            return
        worker = self.scheduler_info["workers"].pop(message, None)
        if worker is not None:  # else it left before it was seen to come
            delay = parse_timedelta(dask.config.get("distributed.deploy.lost-worker-timeout"))
            asyncio.get_running_loop().call_later(delay, self._forget, self._job_of(worker))

    def _forget(self, job: str) -> None:
        """Give up a job without workers: one is then missing, and is submitted."""
        if job in self.workers and job not in map(self._job_of, self.scheduler_info["workers"].values()):
            self._futures.add(asyncio.ensure_future(self.workers.pop(job).close()))

    def _job_of(self, worker: dict[str, Any]) -> str:
        name = str(worker["name"])
        return name if name in self.workers else name.rpartition("-")[0]


def _close(cluster: SpecCluster) -> None:
    try:
        with unbroken():
            cluster.close()
    except Exception as error:  # noqa: BLE001  dask's; what was run stands
        log.warning("closing the cluster failed (%r); see with squeue that no job is left", error)
