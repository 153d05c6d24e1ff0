"""Every event of a run."""

from __future__ import annotations

from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record


class Events(Record):
    """Every entry, exit and crossing, and each block's mode at the start."""

    name = "events"
    words = "whether to keep every event"
    example = None
    takes_load = True
    columns = (
        Column(
            "numbers",
            "event_t",
            "times of the events, never decreasing",
            along="event",
            repeats=False,
            is_time=True,
            dimension="time",
        ),
        Column("wholes", "event_block", "block of each event", along="event", is_index=True),
        Column("modes", "event_mode", "the block's mode from the event on: -1 or +1 slips, 0 sticks", along="event"),
        Column("modes", "initial_mode", "mode of each block at t = 0", along="block"),
    )
    is_of_paths = True

    def of(self, result: Made) -> dict[str, Any]:
        series = result.run.events
        return {
            "event_t": series.t,
            "event_block": series.block,
            "event_mode": series.mode,
            "initial_mode": series.initial_mode,
        }
