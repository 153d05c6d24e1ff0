"""Runs from their tasks to their ends: in slices of a kernel, between which Python can handle signals.

Several runs may begin together as a stack, each with its first slice: a small system takes less time to run than a
call from Python takes. Most end there; the others go on alone, as stacks of one. An engine has a subclass of
`Several`, and `runs` makes its runs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines import certificates, course
from stickslip.sim.engines.contract import Task
from stickslip.sim.engines.course import Events, State
from stickslip.sim.engines.forcing import Drive, times
from stickslip.sim.engines.stacks import Stack
from stickslip.sim.kernels.compile import code_of
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import IntegrationError, Outcome, Run, StalledError, Stats, Stills
from stickslip.sim.runs.series import EventSeries, without_returns

#: By kernel, its code for plain systems.
_CODE: dict[Any, Any] = {}
#: Why the first slice of a run ended, beside the reasons of kernels: others left no room for it, and it is to begin
#: anew alone; or it was all of the run, and its events are at the user's times.
_ANEW, _WHOLE = -1, -2
#: Steps times blocks after which a run is given up if, at their pace, the rest took more than the most: some seconds,
#: which what a start leaves in most systems takes to die out, and some weeks. Steps of fewer blocks cost as much.
_TRIED, _FEW, _MOST = 1e7, 20, 1e12


class Slice(NamedTuple):
    """Why a slice of a run ended, and its events."""

    status: int
    events: Events


def kind_of(task: Task) -> tuple[int, bool, bool] | None:
    """What tasks that may begin together as a stack have in common; None if this one begins alone."""
    if not task.system.is_plain or len(task.samples) or task.modes is not None:
        return None
    return task.system.n, task.stop_early, task.certify


def runs(
    tasks: Sequence[Task], together: Callable[[list[Task]], Several | None], alone: Callable[[Task], Run]
) -> list[Callable[[], Run]]:
    """The runs of some tasks, as `Engine.prepare` gives them.

    `together` is given several tasks that may begin as a stack, and may know why they do not: None. `alone` runs the
    others.
    """
    calls: list[Callable[[], Run]] = []
    for kind, tasks_of_kind in groupby(tasks, kind_of):
        group = list(tasks_of_kind)
        several = together(group) if kind is not None and len(group) > 1 else None
        if several is None:
            calls += [partial(alone, task) for task in group]
        else:
            calls += [partial(several.run, k, first_slice) for k, first_slice in enumerate(several.begin())]
    return calls


class Several(ABC):
    """The runs of some tasks as a stack: one, or plain ones of one kind."""

    tasks: Sequence[Task]
    drives: Sequence[Drive]  #: whose present pieces are run to their ends
    collapse: Sequence[certificates.Collapse]  #: asked for a certificate when the clocks say that it is due
    models: Any  #: as of `Stack`
    work: Any  #: as of `Stack`
    states: State
    lengths: Floats  #: of the present pieces, shape (runs,)
    kernel: Callable[..., None]  #: advances some runs of a `Stack`, as `frame` does
    bounds: Floats  #: of |z| and |w|; beyond them a slice ends, shape (runs,)
    stalled: str  #: what to say, after the time and the block, when the engine cannot go on
    initial_modes: NDArray[np.int8]
    """Shape (runs, 1 + m, n): by the engine's own definition of sticking, then by each of `thresholds`. Events by
    definition d carry block + d n."""
    events_a_step: int  #: the most events that a step can record
    thresholds: tuple[float, ...] = ()
    tells_touches: bool = False  #: by `Events.touch`; see `without_returns`
    method: str = ""  #: where an engine has several
    is_of_one_type: bool = False  #: whether all arrays have the types that they have for any plain system

    @cached_property
    def _slips(self) -> NDArray[np.int64]:
        return np.array([collapse.precheck.slip for collapse in self.collapse])

    @property
    def _capacity(self) -> int:
        """Of the buffers for a slice of one run."""
        return max(2 * self.events_a_step, 4096)

    @abstractmethod
    def goal(self, drive: Drive) -> Any:
        """What the runs are taken to, of which the present piece of the first is that of a drive."""

    @abstractmethod
    def alone(self, k: int) -> Run:
        """Run the task k apart from the others."""

    def settles(self, k: int) -> certificates.Flow | None:
        """The motion of run k to its end, if all blocks are certain to come to rest without another event."""
        return None

    def stats(self, k: int, n_events: int) -> Stats:
        """What run k has cost so far."""
        counts = self.states.counters[k].tolist()
        return Stats(
            counts[course.N_STEPS], counts[course.N_REJECTED], counts[course.N_PRODUCTS], n_events, self.method
        )

    def state(self, k: int) -> State:
        """The state of run k, which kernels change."""
        z, w, mode, clock, counters, (t, z_there, w_there) = self.states
        return State(z[k], w[k], mode[k], clock[k], counters[k], course.Buffers(t[k], z_there[k], w_there[k]))

    def advance(self, first: int, events: Events, slices: NDArray[np.int64]) -> None:
        """Advance some of the runs, from the first on, by a slice.

        What they record is written into the buffers, one behind the other, and for each the status, and how many
        events and ends of all-stuck intervals there are, into a row of `slices`.
        """
        goal, precheck = self.goal(self.drives[first]), self.collapse[first].precheck
        stack = Stack(self.models, self.work, goal, self.states, self._slips, precheck, self.events_a_step)
        kernel, arguments = self.kernel, (stack, events, first, slices)
        (_CODE.get(kernel, kernel) if self.is_of_one_type else kernel)(*arguments)
        if self.is_of_one_type and kernel not in _CODE:
            _CODE[kernel] = code_of(kernel, *arguments)

    def slice(self, k: int, bound: float) -> Slice:
        """Advance run k by a slice, or until its state passes a bound."""
        events, slices = Events.blank(self._capacity), np.zeros((1, 3), dtype=np.int64)
        self.bounds[k], self.states.counters[k, course.N_ALL_STUCK] = bound, 0
        self.advance(k, events, slices)
        status, n_recorded, n_all_stuck = slices[0].tolist()
        return Slice(status, events.first(n_recorded, n_all_stuck))

    def run(self, k: int, first_slice: Slice) -> Run:
        """The run of the task k, whose first slice has been run."""
        if first_slice.status == _ANEW:
            return self.alone(k)
        if first_slice.status != _WHOLE:
            return self.go_on(k, first_slice)
        task, (t, block, mode, _, all_stuck) = self.tasks[k], first_slice.events
        series = EventSeries(t, block, mode, self.initial_modes[k, 0], task.t_start, task.t_end)
        return self._ended(k, task.t_end, [series], all_stuck)

    def go_on(self, k: int, first_slice: Slice | None = None) -> Run:
        """Run slices of the task k, from its start or from where its first slice ended, until the run ends."""
        task, drive, collapse, state = self.tasks[k], self.drives[k], self.collapse[k], self.state(k)
        z, w, mode, clock, counters, _ = state
        outcome: Outcome = "finished"
        reason, t_collapse, n_placed, parts, bound = "", None, 0, list[Events](), 0.0
        while True:
            status, events = first_slice or self.slice(k, bound := bound or _first_bound(task))
            parts.append(events)
            first_slice, flow = None, None
            s = float(clock[course.TIME])
            t = drive.time(s)
            if status == course.DONE:
                if drive.is_last:
                    break
                n_placed = _to_user(drive, task, state, n_placed)
                drive.go_on()
            if status == course.ALL_SLIP:
                certificate = collapse.certify(z, w)
                if certificate.is_certain and t_collapse is None:
                    outcome, reason, t_collapse = "collapsed", certificate.reason, t
                flow = certificate.flow
                clock[course.CHECK + int(mode[0] > 0)] = s + certificate.ask_again_after
            elif status == course.PAUSED and task.stop_early and drive.is_steady:
                flow = self.settles(k)
            elif status == course.DIVERGED:
                why, size = _diverged(task, drive, t, z, w)
                if why:
                    outcome, reason = "diverged", why
                    break
                bound = max(_first_bound(task), 2.0 * size)
            elif status == course.STALLED:
                block = counters[course.LAST_BLOCK]
                raise StalledError(f"no progress at t = {t!r}, at block {block}: {self.stalled}")
            if flow is not None:
                _follow(flow, drive.length - s, s, state)
                t = task.t_end
                break
            if status in (course.PAUSED, course.BUFFER_FULL):
                _require_an_end(task, int(counters[course.N_STEPS]), t)
        _to_user(drive, task, state, n_placed)
        events = Events.joined(parts)
        piece, instants = drive.of_all(events.t, events.all_stuck)
        series = self._series(k, events, piece, instants, t)
        return self._ended(k, t, series, events.all_stuck, outcome, reason, t_collapse)

    def _series(self, k: int, events: Events, piece: NDArray[np.intp], t: Floats, t_end: float) -> list[EventSeries]:
        """The series by each definition of sticking, the first without touches that its error cannot tell."""
        n, t_start = self.tasks[k].system.n, self.tasks[k].t_start
        if not len(t):
            return [
                EventSeries(t, events.block, events.mode, modes, t_start, t_end) for modes in self.initial_modes[k]
            ]
        order = np.lexsort((events.block, t))  # stable: instants that round to one time keep each block's order
        t, s, block, mode = t[order], events.t[order], events.block[order], events.mode[order]
        series = []
        for d, modes in enumerate(self.initial_modes[k]):
            of_definition = block // n == d if self.thresholds else slice(None)
            t_there, block_there, mode_there = t[of_definition], block[of_definition] - d * n, mode[of_definition]
            series.append(EventSeries(t_there, block_there, mode_there, modes, t_start, t_end))
        touch = events.touch[order]
        # else no two events are that close, of whichever block
        if self.tells_touches and (s[1:] - s[:-1] <= touch[1:]).any():
            series[0] = without_returns(series[0], piece[order], s, touch)
        return series

    def _ended(
        self,
        k: int,
        t: float,
        series: list[EventSeries],
        all_stuck: Floats,
        outcome: Outcome = "finished",
        reason: str = "",
        t_collapse: float | None = None,
    ) -> Run:
        """Run k, whose state is that at its end."""
        z, w = self.drives[k].of_user(t, self.states.z[k], self.states.w[k])
        return Run(
            z=z,
            w=w,
            t_end=t,
            events=series[0],
            outcome=outcome,
            reason=reason,
            stats=self.stats(k, len(series[0])),
            t_collapse=t_collapse,
            samples=self.tasks[k].samples.first(int(self.states.counters[k, course.N_SAMPLED])),
            stills=Stills(*all_stuck),
            by_threshold=dict(zip(self.thresholds, series[1:], strict=True)),
        )

    def begin(self) -> list[Slice]:
        """Advance each run by its first slice."""
        systems = [task.system for task in self.tasks]
        self.bounds[:] = certificates.escape_bounds(systems, self.states.z, self.states.w)
        several, n_definitions, n = self.initial_modes.shape
        buffers = Events.blank(max(self._capacity, 64 * several), several)
        slices = np.zeros((several, 3), dtype=np.int64)
        self.advance(0, buffers, slices)
        # where a slice ends may not depend on the others
        is_crowded = (slices[:, 0] == course.BUFFER_FULL) | (slices[:, 1] + self.events_a_step > self._capacity)
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
        order = np.lexsort((block, t, of_event))  # as in `_series`
        of_event, t, s, block = of_event[order], t[order], s[order], block[order]
        mode, touch = mode[order], touch[order]
        if self.tells_touches:
            whole[of_event[_may_be_touches(of_event * n + block, s, touch)]] = False
        s = np.where(whole[of_event], t, s)
        of_stuck, stuck_t = on_clock(stuck_s, slices[:, 2])
        all_stuck = np.array([np.where(whole[of_stuck], stuck_t, stuck_s), total])
        slices[whole, 0] = _WHOLE
        parts = zip([0, *ends], ends, [0, *stuck_ends], stuck_ends, slices[:, 0].tolist(), strict=False)
        return [
            Slice(status, Events(s[a:b], block[a:b], mode[a:b], touch[a:b], all_stuck[:, stuck_a:stuck_b]))
            for a, b, stuck_a, stuck_b, status in parts
        ]


def _may_be_touches(of_block: NDArray[np.intp], t: Floats, touch: Floats) -> NDArray[np.intp]:
    """The events that follow on one of the same block within `touch`, which has one number an event."""
    order = np.argsort(of_block, kind="stable")
    block, times = of_block[order], t[order]
    is_close = (block[1:] == block[:-1]) & (times[1:] - times[:-1] <= touch[order][1:])
    return order[1:][is_close]


def _first_bound(task: Task) -> float:
    """The size at which to ask first whether a run diverges."""
    return float(certificates.escape_bounds([task.system], task.z0[np.newaxis], task.w0[np.newaxis])[0])


def _diverged(task: Task, drive: Drive, t: float, z: Floats, w: Floats) -> tuple[str, float]:
    """Why a run diverges whose state passed a bound, "" if that is not certain yet; and the size of its state."""
    system, passed = task.system, certificates.BEYOND_NUMBERS
    z_there, w_there = drive.of_user(t, z, w)
    speed = float(np.abs(w_there).max())
    size = max(float(np.abs(z).max()), float(np.abs(z_there).max()), speed)
    if not np.isfinite((size, speed)).all():
        raise IntegrationError(
            f"the state is not finite after t = {t!r}: numbers of this size leave float64; scale the system"
        )
    if task.stop_early and (why := certificates.escape(system, z_there, w_there)):
        return why, size
    if size <= passed and task.stop_early and not system.changes:
        beyond_doubt = certificates.divergence_bound(system, task.z0, task.w0)
        if speed > beyond_doubt and certificates.grows(system):
            passed = beyond_doubt
    return certificates.divergence_reason(z_there, w_there, t, passed) if size > passed else "", size


def _require_an_end(task: Task, n_steps: int, t: float) -> None:
    """IntegrationError if the rest of a run, at its pace so far, takes more steps than are worth while."""
    n, steps = task.system.n, float(n_steps)
    left = steps * ((task.t_end - t) / max(t - task.t_start, 1e-300))
    if steps * max(n, _FEW) > _TRIED and left * n > _MOST:
        raise IntegrationError(
            f"t_end: {n_steps} steps led to t = {t:g}, and nothing ends the motion; at this pace t ="
            f" {task.t_end:g} takes {left:.0e} more: shorten the run"
        )


def _to_user(drive: Drive, task: Task, state: State, first: int) -> int:
    """Put the samples so far, from `first` on, into the user's frame; returns how many there are."""
    samples, last = task.samples, int(state.counters[course.N_SAMPLED])
    if last > first:
        of_piece = slice(first, last)
        samples.z[of_piece], samples.w[of_piece] = drive.of_user(
            samples.t[of_piece], samples.z[of_piece], samples.w[of_piece]
        )
    return last


def _follow(flow: certificates.Flow, remaining: float, s: float, state: State) -> None:
    """Put the state at the end, `remaining` from now, and the samples that are still due at s, into their arrays."""
    z, w, _, _, counters, samples = state
    first = int(counters[course.N_SAMPLED])
    at_end, sampled = (flow.at(times) for times in (np.array([remaining]), samples.t[first:] - s))
    z[:], w[:] = at_end[0][0], at_end[1][0]  # separately: a product of another shape rounds differently
    samples.z[first:], samples.w[first:] = sampled
    counters[course.N_SAMPLED] = len(samples.t)
