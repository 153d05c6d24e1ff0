"""Figures 1 and 2: one block and two under the exact law, sampled between events."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from stickslip import sim
from stickslip.sim.theory import folds, strata
from stickslip.workflows.charts.peers import Floats

#: Figure 1, of which the paper gives no constants: rho, kappa, mu, |v|.
ONE = (0.1, 1.0, 1.0, 0.5)
#: Figure 2: rho, kappa_1, kappa_2, kappa_12, mu, v as the caption has them.
RHO, KAPPA_1, KAPPA_2, KAPPA_12, MU, V = 0.1, 1.1, 1.6, 0.5, 1.0, -1.0


@dataclass(frozen=True)
class Portrait:
    """Figure 1: one block's (z, w) for one v; paths are (z, w, whether it leaves the exit point)."""

    v: float
    stick: list[float]
    exit: float
    paths: list[tuple[list[float], list[float], bool]]


@dataclass(frozen=True)
class Path2:
    """One run of two blocks, sampled: case "a", "b" or "c" of figure 2; events are (t, block, mode)."""

    case: str
    t: list[float]
    z: list[list[float]]
    w: list[list[float]]
    events: list[tuple[float, int, int]]


@dataclass(frozen=True)
class Parallelogram:
    """Figure 2 under one sign: corners, in order around, as (lambda_1, lambda_2, z_1, z_2, fold 1, fold 2)."""

    sign: int
    corners: list[tuple[int, int, float, float, str, str]]
    paths: list[Path2]


def sampled(system: sim.System, z0: Floats, w0: Floats, times: Floats) -> tuple[Floats, Floats]:
    """z and w at each of `times`, shape (m, n): the first is the start, each next a run on from the one before."""
    z, w = np.empty((len(times), system.n)), np.empty((len(times), system.n))
    z[0], w[0] = z0, w0
    for k, (before, now) in enumerate(pairwise(times)):
        run = sim.simulate(system, z[k], w[k], float(now), t_start=float(before), stop_early=False)
        z[k + 1], w[k + 1] = run.z, run.w
    return z, w


def single(v: float) -> sim.System:
    """The block of figure 1."""
    rho, kappa, mu, _ = ONE
    return sim.System([[kappa]], rho, mu, v)


def portrait(v: float) -> Portrait:
    """Paths from outside, and the one from the exit point."""
    system = single(v)
    stick = folds.stick_interval(system)
    leaves = stick.low if v < 0.0 else stick.high
    turn = -np.sign(v)
    starts = [
        (3.0 * turn, 1.0 * turn),
        (-3.0 * turn, -0.6 * turn),
        (-1.6 * turn, 1.2 * turn),
        (2.2 * turn, -1.0 * turn),
    ]
    times = np.linspace(0.0, 9.0, 181)
    paths = []
    for z0, w0 in [*starts, (leaves, v)]:
        z, w = sampled(system, np.array([z0]), np.array([w0]), times)
        paths.append((z[:, 0].tolist(), w[:, 0].tolist(), (z0, w0) == (leaves, v)))
    return Portrait(v, [stick.low, stick.high], leaves, paths)


def pair(sign: Literal[1, -1]) -> sim.System:
    """The system of figure 2; `sign` +1: the coupling of eq. (6) as printed, -1: the one that section 3 uses."""
    return folds.two_blocks(KAPPA_1, KAPPA_2, KAPPA_12, RHO, MU, V, sign)


def corner(system: sim.System, sides: tuple[int, int]) -> Floats:
    """Where both blocks are at the edge of sticking, lambda = `sides`; shape (2,)."""
    (found,) = (one for one in strata.corners(system) if one.sides == sides)
    return found.point


def parallelogram(sign: Literal[1, -1]) -> Parallelogram:
    """Corners and the paths (a), (b), (c) under one sign of the coupling."""
    system = pair(sign)
    corners = []
    for one in strata.parallelogram(system):
        (a, b), (x, y), (first, second) = one.sides, one.point, one.visibility()
        corners.append((a, b, float(x), float(y), str(first), str(second)))
    lead = 0.5  # time on the belt before the corner
    belt = np.full(2, V)
    starts = {"a": np.zeros(2), "b": corner(system, (1, 1)) - lead * belt, "c": corner(system, (1, -1))}
    times = np.linspace(0.0, 3.0, 301)
    paths = []
    for case, z0 in starts.items():
        z, w = sampled(system, z0, belt, times)
        events = sim.simulate(system, z0, belt, times[-1]).events
        listed = [(float(t), int(i), int(m)) for t, i, m in zip(events.t, events.block, events.mode, strict=True)]
        paths.append(Path2(case, times.tolist(), z.T.tolist(), w.T.tolist(), listed))
    return Parallelogram(sign, corners, paths)
