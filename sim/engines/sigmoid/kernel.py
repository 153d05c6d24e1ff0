"""The compiled kernel of the sigmoid engine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.precheck import precheck_of
from stickslip.sim.engines.stacks import note_found, rest_of
from stickslip.sim.engines.waveform.control import Control, control_of
from stickslip.sim.engines.waveform.layout import Model, Workspace, model_of, workspace_of
from stickslip.sim.engines.waveform.step import take_steps
from stickslip.sim.kernels.compile import kernel
from stickslip.sim.numerics.arguments import Floats


class Stack(NamedTuple):
    """Runs that are advanced by one call: by run, what `take_steps` takes."""

    model: Model
    work: Workspace
    control: Control
    state: loop.State
    bound: Floats
    slip: NDArray[np.int64]  #: of the pre-check


@kernel
def advance(stack, events, precheck, first, found):  # type: ignore[no-untyped-def]
    """Advance runs of a stack, from the first on, by a slice; see `stacks`."""
    for row in range(len(found)):
        k = first + row
        state = loop.state_of(stack.state, k)
        status, n_recorded = take_steps(
            model_of(stack.model, k), workspace_of(stack.work, k), control_of(stack.control, k), state,
            rest_of(events, found, row), stack.bound[k], precheck_of(precheck, stack.slip[k]),
        )  # fmt: skip
        note_found(found, row, status, n_recorded, state.counters)
