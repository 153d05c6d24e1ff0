"""n_stick of many runs, each on its window of time, in flat arrays: what is summed over windows is summed here.

The levels of run k are those from `first[k]` to `first[k + 1]`; each holds from its `t` to the next one's, the last
one to t_stop[k]. A run has at least one level, so that no part of the arrays is empty. What is found of a run does
not depend on the runs beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

#: Change points of n_stick of a run: t and n_stick, each shape (m,); n_stick[k] holds on [t[k], t[k+1]), the last for
#: ever.
ChangePoints = tuple[np.ndarray, np.ndarray]
_MANY = 40  # levels for each edge from which on looking edges up is faster than counting levels


@dataclass(frozen=True)
class Stack:
    """Change points of R runs, one run after the other, M together.

    Attributes
    ----------
    first : ndarray of int, shape (R + 1,)
        Place of the first change point of each run; M at the end. Each has at least one.
    t : ndarray, shape (M,), float64
    n_stick : ndarray of int, shape (M,)
    """

    first: np.ndarray
    t: np.ndarray
    n_stick: np.ndarray

    @classmethod
    def of(cls, series: Sequence[ChangePoints]) -> Stack:
        """Of runs one by one.

        Raises
        ------
        NoSeries
            If shapes differ, a series is empty, times are no numbers, or values are no integers.
        """
        for k, (times, values) in enumerate(series):
            _check_form(k, np.asarray(times), np.asarray(values))
        firsts = np.concatenate(([0], np.cumsum([len(times) for times, _ in series], dtype=np.int64)))
        t = np.concatenate([np.zeros(0), *(times for times, _ in series)])
        return cls(firsts, t, np.concatenate([np.zeros(0, np.int64), *(values for _, values in series)]))

    @classmethod
    def joined(cls, some: Sequence[Stack]) -> Stack:
        """Several, one after the other; at least one."""
        if len(some) == 1:
            return some[0]
        lengths = np.concatenate([np.diff(stack.first) for stack in some])
        t, n_stick = (np.concatenate([getattr(stack, name) for stack in some]) for name in ("t", "n_stick"))
        return cls(np.concatenate(([0], np.cumsum(lengths))), t, n_stick)

    def __len__(self) -> int:
        return len(self.first) - 1

    def part(self, begin: int, end: int) -> Stack:
        """Neighbouring runs."""
        firsts = self.first[begin : end + 1]
        inside = slice(firsts[0], firsts[-1])
        return Stack(firsts - firsts[0], self.t[inside], self.n_stick[inside])

    def take(self, some: np.ndarray) -> Stack:
        """Some of the runs, by their places."""
        firsts, places = ranges(self.first[some], np.diff(self.first)[some])
        return Stack(firsts, self.t[places], self.n_stick[places])

    @property
    def last(self) -> tuple[np.ndarray, np.ndarray]:
        """t and n_stick of the last change point of each run, shape (R,)."""
        return self.t[self.first[1:] - 1], self.n_stick[self.first[1:] - 1]


def in_parts(stacks: Iterable[Stack], most_runs: int, most_points: int) -> Iterator[Stack]:
    """The same runs in the same order, in parts of so many runs and change points at most, or of one run."""
    waiting: list[Stack] = []
    n_runs = n_points = 0
    for stack in stacks:
        begin = 0
        while begin < len(stack):
            room = most_points - n_points + stack.first[begin]
            end = min(int(np.searchsorted(stack.first, room, side="right")) - 1, begin + most_runs - n_runs)
            if end <= begin and waiting:
                yield Stack.joined(waiting)
                waiting, n_runs, n_points = [], 0, 0
                continue
            end = max(end, begin + 1)
            waiting.append(stack.part(begin, min(end, len(stack))))
            n_runs, n_points = n_runs + len(waiting[-1]), n_points + len(waiting[-1].t)
            begin = end
    if waiting:
        yield Stack.joined(waiting)


def steps_to(t: np.ndarray, start: float, step: np.ndarray | float) -> np.ndarray:
    """The least whole numbers k for which start + k step is at or after t, of the shape of t, float64."""
    k = np.ceil((t - start) / step)
    k -= start + step * (k - 1) >= t  # corrects the rounding of the quotient
    k += start + step * k < t
    return k


def ranges(first: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where ranges of places begin if they are laid end to end, with the whole length at the end; and all places."""
    begins = np.concatenate(([0], np.cumsum(lengths)))
    return begins, np.repeat(first - begins[:-1], lengths) + np.arange(begins[-1])


@dataclass(frozen=True)
class Windows:
    """n_stick of R runs on [t_start, t_stop], with M levels together.

    Attributes
    ----------
    t_start : float
        Start of all windows (dimensionless).
    t_stop : ndarray, shape (R,), float64
        Their ends.
    first : ndarray, shape (R + 1,), int64
        Place of the first level of each run; M at the end.
    t : ndarray, shape (M,), float64
        When each level begins; a run's first one at t_start.
    level : ndarray, shape (M,), int64
        n_stick from then on. Neighbours of one run differ.
    """

    t_start: float
    t_stop: np.ndarray
    first: np.ndarray
    t: np.ndarray
    level: np.ndarray

    def __len__(self) -> int:
        return len(self.t_stop)

    def take(self, some: np.ndarray) -> Windows:
        """Some of the runs, by their places."""
        firsts, places = ranges(self.first[some], np.diff(self.first)[some])
        return Windows(self.t_start, self.t_stop[some], firsts, self.t[places], self.level[places])

    @property
    def span(self) -> np.ndarray:
        """Length of each window, shape (R,)."""
        return self.t_stop - self.t_start

    @cached_property
    def run(self) -> np.ndarray:
        """The run of each level, shape (M,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    @cached_property
    def lasted(self) -> np.ndarray:
        """How long each level holds, shape (M,)."""
        ends = np.empty_like(self.t)
        ends[:-1] = self.t[1:]
        ends[self.first[1:] - 1] = self.t_stop
        return ends - self.t

    def total(self, of_levels: np.ndarray) -> np.ndarray:
        """Sums over the levels of each run, shape (R,)."""
        return np.add.reduceat(of_levels, self.first[:-1])

    @cached_property
    def mean(self) -> np.ndarray:
        """Exact time mean of n_stick, shape (R,)."""
        return self.total(self._share * self.level)

    @cached_property
    def variance(self) -> np.ndarray:
        """Exact variance over time of n_stick, shape (R,)."""
        return self.total(self._share * (self.level - self.mean[self.run]) ** 2)

    @cached_property
    def _share(self) -> np.ndarray:
        """How long each level holds, as a part of its window."""
        return self.lasted / self.span[self.run]

    def means(self, count: int) -> np.ndarray:
        """Exact time means of n_stick over `count` equal parts of each window, shape (R, count)."""
        length = self.span[:, None] / count
        return self._means(self.t_start + length * np.arange(count + 1), self.at(count), length)

    def means_of_ends(self, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Exact time means of n_stick over the first and the last part of each window, shape (R, 2).

        Their lengths, shape (R,), are not more than the window's together.
        """
        start = np.full(len(self), self.t_start)
        begin = np.maximum(self.t_stop - last, start + first)  # rounded
        edges = np.column_stack([start, start + first, begin, self.t_stop])
        places = self._looked_up(edges)
        places[:, -1] = self.first[1:] - 1
        return self._means(edges, places, np.column_stack([first, np.ones(len(self)), last]))[:, ::2]

    def _means(self, edges: np.ndarray, places: np.ndarray, length: np.ndarray) -> np.ndarray:
        """Means over parts from edge to edge, the last at t_stop; `places` are of the levels that hold there."""
        base = self.level[self.first[:-1]]  # areas are those above it, so that what is constant has no rounding
        height = self.level - base[self.run]
        behind = height[places] * (self.t[places] + self.lasted[places] - edges)  # the level's area behind the edge
        starts = np.column_stack([self.first[:-1], places[:, :-1] + 1])  # of the levels that begin within each part
        area_begun = np.add.reduceat(np.append(height * self.lasted, 0.0), starts.ravel()).reshape(starts.shape)[
            :, 1:
        ]
        areas = behind[:, :-1] - behind[:, 1:] + np.where(places[:, 1:] > places[:, :-1], area_begun, 0.0)
        return np.asarray(base[:, None] + areas / length)

    def at(self, count: int) -> np.ndarray:
        """Place of the level that holds at t_start + k span / count, k = 0, ..., count, shape (R, count + 1)."""
        edges = self.t_start + self.span[:, None] / count * np.arange(count + 1)
        places = self._looked_up(edges) if len(self.t) > _MANY * edges.size else self._counted(edges)
        places[:, -1] = self.first[1:] - 1  # t_stop may be rounded
        return places

    def _looked_up(self, edges: np.ndarray) -> np.ndarray:
        """`at`, by looking up each edge among the levels."""
        runs = zip(edges, self.first[:-1].tolist(), self.first[1:].tolist(), strict=True)
        return np.array(
            [
                begin - 1 + np.searchsorted(self.t[begin:end], run_edges, side="right")
                for run_edges, begin, end in runs
            ]
        )

    def _counted(self, edges: np.ndarray) -> np.ndarray:
        """`at`, by counting the levels that begin up to each edge."""
        n_edges = edges.shape[1]
        length = (self.span / (n_edges - 1))[self.run]
        k = steps_to(self.t, self.t_start, length)
        k[self.first[:-1]] = 0
        cell = self.run * n_edges + np.minimum(k, n_edges - 1).astype(np.int64)
        counts = np.bincount(cell, minlength=edges.size).reshape(edges.shape)
        return self.first[:-1, None] - 1 + np.cumsum(counts, axis=1)

    @cached_property
    def step(self) -> np.ndarray:
        """Change of n_stick to each level from the one before, shape (M,); 0 at the first level of a run."""
        steps = np.diff(self.level, prepend=0)
        steps[self.first[:-1]] = 0
        return steps

    @property
    def exits(self) -> np.ndarray:
        """Sum of the falls of n_stick, shape (R,)."""
        return self.total(np.maximum(-self.step, 0))

    @cached_property
    def falls(self) -> tuple[np.ndarray, np.ndarray]:
        """Run and depth of each complete fall: steps down between two steps up."""
        is_first = np.zeros(len(self.step), dtype=bool)
        is_first[self.first[:-1]] = True  # a step of 0, which parts the runs
        down = self.step < 0
        start = np.flatnonzero(is_first | (down != np.append(False, down[:-1])))
        complete = down[start] & ~is_first[start - 1] & np.append(~is_first[start[1:]], False)
        depth = -np.add.reduceat(self.step, start)
        return self.run[start[complete]], depth[complete]


def windows(series: Stack, t_start: float, t_stop: ArrayLike) -> Windows:
    """Series of change points restricted to [t_start, t_stop], each to its own t_stop.

    Parameters
    ----------
    series : Stack
        Of at least one run. Times do not decrease; the first of each is at or before `t_start`. Repeated values of
        n_stick are allowed and change nothing.
    t_stop : array_like, shape (R,)
        Each later than `t_start`.

    Raises
    ------
    NoSeries
        If times decrease, or a window is empty or starts before its series; it names the place of the series,
        counted from 0.
    """
    ends = np.array(t_stop, dtype=np.float64)
    if not (t_start < ends).all():
        k = int(np.argmin(t_start < ends))
        raise NoSeries(k, f"t_start: expected t_start < t_stop, got {t_start!r} and {float(ends[k])!r}")
    firsts, t, level = series.first, series.t, series.n_stick.astype(np.int64, copy=False)
    is_wrong = np.append(False, t[1:] < t[:-1])
    is_wrong[firsts[:-1]] = False
    is_wrong |= ~np.isfinite(t)
    if is_wrong.any():
        k = int(np.searchsorted(firsts, np.argmax(is_wrong), side="right")) - 1
        raise NoSeries(k, "t: expected finite times that do not decrease; sort the change points by time")
    late = t[firsts[:-1]] > t_start
    if late.any():
        k = int(np.argmax(late))
        raise NoSeries(
            k, f"t: expected a change point at or before t_start = {t_start!r}, first is {float(t[firsts[k]])!r}"
        )
    is_before = t <= t_start
    is_kept = np.append(True, level[1:] != level[:-1]) & ~is_before & (t <= np.repeat(ends, np.diff(firsts)))
    is_kept[firsts[:-1] + np.add.reduceat(is_before, firsts[:-1], dtype=np.int64) - 1] = True  # holds at t_start
    begins = np.concatenate(([0], np.cumsum(np.add.reduceat(is_kept, firsts[:-1], dtype=np.int64))))
    t, level = t[is_kept], level[is_kept]
    t[begins[:-1]] = t_start
    return Windows(t_start, ends, begins, t, level)


class NoSeries(ValueError):
    """Raised for change points that are none.

    Attributes
    ----------
    place : int
        Which of the series, from 0.
    """

    def __init__(self, place: int, message: str) -> None:
        super().__init__(message)
        self.place = place


def _check_form(k: int, t: np.ndarray, n_stick: np.ndarray) -> None:
    if t.ndim != 1 or t.shape != n_stick.shape or t.size == 0:
        raise NoSeries(
            k, f"t, n_stick: expected two non-empty arrays of one length, got {t.shape} and {n_stick.shape}"
        )
    if t.dtype.kind not in "iuf":
        raise NoSeries(k, f"t: expected numbers, got dtype {t.dtype}; give times")
    if n_stick.dtype.kind not in "iu":
        raise NoSeries(k, f"n_stick: expected integers, got dtype {n_stick.dtype}")
