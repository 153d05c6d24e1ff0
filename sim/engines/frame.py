"""The one loop that takes a run forward, in slices between which Python can handle signals.

How a motion is followed is a `Way`. Its *window* is the time that one expansion or one macro step covers; it may hold
several events. A slice ends where the run does, where the buffers may not hold what comes next, where all blocks slip
so that a collapse may be certified, where the state passes a bound, and after so many steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from stickslip.sim.engines import course
from stickslip.sim.engines.course import Events
from stickslip.sim.engines.stacks import Model, Stack, Work, note_slice, rest_of, run_of
from stickslip.sim.kernels.compile import inner, kernel
from stickslip.sim.kernels.emit import by_reference
from stickslip.sim.numerics.arguments import Ints
from stickslip.sim.numerics.arithmetic import largest


class Goal(Protocol):
    """What a run is taken to."""

    @property
    def t_end(self) -> float: ...
    @property
    def is_last(self) -> bool: ...
    @property
    def bound(self) -> float: ...
    @property
    def instant(self) -> float:
        """If it is not negative, one window is for the events by then, and the state stays."""


Aim = TypeVar("Aim", bound=Goal)
Window = TypeVar("Window")


@inner
def _nothing(run: Any) -> None:
    """What there is to do where each window begins anew."""


class Way(NamedTuple, Generic[Model, Work, Aim, Window]):
    """A way to follow a motion: functions that kernels call.

    All but the first take the run: what is constant, workspace, what it is taken to, and its state.
    """

    blank: Callable[[], Window]  #: no window
    open: Callable[[Stack[Model, Work, Aim, int], Window, float], Window]
    """The same window, or, if it is over, the next one; the time that remains is given."""
    note: Callable[[Stack[Model, Work, Aim, int], Events, int], tuple[int, bool]]
    """Record the modes that have changed, behind so many events; the number, and whether all are the same."""
    at: Callable[[Stack[Model, Work, Aim, int], Window, float], None]
    """Keep the samples at a time, where a run of no length ends."""
    carry: Callable[[Stack[Model, Work, Aim, int], Window, bool, Events, int], tuple[Window, int, bool]]
    """``(..., is_after_event, events, n_recorded)``: go on to the next event, or to the end of the window,
    with the samples on the way. Returns the window, how many events are recorded, and if there is no progress."""
    enter: Callable[[Stack[Model, Work, Aim, int]], None] = _nothing
    """Begin a piece, whose numbers are there, as is the state in its frame."""


def frame(
    way: Way[Model, Work, Aim, Window], module: str
) -> Callable[[Stack[Model, Work, Any, Ints], Events, int, Ints], None]:
    """The kernel ``f(stack, events, first, slices)``: advance runs of a `Stack`, from the first on.

    Why each ended, and what it recorded, is put into a row of `slices`: see `Several.advance`. A second call goes on
    from there. It is kept as one of a module.
    """
    blank, open_next, note, at, carry, enter = way

    @inner
    def take(run: Stack[Model, Work, Aim, int], events: Events, n_recorded: int, n_last: int) -> tuple[int, int]:
        goal, state, window = run.goal, run.state, blank()
        clock, counters = state.clock, state.counters
        while course.n_tried(counters) < n_last:
            remaining = goal.t_end - clock[course.TIME]
            if remaining <= 0.0 and not goal.is_last:
                return course.DONE, n_recorded  # the next piece decides which blocks stick from here on
            if n_recorded + run.events_a_step > len(events.t):
                return course.BUFFER_FULL, n_recorded
            window = open_next(run, window, remaining)
            before = n_recorded
            n_recorded, same = note(run, events, n_recorded)
            if remaining <= 0.0:
                at(run, window, clock[course.TIME])
                return course.DONE, n_recorded
            if same and course.is_check_due(state, state.mode, run.precheck, remaining):
                if course.may_collapse(state, run.slip, run.precheck):
                    return course.ALL_SLIP, n_recorded
                if n_recorded > 0:
                    return course.PAUSED, n_recorded
                # as at the start of a slice: the result does not depend on the slicing
                n_last, window = course.n_tried(counters) + course.STEPS_A_SLICE, blank()
                continue
            n_rejected = counters[course.N_REJECTED]
            window, n_recorded, stalls = carry(run, window, n_recorded > before, events, n_recorded)
            if stalls:
                return course.STALLED, n_recorded
            if goal.instant >= 0.0 and counters[course.N_REJECTED] == n_rejected:  # a rejected step is taken again
                return course.DONE, n_recorded
            # a maximum of floats may lose a NaN, so it is asked this way
            if not (largest(state.z) <= goal.bound and largest(state.w) <= goal.bound):
                return course.DIVERGED, n_recorded
        return course.PAUSED, n_recorded

    def advance(stack: Stack[Model, Work, Any, Ints], events: Events, first: int, slices: Ints) -> None:
        for row in range(len(slices)):
            k, counters, lengths = first + row, stack.state.counters[first + row], stack.goal.t_end
            buffers = by_reference(rest_of(events, slices, row))
            status, n_recorded, n_last = course.DONE, 0, course.n_tried(counters) + course.STEPS_A_SLICE
            while True:
                run = by_reference(run_of(stack, k))
                pieces, state = run.model.forcing.pieces, run.state
                if pieces.n_ahead[0] > 0 and state.clock[course.TIME] >= lengths[k]:
                    lengths[k] = course.enter(run.model.forcing, state, lengths[k])
                    enter(run)
                    run = by_reference(run_of(stack, k))
                n_before, n_stuck = n_recorded, counters[course.N_ALL_STUCK]
                status, n_recorded = take(run, buffers, n_recorded, n_last)
                course.count(pieces, n_recorded - n_before, counters[course.N_ALL_STUCK] - n_stuck)
                if status != course.DONE or pieces.n_ahead[0] == 0:
                    break
            note_slice(slices, row, status, n_recorded, counters)

    advance.__module__, advance.__qualname__ = module, advance.__name__
    return kernel(advance)
