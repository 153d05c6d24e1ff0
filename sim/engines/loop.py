"""What engines share around their kernels: the loop that Python keeps, in slices, so that signals get through.

A kernel advances a run by a slice and returns ``(status, n_recorded)``; the run's state lives in the arrays it was
given, so the next call goes on where the last one stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import certificates
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import Drive, Outside
from stickslip.sim.engines.watch import too_far
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.numerics.products import Pairs
from stickslip.sim.runs.run import IntegrationError, Outcome, Run, Stats, Stills
from stickslip.sim.runs.series import EventSeries, without_returns
from stickslip.sim.systems.friction import Rational, Stribeck, Weakening, registered
from stickslip.sim.systems.system import Columns, System

#: Why a kernel came back.
DONE, BUFFER_FULL, PAUSED, ALL_SLIP, DIVERGED, STALLED = range(6)
#: Steps a slice: some hundredths of a second at n = 200.
STEPS_A_SLICE = 5_000

#: Counters that every engine keeps, int64.
N_STEPS, N_REJECTED, N_PRODUCTS, LAST_BLOCK, N_STALLED, N_SAMPLED, IS_STILL, N_STILLS, N_COUNTERS = range(9)
#: Clocks that every engine keeps, float64, from the start of the present piece: the time, and after when a collapse
#: may be certified next, with all blocks slipping left and (the next clock) right. An engine may keep more behind
#: them. After, not at: a run that was just asked takes a step before it is asked again, or would be asked for ever.
TIME, CHECK, _CHECK_RIGHT, N_CLOCKS = range(4)


class Fall(NamedTuple):
    """How friction falls with the speed of slip: exp(-x) or 1 / (1 + x), x = steepness |w - v|."""

    far: Floats  #: kinetic friction of a slip without bound, over that of a block that begins to slip
    steepness: float
    is_exponential: bool


#: The laws of weakening whose series the exact engine knows.
_IS_EXPONENTIAL: dict[type[Weakening], bool] = {Rational: False, Stribeck: True}


class Law(NamedTuple):
    """What kernels know of a system. They take named tuples, which numba types by position and compiles away.

    What is None is compiled away too: a function that is given it asks first whether it is.
    """

    columns: Columns
    pairs: Pairs
    row_sums: Floats
    damping: Floats
    friction: Floats  #: kinetic, of a block that begins to slip
    static: Floats
    closed: NDArray[np.int8]  #: the side to which no block slips, 0 if there is none
    fall: Fall | None
    belt_speed: Floats
    outside: Outside | None

    @classmethod
    def of(cls, system: System, pairs: Pairs, drive: Drive) -> Law:
        near, far = system.slip_friction
        fall, weakening = None, system.weakening
        if weakening is not None:
            share = np.divide(far, near, out=np.ones(system.n), where=near > 0)
            fall = Fall(share, weakening.steepness, registered(_IS_EXPONENTIAL, weakening, "coulomb"))
        return cls(
            system.columns,
            pairs,
            system.row_sums,
            system.damping,
            near,
            system.static,
            system.closed,
            fall,
            drive.belt_speed,
            drive.outside,
        )


class Events(NamedTuple):
    """Room for events; those of one block come in order. And for its `Stills`, t and total."""

    t: Floats  #: from the start of the piece
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    stills: Floats

    @classmethod
    def blank(cls, capacity: int) -> Events:
        """Room for so many; each of them, and the start, can make a still."""
        t, stills = np.empty(capacity), np.empty((2, capacity + 1))
        return cls(t, np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int8), stills)

    def part(self, first: int, last: int) -> Events:
        """The room for some of the events, and that for all stills."""
        return Events(self.t[first:last], self.block[first:last], self.mode[first:last], self.stills)

    def first(self, n: int, n_stills: int) -> Events:
        """The first ones; the stills in an array of their own."""
        return self.part(0, n)._replace(stills=self.stills[:, :n_stills].copy())

    @classmethod
    def joined(cls, parts: list[Events]) -> Events:
        """All of some."""
        return parts[0] if len(parts) == 1 else cls(*(np.concatenate(part, -1) for part in zip(*parts, strict=True)))


class Room(NamedTuple):
    """The times of samples, shape (m,), and room for them, shape (m, n)."""

    t: Floats  #: from the start of the piece; infinite beyond its end
    z: Floats
    w: Floats


class State(NamedTuple):
    """Where a run is, all of it in arrays that kernels change in place."""

    z: Floats
    w: Floats
    mode: NDArray[np.int8]
    clock: Floats
    counters: NDArray[np.int64]
    samples: Room

    @classmethod
    def at_start(cls, task: Task, z: Floats, w: Floats, mode: NDArray[np.int8], *clocks: float) -> State:
        """The state at the start of a task, in arrays of its own; `clocks` are the engine's."""
        may_collapse = task.stop_early and task.system.has_one_belt and not task.system.changes
        check = -np.inf if may_collapse else np.inf
        clock = np.array([0.0, check, check, *clocks])
        samples = Room(np.full(len(task.samples), np.inf), task.samples.z, task.samples.w)
        return cls(z, w, mode, clock, np.zeros(N_COUNTERS, dtype=np.int64), samples)


@inner
def is_check_due(clock, mode):  # type: ignore[no-untyped-def]
    """Whether the pre-check of collapse is due, if all blocks slip as the first."""
    return mode[0] != 0 and clock[TIME] > clock[CHECK + (mode[0] > 0)]


@inner
def may_collapse(state, mode, watch):  # type: ignore[no-untyped-def]
    """Whether Python is to certify a collapse; if not, when the next pre-check is due is noted."""
    later = too_far(watch, state.z, state.w, mode[0])
    if later != 0.0:
        state.clock[CHECK + (mode[0] > 0)] = state.clock[TIME] + later
    return later == 0.0


@inner
def note_still(is_still, t, z, events, counters):  # type: ignore[no-untyped-def]
    """Keep where the blocks are if now, and not before, all of them stick, or the other way round."""
    if (1 if is_still else 0) != counters[IS_STILL]:
        counters[IS_STILL] = 1 if is_still else 0
        total = 0.0
        for i in range(len(z)):
            total += z[i]
        _, _, _, stills = events
        stills[0, counters[N_STILLS]], stills[1, counters[N_STILLS]] = t, total
        counters[N_STILLS] += 1


def complete(
    task: Task,
    state: State,
    drive: Drive,
    advance: Callable[[Events, float], tuple[int, int]],
    collapse: certificates.Collapse,
    stalled: str,
    events_a_step: int,
    initial_modes: NDArray[np.int8],
    thresholds: tuple[float, ...] = (),
    shortest: Floats | None = None,
    touch: float = 0.0,
    go_on: Callable[[], None] = lambda: None,
) -> Run:
    """Call `advance` until the run ends, gather its events, and say how it ended.

    Parameters
    ----------
    task : Task
    state : State
        What `advance` works on.
    drive : Drive
        To the end of whose piece it goes on.
    advance : callable
        Runs a slice, writing events into the room that it is given, until the state passes a bound.
    collapse : Collapse
        Asked for a certificate when the clocks say so.
    stalled : str
        What to say, after the time and the block, when the engine cannot go on.
    events_a_step : int
        The most events that a step can record.
    initial_modes : int8, shape (1 + m, n)
        The first row by the engine's own definition of sticking, the others by each of `thresholds`. Events by
        definition d carry block + d n.
    shortest : ndarray, shape (n,), optional
        How long a change of each block's mode must last to be an event, where nothing drives the blocks but belts of
        constant speeds: see `without_returns`.
    touch : float
        The same, in units of the time that a block takes to turn round.
    go_on : callable
        Prepares the engine for the next piece, `state` and `drive` being there already.
    """
    system, (z, w, mode, clock, counters, _) = task.system, state
    capacity = max(2 * events_a_step, 4096)  # of a slice
    events, n_events, n_stills = Events.blank(2 * capacity), 0, 0
    full: list[Events] = []
    bound, diverged_beyond = certificates.escape_bounds(system, z, w)
    outcome: Outcome = "finished"
    reason, t_collapse, n_placed = "", None, 0
    of_piece = [0]  # events
    _hand_over(drive, task, state)
    while True:
        if n_events > capacity:
            full.append(events.first(n_events, n_stills))
            events, n_events, n_stills = Events.blank(2 * capacity), 0, 0
            counters[N_STILLS] = 0
        status, n_recorded = advance(events.part(n_events, n_events + capacity), bound)
        n_events += n_recorded
        of_piece[-1] += n_recorded
        drive.place_stills(events.stills[:, n_stills : counters[N_STILLS]])
        n_stills = int(counters[N_STILLS])
        s = float(clock[TIME])
        t = drive.time(s)
        if status == DONE:
            if drive.is_last:
                break
            n_placed = _to_user(drive, task, state, n_placed)
            drive.go_on(z, w)
            clock[TIME] = 0.0
            of_piece.append(0)
            _hand_over(drive, task, state)
            go_on()
            counters[N_STALLED] = 0
        if status == ALL_SLIP:
            certificate = collapse.certify(z, w)
            if certificate.is_certain and t_collapse is None:
                outcome, reason, t_collapse = "collapsed", certificate.reason, t
            if certificate.flow is not None:
                _follow(certificate.flow, drive.length - s, s, state)
                t = task.t_end
                break
            clock[CHECK + int(mode[0] > 0)] = s + certificate.ask_again_after
        elif status == DIVERGED:
            z_there, w_there = drive.of_user(t, z, w)
            speed = float(np.abs(w_there).max())
            size = max(float(np.abs(z).max()), float(np.abs(z_there).max()), speed)
            is_past_doubt = task.stop_early and speed > diverged_beyond and not system.changes
            if not np.isfinite((size, speed)).all():
                raise IntegrationError(
                    f"the state is not finite after t = {t!r}: numbers of this size leave float64; scale the system"
                )
            if task.stop_early and (reason := certificates.escape(system, z_there, w_there)):
                outcome = "diverged"
                break
            elif size > certificates.BEYOND_NUMBERS or (is_past_doubt and certificates.grows(system)):
                outcome = "diverged"
                passed = certificates.BEYOND_NUMBERS if size > certificates.BEYOND_NUMBERS else diverged_beyond
                reason = certificates.divergence_reason(z_there, w_there, t, min(size, passed))
                break
            else:
                bound = 2.0 * size
        elif status == STALLED:
            raise IntegrationError(f"no progress at t = {t!r}, at block {counters[LAST_BLOCK]}: {stalled}")
    z, w = drive.of_user(t, z, w)
    _to_user(drive, task, state, n_placed)
    event_s, event_block, event_mode, stills = Events.joined([*full, events.first(n_events, n_stills)])
    event_t = drive.times(of_piece, event_s)
    order = np.lexsort((event_block, event_t))  # stable: instants that round to one time keep each block's order
    event_t, event_block, event_mode = event_t[order], event_block[order], event_mode[order]
    series = []
    for d, modes in enumerate(initial_modes):
        of = event_block // system.n == d if thresholds else slice(None)
        series.append(
            EventSeries(event_t[of], event_block[of] - d * system.n, event_mode[of], modes, task.t_start, t)
        )
    event_s = event_s[order]
    # else no two are that close, whose ever they are
    if shortest is not None and (event_s[1:] - event_s[:-1] <= shortest.max()).any():
        lasting, turns = shortest[event_block], drive.turns(of_piece)[order]
        if turns.any():  # in less time than the block's own motion takes
            lasting /= np.hypot(1.0, turns * lasting / touch)
        piece = np.arange(len(of_piece)).repeat(of_piece)[order]
        series[0] = without_returns(series[0], piece, event_s, lasting)
    counts = counters.tolist()
    return Run(
        z=z,
        w=w,
        t_end=t,
        events=series[0],
        outcome=outcome,
        reason=reason,
        stats=Stats(counts[N_STEPS], counts[N_REJECTED], counts[N_PRODUCTS], len(series[0])),
        t_collapse=t_collapse,
        samples=task.samples.first(counts[N_SAMPLED]),
        stills=Stills(*stills),
        by_threshold=dict(zip(thresholds, series[1:], strict=True)),
    )


def _hand_over(drive: Drive, task: Task, state: State) -> None:
    """The times of the samples of the present piece, as its clock has them."""
    times, first = task.samples.t, int(state.counters[N_SAMPLED])
    if first == len(times):
        return
    last = len(times) if drive.is_last else int(np.searchsorted(times, drive.end, side="right"))
    state.samples.t[first:last] = times[first:last] - drive.start


def _to_user(drive: Drive, task: Task, state: State, first: int) -> int:
    """Put the samples of the present piece, from this one on, into the user's frame; returns how many there are."""
    samples, last = task.samples, int(state.counters[N_SAMPLED])
    if last > first:
        of_piece = slice(first, last)
        samples.z[of_piece], samples.w[of_piece] = drive.of_user(
            samples.t[of_piece], samples.z[of_piece], samples.w[of_piece]
        )
    return last


def _follow(flow: certificates.Flow, rest: float, s: float, state: State) -> None:
    """Put the state at the end, a time from now, and the samples that are still wanted at s, in their places."""
    z, w, _, _, counters, samples = state
    first = int(counters[N_SAMPLED])
    at_end, sampled = (flow.at(times) for times in (np.array([rest]), samples.t[first:] - s))
    z[:], w[:] = at_end[0][0], at_end[1][0]  # apart: a product of other shape rounds otherwise
    samples.z[first:], samples.w[first:] = sampled
    counters[N_SAMPLED] = len(samples.t)
