"""The compiled kernel of the sigmoid engine."""

from __future__ import annotations

from stickslip.sim.engines.waveform.step import take_steps
from stickslip.sim.kernels.compile import kernel


@kernel
def advance(model, work, control, state, events, bound, precheck):  # type: ignore[no-untyped-def]
    """Take steps; see `take_steps`."""
    return take_steps(model, work, control, state, events, bound, precheck)
