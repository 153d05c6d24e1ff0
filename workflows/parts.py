"""The runs of a dataset in parts, and what functions that questions put to runs give of each part, wherever that is.

The parts are consecutive shards of the dataset, and what they give is added up in their order: what is found depends
neither on how many processes there are nor on which of them is done first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from stickslip.analysis.series.runs import Ended, Runs, by_number
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.query import all_events, series
from stickslip.pipeline.running.executor import Executor

T = TypeVar("T")


@dataclass(frozen=True)
class Asked:
    """A part of what is asked: the dataset without other shards, the function and some of its runs."""

    opened: Opened
    settings: AnalysisSettings
    of: Callable[..., Any]
    some: Ended
    beside: Ended | None

    def answer(self) -> Any:
        """What the function gives."""
        settings = self.settings
        runs = Runs(series(self.opened), all_events(self.opened), settings.t_burn, settings.seed, settings.time)
        return self.of(runs, self.some) if self.beside is None else self.of(runs, self.some, self.beside)


class Parts:
    """Puts functions to the runs of a dataset; consecutive shards go together until a part has `least` runs."""

    def __init__(self, opened: Opened, settings: AnalysisSettings, executor: Executor, least: int = 1) -> None:
        self._settings, self._opened, self._names = settings, opened, opened.in_parts(least)
        self._executor = executor
        shards = opened.manifest.shards
        self._ends = np.cumsum([sum(shards[name].rows for name in part) for part in self._names])

    def __call__(self, of: Callable[..., T], some: Ended, beside: Ended | None = None) -> list[tuple[list[int], T]]:
        """The places of the runs of each part among `some`, and what the function gives of these.

        With the shards of the runs beside these, which mostly lie in the same part.

        Raises `ScheduleError` if dask's scheduler or its workers are lost, or are of another version.
        """
        part = np.searchsorted(self._ends, some.row, side="right")
        places = by_number(part)
        asked = []
        for own in places:
            more = None if beside is None else beside.take(own)
            also = () if more is None else np.unique(np.searchsorted(self._ends, more.row, side="right")).tolist()
            names = sorted({name for k in (part[own[0]], *also) for name in self._names[k]})
            asked.append(Asked(_only(self._opened, names), self._settings, of, some.take(own), more))
        given = {k: result for results in self._executor.map(Asked.answer, asked) for k, result in results}
        return [(own.tolist(), given[k]) for k, own in enumerate(places)]


def _only(opened: Opened, names: Sequence[str]) -> Opened:
    """A dataset of some shards: what is sent with each task does not grow with the number of shards."""
    shards = {name: opened.manifest.shards[name] for name in names}
    alone = {"shards": shards, "packing": [[shard.rows for shard in shards.values()]], "earlier": []}
    return replace(opened, manifest=opened.manifest.model_copy(update=alone))
