"""How much of the time blocks stick, and which never slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, WindowRecord
from stickslip.sim.runs.series import EventSeries


@dataclass(frozen=True)
class StickShare(WindowRecord):
    """The share of block time that sticks, and the share of blocks that never slip."""

    name = "stick_share"
    words = (
        "whether to keep the share of time that blocks stick after t_burn, and the share of blocks that never slip;"
        " or the former of which blocks"
    )
    columns = (
        Column(
            "number",
            "stick_share",
            "share of the time after t_burn that a block sticks, mean over the blocks with friction",
            least=0.0,
            most=1.0,
            title="share of time that a block sticks",
            note="null if the run ended before, or no block has friction",
        ),
        Column(
            "number",
            "never_slipped",
            "share of the blocks with friction that stick from t_burn to the end",
            least=0.0,
            most=1.0,
            title="share of blocks that never slip",
        ),
    )
    of_block = Column(
        "number",
        "stick_share_{}",
        "share of the time after t_burn that {} sticks",
        least=0.0,
        most=1.0,
        title="share of time that {} sticks",
        note="null if the run ended before",
    )
    is_of_contacts = True
    needs = frozenset({"events", "system"})

    def of(self, result: Made) -> dict[str, Any]:
        if self.blocks:
            return self._of_blocks(result.events)
        events = result.contact_events
        end = events.t_end
        if end <= self.t_burn or not events.n:
            return {}
        t, n_stick = events.change_points()
        edges = np.clip(np.append(t, end), self.t_burn, end)
        sticks = events.mode_at(self.t_burn) == 0
        sticks[events.block[events.t > self.t_burn]] = False  # a block that sticks leaves first
        return {
            "stick_share": min(np.diff(edges) @ n_stick / ((end - self.t_burn) * events.n), 1.0),  # but for rounding
            "never_slipped": sticks.mean(),
        }

    def _of_blocks(self, events: EventSeries) -> dict[str, Any]:
        if events.t_end <= self.t_burn:
            return {}
        shares = np.zeros(events.n)
        for _, k in self.blocks:
            t, mode = events.t[events.block == k], events.mode[events.block == k]
            edges = np.clip([events.t_start, *t, events.t_end], self.t_burn, events.t_end)
            sticks = np.append(events.initial_mode[k], mode) == 0
            shares[k] = min(np.diff(edges) @ sticks / (events.t_end - self.t_burn), 1.0)  # but for rounding
        return self.by_block(shares)
