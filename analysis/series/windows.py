"""n_stick of many runs, each on its window of time, in flat arrays: what is summed over windows is summed here.

The levels of run k are those from `first[k]` to `first[k + 1]`; each holds from its `t` to the next one's, the last
one to t_stop[k]. A run has at least one level, so that no part of the arrays is empty. What is found of a run does
not depend on the runs beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

#: Change points of n_stick of a run: t and n_stick, each shape (m,); n_stick[k] holds on [t[k], t[k+1]), the last for
#: ever.
ChangePoints = tuple[np.ndarray, np.ndarray]


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
        lengths = np.diff(self.first)[some]
        first = np.concatenate(([0], np.cumsum(lengths)))
        places = np.repeat(self.first[some] - first[:-1], lengths) + np.arange(first[-1])
        return Windows(self.t_start, self.t_stop[some], first, self.t[places], self.level[places])

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
        length = self.span / count
        holds = self.at(count)  # at each edge of a part
        edges = self.t_start + length[:, None] * np.arange(count + 1)
        after = self.level[holds] * (self.t[holds] + self.lasted[holds] - edges)  # the level's area behind the edge
        begun = np.bincount(self._cell(count), self.level * self.lasted, len(self) * (count + 1))
        return (after[:, :-1] - after[:, 1:] + begun.reshape(len(self), -1)[:, 1:]) / length[:, None]

    def at(self, count: int) -> np.ndarray:
        """Place of the level that holds at t_start + k span / count, k = 0, ..., count, shape (R, count + 1)."""
        begun = np.bincount(self._cell(count), minlength=len(self) * (count + 1)).reshape(len(self), -1)
        return self.first[:-1, None] - 1 + np.cumsum(begun, axis=1)

    def _cell(self, count: int) -> np.ndarray:
        """Number of the first edge of `count` parts at or after each level's beginning, counted over all runs."""
        length = (self.span / count)[self.run]
        k = np.ceil((self.t - self.t_start) / length)
        k -= self.t_start + length * (k - 1) >= self.t  # corrects the rounding of the quotient
        k += self.t_start + length * k < self.t
        k[self.first[:-1]] = 0
        return self.run * (count + 1) + np.minimum(k, count).astype(np.int64)

    @cached_property
    def step(self) -> np.ndarray:
        """Change of n_stick to each level from the one before, shape (M,); 0 at the first level of a run."""
        found = np.diff(self.level, prepend=0)
        found[self.first[:-1]] = 0
        return found

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


def windows(series: Sequence[ChangePoints], t_start: float, t_stop: Sequence[float]) -> Windows:
    """Series of change points restricted to [t_start, t_stop], each to its own t_stop.

    Parameters
    ----------
    series : sequence of ChangePoints
        At least one. Times do not decrease; the first of each series is at or before `t_start`. Repeated values of
        n_stick are allowed and change nothing.
    t_start : float
    t_stop : sequence of float
        Each later than `t_start`.

    Raises
    ------
    NoSeries
        If shapes differ, values are not integers, times decrease, or a window is empty or starts before its series;
        it names the place of the series, counted from 0.
    """
    ends = np.array(t_stop, dtype=np.float64)
    for k, ((times, values), end) in enumerate(zip(series, t_stop, strict=True)):
        _check_form(k, np.asarray(times), np.asarray(values), t_start, end)
    t = np.concatenate([points[0] for points in series]).astype(np.float64, copy=False)
    level = np.concatenate([points[1] for points in series]).astype(np.int64, copy=False)
    first = np.concatenate(([0], np.cumsum([len(points[0]) for points in series])))
    run = np.repeat(np.arange(len(series)), np.diff(first))
    is_wrong = np.append(False, t[1:] < t[:-1])
    is_wrong[first[:-1]] = False
    is_wrong |= ~np.isfinite(t)
    if is_wrong.any():
        k = int(run[np.argmax(is_wrong)])
        raise NoSeries(k, "t: expected finite times that do not decrease; sort the change points by time")
    late = t[first[:-1]] > t_start
    if late.any():
        k = int(np.argmax(late))
        raise NoSeries(k, f"t: expected a change point at or before t_start = {t_start!r}, first is {t[first[k]]!r}")
    held = np.add.reduceat((t <= t_start).astype(np.int64), first[:-1]) + first[:-1] - 1  # what holds at t_start
    kept = (np.arange(len(t)) >= held[run]) & ((t <= ends[run]) | (np.arange(len(t)) == held[run]))
    t[held] = t_start
    t, level, run = t[kept], level[kept], run[kept]
    moved = np.append(True, (level[1:] != level[:-1]) | (run[1:] != run[:-1]))
    run = run[moved]
    return Windows(t_start, ends, np.searchsorted(run, np.arange(len(series) + 1)), t[moved], level[moved])


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


def _check_form(k: int, t: np.ndarray, n_stick: np.ndarray, t_start: float, t_stop: float) -> None:
    if t.ndim != 1 or t.shape != n_stick.shape or t.size == 0:
        raise NoSeries(
            k, f"t, n_stick: expected two non-empty arrays of one length, got {t.shape} and {n_stick.shape}"
        )
    if n_stick.dtype.kind not in "iu":
        raise NoSeries(k, f"n_stick: expected integers, got dtype {n_stick.dtype}")
    if not t_start < t_stop:
        raise NoSeries(k, f"t_start: expected t_start < t_stop, got {t_start!r} and {t_stop!r}")
