"""Attractors along a key: each run starts from the attractor of the one before."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from stickslip.sim.attractors.multipliers import slip_rates
from stickslip.sim.attractors.result import Attractor
from stickslip.sim.attractors.settling import attractor, frequencies_of, persisting
from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.drive import Harmonic
from stickslip.sim.systems.sliding import RATE_ROUNDING, critical_mode
from stickslip.sim.systems.system import System

#: Kinds of attractors on which blocks may stick and slip.
_MOTIONS = ("periodic", "torus", "irregular")
#: Kinds that a longer run would not change.
_PROVED = ("rest", "sliding", "periodic", "escaping")
#: Of the way that is left, the first step of a cycle that is followed.
_FIRST_STEP = 0.25


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
    return [motion.attractor for motion in settled]


class Settled(NamedTuple):
    """A system, a run of it, and what that settles on."""

    system: System
    run: Run
    attractor: Attractor

    def followed(self, system: System, t_end: float, t_burn: float, settings: dict[str, Any]) -> Settled:
        """Another system from the attractor of this one."""
        start, z, w = self._onto(system)
        run = simulate(system, z, w, start + t_end, t_start=start, **settings)
        return Settled(system, run, attractor(run, system, min(start + t_burn, run.t_end), **settings))

    def persisting(self, system: System, settings: dict[str, Any]) -> Settled | None:
        """Another system on the same cycle, by Newton's method; None if it is not found, or does not attract."""
        cycle = self.attractor
        if cycle.kind != "periodic" or not cycle.n_exits or cycle.period is None or system.changes:
            return None
        start, z, w = self._onto(system)
        run = simulate(system, z, w, start + cycle.period, t_start=start, **settings)
        there = None if run.outcome == "diverged" else persisting(cycle, run, system, **settings)
        return None if there is None else Settled(system, run, there)

    def _onto(self, system: System) -> tuple[float, Floats, Floats]:
        """When and where another system starts from the attractor of this one."""
        z, w, sticks = _at_end(self.run) if frequencies_of(system) else _on(self.attractor, self.run)
        start = _time_of_phase(system, self.system, self.run.t_end)
        v = system.belt_speed_at(start)
        return start, z, np.where(sticks | (system.closed * (w - v) > 0.0), v, w)

    @property
    def sticks_and_slips(self) -> bool:
        """Whether slip onsets go on: near its end a cycle attracts so slowly that it may be undecided."""
        if self.attractor.kind == "undecided":
            events, half = self.run.events, 0.5 * (self.run.events.t_start + self.run.t_end)
            return bool((events.is_exit & (events.t > half)).any())
        return self.attractor.kind in _MOTIONS and bool(self.attractor.n_exits != 0)


class Cause(StrEnum):
    """How the end of a motion along a key is known."""

    MULTIPLIER = "multiplier"  #: that of the cycle comes to 1 there
    GRAZING = "grazing"  #: a block of the cycle only touches its belt's speed there, and does not stick
    CYCLE = "cycle"  #: it attracts at one end of the interval, and a run from it settles elsewhere at the other
    RUNS = "runs"  #: runs from it stick and slip to their ends, up to one end of the interval


class End(NamedTuple):
    """Between which shares of the way from one system to another a motion ends, and how that is known."""

    low: float
    high: float
    cause: Cause


@numpy_arithmetic()
def end_of_motion(
    system_at: Callable[[float], System],
    run: Run,
    attractor: Attractor,
    t_end: float,
    t_burn: float,
    width: float,
    **settings: Any,
) -> End | None:
    """Where between two systems the stick-slip of a run ends; None if it does not.

    A cycle is followed by Newton's method for as long as its multiplier is below 1. From there on, and of other
    motions, runs are followed as by `continued`, from the last motion and from the first. An end is one of runs, and
    depends on `t_end`, only if what is followed last is no cycle, or what comes then is not proved.

    Parameters
    ----------
    system_at : callable
        The systems from that of the run, at 0, to the other, at 1.
    run, attractor : Run, Attractor
        The run, and what it settles on; of what is no stick-slip, and of a run that diverged, the end is None.
    t_end, t_burn, **settings
        Of each run, as of `continued`.
    width : float
        Of the interval in which it ends. It stays wider if near the end runs do not settle.
    """
    first = Settled(system_at(0.0), run, attractor)
    trace = Trace(system_at, width, settings, first)
    if not first.sticks_and_slips:
        return None

    high = 1.0
    while True:
        # the whole step first, and what lay beyond an end again from there: a long step may leave what still attracts
        following = trace.at(high, first, t_end, t_burn)
        if following.sticks_and_slips:
            if high == 1.0:
                return None
            trace.reach(high, following)
            high = 1.0
            continue
        trace.advance()
        if trace.low >= 1.0:
            return None
        if trace.low >= high:
            high = 1.0
            continue
        if high - trace.low <= width:
            return trace.end(high, following)
        while high - trace.low > width:
            middle = 0.5 * (trace.low + high)
            following = trace.at(middle, first, t_end, t_burn)
            if following.sticks_and_slips:
                trace.reach(middle, following)
                trace.advance()
                high = high if trace.low < high else 1.0
            else:
                high = middle


@dataclass
class Trace:
    """A motion that is followed from one system, at 0, towards another, at 1."""

    system_at: Callable[[float], System]
    width: float
    settings: dict[str, Any]
    last: Settled  #: what was followed last
    low: float = 0.0  #: and where
    #: The cycles among what was followed, each of which attracts, with their places.
    cycles: list[tuple[float, Settled]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reach(0.0, self.last)

    def reach(self, place: float, settled: Settled) -> None:
        """Go on from what is followed at a place."""
        self.low, self.last = place, settled
        if settled.attractor.kind == "periodic":
            self.cycles.append((place, settled))

    def at(self, place: float, first: Settled, t_end: float, t_burn: float) -> Settled:
        """What follows there on what was followed last, or else on the first: another motion may last for longer."""
        system = self.system_at(place)
        following = self.last.followed(system, t_end, t_burn, self.settings)
        if following.sticks_and_slips or self.last is first:
            return following
        attempt = first.followed(system, t_end, t_burn, self.settings)
        return attempt if attempt.sticks_and_slips else following

    def advance(self) -> None:
        """Follow a cycle by Newton's method, in steps that shrink where it fails, to an eighth of the width."""
        step = _FIRST_STEP * (1.0 - self.low)
        while self.low < 1.0 and step >= self.width / 8.0:
            place = min(self.low + step, 1.0)
            there = self.last.persisting(self.system_at(place), self.settings)
            if there is None:
                step *= 0.5
            else:
                self.reach(place, there)

    def end(self, high: float, following: Settled) -> End:
        """Between the place reached and one beyond it where something else follows."""
        is_proved = following.attractor.kind in _PROVED
        if not self.cycles or self.last.attractor.kind in ("irregular", "torus"):
            return End(self.low, high, Cause.RUNS)
        known, cycle = self.cycles[-1]
        if self.low - known > self.width:  # between, runs neither settle nor are on a cycle
            return End(known, high, Cause.CYCLE) if is_proved else End(self.low, high, Cause.RUNS)
        for place, earlier in self.cycles[-2::-1]:
            if known - place > self.width or earlier.attractor.n_exits != cycle.attractor.n_exits:
                break
            # 1 - multiplier falls along a line or, at a fold, as a root: then the line comes to 0 too late
            for cause, number_of in ((Cause.MULTIPLIER, _to_one), (Cause.GRAZING, _impact)):
                root = _root(place, number_of(earlier), known, number_of(cycle))
                if root <= known + 0.5 * self.width:
                    return End(known, root + (root - known), cause)
        return End(known, high, Cause.CYCLE if is_proved else Cause.RUNS)


def _to_one(settled: Settled) -> float:
    """1 - multiplier; infinite if it has none."""
    multiplier = settled.attractor.multiplier
    return math.inf if multiplier is None else 1.0 - multiplier


def _impact(settled: Settled) -> float:
    """The least rate at which a block of a cycle comes to its belt's speed, squared: 0 where it only touches it.

    It falls along a line to where the cycle grazes; infinite of what is no cycle.
    """
    cycle, system = settled.attractor, settled.system
    if cycle.kind != "periodic":
        return math.inf
    assert cycle.events is not None
    assert cycle.states is not None
    events = cycle.events
    modes = events.modes_at(events.t)
    numbers = np.arange(len(events))
    modes[numbers, events.block] = events.previous_mode
    entries = (events.mode == 0) & system.has_friction[events.block]
    rates = slip_rates(system.of_unit_mass, cycle.states, modes)[numbers, events.block][entries]
    return float(np.min(rates**2, initial=math.inf))


def _root(x: float, y: float, x_last: float, y_last: float) -> float:
    """Where the line through two points comes to 0 beyond the last; infinite if it does not."""
    return x_last + y_last * (x_last - x) / (y - y_last) if y > y_last and math.isfinite(y) else math.inf


def end_of_stability(system_at: Callable[[float], System]) -> float | None:
    """Where between two systems the linear stability of steady sliding changes; None: nowhere.

    `system_at` is as of `end_of_motion`.
    """

    def rate(share: float) -> float:
        mode = critical_mode(system_at(share))
        return math.nan if mode is None else mode.rate - RATE_ROUNDING

    first, last = rate(0.0), rate(1.0)
    if math.isnan(first) or math.isnan(last) or (first > 0.0) == (last > 0.0):
        return None
    return float(brentq(rate, 0.0, 1.0, xtol=1e-9))


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
    events, states = attractor.events, attractor.states
    if not attractor.n_events or events is None or states is None:
        return _at_end(run)
    sticks = events.modes_at(events.t) == 0
    k = int(sticks.sum(axis=1).argmax())
    return states.z[k], states.w[k], sticks[k]
