"""Attractors along a key: each run starts from the attractor of the one before."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.attractors.result import Attractor
from stickslip.sim.attractors.settling import attractor, frequencies_of
from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.drive import Harmonic
from stickslip.sim.systems.system import System


@numpy_arithmetic()
def continued(
    systems: Iterable[System], z0: ArrayLike, w0: ArrayLike, t_end: float, t_burn: float = 0.0, **settings: Any
) -> list[Attractor]:
    """What runs of the exact engine settle on, one system after the other, each from the attractor before.

    That is, from the event of a cycle after which most blocks stick, and otherwise from the end of the run; a block
    that sticks there takes the speed of its new belt, and so does one ahead of a new belt that bars that side. Under
    a periodic force it is always the end of the run, and forces of one frequency go on from the phase at which they
    are most like those that were; where there are several frequencies, the time goes on, and ramps of belts and
    forces are over.

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
    before: System | None = None
    for system in systems:
        if run is not None and run.events.n != system.n:
            raise ValueError(f"systems: expected {run.events.n} blocks in each, as in the first, got {system.n}")
        z, w, start = z0, w0, 0.0
        if run is not None and before is not None and run.outcome != "diverged":
            z, w, sticks = _at_end(run) if frequencies_of(system) else _on(found[-1], run)
            start = _time_of_phase(system, before, run.t_end)
            v = system.belt_speed_at(start)
            w = np.where(sticks | (system.closed * (w - v) > 0.0), v, w)
        run, before = simulate(system, z, w, start + t_end, t_start=start, **settings), system
        found.append(attractor(run, system, min(start + t_burn, run.t_end), **settings))
    return found


def _time_of_phase(system: System, before: System, t: float) -> float:
    """When forces are most like those of the system before at t; 0 if there were or are none.

    Where there are several frequencies, that is t.
    """
    now, then = frequencies_of(system), frequencies_of(before)
    if not now or not then:
        return 0.0
    if len(now) > 1 or len(then) > 1:
        return t
    alike = np.vdot(_swing(system), _swing(before) * np.exp(1j * then[0] * t))
    return float(np.angle(alike) / now[0] % (2.0 * math.pi / now[0]))


def _swing(system: System) -> NDArray[np.complex128]:
    """What forces of one frequency come to on each block: f in Re(f exp(i omega t)), omega > 0, shape (n,)."""
    total = np.zeros(system.n, dtype=np.complex128)
    for one in system.force:
        if isinstance(one, Harmonic):
            phasor = one.amplitude * np.exp(1j * np.sign(one.frequency) * one.phase)
            total += np.where(one.frequency != 0.0, phasor, 0.0)
    return total


def _at_end(run: Run) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """z and w at the end of a run, and which blocks stick there."""
    return run.z, run.w, run.events.mode_at(run.t_end) == 0


def _on(found: Attractor, run: Run) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """The same on an attractor, at the event after which most blocks stick; without one at the end of the run."""
    if found.kind != "periodic" or found.events is None or found.states is None or len(found.events) == 0:
        return _at_end(run)
    sticks = found.events.modes_at(found.events.t) == 0
    k = int(sticks.sum(axis=1).argmax())
    return found.states.z[k], found.states.w[k], sticks[k]
