"""Adiabatic loading: the belt waits while any block slips.

A belt at rest carries nothing. While all blocks stick it advances, at once, by the least d >= 0 at which friction
gives way somewhere: |F_i + d G_i| = static_i with F = K z and G = K sign(v). It is the limit of a slow belt. The
motion of an event has a clock of its own; the time of the run is that at which a belt of speed v has come as far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.engines.contract import Engine, Task
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import IntegrationError, Loaded, Run, Samples, Stats
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.system import System, require_within

#: What systems may have beyond eq. (10): the rest moves a belt, or blocks on a belt at rest.
TAKES = frozenset({"static", "weakening", "back_slip", "damping matrix", "mass"})
#: An event is given up after this time, in units of 1 / |eigenvalue|.
_LONGEST = 1e6
#: Blocks whose distances to giving way agree so far give way at one instant.
_TIE = 1e-13


class _Event(NamedTuple):
    """An event: the modes at its begin, where it led, and the changes of mode in it, in order of block."""

    initial_mode: NDArray[np.int8]
    z: Floats
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    elapsed: float


class Adiabatic:
    """An exact engine, for the motion in events, whose belt waits; runs have `Run.loaded`."""

    def __init__(self, engine: Engine) -> None:
        if not engine.is_exact:
            raise ValueError(
                f'load: expected an engine of the exact law, by which blocks stick, got engine="{engine.name}"; leave'
                " load out"
            )
        self.engine = engine

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        """As that of an `Engine`."""
        return [partial(self.integrate, task) for task in tasks]

    def integrate(self, task: Task) -> Run:
        """As that of an `Engine`.

        Raises
        ------
        ValueError
            If the system has what a belt that waits cannot load: belts or forces in time, or a block whose static
            friction is not above the kinetic.
        IntegrationError
            If the motion of an event does not come to rest.
        """
        system = task.system
        _require_loadable(system, task.modes)
        return _Loading(self.engine, task).run()


def _require_loadable(system: System, modes: NDArray[np.int8] | None) -> None:
    require_within(TAKES, system, "load='adiabatic'")
    creeps = system.static <= system.slip_friction[0]
    if creeps.any():
        block = int(np.argmax(creeps))
        raise ValueError(
            f"static: expected above the kinetic friction of every block with load='adiabatic', got"
            f" {system.static[block]:g} at block {block}, which would creep after the belt, in no event; raise it, or"
            " leave load out"
        )
    if system.belt_speed == 0.0:
        raise ValueError("belt_speed: expected one that loads with load='adiabatic', got 0")
    if modes is not None:
        raise ValueError("modes: expected None with load='adiabatic', where the state says who sticks")


class _Loading:
    """A run: its state with all blocks stuck, at a time of the belt."""

    def __init__(self, engine: Engine, task: Task) -> None:
        self.engine, self.task = engine, task
        self.resting = task.system.changed(belt_speed=0.0)
        self.speed = float(task.system.belt_speed)
        self.way = np.sign(self.speed)
        self.pull = self.resting.stiffness @ np.full(task.system.n, self.way)
        self.longest = _LONGEST / self.resting.fastest_rate
        self.none = Samples.blank(np.empty(0), task.system.n)
        self.spent = np.zeros(4, dtype=np.int64)

    def run(self) -> Run:
        """The run to the end of the task."""
        task, n = self.task, self.task.system.n
        t, first = task.t_start, self._event(task.z0, task.w0 - self.speed, None, task.t_start)
        z, changes = first.z, [first]
        times, moments, sums, firsts = [t], [], [], []
        while True:
            distance, slips = self._to_next(z)
            due = t + distance / abs(self.speed)
            end = min(due, task.t_end)
            self._sample(t, end, z)
            if due > task.t_end:
                break
            t, z = end, z + distance * self.way
            event = self._event(z, np.zeros(n), slips, t)
            if not len(event.block):
                raise IntegrationError(f"no motion at t = {t!r}, though friction gives way; the start is degenerate")
            firsts.append(int(np.flatnonzero(slips)[0]))
            sums.append(float(z.sum()))
            moments.append(float(-self.way * (event.z.sum() - z.sum())))
            times.append(t)
            changes.append(event)
            z = event.z
        z = z + (task.t_end - t) * self.speed
        by_event = [np.unique(event.block[event.mode != 0]) for event in changes[1:]]
        loaded = Loaded(
            t=np.array(times[1:]),
            elapsed=np.array([event.elapsed for event in changes[1:]]),
            size=np.array([len(blocks) for blocks in by_event], dtype=np.int32),
            moment=np.array(moments),
            first_block=np.array(firsts, dtype=np.int32),
            z_sum=np.array(sums),
        )
        series = EventSeries(
            np.repeat(times, [len(event.block) for event in changes]),
            np.concatenate([event.block for event in changes]),
            np.concatenate([event.mode for event in changes]),
            first.initial_mode,
            task.t_start,
            task.t_end,
        )
        w = np.full(n, self.speed)
        n_steps, n_rejected, n_products, n_events = self.spent.tolist()
        stats = Stats(n_steps, n_rejected, n_products, n_events, "adiabatic")
        return Run(z, w, task.t_end, series, "finished", "", stats, samples=task.samples, loaded=loaded)

    def _to_next(self, z: Floats) -> tuple[float, NDArray[np.int8]]:
        """How far the belt goes until friction gives way, and which way the blocks slip there, 0 of the others."""
        system = self.resting
        force = system.stiffness @ z
        rising = np.sign(self.pull)
        room = np.full(system.n, np.inf)
        is_loaded = (rising != 0) & (system.closed != -rising)
        np.divide(system.static - rising * force, np.abs(self.pull), out=room, where=is_loaded)
        distance = max(float(room.min()), 0.0)
        gives_way = room <= distance * (1.0 + _TIE)
        return distance, np.where(gives_way, -rising, 0.0).astype(np.int8)

    def _event(self, z: Floats, slip: Floats, modes: NDArray[np.int8] | None, t: float) -> _Event:
        """The motion from a state on the belt at rest until all blocks stick."""
        task = self.task._replace(
            system=self.resting, z0=z, w0=slip, t_start=0.0, t_end=self.longest, samples=self.none, modes=modes
        )
        run = self.engine.integrate(task)
        events = run.events
        mode = events.initial_mode.copy()
        mode[events.block] = events.mode  # the last of each block stays
        if mode.any() or run.outcome != "finished":
            raise IntegrationError(
                f"the event at t = {t!r} does not come to rest within {self.longest:g}, on the belt at rest: block"
                f" {int(np.argmax(mode != 0))} slips; damp it, but not beyond critical damping, or leave load out"
            )
        # those that leave at the begin are events of this run, not of their own
        leaves = np.flatnonzero(events.initial_mode if modes is not None else ()).astype(np.int32)
        block = np.concatenate((leaves, events.block))
        order = np.argsort(block, kind="stable")
        changes = np.concatenate((events.initial_mode[leaves], events.mode))[order]
        self.spent += [run.stats.n_steps, run.stats.n_rejected, run.stats.n_products, len(block)]
        elapsed = float(events.t[-1]) if len(events) else 0.0
        return _Event(events.initial_mode, run.z, block[order], changes, elapsed)

    def _sample(self, t: float, end: float, z: Floats) -> None:
        """The samples from a time to another, between which all blocks ride the belt."""
        samples = self.task.samples
        last = len(samples.t) if end == self.task.t_end else int(np.searchsorted(samples.t, end))
        rows = slice(int(np.searchsorted(samples.t, t)), last)
        samples.z[rows] = z + (samples.t[rows] - t)[:, np.newaxis] * self.speed
        samples.w[rows] = self.speed
