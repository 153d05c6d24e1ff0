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

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.variations import ORDER, carry
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.drive import Harmonic
from stickslip.sim.systems.system import System

#: Terms of the exponential series, of matrices up to this size: the next is 1e-16.
_TERMS, _SIZE = 13, 0.5
#: Steps where friction falls with speed, over its fastest rate.
_STEP = 0.35
#: Nodes of a step, of Gauss; from values there to the coefficients of the polynomial through them.
_NODES = 0.5 + 0.5 * np.polynomial.legendre.leggauss(5)[0]
_THROUGH = np.linalg.inv(np.vander(_NODES, increasing=True))
#: Numbers in matrices that are kept at a time.
_ROOM = 2**21
#: How large a motion is at least, for ratios of what it consists of to have all their digits.
LOST = float(np.finfo(np.float64).tiny / np.finfo(np.float64).eps)


class Follow(Protocol):
    """Runs a system from z, w and modes, if they are known, from one time to another, with samples at some times."""

    def __call__(
        self, z: Floats, w: Floats, modes: NDArray[np.int8] | None, span: tuple[float, float], times: Floats
    ) -> Run: ...


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps from edge to edge, over which friction that falls with speed is resolved."""

    segment: NDArray[np.intp]  #: the edge before each, shape (q,)
    length: Floats  #: shape (q,)
    t: Floats  #: their nodes, shape (q, 5)

    @classmethod
    def of(cls, system: System, edges: Floats, modes: NDArray[np.int8]) -> Steps:
        """Between edges, from the modes between them: one step where all blocks stick."""
        assert system.weakening is not None
        near, far = system.slip_friction
        rate = system.fastest_rate + system.weakening.steepest * (near - far).max()
        lengths = np.diff(edges)
        counts = np.where(modes.any(axis=1), np.ceil(lengths * (rate / _STEP)), 1.0)
        counts = np.maximum(counts, 1.0).astype(np.intp)
        segment = np.repeat(np.arange(len(lengths)), counts)
        length = (lengths / counts)[segment]
        number = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
        since = edges[segment] + number * length
        return cls(segment, length, since[:, None] + length[:, None] * _NODES)


@dataclass(frozen=True, eq=False)
class Path:
    """A run between some of its events, with the states there."""

    system: System  #: of unit masses
    modes: NDArray[np.int8]  #: before the first edge, and from each but the last to the next, shape (m + 1, n)
    states: Samples  #: at the m + 1 edges
    middle: Samples  #: and half way between them
    block: NDArray[np.int32]  #: of the event at each edge but the last, shape (m,); empty: there are none
    steps: Steps | None  #: between them, where friction falls with speed
    slip: Floats  #: w - v at the nodes of the steps, shape (q, 5, n)

    @classmethod
    def of(cls, system: System, events: EventSeries, edges: Floats, follow: Callable[[Floats], Samples]) -> Path:
        """From the events at all edges but the last, or from none; `follow` gives the states at any times."""
        m, unit = len(edges) - 1, system.of_unit_mass
        modes = np.repeat(events.initial_mode[np.newaxis], m + 1, axis=0)
        for k, (block, mode) in enumerate(zip(events.block[:m].tolist(), events.mode[:m].tolist(), strict=True)):
            modes[k + 1 :, block] = mode
        steps = None if system.weakening is None else Steps.of(unit, edges, modes[1:])
        middle = 0.5 * (edges[1:] + edges[:-1])
        times = np.concatenate([edges, middle, *([] if steps is None else [steps.t.ravel()])])
        order = np.argsort(times, kind="stable")
        samples, place = follow(times[order]), np.argsort(order, kind="stable")
        z, w = samples.z[place], samples.w[place]
        slip = (w[2 * m + 1 :] - system.belt_speed_at(edges[0])).reshape(-1, len(_NODES), system.n)
        states, halfway = (Samples(times[part], z[part], w[part]) for part in (slice(m + 1), slice(m + 1, 2 * m + 1)))
        return cls(unit, modes, states, halfway, events.block[:m], steps, slip)

    def extent(self, drift: Floats) -> float:
        """How large the motion is, but for a drift at a steady speed.

        The largest of: how far states lie from the first, and z' and w' over the fastest rate.
        """
        one, other = self.states, self.middle
        t, z, w = np.append(one.t, other.t), np.concatenate([one.z, other.z]), np.concatenate([one.w, other.w])
        steady = drift / (self.states.t[-1] - t[0])
        apart = z - z[0] - np.outer(t - t[0], steady), w - w[0]
        fastest = self.system.fastest_rate or 1.0
        sizes = (*apart, (w - steady) / fastest, self._slip_rates / fastest)
        return float(max(np.abs(size).max() for size in sizes))

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
            if is_jump and _row(cross, i)[others].any():
                return False
        return True

    def monodromy(self, is_forced: bool) -> Floats:
        """By what deviations just before the first event are multiplied until just before the last edge.

        Shape (2n, 2n). Where no force depends on time, they are taken there when the first event comes back.
        """
        n = self.system.n
        moved = np.identity(2 * n)
        moved[n:][self.modes[0] == 0] = 0.0
        for k in self._edges(moved):
            self._pass(k, moved)
        if not is_forced:
            self._onto_section(0, moved)
        moved[n:][self.modes[0] == 0] = 0.0
        return moved

    # ------------------------------------------------------------------------------------------ events

    @cached_property
    def _slip_rates(self) -> Floats:
        """w' before each edge, shape (m + 1, n)."""
        return slip_rates(self.system, self.states, self.modes)

    @cached_property
    def _motion(self) -> Floats:
        """(z', w') before each edge, shape (m + 1, 2n, 1)."""
        return np.concatenate([self.states.w, self._slip_rates], axis=1)[:, :, np.newaxis]

    @cached_property
    def _loads(self) -> Floats:
        """Rates at which a block that sticks is loaded, (K w + C w' - f')_i, at each edge, shape (m + 1, n)."""
        loads = (self.system.stiffness @ self.states.w.T).T + self.system.damping_force(self._slip_rates)
        for term in self.system.force:
            if isinstance(term, Harmonic):
                rate = Harmonic(term.amplitude * term.frequency, term.frequency, term.phase + np.pi / 2)
                loads = loads - rate.at(self.states.t)
        return np.asarray(loads)

    @cached_property
    def _rows(self) -> dict[int, Floats]:
        """(K_i, N_i), the gradient of F_i, of each block with an event, shape (2n,)."""
        k, cross = self.system.stiffness, self.system.cross_damping
        none = np.zeros(self.system.n)
        return {
            i: np.append(_row(k, i), none if cross is None else _row(cross, i))
            for i in np.unique(self.block).tolist()
        }

    def _pass(self, k: int, moved: Floats) -> None:
        """Multiply deviations, the columns of an array, by the saltation matrix of the event at an edge, in place."""
        if len(self.block) == 0:
            return
        s, i = self.system, int(self.block[k])
        before, after, row = int(self.modes[k, i]), int(self.modes[k + 1, i]), moved[s.n + i]
        if after == 0:
            row[:] = 0.0
        elif before == 0:
            drop = s.static[i] - s.slip_friction[0][i]
            row[:] = after * drop / self._loads[k, i] * (self._rows[i] @ moved) if drop > 0.0 else 0.0
        else:
            row *= 1.0 + s.slip_friction[0][i] * (before - after) / self._slip_rates[k, i]

    def _onto_section(self, k: int, moved: Floats) -> None:
        """Shift deviations in time, in place, until each has the event at an edge at the time of that edge."""
        n, i = self.system.n, int(self.block[k])
        if self.modes[k, i] == 0:
            late = self._rows[i] @ moved / self._loads[k, i]
        else:
            late = moved[n + i] / self._slip_rates[k, i]
        moved -= self._motion[k] * late

    # ------------------------------------------------------------------------------------------ between events

    def _edges(self, moved: Floats) -> Iterator[int]:
        """Each edge but the last; from there deviations are carried to the next, in place, when that is asked for."""
        n, m, lengths, matrix = self.system.n, len(self.states) - 1, np.diff(self.states.t), self.system.slip_matrix()
        if (steps := self.steps) is None:
            at_a_time = max(_ROOM // (4 * n * n), 1)
            for first in range(0, m, at_a_time):
                part = slice(first, first + at_a_time)
                flows = exponential(_held(matrix, self.modes[1:][part]) * lengths[part, None, None])
                for k, flow in enumerate(flows, first):
                    yield k
                    moved[:] = flow @ moved
            return
        drags, slips = _THROUGH @ self.system.kinetic_slope(self.slip), self.modes[1:][steps.segment] != 0
        first_steps, series = np.searchsorted(steps.segment, np.arange(m + 1)), np.empty((ORDER + 1, *moved.shape))
        for k, (first, last) in enumerate(itertools.pairwise(first_steps.tolist())):
            yield k
            carry(matrix[n:], drags[first:last], slips[first:last], steps.length[first:last], moved, series)


def _row(matrix: Any, i: int) -> Floats:
    """Row i of a dense or sparse matrix, shape (n,)."""
    return np.asarray(matrix[i] if isinstance(matrix, np.ndarray) else matrix[[i]].toarray()[0])


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


def exponential(matrices: Floats) -> Floats:
    """exp of each matrix of a stack, shape (m, k, k), by its series, scaled and squared.

    Much faster than one by one, for many small ones; those of dissipative systems stay below one, and lose little.
    """
    sizes = np.abs(matrices).sum(axis=2).max(axis=1, initial=_SIZE)
    squarings = np.ceil(np.log2(sizes / _SIZE)).astype(int)
    small = np.ldexp(matrices, -squarings[:, None, None])
    total = term = np.broadcast_to(np.identity(matrices.shape[1]), matrices.shape)
    for k in range(1, _TERMS + 1):
        term = term @ small / k
        total = total + term
    for k in range(squarings.max(initial=0)):  # of each as often as it takes: squaring doubles its rounding
        more = squarings > k
        total[more] = total[more] @ total[more]
    return total


def _held(matrix: Floats, modes: NDArray[np.int8]) -> Floats:
    """A where blocks with mode 0 stick, for rows of modes (m, n), shape (m, 2n, 2n)."""
    n = modes.shape[1]
    matrices = np.repeat(matrix[np.newaxis], len(modes), axis=0)
    matrices[:, n:][modes == 0] = 0.0
    return matrices
