"""Cascade sizes by named definition, from the change points of n_stick.

`n_stick[k]` holds on `[t[k], t[k+1])`, the last value to the end of the run. Every definition looks for maximal runs
of falling steps of n_stick. They differ in what a step is and in what is added up:

===========  =============================================  ==================================
definition   steps                                          size of a run
===========  =============================================  ==================================
events       every change, no sampling                      blocks let go
drop         samples every dt                               blocks let go
length       samples every dt                               number of falling steps
descent      samples every dt, steps without change erased  blocks let go
decreases    samples every dt, steps without change erased  number of falling steps
===========  =============================================  ==================================

On samples, a cascade by `drop` or `length` ends at a plateau (a step without change); `descent` and `decreases` are
the same two with plateaus allowed inside a fall. `events` has no plateaus: a change point without change is no step.

All events at one instant are one change of n_stick: k exits are a step by -k, and an exit and an entry at the same
instant cancel, so that no definition sees them. (Exact runs of random systems have no two events at one instant:
none among 220,000 in 20 runs of n = 200.)

A cascade that touches the first or the last step of the window is incomplete and is dropped.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stickslip.analysis import arguments
from stickslip.analysis.series.windows import Stack, Windows, steps_to, windows

SAMPLED = ("drop", "length", "descent", "decreases")
DEFINITIONS = ("events", *SAMPLED)


@dataclass(frozen=True, order=True)
class Law:
    """Names a law of sizes: the definition of size and, for those of `SAMPLED`, the sampling step.

    Raises
    ------
    ValueError
        If the step is not a finite number > 0.
    """

    definition: str
    dt: float | None = None

    def __post_init__(self) -> None:
        if self.dt is not None and not 0.0 < arguments.number("dt", self.dt, "a finite number > 0") < np.inf:
            raise ValueError(f"dt: expected a finite number > 0, got {self.dt!r}; give a sampling step, as 0.5")

    def __str__(self) -> str:
        return self.definition if self.dt is None else f"{self.definition}, dt = {self.dt:g}"


EVENTS = Law("events")


def laws(dts: Iterable[float]) -> list[Law]:
    """The laws of every definition, for the sampled ones at each step of `dts`."""
    return [EVENTS, *(Law(name, dt) for name in SAMPLED for dt in dts)]


@dataclass(frozen=True)
class Window:
    """n_stick on [t_start, t_stop]: its level at t_start and each later change.

    Attributes
    ----------
    t_start, t_stop : float
        Ends of the window (dimensionless).
    level : int
        n_stick at t_start.
    t : ndarray, shape (m,), float64
        Times of the changes in (t_start, t_stop], not decreasing.
    step : ndarray, shape (m,), int64
        The changes of n_stick, none of them zero.
    """

    t_start: float
    t_stop: float
    level: int
    t: np.ndarray
    step: np.ndarray

    def __repr__(self) -> str:
        return f"Window([{self.t_start:g}, {self.t_stop:g}], {len(self.t)} changes from n_stick = {self.level})"

    def path(self) -> np.ndarray:
        """n_stick before the first change and after each, shape (m + 1,)."""
        return self._path

    @cached_property
    def _path(self) -> np.ndarray:
        path = np.empty(len(self.step) + 1, dtype=np.int64)
        path[0] = self.level
        np.cumsum(self.step, out=path[1:])
        path[1:] += self.level
        return path

    def n_steps(self, dt: float) -> int:
        """Number of steps of dt in the window: samples are taken at t_start + k dt, k = 0, ..., n_steps."""
        # without the relative slack, rounding of (t_stop - t_start) / dt could lose the last sample
        return int(np.floor((self.t_stop - self.t_start) / dt * (1 + 1e-12)))

    def places(self, dt: float) -> np.ndarray:
        """Number of the first sample at or after each change; it may lie beyond the last sample."""
        return steps_to(self.t, self.t_start, dt).astype(np.int64)

    def grid_index(self, dt: float) -> np.ndarray:
        """Number of changes up to and at each sample time: an index into `path()`."""
        n_samples = self.n_steps(dt) + 1
        return np.cumsum(np.bincount(self.places(dt), minlength=n_samples)[:n_samples])

    def sampled(self, dt: float) -> np.ndarray:
        """Change of n_stick in each step of dt."""
        n_samples = self.n_steps(dt) + 1
        return np.bincount(self.places(dt), self.step, n_samples)[1:n_samples]

    def time_mean(self) -> float:
        """Exact time mean of n_stick over the window."""
        return float(self.alone.mean[0])

    def time_variance(self) -> float:
        """Exact variance over time of n_stick in the window."""
        return float(self.alone.variance[0])

    def means(self, count: int) -> np.ndarray:
        """Exact time means of n_stick over `count` equal parts of the window, shape (count,)."""
        return self.alone.means(count)[0]

    @cached_property
    def alone(self) -> Windows:
        """This window as the only one of `Windows`."""
        t, firsts = np.concatenate(([self.t_start], self.t)), np.array([0, len(self.t) + 1])
        return Windows(self.t_start, np.array([self.t_stop]), firsts, t, self._path)


def window(t: np.ndarray, n_stick: np.ndarray, t_start: float, t_stop: float) -> Window:
    """A series of change points restricted to [t_start, t_stop].

    Parameters
    ----------
    t : array_like, shape (m,)
        Times of the change points (dimensionless), not decreasing; the first at or before `t_start`.
    n_stick : array_like of int, shape (m,)
        n_stick[k] holds on [t[k], t[k+1]). Repeated values are allowed and change nothing.
    t_start, t_stop : float
        Ends of the window, t_start < t_stop.

    Raises
    ------
    ValueError
        If shapes differ, values are no integers >= 0, times are no numbers or decrease, or the window is empty, has
        no end, or starts before the series.
    """
    begin, end = (arguments.number(name, x, "a time") for name, x in (("t_start", t_start), ("t_stop", t_stop)))
    if end == np.inf:
        raise ValueError(f"t_stop: expected a finite time, got {t_stop}; give the end of the run")
    runs = windows(Stack.of([(np.asarray(t), np.asarray(n_stick))]), begin, [end])
    if runs.level.min() < 0:
        raise ValueError(f"n_stick: expected numbers of blocks, >= 0, got {runs.level.min()}; correct them")
    return Window(begin, end, int(runs.level[0]), runs.t[1:], runs.step[1:])


def sample(t: np.ndarray, n_stick: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """n_stick at each time of `grid`; at a change, the new value.

    Raises
    ------
    ValueError
        If there is no change point, or a grid time lies before the first, or is not finite.
    """
    times, samples = (arguments.numbers(name, x, "times") for name, x in (("t", t), ("grid", grid)))
    if not times.size:
        raise ValueError("t: expected a change point or more, got none; the first is the start of the run")
    index = np.searchsorted(times, samples, side="right") - 1
    if (index < 0).any() or not np.isfinite(samples).all():
        raise ValueError(f"grid: expected finite times >= t[0] = {t[0]!r}, got {np.min(samples)!r}; leave out others")
    return np.asarray(n_stick)[index]


def falls(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First step of each maximal fall that has a rise or a plateau on both sides, and the step after its last.

    On the path before and after each step, they are the first and the last place of a fall.
    """
    falling = steps < 0
    turns = np.flatnonzero(falling[1:] != falling[:-1]) + 1
    turns = turns[int(falling[:1].any()) :]  # a fall may be cut by the start of the window, and one by its end
    return turns[: len(turns) // 2 * 2 : 2], turns[1::2]


def sizes(win: Window, law: Law) -> np.ndarray:
    """Sizes of the complete cascades of a window by one definition, in order of time.

    Raises
    ------
    ValueError
        If they are no window and no law, or the definition is not one of `DEFINITIONS`, or lacks its dt, or has one
        that it does not use.
    """
    win, law = arguments.instance("win", win, Window), arguments.instance("law", law, Law)
    if law.definition not in DEFINITIONS:
        raise ValueError(f"definition: expected one of {', '.join(DEFINITIONS)}, got {law.definition!r}")
    if (law.dt is None) == (law.definition in SAMPLED):
        raise ValueError(f"dt: expected a step for a sampled definition and None for `events`, got {law!r}")
    path = win.path()
    if law.dt is not None:
        path = path[win.grid_index(law.dt)]
    if law.definition in ("descent", "decreases"):
        path = path[np.concatenate(([True], np.diff(path) != 0))]
    start, stop = falls(np.diff(path))
    return stop - start if law.definition in ("length", "decreases") else path[start] - path[stop]


@dataclass(frozen=True)
class Spans:
    """Complete cascades by `events`, in order of time: size, time of the first exit and of the last, each (m,)."""

    size: np.ndarray
    start: np.ndarray
    stop: np.ndarray


def spans(win: Window) -> Spans:
    """Sizes, beginnings and ends of the complete cascades by `events`."""
    path = win.path()
    start, stop = falls(win.step)
    return Spans(path[start] - path[stop], win.t[start], win.t[stop - 1])


def sums(steps: np.ndarray, dt: float | None = None) -> dict[Law, np.ndarray]:
    """Total size and number of the complete cascades by law: the two columns that `estimates.gamma` takes.

    The same as adding up what `sizes` returns, but without making a list of the sizes.

    Parameters
    ----------
    steps : ndarray of int, shape (m,)
        Change of n_stick in each step of dt. Without dt, each change, and the only law is `events`.
    dt : float, optional
    """
    moving = _falls(steps[np.flatnonzero(steps != 0)])  # faster than by truth values
    if dt is None:
        return {EVENTS: moving[[0, 2]]}
    falling = _falls(steps)
    return {
        Law("drop", dt): falling[[0, 2]],
        Law("length", dt): falling[[1, 2]],
        Law("descent", dt): moving[[0, 2]],
        Law("decreases", dt): moving[[1, 2]],
    }


def _falls(steps: np.ndarray) -> np.ndarray:
    """Total depth, total number of steps and number of the complete falls in a series of steps, shape (3,)."""
    start, stop = falls(steps)
    depths = np.maximum(-steps[start[0] : stop[-1]], 0) if len(start) else np.zeros(0)
    return np.array([depths.sum(), np.count_nonzero(depths), len(start)], dtype=np.float64)
