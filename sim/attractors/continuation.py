"""Attractors along a key: each run starts from the attractor of the one before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.attractors.result import Attractor
from stickslip.sim.attractors.settling import attractor, frequencies_of
from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.drive import Harmonic
from stickslip.sim.systems.sliding import critical_mode
from stickslip.sim.systems.system import System

#: Kinds of attractors on which blocks may stick and slip.
_MOTIONS = ("periodic", "torus", "irregular")


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
    settled: list[Settled] = []
    for system in systems:
        before = settled[-1] if settled else None
        if before is not None and before.system.n != system.n:
            raise ValueError(f"systems: expected {before.system.n} blocks in each, as in the first, got {system.n}")
        if before is None or before.run.outcome == "diverged":
            run = simulate(system, z0, w0, t_end, **settings)
            settled.append(Settled(system, run, attractor(run, system, min(t_burn, run.t_end), **settings)))
        else:
            settled.append(before.followed(system, t_end, t_burn, settings))
    return [each.attractor for each in settled]


class Settled(NamedTuple):
    """A system, a run of it, and what that settles on."""

    system: System
    run: Run
    attractor: Attractor

    def followed(self, system: System, t_end: float, t_burn: float, settings: dict[str, Any]) -> Settled:
        """Another system from the attractor of this one."""
        z, w, sticks = _at_end(self.run) if frequencies_of(system) else _on(self.attractor, self.run)
        start = _time_of_phase(system, self.system, self.run.t_end)
        v = system.belt_speed_at(start)
        w = np.where(sticks | (system.closed * (w - v) > 0.0), v, w)
        run = simulate(system, z, w, start + t_end, t_start=start, **settings)
        return Settled(system, run, attractor(run, system, min(start + t_burn, run.t_end), **settings))

    @property
    def sticks_and_slips(self) -> bool:
        """Whether slip onsets go on: near its end a cycle attracts so slowly that it may be undecided."""
        if self.attractor.kind == "undecided":
            events, half = self.run.events, 0.5 * (self.run.events.t_start + self.run.t_end)
            return bool((events.is_exit & (events.t > half)).any())
        return self.attractor.kind in _MOTIONS and bool(self.attractor.n_exits != 0)


@numpy_arithmetic()
def end_of_motion(
    system_at: Callable[[float], System],
    run: Run,
    attractor: Attractor,
    t_end: float,
    t_burn: float,
    width: float,
    **settings: Any,
) -> float | None:
    """Where between two systems the stick-slip of a run ends, followed as by `continued`; None if it does not.

    Parameters
    ----------
    system_at : callable
        The systems from that of the run, at 0, to the other, at 1.
    run, attractor : Run, Attractor
        The run, and what it settles on; of what is no stick-slip, and of a run that diverged, the end is None.
    t_end, t_burn, **settings
        Of each run, as of `continued`.
    width : float
        To which the interval in which it ends is bisected; its middle is returned.
    """
    last, low, high = Settled(system_at(0.0), run, attractor), 0.0, 1.0
    if not last.sticks_and_slips:
        return None
    while True:
        # the whole step first, and what lay beyond an end again from there: a long step may leave what still attracts
        following = last.followed(system_at(high), t_end, t_burn, settings)
        if following.sticks_and_slips:
            if high == 1.0:
                return None
            last, low, high = following, high, 1.0
            continue
        if high - low <= width:
            return 0.5 * (low + high)
        while high - low > width:
            middle = 0.5 * (low + high)
            following = last.followed(system_at(middle), t_end, t_burn, settings)
            if following.sticks_and_slips:
                last, low = following, middle
            else:
                high = middle


def end_of_stability(system_at: Callable[[float], System], width: float) -> float | None:
    """Where between two systems the linear stability of steady sliding changes, bisected to a width; None: nowhere.

    `system_at` is as of `end_of_motion`.
    """

    def is_stable(share: float) -> bool | None:
        mode = critical_mode(system_at(share))
        return None if mode is None else mode.is_stable

    first, low, high = is_stable(0.0), 0.0, 1.0
    if first is None or first == is_stable(high):
        return None
    while high - low > width:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) == first else (low, middle)
    return 0.5 * (low + high)


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
    for force in system.force:
        if isinstance(force, Harmonic):
            phasor = force.amplitude * np.exp(1j * np.sign(force.frequency) * force.phase)
            total += np.where(force.frequency != 0.0, phasor, 0.0)
    return total


def _at_end(run: Run) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """z and w at the end of a run, and which blocks stick there."""
    return run.z, run.w, run.events.mode_at(run.t_end) == 0


def _on(attractor: Attractor, run: Run) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """The same on an attractor, at the event after which most blocks stick; without one at the end of the run."""
    if (
        attractor.kind != "periodic"
        or attractor.events is None
        or attractor.states is None
        or len(attractor.events) == 0
    ):
        return _at_end(run)
    sticks = attractor.events.modes_at(attractor.events.t) == 0
    k = int(sticks.sum(axis=1).argmax())
    return attractor.states.z[k], attractor.states.w[k], sticks[k]
