"""One run: a system and a start in, an event series out. The contract that both engines keep.

An engine is a function ``integrate(system, z0, w0, t_start, t_end, samples, **settings) -> Run`` such that

1. the state is float64, arguments are not changed, and the same arguments give the same run;
2. the series holds every change of mode on [t_start, t_end], in order of time and, at one instant, of block;
3. what happens at one instant is decided together: no order of the blocks enters, and renumbering the blocks
   renumbers the run;
4. a run is `finished` at the t_end asked for; `collapsed` when no block can stick again (proved, see `sim.fate`): its
   motion from there is linear, and followed to t_end; `diverged` when it escapes for ever (proved, or beyond every
   bound): then, and only then, the run ends early;
5. what the engine cannot carry through raises `IntegrationError`, which names the time and the block;
6. samples of the state are read off the steps, by series or cubics: asking for them changes nothing else;
7. an event has a length: what a block takes back sooner than the tolerance can tell from a touch is none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim import show
from stickslip.sim.arguments import Floats, did_you_mean, floats, number, per_block
from stickslip.sim.series import EventSeries
from stickslip.sim.system import System

if TYPE_CHECKING:
    from stickslip.sim.show import Axes

Outcome = Literal["finished", "collapsed", "diverged"]
Engine = Literal["coulomb", "sigmoid"]


class IntegrationError(RuntimeError):
    """An engine could not go on; the message names the time, the block and what to try."""


@dataclass(frozen=True)
class Stats:
    """What a run cost: steps taken, steps rejected, products of K (and of N, see `System`) with a vector, events."""

    n_steps: int
    n_rejected: int
    n_products: int
    n_events: int


@dataclass(frozen=True, eq=False)
class Samples:
    """The state at given times.

    Attributes
    ----------
    t : float64, shape (m,)
    z, w : float64, shape (m, n)
    """

    t: Floats
    z: Floats
    w: Floats

    @classmethod
    def blank(cls, t: Floats, n: int) -> Samples:
        """Room for the state at times `t`; NaN until it is known."""
        return cls(t, np.full((len(t), n), np.nan), np.full((len(t), n), np.nan))

    def first(self, m: int) -> Samples:
        """The first m of them."""
        return Samples(self.t[:m], self.z[:m], self.w[:m])

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        where = f" on [{self.t[0]:g}, {self.t[-1]:g}]" if len(self) else ""
        return f"Samples(n={self.z.shape[1]}, {len(self)} times{where})"


@dataclass(frozen=True, eq=False)
class Run:
    """The result of `simulate` (dimensionless).

    Attributes
    ----------
    z, w : float64, shape (n,)
        Displacements and velocities at `t_end`.
    t_end : float
        The time asked for; earlier if the run diverged.
    events : EventSeries
        On [t_start, t_end].
    outcome : "finished", "collapsed" or "diverged"
    reason : str
        How a run collapsed or diverged; empty for a finished run.
    stats : Stats
    t_collapse : float or None
        From when on it is certain that no block sticks again; None if the run did not collapse.
    samples : Samples
        The state at those times of ``t_eval`` that the run reached.
    by_threshold : mapping of float to EventSeries
        What sticks by each of the further definitions ``thresholds`` of the sigmoid engine.
    """

    z: Floats
    w: Floats
    t_end: float
    events: EventSeries
    outcome: Outcome
    reason: str
    stats: Stats
    t_collapse: float | None = None
    samples: Samples = field(default_factory=lambda: Samples.blank(np.empty(0), 0))
    by_threshold: Mapping[float, EventSeries] = field(default_factory=dict)

    def n_stick(self, times: ArrayLike) -> NDArray[np.int32]:
        """Number of sticking blocks at given times; see `EventSeries.n_stick`."""
        return self.events.n_stick(times)

    def plot(self, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw n_stick(t) on the axes given or on new ones; returns them. `style` goes to `Axes.step`."""
        return show.draw_n_stick(self.events, ax, style)

    def __repr__(self) -> str:
        return f"Run({self._ended()}, n = {self.events.n}, {self.stats.n_events} events)"

    def _ended(self) -> str:
        return f"{self.outcome} at t = {self.t_end if self.t_collapse is None else self.t_collapse:g}"

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {"blocks": self.events.n, "outcome": self._ended()}
        if self.reason:
            rows["reason"] = self.reason
        rows["n_stick at the end"] = int(self.n_stick(self.events.t_end))
        rows |= {name.removeprefix("n_"): count for name, count in self.events.counts().items()}
        rows["steps"] = f"{self.stats.n_steps}, {self.stats.n_rejected} rejected"
        rows["products"] = self.stats.n_products
        return show.table("run", rows)


def simulate(
    system: System,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    *,
    t_start: float = 0.0,
    t_eval: ArrayLike = (),
    engine: Engine = "coulomb",
    **settings: object,
) -> Run:
    """Follow a system of blocks from a start state to `t_end` (dimensionless).

    Parameters
    ----------
    system : System
    z0, w0 : float or array_like, shape (n,)
        Displacements and velocities at `t_start`.
    t_end, t_start : float
    t_eval : array_like, shape (m,)
        Times in [t_start, t_end], not decreasing, at which to keep the state: see `Run.samples`.
    engine : "coulomb" or "sigmoid"
        The exact set-valued law, or mu tanh((w - v) / (ratio eps)) in its place.
    **settings
        both: ``stop_early`` (True: ask whether a collapse or an escape is certain; a run that collapsed then goes on
        without steps, one that escapes ends); coulomb: ``tol`` (see
        `stickslip.sim.coulomb.integrate`);
        sigmoid: ``eps``, ``ratio``, ``rtol``, ``atol``, ``stick``, ``threshold``, ``thresholds`` (see
        `stickslip.sim.sigmoid.integrate`).

    Returns
    -------
    Run

    Raises
    ------
    TypeError, ValueError
        If an argument is unknown, or of the wrong kind, shape or size; the message names it.
    IntegrationError
        If the engine cannot go on.
    """
    from stickslip.sim import coulomb, sigmoid  # the engines build on this contract

    engines: dict[str, Callable[..., Run]] = {"coulomb": coulomb.integrate, "sigmoid": sigmoid.integrate}
    if not isinstance(system, System):
        raise TypeError(f"system: expected a sim.System, got {type(system).__name__}")
    if engine not in get_args(Engine):
        raise ValueError(f"engine: expected one of {', '.join(get_args(Engine))}, got {engine!r}")
    _check_names(settings, engine, engines)
    t_start, t_end = number("t_start", t_start), number("t_end", t_end)
    if t_end < t_start:
        raise ValueError(f"t_end: expected a time not before t_start = {t_start}, got {t_end}")
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    times = floats("t_eval", t_eval, "an array of times")
    if times.ndim != 1 or not (np.diff(times) >= 0).all() or not ((times >= t_start) & (times <= t_end)).all():
        raise ValueError(
            f"t_eval: expected times in [{t_start:g}, {t_end:g}] in rising order, got {t_eval!r}; sort them,"
            " and leave out what lies outside"
        )
    return engines[engine](system, z, w, t_start, t_end, Samples.blank(times, system.n), **settings)


def _check_names(settings: Mapping[str, object], engine: str, engines: Mapping[str, Callable[..., Run]]) -> None:
    """TypeError for a setting that the engine does not take; it says what does, or what may have been meant."""
    takes = {name: _keywords(integrate) for name, integrate in engines.items()}
    for name in settings:
        if name not in takes[engine]:
            other = next((other for other in engines if name in takes[other]), None)
            remedy = did_you_mean(name, takes[engine] + _keywords(simulate))
            remedy = remedy or (f'; write engine="{other}"' if other else "; leave it out")
            known = ", ".join(takes[engine])
            raise TypeError(f'{name}: unknown to the engine "{engine}", which takes {known}{remedy}')


@cache  # small systems run in milliseconds
def _keywords(function: Callable[..., Run]) -> tuple[str, ...]:
    parameters = signature(function).parameters.values()
    return tuple(parameter.name for parameter in parameters if parameter.kind is Parameter.KEYWORD_ONLY)
