"""Functions that questions put to runs, on dask's workers: a task a shard, computed where the shard is read.

What is found does not depend on the number of workers or on their order: the shards of a dataset are its parts, and
what they give is added up in their order.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from distributed import Client

from stickslip.analysis.series.runs import Ended, Runs
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline import ScheduleError
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.query import all_events, series
from stickslip.pipeline.running.submit import ATTEMPTS, LOST, in_flight, lost_scheduler, submit
from stickslip.workflows.fresh import program

T = TypeVar("T")

#: What is to be done after a report that broke off.
_AGAIN = "run the command again"


@dataclass(frozen=True)
class _Asked:
    """A part of what is asked: its number, the dataset without other shards, the function and some of its runs."""

    number: int
    opened: Opened
    settings: AnalysisSettings
    of: Callable[[Runs, Ended], Any]
    some: Ended


class OnWorkers:
    """Puts functions to the runs of a dataset.

    Parameters
    ----------
    opened : Opened
    settings : AnalysisSettings
    client : Client
    scheduler : str, Client or None
        As of `pipeline.running.cluster.connect`, which made the client.
    """

    def __init__(
        self, opened: Opened, settings: AnalysisSettings, client: Client, scheduler: str | Client | None
    ) -> None:
        self._settings, self._client, self._scheduler = settings, client, scheduler
        shards = dict(sorted(opened.manifest.shards.items()))
        self._parts = [_only(opened, name) for name in shards]
        self._ends = np.cumsum([shard.rows for shard in shards.values()])

    def __call__(self, of: Callable[[Runs, Ended], T], some: Ended) -> list[tuple[Sequence[int], T]]:
        """The places of the runs of each shard among `some`, and what the function gives of these.

        Raises
        ------
        ScheduleError
            If the scheduler or its workers are lost, or are of another version.
        """
        part = np.searchsorted(self._ends, some.row, side="right")
        order = np.argsort(part, kind="stable")
        places = np.split(order, np.flatnonzero(np.diff(part[order])) + 1) if len(order) else []
        todo = [
            _Asked(number, self._parts[part[own[0]]], self._settings, of, some.take(own))
            for number, own in enumerate(places)
        ]
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
        return [(own.tolist(), found[number]) for number, own in enumerate(places)]

    def _gather(self, todo: Sequence[_Asked], found: dict[int, T]) -> list[_Asked]:
        """Fill in what is found; return the parts whose workers died."""
        results = submit(self._client, todo, _answer, in_flight(self._client), self._scheduler, _AGAIN)
        while True:
            try:
                number, by, given = next(results)
            except StopIteration as end:
                return list(end.value)
            if by != program():
                raise ScheduleError(
                    f"expected workers with this version of the program ({program()}), got {by}; install the same "
                    f"there, then {_AGAIN}"
                )
            found[number] = given


def _only(opened: Opened, name: str) -> Opened:
    """A dataset of one shard: what is sent with each task does not grow with the number of shards."""
    shard = opened.manifest.shards[name]
    alone = {"shards": {name: shard}, "packing": [[shard.rows]], "earlier": []}
    return replace(opened, manifest=opened.manifest.model_copy(update=alone))


def _answer(task: bytes) -> tuple[int, str, Any]:
    """On a worker: the number of a part, the version of this program, and what the function gives."""
    asked: _Asked = pickle.loads(task)
    opened, settings = asked.opened, asked.settings
    runs = Runs(series(opened), all_events(opened), settings.t_burn, settings.seed)
    return asked.number, program(), asked.of(runs, asked.some)
