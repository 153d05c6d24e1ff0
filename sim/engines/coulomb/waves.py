"""Large dense systems, by waveform relaxation: the exact law on the macro steps of `stickslip.sim.engines.waveform`.

The series of the other loops need products of K with one coefficient after the other; here K meets the five nodes of
a step at once, in single precision after the first iteration. So it is the faster the more blocks there are, as far
as polynomials of degree five follow F; and its error is about the tolerance, where that of a series is far below.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stickslip.sim.engines import course
from stickslip.sim.engines.certificates import Collapse, cost_of
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.frame import frame
from stickslip.sim.engines.sigmoid_law import SetValued
from stickslip.sim.engines.waveform import control as limits
from stickslip.sim.engines.waveform.layout import Exact, Model, Shared, Workspace
from stickslip.sim.engines.waveform.matrices import matrices_of, signed_sum
from stickslip.sim.engines.waveform.runs import WaveformRuns, tables_of
from stickslip.sim.engines.waveform.step import way
from stickslip.sim.numerics.radau import NODES
from stickslip.sim.runs.run import Run, StalledError

#: Over static friction: a start at which |F| is so near to it is left to series, which decide it order by order.
_EDGE = 1e-9
#: The most pieces of a macro step, a block and beside.
_PIECES, _MORE = 8, 256


class _Waves(WaveformRuns):
    """Of one task."""

    kernel, tells_touches, method = staticmethod(frame(way, __name__)), True, "waveform relaxation"
    is_of_one_type = True
    stalled = "a step fell to the rounding of time"
    safety, longest = 1.0, np.inf

    def __init__(self, task: Task, tol: float, followed: float) -> None:
        super().__init__([task], tables_of([task.system]))
        system, block, n = task.system, self.block, task.system.n
        u, pull = block.u0, block.force0
        size = np.maximum(np.abs(pull), block.static)
        self.is_on_edge = bool(((u == 0.0) & (np.abs(np.abs(pull) - block.static) <= _EDGE * size)).any())
        block.mode = np.where(u != 0.0, np.sign(u), np.where(np.abs(pull) < block.static, 0.0, -np.sign(pull)))
        # as if after a step of length 1: F goes on along its tangent, or a block let go at once would leave late
        block.kept_f += np.outer(NODES - 1.0, system.stiffness @ task.w0)
        block.kept_z += np.outer(NODES - 1.0, task.w0)
        modes = block.mode.astype(np.int8)[np.newaxis]
        self.initial_modes = modes.copy()
        self.collapse = [Collapse(system, followed, cost=cost_of(task, limits.CERTIFICATE))]
        exact = Exact(limits.EXACT_CALIBRATION * tol, 0.5 * max(0.0, system.least_damping), system.fastest_belt)
        self.begin_clocks(modes, exact.tol, max(system.fastest_belt, float(np.abs(task.w0).max())))
        self.single_rates = limits.single_rate(np.array([signed_sum(system)])) / limits.EXACT_SINGLE_SHARE
        self.states.counters[:, course.N_PRODUCTS] = 2
        self.work = Workspace.of(self.tables, modes, False, _PIECES * n + _MORE, is_exact=True)
        self.events_a_step, Shared(self.work.shared).safety = len(self.work.changes.x), self.safety
        unused = np.zeros((1, 1, 0))
        self.models = Model(
            SetValued(),
            exact,
            *matrices_of(system),
            course.stack([self.drives[0].forcing]),
            unused,
            unused,
            np.ones((1, 1), np.bool_),
        )

    def alone(self, k: int) -> Run:
        return self.go_on(k)


def run(task: Task, tol: float, followed: float, otherwise: Callable[[], Run]) -> Run:
    """Run a task, or `otherwise`: if the start is on the edge between two modes, or, a restart, if it stalls.

    `tol` is that of a step, and `followed` the error allowed in the motion after a collapse.
    """
    waves = _Waves(task, tol, followed)
    if waves.is_on_edge:
        return otherwise()
    try:
        return waves.go_on(0)
    except StalledError:
        run = otherwise()
        return replace(run, stats=run.stats.after(waves.stats(0, 0)))
