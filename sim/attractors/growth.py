"""How fast runs that begin next to each other part.

Two runs give the largest Lyapunov exponent (G. Benettin, L. Galgani and J.-M. Strelcyn, Phys. Rev. A 14 (1976) 2338)
at the cost of the runs, whatever the number of blocks and events. Their distance is taken across the motion, as a
shift in time does not grow; where a force depends on time there is none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stickslip.sim.attractors.deviations import slip_rates
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.system import System

#: How far apart they begin, of the size of the motion, with the tolerance at which they are run; ln of how many times
#: as far apart they may come, to 1e-4; and rounding of z, a thousand times.
_APART, TOL, _FAR, _ROUNDING = 1e-9, 1e-12, math.log(1e5), 1e-13
#: Shares of the time, the next one where runs are not yet far apart; instants in each; how many are the least.
_SHARES, _SAMPLES, _FEWEST = (1 / 64, 1 / 8, 1.0), 600, 30
#: Distances are averaged over this share of the time: they vary within a round.
_WINDOW = 0.1


class Growth(NamedTuple):
    """The rate at which a small deviation grows, and ln of its growth in the second and in the last third of a time.

    In the first it turns to the direction that grows fastest.
    """

    rate: float
    second: float
    last: float


def growth(
    system: System, z: Floats, times: tuple[float, float], follow: Callable[[Floats, Floats], Run], is_forced: bool
) -> Growth | None:
    """How fast runs from a state and from next to it part; None if nothing is left of a deviation.

    Parameters
    ----------
    system : System
    z : float64, shape (n,)
        Of the state.
    times : (float, float)
        From the first to the second, or until they are 1e5 times as far apart as they began.
    follow : callable
        Runs from some z, and the w of the state, with samples at some times.
    is_forced : bool
        Whether a force depends on time.
    """
    begin, end = times
    for share in _SHARES:
        at = np.linspace(begin, begin + share * (end - begin), _SAMPLES + 1)
        one = follow(z, at)
        apart = _APART * _size(one, z)
        shift = np.random.default_rng(0).normal(size=len(z))
        other = follow(z + apart / np.linalg.norm(shift) * shift, at)
        logs = _distances(system, one, other, is_forced) - math.log(apart)
        is_far = logs > _FAR
        last = int(is_far.argmax()) if is_far.any() else len(logs) - 1
        if is_far.any() and last >= _FEWEST:
            break
    since = at[: last + 1] - begin
    width = _WINDOW * float(since[last])
    ends = since[last] / 3.0 * np.arange(1, 4)
    means = [float(logs[: last + 1][np.abs(since - t + width / 2) <= width / 2].mean()) for t in ends]
    if not np.isfinite(means).all():
        return None
    return Growth((means[2] - means[0]) / float(ends[2] - ends[0]), means[1] - means[0], means[2] - means[1])


def _size(run: Run, z: Floats) -> float:
    """The size of the motion, or what rounding leaves of it where z is large."""
    return float(max(np.ptp(run.samples.z, axis=0).max(), _ROUNDING / _APART * np.abs(z).max()))


def _distances(system: System, one: Run, other: Run, is_forced: bool) -> Floats:
    """ln of the distance of two runs at the instants of their samples, as far as both go."""
    m = int(np.searchsorted(one.samples.t, min(one.t_end, other.t_end), side="right"))
    a, b = (np.concatenate([run.samples.z[:m], run.samples.w[:m]], axis=1) for run in (one, other))
    apart = b - a
    if not is_forced:
        states = one.samples.first(m)
        rates = slip_rates(system.of_unit_mass, states, one.events.modes_at(states.t))
        along = np.concatenate([states.w, rates], axis=1)
        size = (along**2).sum(axis=1)
        apart -= ((apart * along).sum(axis=1) / np.where(size > 0.0, size, 1.0))[:, np.newaxis] * along
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.linalg.norm(apart, axis=1)))
