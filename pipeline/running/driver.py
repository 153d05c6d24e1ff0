"""Running a scene: batches on dask workers, results committed one by one as they arrive."""

from __future__ import annotations

import contextlib
import itertools
import logging
import pickle
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from multiprocessing import current_process
from typing import Any, NamedTuple

from distributed import Client, Future, KilledWorker, as_completed, fire_and_forget
from distributed.comm import CommClosedError

from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.dataset.result import Result
from stickslip.pipeline.dataset.status import Began, Status, Tally, counted
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch, Task
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.own.function import OwnFunction
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.running import ends
from stickslip.pipeline.running.cluster import check_address, check_memory, connect
from stickslip.pipeline.running.isolation import compute_alone_packed
from stickslip.pipeline.running.kept import Kept
from stickslip.pipeline.running.trials import check_functions
from stickslip.pipeline.running.worker import compute, compute_packed, is_cold, load_kernels, row
from stickslip.pipeline.scene import systems
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene

log = logging.getLogger(__name__)

#: Batches in flight for each worker: enough that none waits, few enough to hold and to lose little.
WINDOW = 3

#: Seconds without a single worker, or without the scheduler, after which a run gives up.
LOST_TIMEOUT = 60.0

#: Seconds between two looks at what has come in; meanwhile the workers have their next batches.
_LOOK = 0.02

#: How often batches whose workers died are tried again, their members in processes of their own.
_ATTEMPTS = 3


@dataclass(frozen=True)
class Progress(Tally):
    """How far a run is."""

    n_resumed: int  #: members that were there at the start, and their part of `cost_done`
    cost_resumed: float
    elapsed: float  #: seconds since the start
    last_shard: str | None
    dashboard: str | None = None  #: address of dask's, if there is one
    compiling: tuple[str, ...] = ()  #: engines whose kernels are compiled first, on this machine

    @property
    def rate(self) -> float | None:
        """Members a second; None before the first batch of this run."""
        return self.pace(self.n_resumed, self.cost_resumed, self.elapsed)[0]

    @property
    def eta(self) -> float | None:
        """Seconds to go, at the rate so far; None before the first batch of this run."""
        return self.pace(self.n_resumed, self.cost_resumed, self.elapsed)[1]


def run_ensemble(
    scene: Scene,
    out: Where,
    workers: int = 2,
    scheduler: str | Client | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
    accept_version: bool = False,
    dashboard: bool = False,
) -> Status:
    """Run a scene into the dataset at `out`, or what is missing of it; the same bytes whatever the workers.

    In a script call it under ``if __name__ == "__main__":``, for workers of this machine load the script too.

    Parameters
    ----------
    scene : Scene
        Its `source` is kept beside the data.
    out : str, Path or Place
        Directory of the dataset, or its address in an object store: absent, empty, or an earlier run of this scene,
        which is resumed, or of a part of it, which is extended.
    workers : int
        Local processes of one thread each; 0 runs in this process, for debugging and small scenes.
    scheduler : str or distributed.Client, optional
        Address of a running dask cluster, or a client of one, used instead of local workers. Its workers need this
        package and should have one thread each.
    on_progress : callable, optional
        Called with a `Progress` at the start and after each commit.
    retry_failed : bool
        Whether to run shards with failed members again.
    accept_version : bool
        Whether to resume a dataset that another version of the program began; numbers may differ.
    dashboard : bool
        Whether local workers have dask's dashboard, which anybody on this machine may look at.

    Raises
    ------
    ValueError
        If `workers` is negative.
    StoreError
        If the directory cannot be used or written.
    SceneError
        If an engine does not take what the scene asks, a worker of this machine cannot hold its largest system, or
        a file that systems come from is gone or another, or what functions of the user's own measure of a run is not
        what they declare or differs from call to call; nothing was done.
    AddressError
        If no scheduler answers at the address; nothing was done.
    ScheduleError
        If the scheduler is lost, workers do not come up, or run another version.
    """
    check_caller(workers)
    start = time.monotonic()
    if isinstance(scheduler, str):
        check_address(scheduler)
    scene.check_engines()
    ends.check(scene)
    if scheduler is None:
        check_memory(scene, workers)
    if scene.own_record is not None:  # before anything is written
        check_functions(scene, Store(out, scene, retry_failed, accept_version).look()[1])
    with Store(out, scene, retry_failed, accept_version) as store:
        firsts = [member for batch, _ in store.todo for member in batch.members.firsts()]
        look_at_origins(firsts, scene.own_functions if firsts else ())
        fill(store, lambda task: (*task, None), firsts, start, Workers(workers, scheduler, dashboard), on_progress)
    return counted(store.opened, store.tasks)


def look_at_origins(firsts: Iterable[Member], functions: Iterable[OwnFunction] = ()) -> None:
    """See that what members come from, and functions, are as they were: a word here, and not a row for each member.

    Raises
    ------
    SceneError
        If one is gone, or another.
    """
    for origin in {member.source.origin for member in firsts} | set(functions):
        if origin is not None:
            systems.look_again(origin)


def check_caller(workers: int) -> None:
    """Refuse a number of workers that is none, and a worker that loads the script which starts it.

    Raises
    ------
    ValueError, ScheduleError
        As `run_ensemble`.
    """
    if workers < 0:
        raise ValueError(f"workers: expected a count >= 0, got {workers}; 0 runs in this process")
    if getattr(current_process(), "_inheriting", False):
        raise ScheduleError(
            'expected a scene to be run under if __name__ == "__main__":, got a script that runs it wherever it is '
            "loaded, and every worker loads it; write that line above the call"
        )


#: A shard to be computed, with the rows that there are already, if there are any.
Order = tuple[Batch, Recording, Kept | None]


class Workers(NamedTuple):
    """Where to compute; see `run_ensemble`."""

    n: int
    scheduler: str | Client | None
    has_dashboard: bool


def fill(
    store: Store,
    order: Callable[[Task], Order],
    firsts: Sequence[Member],
    start: float,
    at: Workers,
    on_progress: Callable[[Progress], None] | None,
) -> None:
    """Compute what a dataset is to have, and commit it as it comes in.

    Parameters
    ----------
    store : Store
    order : callable
        What of a task is sent to a worker; called when it is.
    firsts : sequence of Member
        Those that are run: the first of each pair of an origin of systems and an engine.
    start : float
        When this began, by `time.monotonic`.
    at : Workers
    on_progress : callable, optional
        As of `run_ensemble`.

    Raises
    ------
    SceneError, StoreError, ScheduleError
        As `run_ensemble`.
    """
    todo = {batch.name: batch.cost for batch, _ in store.todo}
    tally = before = Tally.of(store.tasks, {name: done for name, done in store.done.items() if name not in todo})
    by_engine = {member.engine: member for member in reversed(firsts)}
    cold = {engine: one for engine, one in by_engine.items() if at.scheduler is None and is_cold(engine)}
    link: str | None = None

    def connected(client: Client) -> None:
        nonlocal link
        with contextlib.suppress(KeyError):  # it has none
            link = client.dashboard_link or None
        if link is not None:
            store.note(f"dashboard {link}")

    def report(last_shard: str | None = None) -> None:
        if on_progress is not None:
            on_progress(
                Progress(
                    **vars(tally),
                    n_resumed=before.n_done,
                    cost_resumed=before.cost_done,
                    elapsed=time.monotonic() - start,
                    last_shard=last_shard,
                    dashboard=link,
                    compiling=tuple(cold),
                )
            )

    report()
    store.note(Began(time.time(), before.n_done, before.cost_done).line)
    # closed at once if a commit fails or the user interrupts, and the workers with it
    with contextlib.closing(_results(store.todo, order, cold, at, connected)) as results:
        for result in results:
            if result.program != program():
                raise ScheduleError(
                    f"expected workers with this version of the program ({program()}), got {result.program} on "
                    f"{result.host}; install the same there, then rerun the scene"
                )
            tally = tally.plus(store.commit(result), todo[result.name])
            report(result.name)


def run_member(scene: Scene, member_id: str) -> dict[str, object]:
    """Run one member of a scene in this process, as a failed one's row says to: its row, by column.

    Raises
    ------
    ValueError
        If the scene has no such member.
    SceneError
        If this machine cannot hold the scene's largest system.
    """
    check_memory(scene, workers=1)
    ends.check(scene)
    members = expand(scene)
    place = next((k for k, name in enumerate(members.ids()) if name == member_id), None)
    if place is None:
        raise ValueError(
            f"member_id: expected a member of the scene, such as {next(members.ids())!r}, got {member_id!r}"
        )
    return row(members[place], scene.recording)


def _results(
    todo: list[Task],
    order: Callable[[Task], Order],
    cold: Mapping[str, Member],
    at: Workers,
    connected: Callable[[Client], None],
) -> Generator[Result]:
    """The batches' results in the order they come in; `connected` is told the client, once there is one.

    `cold` has a member of each engine that is to be compiled.
    """
    if not todo:
        return
    workers, scheduler, dashboard = at
    if workers == 0 and scheduler is None:
        for task in todo:
            yield compute(*order(task))
        return
    n_workers = max(1, min(workers, max(len(todo), len(cold))))  # at an address it may be asked for none here
    with connect(n_workers, scheduler, dashboard) as client:
        # side by side: one batch alone would compile them one after the other
        for member in cold.values():
            fire_and_forget(client.submit(load_kernels, [member], pure=False))
        connected(client)
        try:
            lost = yield from _submit(
                client, map(order, todo), compute_packed, lambda: WINDOW * max(1, sum(client.nthreads().values())),
                scheduler,
            )  # fmt: skip
            # dask blames a worker's death on all tasks that waited there: in processes of their own most pass
            for _ in range(_ATTEMPTS):
                lost = yield from _submit(client, lost, compute_alone_packed, lambda: n_workers, scheduler)
        except (CancelledError, CommClosedError, OSError) as error:  # OSError: TimeoutError among them
            raise ScheduleError(
                "expected the scheduler to stay until the end, lost it; start it again, then rerun the scene: "
                "finished shards are kept"
            ) from error
    if lost:
        first = lost[0][0].members
        raise ScheduleError(
            f"expected workers to stay alive, got {len(lost)} batches whose workers died {_ATTEMPTS + 1} times, but "
            f"not of their members; the first holds {first[0].member_id} to {first[-1].member_id}; see who kills "
            f"them, then rerun the scene: finished shards are kept"
        )


def _submit(
    client: Client,
    todo: Iterable[Order],
    work: Callable[..., Result],
    window: Callable[[], int],
    scheduler: str | Client | None,
) -> Generator[Result, None, list[Order]]:
    """Yield results as they come in, with `window()` batches in flight; return the batches whose workers died."""
    waiting = iter(todo)
    running = as_completed(loop=client.loop)
    task_of: dict[Future[Any], Order] = {}
    lost: list[Order] = []
    while True:
        # measured each time, as clusters grow and shrink
        for task in itertools.islice(waiting, max(0, window() - running.count())):
            # in bytes: the scheduler, in this process, would unpack and pack the members one by one
            future = client.submit(work, pickle.dumps(task), pure=False)
            task_of[future] = task
            running.add(future)
        if running.is_empty():
            return lost
        patience = _Patience(client, scheduler)
        _until(running.has_ready, patience)
        future = next(running)
        task = task_of.pop(future)
        try:
            result = _fetch(future, patience)
        except KilledWorker:
            lost.append(task)
        except (ImportError, AttributeError) as error:
            raise ScheduleError(
                f"expected workers with this version of the program ({program()}), got one that cannot run it "
                f"({error}); install the same there, then rerun the scene"
            ) from error
        else:
            yield result
        future.release()  # a held result is computed again when its worker dies


class _Patience:
    """Ends a wait after `LOST_TIMEOUT` without a scheduler or, on this machine, without a worker."""

    def __init__(self, client: Client, scheduler: str | Client | None) -> None:
        self._client, self._scheduler = client, scheduler
        self._looked = self._alive = time.monotonic()

    def look(self) -> None:
        """Raise if it is time to give up; a cluster at an address may be without workers for any time."""
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
                f"expected workers, got none for {LOST_TIMEOUT:.0f} s; see what ends them (memory?), then rerun "
                f"the scene: finished shards are kept"
            )


def _until(is_so: Callable[[], bool], patience: _Patience) -> None:
    while not is_so():
        time.sleep(_LOOK)
        patience.look()


def _fetch(future: Future[Any], patience: _Patience) -> Result:
    """The result of a future that is done; dask computes it again if its worker has died since."""
    while True:
        try:
            return future.result(timeout=LOST_TIMEOUT / 2)
        except TimeoutError:
            patience.look()
