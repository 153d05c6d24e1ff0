"""Tasks on dask's workers, results as they come in: what a run and a report do on a cluster."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import pickle
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import CancelledError
from typing import Any, TypeVar

from dask.sizeof import sizeof
from distributed import Client, Future, KilledWorker, as_completed
from distributed.comm import CommClosedError

from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.running.cluster import Scheduling
from stickslip.pipeline.running.slurm import Jobs

log = logging.getLogger(__name__)

#: Tasks in flight for each worker: enough that none waits, few enough to hold and to lose little.
WINDOW = 3

#: Seconds without a single worker, or without the scheduler, after which a run gives up.
LOST_TIMEOUT = 60.0

#: Seconds between two looks at what has come in; meanwhile the workers have their next tasks.
_LOOK = 0.02

#: Seconds between two looks at how many workers there are: the scheduler names each of them.
_LOOK_AT_WORKERS = 1.0

#: Results that are yielded together, at most, and bytes after which no more are fetched.
_TOGETHER, _ROOM = 16, 2**26

#: How often tasks whose workers died are tried again.
ATTEMPTS = 3

#: What is raised where the scheduler is lost; TimeoutError is an OSError.
LOST = (CancelledError, CommClosedError, OSError)

T = TypeVar("T")
R = TypeVar("R")


def in_flight(client: Client) -> Callable[[], int]:
    """How many tasks are to be in flight, for as many workers as there are at the last look."""
    looked, count = -math.inf, 0

    def window() -> int:
        nonlocal looked, count
        if time.monotonic() - looked > _LOOK_AT_WORKERS:
            count = WINDOW * max(1, sum(client.nthreads().values()))
            looked = time.monotonic()
        return count

    return window


def lost_scheduler(again: str) -> ScheduleError:
    """The error for a scheduler that is lost."""
    return ScheduleError(f"expected the scheduler to stay until the end, lost it; start it again, then {again}")


def submit(
    client: Client,
    todo: Iterable[T],
    work: Callable[[bytes], R],
    window: Callable[[], int],
    scheduler: Scheduling,
    again: str,
    on_workers: Callable[[int], None] = lambda n: None,
) -> Generator[list[R], None, list[T]]:
    """Yield results as they come in, those that are there together, with `window()` tasks in flight.

    Returns the tasks whose workers died.

    Parameters
    ----------
    client : Client
    todo : iterable
        Tasks, each taken when there is room for it.
    work : callable
        Takes a pickled task.
    window : callable
    scheduler : str, Client, callable or None
        As of `connect`.
    again : str
        What errors say to do once their reason is gone.
    on_workers : callable, optional
        Called about once a second with how many threads there are to compute.

    Raises
    ------
    ScheduleError
        If workers do not come up, or run another version.
    Exception
        One of `LOST` if the scheduler is lost, and whatever `work` raises.
    """
    waiting = iter(todo)
    running = as_completed(loop=client.loop)
    task_of: dict[Future[Any], T] = {}
    lost: list[T] = []
    patience = _Patience(client, scheduler, again, on_workers)
    while True:
        # measured each time, as clusters grow and shrink
        for task in itertools.islice(waiting, max(0, window() - running.count())):
            # in bytes: the scheduler, in this process, would unpack and pack the members one by one
            future = client.submit(work, pickle.dumps(task), pure=False)
            task_of[future] = task
            running.add(future)
        if running.is_empty():
            return lost
        patience.look()
        _until(running.has_ready, patience)
        results: list[R] = []
        try:
            while running.has_ready() and len(results) < _TOGETHER and sizeof(results) < _ROOM:
                future = next(running)
                task = task_of.pop(future)
                try:
                    results.append(_fetch(future, patience))
                except KilledWorker:
                    lost.append(task)
                except (ImportError, AttributeError) as error:
                    raise ScheduleError(
                        f"expected workers with this version of the program ({program()}), got one that cannot run "
                        f"it ({error}); install the same there, then {again}"
                    ) from error
                future.release()  # a held result is computed again when its worker dies
        finally:  # what has come in is kept even if the next is lost
            if results:
                yield results


class _Patience:
    """Ends a wait after `LOST_TIMEOUT` without a scheduler or, on this machine, without a worker.

    And at once where Slurm takes no job at all, as it will take no other.
    """

    def __init__(
        self, client: Client, scheduler: Scheduling, again: str, on_workers: Callable[[int], None] = lambda n: None
    ) -> None:
        self._client, self._scheduler, self._again, self._on_workers = client, scheduler, again, on_workers
        self._connected = self._staffed = time.monotonic()
        self._looked, self._n_workers = -math.inf, 0

    def look(self) -> None:
        """Raise if it is time to give up; a cluster at an address may be without workers for any time."""
        now = time.monotonic()
        if now - self._looked < 1.0:
            return
        self._looked = now
        cluster = self._client.cluster
        if isinstance(cluster, Jobs) and cluster.refused and not cluster.n_accepted:
            raise ScheduleError(f"expected Slurm to take jobs, got none in: {cluster.refused}; change --job")
        if self._client.status == "running":
            self._connected = now
            with contextlib.suppress(*LOST):  # it may be lost just now, which is seen at the next look
                n_workers = sum(self._client.nthreads().values())
                self._staffed = now if n_workers else self._staffed
                self._n_workers = n_workers
        self._on_workers(self._n_workers)
        if now - self._connected > LOST_TIMEOUT:
            raise CommClosedError
        if self._connected == now and now - self._staffed > LOST_TIMEOUT:
            if self._scheduler is None:
                raise ScheduleError(
                    f"expected workers, got none for {LOST_TIMEOUT:.0f} s; see what ends them (memory?), then "
                    f"{self._again}"
                )
            log.warning(
                "waiting for workers: there was none for %.0f s; start some, or see in their logs what ends them",
                LOST_TIMEOUT,
            )
            self._staffed = now


def _until(is_so: Callable[[], bool], patience: _Patience) -> None:
    while not is_so():
        time.sleep(_LOOK)
        patience.look()


def _fetch(future: Future[Any], patience: _Patience) -> Any:
    """The result of a future that is done; dask computes it again if its worker has died since."""
    while True:
        try:
            return future.result(timeout=LOST_TIMEOUT / 2)
        except TimeoutError:
            patience.look()
