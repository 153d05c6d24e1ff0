"""A run of the engine `sigmoid`: the tables that its kernels work on, from a system and the engine's settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import certificates, loop
from stickslip.sim.engines.contract import Ratios, Task
from stickslip.sim.engines.forcing import Drive
from stickslip.sim.engines.sigmoid.collocation import (
    AT_PEAK,
    BELT,
    CLOSED,
    DAMPING,
    DONE,
    DRAG,
    FALL,
    FAR,
    FINE,
    FORCE0,
    FRICTION,
    HIDDEN,
    KEPT_F,
    KEPT_U,
    N_ROWS,
    PASSED,
    PEAK,
    REACH,
    ROW_SUM,
    SPEED_BEFORE,
    STATIC,
    STEEP,
    STEP_H,
    TOLERANCE,
    U0,
    Z0,
    H,
)
from stickslip.sim.engines.sigmoid.friction import Exponential, Peaked, Plain, Rational, Steady
from stickslip.sim.engines.sigmoid.layer import PASSES, PIECE
from stickslip.sim.engines.sigmoid.step import BOOST, JUMPED, POWER, STEP, advance
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.lanes import WIDTH
from stickslip.sim.numerics.panels import HEIGHT, ROUGH, SINGLE_HEIGHT, panels
from stickslip.sim.numerics.radau import STAGES
from stickslip.sim.runs.run import Run
from stickslip.sim.systems import friction as laws
from stickslip.sim.systems.friction import hidden_term, turning_point
from stickslip.sim.systems.system import System

if TYPE_CHECKING:
    from stickslip.sim.engines.sigmoid.settings import Sigmoid

#: The tolerances inside over those asked for: so chosen that random systems err by what was asked for.
_CALIBRATION = 5.0
#: Where a step of a block's own has passed the layer, its error counts by so many times the boost.
_PASSED = 3.0
#: What a step may err by at a peak of friction, over the root of what was asked for: F there is within the square of
#: static friction.
_OF_ROOT = 0.5
#: The share of a step's tolerance that is for leaving a peak of friction, over delta^(2/3): see `NEAR_PEAK`.
_FINE = 0.1
#: Slower than at this rate, in units of time, what has left a peak of friction by weakening alone is no matter.
_STEEP = 10.0
#: Of friction: by how much F jumps where a belt's speed begins to change by another rate, if it is no rounding.
_JUMP = 1e-9
#: The laws of weakening whose shapes the engine knows.
_SHAPES: dict[type[laws.Weakening], type[Rational] | type[Exponential]] = {
    laws.Rational: Rational,
    laws.Stribeck: Exponential,
}


def runs(tasks: Sequence[Task], engine: Sigmoid) -> list[Callable[[], Run]]:
    """The runs of a task, or of several with plain systems of as many blocks: see `Engine.prepare`.

    Raises
    ------
    ValueError
        If there is not one ratio a block, the layer is too wide for its definition of sticking, or a block has
        static friction alone.
    IntegrationError
        Of a run: if the step shrinks to rounding.
    """
    systems = [task.system for task in tasks]
    system, n = systems[0], systems[0].n  # where it is not plain, it is the only one
    delta = Ratios.for_blocks("ratio", engine.ratio, n) * engine.eps
    is_manifold = engine.stick == "manifold"
    if is_manifold and not (delta < 1).all():
        raise ValueError(
            f"eps, ratio: stick='manifold' needs ratio * eps < 1, got {delta.max():g}; use stick='threshold'"
        )
    band = delta * np.log(1 / delta) if is_manifold else engine.threshold * delta
    by_force = np.array([is_manifold, *(False for _ in engine.thresholds)])
    rtol, atol = _CALIBRATION * engine.rtol, _CALIBRATION * engine.atol
    boost = max(1.0, BOOST * (atol + rtol) ** (POWER - 1.0))
    allowed = engine.atol + engine.rtol * np.array([one.fastest_belt for one in systems])
    law, hidden, peak = _law(system)
    if system.weakening is not None:
        peak = _peak(system, delta, hidden)

    # from here on by task and block, or by task, definition of sticking and block
    drives = [Drive(task.system, task.t_start, task.t_end, 0) for task in tasks]
    v = np.array([drive.belt_speed for drive in drives])
    z, w = np.array([task.z0 for task in tasks]), np.array([task.w0 for task in tasks])
    damping, friction, static, closed = (
        np.array([getattr(one, name) for one in systems]) for name in ("damping", "friction", "static", "closed")
    )
    near, far = (np.array(rows) for rows in zip(*(one.slip_friction for one in systems), strict=True))
    bands = np.array([band, *(c * delta for c in engine.thresholds)])
    bands = bands * (near > 0.0)[:, np.newaxis]  # without friction no block sticks
    kinetic = np.empty_like(bands)
    for k, one in enumerate(systems):
        kinetic[k] = one.kinetic(bands[k])
    drag, pull = (np.array(rows) for rows in zip(*map(_forces, systems, drives, z, w), strict=True))
    u = w - v
    modes = _modes(u, pull, bands, is_manifold, peak * delta, near, static, closed)
    table = _table(z, w, u, delta, damping, near, drag, pull)
    table[:, BELT, :n], table[:, STATIC, :n], table[:, CLOSED, :n] = v, static, closed
    table[:, PASSED, :n], table[:, AT_PEAK, :n] = _PASSED * boost, _OF_ROOT * np.sqrt(engine.atol + engine.rtol)
    table[:, HIDDEN, :n], table[:, PEAK, :n] = hidden, peak * delta
    table[:, ROW_SUM, :n] = np.array([one.row_sums for one in systems])
    table[:, FINE, :n] = np.where(peak < np.inf, np.minimum(_FINE * delta ** (2.0 / 3.0), 1.0), 1.0)
    if system.weakening is not None:
        table[:, FALL, :n] = system.weakening.steepness * delta
        table[:, FAR, :n] = np.divide(far, near, out=np.ones_like(near), where=near > 0)
    # how deep in the layer friction differs from kinetic by what counts
    table[:, REACH, :n] = 1.0 + 0.5 * np.log1p(2.0 * near * (1.0 + 2.0 * hidden) / (boost * atol))
    fastest = np.abs(np.array([w, damping * u + pull, friction])).max(axis=(0, 2)).tolist()
    matrices, widest = _matrices(systems), bands.max(axis=(1, 2)).tolist()
    pulls = np.array([one.row_sums for one in systems]).max(axis=1).tolist()
    n_pieces = 16 * n + 256

    def first_step(speed: float) -> float:
        return (atol**0.2) * 0.3 / speed if speed > 0 else np.inf

    @cache
    def smoothed(speed: float, widest: float) -> certificates.Smoothed:
        return certificates.Smoothed(speed, delta, hidden, float(band.max()), widest)

    def run(k: int) -> Run:
        task, system, drive, own = tasks[k], systems[k], drives[k], table[k]
        z, w, next_h = task.z0.copy(), task.w0.copy(), np.empty(n)
        step = min(drive.length, 0.1, first_step(fastest[k]))
        next_h[:] = step / 4
        state = loop.State.at_start(task, z, w, modes[k, 0], step, 1.0, 0.0, 0.0)
        state.counters[loop.N_PRODUCTS] = 1 if system.cross_damping is None else 2
        numbers = np.zeros((STAGES + 1, STAGES))
        numbers[STAGES, STEP_H + 1 :] = atol, rtol, boost, 0.0
        single = np.zeros((2, STAGES, -(-n // SINGLE_HEIGHT) * SINGLE_HEIGHT), np.float32)
        pushes = np.zeros((0 if drive.outside is None else STAGES, n))
        arguments = (
            own, np.zeros((N_ROWS, WIDTH)), numbers, law, matrices[k], ROUGH * pulls[k],
            (np.zeros((STAGES, own.shape[1])), single[0], single[1]),
            (bands[k], kinetic[k], by_force, modes[k]),
            np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.int64), next_h,
            np.empty((n_pieces, PIECE)), np.zeros(n_pieces, dtype=np.int64), np.empty(n, dtype=np.int64),
            np.empty((n_pieces, PIECE)), z, w, state.clock, state.counters, tuple(state.samples),
        )  # fmt: skip
        collapse = certificates.Collapse(system, allowed[k], smoothed(system.fastest_belt, widest[k]))
        longest = np.pi / drive.fastest if drive.fastest > 0 else np.inf

        def jumped() -> None:
            """F is not what friction was: blocks in the layer settle there, or leave it, in a time of its own."""
            state.clock[JUMPED] = 1.0
            is_in = np.abs(own[U0, :n]) * own[STEEP, :n] < own[REACH, :n]
            np.minimum(next_h, 1.0 / np.maximum(own[FRICTION, :n] * own[STEEP, :n], 1.0), out=next_h, where=is_in)

        jumped()

        def go_on() -> None:
            """At the start of a piece: u is what it was; F jumps where belts' speeds change by another rate."""
            before = own[FORCE0, :n].copy()
            own[Z0, :n], own[BELT, :n] = z, drive.belt_speed
            own[DRAG, :n], own[FORCE0, :n] = _forces(system, drive, z, w)
            jump = np.abs(own[FORCE0, :n] - before)
            step = first_step(float(jump.max()))
            state.clock[STEP] = min(state.clock[STEP], step)
            next_h[:] = np.minimum(next_h, step / 4)
            if (jump > _JUMP * own[FRICTION, :n]).any():
                jumped()

        return loop.complete(
            task,
            state,
            drive,
            lambda events, bound: advance(
                *arguments,
                drive.ahead if drive.is_instant else drive.length,
                drive.instant if drive.is_instant else -1.0,
                longest,
                drive.outside,
                pushes,
                atol,
                boost,
                tuple(events),
                bound,
                collapse.watch,
            ),
            collapse,
            stalled=f"the step fell to the rounding of time (rtol = {engine.rtol:g}, atol = {engine.atol:g}); use"
            " engine='coulomb', or raise rtol and atol by tens, which helps unless a belt or a force jumps",
            events_a_step=PASSES * (n + n_pieces) * len(by_force),
            initial_modes=modes[k].copy(),
            thresholds=engine.thresholds,
            go_on=go_on,
        )

    return [partial(run, k) for k in range(len(tasks))]


def _forces(system: System, drive: Drive, z: Floats, w: Floats) -> tuple[Floats, Floats]:
    """What belts give F by damping, and F, at the start of a piece."""
    v, cross = drive.belt_speed, system.cross_damping
    drag, pull = system.damping * v, system.damping * v + system.stiffness @ z
    if cross is not None:
        drag += cross.sum(axis=1) * v[0] if system.has_one_belt else cross @ v
        pull += cross @ w
    if drive.outside is not None:
        pull -= drive.value()
    return drag, pull


def _law(system: System) -> tuple[NamedTuple, Floats, Floats]:
    """The friction law, its c by block, and the x at which it has its peak.

    Raises
    ------
    ValueError
        If a block without kinetic friction has a static one, or a side that is closed.
    """
    friction, falls = system.slip_friction[0], system.weakening
    law: NamedTuple = Peaked() if system.is_static_above else Plain()
    if falls is not None:
        law = laws.registered(_SHAPES, falls, "sigmoid")()
    elif not system.back_slip:
        law = Steady()
    if not system.back_slip and (friction[system.closed != 0] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.closed != 0))[0])
        raise ValueError(
            f"back_slip: engine='sigmoid' bars a side by friction that grows, got none at block {block}; give it a"
            " small kinetic friction"
        )
    if not system.is_static_above:
        return law, np.zeros(system.n), np.full(system.n, np.inf)
    if (friction[system.static > friction] == 0).any():
        block = int(np.flatnonzero((friction == 0) & (system.static > 0))[0])
        raise ValueError(
            f"static: engine='sigmoid' smooths the ratio of static to kinetic friction, got {system.static[block]:g}"
            f" above 0 at block {block}; give it a small kinetic friction"
        )
    ratio = np.divide(system.static, friction, out=np.ones(system.n), where=friction > 0)
    hidden = hidden_term(ratio)
    lam = turning_point(hidden)
    return law, hidden, np.arctanh(lam, out=np.full(system.n, np.inf), where=lam < 1)


def _peak(system: System, delta: Floats, hidden: Floats) -> Floats:
    """The x at which a law that falls with the speed of slip has its peak; infinite where that counts for nothing."""
    assert system.weakening is not None
    near, far = system.slip_friction
    low, high = np.zeros(system.n), np.full(system.n, 20.0)
    for _ in range(6):  # to some 1e-8
        x = np.linspace(low, high, 64)
        lam = np.tanh(x)
        best = ((lam + hidden * lam * (1.0 - lam * lam)) * system.kinetic(delta * x)).argmax(axis=0)
        step = (high - low) / 63
        low, high = low + step * np.maximum(best - 1, 0), low + step * np.minimum(best + 1, 63)
    is_steep = (near - far) * system.weakening.steepness > _STEEP
    return np.where(is_steep | (hidden > 0.0), 0.5 * (low + high), np.inf)


def _modes(
    u: Floats,
    pull: Floats,
    bands: Floats,
    is_manifold: bool,
    peak: Floats,
    kinetic: Floats,
    static: Floats,
    closed: Any,
) -> NDArray[np.int8]:
    """Who sticks at the start, by each definition."""
    if closed.any():
        u, pull = np.where(u * closed > 0, 0.0, u), np.where(pull * closed < 0, 0.0, pull)
    held = np.abs(u)[:, np.newaxis] < bands
    if is_manifold:
        is_driven = (np.abs(u) > peak) & (-pull * np.sign(u) > kinetic)
        held[:, 0] &= (np.abs(pull) < static) & ~is_driven
    side = np.where(u != 0, np.sign(u), -np.sign(pull))  # on the belt's speed, where it goes next
    return np.where(held, 0, side[:, np.newaxis]).astype(np.int8)


def _table(
    z: Floats, w: Floats, u: Floats, delta: Floats, damping: Floats, friction: Floats, drag: Floats, pull: Floats
) -> Floats:
    """What formulas read and write, at the start; columns that are no block have numbers that are harmless."""
    several, n = z.shape
    table = np.zeros((several, N_ROWS, -(-n // HEIGHT) * HEIGHT))
    table[:, [STEEP, H, DONE, TOLERANCE]] = 1.0
    table[:, U0, :n], table[:, Z0, :n], table[:, SPEED_BEFORE, :n] = u, z, np.abs(w)
    table[:, DAMPING, :n], table[:, FRICTION, :n], table[:, STEEP, :n] = damping, friction, 1.0 / delta
    table[:, DRAG, :n], table[:, FORCE0, :n] = drag, pull
    table[:, KEPT_F : KEPT_F + STAGES, :n], table[:, KEPT_U : KEPT_U + STAGES, :n] = (
        pull[:, np.newaxis],
        u[:, np.newaxis],
    )
    return table


def _matrices(systems: Sequence[System]) -> list[tuple[Any, Any, bool]]:
    """K and N as `_times` takes them, and whether there is an N."""
    if len(systems) == 1:
        system, cross = systems[0], systems[0].cross_damping
        if system not in _MATRICES:
            kept = _matrix(system.stiffness), _NONE if cross is None else _matrix(cross), cross is not None
            _MATRICES[system] = kept
        return [_MATRICES[system]]
    dense, single, *no_rows = _matrix(np.array([one.stiffness for one in systems]))
    return [((dense[k], single[k], *no_rows), _NONE, False) for k in range(len(systems))]


def _matrix(matrix: Any) -> tuple[NDArray[Any], ...]:
    """Panels in float64 and float32 if it is dense, or dense ones, shape (m, n, n); else its rows."""
    if isinstance(matrix, np.ndarray):
        no_index = np.empty(0, dtype=np.int32)
        dense, single = panels(matrix, HEIGHT, np.float64), panels(matrix, SINGLE_HEIGHT, np.float32)
        return dense, single, no_index, no_index, np.empty(0)
    rows = matrix.tocsr()
    no_panels = np.empty((0, 0, HEIGHT)), np.empty((0, 0, SINGLE_HEIGHT), np.float32)
    return *no_panels, rows.indptr.astype(np.int32), rows.indices.astype(np.int32), rows.data.astype(np.float64)


_NONE = _matrix(np.empty((0, 0)))
#: Of systems that are run by themselves, as large ones are, from many starts: panels take as long as 30 products.
_MATRICES: WeakKeyDictionary[System, tuple[Any, Any, bool]] = WeakKeyDictionary()
