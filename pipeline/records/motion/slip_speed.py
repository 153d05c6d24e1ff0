"""How fast blocks slip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import StateRecord, mean_in_time
from stickslip.sim.runs.run import Samples
from stickslip.sim.systems.system import System

_speed = partial(Column, "number", least=0.0, dimension="speed")


@dataclass(frozen=True)
class SlipSpeed(StateRecord):
    """Mean and root mean square of |w - v|, over blocks and time."""

    name = "slip_speed"
    words = "whether to keep the speed of slip after t_burn, over blocks and time; or of which blocks"
    columns = (
        _speed(
            "slip_speed",
            "mean of |w - v| over blocks with friction and time after t_burn, 0 while they stick",
            note="null if the run ended before, or no block has friction",
        ),
        _speed(
            "slip_speed_rms",
            "root mean square of |w - v| over blocks with friction and time after t_burn",
            title="root mean square of the slip speed",
        ),
    )
    of_block = _speed(
        "slip_speed_{}",
        "mean of |w - v| of {} over time after t_burn, 0 while it sticks",
        title="slip speed of {}",
        note="null if the run ended before",
    )
    is_of_contacts = True

    def of_states(self, samples: Samples, system: System) -> dict[str, Any]:
        if self.blocks:
            slip = np.abs(samples.w - system.belt_speed_at(samples.t))
            return self.by_block(lambda k: mean_in_time(slip[:, k], samples))
        rubs = system.has_friction
        if not rubs.any():
            return {}
        slip = np.abs(samples.w - system.belt_speed_at(samples.t))[:, rubs]
        mean, square = (mean_in_time(values.mean(1), samples) for values in (slip, slip**2))
        return {"slip_speed": mean, "slip_speed_rms": np.sqrt(square)}
