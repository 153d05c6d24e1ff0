"""The record of a run: when each block entered, left or crossed the sticking mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs import show

if TYPE_CHECKING:
    from stickslip.sim.runs.show import Axes


@dataclass(frozen=True, eq=False)
class EventSeries:
    """The modes of n blocks as a series of events.

    Block i sticks (mode 0), slips right (+1) or left (-1). An event changes one block's mode:
    stick -> slip is an *exit*, slip -> stick an *entry*, + <-> - a *crossing*.

    Attributes
    ----------
    t : float64, shape (m,)
        Times of the events, never decreasing (dimensionless).
    block : int32, shape (m,)
    mode : int8, shape (m,)
        The block's mode from t on.
    initial_mode : int8, shape (n,)
        Modes right after `t_start`.
    t_start, t_end : float
        The series is complete on [t_start, t_end].
    names : tuple of str
        The names of the blocks; empty if they have none.
    unit : str
        That of t, as "s"; empty: dimensionless.
    """

    t: Floats
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    initial_mode: NDArray[np.int8]
    t_start: float
    t_end: float
    names: tuple[str, ...] = ()
    unit: str = ""

    @property
    def n(self) -> int:
        """Number of blocks."""
        return len(self.initial_mode)

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def by_block(self) -> NDArray[np.intp]:
        """The order of the events by block; those of one block keep their order."""
        return by_block(self.block)

    @cached_property
    def previous_mode(self) -> NDArray[np.int8]:
        """The mode that each event ended, int8, shape (m,)."""
        order = self.by_block
        block, mode = self.block[order], self.mode[order]
        before = self.initial_mode[block]
        np.copyto(before[1:], mode[:-1], where=block[1:] == block[:-1])
        previous = np.empty_like(before)
        previous[order] = before
        return previous

    @property
    def is_exit(self) -> NDArray[np.bool_]:
        """Whether each event ends a stick, shape (m,)."""
        return self.previous_mode == 0

    def counts(self) -> dict[str, int]:
        """Numbers of entries, exits and crossings."""
        return summaries([self])[0].counts

    def change_points(self) -> tuple[Floats, NDArray[np.int32]]:
        """Times at which n_stick changes, and its values: n_stick[k] holds on [t[k], t[k+1]).

        t[0] is `t_start`; events at one instant are merged, and an instant that does not change n_stick is no change
        point.
        """
        summary = summaries([self])[0]
        return summary.t, summary.n_stick

    def n_stick(self, times: ArrayLike) -> NDArray[np.int32]:
        """Number of sticking blocks at given times (the sticking codimension), right-continuous.

        Raises
        ------
        ValueError
            If a time lies outside [t_start, t_end].
        """
        times = self._known(times)
        t, n_stick = self.change_points()
        return n_stick[np.searchsorted(t, times, side="right") - 1]

    def mode_at(self, time: float) -> NDArray[np.int8]:
        """Modes of all blocks at one time, int8, shape (n,), right-continuous.

        Raises
        ------
        ValueError
            If the time is no number in [t_start, t_end].
        """
        if np.ndim(time) != 0:
            raise ValueError(f"time: expected one number, got {time!r}")
        self._known(time)
        return self.mode_after(int(np.searchsorted(self.t, time, side="right")))

    def modes_at(self, times: ArrayLike) -> NDArray[np.int8]:
        """Modes of all blocks at some times that do not decrease, int8, shape (m, n), right-continuous.

        Raises
        ------
        ValueError
            If a time lies outside [t_start, t_end].
        """
        upto = np.searchsorted(self.t, self._known(times), side="right")
        mode, first = self.initial_mode.copy(), 0
        modes = np.empty((len(upto), self.n), dtype=np.int8)
        for k, last in enumerate(upto.tolist()):
            mode[self.block[first:last]] = self.mode[first:last]
            modes[k], first = mode, last
        return modes

    def mode_after(self, k: int) -> NDArray[np.int8]:
        """Modes of all blocks after the first k events, int8, shape (n,)."""
        mode = self.initial_mode.copy()
        mode[self.block[:k]] = self.mode[:k]  # for a repeated block the last assignment holds
        return mode

    def _known(self, times: ArrayLike) -> Floats:
        array = np.asarray(times, dtype=np.float64)
        inside = (array >= self.t_start) & (array <= self.t_end)
        if not inside.all():
            raise ValueError(
                f"times: expected values in [{self.t_start}, {self.t_end}], where the series is known,"
                f" got {array[~inside].flat[0]}"
            )
        return array

    def of_blocks(self, chosen: NDArray[np.bool_]) -> EventSeries:
        """The series of some blocks alone, numbered from 0 in their order.

        Parameters
        ----------
        chosen : ndarray of bool, shape (n,)
        """
        if chosen.all():
            return self
        events, number = chosen[self.block], np.cumsum(chosen, dtype=np.int32) - 1
        block, names = number[self.block[events]], tuple(compress(self.names, chosen))
        return part_of(self, events, block=block, initial_mode=self.initial_mode[chosen], names=names)

    def plot(self, kind: str = "space_time", ax: Axes | None = None, **options: Any) -> Axes:
        """Draw "space_time", "n_stick" or the "spectrum" of n_stick; arguments and errors as of `Run.plot`."""
        return show.plot(self, None, kind, ax, options)

    def __repr__(self) -> str:
        return f"EventSeries(n={self.n}, {len(self)} events on [{self.t_start:g}, {self.t_end:g}])"

    def _repr_html_(self) -> str:
        counts = {name.removeprefix("n_"): count for name, count in self.counts().items()}
        return show.table(
            f"events of {self.n} blocks on [{self.t_start:g}, {self.t_end:g}]", {"events": len(self)} | counts
        )


def part_of(series: EventSeries, which: NDArray[Any] | slice, **changes: Any) -> EventSeries:
    """The series of some of the events, in the order that `which` gives them; with changes of other fields."""
    events = {name: getattr(series, name)[which] for name in ("t", "block", "mode")}
    return replace(series, **events | changes)


def by_block(block: NDArray[np.int32]) -> NDArray[np.intp]:
    """The order of events by block, those of one block in time: the same whatever blocks come at one instant."""
    return np.argsort(block, kind="stable")


class Summary(NamedTuple):
    """See `EventSeries.change_points` and `EventSeries.counts`."""

    t: Floats
    n_stick: NDArray[np.int32]
    counts: dict[str, int]


def summaries(many: Sequence[EventSeries]) -> list[Summary]:
    """A summary of each series, together: one by one, short series take as long as their runs."""
    if not many:
        return []
    which, lengths, sizes = np.arange(len(many)), [len(series) for series in many], [series.n for series in many]
    # one series, with consecutive block numbers
    mode, initial_mode = (
        np.concatenate([getattr(series, name) for series in many]) for name in ("mode", "initial_mode")
    )
    block = np.concatenate([series.block for series in many]) + np.repeat(np.cumsum(sizes) - sizes, lengths)
    enters = mode == 0
    leaves = EventSeries(np.empty(0), block, mode, initial_mode, 0.0, 0.0).previous_mode == 0
    of_event = which.repeat(lengths)
    n_entries, n_exits, at_start = (
        np.bincount(runs, minlength=len(many))
        for runs in (of_event[enters], of_event[leaves], which.repeat(sizes)[initial_mode == 0])
    )

    # a row for each start too, at which the sum of the changes starts again
    of_row = which.repeat(np.add(lengths, 1))
    is_start = _differs(of_row)
    t, change = np.empty(len(of_row)), np.empty(len(of_row), dtype=np.int32)
    t[is_start], t[~is_start] = [series.t_start for series in many], np.concatenate([series.t for series in many])
    change[is_start], change[~is_start] = at_start, enters.astype(np.int8) - leaves
    change[np.flatnonzero(is_start)[1:]] -= (at_start + n_entries - n_exits)[:-1]
    n_stick = np.cumsum(change, dtype=np.int32)
    is_kept = np.roll(is_start | _differs(t), -1)  # the last event of an instant holds
    t, n_stick, of_row = t[is_kept], n_stick[is_kept], of_row[is_kept]
    is_kept = _differs(n_stick) | _differs(of_row)
    t, n_stick = t[is_kept], n_stick[is_kept]
    ends = np.cumsum(np.bincount(of_row[is_kept])).tolist()
    kinds = zip([0, *ends[:-1]], ends, n_entries.tolist(), n_exits.tolist(), lengths, strict=True)
    return [
        Summary(t[first:end], n_stick[first:end], {"n_entries": n_in, "n_exits": out, "n_crossings": n - n_in - out})
        for first, end, n_in, out, n in kinds
    ]


def _differs(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether each value differs from the one before; True for the first."""
    differs = np.ones(len(values), dtype=bool)
    np.not_equal(values[1:], values[:-1], out=differs[1:])
    return differs


def without_returns(series: EventSeries, piece: NDArray[np.intp], s: Floats, shortest: Floats) -> EventSeries:
    """The series without opposite changes of mode of one block within `shortest`.

    A block that only touches the belt's speed, or the force that friction can hold, does so for one instant: rounding
    decides whether that is two events or none. So two opposite events of a block count only if they are more than
    `shortest` apart, or a force or belt speed has a bend between them.

    Parameters
    ----------
    series : EventSeries
    piece, s : intp and float64, shape (m,)
        Of each event: the number of its piece between such bends, and the time since the start of that.
    shortest : float64, shape (m,)
        The least time from the opposite event before each.
    """
    while True:
        order = series.by_block
        block, mode, times, piece_of = series.block[order], series.mode[order], s[order], piece[order]
        undone = (
            (block[1:] == block[:-1])
            & (piece_of[1:] == piece_of[:-1])
            & (times[1:] - times[:-1] <= shortest[order][1:])
        )
        if not undone.any():
            break
        undone &= mode[1:] == series.previous_mode[order][:-1]
        if not undone.any():
            break
        is_kept = np.ones(len(s), dtype=bool)
        for first in np.flatnonzero(undone):
            if is_kept[first]:  # not itself the second of a pair
                is_kept[first : first + 2] = False
        is_kept = np.isin(np.arange(len(s)), order[is_kept])
        series = part_of(series, is_kept)
        piece, s, shortest = piece[is_kept], s[is_kept], shortest[is_kept]
    return series
