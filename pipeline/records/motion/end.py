"""The state at the end of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record


class End(Record):
    """The state at the end, at which runs of another scene can start."""

    name = "end"
    words = "whether to keep the state at the end, at which runs of another scene can start"
    takes_load = True
    columns = (
        Column(
            "numbers",
            "z_end",
            "displacement of each block at the end of the run, t_end or earlier",
            along="block",
            dimension="length",
        ),
        Column("numbers", "w_end", "velocity of each block then", along="block", dimension="speed"),
        Column("modes", "mode_end", "mode of each block then: -1 or +1 slips, 0 sticks", along="block"),
    )

    def of(self, result: Made) -> dict[str, Any]:
        run, mode = result.run, result.run.events.mode_after(len(result.run.events))
        # a block that slips after a collapse may have turned round without an event
        side = np.where(run.w > result.system.belt_speed_at(run.t_end), 1, -1)
        return {"z_end": run.z, "w_end": run.w, "mode_end": np.where(mode == 0, 0, side).astype(np.int8)}
