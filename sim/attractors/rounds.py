"""Rounds of events that repeat, as cycles do, whatever the order of those at one instant."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.runs.series import EventSeries, part_of

#: Rounds of events that are tried as a cycle, the shortest first.
_TRIED = 8
#: The same of rounds that only nearly come back, within this share of their time: the run may settle there.
_TRIED_NEAR, _NEAR = 2, 0.02


class Round(NamedTuple):
    """A round of events that may be a cycle: how many there are, their time, and whether it has come back.

    If it has not, the run may be about to settle on a cycle of as many events.
    """

    n_events: int
    period: float
    is_back: bool


def rounds_of(last: EventSeries, back: float) -> Iterator[Round]:
    """Rounds after which the last events repeat, the shortest first: their symbols, and the times between them."""
    symbols, n = symbols_of(last), len(last)
    place = np.flatnonzero(symbols == symbols[-1])[::-1]
    ago = last.t[-1] - last.t[place]
    rounds = np.arange(1, (len(place) - 1) // 2 + 1)
    period = ago[rounds]
    repeats = np.abs(ago[2 * rounds] - 2.0 * period) <= 2.0 * _NEAR * period
    repeats &= 2 * place[rounds] - (n - 1) >= 0
    tried = {True: _TRIED, False: _TRIED_NEAR}
    for k in rounds[repeats].tolist():
        p, span = n - 1 - int(place[k]), float(ago[k])
        last_round, round_before = slice(n - p, n), slice(n - 2 * p, n - p)
        if (symbols[last_round] != symbols[round_before]).any():
            continue
        off = np.abs(last.t[last_round] - last.t[round_before] - span).max(initial=abs(ago[2 * k] - 2.0 * span)) / (
            2.0 * span
        )
        is_back = bool(off <= back)
        if off <= _NEAR and tried[is_back] > 0:
            tried[is_back] -= 1
            yield Round(p, span, is_back)
            if tried[True] == 0:
                return


def symbols_of(events: EventSeries) -> NDArray[np.int64]:
    """A number for the block and mode of each event."""
    return events.block.astype(np.int64) * 3 + events.mode + 1


def in_order(events: EventSeries, first: int, together: float) -> EventSeries:
    """The events from some event on, those of one instant by block: their order is otherwise one of rounding."""
    later = part_of(events, slice(first, None), initial_mode=events.mode_after(first))
    gaps = np.diff(later.t)
    if not (gaps <= together).any():
        return later
    instant = np.cumsum(np.append(0, gaps > together))
    return part_of(later, np.lexsort((later.block, instant)))
