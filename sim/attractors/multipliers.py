"""How small deviations move along a run of the exact law: from event to event, and round a cycle.

Between events a deviation x = (dz, dw) moves as x' = A x, A the matrix of the blocks that slip. Where friction falls
with speed, A is a polynomial in time through its values at Gauss's nodes of a step, which gives its order (S. Blanes,
F. Casas, J. A. Oteo and J. Ros, Phys. Rep. 470 (2009) 151, 5.4), and the Taylor series of x are summed.
At an event it is multiplied by the saltation matrix

    S = 1 + (f+ - f-) n / (n f- + dg/dt),    g(x, t) = 0 the event, n its gradient, f-+ = (z', w') before and after

(R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004). With this law an
entry sets dw_i = 0; an exit adds (m_i - mu_i) s (K dz + N dw)_i / (K w + N w' - f')_i to it, m_i the static friction
and s the side; a crossing multiplies it by w_i'+ / w_i'-. These commute, so the order of events at one instant does
not matter, unless damping couples one to an exit with m_i > mu_i, which depends on w'.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.variations import Course, carried
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.drive import Harmonic
from stickslip.sim.systems.system import System

#: Steps over the fastest rate, and where friction falls with speed.
_LONG_STEP, _STEP = 4.0, 0.35
#: The longest over which the first term of a series that is left out, of the second order and so on, is rounding.
_REACH = [(1e-16 * math.factorial(order)) ** (1.0 / order) for order in range(2, 40)]
#: Nodes of a step, of Gauss; from values there to the coefficients of the polynomial through them.
_NODES = 0.5 + 0.5 * np.polynomial.legendre.leggauss(5)[0]
_THROUGH = np.linalg.inv(np.vander(_NODES, increasing=True))
#: Of more equal steps one is taken, to their power.
_MOST = 16
#: How large a motion is at least, for ratios of what it consists of to have all their digits.
LOST = float(np.finfo(np.float64).tiny / np.finfo(np.float64).eps)


#: Runs a system from z, w and modes, if they are known, from one time to another, with samples at some times.
Follow: TypeAlias = Callable[[Floats, Floats, NDArray[np.int8] | None, tuple[float, float], Floats], Run]


@dataclass(frozen=True, eq=False)
class Spans:
    """Steps from edge to edge, of blocks that slip: over them motion, and friction, are resolved."""

    counts: Ints  #: of those listed between edges, shape (m,)
    repeats: Ints  #: how often each of these is taken: where there would be many, once listed; shape (m,)
    length: Floats  #: shape (q,)
    order: Ints  #: of their series, shape (q,)
    t: Floats  #: their nodes, shape (q, 5)

    @classmethod
    def of(cls, system: System, edges: Floats, modes: NDArray[np.int8]) -> Spans:
        """Between edges, from the modes between them."""
        rate, longest = system.fastest_rate, _LONG_STEP
        if system.weakening is not None:
            near, far = system.slip_friction
            rate, longest = rate + system.weakening.steepest * (near - far).max(), _STEP
        lengths = np.diff(edges)
        counts = (np.maximum(np.ceil(lengths * (rate / longest)), 1.0) * modes.any(axis=1)).astype(np.intp)
        length = lengths / np.maximum(counts, 1)
        repeats = np.where((counts > _MOST) & (system.weakening is None), counts, 1)
        counts //= repeats
        length = length.repeat(counts)
        number = np.arange(len(length)) - (np.cumsum(counts) - counts).repeat(counts)
        since = edges[:-1].repeat(counts) + number * length
        order = np.searchsorted(_REACH, rate * length) + 1
        return cls(counts, repeats, length, order, since[:, None] + length[:, None] * _NODES)


@dataclass(frozen=True, eq=False)
class Path:
    """A run between some of its events, with the states there."""

    system: System  #: of unit masses
    modes: NDArray[np.int8]  #: before the first edge, and from each but the last to the next, shape (m + 1, n)
    states: Samples  #: at the m + 1 edges
    middle: Samples  #: and half way between them
    block: NDArray[np.int32]  #: of the event at each edge but the last, shape (m,); empty: there are none
    spans: Spans  #: between them
    slip: Floats  #: w - v at the nodes of the steps, shape (q, 5, n), where friction falls with speed; else none
    _extents: dict[bytes, float] = field(default_factory=dict)

    @classmethod
    def of(cls, system: System, events: EventSeries, edges: Floats, follow: Callable[[Floats], Samples]) -> Path:
        """From the events at all edges but the last, or from none; `follow` gives the states at any times."""
        m, unit = len(edges) - 1, system.of_unit_mass
        modes = np.repeat(events.initial_mode[np.newaxis], m + 1, axis=0)
        for k, (block, mode) in enumerate(zip(events.block[:m].tolist(), events.mode[:m].tolist(), strict=True)):
            modes[k + 1 :, block] = mode
        spans = Spans.of(unit, edges, modes[1:])
        middle = 0.5 * (edges[1:] + edges[:-1])
        times = np.concatenate([edges, middle, spans.t[: 0 if system.weakening is None else None].ravel()])
        order = np.argsort(times, kind="stable")
        samples, place = follow(times[order]), np.argsort(order, kind="stable")
        z, w = samples.z[place], samples.w[place]
        slip = (w[2 * m + 1 :] - system.belt_speed_at(edges[0])).reshape(-1, len(_NODES), system.n)
        states, halfway = (Samples(times[part], z[part], w[part]) for part in (slice(m + 1), slice(m + 1, 2 * m + 1)))
        return cls(unit, modes, states, halfway, events.block[:m], spans, slip)

    def extent(self, drift: Floats) -> float:
        """How large the motion is, but for a drift at a steady speed.

        The largest of: how far states lie from the first, and z' and w' over the fastest rate.
        """
        if (known := self._extents.get(drift.tobytes())) is not None:
            return known
        one, other = self.states, self.middle
        t, z, w = np.append(one.t, other.t), np.concatenate([one.z, other.z]), np.concatenate([one.w, other.w])
        steady = drift / (self.states.t[-1] - t[0])
        apart = z - z[0] - np.outer(t - t[0], steady), w - w[0]
        fastest = self.system.fastest_rate or 1.0
        sizes = (*apart, (w - steady) / fastest, self._slip_rates / fastest)
        self._extents[drift.tobytes()] = extent = float(max(np.abs(size).max() for size in sizes))
        return extent

    def missed(self, drift: Floats) -> Floats:
        """By what the last state misses the first, but for a drift, shape (2n,)."""
        z, w = self.states.z, self.states.w
        return np.concatenate([z[-1] - z[0] - drift, w[-1] - w[0]])

    def is_differentiable(self, at_once: float) -> bool:
        """Whether deviations have a matrix; events no further apart than `at_once` are at one instant.

        Not where damping couples an exit with a jump of w' to another event of its instant: which of the two comes
        first then depends on the deviation, and what it becomes on that.
        """
        s, cross = self.system, self.system.cross_damping
        if cross is None:
            return True
        for k, i in enumerate(self.block.tolist()):
            is_jump = self.modes[k, i] == 0 and s.static[i] > s.slip_friction[0][i]
            others = self.block[np.abs(self.states.t[: len(self.block)] - self.states.t[k]) <= at_once]
            if is_jump and (abs(cross) @ np.isin(np.arange(s.n), others))[i] > 0.0:
                return False
        return True

    def monodromy(self, is_forced: bool) -> Floats:
        """By what deviations just before the first event are multiplied until just before the last edge.

        Shape (2n, 2n). Where no force depends on time, they are taken there when the first event comes back.
        """
        n, spans, slips, is_long = self.system.n, self.spans, self.modes[1:] != 0, self.spans.repeats > 1
        pull, drags = self.system.slip_matrix()[n:], np.zeros((len(spans.t), len(_NODES) if len(self.slip) else 1, n))
        np.fill_diagonal(pull[:, n:], 0.0)
        drags[:, 0] = self.system.damping
        if len(self.slip):
            drags += _THROUGH @ self.system.kinetic_slope(self.slip)
        blocks, first = np.argsort(~slips, axis=1, kind="stable"), spans.counts.cumsum() - spans.counts
        of_stays = first, np.where(is_long, 0, spans.counts), slips.sum(axis=1), blocks
        course = Course(*self._events, *of_stays, spans.length, spans.order, drags)
        one_step = course._replace(block=np.full(len(slips), -1), counts=spans.counts)
        is_free, start = np.append(np.full(n, True), self.modes[0] != 0), 0
        moved = np.identity(2 * n)[:, is_free]
        for k in np.flatnonzero(is_long).tolist():
            moved, start = carried(moved, pull, course, start, k + 1), k + 1
            flow = carried(np.identity(2 * n), pull, one_step, k, k + 1)
            moved = np.linalg.matrix_power(flow, int(spans.repeats[k])) @ moved
        moved = carried(moved, pull, course, start, len(slips))
        if not is_forced:  # shift each in time until the first event is when it was
            block = int(self.block[0])
            off, rates = moved[n + block], self._slip_rates[0]
            late = -pull[block] @ moved / self._loads[0, block] if self.modes[0, block] == 0 else off / rates[block]
            moved -= np.append(self.states.w[0], rates)[:, np.newaxis] * late
        whole = np.zeros((2 * n, 2 * n))
        whole[np.ix_(is_free, is_free)] = moved[is_free]
        return whole

    # ------------------------------------------------------------------------------------------ events

    @cached_property
    def _slip_rates(self) -> Floats:
        """w' before each edge, shape (m + 1, n)."""
        return slip_rates(self.system, self.states, self.modes)

    @cached_property
    def _loads(self) -> Floats:
        """Rates at which a block that sticks is loaded, (K w + C w' - f')_i, at each edge, shape (m + 1, n)."""
        loads = (self.system.stiffness @ self.states.w.T).T + self.system.damping_force(self._slip_rates)
        for term in self.system.force:
            if isinstance(term, Harmonic):
                rate = Harmonic(term.amplitude * term.frequency, term.frequency, term.phase + np.pi / 2)
                loads = loads - rate.at(self.states.t)
        return np.asarray(loads)

    @property
    def _events(self) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
        """The block of the event at each edge, -1 if it has none, and its factor; whether that is of F: an exit."""
        if not len(self.block):
            return np.array([-1]), np.zeros(1), np.array([False])
        s, block, at = self.system, self.block.astype(np.int64), (np.arange(len(self.block)), self.block)
        before, after, near = self.modes[:-1][at], self.modes[1:][at], s.slip_friction[0][block]
        is_exit = before == 0
        change = np.where(is_exit, after * (s.static[block] - near), near * (before - after)) * (after != 0)
        rate = np.where(is_exit, -self._loads[at], self._slip_rates[at])
        factor = np.divide(change, rate, out=np.zeros(len(block)), where=change != 0.0)
        return block, factor + (before * after != 0), is_exit


def slip_rates(system: System, states: Samples, modes: NDArray[np.int8]) -> Floats:
    """w' of blocks of unit masses at some states, with the modes there, shape (m, n)."""
    s, (t, z, w) = system, (states.t, states.z, states.w)
    forces = -(s.stiffness @ z.T).T - s.damping_force(w) - s.kinetic(w - s.belt_speed_at(t)) * modes
    if s.force:
        forces += s.force_at(t)
    return np.where(modes == 0, 0.0, forces)


def largest(monodromy: Floats, free: Any) -> float:
    """Largest modulus of the multipliers of a cycle, but for those of shifts along `free`, which change nothing.

    `monodromy` is that of its `Path`; there the multiplier of a shift in time is 0, where no force depends on it.
    `free`, shape (n, k), an array or a sparse one, has orthonormal columns, along which no spring pulls.
    """
    across, n = monodromy.copy(), free.shape[0]
    across[:n] -= free @ (free.T @ across[:n])
    return float(np.abs(np.linalg.eigvals(across)).max())
