"""A run of the exact engine: its checks, the loop that `Coulomb.is_by_waves` picks, and its errors and warnings."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import several
from stickslip.sim.engines.certificates import Collapse, cost_of
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.coulomb import control, sparse, step, waves
from stickslip.sim.engines.coulomb.control import Goal
from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.model import Model, weakening_of
from stickslip.sim.engines.coulomb.overdamped import Slow, is_heavy
from stickslip.sim.engines.coulomb.sparse import Local
from stickslip.sim.engines.coulomb.windows import Work
from stickslip.sim.engines.course import State
from stickslip.sim.engines.forcing import Drive
from stickslip.sim.engines.several import Several, Slice
from stickslip.sim.numerics import products
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.system import System

if TYPE_CHECKING:
    from stickslip.sim.engines.coulomb.settings import Coulomb

#: More steps than this are warned of.
_MANY = 1e8
#: The motion after a collapse is summed from the eigenmodes if a bound of their rounding, some hundred times the
#: actual one, is below the tolerance, or below this.
_FOLLOWED = 1e-10
#: The slowest motion whose series do not leave float64, and the least friction.
_SLOWEST, _FAINTEST = 1e-24, 1e-280
#: The error of F at an event at which a run was cut, in tolerances of its terms.
_AT_EVENTS = 100.0


def runs(tasks: Sequence[Task], engine: Coulomb) -> list[Callable[[], Run]]:
    """The runs of some tasks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        Of a run: if numbers leave float64 on the way, or a block starts ahead of its belt without back slip.
    IntegrationError
        Of a run: if events accumulate at one instant.
    """

    def together(group: list[Task]) -> _Runs | None:
        return _Runs(group, engine) if _may_begin_together(group, engine) else None

    stored = [_stored(task, engine, _is_by_waves(task, engine)) for task in tasks]
    return several.runs(stored, together, partial(alone, engine))


def _is_by_waves(task: Task, engine: Coulomb) -> bool:
    return task.modes is None and engine.is_by_waves(task.system, task.length)


def _stored(task: Task, engine: Coulomb, by_waves: bool) -> Task:
    """The task with K as the method takes it, dense or sparse."""
    system = task.system
    if isinstance(system.stiffness, np.ndarray) != engine.is_sparse(system, by_waves):
        return task
    return task._replace(system=_otherwise(system))


@once_a_system
def _otherwise(system: System) -> System:
    """The system with its dense K as a sparse one, or the other way round."""
    if not isinstance(system.stiffness, np.ndarray):
        return system.changed(stiffness=system.stiffness.toarray())
    from scipy.sparse import csc_array  # it takes a tenth of a second to load

    return system.changed(stiffness=csc_array(system.stiffness))


def _may_begin_together(tasks: Sequence[Task], engine: Coulomb) -> bool:
    """Whether all are run by series, with products of one kind, and none is beyond float64 or heavily damped."""
    pull, damping = (np.array([getattr(task.system, name) for task in tasks]) for name in ("row_sums", "damping"))
    is_any_alone = is_heavy(damping, pull, 0.0).any() or any(
        _is_by_waves(task, engine) or _beyond_float64(task, True) for task in tasks
    )
    return not is_any_alone and products.are_of_one_kind(pull)


def alone(engine: Coulomb, task: Task) -> Run:
    """The run of a task, by the method that it takes; raises as those of `runs`."""
    by_waves = _is_by_waves(task, engine)
    if beyond := _beyond_float64(task, not by_waves):
        raise ValueError(f"system: expected {beyond}; take other units, as System.from_physical does")
    if not by_waves:
        return _by_series(task, engine)
    system, tol = task.system, engine.tol_of_waves(task.system, task.length)
    stored = _stored(task, engine, True)
    return waves.run(stored, tol, _followed(system, tol), lambda: _by_series(task, engine))


def _by_series(task: Task, engine: Coulomb) -> Run:
    return _Runs([_stored(task, engine, False)], engine).go_on(0)


def _followed(system: System, tol: float) -> float:
    """The error allowed in the motion after a collapse."""
    return max(tol * system.fastest_belt, _FOLLOWED)


class _Runs(Several):
    """By series; of one task alone if blocks are heavily damped, or K is sparse."""

    tells_touches, method = True, "Taylor series"
    stalled = (
        f"more than {control.STALL} instants that rounding cannot tell apart; this start is degenerate: perturb it,"
        " or use engine='sigmoid'"
    )

    def __init__(self, tasks: Sequence[Task], engine: Coulomb) -> None:
        self.tasks, self.engine = tasks, engine
        self.tols = np.array([engine.tol_of_series(task.system, task.length) for task in tasks])
        systems = [task.system for task in tasks]
        first = systems[0]  # if it is not plain, it is the only one
        self.drives = [Drive(task, control.ORDER_MAX + 1) for task in tasks]
        # arrays from here on are by task and block
        self.models = Model.of(systems, self.drives)
        self.rates = np.array([system.fastest_rate for system in systems])
        u = np.array([task.w0 for task in tasks]) - self.models.belt_speed
        mode, weakening = np.sign(u).astype(np.int8), first.weakening
        if weakening is not None:
            near, far = first.slip_friction
            self.rates += weakening.steepest * (near - far).max()
        if not first.back_slip:
            closed = first.closed
            _refuse_closed(closed * u[0], float(self.tols[0]) * first.fastest_belt)
            mode[mode * closed > 0] = 0
        exposures = [
            (1.0 / rate if rate > 0 else max(task.t_end - task.t_start, 1.0), 1.0)
            for rate, task in zip(self.rates.tolist(), tasks, strict=True)
        ]
        self.states = State.at_start(tasks, mode, exposures)
        self.decays = np.array(
            [0.5 * max(0.0, system.least_damping) if weakening is None else 0.0 for system in systems]
        )
        self.bounds, self.lengths = np.empty(len(tasks)), np.array([drive.length for drive in self.drives])
        self.collapse = [
            Collapse(task.system, _followed(task.system, tol), cost=cost_of(task, control.CERTIFICATE))
            for task, tol in zip(tasks, self.tols.tolist(), strict=True)
        ]
        may_be_slow = len(tasks) == 1 and weakening is None and first.cross_damping is None
        self.slow = Slow.of(first, self.drives[0].fastest) if may_be_slow else None
        self.is_of_one_type = first.is_plain and self.slow is None
        is_dense = isinstance(first.stiffness, np.ndarray)
        is_whole = is_dense or weakening is not None or self.drives[0].is_forced or self.slow is not None
        self.kernel, local = (step.advance, None) if is_whole else (sparse.advance, Local.of(first))
        expansion = Expansion.of(mode, weakening_of(first))
        if tasks[0].modes is not None:
            expansion.leaves[:] = np.where(mode == 0, tasks[0].modes, 0)
        self.work = Work(expansion, self.slow, local)
        self.initial_modes, self.events_a_step = expansion.initial_mode[:, np.newaxis], first.n

    def goal(self, drive: Drive) -> Goal[Floats]:
        return Goal(self.lengths, drive.is_last, -1.0, self.tols, self.rates, self.decays, self.bounds)

    def alone(self, k: int) -> Run:
        return _by_series(self.tasks[k], self.engine)

    def slice(self, k: int, bound: float) -> Slice:
        ended, task = super().slice(k, bound), self.tasks[k]
        if task.modes is not None:
            _require_modes(task, task.modes, self.initial_modes[k, 0], float(self.tols[k]))
        return ended

    def go_on(self, k: int, first_slice: Slice | None = None) -> Run:
        # `expand` itself limits a step to where the series of a force holds
        _warn_of_short_steps(self.tasks[k], float(self.rates[k]) if self.slow is None else self.slow.rate)
        return super().go_on(k, first_slice)


def _beyond_float64(task: Task, by_series: bool) -> str:
    """Which numbers of a task the method cannot follow, since what it takes of them leaves float64; "" if it can."""
    rate, most = task.system.fastest_rate, task.system.most_friction
    if 0.0 < most < _FAINTEST:
        return f"friction of at least {_FAINTEST:g}, or none, got {most:.3g}"
    if by_series and rate < _SLOWEST and rate * task.length > _FOLLOWED:
        return f"rates of at least {_SLOWEST:g}, got {rate:.3g}"
    return ""


def _warn_of_short_steps(task: Task, rate: float) -> None:
    """RuntimeWarning if blocks that slip throughout, at this rate, take more steps than most would wait for."""
    n_steps = rate * (task.t_end - task.t_start) / control.SPAN
    if n_steps > _MANY:
        fastest = f"damping up to {task.system.damping.max():g}, stiffness up to {task.system.row_sums.max():g} a row"
        warnings.warn(
            f"system: {fastest} allow steps of {control.SPAN / rate:.0e} while blocks slip, {n_steps:.0e} of them to"
            f" t = {task.t_end:g}: a minute or more for each 1e8; engine='sigmoid' takes long ones under damping",
            RuntimeWarning,
            stacklevel=2,
        )


def _require_modes(task: Task, modes: NDArray[np.int8], initial_modes: NDArray[np.int8], tol: float) -> None:
    """ValueError if a block cannot start in the mode that was asked for, within the tolerance."""
    if (modes == initial_modes).all():
        return
    s, z, t = task.system, task.z0, task.t_start
    v, force = s.belt_speed_at(t), s.holding_force(z, task.w0, t)
    # a run that was cut at an event has |F| at static friction to its own tolerance
    size = np.abs(s.damping * v) + s.row_sums * np.abs(z).max() + np.abs(s.force_at(t)) + s.static
    size += s.cross_sums * np.abs(task.w0).max()
    allowed = _AT_EVENTS * tol * size
    is_at_edge = (np.abs(task.w0 - v) <= tol * s.fastest_belt) & (np.abs(np.abs(force) - s.static) <= allowed)
    # but friction drives no block, and none slips to a side that is closed
    is_at_edge &= (modes * s.closed <= 0) & ((modes * force <= 0.0) | (s.static <= allowed))
    if ((modes != initial_modes) & ~is_at_edge).any():
        block = int(np.argmax((modes != initial_modes) & ~is_at_edge))
        raise ValueError(
            f"modes: expected what the state allows, got {modes[block]} for block {block}, which begins with"
            f" {initial_modes[block]}: off the belt's speed a block slips to its side, on it one sticks if |F| is at"
            " most its static friction, and slips, against F, if it is above its kinetic"
        )


def _refuse_closed(beyond: Floats, allowed: float) -> None:
    """ValueError if a block starts ahead of its belt by more than is allowed: no motion leads there."""
    if (beyond > allowed).any():
        block = int(np.argmax(beyond))
        raise ValueError(
            f"w0: expected no block ahead of its belt with back_slip=False, got block {block} ahead by"
            f" {beyond[block]:g}; start it at the belt's speed"
        )
