"""Hidden dynamics of a discontinuity: the blow-up, its sticking modes, and what becomes of them in slow time.

Inside the layer lambda_j = phi((w_j - v) / eps_j), and on the fast time of eq. (13), positive factors kept,

    lambda_j' = (phi' / eps_j) f_j(F; lambda),    f = -F - mu s(lambda)     (laws: `sim.switching`)

Sticking modes are its equilibria, eq. (14). The factors move neither modes nor saddles, but they shape basins and,
where eigenvalues are complex or there are more than two switches, can decide stability. Dimensionless.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from sim.arguments import Floats, number, per_block
from sim.run import IntegrationError
from sim.switching import Slips, SwitchingLaw
from sim.system import System

EventKind = Literal["exit", "entry", "crossing", "jump"]
ModeKind = Literal["node", "focus", "saddle", "degenerate", "slip"]
#: what ended a phase: a slipping block reached the belt, a mode met a face, a saddle, or a Hopf point, or time was up
Cause = Literal["arrival", "face", "fold", "focus", "end"]

#: 1 - |lambda| where a block enters a layer from slip (the limit to 0 is meant), and how near a fold is left behind
ENTRY_DEPTH, FOLD_DEPTH = 1e-9, 1e-3
#: what counts as one instant, in w and in lambda
TOGETHER = 1e-9
#: what one descent of the fast system may cost; a slow passage past a lost mode takes a tenth of it
MAX_EVALUATIONS = 20_000
#: |f| / mu at which the fast system counts as caught in an unstable mode
ON_BORDER = 1e-10
#: real parts below this share of the largest eigenvalue are zero
DEGENERATE = 1e-12


@dataclass(frozen=True)
class Sigmoid:
    """phi: the map u = (w - v) / eps -> lambda, an inverse of it on (-1, 1), and phi' as a function of lambda."""

    value: Callable[[Floats], Floats]
    inverse: Callable[[Floats], Floats]
    slope: Callable[[Floats], Floats]


#: phi' = 1 - lambda^2
TANH = Sigmoid(np.tanh, np.arctanh, lambda lam: 1 - lam**2)
#: phi' = 1 inside the box: eq. (13) as printed, without the factors
RAMP = Sigmoid(lambda u: np.clip(u, -1.0, 1.0), np.array, np.ones_like)


@dataclass(frozen=True, eq=False)
class Mode:
    """A way for the blocks to go on at one state.

    Attributes
    ----------
    lam : float64, shape (m,)
    slip : int8, shape (m,)
        0 for a block that sticks, else the direction in which it slips.
    eigenvalues : complex128, shape (number of sticking blocks,)
        Of (phi' / eps) df/dlambda over the sticking blocks, by falling real part.
    kind : "node", "focus", "saddle", "degenerate" or "slip"
        Degenerate: an eigenvalue without a real part, as at a saddle-node or on a face. Slip: no block sticks.
    is_stable : bool
        The fast system comes here from all around, within the blocks that stick.
    """

    lam: Floats
    slip: Slips
    eigenvalues: NDArray[np.complex128]
    kind: ModeKind
    is_stable: bool


@dataclass(frozen=True, eq=False)
class Settled:
    """Where the fast system comes to rest.

    Attributes
    ----------
    lam : float64, shape (m,)
    slip : int8, shape (m,)
        0 for a block that sticks; +1, -1 for one that left through the face lambda_i = +1, -1 (or was slipping).
    is_stable : bool
        False if the entry lies on the boundary of basins, or within about 1e-10 of it, and ends in an unstable mode.
    time : float64, shape (k,); path : float64, shape (k, m)
        Fast time and lambda on the way.
    """

    lam: Floats
    slip: Slips
    is_stable: bool
    time: Floats
    path: Floats


@dataclass(frozen=True, eq=False, init=False)
class Blowup:
    """The fast system (13) of m switches.

    Parameters
    ----------
    law : SwitchingLaw
    friction : float or array_like, shape (m,)
        mu > 0.
    eps : float or array_like, shape (m,)
        Relative widths of the layers, > 0.
    sigmoid : Sigmoid
        phi; `TANH`, or `RAMP` for eq. (13) as printed.

    Raises
    ------
    ValueError
        If mu or eps is not positive, or the law is for another number of switches.
    """

    law: SwitchingLaw
    friction: Floats
    eps: Floats
    sigmoid: Sigmoid

    def __init__(self, law: SwitchingLaw, friction: ArrayLike, eps: ArrayLike = 1.0, sigmoid: Sigmoid = TANH) -> None:
        m = np.size(friction) if law.size is None or np.ndim(friction) else law.size
        for name, value in (("friction", friction), ("eps", eps)):
            array = per_block(name, value, m)
            if (array <= 0).any():
                raise ValueError(f"{name}: expected positive numbers, got {array.min()}; a switch needs both")
            object.__setattr__(self, name, array)
        if law.size not in (None, m):
            raise ValueError(f"law: {type(law).__name__} is for {law.size} blocks, got {m}")
        object.__setattr__(self, "law", law)
        object.__setattr__(self, "sigmoid", sigmoid)

    def rhs(self, force: Floats, lam: Floats) -> Floats:
        """lambda' on the fast time, eq. (13) with its factors, shape (m,)."""
        return self.sigmoid.slope(lam) / self.eps * self.law.accelerations(force, self.friction, lam)

    def mode(self, lam: Floats, slip: Slips) -> Mode:
        """An equilibrium and its stability within the blocks that stick."""
        free = np.flatnonzero(slip == 0)
        if not len(free):
            return Mode(lam, slip, np.empty(0, dtype=np.complex128), "slip", True)
        factor = self.sigmoid.slope(lam[free]) / self.eps[free]
        jacobian = factor[:, None] * self.law.jacobian(self.friction, lam)[np.ix_(free, free)]
        values = np.linalg.eigvals(jacobian).astype(np.complex128)
        values = values[np.argsort(-values.real)]
        kind: ModeKind
        if (np.abs(values.real) <= DEGENERATE * np.abs(values).max()).any():
            kind = "degenerate"
        elif values[0].real > 0 > values[-1].real:
            kind = "saddle"
        else:
            kind = "focus" if (values.imag != 0).any() else "node"
        return Mode(lam, slip, values, kind, bool(kind != "degenerate" and values[0].real < 0))

    def sticking_modes(self, force: ArrayLike, slip: ArrayLike = 0) -> tuple[Mode, ...]:
        """All equilibria of (14) in the closed box, with the blocks of `slip` slipping and the others stuck.

        Complete for the offered laws; for `SmoothLaw` and `Canopy` as `SmoothLaw` promises.

        Parameters
        ----------
        force : float or array_like, shape (m,)
            F.
        slip : int or array_like, shape (m,)
            0 where a block sticks, else +1 or -1.

        Raises
        ------
        IntegrationError
            If a law's zeros could not be decided.
        """
        slips = self._slips(slip)
        target = -per_block("force", force, len(slips)) / self.friction
        found = self.law.zeros(target, slips)
        return tuple(self.mode(lam, slips) for lam in found[np.lexsort(found.T[::-1])])

    def continuations(self, force: ArrayLike, slip: ArrayLike = 0) -> tuple[Mode, ...]:
        """All forward continuations of blocks that are on the belt (slip_i = 0): stable modes and possible slips.

        Every block sticks or slips; sticking blocks are in a stable mode, and a block that begins to slip is
        carried away, f_i strictly in the direction of its slip. At a fold f_i = 0 and this leaves the slip out.
        """
        slips, m = self._slips(slip), len(self.friction)
        load = per_block("force", force, m)
        found = []
        for choice in product(*([0, 1, -1] if s == 0 else [s] for s in slips.tolist())):
            trial = np.array(choice, dtype=np.int8)
            starts = (trial != 0) & (slips == 0)
            for mode in self.sticking_modes(load, trial):
                away = self.law.accelerations(load, self.friction, mode.lam) * trial > 0
                if mode.is_stable and away[starts].all():
                    found.append(mode)
        return tuple(found)

    def settle(self, force: ArrayLike, entry: ArrayLike, slip: ArrayLike = 0) -> Settled:
        """Run the fast system from an entry point to where it settles.

        Parameters
        ----------
        force : float or array_like, shape (m,)
        entry : float or array_like, shape (m,)
            lambda in the closed box; on a face the block enters from slip, just inside it.
        slip : int or array_like, shape (m,)
            Blocks that slip already keep lambda_i = slip_i.

        Raises
        ------
        ValueError
            If the entry is outside the box.
        IntegrationError
            If it has not come to rest in 2^14 of its time units or 20,000 evaluations: a cycle, perhaps.
        """
        slips, m = self._slips(slip), len(self.friction)
        load, start = per_block("force", force, m), per_block("entry", entry, m)
        if (np.abs(start) > 1).any():
            raise ValueError(f"entry: expected lambda in [-1, 1], got {start.tolist()}")
        free = slips == 0

        def box(u: Floats) -> Floats:
            lam = slips.astype(np.float64)
            lam[free] = self.sigmoid.value(u)
            return lam

        def rhs(_: float, u: Floats) -> Floats:
            return (self.law.accelerations(load, self.friction, box(u)) / self.eps)[free]

        u = self.sigmoid.inverse(np.clip(start, ENTRY_DEPTH - 1, 1 - ENTRY_DEPTH)[free])
        unit = float(self.eps.max() / self.friction.min())
        times, path, t, n_evaluations = [np.zeros(1)], [box(u)[None]], 0.0, 0
        for span in (*2.0 ** np.arange(2, 14), 0.0):
            rest = self._at_rest(load, box(u), slips, 1e-9 if span else 1e-4)
            if rest is not None:
                lam, slipping, is_stable = rest
                return Settled(lam, slipping, is_stable, np.concatenate(times), np.concatenate(path))
            if not span or n_evaluations > MAX_EVALUATIONS:
                break
            run = solve_ivp(rhs, (t, t + span * unit), u, method="LSODA", rtol=1e-10, atol=1e-12)
            if not run.success:
                raise IntegrationError(
                    f"the fast system at F = {load.tolist()}, lambda = {box(u).tolist()}: {run.message}"
                )
            u, t = run.y[:, -1], run.t[-1]
            times.append(run.t[1:])
            path.append(np.array([box(v) for v in run.y.T[1:]]))
            n_evaluations += run.nfev
        raise IntegrationError(
            f"the fast system at F = {load.tolist()} does not come to rest from lambda = {start.tolist()} in"
            f" {t / unit:g} time units, it is at {box(u).tolist()}: a cycle, or a force on the brink of two modes"
        )

    def _at_rest(self, load: Floats, lam: Floats, slip: Slips, tol: float) -> tuple[Floats, Slips, bool] | None:
        """The equilibrium that the fast system is about to reach, the blocks that left, and if it attracts."""
        f = f_before = self.law.accelerations(load, self.friction, lam)
        scale = float(np.max(self.friction))
        leaving = (slip == 0) & (1 - np.abs(lam) < 10 * ENTRY_DEPTH) & (f * lam > tol * scale)
        slipping = np.where(leaving, np.sign(lam), slip).astype(np.int8)
        free = np.flatnonzero(slipping == 0)
        if (np.abs(f[free]) > tol * scale).any():
            return None
        at = np.where(slipping != 0, slipping, lam).astype(np.float64)
        for _ in range(8 if len(free) else 0):
            jacobian = self.law.jacobian(self.friction, at)[np.ix_(free, free)]
            step = np.linalg.lstsq(jacobian, -self.law.accelerations(load, self.friction, at)[free])[0]
            at[free] = np.clip(at[free] + step, -1.0, 1.0)
        f = self.law.accelerations(load, self.friction, at)
        near = np.abs(at - lam).max() < 1e-2 and (np.abs(f[free]) < 1e-9 * scale).all()
        if not near or not (f * slipping > 0)[leaving].all():
            return None
        if not len(free):
            return at, slipping, True
        # the factors vanish on a face: a floor keeps the sign that they give just inside it
        factor = np.maximum(self.sigmoid.slope(at[free]), 1e-6) / self.eps[free]
        jacobian = self.law.jacobian(self.friction, at)[np.ix_(free, free)]
        is_stable = bool(np.linalg.eigvals(factor[:, None] * jacobian).real.max() < 0)
        if not is_stable and np.abs(f_before[free]).max() > ON_BORDER * scale:
            return None  # it may only be passing by
        return at, slipping, is_stable

    def _slips(self, slip: ArrayLike) -> Slips:
        array = per_block("slip", slip, len(self.friction))
        if not np.isin(array, (-1, 0, 1)).all():
            raise ValueError(f"slip: expected -1, 0 or +1 for each block, got {array.tolist()}")
        return array.astype(np.int8)


def continuations(
    system: System,
    law: SwitchingLaw,
    z: ArrayLike,
    w: ArrayLike,
    *,
    eps: ArrayLike = 1.0,
    sigmoid: Sigmoid = TANH,
) -> tuple[Mode, ...]:
    """All forward continuations of a state: one if the state determines its future, more if it does not.

    Coulomb's law has one everywhere but at folds (-Sign is monotone). Under static friction above kinetic, ratio r, a
    block with 1 < |F| / mu < r has two: it sticks on, or it slips. Blocks with w_i = v are on the belt.

    Returns
    -------
    tuple of Mode
        See `Blowup.continuations`.
    """
    blowup = Blowup(law, system.friction, eps, sigmoid)
    z, w = per_block("z", z, system.n), per_block("w", w, system.n)
    return blowup.continuations(_force(system, z, w), np.sign(w - system.belt_speed))


# --- slow time -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of slow time in one mode: state at its start, and lambda at both ends."""

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
        Modes of all blocks from t on: the new mode of the block, and so which way it left, is slip[block].
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


Watch: TypeAlias = Callable[[float, Floats], float]
#: a segment, the events that end it, and the state after them
_Stretch: TypeAlias = tuple[Segment, list[LawEvent], _State]


def run_with_law(
    system: System,
    law: SwitchingLaw,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    *,
    entry: ArrayLike = 0.0,
    eps: ArrayLike = 1.0,
    sigmoid: Sigmoid = TANH,
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
    eps, sigmoid
        See `Blowup`.

    Raises
    ------
    ValueError
        If an argument is of the wrong shape or size.
    IntegrationError
        If the fast system cannot decide: it cycles, or ends in an unstable mode.
    """
    if system.n > 2:
        raise ValueError(f"system: expected one or two blocks, got {system.n}; `sim.simulate` runs more, by Coulomb")
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    blowup = Blowup(law, system.friction, eps, sigmoid)
    return _collect(_march(system, blowup, z, w, per_block("entry", entry, system.n), number("t_end", t_end, 0.0)))


def follow(
    system: System,
    law: SwitchingLaw,
    z: ArrayLike,
    lam: ArrayLike,
    t_end: float,
    *,
    eps: ArrayLike = 1.0,
    sigmoid: Sigmoid = TANH,
) -> LawRun:
    """Continue a sticking mode in slow time, all blocks stuck (z' = v), through jumps, to its first exit or `t_end`.

    The mode, a curve in (lambda, t), is followed along its tangent, so that a saddle-node is a regular point of
    the path; event times are good to 1e-10.

    Parameters
    ----------
    system : System
        n blocks, all with mu > 0.
    law : SwitchingLaw
    z : float or array_like, shape (n,)
        Displacements at t = 0.
    lam : float or array_like, shape (n,)
        A point from which the fast system settles on the mode, such as the mode itself.
    t_end : float

    Returns
    -------
    LawRun
        Ends at the first exit: its events are jumps, then exits.

    Raises
    ------
    ValueError, IntegrationError
        As `run_with_law`.
    """
    start, belt = per_block("z", z, system.n), np.full(system.n, system.belt_speed)
    blowup = Blowup(law, system.friction, eps, sigmoid)
    marching = _march(system, blowup, start, belt, per_block("lam", lam, system.n), number("t_end", t_end, 0.0))
    return _collect(marching, until_exit=True)


def _collect(marching: Iterator[_Stretch], until_exit: bool = False) -> LawRun:
    segments: list[Segment] = []
    events: list[LawEvent] = []
    for segment, happened, state in marching:
        if until_exit and segment.slip.any():
            break
        segments.append(segment)
        events += happened
        if until_exit and state.slip.any():
            break
    if not segments:
        raise IntegrationError("lam: the fast system does not settle on a mode in which all blocks stick")
    return LawRun(tuple(segments), tuple(events), state.t, state.z, state.w)


def _march(system: System, blowup: Blowup, z: Floats, w: Floats, entry: Floats, t_end: float) -> Iterator[_Stretch]:
    """Phases and what happens between them, up to t_end."""
    slip = np.sign(w - system.belt_speed).astype(np.int8)
    state = _decide(system, blowup, _State(0.0, z, w, np.where(slip == 0, entry, slip), slip))
    n_still = 0
    while True:
        end, cause = _phase(system, blowup, state, t_end)
        segment = Segment(state.t, end.t, state.slip, state.z, state.w, state.lam, end.lam)
        if cause == "end":
            yield segment, [], end
            return
        after = _decide(system, blowup, _at_event(system, blowup, end, cause))
        yield segment, _events(end, after, cause), after
        n_still = n_still + 1 if end.t - state.t < TOGETHER else 0
        if n_still > 10 * system.n:
            raise IntegrationError(f"t = {end.t:.12g}: events pile up; the modes chatter under this law")
        state = after


def _force(system: System, z: Floats, w: Floats) -> Floats:
    """F_i = R_i w_i + (K z)_i."""
    return np.asarray(system.damping * w + system.stiffness @ z, dtype=np.float64)


def _decide(system: System, blowup: Blowup, state: _State) -> _State:
    """The fast system from the state's lambda: which blocks stick, and in which mode."""
    if state.slip.all():
        return state
    try:
        settled = blowup.settle(_force(system, state.z, state.w), state.lam, state.slip)
    except IntegrationError as error:
        raise IntegrationError(f"t = {state.t:.12g}: {error}") from error
    if not settled.is_stable:
        raise IntegrationError(
            f"t = {state.t:.12g}: from lambda = {state.lam.tolist()} the fast system ends in the unstable"
            f" mode {settled.lam.tolist()}, on the border of basins; start it from another lambda"
        )
    return _State(state.t, state.z, state.w, settled.lam, settled.slip)


def _at_event(system: System, blowup: Blowup, state: _State, cause: Cause) -> _State:
    """The state as the fast system takes it over: blocks freed or caught, a lost mode left behind."""
    w, lam, slip = state.w.copy(), state.lam.copy(), state.slip.copy()
    if cause == "arrival":
        arrived = (slip != 0) & (np.abs(w - system.belt_speed) < TOGETHER)
        w[arrived], slip[arrived] = system.belt_speed, 0
    elif cause == "face":
        out = (slip == 0) & (np.abs(lam) > 1 - TOGETHER)
        slip[out] = lam[out] = np.sign(lam[out])
    else:
        free = np.flatnonzero(slip == 0)
        factor = blowup.sigmoid.slope(lam[free]) / blowup.eps[free]
        jacobian = factor[:, None] * blowup.law.jacobian(blowup.friction, lam)[np.ix_(free, free)]
        values, right = np.linalg.eig(jacobian)
        along = right[:, np.argmax(values.real)].real
        along, depth = along / np.abs(along).max(), FOLD_DEPTH
        if cause == "fold":  # no mode is left ahead, so lambda leaves to the side to which the drift of F pushes it
            values, left = np.linalg.eig(jacobian.T)
            across = left[:, np.argmax(values.real)].real
            along *= -np.sign((across @ (factor * (system.stiffness @ w)[free])) * (across @ along))
            depth = _fold_depth(blowup, _force(system, state.z, w), lam, free, along, across / (across @ along))
        lam[free] = np.clip(lam[free] + depth * along, -1.0, 1.0)
    return _State(state.t, state.z, w, lam, slip)


def _fold_depth(
    blowup: Blowup, force: Floats, lam: Floats, free: NDArray[np.intp], along: Floats, across: Floats
) -> float:
    """How far from a fold to start: near a cusp further, where the fast system is not too slow to be followed."""
    depth = FOLD_DEPTH
    while depth < 0.1:
        ahead = lam.copy()
        ahead[free] = np.clip(ahead[free] + depth * along, -1.0, 1.0)
        if not 0 < across @ blowup.rhs(force, ahead)[free] < 1e-5 * float((blowup.friction / blowup.eps).min()):
            break
        depth *= 2
    return depth


def _events(before: _State, after: _State, cause: Cause) -> list[LawEvent]:
    def event(kind: EventKind, block: int) -> LawEvent:
        return LawEvent(after.t, kind, cause, block, after.slip, before.lam, after.lam)

    changed = np.flatnonzero(before.slip != after.slip)
    if not len(changed):  # a block that grazes the belt speed slips on: no event
        return [event("jump", -1)] if cause in ("fold", "focus") else []
    return [
        event("exit" if before.slip[j] == 0 else "entry" if after.slip[j] == 0 else "crossing", int(j))
        for j in changed
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
        rate = blowup.law.accelerations(_force(system, z, w), blowup.friction, lam)[moving]
        return np.concatenate([tangent, tangent[m] * w, tangent[m] * rate])

    def at(index: int, level: float) -> Watch:
        return lambda _, x: float(x[index] - level)

    watched: list[tuple[Cause, Watch, float]] = [("end", at(m, t_end), 1.0)]
    watched += [("arrival", at(m + 1 + n + k, v), -float(slip[j])) for k, j in enumerate(moving)]
    watched += [("face", at(k, side), side) for k in range(m) for side in (1.0, -1.0)]
    if m:
        watched.append(("fold", lambda _, x: float(np.linalg.det(slope(x))), -1.0))
    if m > 1:
        watched.append(("focus", lambda _, x: _pair_growth(blowup, slope(x), x[:m], free), 1.0))
    for _, function, direction in watched:
        function.terminal, function.direction = True, direction  # type: ignore[attr-defined]

    x0 = np.concatenate([state.lam[free], [state.t], state.z, state.w[moving]])
    stiffness = np.linalg.norm(system.stiffness @ np.eye(n), 2)
    longest = 0.05 / max(float(np.sqrt(stiffness)), float(np.abs(system.damping).max()), 0.05 / t_end)
    run = solve_ivp(
        rhs, (0.0, np.inf), x0, "DOP853", events=[f for _, f, _ in watched], rtol=1e-12, atol=1e-13, max_step=longest
    )
    if run.status != 1:
        raise IntegrationError(f"t = {run.y[m, -1]:.12g}: {run.message} The state may be growing without bound.")
    x = run.y[:, -1]
    cause = next(c for (c, _, _), hits in zip(watched, run.t_events, strict=True) if len(hits))
    unpack(x)
    return _State(float(x[m]), x[m + 1 : m + 1 + n].copy(), w, lam, slip), cause


def _tangent(slope: Floats, drift: Floats) -> Floats:
    """Unit kernel vector (lambda', t') of [slope, drift], with t' of the sign of det(slope); shape (m + 1,)."""
    m = len(drift)
    if m == 0:
        return np.ones(1)
    if m == 1:
        kernel = np.array([-drift[0], slope[0, 0]])
    elif m == 2:
        (a, b), (c, d) = slope
        kernel = np.array([b * drift[1] - d * drift[0], c * drift[0] - a * drift[1], a * d - b * c])
    else:
        kernel = np.linalg.svd(np.column_stack([slope, drift]))[2][-1]
        kernel *= np.sign(np.linalg.det(np.vstack([np.column_stack([slope, drift]), kernel])))
    return np.asarray(kernel / np.linalg.norm(kernel))


def _pair_growth(blowup: Blowup, slope: Floats, lam: Floats, free: NDArray[np.intp]) -> float:
    """Largest real part among complex pairs of the scaled Jacobian; -1 without any."""
    factor = blowup.sigmoid.slope(lam) / blowup.eps[free]
    values = np.linalg.eigvals(-factor[:, None] * slope)
    pairs = values[values.imag > 0].real
    return float(pairs.max()) if len(pairs) else -1.0
