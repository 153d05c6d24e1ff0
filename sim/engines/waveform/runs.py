"""Runs by macro steps as stacks: their tables of blocks, whatever the law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import course
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import Drive
from stickslip.sim.engines.several import Several
from stickslip.sim.engines.waveform import control
from stickslip.sim.engines.waveform.control import Control
from stickslip.sim.engines.waveform.layout import Blocks, Model, Workspace
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.panels import HEIGHT
from stickslip.sim.systems.system import System


class WaveformRuns(Several):
    """Runs by macro steps; a subclass fills in its law. Arrays are by task and block, or task, definition and block.

    `tables` are those of `tables_of`, with the rows of a smooth law; they are copied, and filled in with the start.
    """

    block: Blocks  #: at the start; u and F are kept as if they had been constant before
    models: Model
    work: Workspace
    safety: float  #: as of `Control`
    longest: float  #: as of `Control`

    def __init__(self, tasks: Sequence[Task], tables: Floats) -> None:
        self.tasks, self.tables = tasks, tables.copy()
        self.drives = [Drive(task, orders=0) for task in tasks]
        block = self.block = Blocks(self.tables[..., : tasks[0].system.n])
        z, w = np.array([task.z0 for task in tasks]), np.array([task.w0 for task in tasks])
        v = np.array([drive.belt_speed for drive in self.drives])
        u = w - v
        block.u0, block.z0, block.speed_before, block.belt = u, z, np.abs(w), v
        forces = [forces_of(task.system, *start) for task, *start in zip(tasks, self.drives, z, w, strict=True)]
        drag, force = np.array(forces).swapaxes(0, 1)
        block.drag, block.force0 = drag, force
        block.kept_f, block.kept_u, block.kept_z = force[:, np.newaxis], u[:, np.newaxis], z[:, np.newaxis]
        if self.drives[0].is_forced:
            block.kept_f += self.drives[0].value()
        block.z_near = np.inf  # no product is known
        self.bounds, self.lengths = np.empty(len(tasks)), np.array([drive.length for drive in self.drives])

    def begin_clocks(self, modes: NDArray[np.int8], tol: float, scale: float = 1.0) -> Floats:
        """Set the state at the start, in these modes, and the bounds of products in single precision.

        Returns the first step of each run, by the error of w allowed in it over its scale.
        """
        block = self.block
        changes = np.maximum(block.speed_before, np.abs(block.damping * block.u0 + block.force0)).max(axis=1)
        speeds = np.maximum(changes, [task.system.most_friction for task in self.tasks]).tolist()
        firsts = [min(control.LONGEST_FIRST, scale * control.first_step(tol, speed)) for speed in speeds]
        steps = np.minimum(self.lengths, firsts)
        self.states = course.State.at_start(self.tasks, modes[:, 0].copy(), [(step, 1.0, 0.0, 0.0) for step in steps])
        self.single_rates = control.single_rate(block.row_sum.max(axis=1)) / control.SINGLE_SHARE
        return steps

    def goal(self, drive: Drive) -> Control[Floats]:
        longest = min(self.longest, np.pi / drive.fastest) if drive.fastest > 0 else self.longest
        return Control(
            self.lengths, drive.is_last, drive.instant, self.bounds, longest, self.safety, self.single_rates
        )


def tables_of(systems: Sequence[System]) -> Floats:
    """Tables of `Blocks` with the rows that systems fill in; columns beyond the last block have harmless numbers."""
    n = systems[0].n
    tables = np.zeros((len(systems), Blocks.n_rows, -(-n // HEIGHT) * HEIGHT))
    whole, block = Blocks(tables), Blocks(tables[..., :n])
    whole.steep = whole.h = whole.done = whole.tolerance = 1.0
    block.damping, block.static, block.closed, block.friction, block.row_sum = np.array(
        [[one.damping, one.static, one.closed, one.slip_friction[0], one.row_sums] for one in systems]
    ).swapaxes(0, 1)
    return tables


def forces_of(system: System, drive: Drive, z: Floats, w: Floats) -> tuple[Floats, Floats]:
    """The part of F from damping at the belts' speeds, and F, at the start of a piece."""
    v, cross = drive.belt_speed, system.cross_damping
    drag, pull = system.damping * v, system.damping * v + system.stiffness @ z
    if cross is not None:
        drag += cross.sum(axis=1) * v[0] if system.has_one_belt else cross @ v
        pull += cross @ w
    if drive.is_forced:
        pull -= drive.value()
    return drag, pull
