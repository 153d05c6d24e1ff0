"""Attractors along a key: each run starts from the attractor of the one before."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.attractors import Attractor, attractor
from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.runs.run import Run
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.system import System


def continued(
    systems: Iterable[System], z0: ArrayLike, w0: ArrayLike, t_end: float, t_burn: float = 0.0, **settings: Any
) -> list[Attractor]:
    """What runs of the exact engine settle on, one system after the other, each from the attractor before.

    That is, from the event of a cycle after which most blocks stick, and otherwise from the end of the run; a block
    that sticks there takes the speed of its new belt, and so does one ahead of a new belt that bars that side.

    An attractor is followed for as long as it attracts what the step to the next system leaves of it; then another
    one is found. So the same systems in the opposite order may give others: where they do, several attract.

    Parameters
    ----------
    systems : iterable of System
        Of n blocks each, such as one system with a rising belt speed. Small steps follow an attractor further.
    z0, w0 : float or array_like, shape (n,)
        Start of the first run.
    t_end, t_burn : float
        Of each run, and of `stickslip.sim.attractors.attractor`.
    **settings
        Of the engine, as `tol`.

    Returns
    -------
    list of Attractor
        In the order of the systems. After one that escapes the next starts as the first did.

    Raises
    ------
    TypeError, ValueError
        As `stickslip.simulate` and `attractor`; if a system has another number of blocks than the first.
    """
    t_end = number("t_end", t_end)
    found: list[Attractor] = []
    run: Run | None = None
    for system in systems:
        if run is not None and run.events.n != system.n:
            raise ValueError(f"systems: expected {run.events.n} blocks in each, as in the first, got {system.n}")
        z, w = z0, w0
        if run is not None and run.outcome != "diverged":
            z, w, sticks = _on(found[-1], run)
            v = system.belt_speed_at(0.0)
            w = np.where(sticks | (system.closed * (w - v) > 0.0), v, w)
        run = simulate(system, z, w, t_end, **settings)
        found.append(attractor(run, system, min(t_burn, run.t_end), **settings))
    return found


def _on(found: Attractor, run: Run) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """z and w on an attractor, and which blocks stick there."""
    if found.kind != "periodic" or found.events is None or found.states is None or len(found.events) == 0:
        return run.z, run.w, run.events.mode_at(run.t_end) == 0
    sticks = np.array([found.events.mode_at(t) == 0 for t in found.events.t])
    k = int(sticks.sum(axis=1).argmax())
    return found.states.z[k], found.states.w[k], sticks[k]
