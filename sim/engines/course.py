"""What the kernels of all engines keep of a run, in arrays that they change in place, and record of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.forcing import BELT, GAIN, Forcing, Pieces
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.numerics.arithmetic import copy

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

#: All blocks are to slip, before a collapse is certified, as long as takes this share of what that costs.
_SEEN = 0.1


class Events(NamedTuple):
    """Buffers for events, those of one block in order, and for the `Stills` of the run, t and total."""

    t: Floats  #: from the start of the piece
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    touch: Floats  #: how long one that ends then takes at most: see `touch`; only where `Several.tells_touches`
    all_stuck: Floats

    @classmethod
    def blank(cls, capacity: int, several: int = 1) -> Events:
        """Buffers for so many events; each of them, and each start, can begin or end an all-stuck interval."""
        t, touch = np.empty((2, capacity))
        block, mode = np.empty(capacity, np.int32), np.empty(capacity, np.int8)
        return cls(t, block, mode, touch, np.empty((2, capacity + several)))

    def first(self, n: int, n_all_stuck: int) -> Events:
        """A copy of the first events, and all-stuck intervals."""
        t, block, mode, touch, all_stuck = self
        return Events(
            t[:n].copy(), block[:n].copy(), mode[:n].copy(), touch[:n].copy(), all_stuck[:, :n_all_stuck].copy()
        )

    @classmethod
    def joined(cls, parts: list[Events]) -> Events:
        """The events of all parts."""
        return parts[0] if len(parts) == 1 else cls(*(np.concatenate(part, -1) for part in zip(*parts, strict=True)))


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


@by_run()
class Precheck(NamedTuple):
    """By which kernels see for themselves that a state is too far out for a collapse to be certified.

    The eigenmodes of the all-slip system, as `Collapse` has them, and the bound that |w_i| must stay below.
    """

    inverse: Floats  #: T^-1, its real and imaginary parts: complex numbers take a second to compile
    sizes: Floats  #: |T_{w_i, j}|, shape (n, 2n)
    rest: Floats
    slip: int  #: the direction in which blocks may slip for ever; 0: in none
    limit: float  #: that bound; 0: not known yet
    growth: float
    cost: float  #: of a certificate, in products; 0: it is asked for whenever it may be had
    room: Floats  #: shape (2n,)

    @classmethod
    def blank(cls, slip: int, cost: float) -> Precheck:
        """Before more than the direction is known, and what a certificate costs."""
        return cls(_NO_INVERSE, _NO_SIZES, _NO_ROW, slip, 0.0, 0.0, cost, _NO_ROW)


_NO_INVERSE, _NO_SIZES, _NO_ROW = np.empty((2, 0, 0)), np.empty((0, 0)), np.empty(0)


@inner
def too_far(precheck: Precheck, z: Floats, w: Floats) -> float:
    """The time after which to ask again if no collapse can be certified of this state, else 0; see `Collapse`."""
    if precheck.limit == 0.0:
        return 0.0
    inverse, rest, sizes, n = precheck.inverse, precheck.rest, precheck.room, len(z)
    for j in range(2 * n):
        real, imaginary = 0.0, 0.0
        for k in range(n):
            real += inverse[0, j, k] * (z[k] - rest[k]) + inverse[0, j, n + k] * w[k]
            imaginary += inverse[1, j, k] * (z[k] - rest[k]) + inverse[1, j, n + k] * w[k]
        sizes[j] = math.hypot(real, imaginary)
    reach = 0.0
    for i in range(n):
        bound = 0.0
        for j in range(2 * n):
            bound += precheck.sizes[i, j] * sizes[j]
        reach = max(reach, bound)
    return 0.25 * math.log(reach / precheck.limit) / -precheck.growth if reach > precheck.limit else 0.0


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
