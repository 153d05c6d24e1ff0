"""How fast blocks slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.pipeline.records.column import Column
from stickslip.pipeline.records.record import Made, StateRecord


@dataclass(frozen=True)
class SlipSpeed(StateRecord):
    """Mean and root mean square of |w - v|, over blocks and time."""

    name = "slip_speed"
    words = "whether to keep the speed of slip after t_burn, over blocks and time"
    asked_by = "`slip_speed = true` under [record]"
    columns = (
        Column(
            "number",
            "slip_speed",
            "mean of |w - v| over blocks and time after t_burn, 0 while they stick; null if the run ended before",
        ),
        Column("number", "slip_speed_rms", "its root mean square"),
    )

    def of(self, made: Made) -> dict[str, Any]:
        samples = made.samples(self.times(made.member))
        if len(samples) < 2:
            return {}
        slip = np.abs(samples.w - made.system.belt_speed_at(samples.t))
        span = samples.t[-1] - samples.t[0]
        mean, square = (np.trapezoid(one.mean(1), samples.t) / span for one in (slip, slip**2))
        return {"slip_speed": mean, "slip_speed_rms": np.sqrt(square)}
