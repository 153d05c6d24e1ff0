"""The runs of a dataset in parts, and what functions that questions put to runs give of each part, wherever that is.

The parts are consecutive shards of the dataset, and what they give is added up in their order: what is found depends
neither on how many processes there are nor on which of them is done first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stickslip.analysis.series.runs import Ended, Runs, by_number
from stickslip.analysis.settings import AnalysisSettings
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.query import all_events, series


@dataclass(frozen=True)
class Asked:
    """A part of what is asked: its number, the dataset without other shards, the function and some of its runs."""

    number: int
    opened: Opened
    settings: AnalysisSettings
    of: Callable[..., Any]
    some: Ended
    beside: Ended | None

    def answer(self) -> Any:
        """What the function gives."""
        runs = Runs(series(self.opened), all_events(self.opened), self.settings.t_burn, self.settings.seed)
        return self.of(runs, self.some) if self.beside is None else self.of(runs, self.some, self.beside)


class Parts:
    """The parts of a dataset.

    Parameters
    ----------
    opened : Opened
    settings : AnalysisSettings
    least : int
        Runs of a part, at least, but for the last: consecutive shards go together until there are so many.
    """

    def __init__(self, opened: Opened, settings: AnalysisSettings, least: int = 1) -> None:
        self._settings, self._opened, self._names = settings, opened, opened.in_parts(least)
        shards = opened.manifest.shards
        self._ends = np.cumsum([sum(shards[name].rows for name in part) for part in self._names])

    def ask(self, of: Callable[..., Any], some: Ended, beside: Ended | None) -> tuple[list[Asked], list[list[int]]]:
        """A function put to some runs: what is asked of each part that has some, and their places among `some`.

        With the shards of the runs beside these, which mostly lie in the same part.
        """
        part = np.searchsorted(self._ends, some.row, side="right")
        places = by_number(part)
        asked = []
        for number, own in enumerate(places):
            more = None if beside is None else beside.take(own)
            also = () if more is None else np.unique(np.searchsorted(self._ends, more.row, side="right")).tolist()
            names = sorted({name for k in (part[own[0]], *also) for name in self._names[k]})
            asked.append(Asked(number, _only(self._opened, names), self._settings, of, some.take(own), more))
        return asked, [own.tolist() for own in places]


def _only(opened: Opened, names: Sequence[str]) -> Opened:
    """A dataset of some shards: what is sent with each task does not grow with the number of shards."""
    shards = {name: opened.manifest.shards[name] for name in names}
    alone = {"shards": shards, "packing": [[shard.rows for shard in shards.values()]], "earlier": []}
    return replace(opened, manifest=opened.manifest.model_copy(update=alone))
