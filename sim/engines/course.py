"""The course of a run through its engine's kernel, in slices between which Python can handle signals.

A kernel advances a run by a slice and returns ``(status, n_recorded)``. The run's state is kept in the arrays that it
is given, so the next call goes on where the last one stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from threading import get_ident
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import certificates
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import BELT, GAIN, Drive, Forcing, Pieces
from stickslip.sim.engines.precheck import Precheck, too_far
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import copy, largest
from stickslip.sim.runs.run import IntegrationError, Outcome, Run, StalledError, Stats, Stills
from stickslip.sim.runs.series import EventSeries, without_returns

Kind = TypeVar("Kind", bound=tuple[Any, ...])
#: What each run has for itself: in a kernel a number, in a stack an array with a place for each run.
Number = TypeVar("Number", float, Floats)

#: Why a kernel returned.
DONE, BUFFER_FULL, PAUSED, ALL_SLIP, DIVERGED, STALLED = range(6)
#: Steps a slice: some hundredths of a second at n = 200.
STEPS_A_SLICE = 5_000

#: Counters that every engine keeps, int64.
N_STEPS, N_REJECTED, N_PRODUCTS, LAST_BLOCK, N_STALLED, N_SAMPLED, IS_ALL_STUCK, N_ALL_STUCK = range(8)
#: The products up to the last event.
N_PRODUCTS_THEN, N_COUNTERS = 8, 9
#: Clocks that every engine keeps, float64, from the start of the present piece: the time, and the times after which a
#: collapse may next be certified, with all blocks slipping left and (the next clock) right. An engine may keep more
#: behind them. After, not at: a run takes a step between two requests, or would make them for ever. Then the time of
#: the last event, what the time lacks by rounding, and, of the exact law, an estimate of the error of w.
TIME, CHECK, _CHECK_RIGHT, _LAST_EVENT, LACKING, ERROR, N_CLOCKS = range(7)

#: Steps times blocks after which a run is given up if, at their pace, the rest took more than the most: some seconds,
#: which what a start leaves in most systems takes to die out, and some weeks. Steps of fewer blocks cost as much.
_TRIED, _FEW, _MOST = 1e7, 20, 1e12
#: All blocks are to slip, before a collapse is certified, as long as takes this share of what that costs.
_SEEN = 0.1


class Events(NamedTuple):
    """Buffers for events, those of one block in order, and for the `Stills` of the run, t and total."""

    t: Floats  #: from the start of the piece
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    touch: Floats  #: how long one that ends then takes at most: see `touch`; only where `Plan.tells_touches`
    all_stuck: Floats

    @classmethod
    def blank(cls, capacity: int, several: int = 1) -> Events:
        """Buffers for so many events; each of them, and each start, can begin or end an all-stuck interval."""
        t, touch = np.empty((2, capacity))
        block, mode = np.empty(capacity, np.int32), np.empty(capacity, np.int8)
        return cls(t, block, mode, touch, np.empty((2, capacity + several)))

    def part(self, first: int, last: int) -> Events:
        """The buffers of some of the events, and those of all all-stuck intervals."""
        t, block, mode, touch, all_stuck = self
        return Events(t[first:last], block[first:last], mode[first:last], touch[first:last], all_stuck)

    def first(self, n: int, n_all_stuck: int) -> Events:
        """The first events, with the all-stuck intervals in an array of their own."""
        t, block, mode, touch, all_stuck = self
        return Events(t[:n], block[:n], mode[:n], touch[:n], all_stuck[:, :n_all_stuck].copy())

    @classmethod
    def joined(cls, parts: list[Events]) -> Events:
        """The events of all parts."""
        return parts[0] if len(parts) == 1 else cls(*(np.concatenate(part, -1) for part in zip(*parts, strict=True)))


_NOTHING = Events.blank(0)


@lru_cache(maxsize=8)
def _buffers(capacity: int, thread: int) -> Events:
    """Those that runs of a thread share: for a small system they take longer to make than a run."""
    return Events.blank(capacity)


class Buffers(NamedTuple):
    """The times of samples, shape (m,), and buffers for them, shape (m, n)."""

    t: Floats  #: from the start of the piece; beyond its end from that of an earlier one
    z: Floats
    w: Floats


class State(NamedTuple):
    """The state of a run, in arrays that kernels change in place."""

    z: Floats
    w: Floats
    mode: NDArray[np.int8]
    clock: Floats
    counters: NDArray[np.int64]
    samples: Buffers

    @classmethod
    def at_start(cls, tasks: Sequence[Task], mode: NDArray[np.int8], clocks: Sequence[Sequence[float]]) -> State:
        """The states at the start of some tasks, as a stack of their own; `clocks` are those of the engine, by task.

        Of several tasks none has samples.
        """
        may_collapse = [task.stop_early and task.system.has_one_belt and not task.system.changes for task in tasks]
        checks = [-math.inf if may else math.inf for may in may_collapse]
        clock = np.array(
            [[0.0, check, check, 0.0, 0.0, 0.0, *of_engine] for check, of_engine in zip(checks, clocks, strict=True)]
        )
        z, w = np.array([[task.z0 for task in tasks], [task.w0 for task in tasks]])
        (m, n), first = mode.shape, tasks[0].samples
        if len(first):
            s = first.t - tasks[0].t_start
            samples = Buffers(s[np.newaxis], first.z[np.newaxis], first.w[np.newaxis])
        else:
            samples = Buffers(np.empty((m, 0)), *np.empty((2, m, 0, n)))
        return cls(z, w, mode, clock, np.zeros((m, N_COUNTERS), np.int64), samples)


def stack(parts: Sequence[Any]) -> Any:
    """Arrays, or tuples of them, of some runs as those of a stack; of one run without a copy.

    What is no array is the same for all.
    """
    first = parts[0]
    if len(parts) == 1:
        return of_run(first, np.newaxis)
    if isinstance(first, np.ndarray):
        return np.array(parts)
    if isinstance(first, tuple):
        return type(first)(*map(stack, zip(*parts, strict=True)))
    return first


def forcing_of(drives: Sequence[Drive]) -> Forcing:
    """The forces of some runs as those of a stack."""
    return stack([drives[0].forcing]) if drives[0].is_forced else Forcing.none(len(drives))


_BY_RUN: dict[type, tuple[str, ...]] = {}


def by_run(*fields: str) -> Callable[[type[Kind]], type[Kind]]:
    """Mark a class of tuples: of a stack, only these fields have a place for each run; the others are shared."""

    def mark(kind: type[Kind]) -> type[Kind]:
        _BY_RUN[kind] = fields
        return kind

    return mark


def is_by_run(kind: Any, field: str) -> bool:
    """Whether a field of such a class has a place for each run."""
    return field in _BY_RUN.get(kind, kind._fields)


def of_run(part: Any, k: int | None) -> Any:
    """Run k of a stack, or a run as the only one of a stack; arrays are views."""
    if isinstance(part, np.ndarray):
        return part[k]
    if not isinstance(part, tuple):
        return part
    kind: Any = type(part)
    own = _BY_RUN.get(kind)
    return kind(
        *[
            # a small run takes less time than a call for each array
            field
            if own is not None and name not in own
            else field[k]
            if isinstance(field, np.ndarray)
            else of_run(field, k)
            for name, field in zip(kind._fields, part, strict=True)
        ]
    )


@inner
def n_tried(counters: Ints) -> int:
    """How many steps there were, those that failed among them."""
    return counters[N_STEPS] + counters[N_REJECTED]


@inner
def later(t: float, lacking: float, step: float, t_end: float) -> tuple[float, float]:
    """The time a step after t, and what it lacks by rounding, as t lacks `lacking`; t_end, exactly, if it takes all.

    Without that the time of a long run would be off by as many roundings, of one sign, as there are steps.
    """
    length = step + lacking
    end = t + length
    if step >= t_end - t or end >= t_end:
        return t_end, 0.0
    moved = end - t
    return end, (t - (end - moved)) + (length - moved)


@inner
def touch(before: int, mode: int, slope: float, braked: float, pull: float, error: float) -> float:
    """How long two opposite changes of mode take at most that are one instant but for an error of w.

    At the second of them: from which mode to which, F', w' just before, and the row sum of |K|.

    A block that touches the belt, w - v = a s^2 / 2 with a = |F'|, sticks for a time T if it would go on to
    a T^2 / 2 beyond it. Without friction it crosses it twice, by a T^2 / 8, and w' is then a T / 2. One whose F
    touches m, by -b s^2 / 2, slips from s = -T / 3 on if F goes beyond m by b (T / 3)^2 / 2: it comes back at
    2 T / 3, where w' is three times as much, and F' 4 w' / T, after 4 w' T / 27 at most. An error e of w is one of
    pull^(1/2) e of F, as it turns.
    """
    slope, braked = abs(slope), abs(braked)
    if slope == 0.0:
        return 0.0
    if mode == 0:
        most = 3.0 * math.sqrt(pull) * error
        return min(4.0 * most / slope, 27.0 / 4.0 * error / braked) if 0.0 < braked <= most else 0.0
    stick = math.sqrt(2.0 * error / slope)
    if before == 0:
        return stick
    return 2.0 * stick if braked <= slope * stick else 0.0


@inner
def note_event(clock: Floats, counters: Ints) -> None:
    """Note that a block's mode has changed just now."""
    clock[_LAST_EVENT], counters[N_PRODUCTS_THEN] = clock[TIME], counters[N_PRODUCTS]


@inner
def is_check_due(state: State, mode: NDArray[np.int8], precheck: Precheck, left: float) -> bool:
    """Whether the pre-check of collapse is due, if all blocks slip in the direction of the first.

    Only where a certificate pays, counted in products, so that no clock decides: there was no event for a share of
    what it costs, and at that rate the rest of the run, `left`, would cost as much as all of it.
    """
    clock, counters = state.clock, state.counters
    if mode[0] == 0 or clock[TIME] <= clock[CHECK + (mode[0] > 0)]:
        return False
    spent, seen = counters[N_PRODUCTS] - counters[N_PRODUCTS_THEN], clock[TIME] - clock[_LAST_EVENT]
    return spent >= _SEEN * precheck.cost and spent * left >= precheck.cost * seen


@inner
def may_collapse(state: State, slip: int, precheck: Precheck) -> bool:
    """Whether Python is to certify a collapse; if not, the time of the next pre-check is noted."""
    later = too_far(precheck, state.z, state.w) if state.mode[0] == slip else np.inf
    if later != 0.0:
        state.clock[CHECK + (state.mode[0] > 0)] = state.clock[TIME] + later
    return later == 0.0


@inner
def enter(forcing: Forcing, state: State, length: float) -> float:
    """Go on to the next piece from the end of one of that length, with the state in its frame; returns its length."""
    z, w, clock, counters, table = state.z, state.w, state.clock, state.counters, forcing.table
    pieces, k = forcing.pieces, counters[N_SAMPLED]
    here = len(pieces.tables) - pieces.n_ahead[0]
    for i in range(len(z)):
        z[i] += 0.5 * length * (length * table[GAIN, i])
        w[i] -= table[BELT, i]
    for row in range(len(table)):
        copy(pieces.tables[here, row], table[row])
    for i in range(len(z)):
        w[i] += table[BELT, i]
    pieces.n_ahead[0] -= 1
    while k < len(pieces.samples) and pieces.samples[k] <= pieces.bounds[1, here]:
        state.samples.t[k] = pieces.samples[k] - pieces.bounds[0, here]
        k += 1
    clock[TIME] = clock[LACKING] = 0.0
    counters[N_STALLED] = 0
    return pieces.bounds[2, here]


@inner
def count(pieces: Pieces, n_events: int, n_stuck: int) -> None:
    """Add to the events, and the ends of all-stuck intervals, of the present piece, unless it is all of the run."""
    here = len(pieces.tables) - 1 - pieces.n_ahead[0]
    if here >= 0:
        pieces.counts[here, 0] += n_events
        pieces.counts[here, 1] += n_stuck


@inner
def is_within(state: State, bound: float) -> bool:
    """Whether |z_i| and |w_i| are at most the bound; a maximum of floats may lose a NaN, so it is asked this way."""
    return largest(state.z) <= bound and largest(state.w) <= bound


@inner
def note_all_stuck_at(is_all_stuck: bool, t: float, z: Floats, events: Events, counters: Ints) -> None:
    """Record where the blocks are if all of them stick now and did not before, or the other way round."""
    if (1 if is_all_stuck else 0) != counters[IS_ALL_STUCK]:
        counters[IS_ALL_STUCK] = 1 if is_all_stuck else 0
        total = 0.0
        for i in range(len(z)):
            total += z[i]
        all_stuck = events.all_stuck
        all_stuck[0, counters[N_ALL_STUCK]], all_stuck[1, counters[N_ALL_STUCK]] = t, total
        counters[N_ALL_STUCK] += 1


class Plan(NamedTuple):
    """What `complete` needs of an engine."""

    advance: Callable[[Events, float], tuple[int, int]]
    """Runs a slice until the state passes a bound, and writes events into the buffers that it is given."""
    stalled: str  #: what to say, after the time and the block, when the engine cannot go on
    events_a_step: int  #: the most events that a step can record
    initial_modes: NDArray[np.int8]
    """Shape (1 + m, n): the first row by the engine's own definition of sticking, the others by each of `thresholds`.
    Events by definition d carry block + d n."""
    thresholds: tuple[float, ...] = ()
    tells_touches: bool = False  #: by `Events.touch`; see `without_returns`
    method: str = ""  #: where an engine has several
    settles: Callable[[], certificates.Flow | None] = lambda: None
    """The motion to the end, if all blocks are certain to come to rest without another event; asked after slices."""


class FirstSlice(NamedTuple):
    """Why the first slice of a run ended, and its events."""

    status: int
    events: Events  #: at times from the start, or, of what is whole, at the user's
    is_whole: bool  #: whether it was the last slice, and its events are those of the run


def stats_of(counters: NDArray[np.int64], n_events: int, method: str) -> Stats:
    """What a run cost."""
    counts = counters.tolist()
    return Stats(counts[N_STEPS], counts[N_REJECTED], counts[N_PRODUCTS], n_events, method)


def capacity(events_a_step: int) -> int:
    """Of the buffers for a slice of one run."""
    return max(2 * events_a_step, 4096)


class _Recorded:
    """The events of a run so far."""

    def __init__(self, plan: Plan, state: State, first_slice: FirstSlice | None) -> None:
        self._plan, self._counters = plan, state.counters
        self._capacity = capacity(plan.events_a_step)
        self._full = [] if first_slice is None else [first_slice.events]
        self._events: Events | None = None

    def _begin(self) -> Events:
        self._full = self._all()
        # no run outlives another of its thread, and what is returned of the first buffers is copied
        blank = Events.blank(2 * self._capacity) if self._full else _buffers(2 * self._capacity, get_ident())
        self._events, self._n = blank, 0
        self._counters[N_ALL_STUCK] = 0
        return self._events

    def slice(self, bound: float) -> int:
        """Run a slice, and take over its events; returns why it ended."""
        events = self._events
        if events is None or self._n > self._capacity:
            events = self._begin()
        status, n_recorded = self._plan.advance(events.part(self._n, self._n + self._capacity), bound)
        self._n += n_recorded
        return status

    def _all(self) -> list[Events]:
        if self._events is None:
            return self._full
        return [*self._full, self._events.first(self._n, int(self._counters[N_ALL_STUCK]))]

    def all(self) -> Events:
        """All of them."""
        return Events.joined(self._all())


class _Divergence:
    """Whether a run diverges; asked when its state passes a bound."""

    def __init__(self, task: Task, drive: Drive) -> None:
        self._task, self._drive, self._passed = task, drive, 0.0

    @cached_property
    def _first(self) -> float:
        task = self._task
        return float(certificates.escape_bounds([task.system], task.z0[np.newaxis], task.w0[np.newaxis])[0])

    @cached_property
    def _beyond(self) -> float:
        return certificates.divergence_bound(self._task.system, self._task.z0, self._task.w0)

    @property
    def bound(self) -> float:
        """The size at which to ask next."""
        return max(self._first, 2.0 * self._passed)

    def reason(self, t: float, z: Floats, w: Floats) -> str:
        """Why the run diverges; "" if that is not certain yet: the bound is then moved out."""
        system, stop_early = self._task.system, self._task.stop_early
        z_there, w_there = self._drive.of_user(t, z, w)
        speed = float(np.abs(w_there).max())
        size = max(float(np.abs(z).max()), float(np.abs(z_there).max()), speed)
        is_past_doubt = stop_early and speed > self._beyond and not system.changes
        if not np.isfinite((size, speed)).all():
            raise IntegrationError(
                f"the state is not finite after t = {t!r}: numbers of this size leave float64; scale the system"
            )
        if stop_early and (why := certificates.escape(system, z_there, w_there)):
            return why
        if size > certificates.BEYOND_NUMBERS or (is_past_doubt and certificates.grows(system)):
            passed = certificates.BEYOND_NUMBERS if size > certificates.BEYOND_NUMBERS else self._beyond
            return certificates.divergence_reason(z_there, w_there, t, min(size, passed))
        self._passed = size
        return ""


def complete(
    task: Task,
    state: State,
    drive: Drive,
    collapse: certificates.Collapse,
    plan: Plan,
    first_slice: FirstSlice | None = None,
) -> Run:
    """Run slices of an engine until the run ends, gather its events, and say how it ended.

    Parameters
    ----------
    task : Task
    state : State
        What the engine works on.
    drive : Drive
        Whose present piece the engine runs to its end.
    collapse : Collapse
        Asked for a certificate when the clocks say that it is due.
    plan : Plan
    first_slice : FirstSlice, optional
        What came of the first slice, if it was run with others.
    """
    z, w, mode, clock, counters, _ = state
    recorded, divergence = _Recorded(plan, state, first_slice), _Divergence(task, drive)
    outcome: Outcome = "finished"
    reason, t_collapse, n_placed = "", None, 0
    while True:
        status = recorded.slice(divergence.bound) if first_slice is None else first_slice.status
        first_slice, flow = None, None
        s = float(clock[TIME])
        t = drive.time(s)
        if status == DONE:
            if drive.is_last:
                break
            n_placed = _to_user(drive, task, state, n_placed)
            drive.go_on()
        if status == ALL_SLIP:
            certificate = collapse.certify(z, w)
            if certificate.is_certain and t_collapse is None:
                outcome, reason, t_collapse = "collapsed", certificate.reason, t
            flow = certificate.flow
            clock[CHECK + int(mode[0] > 0)] = s + certificate.ask_again_after
        elif status == PAUSED and task.stop_early and drive.is_steady:
            flow = plan.settles()
        elif status == DIVERGED:
            if why := divergence.reason(t, z, w):
                outcome, reason = "diverged", why
                break
        elif status == STALLED:
            raise StalledError(f"no progress at t = {t!r}, at block {counters[LAST_BLOCK]}: {plan.stalled}")
        if flow is not None:
            _follow(flow, drive.length - s, s, state)
            t = task.t_end
            break
        if status in (PAUSED, BUFFER_FULL):
            _require_an_end(task, counters, t)
    _to_user(drive, task, state, n_placed)
    return _run(task, state, drive, plan, recorded.all(), outcome, reason, t, t_collapse)


def _run(
    task: Task, state: State, drive: Drive, plan: Plan, events: Events, outcome: Outcome, reason: str, t: float,
    t_collapse: float | None,
) -> Run:  # fmt: skip
    """The run whose state is that at its end."""
    z, w = drive.of_user(t, state.z, state.w)
    series = _series(events, *drive.of_all(events.t, events.all_stuck), task, plan, t)
    return Run(
        z=z,
        w=w,
        t_end=t,
        events=series[0],
        outcome=outcome,
        reason=reason,
        stats=stats_of(state.counters, len(series[0]), plan.method),
        t_collapse=t_collapse,
        samples=task.samples.first(int(state.counters[N_SAMPLED])),
        stills=Stills(*events.all_stuck),
        by_threshold=dict(zip(plan.thresholds, series[1:], strict=True)),
    )


def _require_an_end(task: Task, counters: NDArray[np.int64], t: float) -> None:
    """IntegrationError if the rest of a run, at its pace so far, takes more steps than are worth while."""
    n, steps = task.system.n, float(counters[N_STEPS])
    left = steps * ((task.t_end - t) / max(t - task.t_start, 1e-300))
    if steps * max(n, _FEW) > _TRIED and left * n > _MOST:
        raise IntegrationError(
            f"t_end: {counters[N_STEPS]} steps led to t = {t:g}, and nothing ends the motion; at this pace t ="
            f" {task.t_end:g} takes {left:.0e} more: shorten the run"
        )


def _series(
    events: Events, piece: NDArray[np.intp], t: Floats, task: Task, plan: Plan, t_end: float
) -> list[EventSeries]:
    """The series by each definition of sticking, the first without touches that its error cannot tell."""
    n = task.system.n
    if not len(t):
        return [EventSeries(*_NOTHING[:3], modes, task.t_start, t_end) for modes in plan.initial_modes]
    order = np.lexsort((events.block, t))  # stable: instants that round to one time keep each block's order
    t, s, block, mode = t[order], events.t[order], events.block[order], events.mode[order]
    series = []
    for d, modes in enumerate(plan.initial_modes):
        of_definition = block // n == d if plan.thresholds else slice(None)
        series.append(
            EventSeries(
                t[of_definition], block[of_definition] - d * n, mode[of_definition], modes, task.t_start, t_end
            )
        )
    touch = events.touch[order]
    # else no two events are that close, of whichever block
    if plan.tells_touches and (s[1:] - s[:-1] <= touch[1:]).any():
        series[0] = without_returns(series[0], piece[order], s, touch)
    return series


def _to_user(drive: Drive, task: Task, state: State, first: int) -> int:
    """Put the samples so far, from `first` on, into the user's frame; returns how many there are."""
    samples, last = task.samples, int(state.counters[N_SAMPLED])
    if last > first:
        of_piece = slice(first, last)
        samples.z[of_piece], samples.w[of_piece] = drive.of_user(
            samples.t[of_piece], samples.z[of_piece], samples.w[of_piece]
        )
    return last


def _follow(flow: certificates.Flow, remaining: float, s: float, state: State) -> None:
    """Put the state at the end, `remaining` from now, and the samples that are still due at s, into their arrays."""
    z, w, _, _, counters, samples = state
    first = int(counters[N_SAMPLED])
    at_end, sampled = (flow.at(times) for times in (np.array([remaining]), samples.t[first:] - s))
    z[:], w[:] = at_end[0][0], at_end[1][0]  # separately: a product of another shape rounds differently
    samples.z[first:], samples.w[first:] = sampled
    counters[N_SAMPLED] = len(samples.t)
