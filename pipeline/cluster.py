"""The workers of a run: of this machine, or of a cluster that is there already."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import tempfile
from collections.abc import Iterator
from multiprocessing import resource_tracker

import dask
from distributed import Client, LocalCluster
from distributed.utils import LoopRunner, silence_logging_cmgr

from pipeline.child import ONE_THREAD, environment_kept
from pipeline.errors import ScheduleError
from pipeline.interrupt import unbroken

log = logging.getLogger(__name__)

#: Seconds to wait for a scheduler at a given address.
CONNECT_TIMEOUT = 10.0

_LOCAL_CLUSTER = {
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,
    # whose worker dies is run in a process of its own next: no second chance to take others along
    "distributed.scheduler.allowed-failures": 0,
    # dask drops a worker for good that is being restarted just this long after it died; with it went the run
    "distributed.deploy.lost-worker-timeout": "1000 days",
    # each samples Python's stacks, or measures the delay of a loop, many times a second, and disturbs who computes
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}


@contextlib.contextmanager
def connect(workers: int, scheduler: str | None) -> Iterator[Client]:
    """A client of the cluster at an address, or of a local one that lives as long as the with-block."""
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:  # refused, timed out, no address
            raise ScheduleError(
                f"scheduler: expected the address of a running dask scheduler, got {scheduler!r} ({error}); "
                f"start one with `dask scheduler`, or leave the address out to run on this machine"
            ) from error
        with client:
            _look_at(client)  # before all handlers fall silent
            with silence_logging_cmgr(logging.CRITICAL), client:  # what matters reaches the caller as an error
                yield client
        return
    # around all of it: a cluster in the middle of closing still has connections to complain of
    with silence_logging_cmgr(logging.CRITICAL), _one_thread(), contextlib.ExitStack() as opened:
        with unbroken():  # dask leaves a cluster that is half built, or half closed, to itself
            loop = _deaf_loop()
            opened.callback(loop.stop)
            cluster = _local_cluster(workers, loop)
            client = Client(cluster, set_as_default=False)
            opened.callback(_close, client, cluster)
            opened.callback(_kill, cluster)
        yield client


def _look_at(client: Client) -> None:
    """Warn of workers of a cluster, as far as they are there, that are slow or whose numbers may differ."""
    several = [address for address, count in client.nthreads().items() if count > 1]
    if several:
        log.warning(
            "expected workers of one thread each, got several in %d of them, %s first: they take turns in Python, "
            "and are slower than as many processes; start them with `--nthreads 1 --nworkers N`",
            len(several),
            several[0],
        )
    threads = client.run(_threads_of_libraries, on_error="ignore") or {}
    unset = [address for address, counts in threads.items() if not counts & {"1"}]
    if unset:
        log.warning(
            "expected workers whose libraries have one thread each, got %d that do not say so, %s first: last digits "
            "may differ from those of other workers; start them with OMP_NUM_THREADS=1 in their environment",
            len(unset),
            unset[0],
        )


def _threads_of_libraries() -> set[str]:
    return {value for name in ONE_THREAD if (value := os.environ.get(name)) is not None}


def _close(client: Client, cluster: LocalCluster) -> None:
    with unbroken():
        client.close()
        cluster.close()


def _kill(cluster: LocalCluster) -> None:
    """End the workers, idle or in the middle of what nobody waits for any more: asked to, they take seconds."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        with contextlib.suppress(ProcessLookupError, TypeError):  # TypeError: it has no process just now
            os.kill(nanny.pid, signal.SIGKILL)


def _deaf_loop() -> LoopRunner:
    """Dask's thread, and with it the workers that it starts, deaf to Ctrl-C and SIGTERM.

    Both may reach every process of a group: the driver alone answers them, and ends its workers.
    """
    resource_tracker.ensure_running()  # it would open the ears of the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        loop = LoopRunner()
        loop.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return loop


def _local_cluster(workers: int, loop: LoopRunner) -> LocalCluster:
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            loop=loop.loop,
            dashboard_address=":0",  # any free port: two runs at once do not quarrel over one
            silence_logs=logging.CRITICAL,  # what matters reaches the caller as an error
        )
    except (OSError, RuntimeError) as error:
        raise ScheduleError(
            f"expected {workers} workers on this machine, could not start them ({error}); see that "
            f"{dask.config.get('temporary-directory') or tempfile.gettempdir()} can be written, then run the same "
            f'scene again; in a script, which every worker loads, call run_scene under if __name__ == "__main__":'
        ) from error


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let workers started in the with-block load their libraries with one thread; restore this process's own."""
    with environment_kept(), dask.config.set(_LOCAL_CLUSTER):  # dask sets the variables here, for workers to inherit
        yield
