"""Running a scene: batches on dask workers, results committed one by one as they arrive."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import current_process

import numpy as np
from distributed import Client, fire_and_forget

from stickslip.pipeline.dataset.opened import Opened, open_dataset
from stickslip.pipeline.dataset.schema import scaled
from stickslip.pipeline.dataset.status import Pace, Status, Tally, status
from stickslip.pipeline.dataset.writer import Store
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.own.function import OwnFunction
from stickslip.pipeline.places.manifest import Result
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.running import ends
from stickslip.pipeline.running.cluster import Scheduling, check_address, connect
from stickslip.pipeline.running.estimate import check_memory
from stickslip.pipeline.running.executor import Executor, Here
from stickslip.pipeline.running.submit import LOST, Dask
from stickslip.pipeline.running.taken_over import KeptRows
from stickslip.pipeline.running.trials import check_functions
from stickslip.pipeline.running.worker import (
    Order,
    cold_engines,
    compute,
    compute_alone,
    compute_there,
    load_kernels,
    row,
)
from stickslip.pipeline.scene.scene import Scene
from stickslip.pipeline.scene.systems import read_measured
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
    *,
    dashboard: bool = False,
    yes: bool = False,
    kept: Where | Opened | None = None,
) -> Status:
    """Run a scene into the dataset at `out`, or what is missing of it; the same bytes whatever the workers.

    In a script call it under ``if __name__ == "__main__":``, for workers of this machine load the script too.

    Parameters
    ----------
    scene : Scene
        Its `source` is kept beside the data.
    out : str, Path or Place
        Directory of the dataset, or its address in an object store: absent, empty, or an earlier run of this scene,
        which is resumed, or of a part of it, which grows.
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
    kept : str, Path, Place or Opened, optional
        Another dataset. Its members that are the same here, and did not fail, are run only for what their rows lack.

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
    start = time.monotonic()
    _check(scene, workers, scheduler, yes)
    rows = None if kept is None else KeptRows(open_dataset(kept))
    store = Store(out, scene, retry_failed, accept_version, () if rows is None else rows.opened.manifest.programs)
    if scene.own_record is not None and (rows is None or scene.own_record not in rows.opened.scene.records):
        check_functions(scene, store.look()[1])  # before anything is written
    with store:
        runs = [batch.members if rows is None else rows.left(batch) for batch in store.todo]
        firsts = [member for members in runs for member in members.firsts()]
        _look_at_origins(firsts, scene.own_functions if firsts else ())
        fill = _Filling(store, firsts, workers, scheduler, dashboard, on_progress, start)
        fill(lambda batch: (batch, None if rows is None else rows.of(batch)))
    return status(store.opened)


def _look_at_origins(firsts: Sequence[Member], functions: Iterable[OwnFunction]) -> None:
    """See that what members come from, and functions, are as they were: a word here, and not a row for each member.

    Raises `SceneError` if one is gone, or another.
    """
    for origin in {member.source.origin for member in firsts} | set(functions):
        if origin is not None:
            origin.look_again()
    for series in {value for member in firsts for value in member.series}:
        read_measured(series)


def _check(scene: Scene, workers: int, scheduler: Scheduling, yes: bool) -> None:
    """Refuse what cannot be run before anything is looked at or written; raises as `run_ensemble`."""
    if workers < 0:
        raise ValueError(f"workers: expected a count >= 0, got {workers}; 0 runs in this process")
    if getattr(current_process(), "_inheriting", False):
        raise ScheduleError(
            'expected a scene to be run under if __name__ == "__main__":, got a script that runs it wherever it is '
            "loaded, and every worker loads it; write that line above the call"
        )
    scene.check_size(yes)
    if isinstance(scheduler, str):
        check_address(scheduler)
    scene.check_engines()
    ends.check(scene)
    if scheduler is None:
        check_memory(scene, workers)


class _Filling:
    """Computes what a dataset is to have, and commits it as it comes in.

    Parameters
    ----------
    firsts : sequence of Member
        Those that are run: the first of each pair of an origin of systems and an engine.
    workers, scheduler, dashboard, on_progress
        As of `run_ensemble`.
    start : float
        When this began, by `time.monotonic`.
    """

    def __init__(
        self,
        store: Store,
        firsts: Sequence[Member],
        workers: int,
        scheduler: Scheduling,
        dashboard: bool,
        on_progress: Callable[[Progress], None] | None,
        start: float,
    ) -> None:
        self._store, self._on_progress, self._start = store, on_progress, start
        self._workers, self._scheduler, self._has_dashboard = workers, scheduler, dashboard
        self._is_here = workers == 0 and scheduler is None
        self._costs = {batch.name: batch.cost for batch in store.todo}
        shards = {name: shard for name, shard in store.done.items() if name not in self._costs}
        self._tally = Tally.of(store.tasks, shards)
        self._by_engine = {member.engine: member for member in reversed(firsts)}
        self._cold = cold_engines(self._by_engine) if scheduler is None else ()
        self._dashboard: str | None = None
        self._pace: Pace | None = None
        self._n_workers = int(self._is_here)
        self._most_workers = self._n_shards_before = 0
        self._is_waiting = bool(store.todo)

    def __call__(self, order: Callable[[Batch], Order]) -> None:
        """Compute and commit; `order` gives what of a batch is sent to a worker, and is called when it is.

        Raises `SceneError` or `StoreError` or `ScheduleError` as `run_ensemble`.
        """
        self._report()
        self._store.note(f"began {time.time():.3f}")
        if not self._store.todo:
            return
        compute_order = (lambda order: compute(*order)) if self._is_here else compute_there
        # closed at once if a commit fails or the user interrupts, and the workers with it
        with (
            self._executor() as executor,
            contextlib.closing(executor.map(compute_order, map(order, self._store.todo))) as computed,
        ):
            for numbered in computed:
                self._commit([result for _, result in numbered])

    @contextlib.contextmanager
    def _executor(self) -> Iterator[Executor]:
        if self._is_here:
            yield Here()
            return
        # at an address it may be asked for none here
        n_workers = max(1, min(self._workers, max(len(self._costs), len(self._cold))))
        with connect(n_workers, self._scheduler, self._has_dashboard) as client:
            # side by side: one batch alone would compile them one after the other
            for engine in self._cold:
                fire_and_forget(client.submit(load_kernels, [self._by_engine[engine]], pure=False))
            with contextlib.suppress(KeyError):  # it has none
                self._dashboard = client.dashboard_link or None
            if self._dashboard is not None:
                self._store.note(f"dashboard {self._dashboard}")
            # in processes of their own most of those pass whose workers died
            yield Dask(client, self._scheduler, _AGAIN, compute_alone, on_workers=partial(self._staffed, client))

    def _staffed(self, client: Client, count: int) -> None:
        if count and not self._n_workers and self._scheduler is not None and self._is_waiting:
            self._cold = _cold_there(client, tuple(self._by_engine)) or self._cold
        self._n_workers = count
        if self._is_waiting or not count:
            self._report()

    def _commit(self, results: Sequence[Result]) -> None:
        self._is_waiting = False
        if max(self._n_workers, 1) > self._most_workers:
            self._most_workers, self._n_shards_before = max(self._n_workers, 1), self._tally.n_shards_done
        for result, shard in zip(results, self._store.commit(*results), strict=True):
            self._tally = self._tally.plus(shard, self._costs[result.name])
            self._report(result.name)
        # a worker's first shard takes as long as starting it and compiling do
        is_new = self._pace is None or self._pace.n_workers < self._most_workers
        if is_new and self._tally.n_shards_done - self._n_shards_before >= self._most_workers:
            tally = self._tally
            self._pace = Pace(time.time(), tally.n_done, tally.cost_done, tally.n_shards_done, self._most_workers)
            self._store.note(self._pace.line)

    def _report(self, last_shard: str | None = None) -> None:
        if self._on_progress is not None:
            rate, eta = self._tally.pace(self._pace, time.time())
            elapsed, waiting = time.monotonic() - self._start, self._waiting_for()
            self._on_progress(
                Progress(**vars(self._tally), elapsed=elapsed, last_shard=last_shard, dashboard=self._dashboard,
                         rate=rate, eta=eta, waiting=waiting)
            )  # fmt: skip

    def _waiting_for(self) -> str | None:
        if self._costs and not self._n_workers:
            return "workers"
        if not self._is_waiting:
            return None
        cold = " and ".join(self._cold)
        return f"{cold} to be compiled, once: half a minute of a core" if cold else "the first shard"


def _cold_there(client: Client, engines: tuple[str, ...]) -> tuple[str, ...]:
    """Engines whose kernels a worker would have to compile, by what the first one says."""
    with contextlib.suppress(*LOST):
        for address in [*client.nthreads()][:1]:
            answers = client.run(cold_engines, engines, workers=[address], on_error="ignore")
            return tuple((answers or {}).get(address, ()))
    return ()


def run_member(scene: Scene, member_id: str) -> dict[str, object]:
    """Run one member of a scene in this process, as a failed one's row says to: its row, by column, in its units.

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
    values, scales = row(members[place], scene.recording), scaled(scene.recording)
    return {
        name: value if value is None or name not in scales else np.asarray(value, np.float64) * scales[name]
        for name, value in values.items()
    }
