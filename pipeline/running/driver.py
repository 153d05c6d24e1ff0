"""Running a scene: batches on dask workers, results committed one by one as they arrive."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import current_process
from typing import NamedTuple

from distributed import Client, fire_and_forget

from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.dataset.result import Result
from stickslip.pipeline.dataset.status import Pace, Status, Tally, counted
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch, Task
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.own.function import OwnFunction
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.running import ends
from stickslip.pipeline.running.cluster import Scheduling, check_address, check_memory, connect
from stickslip.pipeline.running.isolation import compute_alone_packed
from stickslip.pipeline.running.kept import Kept
from stickslip.pipeline.running.submit import ATTEMPTS, LOST, in_flight, lost_scheduler, submit
from stickslip.pipeline.running.trials import check_functions
from stickslip.pipeline.running.worker import cold_engines, compute, compute_packed, load_kernels, row
from stickslip.pipeline.scene import systems
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene
from stickslip.sim.numerics.session import numpy_defaults

log = logging.getLogger(__name__)

#: What is to be done after a run that broke off.
_AGAIN = "rerun the scene: finished shards are kept"


@dataclass(frozen=True)
class Progress(Tally):
    """How far a run is."""

    elapsed: float  #: seconds since the start
    last_shard: str | None
    dashboard: str | None = None  #: address of dask's, if there is one
    rate: float | None = None  #: members a second; None as long as it cannot be known
    eta: float | None = None  #: seconds to go, at the rate so far
    waiting: str | None = None  #: what the run waits for, until its first shard, or when it has lost all workers


@numpy_defaults()
def run_ensemble(
    scene: Scene,
    out: Where,
    workers: int = 2,
    scheduler: Scheduling = None,
    on_progress: Callable[[Progress], None] | None = None,
    retry_failed: bool = False,
    accept_version: bool = False,
    dashboard: bool = False,
    yes: bool = False,
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
    scheduler : str, distributed.Client or callable, optional
        Address of a running dask cluster, or a client of one, or a function that returns it and is called once there
        is something to compute; used instead of local workers. Its workers need this package and should have one
        thread each.
    on_progress : callable, optional
        Called with a `Progress` at the start, each second while the run waits, and after each commit.
    retry_failed : bool
        Whether to run shards with failed members again.
    accept_version : bool
        Whether to resume a dataset that another version of the program began; numbers may differ.
    dashboard : bool
        Whether local workers have dask's dashboard, which anybody on this machine may look at.
    yes : bool
        Whether to run more than 10 million members, which may be a typing error.

    Raises
    ------
    ValueError
        If `workers` is negative.
    CacheError
        If others could write the kernel cache.
    StoreError
        If the directory cannot be used or written.
    SceneError
        If it has many members without a yes, an engine does not take what the scene asks, a worker of this machine
        cannot hold its largest system, or a file that systems come from is gone or another, or what functions of the
        user's own measure of a run is not what they declare or differs from call to call; nothing was done.
    AddressError
        If no scheduler answers at the address; nothing was done.
    ScheduleError
        If the scheduler is lost, workers do not come up, or run another version.
    """
    check_caller(workers, scheduler)
    start = time.monotonic()
    scene.check_size(yes)
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


def check_caller(workers: int, scheduler: Scheduling) -> None:
    """Refuse a number of workers that is none, and a worker that loads the caller's script.

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
    scheduler: Scheduling
    has_dashboard: bool

    @property
    def is_here(self) -> bool:
        """Whether it is in this process."""
        return self.n == 0 and self.scheduler is None


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
    tally = Tally.of(store.tasks, {name: done for name, done in store.done.items() if name not in todo})
    by_engine = {member.engine: member for member in reversed(firsts)}
    cold = cold_engines(tuple(by_engine)) if at.scheduler is None else ()
    link: str | None = None
    pace: Pace | None = None
    n_workers = int(at.is_here)
    most_workers = n_shards_before = 0
    is_waiting = bool(todo)

    def words() -> str | None:
        if todo and not n_workers:
            return "workers"
        if not is_waiting:
            return None
        return f"{' and '.join(cold)} to be compiled, once: some ten seconds" if cold else "the first shard"

    def report(last_shard: str | None = None) -> None:
        if on_progress is not None:
            rate, eta = tally.pace(pace, time.time())
            on_progress(
                Progress(**vars(tally), elapsed=time.monotonic() - start, last_shard=last_shard, dashboard=link,
                         rate=rate, eta=eta, waiting=words())
            )  # fmt: skip

    def connected(client: Client) -> None:
        nonlocal link
        with contextlib.suppress(KeyError):  # it has none
            link = client.dashboard_link or None
        if link is not None:
            store.note(f"dashboard {link}")

    def staffed(client: Client, count: int) -> None:
        nonlocal n_workers, cold
        if count and not n_workers and at.scheduler is not None and is_waiting:
            cold = _cold_there(client, tuple(by_engine)) or cold
        n_workers = count
        if is_waiting or not count:
            report()

    report()
    store.note(f"began {time.time():.3f}")
    # closed at once if a commit fails or the user interrupts, and the workers with it
    with contextlib.closing(_results(store.todo, order, by_engine, cold, at, connected, staffed)) as results:
        for some in results:
            for result in some:
                if result.program != program():
                    raise ScheduleError(
                        f"expected workers with this version of the program ({program()}), got {result.program} on "
                        f"{result.host}; install the same there, then rerun the scene"
                    )
            is_waiting = False
            if max(n_workers, 1) > most_workers:
                most_workers, n_shards_before = max(n_workers, 1), tally.n_shards_done
            for result, shard in zip(some, store.commit(*some), strict=True):
                tally = tally.plus(shard, todo[result.name])
                report(result.name)
            # a worker's first shard takes as long as starting it and compiling do
            is_new = pace is None or pace.n_workers < most_workers
            if is_new and tally.n_shards_done - n_shards_before >= most_workers:
                pace = Pace(time.time(), tally.n_done, tally.cost_done, tally.n_shards_done, most_workers)
                store.note(pace.line)


def _cold_there(client: Client, engines: tuple[str, ...]) -> tuple[str, ...]:
    """Engines whose kernels a worker would have to compile, by what the first one says."""
    with contextlib.suppress(*LOST):
        for address in [*client.nthreads()][:1]:
            answers = client.run(cold_engines, engines, workers=[address], on_error="ignore")
            return tuple((answers or {}).get(address, ()))
    return ()


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
    by_engine: Mapping[str, Member],
    cold: Sequence[str],
    at: Workers,
    connected: Callable[[Client], None],
    staffed: Callable[[Client, int], None],
) -> Generator[Sequence[Result]]:
    """The batches' results in the order they come in, those that are there together.

    `connected` is told the client, once there is one, and `staffed` again and again how many threads it has.
    `by_engine` has a member of each engine; `cold` are those that are to be compiled on this machine.
    """
    if not todo:
        return
    workers, scheduler, dashboard = at
    if at.is_here:
        for task in todo:
            yield [compute(*order(task))]
        return
    n_workers = max(1, min(workers, max(len(todo), len(cold))))  # at an address it may be asked for none here
    with connect(n_workers, scheduler, dashboard) as client:
        # side by side: one batch alone would compile them one after the other
        for engine in cold:
            fire_and_forget(client.submit(load_kernels, [by_engine[engine]], pure=False))
        connected(client)
        try:
            lost = yield from submit(
                client, map(order, todo), compute_packed, in_flight(client), scheduler, _AGAIN,
                partial(staffed, client),
            )  # fmt: skip
            # dask blames a worker's death on all tasks that waited there: in processes of their own most pass
            for _ in range(ATTEMPTS):
                lost = yield from submit(client, lost, compute_alone_packed, lambda: n_workers, scheduler, _AGAIN)
        except LOST as error:
            raise lost_scheduler(_AGAIN) from error
    if lost:
        first = lost[0][0].members
        raise ScheduleError(
            f"expected workers to stay alive, got {len(lost)} batches whose workers died {ATTEMPTS + 1} times, but "
            f"not of their members; the first holds {first[0].member_id} to {first[-1].member_id}; see who kills "
            f"them, then {_AGAIN}"
        )
