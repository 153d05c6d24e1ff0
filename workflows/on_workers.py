"""Functions that questions put to runs, on dask's workers: a task a shard, computed where the shard is read."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from distributed import Client

from stickslip.analysis.series.runs import Ended
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline import ScheduleError
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.running.cluster import Scheduling
from stickslip.pipeline.running.submit import ATTEMPTS, LOST, in_flight, lost_scheduler, submit
from stickslip.workflows.fresh import program
from stickslip.workflows.parts import Asked, Parts

T = TypeVar("T")

#: What is to be done after a report that broke off.
_AGAIN = "run the command again"


class OnWorkers:
    """Puts functions to the runs of a dataset.

    Parameters
    ----------
    opened : Opened
    settings : AnalysisSettings
    client : Client
    scheduler : str, Client, callable or None
        As of `pipeline.running.cluster.connect`, which made the client.
    """

    def __init__(self, opened: Opened, settings: AnalysisSettings, client: Client, scheduler: Scheduling) -> None:
        there = replace(opened, place=opened.place.from_anywhere)
        self._parts, self._client, self._scheduler = Parts(there, settings), client, scheduler

    def __call__(
        self, of: Callable[..., T], some: Ended, beside: Ended | None = None
    ) -> list[tuple[Sequence[int], T]]:
        """The places of the runs of each shard among `some`, and what the function gives of these.

        Raises
        ------
        ScheduleError
            If the scheduler or its workers are lost, or are of another version.
        """
        todo, places = self._parts.ask(of, some, beside)
        found: dict[int, T] = {}
        try:
            for _ in range(ATTEMPTS):
                todo = self._gather(todo, found)
        except LOST as error:
            raise lost_scheduler(_AGAIN) from error
        if todo:
            raise ScheduleError(
                f"expected workers to stay alive, got {len(todo)} parts whose workers died {ATTEMPTS} times; "
                f"see what ends them (memory?), then {_AGAIN}"
            )
        return [(own, found[number]) for number, own in enumerate(places)]

    def _gather(self, todo: Sequence[Asked], found: dict[int, T]) -> list[Asked]:
        """Fill in what is found; return the parts whose workers died."""
        results = submit(self._client, todo, _answer, in_flight(self._client), self._scheduler, _AGAIN)
        while True:
            try:
                some = next(results)
            except StopIteration as end:
                return list(end.value)
            for number, by, given in some:
                if by != program():
                    raise ScheduleError(
                        f"expected workers with this version of the program ({program()}), got {by}; install the "
                        f"same there, then {_AGAIN}"
                    )
                found[number] = given


def _answer(task: bytes) -> tuple[int, str, Any]:
    """On a worker: the number of a part, the version of this program, and what the function gives."""
    asked: Asked = pickle.loads(task)
    return asked.number, program(), asked.answer()
