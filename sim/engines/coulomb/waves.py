"""Large dense systems, by waveform relaxation: the exact law on the macro steps of `stickslip.sim.engines.waveform`.

The series of the other loops need products of K with one coefficient after the other; here K meets the five nodes of
a step at once, in single precision after the first iteration. So it is the faster the more blocks there are, as far
as polynomials of degree five follow F; and its error is about the tolerance, where that of a series is far below.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stickslip.sim.engines import loop
from stickslip.sim.engines.certificates import Collapse
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import Drive
from stickslip.sim.engines.waveform import control as limits
from stickslip.sim.engines.waveform.control import Control, first_step
from stickslip.sim.engines.waveform.friction import SetValued
from stickslip.sim.engines.waveform.layout import Blocks, Exact, Model, Shared, Workspace, blank_tables
from stickslip.sim.engines.waveform.matrices import matrices_of
from stickslip.sim.engines.waveform.step import take_steps
from stickslip.sim.kernels.compile import kernel
from stickslip.sim.numerics.radau import NODES
from stickslip.sim.runs.run import Run, StalledError

#: Over static friction: a start at which |F| is so near to it is left to series, which decide it order by order.
_EDGE = 1e-9
#: The most pieces of a macro step, a block and beside.
_PIECES, _MORE = 8, 256


@kernel
def advance(model, work, control, state, events, bound, precheck):  # type: ignore[no-untyped-def]
    """Take steps; see `take_steps`."""
    return take_steps(model, work, control, state, events, bound, precheck)


def run(task: Task, tol: float, followed: float, otherwise: Callable[[], Run]) -> Run:
    """Run a task, or `otherwise`: if the start is on the edge between two modes, or, a restart, if it stalls.

    Parameters
    ----------
    task : Task
    tol : float
        Of a step.
    followed : float
        The error allowed in the motion after a collapse.
    otherwise : callable
        Runs it by series.
    """
    system, n = task.system, task.system.n
    drive = Drive(system, task.t_start, task.t_end, 0)
    z, w, v = task.z0, task.w0, drive.belt_speed
    drag = system.damping * v
    pull = drag + system.stiffness @ z
    near = (w == v) & (np.abs(np.abs(pull) - system.static) <= _EDGE * np.maximum(np.abs(pull), system.static))
    if task.modes is not None or near.any():
        return otherwise()
    mode = np.where(w != v, np.sign(w - v), np.where(np.abs(pull) < system.static, 0.0, -np.sign(pull)))
    modes = mode.astype(np.int8)[np.newaxis]
    tables = blank_tables(1, n)[0]
    block = Blocks(tables[:, :n])
    block.u0, block.z0, block.speed_before, block.belt, block.mode = w - v, z, np.abs(w), v, mode
    block.damping, block.friction, block.static = system.damping, system.friction, system.static
    block.drag, block.force0, block.row_sum = drag, pull, system.row_sums
    # as if there had been a step of length 1: F goes on along its tangent, or a block let go at once would leave late
    block.kept_f, block.kept_u = pull + np.outer(NODES - 1.0, system.stiffness @ w), (w - v)[np.newaxis]
    decay = 0.5 * max(0.0, system.least_damping)
    exact = Exact(limits.EXACT_CALIBRATION * tol, decay, system.fastest_belt)
    scale = max(system.fastest_belt, float(np.abs(w).max()))
    changes = np.abs(np.array([w, system.damping * (w - v) + pull, system.friction]))
    step = min(drive.length, limits.LONGEST_FIRST, scale * first_step(exact.tol, float(changes.max())))
    state = loop.of_run(loop.State.at_start([task], modes, [(step, 1.0, 0.0, 0.0)]), 0)
    state.counters[loop.N_PRODUCTS] = 2
    work = Workspace.of(tables, modes, False, _PIECES * n + _MORE, is_exact=True)
    Shared(work.shared).safety = 1.0
    unused = np.zeros((1, 0))
    model = Model(SetValued(), exact, *matrices_of(system), drive.forcing, unused, unused, np.ones(1, np.bool_))
    control = Control(drive.length, -1.0, np.inf, 1.0, limits.single_rate(float(system.row_sums.max())))
    collapse = Collapse(system, followed, cost=limits.certificate(task))

    def advance_a_slice(events: loop.Events, bound: float) -> tuple[int, int]:
        found: tuple[int, int] = advance(model, work, control, state, events, bound, collapse.precheck)
        return found

    plan = loop.Plan(
        advance_a_slice,
        stalled="a step fell to the rounding of time",
        events_a_step=len(work.changes.x),
        initial_modes=modes.copy(),
        tells_touches=True,
        method="waveform relaxation",
    )
    try:
        return loop.complete(task, state, drive, collapse, plan)
    except StalledError:
        run = otherwise()
        return replace(run, stats=run.stats.after(loop.stats_of(state.counters, 0, plan.method)))
