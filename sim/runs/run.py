"""What `simulate` returns: a run, with its cost and the state at given times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs import show
from stickslip.sim.runs.series import EventSeries

if TYPE_CHECKING:
    from stickslip.sim.runs.show import Axes

Outcome = Literal["finished", "collapsed", "diverged"]


class IntegrationError(RuntimeError):
    """An engine could not go on; the message names the time, the block and what to try."""


class StalledError(IntegrationError):
    """No step that is not lost in the rounding of time leads on."""


@dataclass(frozen=True)
class Stats:
    """The cost of a run: steps, rejected steps, products of K (and of N, see `System`) with a vector, events.

    `method` is that of the engine, if it has several, and `n_restarts` says how often another one came to a stop, and
    the run was begun anew. The cost of that is included.
    """

    n_steps: int
    n_rejected: int
    n_products: int
    n_events: int
    method: str = ""
    n_restarts: int = field(default=0, repr=False)

    def after(self, stopped: Stats) -> Stats:
        """Of a run that was begun anew, from those of its first attempt."""
        return replace(
            self,
            n_steps=self.n_steps + stopped.n_steps,
            n_rejected=self.n_rejected + stopped.n_rejected,
            n_products=self.n_products + stopped.n_products,
            n_restarts=self.n_restarts + 1,
        )


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
        """Arrays for the state at times `t`, NaN until it is known."""
        z, w = np.full((2, len(t), n), np.nan) if len(t) else np.empty((2, 0, n))
        return cls(t, z, w)

    def first(self, m: int) -> Samples:
        """The first m samples."""
        return self if m == len(self.t) else Samples(self.t[:m], self.z[:m], self.w[:m])

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        where = f" on [{self.t[0]:g}, {self.t[-1]:g}]" if len(self) else ""
        return f"Samples(n={self.z.shape[1]}, {len(self)} times{where})"


@dataclass(frozen=True, eq=False)
class Stills:
    """The ends of all-stuck intervals: when all blocks come to stick, or one leaves, and where they are then.

    A start at which all blocks stick counts.

    Attributes
    ----------
    t : float64, shape (m,)
        Never decreasing.
    total : float64, shape (m,)
        Sum of z over the blocks.
    """

    t: Floats
    total: Floats


class Loaded(NamedTuple):
    """The events of a run whose belt waits while any block slips: see `stickslip.sim.engines.adiabatic`.

    Attributes
    ----------
    t : float64, shape (m,)
        When friction gives way, by the travel of the belt; never decreasing.
    elapsed : float64, shape (m,)
        How long the motion takes, by its own clock.
    size, moment, first_block, z_sum : shape (m,)
        As in `stickslip.sim.episodes.Episodes`.
    """

    t: Floats
    elapsed: Floats
    size: NDArray[np.int32]
    moment: Floats
    first_block: NDArray[np.int32]
    z_sum: Floats


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
        The time from which on it is certain that no block sticks again; None if the run did not collapse.
    samples : Samples
        The state at those times of ``t_eval`` that the run reached.
    stills : Stills or None
        All-stuck intervals, for `stickslip.sim.episodes`; None if the engine does not record them.
    loaded : Loaded or None
        The events under adiabatic loading; None of a belt that moves.
    by_threshold : mapping of float to EventSeries
        The events by each of the further definitions of sticking, ``thresholds`` of the sigmoid engine.

    Raises
    ------
    IntegrationError
        If the state at the end is not finite, and the run has not diverged: an engine may not have noticed.
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
    stills: Stills | None = None
    loaded: Loaded | None = None
    by_threshold: Mapping[float, EventSeries] = field(default_factory=dict)

    def __post_init__(self) -> None:
        finite = np.isfinite(self.z) & np.isfinite(self.w)
        if self.outcome != "diverged" and not finite.all():
            where = f"block {int(finite.argmin())} has no finite state at t = {self.t_end:g}"
            raise IntegrationError(f"{where}; take a smaller step or tolerance, or another engine")

    def n_stick(self, times: ArrayLike) -> NDArray[np.int32]:
        """Number of sticking blocks at given times; see `EventSeries.n_stick`."""
        return self.events.n_stick(times)

    def plot(self, kind: str = "n_stick", ax: Axes | None = None, **options: Any) -> Axes:
        """Draw a picture of the run with matplotlib.

        Parameters
        ----------
        kind : str
            - ``"n_stick"``: n_stick(t) as steps.
            - ``"space_time"``: which block slips when, and which way, from the exact events. ``width``: length of the
              rows of a grid, which are then set apart.
            - ``"slip"``: how often each block of a grid, of rows of ``width`` blocks, began to slip.
            - ``"time"``: displacements, or ``of="w"`` velocities, of some ``blocks`` against time; default: the first
              three.
            - ``"phase"``: velocity against displacement of a ``block``; default: 0.
            - ``"spectrum"``: power spectral density of n_stick, or of the velocity of a ``block``.

            "time", "phase" and the spectrum of a block need samples, ``simulate(..., t_eval=times)``, that of a block
            at equal distances.
        ax : matplotlib Axes, optional
            Where to draw; default: a new pyplot figure in matplotlib's own style, whatever the session has set. Axes
            of your own have yours.
        **options
            Those of the kind, and ``span``, two times between which to draw, such as the start and end of an episode.
            Other names are properties of the lines, such as ``color``.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        ValueError
            If the kind is unknown or needs samples that the run does not have, or an option has no such value.
        TypeError
            If an option is unknown to the kind, or of the wrong type.
        """
        return show.plot(self.events, self.samples, kind, ax, options)

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
        return f"<div>{show.table('run', rows)}{show.html(self.events)}</div>"
