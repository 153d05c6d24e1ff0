"""An exact engine that shares no code and no method with `sim`: matrix exponentials and Chebyshev interpolants.

    M z'' + C z' + K z + mu lambda = f(t),    lambda_i in Sign(z_i' - v_i(t)),    C = diag(R) + N

While no block changes its mode the motion is linear, X' = A X with X = (z, (w - v) / rate, drive), and exp(A t) is
taken by Pade's method at Chebyshev nodes of a sub-interval that is short against 1 / |A|: singular, nilpotent,
defective or undamped systems need no care. What drives them is part of X: one, the time since the last knot, of which
f and v are linear functions between knots, and the cosine and sine of each frequency of f. What may end the motion,
(w - v) of a slipping block and m -+ F of a sticking one, m its static friction and F = M v' + R v + N w + K z - f, is
then a polynomial; it is monotone between the zeros of its derivative, so no crossing and no touch is missed. One
that vanishes at the start, to the order k, is divided by t^k exactly: its k-th derivative is averaged.

At an instant every block with w = v is decided anew, all together: by |F| against m, and at |F| = m by the first
derivative of F that does not vanish. With m above mu a block that leaves is felt at once, so those that stay are then
decided again. A touch after which the block goes on as before is no event. A knot is such an instant too.

Where mu falls with |w - v| the motion is not linear: it is exp(A t) X and a polynomial beside it, which meets the
equation at the nodes; sub-intervals are halved until its last coefficients are rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, expm
from scipy.optimize import brentq

Floats = NDArray[np.float64]

_NODES = 18
_REACH = 3.0  # sub-interval times rate: the first coefficient left out is 2 (3 / 4)^18 / 18! = 2e-18
_BATCH = 16
_ROUNDING = 1e-12  # what is smaller, relative to the state, vanishes
_REMEMBERED = 1e-3  # of the largest state so far: its rounding is still there
_EVENTS_MAX = 2_000
_PIECES_MAX = 50_000
_EACH = ("damping", "friction", "z0", "w0", "static", "mass", "closed")
_HALVINGS_MAX = 30
_PICARD_MAX = 80

_TAU = (1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2
_TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(2 * _TAU - 1, _NODES - 1))
_FROM_COEFFICIENTS = chebyshev.chebvander(2 * _TAU - 1, _NODES - 1)
#: From values at the nodes to those of the integral from 0.
_INTEGRAL = chebyshev.chebvander(2 * _TAU - 1, _NODES) @ chebyshev.chebint(_TO_COEFFICIENTS, lbnd=-1, axis=0) / 2


class Undecided(RuntimeError):
    """The engine gives up: events accumulate, or the run is too long for it."""


@dataclass(frozen=True)
class Ramp:
    """Linear between `values` (k, n) at `times` (k,), constant before and after."""

    times: Floats
    values: Floats

    @classmethod
    def of(cls, given: ArrayLike | Ramp, n: int) -> Ramp:
        """For n blocks, from another or from what has one value at all times, a number or (n,)."""
        if isinstance(given, Ramp):
            times, values = given.times, np.asarray(given.values, dtype=float)
            values = values[:, None] if values.ndim == 1 else values
        else:
            times, values = np.zeros(1), np.asarray(given, dtype=float)[None]
        return cls(np.array(times, dtype=float), np.broadcast_to(values, (len(times), n)).copy())

    def line(self, t: float) -> tuple[Floats, Floats]:
        """Value and slope right after a time."""
        k = int(np.searchsorted(self.times, t, side="right"))
        if k in (0, len(self.times)):
            return self.values[max(k - 1, 0)], np.zeros(self.values.shape[1])
        slope = (self.values[k] - self.values[k - 1]) / (self.times[k] - self.times[k - 1])
        return self.values[k - 1] + slope * (t - self.times[k - 1]), slope

    def at(self, times: ArrayLike) -> Floats:
        """Values (m, n) at times (m,)."""
        return np.array([self.line(t)[0] for t in np.atleast_1d(times)])

    def beside(self, other: Ramp) -> Ramp:
        """Of two systems as one."""
        times = np.union1d(self.times, other.times)
        return Ramp(times, np.hstack((self.at(times), other.at(times))))

    def varied(self, change: Callable[..., Floats]) -> Ramp:
        """Each value times 1 + u, u by `change` of the shape."""
        return Ramp(self.times, self.values * (1 + change(*self.values.shape)))


@dataclass(frozen=True)
class Case:
    """What is to be followed: the system and its start; `stiffness`, `cross` (n, n), `waves` (m, 3, n), else (n,).

    `waves` are amplitudes, frequencies and phases of cosines, which with `push` make the force. `falls` is the law by
    which friction falls with speed, ("rational", rate) or ("exponential", speed); `closed` the side to which a block
    may not slip, 0 for neither.
    """

    stiffness: Floats
    damping: Floats
    friction: Floats
    belt: Ramp
    z0: Floats
    w0: Floats
    static: Floats
    mass: Floats
    push: Ramp
    waves: Floats
    closed: Floats
    falls: tuple[str, float] | None
    cross: Floats

    @classmethod
    def of(
        cls,
        stiffness: ArrayLike,
        damping: ArrayLike,
        friction: ArrayLike,
        belt_speed: ArrayLike | Ramp,
        z0: ArrayLike,
        w0: ArrayLike,
        static: ArrayLike | None = None,
        *,
        mass: ArrayLike = 1.0,
        push: ArrayLike | Ramp = 0.0,
        waves: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]] = (),
        falls: tuple[str, float] | None = None,
        back_slip: bool = True,
    ) -> Case:
        """From what `sim.System` and `simulate` take; numbers stand for all blocks."""
        matrix = np.array(stiffness, dtype=float)
        n = len(matrix)
        static = friction if static is None else static

        def each(x: ArrayLike) -> Floats:
            return np.broadcast_to(np.asarray(x, dtype=float), n).copy()

        cosines = np.array([[each(x) for x in wave] for wave in waves]).reshape(-1, 3, n)
        belt, force = Ramp.of(belt_speed, n), Ramp.of(push, n)
        closed = np.zeros(n) if back_slip else np.sign(belt.values.sum(axis=0))
        own = (
            each(np.diag(damping) if np.ndim(damping) == 2 else damping),
            each(friction),
            belt,
            each(z0),
            each(w0),
            each(static),
            each(mass),
            force,
            cosines,
            closed,
        )
        drag = np.array(damping, dtype=float)
        cross = drag - np.diag(np.diag(drag)) if drag.ndim == 2 else np.zeros((n, n))
        return cls(matrix, *own, falls, cross)

    @cached_property
    def near(self) -> Floats:
        """Kinetic friction of a block that begins to slip."""
        return self.static if self.falls and self.falls[0] == "exponential" else self.friction

    @cached_property
    def drop(self) -> Floats:
        """By how much it falls until the slip has no bound."""
        if self.falls is None:
            return np.zeros(self.n)
        return self.static - self.friction if self.falls[0] == "exponential" else self.friction

    @cached_property
    def steepness(self) -> float:
        """What the speed of slip is multiplied by, in the law by which friction falls."""
        if self.falls is None:
            return 0.0
        return 1 / self.falls[1] if self.falls[0] == "exponential" else self.falls[1]

    def fallen(self, slip: Floats) -> tuple[Floats, Floats]:
        """By how much friction has fallen at the speeds of slip (..., n), and the slope of that."""
        x = self.steepness * slip
        if self.falls is None or self.falls[0] == "exponential":
            return -self.drop * np.expm1(-x), self.drop * self.steepness * np.exp(-x)
        return self.drop * x / (1 + x), self.drop * self.steepness / (1 + x) ** 2

    @cached_property
    def is_above(self) -> list[bool]:
        """Whether the static friction is above the kinetic that a slip begins with, by block."""
        return (self.static > self.near).tolist()

    @property
    def n(self) -> int:
        """Number of blocks."""
        return len(self.damping)

    @cached_property
    def rate(self) -> float:
        """No motion is faster than about this; not below one, or friction alone would be seen at too few places."""
        own = np.sqrt(np.linalg.norm(self.stiffness / self.mass[:, None], 2)) + np.abs(self.damping / self.mass).max()
        own += np.linalg.norm(self.cross / self.mass[:, None], 2)
        own += (self.drop * self.steepness / self.mass).max()
        return float(max(1.0, own, self.frequencies.max(initial=0.0)))

    @cached_property
    def frequencies(self) -> Floats:
        """Those of the force, each once."""
        return np.unique(np.abs(self.waves[:, 1]))

    @cached_property
    def fastest_belt(self) -> float:
        """The largest |v|."""
        return float(np.abs(self.belt.values).max())

    @cached_property
    def knots(self) -> Floats:
        """When the drive may have a kink."""
        return np.union1d(self.belt.times, self.push.times)

    @cached_property
    def is_driven(self) -> bool:
        """Whether there is a force, or a speed of a belt that depends on time."""
        return bool(
            self.push.values.any() or self.waves[:, 0].any() or (self.belt.values != self.belt.values[0]).any()
        )

    @cached_property
    def strongest_push(self) -> Floats:
        """A bound of |f| + M |v'| + R |v|, by block."""
        slopes = np.abs([self.belt.line(t)[1] for t in self.belt.times]).max(axis=0)
        push = np.abs(self.push.values).max(axis=0) + np.abs(self.waves[:, 0]).sum(axis=0)
        return np.asarray(
            push + self.mass * slopes + np.abs(self.damping) * np.abs(self.belt.values).max(axis=0), dtype=float
        )

    def force(self, t: float) -> Floats:
        """The force from outside (n,) at a time."""
        amplitude, frequency, phase = self.waves.transpose(1, 0, 2)
        return np.asarray(self.push.line(t)[0] + (amplitude * np.cos(frequency * t + phase)).sum(axis=0))

    def holding(self, times: Floats, z: Floats, w: Floats) -> Floats:
        """F (m, n) at times (m,), of z and w (m, n)."""
        push = [self.force(t) - self.mass * self.belt.line(t)[1] for t in times]
        return np.asarray(self.damping * self.belt.at(times) + z @ self.stiffness.T + w @ self.cross.T - push)

    def renumbered(self, order: NDArray[np.int64]) -> Case:
        """With the blocks in this order."""
        each: dict[str, Any] = {name: getattr(self, name)[order] for name in _EACH}
        belt, push = (Ramp(ramp.times, ramp.values[:, order]) for ramp in (self.belt, self.push))
        matrix, cross = self.stiffness[np.ix_(order, order)], self.cross[np.ix_(order, order)]
        return replace(
            self, stiffness=matrix, cross=cross, belt=belt, push=push, waves=self.waves[:, :, order], **each
        )

    def beside(self, other: Case) -> Case:
        """Two systems as one; friction falls as here."""
        each: dict[str, Any] = {name: np.concatenate((getattr(self, name), getattr(other, name))) for name in _EACH}
        mine, its = np.zeros((len(self.waves), 3, other.n)), np.zeros((len(other.waves), 3, self.n))
        waves = np.concatenate((np.dstack((self.waves, mine)), np.dstack((its, other.waves))))
        belt, push = self.belt.beside(other.belt), self.push.beside(other.push)
        matrix, cross = block_diag(self.stiffness, other.stiffness), block_diag(self.cross, other.cross)
        return replace(self, stiffness=matrix, cross=cross, belt=belt, push=push, waves=waves, **each)

    def perturbed(self, rng: np.random.Generator, size: float) -> Case:
        """Each constant times 1 + size u, and each start plus size u times the largest of the start; |u| <= 1."""

        def u(*shape: int) -> Floats:
            return size * rng.uniform(-1, 1, shape)

        n = self.n
        start = max(np.abs(self.z0).max(), np.abs(self.w0).max(), self.fastest_belt)
        same = u(1).repeat(n) if (self.belt.values == self.belt.values[0, 0]).all() else u(n)
        changed = replace(
            self,
            stiffness=self.stiffness * (1 + u(n, n)),
            damping=self.damping * (1 + u(n)),
            friction=self.friction * (1 + u(n)),
            belt=Ramp(self.belt.times, self.belt.values * (1 + same)),
            z0=self.z0 + start * u(n),
            w0=self.w0 + start * u(n),
        )
        drop = (self.static - self.friction) * (1 + u(n)) if (self.static > self.friction).any() else 0.0
        changed = replace(changed, static=changed.friction + drop)
        if self.closed.any():
            ahead = self.closed * (changed.w0 - changed.belt.line(0.0)[0]) >= 0
            changed = replace(changed, w0=np.where(ahead, changed.belt.line(0.0)[0], changed.w0))
        if self.falls:
            changed = replace(changed, falls=(self.falls[0], self.falls[1] * float(1 + u(1)[0])))
        if self.is_driven or (self.mass != 1).any():
            push, waves = self.push.varied(u), self.waves * (1 + u(*self.waves.shape))
            changed = replace(changed, mass=self.mass * (1 + u(n)), push=push, waves=waves)
        return replace(changed, cross=self.cross * (1 + u(n, n))) if self.cross.any() else changed


@dataclass
class Path:
    """A run: events in order of time and block, and the state at any time.

    `t`, `block`, `mode` as in `sim.EventSeries`; `initial_mode` right after the start; `z`, `w` at the end.
    """

    case: Case
    t_end: float
    initial_mode: tuple[int, ...]
    t: list[float] = field(default_factory=list)
    block: list[int] = field(default_factory=list)
    mode: list[int] = field(default_factory=list)
    pieces: list[tuple[float, Floats, _Flow]] = field(default_factory=list)

    def at(self, times: ArrayLike) -> tuple[Floats, Floats]:
        """z, w at times in [0, t_end], each (m, n)."""
        times = np.atleast_1d(np.asarray(times, dtype=float))
        index = np.searchsorted([piece[0] for piece in self.pieces], times, side="right") - 1
        found = [self.pieces[k] for k in index]
        x = np.array([flow.state(x, t - start) for t, (start, x, flow) in zip(times, found, strict=True)])
        n, rate = self.case.n, self.case.rate
        return x[:, :n], self.case.belt.at(times) + rate * x[:, n : 2 * n]

    @property
    def z(self) -> Floats:
        """Displacements at the end."""
        return self.at(self.t_end)[0][0]

    @property
    def w(self) -> Floats:
        """Velocities at the end."""
        return self.at(self.t_end)[1][0]


class _Flow:
    """The motion while the modes hold, on sub-intervals of the length h; time in them is tau = t / h.

    X is z, (w - v) / rate, one, rate times the time since the knot `since`, cosine and sine of each frequency.
    """

    def __init__(
        self, case: Case, mode: Sequence[int], held: Sequence[bool], since: float, halvings: int = 0
    ) -> None:
        n, rate, frequencies = case.n, case.rate, case.frequencies
        self.case, self.since, self.mode = case, since, np.array(mode)
        self.is_curved = bool((case.drop[self.mode != 0] > 0).any())
        self.h = _REACH / rate / 2**halvings
        one, time = 2 * n, 2 * n + 1
        size = 2 * n + 2 + 2 * len(frequencies)
        (v, v_slope), (push, push_slope) = case.belt.line(since), case.push.line(since)
        #: F = forces X
        self.forces = np.zeros((n, size))
        self.forces[:, :n], self.forces[:, n : 2 * n] = case.stiffness, rate * case.cross
        self.forces[:, one] = case.mass * v_slope + case.damping * v + case.cross @ v - push
        self.forces[:, time] = (case.damping * v_slope + case.cross @ v_slope - push_slope) / rate
        m = np.zeros((size, size))
        for k, frequency in enumerate(frequencies):
            cosine, sine = time + 1 + 2 * k, time + 2 + 2 * k
            m[cosine, sine], m[sine, cosine] = -frequency, frequency
            amplitude, own, phase = case.waves.transpose(1, 0, 2)
            is_here = np.abs(own) == frequency
            self.forces[:, cosine] = -(is_here * amplitude * np.cos(phase)).sum(axis=0)
            self.forces[:, sine] = (is_here * amplitude * np.sin(phase) * np.sign(own)).sum(axis=0)
        m[:n, n : 2 * n] = rate * np.eye(n)
        m[:n, one], m[:n, time], m[time, one] = v, v_slope / rate, rate
        for i in range(n):
            if not held[i]:
                m[n + i] = -self.forces[i] / (case.mass[i] * rate)
                m[n + i, n + i] = -case.damping[i] / case.mass[i]
                m[n + i, one] -= case.near[i] * mode[i] / (case.mass[i] * rate)
        self.matrix, self.generator = m, m * self.h
        stack = expm(self.generator * np.append(_TAU, 1.0)[:, None, None])
        self._coefficients = np.einsum("kj,jab->kab", _TO_COEFFICIENTS, stack[:-1])
        self.step = stack[-1]
        # what ends it: m (w - v) of a slipping block; static friction -+ F of a sticking one
        rows, self.owners = [], []
        for i in range(n):
            if mode[i] != 0:
                row = np.zeros(size)
                row[n + i] = mode[i]
                rows.append(row)
                self.owners.append((i, 0))
            elif held[i]:
                for side in (side for side in (1, -1) if side != -case.closed[i]):
                    row = -side * self.forces[i]
                    row[one] += case.static[i]
                    rows.append(row)
                    self.owners.append((i, side))
            else:  # a free block that rides the belt: w - v either way
                for side in (1, -1):
                    row = np.zeros(size)
                    row[n + i] = side
                    rows.append(row)
                    self.owners.append((i, 0))
        self.rows = np.array(rows)
        self._functions = np.einsum("ea,kab->keb", self.rows, self._coefficients)
        self._curves: dict[bytes, Floats] = {}

    def timed(self, x: Floats, t: float) -> Floats:
        """X with the drive of the time t."""
        turns = self.case.frequencies * t
        waves = np.column_stack((np.cos(turns), np.sin(turns))).ravel()
        return np.concatenate((x[: 2 * self.case.n], [1.0, (t - self.since) * self.case.rate], waves))

    def _pull(self, x: Floats) -> Floats:
        """X' / h beyond the linear, of states (m, N)."""
        n, case = self.case.n, self.case
        more = np.zeros_like(x)
        fallen = case.fallen(case.rate * self.mode * x[:, n : 2 * n])[0]
        more[:, n : 2 * n] = self.mode * fallen / (case.mass * case.rate)
        return more

    def tangent(self, x: Floats) -> Floats:
        """What X' is of X, to first order about x, in units of the rate."""
        n, case = self.case.n, self.case
        matrix, slip = self.matrix.copy(), case.rate * self.mode * x[n : 2 * n]
        fallen, slope = case.fallen(slip)
        each = np.arange(n, 2 * n)
        matrix[each, each] += self.mode**2 * slope / case.mass
        matrix[each, 2 * n] += self.mode * (fallen - slope * slip) / (case.mass * case.rate)
        return np.asarray(matrix / case.rate)

    def curve(self, x: Floats) -> Floats:
        """Chebyshev coefficients (NODES, N) of the motion from x; not finite if none is found."""
        if not self.is_curved:
            return self._coefficients @ x
        key = x.tobytes()
        if key not in self._curves:
            self._curves.clear()
            self._curves[key] = self._solved(x)
        return self._curves[key]

    def _solved(self, x: Floats) -> Floats:
        """D' = A D + what is not linear, D the motion less exp(A t) x: at the nodes, again and again."""
        linear = _FROM_COEFFICIENTS @ (self._coefficients @ x)
        size = linear.shape
        beside = np.zeros(size)
        for _ in range(_PICARD_MAX):
            before = beside
            with np.errstate(all="ignore"):  # a polynomial that is not yet right may be anywhere
                right = _INTEGRAL @ (self.h * self._pull(linear + before))
                beside = (self._volterra @ right.ravel()).reshape(size)
            if not np.isfinite(beside).all():
                break
            if np.abs(beside - before).max() <= 2e-16 * np.abs(linear + beside).max():
                return np.asarray(_TO_COEFFICIENTS @ (linear + beside))
        return np.full(size, np.nan)

    @cached_property
    def _volterra(self) -> Floats:
        """The inverse of D - integral of A D, on the values at the nodes."""
        size = _NODES * len(self.generator)
        return np.linalg.inv(np.eye(size) - np.kron(_INTEGRAL, self.generator))

    def resolves(self, x: Floats) -> bool:
        """Whether the motion from x is a polynomial up to rounding."""
        if not self.is_curved:
            return True
        curve = np.abs(self.curve(x)[:, : 2 * self.case.n])
        return bool(curve[-3:].max() <= 1e-15 * curve.max())

    def later(self, x: Floats, j: int) -> Floats:
        """X after j sub-intervals, one at most of a motion that is not linear."""
        if self.is_curved and j:
            return self.state(x, self.h)
        return np.asarray(self.powers[j] @ x if j else x)

    @cached_property
    def powers(self) -> Floats:
        """exp(M h j), j = 0.._BATCH."""
        stack = [np.eye(len(self.step))]
        for _ in range(_BATCH):
            stack.append(self.step @ stack[-1])
        return np.array(stack)

    def state(self, x: Floats, t: float) -> Floats:
        """X a time t <= h after x."""
        return np.cos(np.arange(_NODES) * np.arccos(min(max(2 * t / self.h - 1, -1.0), 1.0))) @ self.curve(x)

    def functions(self, x: Floats) -> Floats:
        """Chebyshev coefficients of what may end the motion, from each of the states x (m, 2n+1): (N, e, m)."""
        if self.is_curved:
            return (self.curve(x[0]) @ self.rows.T)[:, :, None]
        return self._functions @ x.T

    def divided(self, e: int, order: int, x: Floats) -> Floats:
        """Coefficients of function e over tau^order, if its first `order` derivatives vanish at x."""
        if self.is_curved:
            states = _FROM_COEFFICIENTS @ self.curve(x)
            slope = _TO_COEFFICIENTS @ ((states @ self.generator.T + self.h * self._pull(states)) @ self.rows[e])
            higher = 2.0 ** (order - 1) * chebyshev.chebder(slope, order - 1)
            return _averages(order) @ np.append(higher, np.zeros(_NODES - len(higher)))
        row = self.rows[e] @ np.linalg.matrix_power(self.generator, order)
        return _averages(order) @ ((row @ self._coefficients) @ x)


@cache
def _averages(k: int) -> Floats:
    """From coefficients of g^(k) to those of g / tau^k = int_0^1 (1 - s)^(k-1) / (k-1)! g^(k)(s tau) ds."""
    s, weights = np.polynomial.legendre.leggauss(48)
    s, weights = (s + 1) / 2, weights / 2
    weights = weights * np.prod([(1 - s) / j for j in range(1, k)], axis=0)
    values = np.einsum("q,jqc->jc", weights, chebyshev.chebvander(2 * np.outer(_TAU, s) - 1, _NODES - 1))
    return _TO_COEFFICIENTS @ values


def _first_zero(c: Floats, end: float, vanishes: float) -> float | None:
    """First tau in (0, end] where the function, positive before, passes zero or touches it; None if there is none.

    To touch is to have a least value within `vanishes` of zero.
    """
    slope = chebyshev.chebder(c)
    if abs(slope[0]) > np.abs(slope[1:]).sum():  # monotone
        flat = np.empty(0)
    else:
        roots = chebyshev.chebroots(np.trim_zeros(slope, "b")) if slope.any() else np.empty(0)
        flat = (roots.real[np.abs(roots.imag) < 1e-6] + 1) / 2
        flat = np.sort(flat[(flat > 0) & (flat < end)])
    points = [0.0, *flat.tolist(), end]
    coefficients = c.tolist()
    values = [_value(x, coefficients) for x in points]
    for k in range(1, len(points)):
        is_least = k < len(points) - 1 and values[k] <= values[k - 1] and values[k] <= values[k + 1]
        if is_least and abs(values[k]) <= vanishes:
            return points[k]
        if values[k] <= 0:
            if values[k - 1] <= 0:  # it starts within rounding of zero, on the other side
                return points[k - 1]
            return float(brentq(_value, points[k - 1], points[k], args=(coefficients,), xtol=1e-16))
    return None


def _value(tau: float, coefficients: list[float]) -> float:
    """By Clenshaw's recurrence: a Chebyshev series on [0, 1]."""
    x = 4 * tau - 2
    b, before = 0.0, 0.0
    for c in coefficients[:0:-1]:
        b, before = c + x * b - before, b
    return coefficients[0] + x / 2 * b - before


class _Follower:
    def __init__(self, case: Case) -> None:
        self.case = case
        self.n = case.n
        self.since = 0.0
        self.x = np.concatenate((case.z0, (case.w0 - case.belt.line(0.0)[0]) / case.rate))
        self.mode = [0 if y == 0 else (1 if y > 0 else -1) for y in self.x[self.n :]]
        self.orders: dict[int, int] = {}
        self._peak = np.zeros(case.n)
        self._flows: dict[tuple[tuple[int, ...], tuple[bool, ...], int], _Flow] = {}
        self._halvings = 0
        self.be_at(0.0)

    def be_at(self, t: float) -> None:
        """Take the drive of this time, and what rounding is of: each block's size now, and some of its largest."""
        case, n = self.case, self.n
        self.x = self.flow(self.mode).timed(self.x, t)
        now = np.abs(self.x[:n]) + np.abs(self.x[n : 2 * n]) + case.fastest_belt / case.rate
        self._peak = np.maximum(self._peak, now)
        size = np.maximum(now, _REMEMBERED * self._peak)
        pull = (np.abs(case.stiffness) + case.rate * np.abs(case.cross)) @ size + case.strongest_push
        self.small_force = _ROUNDING * (pull + case.static)
        self.small_speed = _ROUNDING * (size + pull / (case.mass * case.rate**2))

    def go_on(self, knot: float) -> None:
        """With the drive that holds from a knot on."""
        self.since = knot
        self._flows.clear()

    def flow(self, mode: Sequence[int], halvings: int = 0) -> _Flow:
        can_hold = (self.case.static > 0) | (self.case.closed != 0)
        held = tuple(m == 0 and can for m, can in zip(mode, can_hold.tolist(), strict=True))
        key = (tuple(mode), held, halvings)
        if key not in self._flows:
            self._flows[key] = _Flow(self.case, mode, held, self.since, halvings)
        return self._flows[key]

    def flow_now(self) -> _Flow:
        """From the present state, on sub-intervals as short as that takes."""
        for halvings in range(max(self._halvings - 1, 0), _HALVINGS_MAX):
            flow = self.flow(self.mode, halvings)
            if flow.resolves(self.x):
                self._halvings = halvings if flow.is_curved else 0
                return flow
        raise Undecided("the motion is no polynomial")

    def decide(self, touching: list[int]) -> None:
        """Modes of the blocks with w = v; the orders to which what ends their motion vanishes now."""
        case, small = self.case, self.small_force
        forces = self.flow(self.mode).forces
        force = forces @ self.x
        self.orders = {}
        open_: list[int] = []
        for i in touching:
            push = abs(force[i]) if case.closed[i] == 0 else case.closed[i] * force[i]
            if push > case.static[i] + small[i]:
                self.mode[i] = -1 if force[i] > 0 else 1
                self.orders[i] = 1
            else:
                self.mode[i] = 0
                if push >= case.static[i] - small[i]:
                    open_.append(i)
        edge = list(open_)
        while open_:
            flow = self.flow(self.mode)
            x, found, felt = self.x, 0, False
            tangent = flow.tangent(x)
            for order in range(1, len(x)):
                x = tangent @ x
                change = forces @ x
                moved = [i for i in open_ if abs(change[i]) > small[i]]
                for i in moved:
                    open_.remove(i)
                    side = np.sign(force[i]) if case.static[i] > 0 else np.sign(change[i])
                    leaves = change[i] * side > 0 and side != -case.closed[i]
                    self.mode[i] = int(-side) if leaves else 0
                    self.orders[i] = order if not leaves else 1 if case.is_above[i] else order + 1
                    found += leaves
                    felt = felt or (leaves and case.is_above[i])
                if found:
                    break  # others feel it, at a higher order
            if felt:
                open_ = [i for i in edge if self.mode[i] == 0 or not case.is_above[i]]
                for i in open_:
                    self.mode[i] = 0
            if not found:
                for i in open_:
                    self.orders[i] = -1  # it rests there
                return

    def search(self, flow: _Flow, end: float, count: int) -> tuple[int, float | None]:
        """Over up to `count` sub-intervals: those without an event, tau of the first in the next."""
        starts = flow.powers[:count] @ self.x if count > 1 else self.x[None]
        functions = flow.functions(starts)
        small = [self.small_force[i] if side else self.small_speed[i] for i, side in flow.owners]
        force = flow.forces @ self.x
        for e, (i, side) in enumerate(flow.owners):
            order = self.orders.get(i, 0)
            if order == 0:
                continue
            if side and self.case.static[i] > 0 and np.sign(force[i]) != side:
                continue
            if order > 0:
                functions[:, e, 0] = flow.divided(e, order, self.x)
            else:
                functions[0, e] += 4 * small[e]
        may = functions[0] <= np.abs(functions[1:]).sum(axis=0)
        for j in range(len(starts)):
            zeros = [
                zero
                for e in np.flatnonzero(may[:, j])
                if (zero := _first_zero(functions[:, e, j], min(end - j, 1.0), small[e])) is not None
            ]
            if zeros:
                return j, min(zeros)
        return len(starts), None


def follow(case: Case, t_end: float) -> Path:
    """The run from t = 0 to `t_end`.

    Raises
    ------
    Undecided
        If there are too many events or sub-intervals.
    """
    me = _Follower(case)
    n = case.n
    me.decide([i for i in range(n) if me.x[n + i] == 0])
    path = Path(case, t_end, tuple(me.mode))
    knots = [t for t in case.knots.tolist() if 0 < t < t_end] if case.is_driven else []
    stops = iter([*knots, t_end])
    t, stop, count, stalled = 0.0, next(stops), 1, 0
    while True:
        flow = me.flow_now()
        h, remaining = flow.h, (stop - t) / flow.h
        count = 1 if flow.is_curved else max(1, min(count, int(np.ceil(remaining))))
        done, tau = me.search(flow, remaining, count)
        is_over = tau is None and done >= remaining
        if is_over:
            done = max(int(np.ceil(remaining)) - 1, 0)
            tau = remaining - done
        for j in range(done + (tau is not None)):
            path.pieces.append((t + j * h, flow.later(me.x, j), flow))
        if len(path.pieces) > _PIECES_MAX or len(path.t) > _EVENTS_MAX:
            raise Undecided(f"{len(path.pieces)} pieces and {len(path.t)} events until t = {t}")
        if is_over and stop == t_end:
            return path
        if tau is None:
            me.x = flow.later(me.x, done)
            t += done * h
            count = min(4 * count, _BATCH)
            me.orders = {i: -1 for i, order in me.orders.items() if order < 0}  # what rests may go on to rest
            me.be_at(t)
            continue
        stalled = 0 if done + tau > 1e-13 else stalled + 1
        if stalled > 2 * n + 5:
            raise Undecided(f"events accumulate at t = {t}")
        t = stop if is_over else t + (done + tau) * h
        me.x = flow.state(flow.later(me.x, done), tau * h)
        if is_over:
            me.go_on(stop)
            stop = next(stops)
        me.be_at(t)
        y = me.x[n : 2 * n]
        touching = [i for i in range(n) if abs(y[i]) <= 2 * me.small_speed[i]]
        y[touching] = 0.0
        before = list(me.mode)
        for i in range(n):
            if before[i] == 0 and i not in touching:  # a free block that rode the belt
                me.mode[i] = int(np.sign(y[i]))
        me.decide(touching)
        for i in range(n):
            if me.mode[i] != before[i]:
                path.t.append(min(t, t_end))
                path.block.append(i)
                path.mode.append(me.mode[i])
        count = 1
