"""When the first block with friction lets go."""

from __future__ import annotations

from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column, Until
from stickslip.pipeline.records.record import Made, Record


class FirstExit(Record):
    """The time of the first exit, and the block."""

    name = "first_exit"
    words = "whether to keep when the first block with friction that sticks lets go, and which"
    columns = (
        Column(
            "number",
            "first_exit",
            "time of the first exit",
            least=0.0,
            absent="no exit",
            title="time of the first exit",
            until=Until(),
            note="null, as below, if there is none",
            dimension="time",
        ),
        Column("whole", "first_exit_block", "the block that lets go first", is_averaged=False, is_index=True),
    )
    needs = frozenset({"events", "system"})

    def of(self, result: Made) -> dict[str, Any]:
        events = result.events
        exits = np.flatnonzero(events.is_exit & result.system.has_friction[events.block])
        if not len(exits):
            return {}
        return {"first_exit": events.t[exits[0]], "first_exit_block": int(events.block[exits[0]])}
