"""Runs that begin together: a small system takes less time to run than a call from Python takes.

A kernel advances a *stack* of runs, whose arrays have an axis more in front, each by its first slice. Most end there;
the others go on alone, as stacks of one. An engine has a subclass of `Several`, and `runs` makes its runs.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import groupby
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from stickslip.sim.engines import certificates, course
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.course import Events, FirstSlice, State
from stickslip.sim.engines.forcing import Drive, times
from stickslip.sim.kernels.compile import code_of, inner
from stickslip.sim.kernels.emit import IS_COMPILED
from stickslip.sim.numerics.arguments import Floats, Ints
from stickslip.sim.runs.run import Run, Stills
from stickslip.sim.runs.series import EventSeries

#: By kernel, its code for plain systems.
_CODE: dict[Any, Any] = {}
#: Why the first slice of a run ended: others left no room for it, and it is to begin anew alone.
_ANEW = -1


Model = TypeVar("Model")
Work = TypeVar("Work")
Goal = TypeVar("Goal")
Slip = TypeVar("Slip", int, Ints)


class Stack(NamedTuple, Generic[Model, Work, Goal, Slip]):
    """Runs that one call advances, as `frame` takes them. Arrays have a place for each run; see `course.by_run`."""

    model: Model
    work: Work
    goal: Goal
    state: State
    slip: Slip  #: of the pre-check
    events_a_step: int  #: the most that one step can record


def _type_of_run(kind: Any) -> Any:
    """The type of one run's part, from that of a stack's."""
    if isinstance(kind, types.Array):
        return kind.copy(ndim=kind.ndim - 1) if kind.ndim > 1 else kind.dtype
    if not hasattr(kind, "instance_class"):
        return kind
    fields = [
        _type_of_run(part) if course.is_by_run(kind.instance_class, name) else part
        for name, part in zip(kind.fields, kind.types, strict=True)
    ]
    return types.BaseTuple.from_types(fields, kind.instance_class)


def _emit_run(context: Any, builder: Any, kind: Any, value: Any, k: Any) -> Any:
    of_run = _type_of_run(kind)
    if of_run == kind:
        return value
    if isinstance(kind, types.Array):
        return context.get_function(operator.getitem, of_run(kind, types.intp))(builder, (value, k))
    fields = [builder.extract_value(value, place) for place in range(len(kind.fields))]
    fields = [
        _emit_run(context, builder, part, field, k) if course.is_by_run(kind.instance_class, name) else field
        for name, part, field in zip(kind.fields, kind.types, fields, strict=True)
    ]
    return context.make_tuple(builder, of_run, fields)


def _run_of(typing_context: Any, stack: Any, k: Any) -> Any:
    """Run k of a stack, as tuples of views."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _emit_run(context, builder, stack, *arguments)

    return _type_of_run(stack)(stack, types.intp), codegen


run_of: Any = intrinsic(_run_of) if IS_COMPILED else course.of_run


@inner
def rest_of(events: Events, slices: Ints, k: int) -> Events:
    """What is left of the buffers of a stack for the events of run k."""
    n_recorded, n_all_stuck = 0, 0
    for j in range(k):
        n_recorded += slices[j, 1]
        n_all_stuck += slices[j, 2]
    t, block, mode, touch, all_stuck = events
    return Events(
        t[n_recorded:], block[n_recorded:], mode[n_recorded:], touch[n_recorded:], all_stuck[:, n_all_stuck:]
    )


@inner
def note_slice(slices: Ints, k: int, status: int, n_recorded: int, counters: Ints) -> None:
    """Note why run k of a stack ended its slice, and how many events and all-stuck intervals it recorded."""
    slices[k, 0], slices[k, 1], slices[k, 2] = status, n_recorded, counters[course.N_ALL_STUCK]


def alike(tasks: Sequence[Task]) -> Iterator[tuple[bool, list[Task]]]:
    """The tasks in order, those that follow on each other and may begin together as a stack; the others, as such."""

    def kind(task: Task) -> tuple[int, bool, bool] | None:
        if not task.system.is_plain or len(task.samples) or task.modes is not None:
            return None
        return task.system.n, task.stop_early, task.certify

    for common, group in groupby(tasks, kind):
        yield common is not None, list(group)


def runs(
    tasks: Sequence[Task], together: Callable[[list[Task]], Several | None], alone: Callable[[Task], Run]
) -> list[Callable[[], Run]]:
    """The runs of some tasks, as `Engine.prepare` gives them.

    `together` is given several tasks that may begin as a stack, and may know why they do not: None. `alone` runs the
    others.
    """
    calls: list[Callable[[], Run]] = []
    for may_begin, group in alike(tasks):
        several = together(group) if may_begin and len(group) > 1 else None
        if several is None:
            calls += [partial(alone, task) for task in group]
        else:
            calls += [partial(several.run, k, first_slice) for k, first_slice in enumerate(several.begin())]
    return calls


class Several(ABC):
    """The runs of some tasks as a stack: one, or plain ones of one kind."""

    tasks: Sequence[Task]
    drives: Sequence[Drive]
    collapse: Sequence[certificates.Collapse]
    models: Any  #: as of `Stack`
    work: Any  #: as of `Stack`
    states: State
    lengths: Floats  #: of the present pieces, shape (runs,)
    kernel: Callable[..., None]  #: advances some runs of a `Stack`, as `frame` does
    bounds: Floats  #: of |z| and |w|; beyond them a slice ends, shape (runs,)
    stalled: str  #: as of `course.Plan`
    initial_modes: NDArray[np.int8]  #: shape (runs, definitions of sticking, n)
    events_a_step: int  #: this, and the next two, as of `course.Plan`
    tells_touches: bool = False
    method: str = ""
    is_of_one_type: bool = False  #: whether all arrays have the types that they have for any plain system

    @cached_property
    def _slips(self) -> NDArray[np.int64]:
        return np.array([collapse.precheck.slip for collapse in self.collapse])

    @abstractmethod
    def goal(self, drive: Drive) -> Any:
        """What the runs are taken to, of which the present piece of the first is that of a drive."""

    @abstractmethod
    def alone(self, k: int) -> Run:
        """Run the task k apart from the others."""

    def advance(self, first: int, events: Events, slices: NDArray[np.int64]) -> None:
        """Advance some of the runs, from the first on, by a slice.

        What they record is written into the buffers, one behind the other, and for each the status, and how many
        events and ends of all-stuck intervals there are, into a row of `slices`.
        """
        goal = self.goal(self.drives[first])
        stack = Stack(self.models, self.work, goal, self.states, self._slips, self.events_a_step)
        kernel, arguments = self.kernel, (stack, events, self.collapse[first].precheck, first, slices)
        (_CODE.get(kernel, kernel) if self.is_of_one_type else kernel)(*arguments)
        if self.is_of_one_type and kernel not in _CODE:
            _CODE[kernel] = code_of(kernel, *arguments)

    def slice(self, k: int, events: Events, bound: float) -> tuple[int, int]:
        """Advance run k by a slice: the status, and how many events it recorded."""
        self.bounds[k], slices = bound, np.zeros((1, 3), dtype=np.int64)
        self.advance(k, events, slices)
        return int(slices[0, 0]), int(slices[0, 1])

    def plan(self, k: int) -> course.Plan:
        """What `course.complete` needs to run the task k."""
        return course.Plan(
            partial(self.slice, k),
            stalled=self.stalled,
            events_a_step=self.events_a_step,
            initial_modes=self.initial_modes[k],
            tells_touches=self.tells_touches,
            method=self.method,
        )

    def state(self, k: int) -> State:
        """The state of run k, which kernels change."""
        z, w, mode, clock, counters, (t, z_there, w_there) = self.states
        return State(z[k], w[k], mode[k], clock[k], counters[k], course.Buffers(t[k], z_there[k], w_there[k]))

    def go_on(self, k: int, first_slice: FirstSlice | None = None) -> Run:
        """Run the task k to its end, from its start or from where its first slice ended."""
        return course.complete(
            self.tasks[k], self.state(k), self.drives[k], self.collapse[k], self.plan(k), first_slice
        )

    def run(self, k: int, first_slice: FirstSlice) -> Run:
        """The run of the task k, whose first slice has been run."""
        if first_slice.status == _ANEW:
            return self.alone(k)
        return self._ended(k, first_slice) if first_slice.is_whole else self.go_on(k, first_slice)

    def begin(self) -> list[FirstSlice]:
        """Advance each run by its first slice."""
        systems = [task.system for task in self.tasks]
        self.bounds[:] = certificates.escape_bounds(systems, self.states.z, self.states.w)
        several, n_definitions, n = self.initial_modes.shape
        of_one = course.capacity(self.events_a_step)
        buffers = Events.blank(max(of_one, 64 * several), several)
        slices = np.zeros((several, 3), dtype=np.int64)
        self.advance(0, buffers, slices)
        # where a slice ends may not depend on the others
        is_crowded = (slices[:, 0] == course.BUFFER_FULL) | (slices[:, 1] + self.events_a_step > of_one)
        slices[is_crowded, 0] = _ANEW
        whole = (slices[:, 0] == course.DONE) & (n_definitions == 1)
        ends, stuck_ends = slices[:, 1:].cumsum(axis=0).T.tolist()
        s, block, mode, touch, (stuck_s, total) = buffers.first(ends[-1], stuck_ends[-1])
        starts, stops = np.array([(task.t_start, task.t_end) for task in self.tasks]).T

        def on_clock(s: Floats, counts: NDArray[np.int64]) -> tuple[NDArray[np.intp], Floats]:
            """The number of the run, and its time."""
            run = np.arange(several).repeat(counts)
            return run, times(starts[run], stops[run], s)

        of_event, t = on_clock(s, slices[:, 1])
        order = np.lexsort((block, t, of_event))  # as in `course.complete`
        of_event, t, s, block = of_event[order], t[order], s[order], block[order]
        mode, touch = mode[order], touch[order]
        if self.tells_touches:
            whole[of_event[_may_be_touches(of_event * n + block, s, touch)]] = False
        s = np.where(whole[of_event], t, s)
        of_stuck, stuck_t = on_clock(stuck_s, slices[:, 2])
        all_stuck = np.array([np.where(whole[of_stuck], stuck_t, stuck_s), total])
        parts = zip(
            [0, *ends], ends, [0, *stuck_ends], stuck_ends, slices[:, 0].tolist(), whole.tolist(), strict=False
        )
        return [
            FirstSlice(
                status, Events(s[a:b], block[a:b], mode[a:b], touch[a:b], all_stuck[:, stuck_a:stuck_b]), is_whole
            )
            for a, b, stuck_a, stuck_b, status, is_whole in parts
        ]

    def _ended(self, k: int, first_slice: FirstSlice) -> Run:
        """Run k, whose first slice was all of it, as `course.complete` would give it."""
        task, (t, block, mode, _, all_stuck) = self.tasks[k], first_slice.events
        return Run(
            z=self.states.z[k],
            w=self.states.w[k],
            t_end=task.t_end,
            events=EventSeries(t, block, mode, self.initial_modes[k, 0], task.t_start, task.t_end),
            outcome="finished",
            reason="",
            stats=course.stats_of(self.states.counters[k], len(t), self.method),
            samples=task.samples,
            stills=Stills(*all_stuck),
        )


def _may_be_touches(of_block: NDArray[np.intp], t: Floats, touch: Floats) -> NDArray[np.intp]:
    """The events that follow on one of the same block within `touch`, which has one number an event."""
    order = np.argsort(of_block, kind="stable")
    block, times = of_block[order], t[order]
    is_close = (block[1:] == block[:-1]) & (times[1:] - times[:-1] <= touch[order][1:])
    return order[1:][is_close]
