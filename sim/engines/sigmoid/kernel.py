"""The compiled kernel of the sigmoid engine."""

from __future__ import annotations

from stickslip.sim.engines import loop
from stickslip.sim.engines.precheck import precheck_of
from stickslip.sim.engines.waveform.control import control_of
from stickslip.sim.engines.waveform.layout import model_of, workspace_of
from stickslip.sim.engines.waveform.step import take_steps
from stickslip.sim.kernels.compile import kernel


@kernel
def advance(models, works, controls, states, events, bounds, precheck, slips, first, found):  # type: ignore
    """Advance runs of a stack, from the first on, by a slice; see `loop.begin`. `slips` are those of `Precheck`."""
    for row in range(len(found)):
        k = first + row
        state = loop.state_of(states, k)
        status, n_recorded = take_steps(
            model_of(models, k), workspace_of(works, k), control_of(controls, k), state,
            loop.rest_of(events, found, row), bounds[k], precheck_of(precheck, slips[k]),
        )  # fmt: skip
        loop.note_found(found, row, status, n_recorded, state.counters)
