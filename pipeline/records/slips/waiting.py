"""How long blocks wait between two exits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, WindowRecord


@dataclass(frozen=True)
class Waiting(WindowRecord):
    """The times between successive exits of the same block, over all blocks with friction."""

    name = "waiting"
    words = "whether to keep the mean and the scatter of times between exits of the same block after t_burn"
    columns = (
        Column(
            "count",
            "waiting_count",
            "number of times between successive exits of the same block after t_burn",
            least=0.0,
            title="number of waiting times",
            is_averaged=False,
        ),
        Column(
            "number",
            "waiting_mean",
            "mean of the times between successive exits of the same block after t_burn",
            least=0.0,
            absent="no block left twice",
            title="waiting time",
            of_gaps="mean",
            note="null if there are none",
            dimension="time",
        ),
        Column(
            "number",
            "waiting_cv",
            "standard deviation of these times over their mean",
            least=0.0,
            absent="fewer than two times",
            title="coefficient of variation of waiting times",
            of_gaps="scatter",
            note="null with fewer than two",
        ),
    )
    is_of_contacts = True
    needs = frozenset({"events", "system"})

    def of(self, result: Made) -> dict[str, Any]:
        events = result.contact_events
        exits = np.flatnonzero(events.is_exit & (events.t >= self.t_burn))
        order = exits[np.argsort(events.block[exits], kind="stable")]  # in time within a block
        gaps = np.diff(events.t[order])[np.diff(events.block[order]) == 0]
        values: dict[str, Any] = {"waiting_count": len(gaps)}
        if len(gaps):
            values["waiting_mean"] = gaps.mean()
        if len(gaps) > 1:
            values["waiting_cv"] = gaps.std(ddof=1) / gaps.mean()
        return values
