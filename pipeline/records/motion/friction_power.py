"""How much friction takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import StateRecord, mean_in_time
from stickslip.sim.runs.run import Samples
from stickslip.sim.systems.system import System


@dataclass(frozen=True)
class FrictionPower(StateRecord):
    """The power that slip turns into heat: sum over blocks of kinetic friction times |w - v|, by the exact law."""

    name = "friction_power"
    words = "whether to keep the power that friction turns into heat after t_burn, by the exact law"
    columns = (
        Column(
            "number",
            "friction_power",
            "heat of all blocks by slip on the belt, mean in time after t_burn",
            least=0.0,
            note="null if the run ended before, or is not of the exact law",
            dimension="power",
        ),
    )
    is_of_exact = True

    def of_states(self, samples: Samples, system: System) -> dict[str, Any]:
        slip = samples.w - system.belt_speed_at(samples.t)
        power = (system.kinetic(slip) * np.abs(slip)).sum(1)
        return {"friction_power": mean_in_time(power, samples)}
