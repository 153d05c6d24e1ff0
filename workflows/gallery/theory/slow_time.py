"""Hidden dynamics in slow time: modes followed to jumps and exits; runs of one or two blocks by any switching law.

Between events z and w move while lambda stays on its mode, f(F; lambda) = 0, eq. (14); at an event the fast system of
`stickslip.workflows.gallery.theory.blowup` decides which mode comes next. Dimensionless.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from stickslip.sim.numerics.arguments import Floats, number, per_block
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import IntegrationError
from stickslip.sim.systems.system import System, require_plain
from stickslip.workflows.gallery.theory.blowup import Blowup, total_force
from stickslip.workflows.gallery.theory.laws import Slips, SwitchingLaw

EventKind = Literal["exit", "entry", "crossing", "jump"]
#: the end of a phase: a slipping block reached the belt, a mode met a face, a saddle, or a Hopf point, or `t_end`
Cause = Literal["arrival", "face", "fold", "focus", "end"]

#: the distance from a fold, in lambda, at which it is left
FOLD_DEPTH = 1e-3
#: the distances in w and in lambda within which events are at one instant
TOGETHER = 1e-9


@dataclass(frozen=True, eq=False)
class Segment:
    """An interval of slow time in one mode: the state at its start, and lambda at both ends."""

    t_start: float
    t_end: float
    slip: Slips
    z: Floats
    w: Floats
    lam_start: Floats
    lam_end: Floats


@dataclass(frozen=True, eq=False)
class LawEvent:
    """A change of mode.

    Attributes
    ----------
    t : float
    kind : "exit", "entry", "crossing" or "jump"
        A jump is from one sticking mode to another.
    cause : "arrival", "face", "fold" or "focus"
        A slipping block reached the belt speed; the mode met a face, a saddle (saddle-node), or lost stability by
        a complex pair (Hopf).
    block : int
        Index of the block; -1 for a jump, which has none.
    slip : int8, shape (n,)
        Modes of all blocks from t on; the new mode of the block, and so the direction of an exit, is slip[block].
    lam_before, lam : float64, shape (n,)
        lambda just before, and where the fast system settles.
    """

    t: float
    kind: EventKind
    cause: Cause
    block: int
    slip: Slips
    lam_before: Floats
    lam: Floats


@dataclass(frozen=True, eq=False)
class LawRun:
    """Segments and events in order of time, and the state at t_end (dimensionless)."""

    segments: tuple[Segment, ...]
    events: tuple[LawEvent, ...]
    t_end: float
    z: Floats
    w: Floats


@dataclass(frozen=True, eq=False)
class _State:
    t: float
    z: Floats
    w: Floats
    lam: Floats
    slip: Slips


EventFunction: TypeAlias = Callable[[float, Floats], float]
#: a segment, the events that end it, and the state after them
_Stretch: TypeAlias = tuple[Segment, list[LawEvent], _State]


@numpy_arithmetic()
def run_with_law(
    system: System, law: SwitchingLaw, z0: ArrayLike, w0: ArrayLike, t_end: float, *, entry: ArrayLike = 0.0
) -> LawRun:
    """Follow one or two blocks under a switching law from t = 0; the fast system chooses among modes.

    Between events DOP853 at rtol 1e-12; event times are good to about 1e-10. Two crossings of the belt speed, or
    of a face, within one step (1/20 of the system's time scale) can be missed.

    Parameters
    ----------
    system : System
        n <= 2 blocks, all with mu > 0.
    law : SwitchingLaw
    z0, w0 : float or array_like, shape (n,)
    t_end : float
        > 0.
    entry : float or array_like, shape (n,)
        lambda from which blocks with w0_i = v settle. Blocks that come from slip enter at their face; if two
        come at one instant, at equal depth.

    Raises
    ------
    ValueError
        If an argument is of the wrong shape or size, the damping is not diagonal, or static friction is above
        the kinetic.
    IntegrationError
        If the fast system cannot decide: it cycles, or ends in an unstable mode.
    """
    require_plain(system, "`stickslip.workflows.gallery.theory.slow_time`")
    if system.n > 2:
        raise ValueError(
            f"system: expected one or two blocks, got {system.n}; `stickslip.sim.simulate` runs more, by Coulomb"
        )
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    blowup = Blowup(law, system.friction)
    phases = list(_march(system, blowup, z, w, per_block("entry", entry, system.n), number("t_end", t_end, 0.0)))
    events = tuple(event for _, changes, _ in phases for event in changes)
    *_, (_, _, end) = phases
    return LawRun(tuple(segment for segment, *_ in phases), events, end.t, end.z, end.w)


def _march(system: System, blowup: Blowup, z: Floats, w: Floats, entry: Floats, t_end: float) -> Iterator[_Stretch]:
    """Phases and the events between them, up to t_end."""
    slip = np.sign(w - system.belt_speed).astype(np.int8)
    state = _decide(system, blowup, _State(0.0, z, w, np.where(slip == 0, entry, slip), slip))
    n_still = 0
    while True:
        end, cause = _phase(system, blowup, state, t_end)
        segment = Segment(state.t, end.t, state.slip, state.z, state.w, state.lam, end.lam)
        if cause == "end":
            yield segment, [], end
            return
        next_state = _decide(system, blowup, _at_event(system, blowup, end, cause))
        yield segment, _events(end, next_state, cause), next_state
        n_still = n_still + 1 if end.t - state.t < TOGETHER else 0
        if n_still > 10 * system.n:
            raise IntegrationError(f"t = {end.t:.12g}: events pile up; the modes chatter under this law")
        state = next_state


def _decide(system: System, blowup: Blowup, state: _State) -> _State:
    """The fast system from the state's lambda: which blocks stick, and in which mode."""
    if state.slip.all():
        return state
    try:
        settled = blowup.settle(total_force(system, state.z, state.w), state.lam, state.slip)
    except IntegrationError as error:
        raise IntegrationError(f"t = {state.t:.12g}: {error}") from error
    if not settled.is_stable:
        raise IntegrationError(
            f"t = {state.t:.12g}: from lambda = {state.lam.tolist()} the fast system ends in the unstable"
            f" mode {settled.lam.tolist()}, on the border of basins; start it from another lambda"
        )
    return _State(state.t, state.z, state.w, settled.lam, settled.slip)


def _at_event(system: System, blowup: Blowup, state: _State, cause: Cause) -> _State:
    """The state from which the fast system goes on: with blocks that leave or arrive, or off a lost mode."""
    w, lam, slip = state.w.copy(), state.lam.copy(), state.slip.copy()
    if cause == "arrival":
        arrived = (slip != 0) & (np.abs(w - system.belt_speed) < TOGETHER)
        w[arrived], slip[arrived] = system.belt_speed, 0
    elif cause == "face":
        out = (slip == 0) & (np.abs(lam) > 1 - TOGETHER)
        slip[out] = lam[out] = np.sign(lam[out])
    else:
        free = np.flatnonzero(slip == 0)
        factor = blowup.factor(lam)[free]
        jacobian = factor[:, None] * blowup.law.jacobian(blowup.friction, lam)[np.ix_(free, free)]
        values, right = np.linalg.eig(jacobian)
        along = right[:, np.argmax(values.real)].real
        along, depth = along / np.abs(along).max(), FOLD_DEPTH
        if cause == "fold":  # no mode exists beyond, so lambda leaves to the side to which the drift of F pushes it
            values, left_vectors = np.linalg.eig(jacobian.T)
            across = left_vectors[:, np.argmax(values.real)].real
            along *= -np.sign((across @ (factor * (system.stiffness @ w)[free])) * (across @ along))
            depth = _fold_depth(blowup, total_force(system, state.z, w), lam, free, along, across / (across @ along))
        lam[free] = np.clip(lam[free] + depth * along, -1.0, 1.0)
    return _State(state.t, state.z, w, lam, slip)


def _fold_depth(
    blowup: Blowup, force: Floats, lam: Floats, free: NDArray[np.intp], along: Floats, across: Floats
) -> float:
    """The distance from a fold at which to start: larger near a cusp, where the fast system is slow."""
    depth = FOLD_DEPTH
    while depth < 0.1:
        ahead = lam.copy()
        ahead[free] = np.clip(ahead[free] + depth * along, -1.0, 1.0)
        if not 0 < across @ blowup.rhs(force, ahead)[free] < 1e-5 * float((blowup.friction / blowup.eps).min()):
            break
        depth *= 2
    return depth


def _events(old: _State, new: _State, cause: Cause) -> list[LawEvent]:
    def event(kind: EventKind, block: int) -> LawEvent:
        return LawEvent(new.t, kind, cause, block, new.slip, old.lam, new.lam)

    changed = np.flatnonzero(old.slip != new.slip)
    if not len(changed):  # a block that grazes the belt speed goes on slipping: no event
        return [event("jump", -1)] if cause in ("fold", "focus") else []
    return [
        event("exit" if old.slip[j] == 0 else "entry" if new.slip[j] == 0 else "crossing", int(j)) for j in changed
    ]


def _phase(system: System, blowup: Blowup, state: _State, t_end: float) -> tuple[_State, Cause]:
    """Slow motion in one mode, eqs (13)-(14), to the first event.

    The path is x = (lambda of sticking blocks, t, z, w) along the unit tangent of f(F(t), lambda) = 0, which
    passes a saddle-node without a singularity: there t' = 0 while det(df/dlambda) changes sign.
    """
    n, v, slip = system.n, system.belt_speed, state.slip
    free, moving = np.flatnonzero(slip == 0), np.flatnonzero(slip != 0)
    m = len(free)
    lam, w = slip.astype(np.float64), np.full(n, v)

    def unpack(x: Floats) -> None:
        lam[free], w[moving] = x[:m], x[m + 1 + n :]

    def slope(x: Floats) -> Floats:
        unpack(x)
        return -blowup.law.jacobian(blowup.friction, lam)[np.ix_(free, free)]

    def rhs(_: float, x: Floats) -> Floats:
        unpack(x)
        z = x[m + 1 : m + 1 + n]
        tangent = _tangent(slope(x), (system.stiffness @ w)[free])
        rate = blowup.law.accelerations(total_force(system, z, w), blowup.friction, lam)[moving]
        return np.concatenate([tangent, tangent[m] * w, tangent[m] * rate])

    def at(index: int, level: float) -> EventFunction:
        return lambda _, x: float(x[index] - level)

    functions: list[tuple[Cause, EventFunction, float]] = [("end", at(m, t_end), 1.0)]
    functions += [("arrival", at(m + 1 + n + k, v), -float(slip[j])) for k, j in enumerate(moving)]
    functions += [("face", at(k, side), side) for k in range(m) for side in (1.0, -1.0)]
    if m:
        functions.append(("fold", lambda _, x: float(np.linalg.det(slope(x))), -1.0))
    if m > 1:
        functions.append(("focus", lambda _, x: _pair_growth(blowup, slope(x), lam), 1.0))
    for _, function, direction in functions:
        function.terminal, function.direction = True, direction  # type: ignore[attr-defined]

    x0 = np.concatenate([state.lam[free], [state.t], state.z, state.w[moving]])
    stiffness = np.linalg.norm(system.stiffness @ np.eye(n), 2)
    longest = 0.05 / max(float(np.sqrt(stiffness)), float(np.abs(system.damping).max()), 0.05 / t_end)
    run = solve_ivp(
        rhs,
        (0.0, np.inf),
        x0,
        "DOP853",
        events=[f for _, f, _ in functions],
        rtol=1e-12,
        atol=1e-13,
        max_step=longest,
    )
    if run.status != 1:
        raise IntegrationError(f"t = {run.y[m, -1]:.12g}: {run.message} The state may be growing without bound.")
    x = run.y[:, -1]
    cause = next(c for (c, _, _), hits in zip(functions, run.t_events, strict=True) if len(hits))
    unpack(x)
    return _State(float(x[m]), x[m + 1 : m + 1 + n].copy(), w, lam, slip), cause


def _tangent(slope: Floats, drift: Floats) -> Floats:
    """Unit kernel vector (lambda', t') of [slope, drift], with t' of the sign of det(slope); shape (m + 1,)."""
    m = len(drift)
    if m == 0:
        return np.ones(1)
    if m == 1:
        kernel = np.array([-drift[0], slope[0, 0]])
    else:
        (a, b), (c, d) = slope
        kernel = np.array([b * drift[1] - d * drift[0], c * drift[0] - a * drift[1], a * d - b * c])
    return np.asarray(kernel / np.linalg.norm(kernel))


def _pair_growth(blowup: Blowup, slope: Floats, lam: Floats) -> float:
    """Largest real part among complex pairs of the scaled Jacobian of two blocks; -1 without any."""
    values = np.linalg.eigvals(-blowup.factor(lam)[:, None] * slope)
    pairs = values[values.imag > 0].real
    return float(pairs.max()) if len(pairs) else -1.0
