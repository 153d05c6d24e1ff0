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
from typing import Any

from dask.sizeof import sizeof
from distributed import Client, Future, KilledWorker, as_completed
from distributed.comm import CommClosedError

from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.running.cluster import Scheduling
from stickslip.pipeline.running.executor import Executor, R, Results, T, call_there
from stickslip.pipeline.running.slurm import Jobs

log = logging.getLogger(__name__)

#: Tasks in flight for each worker: enough that none waits, few enough to hold and to lose little.
WINDOW = 3

#: Seconds without a single worker, or without the scheduler, after which a run gives up.
LOST_TIMEOUT = 60.0

#: Seconds between two looks at what has come in; meanwhile the workers have their next tasks.
_LOOK = 0.02

#: Results that are yielded together, at most, and bytes after which no more are fetched.
_TOGETHER, _ROOM = 16, 2**26

#: How often tasks whose workers died are tried again.
ATTEMPTS = 3

#: What is raised where the scheduler is lost; TimeoutError is an OSError.
LOST = (CancelledError, CommClosedError, OSError)


class Dask(Executor):
    """Workers of dask.

    Parameters
    ----------
    scheduler : str, Client, callable or None
        As of `connect`.
    again : str
        What errors say to do once their reason is gone.
    alone : callable, optional
        Computes, in place of the function, parts whose workers died.
    version : callable, optional
        Of what has to be the same on workers.
    on_workers : callable, optional
        Called about once a second with how many threads there are to compute.
    """

    def __init__(
        self,
        client: Client,
        scheduler: Scheduling,
        again: str,
        alone: Callable[[Any], Any] | None = None,
        version: Callable[[], str] = program,
        on_workers: Callable[[int], None] = lambda n: None,
    ) -> None:
        self._client, self._scheduler, self._again = client, scheduler, again
        self._alone, self._version, self._on_workers = alone, version, on_workers

    def map(self, function: Callable[[T], R], parts: Iterable[T]) -> Results[R]:
        """As `Executor.map`, with some parts in flight for each worker.

        Raises `ScheduleError` if the scheduler or its workers are lost, do not come up, or run another version;
        `Exception`: whatever the function raises.
        """
        tasks: Iterable[tuple[int, T]] = enumerate(parts)
        lost: list[tuple[int, T]] = []
        n_together, watch = WINDOW, Watch(self._client, self._scheduler, self._again, self._on_workers)
        try:
            for _ in range(ATTEMPTS + 1):
                tasks = lost = yield from self._attempt(function, tasks, n_together, watch)
                # dask blames a worker's death on all tasks that waited there
                function, n_together = self._alone or function, 1
        except LOST as error:
            raise ScheduleError(
                f"expected the scheduler to stay until the end, lost it; start it again, then {self._again}"
            ) from error
        if lost:
            raise ScheduleError(
                f"expected workers to stay alive, got {len(lost)} parts whose workers died {ATTEMPTS + 1} times; "
                f"see what ends them (memory?), then {self._again}"
            )

    def _attempt(
        self, function: Callable[[T], R], tasks: Iterable[tuple[int, T]], n_together: int, watch: Watch
    ) -> Generator[list[tuple[int, R]], None, list[tuple[int, T]]]:
        """What the function gives of numbered parts, as it comes in; returns those whose workers died."""
        waiting = iter(tasks)
        running = as_completed(loop=self._client.loop)
        task_of: dict[Future[Any], tuple[int, T]] = {}
        lost: list[tuple[int, T]] = []
        watch.look()
        while True:
            # measured each time, as clusters grow and shrink
            window = n_together * max(1, watch.n_workers)
            for task in itertools.islice(waiting, max(0, window - running.count())):
                # in bytes: the scheduler, in this process, would unpack and pack the members one by one
                content = pickle.dumps(task[1])
                future = self._client.submit(call_there, function, content, self._version, pure=False)
                task_of[future] = task
                running.add(future)
            if running.is_empty():
                return lost
            watch.until(running.has_ready)
            results: list[tuple[int, R]] = []
            try:
                while running.has_ready() and len(results) < _TOGETHER and sizeof(results) < _ROOM:
                    future = next(running)
                    task = task_of.pop(future)
                    try:
                        results.append((task[0], self._checked(watch.fetch(future))))
                    except KilledWorker:
                        lost.append(task)
                    except (ImportError, AttributeError) as error:
                        raise self._of_another(f"one that cannot run it ({error})") from error
                    future.release()  # a held result is computed again when its worker dies
            finally:  # what has come in is kept even if the next is lost
                if results:
                    yield results

    def _checked(self, answer: tuple[str, str, R]) -> R:
        version, host, result = answer
        if version != self._version():
            raise self._of_another(f"{version} on {host}")
        return result

    def _of_another(self, which: str) -> ScheduleError:
        return ScheduleError(
            f"expected workers with this version of the program ({self._version()}), got {which}; install the same "
            f"there, then {self._again}"
        )


class Watch:
    """Counts workers about once a second: the scheduler names each of them.

    Ends a wait after `LOST_TIMEOUT` without a scheduler or, on this machine, without a worker; and at once where
    Slurm takes no job at all, as it will take no other.
    """

    def __init__(
        self, client: Client, scheduler: Scheduling, again: str, on_workers: Callable[[int], None] = lambda n: None
    ) -> None:
        self._client, self._scheduler, self._again, self._on_workers = client, scheduler, again, on_workers
        self._connected = self._staffed = time.monotonic()
        self._looked, self.n_workers = -math.inf, 0

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
                self.n_workers = sum(self._client.nthreads().values())
                self._staffed = now if self.n_workers else self._staffed
        self._on_workers(self.n_workers)
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

    def until(self, is_so: Callable[[], bool]) -> None:
        """Wait for something, looking about."""
        self.look()
        while not is_so():
            time.sleep(_LOOK)
            self.look()

    def fetch(self, future: Future[Any]) -> Any:
        """The result of a future that is done; dask computes it again if its worker has died since."""
        while True:
            try:
                return future.result(timeout=LOST_TIMEOUT / 2)
            except TimeoutError:
                self.look()
