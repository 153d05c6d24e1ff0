"""How fast runs that begin next to each other part.

Two runs, of which the second is set back next to the first again and again, give the largest Lyapunov exponent
(G. Benettin, L. Galgani and J.-M. Strelcyn, Phys. Rev. A 14 (1976) 2338) at the cost of the runs, whatever the number
of blocks and events. Their distance is that of (z, w / omega), omega the fastest rate of a block, across the motion,
as a shift in time does not grow; where a force depends on time there is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.attractors.multipliers import LOST, Follow, slip_rates
from stickslip.sim.attractors.null_space import across
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.system import System

#: The tolerance at which they are run.
TOL = 1e-12
#: How far apart they begin, of the size of the motion, or if that is more, of the errors of such runs; and the most
#: of the size of the motion that the latter may be.
_APART, _NOISE, _MOST = 1e-8, 1e3, 1e-4
_EPS = float(np.finfo(np.float64).eps)
#: The first piece, of the time; instants in each; ln of the growth in a piece below which the next is twice as long,
#: above which half as long; and of the growth, or decay, that is enough.
_FIRST, _SAMPLES, _LITTLE, _MUCH, _ENOUGH = 1 / 32, 50, 3.0, 8.0, 30.0
#: ln of what a deviation grows by over the last two thirds of a time, with a third of that in each half: on a torus
#: without forces deviations grow as time does, by ln 2 and ln 1.5 there.
_GROWN = 3.0
#: And over its standard error, from so many parts of that time (95%, one-sided, by Student's t): a beat of forces
#: moves deviations back and forth.
_CERTAIN, _PARTS = 1.9, 8
#: ln of what a distance of zero counts as.
_NOTHING = -10.0
#: Distances are averaged over this share of the time, at so many instants: they vary within a round.
_WINDOW, _INSTANTS = 0.1, 60


class Growth(NamedTuple):
    """The rate at which a small deviation grows, and ln of its growth in the second and in the last third of a time.

    In the first it turns to the direction that grows fastest. `error` is the standard error of ln of that in both.
    """

    rate: float
    second: float
    last: float
    error: float

    @property
    def grows(self) -> bool:
        """Whether it grows as in chaos."""
        least = max(_GROWN, _CERTAIN * self.error)
        return self.second + self.last >= least and min(self.second, self.last) >= _GROWN / 3.0

    @property
    def decays(self) -> bool:
        """Whether it decays as steadily."""
        return Growth(-self.rate, -self.second, -self.last, self.error).grows


def growth(
    system: System,
    z: Floats,
    w: Floats,
    modes: NDArray[np.int8],
    times: tuple[float, float],
    follow: Follow,
    is_forced: bool,
) -> Growth | None:
    """How fast runs from a state, shape (n,), and from next to it part; None if the motion is too small to tell.

    From the first of two times to the second, or until they have parted, or come together, by e^30. `is_forced` says
    whether a force depends on time.
    """
    n, fastest = system.n, system.fastest_rate or 1.0
    t, end = times
    length, total, distance = _FIRST * (end - t), 0.0, 0.0
    start_modes: NDArray[np.int8] | None = modes
    towards = _any_direction(n)
    instants, logs = [np.array([t])], [np.zeros(1)]
    while t < end and abs(total) < _ENOUGH:
        sampled = np.linspace(t, end if end - t < 1.5 * length else t + length, _SAMPLES + 1)
        span = t, float(sampled[-1])
        reference = follow(z, w, start_modes, span, sampled)
        if not distance:
            size = float(np.ptp(across(system, reference.samples.z), axis=0).max())
            noise = max(TOL * system.fastest_belt / fastest, _EPS * float(np.abs(z).max()))
            distance = max(_APART * size, _NOISE * noise)
            if size < LOST or distance > _MOST * size:
                return None
        shift = distance * towards
        neighbour = follow(z + shift[:n], w + fastest * shift[n:], None, span, sampled)
        deviation = _apart(system, fastest, reference, neighbour, is_forced) / distance
        with np.errstate(divide="ignore"):
            grown = np.maximum(np.log(np.linalg.norm(deviation, axis=1)), _NOTHING)
        instants.append(sampled[1 : len(grown)])
        logs.append(total + grown[1:])
        if len(grown) < len(sampled):
            break  # one of them ran away
        t, total = span[1], total + float(grown[-1])
        z, w, start_modes = reference.samples.z[-1], reference.samples.w[-1], None
        towards = _any_direction(n) if grown[-1] <= _NOTHING else deviation[-1] / np.linalg.norm(deviation[-1])
        towards[n:][reference.events.mode_at(t) == 0] = 0.0
        length *= 2.0 if abs(grown[-1]) < _LITTLE else 0.5 if abs(grown[-1]) > _MUCH else 1.0
    return _of(np.concatenate(instants), np.concatenate(logs))


def _any_direction(n: int) -> Floats:
    direction = np.append(np.random.default_rng(0).normal(size=n), np.zeros(n))
    return np.asarray(direction / np.linalg.norm(direction))


def _apart(system: System, fastest: float, reference: Run, neighbour: Run, is_forced: bool) -> Floats:
    """By what two runs differ at the instants of their samples, as far as both go, shape (m, 2n)."""
    m = int(np.searchsorted(reference.samples.t, min(reference.t_end, neighbour.t_end), side="right"))
    states = reference.samples.first(m)
    deviation = np.concatenate(
        [neighbour.samples.z[:m] - states.z, (neighbour.samples.w[:m] - states.w) / fastest], axis=1
    )
    if not is_forced:
        rates = slip_rates(system.of_unit_mass, states, reference.events.modes_at(states.t))
        along = np.concatenate([states.w, rates / fastest], axis=1)
        size = (along**2).sum(axis=1)
        deviation -= ((deviation * along).sum(axis=1) / np.where(size > 0.0, size, 1.0))[:, np.newaxis] * along
    return np.asarray(deviation)


def _of(instants: Floats, logs: Floats) -> Growth:
    """From ln of the distance at some instants."""
    begin, length = float(instants[0]), float(instants[-1] - instants[0])
    if length == 0.0:
        return Growth(0.0, 0.0, 0.0, 0.0)  # one of them ran away at once
    ends = begin + length / 3.0 * np.arange(1, 4)
    windows = ends[:, np.newaxis] - _WINDOW * length * np.linspace(0.0, 1.0, _INSTANTS)
    first, second, third = np.interp(windows, instants, logs).mean(axis=1).tolist()
    growths = np.diff(np.interp(np.linspace(ends[0], ends[2], _PARTS + 1), instants, logs))
    error = math.sqrt(_PARTS) * float(growths.std(ddof=1))
    return Growth((third - first) / (length * 2.0 / 3.0), second - first, third - second, error)
