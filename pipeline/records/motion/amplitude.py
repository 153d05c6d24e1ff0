"""How far blocks swing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import StateRecord
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Samples
from stickslip.sim.systems.system import System

_length = partial(Column, "number", least=0.0, dimension="length")


@dataclass(frozen=True)
class Amplitude(StateRecord):
    """Half of peak to peak of z, over the blocks."""

    name = "amplitude"
    words = "whether to keep the amplitude of motion after t_burn, half of peak to peak of z; or of which blocks"
    columns = (
        _length(
            "amplitude",
            "half of peak to peak of z after t_burn, the largest of the blocks",
            title="amplitude of the block that swings most",
            note="null if the run ended before",
        ),
        _length(
            "amplitude_mean",
            "half of peak to peak of z after t_burn, mean over the blocks",
            title="amplitude averaged over the blocks",
        ),
    )
    of_block = _length(
        "amplitude_{}",
        "half of peak to peak of z of {} after t_burn",
        title="amplitude of {}",
        note="null if the run ended before",
    )

    def of_states(self, samples: Samples, system: System) -> dict[str, Any]:
        turns = _turns(samples)
        half = (np.maximum(samples.z.max(0), turns.max(0)) - np.minimum(samples.z.min(0), turns.min(0))) / 2
        if self.blocks:
            return self.by_block(half.__getitem__)
        return {"amplitude": half.max(), "amplitude_mean": half.mean()}


def _turns(samples: Samples) -> Floats:
    """z where blocks turn round between two samples, shape (m - 1, n); at the first of the two where they do not.

    The cubic through z and w at both, at the zero of the line through w: an error of order dt^4 between events.
    """
    step = np.diff(samples.t)[:, None]
    (z0, z1), (w0, w1) = ((states[:-1], states[1:]) for states in (samples.z, samples.w))
    does = w0 * w1 < 0
    x = np.divide(w0, w0 - w1, out=np.zeros_like(w0), where=does)
    y = 1 - x
    return y**2 * (1 + 2 * x) * z0 + x**2 * (1 + 2 * y) * z1 + step * x * y * (y * w0 - x * w1)
