"""The workers of a run: of this machine, or of a cluster that is there already.

Dask runs whatever code it is sent. So a cluster started here listens on this machine alone and obeys only a
certificate that is made for the one run and never leaves its processes; its files lie where no other user writes.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import resource
import signal
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

import dask
import distributed
from distributed import Client, Nanny, Scheduler, Security, SpecCluster, Worker
from distributed.comm import get_address_host_port
from distributed.core import Server, Status, rpc
from distributed.gc import GCDiagnosis
from distributed.process import AsyncProcess
from distributed.utils import LoopRunner, silence_logging_cmgr

from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.errors import AddressError, ScheduleError, remedy
from stickslip.pipeline.machine import processes
from stickslip.pipeline.machine.processes import ONE_THREAD, ErrorStream, environment_kept
from stickslip.pipeline.machine.scratch import scratch
from stickslip.pipeline.machine.signals import blocked, unbroken
from stickslip.sim.kernels.cache import is_ours, others_write

log = logging.getLogger(__name__)

#: Where tasks are computed: by the workers of a scheduler at an address, by those of a client, or of one that a
#: function gives once there is something to compute; or by workers of this machine (None).
Scheduling = str | Client | Callable[[], Client] | None

#: Seconds to wait for a scheduler at a given address.
CONNECT_TIMEOUT = 20.0

#: Seconds that workers of this machine have to start, together and each: on a busy one they take minutes.
_START_TIMEOUT, _START_EACH = 300.0, 3.0

#: Seconds between two looks at workers that start.
_LOOK = 0.05

#: Seconds for processes that start to be there, and be gone once they are killed: less than a signal's grace.
_ENDING = 1.0

#: Bytes of addresses that a process which loads dask, Arrow and SciPy takes, at least.
_LEAST_SPACE = 800_000_000

#: Files that a driver of local workers may open, where the system lets it.
_MOST_FILES = 65_536

_LOCAL_CLUSTER = {
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,
    # a task whose worker dies is run in a process of its own next: here it would take others along
    "distributed.scheduler.allowed-failures": 0,
    # dask drops a worker for good, and the run with it, if it is restarting this long after it died
    "distributed.deploy.lost-worker-timeout": "1000 days",
    # each samples Python's stacks, or measures the delay of a loop, many times a second, and slows the computation
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}


def check_address(address: str) -> None:
    """See that a scheduler answers at an address: with a wrong one `Client` hangs in its destructor.

    Raises `AddressError` if it is no address, or no scheduler answers there within `CONNECT_TIMEOUT`.
    """
    try:
        # a closed port is refused at once here; dask would retry
        socket.create_connection(get_address_host_port(address), CONNECT_TIMEOUT).close()
        with silence_logging_cmgr(logging.CRITICAL):
            identity = LoopRunner().run_sync(_who_is_at, address)
        if "workers" not in identity:
            raise ValueError(f"a {identity['type']} answers there")
    # in turn: refused or silent; no address; no certificate for tls; tcp where dask has to encrypt;
    # the answer of another service, taken for the length of a message
    except (OSError, ValueError, TypeError, RuntimeError, MemoryError) as error:
        why = " ".join(str(_first_of(error)).split()) or f"no answer in {CONNECT_TIMEOUT:.0f} s"
        raise AddressError(
            f"scheduler: expected the address of a running dask scheduler, tcp://HOST:PORT, or tls://HOST:PORT with "
            f"certificates in dask's configuration, distributed.comm.tls, got {address!r} ({why}); start one with "
            f"`dask scheduler`, or leave the address out to run on this machine"
        ) from error


def _first_of(error: BaseException) -> BaseException:
    """The error that others were raised from: dask's own hide what TLS says of a certificate."""
    while isinstance(error.__cause__, OSError):
        error = error.__cause__
    return error


async def _who_is_at(address: str) -> dict[str, Any]:
    security = Security().get_connection_args("client")
    async with rpc(address, timeout=CONNECT_TIMEOUT, connection_args=security) as server:
        return await asyncio.wait_for(server.identity(), CONNECT_TIMEOUT)


@contextlib.contextmanager
def connect(workers: int, scheduler: Scheduling, dashboard: bool = False) -> Iterator[Client]:
    """A client of a running cluster, or of local workers that live as long as the with-block."""
    if callable(scheduler):
        scheduler = scheduler()
    if scheduler is None:
        with local(workers, dashboard) as client:
            yield client
    elif isinstance(scheduler, Client):
        _look_at(scheduler)
        yield scheduler
    else:
        with Client(scheduler, timeout=CONNECT_TIMEOUT, security=Security(), set_as_default=False) as client:
            _look_at(client)  # before all handlers fall silent
            with silence_logging_cmgr(logging.CRITICAL), client:  # what matters reaches the caller as an error
                yield client


@contextlib.contextmanager
def local(workers: int, dashboard: bool = False) -> Iterator[Client]:
    """A client of new workers on this machine, which live as long as the with-block.

    `dashboard`: whether to serve dask's, which any user of this machine may read.
    """
    # around all of it: a cluster in the middle of closing still has connections to complain of
    with silence_logging_cmgr(logging.CRITICAL), environment_kept(), contextlib.ExitStack() as opened:
        errors = processes.forks.errors if processes.forks is not None else opened.enter_context(ErrorStream())
        with unbroken():
            loop = LoopRunner()
            with blocked():
                loop.start()
            opened.callback(loop.stop)
            opened.enter_context(_files_for(workers))
            _check_address_space()
            _check_loopback()
            clusters: list[SpecCluster] = []
            starting = _start(workers, dashboard, loop, opened, clusters)
            opened.callback(_abandon, clusters, loop)
        with errors.instead():
            cluster = _wait_for(starting, loop, workers, errors)
        errors.pass_on()
        with unbroken():
            client = Client(cluster, set_as_default=False)
            opened.callback(_close, client, cluster)
        yield client


def _check_address_space() -> None:
    """Refuse a limit with which libraries fail one by one as they are loaded, each in its own words, or hang.

    Raises `ScheduleError`.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_SPACE:
        raise ScheduleError(
            f"workers: expected a limit of {_LEAST_SPACE / 1e9:.2g} GB or more of memory for each process, got"
            f" {limit / 1e9:.2g} GB (`ulimit -v`); raise it, or take a larger machine"
        )


def _check_loopback() -> None:
    """Refuse a machine whose own address answers nobody: dask would wait for minutes.

    Raises `ScheduleError`.
    """
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            socket.create_connection(server.getsockname(), _ENDING).close()
    except OSError as error:
        raise ScheduleError(
            f"workers: expected connections within this machine, at 127.0.0.1, got none ({error}); bring its loopback"
            " up, as by `ip link set lo up`"
        ) from error


@contextlib.contextmanager
def _files_for(workers: int) -> Iterator[None]:
    """Within: this process may open as many files as workers take, 23 and 12 for each; without them dask hangs.

    Raises `ScheduleError` if it may not.
    """
    needed = 32 + 16 * workers
    limit = max(needed, _MOST_FILES)  # others on this machine may open connections too, which are then refused
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < needed:
        raise ScheduleError(
            f"workers: expected a limit of {needed} or more open files, for {workers} of them, got {hard} "
            f"(`ulimit -n`); raise it, or use fewer workers"
        )
    raised = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft if soft == resource.RLIM_INFINITY else max(soft, raised), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def _look_at(client: Client) -> None:
    """Refuse workers that are there and run another version; warn of a setup that is slow or that others may enter.

    Raises `ScheduleError`.
    """
    several = [address for address, count in client.nthreads().items() if count > 1]
    if several:
        log.warning(
            "expected workers of one thread each, got several in %d of them, %s first: they take turns in Python, "
            "and are slower than as many processes; start them with `--nthreads 1 --nworkers N`",
            len(several),
            several[0],
        )
    # by names that every Python knows: a worker that cannot load a function of ours ends, and only its log says why
    for address, version in (client.run(eval, _PROGRAM, on_error="return") or {}).items():
        if version != program():
            raise ScheduleError(
                f"expected workers with this version of the program ({program()}), got {address} with {version!r}; "
                "install the same there, then try again"
            )
    setups: dict[str, tuple[bool, str]] = client.run(_setup, on_error="ignore") or {}
    unset = [address for address, (is_set, _) in setups.items() if not is_set]
    if unset:
        log.warning(
            "expected workers whose libraries have one thread each, got %d that do not say so, %s first: last digits "
            "may differ from those of other workers; start them with OMP_NUM_THREADS=1 in their environment",
            len(unset),
            unset[0],
        )
    open_to_others = [(shared, address) for address, (_, shared) in setups.items() if shared]
    if open_to_others:
        log.warning(
            "expected workers in a directory in which nobody else may write, as they run what lies there, got %s of "
            "%s; start them with DASK_TEMPORARY_DIRECTORY=$(mktemp -d) in their environment",
            *open_to_others[0],
        )


#: What tells the version of a worker's program, as code of its own.
_PROGRAM = "__import__('importlib').import_module('stickslip.pipeline.dataset.program').program()"


def _setup(dask_worker: Worker) -> tuple[bool, str]:
    """Whether the libraries of a worker are told to have one thread; and its directory if others may write there."""
    directory = Path(dask_worker.local_directory)
    is_shared = any(
        not is_ours(facts) or others_write(facts) for facts in (directory.stat(), directory.parent.stat())
    )
    return any(os.environ.get(name) == "1" for name in ONE_THREAD), str(directory.parent) if is_shared else ""


def _wait_for(starting: Future[SpecCluster], loop: LoopRunner, workers: int, errors: ErrorStream) -> SpecCluster:
    """The cluster, once its workers have started, which may take no longer than a limit.

    Raises `ScheduleError` if one cannot, with the last that it said.
    """
    limit = _START_TIMEOUT + _START_EACH * workers
    end = time.monotonic() + limit
    why = ""
    while not why:
        if starting in wait([starting], _LOOK).done:
            error = starting.exception()
            if error is None:
                return starting.result()
            why = str(error) or repr(error)
        elif processes.forks is not None and processes.forks.has_died:
            why = "the process that they are forked from has died"
        elif not loop.loop.asyncio_loop.is_running():
            why = "dask's loop has ended"
        elif time.monotonic() > end:
            why = f"they did not within {limit:.0f} s"
    raise _no_start(workers, why, errors.last_lines())


def _no_start(workers: int, why: str, last_lines: Sequence[str]) -> ScheduleError:
    is_script, limit = processes.forks is None, resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        why += f"; each process may have {limit / 1e9:.2g} GB, `ulimit -v`"
    lines = [
        f"expected {workers} workers on this machine, could not start them ({why})",
        *(f"    {line}" for line in last_lines),
        "remove what ends them, then rerun the scene"
        + '; in a script, which every worker loads, run it under if __name__ == "__main__":' * is_script,
    ]
    return ScheduleError("\n".join(lines) if last_lines else "; ".join(lines))


def _close(client: Client, cluster: SpecCluster) -> None:
    with unbroken():  # dask leaves a cluster that is half closed to itself
        _kill(cluster)
        client.close()
        cluster.close()


def _abandon(clusters: list[SpecCluster], loop: LoopRunner) -> None:
    """Wait no longer for a cluster to start; nothing of it starts any more."""
    loop.stop()  # it would go on with dask's own configuration, in a directory that nobody removes
    for cluster in clusters:
        if cluster.status == Status.closed:
            continue
        cluster.shutdown_on_close = False  # dask would wait for it as this process ends
        _end([nanny.process.process for nanny in cluster._created if nanny.process and nanny.process.process])
        if cluster.scheduler is not None and cluster.scheduler._workdir is not None:
            cluster.scheduler._workdir.release()  # at the end of the process dask would complain that it is gone


def _end(workers: Sequence[AsyncProcess]) -> None:
    """Kill workers' processes, even those that a thread is just starting."""
    end = time.monotonic() + _ENDING
    children = [worker._process for worker in workers]
    for worker in workers:
        worker.close()
        # what it would be forked from may be loading still, and is ended next
        worker._watch_message_thread.join(max(0.0, end - time.monotonic()))
    started = [process for process in children if process is not None and process.pid is not None]
    for process in started:
        process.kill()
    for process in started:
        process.join(max(0.0, end - time.monotonic()))  # dask would speak of one that lives


def _kill(cluster: SpecCluster) -> None:
    """Kill the workers, whatever they are doing: an orderly end takes seconds."""
    for nanny in cluster._created:
        if nanny.status in (Status.closing, Status.closed):
            continue
        nanny.close_gracefully()  # it is not to start another
        with contextlib.suppress(ProcessLookupError, TypeError):  # TypeError: it has no process just now
            os.kill(nanny.pid, signal.SIGKILL)


class _NoDiagnosis(GCDiagnosis):
    """Looks at no garbage collection: dask's hook fails, with a traceback, if one goes on as it is set."""

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False


class _Quiet(Server):
    """A server of dask without its web server, which shows workers and logs to anybody who asks."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        # where bokeh is installed, a scheduler would hang its pages into the server that is not there
        super().__init__(*arguments, **settings | {"dashboard": False})  # type: ignore[no-untyped-call]

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open nothing."""

    async def start_unsafe(self) -> Any:
        """Start as dask does, but for its diagnosis of garbage collections."""
        if not distributed.gc._gc_diagnosis.enabled:  # else a cluster of the user's own has begun it
            distributed.gc._gc_diagnosis = _NoDiagnosis()  # type: ignore[no-untyped-call]
        return await super().start_unsafe()  # type: ignore[no-untyped-call]


class QuietScheduler(_Quiet, Scheduler):
    """A scheduler that opens no page."""


class QuietWorker(_Quiet, Worker):
    """A worker that opens no page."""


def _start(
    workers: int, dashboard: bool, loop: LoopRunner, opened: contextlib.ExitStack, clusters: list[SpecCluster]
) -> Future[SpecCluster]:
    """Have the loop start a cluster of this machine, which is in `clusters` from its beginning on."""
    where = dask.config.get("temporary-directory") or tempfile.gettempdir()
    # if workers are forked: `forked_workers` has said from what, and dask would load pandas here too
    distributed.utils._forkserver_preload_set = True
    try:
        # dask imports from its directory, and uses one that exists already, even another user's
        directory = opened.enter_context(scratch(where))
    except OSError as error:
        raise ScheduleError(
            f"expected a directory in which workers can write, got {where} ({error}); {remedy(error)}, or set TMPDIR"
        ) from error
    settings = {**_LOCAL_CLUSTER, "temporary-directory": directory.pinned}
    settings["distributed.worker.multiprocessing-method"] = "spawn" if processes.forks is None else "forkserver"
    opened.enter_context(dask.config.set(settings))  # it sets variables here too, for workers to inherit
    options = {"host": "127.0.0.1", "port": 0, "protocol": "tls://", "security": Security.temporary()}
    options |= {"dashboard": False}
    pages = {"dashboard": True, "dashboard_address": "127.0.0.1:0"} if dashboard else {}
    worker = {
        "cls": Nanny,
        "options": {
            **options,
            "worker_class": QuietWorker,
            "nthreads": 1,
            "memory_limit": 1.0 / workers,
            "silence_logs": logging.CRITICAL,  # what matters reaches the caller as an error
        },
    }

    async def start() -> SpecCluster:
        cluster = SpecCluster(
            scheduler={"cls": Scheduler if dashboard else QuietScheduler, "options": options | pages},
            workers=dict.fromkeys(range(workers), worker),
            worker=worker,
            asynchronous=True,
            loop=loop.loop,
            security=options["security"],
            silence_logs=logging.CRITICAL,
        )

        clusters.append(cluster)
        return await cluster

    return asyncio.run_coroutine_threadsafe(start(), loop.loop.asyncio_loop)
