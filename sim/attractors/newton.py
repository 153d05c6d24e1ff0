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

from stickslip.sim.attractors.deviations import LOST, Follow, Path
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Samples
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


def near_cycle(
    system: System,
    z: Floats,
    w: Floats,
    events: EventSeries,
    n_events: int,
    back: float,
    in_order: Callable[[EventSeries], EventSeries],
    follow: Follow,
    size_of: Callable[[Path], float],
    counted: NDArray[np.bool_] | None = None,
    far: float = FAR,
) -> Near | None:
    """The cycle near a state at an entry or a crossing, if a run from that state is on its way to it; else None.

    Parameters
    ----------
    system : System
        Whose drive does not depend on time.
    z, w : float64, shape (n,)
    events : EventSeries
        From that state on, the event there first, at time 0, for one round at least.
    n_events : int
        Of a round, of the blocks that count.
    back : float
        By how much of the motion's size the state may miss itself.
    in_order : callable
        Puts the events of one instant in the order of `events`.
    follow : Follow
    size_of : callable
        The size of the motion on a path.
    counted : bool, shape (n,), optional
        The blocks whose events have to be those of the round; default: all.
    far : float
        How far from its cycle, of the size of its motion, a run may be to be on its way to it.
    """
    n, p = system.n, n_events
    is_counted = np.full(n, True) if counted is None else counted
    first = z, w
    round_events = np.flatnonzero(is_counted[events.block])[1:p]
    order = round_events[by_block(events.block[round_events])]
    expected, symbol = (events.block[order], events.mode[order]), (events.block[0], events.mode[0])
    block, mode = int(symbol[0]), int(symbol[1])
    before = events.initial_mode
    modes = before.copy()
    modes[block] = mode
    period = float(events.t[-1])
    missed = math.inf
    is_held = (modes == 0) | (np.arange(n) == block)
    nearest, is_on_its_way = None, False
    for _ in range(_MOST):
        w = np.where(is_held, system.belt_speed_at(0.0), w)
        # a block that does not count is on a side of its belt's speed, and never sticks
        sides = np.where(w < system.belt_speed_at(0.0), -1, 1)
        before, modes = (np.where(is_counted, mode_of, sides).astype(np.int8) for mode_of in (before, modes))
        if not _are_allowed(system, z, w, modes):
            break
        after = in_order(follow(z, w, modes, (0.0, _LONGER * period), np.empty(0)).events)
        places = np.flatnonzero(is_counted[after.block])[:p]
        if len(places) < p or (after.block[places[-1]], after.mode[places[-1]]) != symbol:
            break
        n_after = int(places[-1]) + 1  # with those of blocks that do not count
        order = places[by_block(after.block[places[:-1]])]
        if (after.block[order] != expected[0]).any() or (after.mode[order] != expected[1]).any():
            break
        t = np.append(0.0, after.t[:n_after])
        round_ = replace(
            after, t=t, block=np.append(block, after.block[:n_after]).astype(after.block.dtype),
            mode=np.append(mode, after.mode[:n_after]).astype(after.mode.dtype), initial_mode=before,
            t_end=float(t[-1]),
        )  # fmt: skip
        ending = partial(_samples, follow, z, w, modes, float(t[-1]))
        path = Path.of(system, round_, t, ending)
        error = np.concatenate([path.states.z[-1] - z, path.states.w[-1] - w])
        size = size_of(path)
        if size < LOST:
            break
        # a state is further from the cycle than it moves in a round: once it is back, more steps go to the cycle
        off_by = float(np.linalg.norm(error))
        if off_by > missed:
            break
        matrix = path.monodromy(is_forced=False)
        step = np.linalg.lstsq(np.identity(2 * n) - matrix, error, rcond=1e-12)[0]
        if np.abs(error).max() <= back * size:
            start = np.concatenate([first[0] - z, first[1] - w]) - step  # to where the next step leads
            nearest = Near(round_, path, matrix, float(np.linalg.norm(start)) / size)
            is_on_its_way = _stays_within(far * size, matrix, start)
        missed, period = off_by, float(t[-1])
        if missed <= _EXACT * size:
            break
        z, w = z + step[:n], w + step[n:]
    return nearest if is_on_its_way else None


def _stays_within(bound: float, matrix: Floats, start: Floats) -> bool:
    """Whether the norm of a vector does, multiplied again and again by a matrix."""
    for _ in range(_ROUNDS):
        if np.linalg.norm(start) > bound:
            return False
        start = matrix @ start
    return True


def _samples(follow: Follow, z: Floats, w: Floats, modes: NDArray[np.int8], length: float, times: Floats) -> Samples:
    return follow(z, w, modes, (0.0, length), times).samples


def _are_allowed(system: System, z: Floats, w: Floats, modes: NDArray[np.int8]) -> bool:
    """Whether blocks can be in some modes: a long step may lead to a state where they cannot."""
    slip = w - system.belt_speed_at(0.0)
    pull = -(system.stiffness @ z) - system.damping_force(w)
    pull += system.force_at(0.0) if system.force else 0.0
    outward = np.where(system.closed == 0, np.abs(pull), -system.closed * pull)
    slips = (modes * slip > 0.0) | ((slip == 0.0) & (modes * pull > system.kinetic(0.0 * slip)))
    return bool(np.where(modes == 0, outward < system.static, slips).all())
