"""How much of the time blocks stick, and which never slip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, WindowRecord
from stickslip.sim.runs.series import EventSeries

_column = partial(Column, "number", least=0.0, most=1.0)


@dataclass(frozen=True)
class StickShare(WindowRecord):
    """The share of block time that sticks, and the share of blocks that never slip."""

    name = "stick_share"
    words = (
        "whether to keep the share of time that blocks stick after t_burn, and the share of blocks that never slip;"
        " or the former of which blocks"
    )
    columns = (
        _column(
            "stick_share",
            "share of the time after t_burn that a block sticks, mean over the blocks with friction",
            title="share of time that a block sticks",
            note="null if the run ended before, or no block has friction",
        ),
        _column(
            "never_slipped",
            "share of the blocks with friction that stick from t_burn to the end",
            title="share of blocks that never slip",
        ),
    )
    of_block = _column(
        "stick_share_{}",
        "share of the time after t_burn that {} sticks",
        title="share of time that {} sticks",
        note="null if the run ended before",
    )
    is_of_contacts = True
    needs = frozenset({"events", "system"})

    def of(self, result: Made) -> dict[str, Any]:
        events = result.events if self.blocks else result.contact_events
        if events.t_end <= self.t_burn or not events.n:
            return {}
        if self.blocks:
            return self.by_block(lambda k: self._share(events.of_blocks(np.arange(events.n) == k)))
        sticks = events.mode_at(self.t_burn) == 0
        sticks[events.block[events.t > self.t_burn]] = False  # a block that sticks leaves first
        return {"stick_share": self._share(events), "never_slipped": sticks.mean()}

    def _share(self, events: EventSeries) -> float:
        t, n_stick = events.change_points()
        edges = np.clip(np.append(t, events.t_end), self.t_burn, events.t_end)
        sticking = np.diff(edges) @ n_stick / ((events.t_end - self.t_burn) * events.n)
        return float(min(sticking, 1.0))  # but for rounding
