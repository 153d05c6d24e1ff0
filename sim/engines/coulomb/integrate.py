"""A run of the exact engine: its checks, the choice of its loop, and its errors and warnings."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import loop
from stickslip.sim.engines.certificates import Collapse
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.coulomb import control, sparse, step, waves
from stickslip.sim.engines.coulomb.model import Model
from stickslip.sim.engines.coulomb.overdamped import Slow
from stickslip.sim.engines.coulomb.taylor import Expansion
from stickslip.sim.engines.coulomb.windows import Goal, Search
from stickslip.sim.engines.forcing import Drive
from stickslip.sim.engines.loop import Events, State
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Pairs
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.system import System

if TYPE_CHECKING:
    from stickslip.sim.engines.coulomb.settings import Coulomb

#: A touch w - v = a s^2 / 2 with an error of the tolerance becomes two events 2 (2 tol |v| / a)^(1/2) apart, where a
#: is about |v| rate^2, or none: events closer than this many tol^(1/2) / rate are a touch.
_TOUCH = 4.0
#: More steps than this are warned of.
_MANY = 1e8
#: The motion after a collapse is summed from the eigenmodes if a bound of their rounding, some hundred times the
#: actual one, is below the tolerance, or below this.
_FOLLOWED = 1e-10
#: The error of F at an event at which a run was cut, in tolerances of its terms.
_AT_EVENTS = 100.0


def runs(tasks: Sequence[Task], engine: Coulomb) -> list[Callable[[], Run]]:
    """The runs of a task, or of several with plain systems of as many blocks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        Of a run: if the system has cross damping, or a block starts ahead of its belt without back slip.
    IntegrationError
        Of a run: if events accumulate at one instant.
    """
    tol = min(engine.tol, control.LOOSEST)
    is_by_waves = [engine.is_by_waves(task.system) for task in tasks]
    by_series = iter(_by_series([task for task, by in zip(tasks, is_by_waves, strict=True) if not by], tol))
    return [_by_waves(task, tol) if by else next(by_series) for task, by in zip(tasks, is_by_waves, strict=True)]


def _by_waves(task: Task, tol: float) -> Callable[[], Run]:
    """The run of a task by `waves`."""
    system = task.system
    shortest, touch = _shortest(system.rates, system.static, system.friction, tol), _TOUCH * math.sqrt(tol)
    return partial(
        waves.run, task, tol, _followed(system, tol), shortest, touch, lambda: _by_series([task], tol)[0]()
    )


def _by_series(tasks: Sequence[Task], tol: float) -> list[Callable[[], Run]]:
    """The runs of some tasks by series."""
    if not tasks:
        return []
    systems = [task.system for task in tasks]
    # arrays from here on are by task and block
    rates, static, near, row_sums = (
        np.array(rows)
        for rows in zip(
            *((one.rates, one.static, one.slip_friction[0], one.row_sums) for one in systems), strict=True
        )
    )
    of_runs = zip(
        tasks,
        Pairs.of([one.stiffness for one in systems], row_sums),
        rates.max(axis=1).tolist(),
        _shortest(rates, static, near, tol),
        strict=True,
    )
    return [partial(_integrate, tol, *of_run) for of_run in of_runs]


def _shortest(rates: Floats, static: Floats, near: Floats, tol: float) -> Floats:
    """How long a change of each block's mode must last to be an event: with a static friction above the kinetic, any.

    A touch sticks there, until F has gone from the kinetic to the static.
    """
    is_touch = (rates > 0) & (static == near)
    return np.divide(_TOUCH * math.sqrt(tol), rates, out=np.zeros_like(rates), where=is_touch)


def _followed(system: System, tol: float) -> float:
    """The error allowed in the motion after a collapse."""
    return max(tol * system.fastest_belt, _FOLLOWED)


def _integrate(tol: float, task: Task, pairs: Pairs, rate: float, shortest: Floats) -> Run:
    """Run a task. `rate` bounds |eigenvalues|; `expand` itself limits a step to where the series of a force holds."""
    system = task.system
    drive = Drive(system, task.t_start, task.t_end, control.ORDER_MAX + 1)
    model, v = Model.of(system, pairs, drive), drive.belt_speed
    near, far = system.slip_friction
    if model.weakening is not None:
        rate += model.weakening.steepness * float((near - far).max())
    mode = np.sign(task.w0 - v).astype(np.int8)
    if not system.back_slip:
        _refuse_closed(system.closed * (task.w0 - v), tol * system.fastest_belt)
        mode[mode * system.closed > 0] = 0
    exposure = 1.0 / rate if rate > 0 else max(task.t_end - task.t_start, 1.0)
    state = State.at_start(task, task.z0.copy(), task.w0.copy(), mode, exposure, 1.0)
    expansion, search = (
        Expansion.blank(mode, 0 if system.weakening is None else system.weakening.n_series),
        Search.of(mode),
    )
    if task.modes is not None:
        expansion.leaves[:] = np.where(mode == 0, task.modes, 0)
    collapse = Collapse(system, _followed(system, tol), cost=control.certificate(task))
    slow = Slow.of(system, drive.fastest) if model.weakening is None else None
    _warn_of_short_steps(task, rate if slow is None else slow.rate)
    is_local = len(model.columns.dense) == 0 and not drive.is_forced and model.weakening is None and slow is None

    def advance(events: Events, bound: float) -> tuple[int, int]:
        goal = Goal(drive.length, drive.is_last, tol, rate, bound)
        if is_local:
            found = sparse.advance(model, goal, state, expansion, search, room, events, collapse.precheck)
        else:
            found = step.advance(model, goal, state, expansion, search, slow, events, collapse.precheck)
        if task.modes is not None:
            _require_modes(task, task.modes, search.initial_mode, tol)
        return found

    if is_local:
        room = sparse.Local.of(system.n, float(system.row_sums.max()))
    plan = loop.Plan(
        advance,
        stalled=f"more than {control.STALL} instants that rounding cannot tell apart; this start is degenerate:"
        " perturb it, or use engine='sigmoid'",
        events_a_step=system.n,
        initial_modes=search.initial_mode[np.newaxis],
        shortest=shortest,
        touch=_TOUCH * math.sqrt(tol),
        method="Taylor series",
    )
    return loop.complete(task, state, drive, collapse, plan)


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


def _require_modes(task: Task, asked: NDArray[np.int8], found: NDArray[np.int8], tol: float) -> None:
    """ValueError if a block cannot start in the mode that was asked for, within the tolerance."""
    if (asked == found).all():
        return
    s, z, t = task.system, task.z0, task.t_start
    v, force = s.belt_speed_at(t), s.holding_force(z, task.w0, t)
    # a run that was cut at an event has |F| at static friction to its own tolerance
    size = np.abs(s.damping * v) + s.row_sums * np.abs(z).max() + np.abs(s.force_at(t)) + s.static
    allowed = _AT_EVENTS * tol * size
    is_at_edge = (np.abs(task.w0 - v) <= tol * s.fastest_belt) & (np.abs(np.abs(force) - s.static) <= allowed)
    # but friction drives no block, and none slips to a side that is closed
    is_at_edge &= (asked * s.closed <= 0) & ((asked * force <= 0.0) | (s.static <= allowed))
    if ((asked != found) & ~is_at_edge).any():
        block = int(np.argmax((asked != found) & ~is_at_edge))
        raise ValueError(
            f"modes: expected what the state allows, got {asked[block]} for block {block}, which begins with"
            f" {found[block]}: off the belt's speed a block slips to its side, on it one sticks if |F| is at most"
            " its static friction, and slips, against F, if it is above its kinetic"
        )


def _refuse_closed(beyond: Floats, allowed: float) -> None:
    """ValueError if a block starts ahead of its belt by more than is allowed: no motion leads there."""
    if (beyond > allowed).any():
        block = int(np.argmax(beyond))
        raise ValueError(
            f"w0: expected no block ahead of its belt with back_slip=False, got block {block} ahead by"
            f" {beyond[block]:g}; start it at the belt's speed"
        )
