"""Running a scene: batches on dask workers, results committed one by one as they arrive."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import signal
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.comm import CommClosedError
from distributed.utils import LoopRunner, silence_logging_cmgr

from pipeline.alone import compute_alone
from pipeline.audit import Status, status
from pipeline.interrupt import unbroken
from pipeline.live import Began
from pipeline.members import Member, expand
from pipeline.plan import Task
from pipeline.scene import Scene
from pipeline.shards import Recording, Result, compute, program, row
from pipeline.store import Store

log = logging.getLogger(__name__)

#: Batches in flight for each worker: enough that none waits, few enough to hold and to lose little.
WINDOW = 3

#: Seconds to wait for a scheduler at a given address.
CONNECT_TIMEOUT = 10.0

#: Seconds without a single worker, or without the scheduler, after which a run gives up.
LOST_TIMEOUT = 60.0

#: How often batches are given once more to workers of their own when those die of other causes.
_ATTEMPTS = 3

# One thread each: threaded products in several processes fight for the cores, and threads that share a sum round
# it differently. Libraries read these when they are loaded, so they must be set before.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

_LOCAL_CLUSTER = {
    "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
    # whose worker dies is run in a process of its own next: no second chance to take others along
    "distributed.scheduler.allowed-failures": 0,
    # dask drops a worker for good that is being restarted just this long after it died; with it went the run
    "distributed.deploy.lost-worker-timeout": "1000 days",
}


class ScheduleError(RuntimeError):
    """The run could not be done to its end. What is committed stays; the message says what to do."""


@dataclass(frozen=True)
class Progress:
    """How far a run is; costs in the units of `Member.cost`."""

    n_members: int
    n_done: int
    n_failed: int
    n_shards: int
    n_shards_done: int
    cost: float
    cost_done: float
    cost_resumed: float  #: part of `cost_done` that was there at the start
    elapsed: float  #: seconds since the start
    last_shard: str | None

    @property
    def eta(self) -> float | None:
        """Seconds to go, at the rate so far; None before the first batch of this run."""
        computed = self.cost_done - self.cost_resumed
        return self.elapsed * (self.cost - self.cost_done) / computed if computed > 0 else None


def run_scene(
    scene: Scene,
    source: bytes,
    out: Path,
    workers: int = 2,
    scheduler: str | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
    accept_version: bool = False,
) -> Status:
    """Run a scene into the dataset at `out`, or what is missing of it; the same bytes whatever the workers.

    Parameters
    ----------
    scene : Scene
    source : bytes
        The scene file, kept beside the data.
    out : Path
        Directory of the dataset: absent, empty, or an earlier run of this scene, which is resumed, or of a part of
        it, which is extended.
    workers : int
        Local processes of one thread each; 0 runs in this process, for debugging and small scenes.
    scheduler : str, optional
        Address of a running dask cluster, used instead of local workers. Its workers need this package and
        should have one thread each.
    on_progress : callable, optional
        Called with a `Progress` at the start and after each commit.
    retry_failed : bool
        Whether to run shards with failed members again.
    accept_version : bool
        Whether to go on with a dataset that another version of the program began; numbers may differ.

    Raises
    ------
    ValueError
        If `workers` is negative.
    StoreError
        If the directory cannot be used or written.
    ScheduleError
        If the scheduler cannot be reached or is lost, workers do not come up, or run another version.
    """
    if workers < 0:
        raise ValueError(f"workers: expected a count >= 0, got {workers}; 0 runs in this process")
    start = time.monotonic()
    with Store(Path(out), scene, source, retry_failed, accept_version) as store:
        members = {batch.name: len(batch.members) for batch, _ in store.tasks}
        costs = {batch.name: batch.cost for batch, _ in store.tasks}
        todo = {batch.name for batch, _ in store.todo}
        before = sum(cost for name, cost in costs.items() if name not in todo)

        def report(last_shard: str | None = None) -> None:
            if on_progress is not None:
                on_progress(
                    Progress(
                        n_members=scene.n_members,
                        n_done=sum(count for name, count in members.items() if name not in todo),
                        n_failed=store.n_failed,
                        n_shards=len(members),
                        n_shards_done=len(members) - len(todo),
                        cost=sum(costs.values()),
                        cost_done=sum(cost for name, cost in costs.items() if name not in todo),
                        cost_resumed=before,
                        elapsed=time.monotonic() - start,
                        last_shard=last_shard,
                    )
                )

        report()
        n_before = sum(count for name, count in members.items() if name not in todo)
        store.note(Began(time.time(), n_before, before).line)
        # closed at once if a commit fails or the user interrupts, and the workers with it
        with contextlib.closing(_results(store.todo, workers, scheduler, store.note)) as results:
            for result in results:
                if result.program != program():
                    raise ScheduleError(
                        f"expected workers with this version of the program ({program()}), got {result.program} on "
                        f"{result.host}; install the same there, then run the same scene again"
                    )
                store.commit(result)
                todo.discard(result.name)
                report(result.name)
    return status(out)


def run_member(scene: Scene, member_id: str) -> dict[str, object]:
    """Run one member of a scene in this process, as a failed one's row says to: its row, by column.

    Raises
    ------
    ValueError
        If the scene has no such member.
    """
    for member in expand(scene):
        if member.member_id == member_id:
            return row(member, Recording.of(scene))
    raise ValueError(
        f"member_id: expected a member of the scene, such as {expand(scene)[0].member_id!r}, got {member_id!r}"
    )


def _results(todo: list[Task], workers: int, scheduler: str | None, note: Callable[[str], None]) -> Generator[Result]:
    """The batches' results in the order they come in; `note` is told the address of dask's dashboard."""
    if not todo:
        return
    if workers == 0 and scheduler is None:
        for task in todo:
            yield compute(*task)
        return
    n_workers = min(workers, len(todo))
    with _client(n_workers, scheduler) as client:
        note(f"dashboard {client.dashboard_link}")
        try:
            if scheduler is None and n_workers > 1:
                _compile_once(client, todo)
            lost = yield from _submit(
                client, todo, compute, lambda: WINDOW * max(1, sum(client.nthreads().values())), scheduler
            )
            # dask blames a worker's death on all that waited there: in processes of their own the innocent pass
            for _ in range(_ATTEMPTS):
                lost = yield from _submit(client, lost, compute_alone, lambda: n_workers, scheduler)
        except (CancelledError, CommClosedError, OSError) as error:  # OSError: TimeoutError among them
            raise ScheduleError(
                "expected the scheduler to stay until the end, lost it; start it again, then run the same scene "
                "again: the shards that are done are kept"
            ) from error
    if lost:
        first = lost[0][0].members
        raise ScheduleError(
            f"expected workers to stay alive, got {len(lost)} batches whose workers died {_ATTEMPTS + 1} times, but "
            f"not of their members; the first holds {first[0].member_id} to {first[-1].member_id}; see who kills "
            f"them, then run the same scene again: the shards that are done are kept"
        )


def _submit(
    client: Client,
    todo: list[Task],
    work: Callable[..., Result],
    window: Callable[[], int],
    scheduler: str | None,
) -> Generator[Result, None, list[Task]]:
    """Yield results as they come in, with so many batches in flight; return the batches whose workers died."""
    waiting = iter(todo)
    running = as_completed(loop=client.loop)
    task_of: dict[Future, Task] = {}
    lost: list[Task] = []
    while True:
        # the window is measured anew each time, as clusters grow and shrink
        for task in itertools.islice(waiting, max(0, window() - running.count())):
            future = client.submit(work, *task, pure=False)
            task_of[future] = task
            running.add(future)
        if running.is_empty():
            return lost
        watch = _Watch(client, scheduler)
        _until(running.has_ready, watch)
        future = next(running)
        task = task_of.pop(future)
        try:
            result = _fetch(future, watch)
        except KilledWorker:
            lost.append(task)
        else:
            yield result
        future.release()  # a held result is computed again when its worker dies


class _Watch:
    """Patience while waiting: it ends when for `LOST_TIMEOUT` there is no scheduler, or here no worker."""

    def __init__(self, client: Client, scheduler: str | None) -> None:
        self._client, self._scheduler = client, scheduler
        self._looked = self._alive = time.monotonic()

    def look(self) -> None:
        """Give up if it is time to; a cluster at an address may be without workers for as long as it likes."""
        now = time.monotonic()
        if now - self._looked < 1.0:
            return
        self._looked = now
        is_connected = self._client.status == "running"
        if is_connected and (self._scheduler is not None or self._client.nthreads()):
            self._alive = now
        elif now - self._alive > LOST_TIMEOUT:
            if not is_connected:
                raise CommClosedError
            raise ScheduleError(
                f"expected workers, got none for {LOST_TIMEOUT:.0f} s; see what ends them (memory?), then run the "
                f"same scene again: the shards that are done are kept"
            )


def _until(is_so: Callable[[], bool], watch: _Watch) -> None:
    while not is_so():
        time.sleep(0.005)
        watch.look()


def _fetch(future: Future, watch: _Watch) -> Result:
    """The result of a future that is done; dask computes it again if its worker has died since."""
    while True:
        try:
            return future.result(timeout=LOST_TIMEOUT / 2)
        except TimeoutError:
            watch.look()


def _compile_once(client: Client, todo: list[Task]) -> None:
    """Let one worker a kernel compile it for all, before all need it: seconds each on a cold cache."""
    kinds: dict[object, Member] = {}
    for batch, _ in todo:
        for member in batch.members:
            kinds.setdefault((member.engine, member.coupling, member.ratio, bool(member.thresholds)), member)
    futures = [client.submit(_warm, member, pure=False) for member in kinds.values()]
    _until(lambda: all(future.done() for future in futures), _Watch(client, None))


def _warm(member: Member) -> None:
    row(replace(member, n=min(member.n, 3), t_end=1e-6), Recording("", (), None))


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """A client of the cluster at an address, or of a local one that lives as long as the with-block."""
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:  # refused, timed out, no address
            raise ScheduleError(
                f"scheduler: expected the address of a running dask scheduler, got {scheduler!r} ({error}); "
                f"start one with `dask scheduler`, or leave the address out to run on this machine"
            ) from error
        with silence_logging_cmgr(logging.CRITICAL), client:  # what matters reaches the caller as an error
            yield client
        return
    with _one_thread(), contextlib.ExitStack() as opened:
        with unbroken():  # dask leaves a cluster that is half built, or half closed, to itself
            loop = _deaf_loop()
            opened.callback(loop.stop)
            cluster = _local_cluster(workers, loop)
            client = Client(cluster, set_as_default=False)
            opened.callback(_close, client, cluster)
            opened.push(lambda kind, error, trace: _kill(cluster) if kind is not None else None)
        yield client


def _close(client: Client, cluster: LocalCluster) -> None:
    with unbroken():
        client.close()
        cluster.close()


def _kill(cluster: LocalCluster) -> None:
    """End the workers in the middle of what nobody waits for any more: asked to, they take seconds."""
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
            f"scene again"
        ) from error


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let workers started in the with-block load their libraries with one thread; restore this process's own."""
    here = dict(os.environ)  # dask sets the variables here, for the processes it spawns to inherit
    try:
        with dask.config.set(_LOCAL_CLUSTER):
            yield
    finally:
        os.environ.clear()
        os.environ.update(here)
