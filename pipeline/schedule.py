"""Running a scene: batches on dask workers, results committed one by one as they arrive."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import time
from asyncio import CancelledError
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.comm import CommClosedError

from pipeline.audit import Status, status
from pipeline.manifest import StoreError
from pipeline.members import Batch, batches, expand
from pipeline.scene import Scene
from pipeline.shards import Result, compute
from pipeline.store import Store

#: Batches in flight for each worker: enough that none waits, few enough to hold and to lose little.
WINDOW = 3

#: Seconds to wait for a scheduler at a given address.
CONNECT_TIMEOUT = 10.0

# One thread each: threaded products in several processes fight for the cores, and threads that share a sum round
# it differently. Libraries read these when they are loaded, so they must be set before.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

# Ctrl-C reaches every process of the terminal; the driver alone answers it, and ends its workers.
_IGNORE_INTERRUPT = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"


class ScheduleError(RuntimeError):
    """The run could not be done to its end. What is committed stays; the message says what to do."""


@dataclass(frozen=True)
class Progress:
    """How far a run is; costs in the units of `Member.cost`."""

    n_members: int
    n_done: int
    n_failed: int
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
) -> Status:
    """Run a scene into the dataset at `out`, or what is missing of it; the same bytes whatever the workers.

    Parameters
    ----------
    scene : Scene
    source : bytes
        The scene file, kept beside the data.
    out : Path
        Directory of the dataset: absent, empty, or an earlier run of this scene, which is resumed.
    workers : int
        Local processes of one thread each; 0 runs in this process, for debugging and small scenes.
    scheduler : str, optional
        Address of a running dask cluster, used instead of local workers. Its workers need this package and
        should have one thread each.
    on_progress : callable, optional
        Called with a `Progress` at the start and after each commit.

    Raises
    ------
    ValueError
        If `workers` is negative.
    StoreError
        If the directory cannot be used or written.
    ScheduleError
        If the scheduler cannot be reached, or a batch kills its workers; everything else is done first.
    """
    if workers < 0:
        raise ValueError(f"workers: expected a count >= 0, got {workers}; 0 runs in this process")
    start = time.monotonic()
    packed = batches(expand(scene), scene.hash)
    with Store(Path(out), scene, source) as store:
        todo = [batch for batch in packed if batch.name not in store.done]
        members = {batch.name: len(batch.members) for batch in packed}
        costs = {batch.name: batch.cost for batch in packed}
        foreign = sorted(store.done - costs.keys())
        if foreign:
            raise StoreError(
                f"{out}: expected shards as this version of the program packs them, got {foreign[0]}; "
                f"go on with the version that began, or choose another directory"
            )
        before = sum(costs[name] for name in store.done)
        n_failed = status(out).outcomes.get("failed", 0)

        def report(last_shard: str | None = None) -> None:
            if on_progress is not None:
                on_progress(
                    Progress(
                        n_members=scene.n_members,
                        n_done=sum(members[name] for name in store.done),
                        n_failed=n_failed,
                        cost=sum(costs.values()),
                        cost_done=sum(costs[name] for name in store.done),
                        cost_resumed=before,
                        elapsed=time.monotonic() - start,
                        last_shard=last_shard,
                    )
                )

        report()
        # closed at once if a commit fails or the user interrupts, and the workers with it
        with contextlib.closing(_results(todo, scene, workers, scheduler)) as results:
            for result in results:
                store.commit(result)
                n_failed += result.n_failed
                report(result.name)
    return status(out)


def _results(todo: list[Batch], scene: Scene, workers: int, scheduler: str | None) -> Generator[Result]:
    """The batches' results in the order they come in."""
    work = (scene.hash, scene.record.events)
    if not todo:
        return
    if workers == 0 and scheduler is None:
        for batch in todo:
            yield compute(batch, *work)
        return
    with _client(min(workers, len(todo)), scheduler) as client:
        try:
            suspects = yield from _submit(
                client, todo, work, lambda: WINDOW * max(1, sum(client.nthreads().values()))
            )
            # dask blames a worker's death on all that waited there: one at a time, the innocent get through
            guilty = yield from _submit(client, suspects, work, lambda: 1)
        except (CancelledError, CommClosedError, TimeoutError) as error:
            raise ScheduleError(
                "expected the scheduler to stay until the end, lost it; start it again, then run the same scene "
                "again: the shards that are done are kept"
            ) from error
    if guilty:
        first = guilty[0].members
        raise ScheduleError(
            f"expected every batch to end, got {len(guilty)} that killed each worker that ran it; the first holds "
            f"{first[0].member_id} to {first[-1].member_id}; all other batches are done: give the workers more "
            f"memory, then run the same scene again"
        )


def _submit(
    client: Client, todo: list[Batch], work: tuple[str, bool], window: Callable[[], int]
) -> Generator[Result, None, list[Batch]]:
    """Yield results as they come in, with so many batches in flight; return the batches whose workers died."""
    waiting = iter(todo)
    running = as_completed(loop=client.loop)
    batch_of: dict[Future, Batch] = {}
    lost: list[Batch] = []
    while True:
        # the window is measured anew each time, as clusters grow and shrink
        for batch in itertools.islice(waiting, max(0, window() - running.count())):
            future = client.submit(compute, batch, *work, pure=False)
            batch_of[future] = batch
            running.add(future)
        if running.is_empty():
            return lost
        future = next(running)
        batch = batch_of.pop(future)
        try:
            result = future.result()
        except KilledWorker:
            lost.append(batch)
        else:
            yield result
        future.release()  # a held result is computed again when its worker dies


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
        with client:
            yield client
        return
    with (
        _one_thread(),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",  # any free port: two runs at once do not quarrel over one
            preload=[_IGNORE_INTERRUPT],
            silence_logs=logging.CRITICAL,  # what matters reaches the caller as an error
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let workers started in the with-block load their libraries with one thread; restore this process's own."""
    here = dict(os.environ)  # dask sets the variables here, for the processes it spawns to inherit
    try:
        with dask.config.set({"distributed.nanny.pre-spawn-environ": _ONE_THREAD}):
            yield
    finally:
        os.environ.clear()
        os.environ.update(here)
