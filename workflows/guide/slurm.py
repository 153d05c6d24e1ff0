"""Run a scene on a Slurm cluster: ``python slurm.py SCENE --out DIR --workers 64``; see cluster.md beside this file.

Run it where jobs may be submitted: on a login node, or in a small job of its own that lasts as long as the run. It
asks Slurm for jobs of workers, hands them the scene, and replaces jobs whose time is over. Ended by Ctrl-C or
SIGTERM, it cancels its jobs and leaves a dataset that the same command resumes.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed import Client, Security, SpecCluster
from distributed.core import Status

from stickslip.pipeline import (
    Interrupted,
    SceneError,
    ScheduleError,
    StoreError,
    interruptible,
    run_ensemble,
)
from stickslip.pipeline.errors import command
from stickslip.pipeline.machine.signals import unbroken
from stickslip.pipeline.running.cluster import QuietScheduler, QuietWorker, local
from stickslip.workflows.asking import Asking
from stickslip.workflows.commands.report import write_report
from stickslip.workflows.progress import Watch
from stickslip.workflows.scenes import find, load

#: Seconds that a worker leaves before its job ends, to hand over what it holds, and by how much more or less some do:
#: workers that started together are not all replaced at once. In short jobs, at most these parts of their time.
MARGIN, STAGGER = (300, 1 / 4), (240, 1 / 8)
#: Seconds until a job that was refused is submitted again.
RETRY = 60.0


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    found = argparse.ArgumentParser(description="Run a scene on a Slurm cluster, or go on with it.")
    found.add_argument("scene", metavar="SCENE", help="a scene file, or the name of one that ships")
    found.add_argument("--out", required=True, metavar="DIR", help="directory of the dataset, or its address")
    found.add_argument("--workers", type=int, default=64, metavar="N", help="processes in all (default: 64)")
    found.add_argument("--per-job", type=int, default=16, metavar="N", help="processes in one job (default: 16)")
    found.add_argument("--memory", type=float, default=2.0, metavar="GB", help="of each process (default: 2)")
    found.add_argument("--minutes", type=int, default=120, help="time limit of a job (default: 120)")
    found.add_argument("--queue", metavar="NAME", help="Slurm's partition")
    found.add_argument("--account", metavar="NAME", help="whom Slurm charges")
    found.add_argument("--report", action="store_true", help="have the workers look at the runs for the report too")
    found.add_argument("--local", action="store_true", help="processes of this machine instead, to try the rest")
    return found


def slurm_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Settings of dask-jobqueue: jobs of single-threaded processes that leave before their time is over."""
    prologue = [f"export {name}_NUM_THREADS=1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")]
    # of its own: workers look for modules there, and the shared one belongs to whoever came first
    prologue += ["export DASK_TEMPORARY_DIRECTORY=$(mktemp -d)", "trap 'rm -rf \"$DASK_TEMPORARY_DIRECTORY\"' EXIT"]
    hours, minutes = divmod(arguments.minutes, 60)
    margin, stagger = (min(most, int(part * 60 * arguments.minutes)) for most, part in (MARGIN, STAGGER))
    lifetime = 60 * arguments.minutes - margin - stagger
    how_long = ["--lifetime", f"{lifetime}s", "--lifetime-stagger", f"{stagger}s"]
    no_pages = ["--no-dashboard", "--worker-class", f"{QuietWorker.__module__}.{QuietWorker.__qualname__}"]
    return {
        "job_name": "stickslip",
        "cores": arguments.per_job,
        "processes": arguments.per_job,
        "memory": f"{arguments.memory * arguments.per_job:g}GB",
        "walltime": f"{hours:02d}:{minutes:02d}:00",
        "queue": arguments.queue,
        "account": arguments.account,
        "job_script_prologue": prologue,
        "worker_extra_args": [*how_long, *no_pages],
        # others use these machines: whoever lacks the run's certificate is refused. Workers find theirs in files that
        # only their owner can read, in the directory in which jobs are submitted and begin
        "security": Security.temporary(),
        "shared_temp_directory": os.getcwd(),
        "scheduler_cls": QuietScheduler,
    }


@contextlib.contextmanager
def start(arguments: argparse.Namespace) -> Iterator[Client]:
    """A client of a cluster that keeps this number of workers, as far as it gets them, during the with-block."""
    if arguments.local:
        with local(arguments.workers) as client:
            yield client
        return
    from dask_jobqueue.slurm import SLURMCluster

    with contextlib.ExitStack() as opened:
        # of its own, as above: this process, which has the scheduler, looks for modules there too
        own = opened.enter_context(tempfile.TemporaryDirectory(prefix="stickslip-", ignore_cleanup_errors=True))
        opened.enter_context(dask.config.set({"temporary-directory": own}))
        with unbroken():  # a cluster that is half built, or half closed, would leave its jobs behind
            cluster = replacing(SLURMCluster)(**slurm_settings(arguments))
            opened.callback(_close, cluster)
        # not `scale`: what is adapted is also replaced, when a job's time is over or its node fails
        n_jobs = -(-arguments.workers // arguments.per_job)
        cluster.adapt(minimum_jobs=n_jobs, maximum_jobs=n_jobs)
        client = opened.enter_context(Client(cluster, set_as_default=False))
        _wait(client, cluster, arguments.workers)
        yield client


def _wait(client: Client, cluster: Any, workers: int) -> None:
    """Until there is a worker; SystemExit if Slurm refuses the first jobs, as it will refuse others."""
    print(f"dask    waiting for the first of {workers} workers")
    while True:
        with contextlib.suppress(TimeoutError):
            client.wait_for_workers(1, timeout=2)
            return
        if cluster.refused and not cluster.n_accepted:
            sys.exit(f"slurm.py: Slurm takes no job: {cluster.refused}")


def replacing(kind: type[SpecCluster]) -> type[SpecCluster]:
    """A kind of cluster that submits another job once the last worker of one has left.

    Dask's own looks for a job by the name of the worker. Where jobs have several, each has a name of its own, as
    SLURMCluster-1-0 of SLURMCluster-1, and no job would ever be missed.
    """

    class Replacing(kind):  # type: ignore[valid-type, misc]
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
            self.refused = (words.partition("stderr:")[2] or words).strip()
            is_due = self._next is None or self._next.when() <= asyncio.get_running_loop().time()
            if is_due and (self.n_accepted or self.workers):
                print(f"slurm.py: a job was refused and is submitted again in {RETRY:g} s: {self.refused}",
                      file=sys.stderr)  # fmt: skip
                self._next = asyncio.get_running_loop().call_later(RETRY, self._correct_state)

        def _update_worker_status(self, op: str, message: Any) -> None:
            if op != "remove":
                super()._update_worker_status(op, message)
                return
            left = self.scheduler_info["workers"].pop(message, None)
            if left is not None:  # else it left before it was seen to come
                delay = parse_timedelta(dask.config.get("distributed.deploy.lost-worker-timeout"))
                asyncio.get_running_loop().call_later(delay, self._forget, self._job_of(left))

        def _forget(self, job: str) -> None:
            """Give up a job without workers: one is then missing, and is submitted."""
            if job in self.workers and job not in map(self._job_of, self.scheduler_info["workers"].values()):
                self._futures.add(asyncio.ensure_future(self.workers.pop(job).close()))

        def _job_of(self, worker: dict[str, Any]) -> str:
            name = str(worker["name"])
            return name if name in self.workers else name.rpartition("-")[0]

    return Replacing


def _close(cluster: SpecCluster) -> None:
    try:
        with unbroken():
            cluster.close()
    except Exception as error:  # noqa: BLE001  dask's; what was run stands
        print(f"slurm.py: closing the cluster failed ({error!r}); see with squeue that no job is left",
              file=sys.stderr)  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Run; returns the exit code: 0 done, 1 not done or failed members, 130 or 143 interrupted."""
    arguments = parser().parse_args(argv)
    try:
        scene = load(find(arguments.scene))
        if not arguments.local:
            import_module("dask_jobqueue.slurm")  # it sets a handler of SIGINT, which ours must replace
        with interruptible(), start(arguments) as client, Watch(arguments.out) as watch:
            status = run_ensemble(scene, arguments.out, scheduler=client, on_progress=watch)
            if arguments.report:
                with Asking(scheduler=client) as asking:
                    write_report(arguments.out, asking, watch)
    except Interrupted as interrupt:
        print("interrupted; finished work is kept: rerun the same command to resume", file=sys.stderr)
        return interrupt.exit_code
    except (SceneError, ScheduleError, StoreError) as error:
        sys.exit(f"slurm.py: {error}")
    n_failed = sum(status.failures.values())
    print(f"data    {arguments.out}: {status.n_done} of {status.n_members} members, {n_failed} failed")
    if not arguments.report:
        print(f"report  not written; write it with: {command('report', arguments.out)}")
    return 1 if status.failures else 0


if __name__ == "__main__":
    sys.exit(main())
