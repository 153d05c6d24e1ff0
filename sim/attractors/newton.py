"""The cycle that a run is about to settle on, by Newton's method.

A run that comes nearer to a cycle by a tenth a period is far from it for long. The cycle is found sooner as the state
at an event that comes back, x = P(x): with M = dP/dx, from the deviations along one round, x goes to
x + (1 - M)^-1 (P(x) - x), and the error to its square.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.attractors.multipliers import LOST, Follow, Path
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.series import EventSeries, by_block
from stickslip.sim.systems.system import System

#: Rounds of Newton's method, each of which has to come nearer.
_MOST = 20
#: A round is run for so much longer than the last: it may take another time from another state.
_LONGER = 1.2
#: A state comes back exactly within this share of its motion's size.
_EXACT = 1e-14
#: A run is near a cycle if its distance from it is within this share of the motion's size, now and by M in as many
#: rounds as here: from further off a block that is near its belt's speed, or near leaving, may have another event.
FAR, _ROUNDS = 3e-3, 100


@dataclass(frozen=True, eq=False)
class Near:
    """A cycle near a run: its events, those at time 0 first and last, the path of one round, and its matrix.

    `distance` is that of the run's state from it, over the size of its motion.
    """

    events: EventSeries
    path: Path
    matrix: Floats
    distance: float


@dataclass(frozen=True, eq=False)
class Newton:
    """Newton's method for cycles of a system whose drive does not depend on time."""

    system: System
    follow: Follow
    in_order: Callable[[EventSeries], EventSeries]  #: puts the events of one instant in an order without rounding
    size_of: Callable[[Path], float]  #: the size of the motion on a path
    back: float  #: by how much of that a state on a cycle may miss itself
    far: float  #: how far from its cycle, of that, a run on its way to it may be
    counted: NDArray[np.bool_]  #: the blocks whose events have to be those of the round

    def cycle(self, z: Floats, w: Floats, events: EventSeries) -> Near | None:
        """The cycle near a state at an entry or a crossing, if a run from that state is on its way to it; else None.

        `events` are a round of them from that state on, shape (n,), those of its ends first, at time 0, and last.
        """
        start, x, missed = np.concatenate([z, w]), np.concatenate([z, w]), math.inf
        round_, nearest, is_on_its_way = events, None, False
        for _ in range(_MOST):
            after = self._round(x, round_)
            if after is None:
                break
            round_, path = after
            error = np.concatenate([path.states.z[-1], path.states.w[-1]]) - x
            # a state is further from the cycle than it moves in a round: once it is back, more steps go to the cycle
            size, off_by = self.size_of(path), float(np.linalg.norm(error))
            if size < LOST or off_by > missed:
                break
            matrix = path.monodromy(is_forced=False)
            step = np.linalg.lstsq(np.identity(len(x)) - matrix, error, rcond=1e-12)[0]
            if np.abs(error).max() <= self.back * size:
                off = start - x - step  # from where the next step leads
                nearest = Near(round_, path, matrix, float(np.linalg.norm(off)) / size)
                is_on_its_way = _stays_within(self.far * size, matrix, off)
            missed = off_by
            if missed <= _EXACT * size:
                break
            x += step
        return nearest if is_on_its_way else None

    def _round(self, x: Floats, last: EventSeries) -> tuple[EventSeries, Path] | None:
        """The events of a round from a state, as those of the last one, and its path; None if they are others.

        The state, shape (2n,), has its first block, and those that stick, at their belts' speeds from then on.
        """
        n, block, counted = self.system.n, int(last.block[0]), self.counted
        z, w, before = x[:n], x[n:], last.initial_mode
        modes = before.copy()
        modes[block] = last.mode[0]
        belt = self.system.belt_speed_at(0.0)
        w[:] = np.where((modes == 0) | (np.arange(n) == block), belt, w)
        # a block that does not count is on a side of its belt's speed, and never sticks
        sides = np.where(w < belt, -1, 1)
        before, modes = (np.where(counted, mode, sides).astype(np.int8) for mode in (before, modes))
        if not _are_allowed(self.system, z, w, modes):
            return None
        run = partial(self.follow, z, w, modes)
        after = self.in_order(run((0.0, _LONGER * float(last.t[-1])), np.empty(0)).events)
        listed = np.flatnonzero(counted[last.block])[1:]
        places = np.flatnonzero(counted[after.block])[: len(listed)]
        listed[-1] = 0  # it ends as it began
        if len(places) < len(listed) or _symbols(after, places) != _symbols(last, listed):
            return None
        end = int(places[-1]) + 1  # with those of blocks that do not count
        t, blocks = np.append(0.0, after.t[:end]), np.append(last.block[:1], after.block[:end])
        passed = np.append(last.mode[:1], after.mode[:end])
        round_ = replace(after, t=t, block=blocks, mode=passed, initial_mode=before, t_end=float(t[-1]))
        return round_, Path.of(self.system, round_, t, lambda times: run((0.0, round_.t_end), times).samples)


def _symbols(events: EventSeries, places: NDArray[np.intp]) -> list[tuple[int, int]]:
    """The blocks and modes of some events: the last one last, the others, which may be at one instant, by block."""
    order = np.append(places[by_block(events.block[places[:-1]])], places[-1])
    return [*zip(events.block[order].tolist(), events.mode[order].tolist(), strict=True)]


def _stays_within(bound: float, matrix: Floats, start: Floats) -> bool:
    """Whether the norm of a vector does, multiplied again and again by a matrix."""
    for _ in range(_ROUNDS):
        if np.linalg.norm(start) > bound:
            return False
        start = matrix @ start
    return True


def _are_allowed(system: System, z: Floats, w: Floats, modes: NDArray[np.int8]) -> bool:
    """Whether blocks can be in some modes: a long step may lead to a state where they cannot."""
    slip = w - system.belt_speed_at(0.0)
    pull = -(system.stiffness @ z) - system.damping_force(w)
    pull += system.force_at(0.0) if system.force else 0.0
    outward = np.where(system.closed == 0, np.abs(pull), -system.closed * pull)
    slips = (modes * slip > 0.0) | ((slip == 0.0) & (modes * pull > system.kinetic(0.0 * slip)))
    return bool(np.where(modes == 0, outward < system.static, slips).all())
