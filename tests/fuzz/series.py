"""Whether two series tell the same, where rounding and the tolerance leave a choice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat

import numpy as np

#: (from, mode, by how much an error moves that time) of one block, in order; the first from the start.
Stretches = list[tuple[float, int, float]]


def by_block(
    t: Iterable[float],
    block: Iterable[int],
    mode: Iterable[int],
    initial: Iterable[int],
    moves: Iterable[float] = repeat(0.0),
) -> list[Stretches]:
    """The stretches of each block, from t = 0."""
    found = [[(0.0, int(m), 0.0)] for m in initial]
    for time, i, m, moved in zip(t, block, mode, moves, strict=False):
        found[i].append((float(time), int(m), moved))
    return found


def without(stretches: Stretches, length: float, t_end: float) -> Stretches:
    """Without those shorter than `length`, the shortest first; neighbours of one mode become one."""
    kept = list(stretches)
    while len(kept) > 1:
        edges = [stretch[0] for stretch in kept] + [t_end]
        lengths = np.diff(edges)
        k = int(np.argmin(lengths))
        if lengths[k] >= length:
            break
        if k == 0:
            kept[1] = (kept[0][0], *kept[1][1:])
        del kept[k]
        if 0 < k < len(kept) and kept[k][1] == kept[k - 1][1]:
            del kept[k]
    return kept


def compare(
    seen: Stretches, expected: Stretches, changed: Sequence[Stretches], error: float, shortest: float, t_end: float
) -> tuple[str, str]:
    """("same" | "graze" | "undecided" | "differs", words) of one block, up to t_end.

    `changed` is what the reference says when start and constants change by what the tolerance allows: it says how far
    times may be apart, beyond what `error` moves them, and how much of the order is certain. Stretches up to
    `shortest` (a touch or a dip, where an error e makes a stretch of the length sqrt(e)) may be left out, of all
    alike.
    """
    expected, *changed = ([s for s in other if s[0] <= t_end] for other in (expected, *changed))
    words = ""
    for length in (0.0, *(shortest * 10.0**k for k in range(-5, 1))):
        mine, its, *others = (without(one, length, t_end) for one in (seen, expected, *changed))
        steady = [other for other in others if _modes(other) == _modes(its)]
        certain = len(its) if len(steady) == len(others) else min(agreeing(its, other) for other in others)
        late = [0.0] * len(its)
        for other in steady:
            late = [max(a, abs(b[0] - c[0])) for a, b, c in zip(late, its, other, strict=True)]
        removed = len(mine) < len(seen) or len(its) < len(expected)
        k = agreeing(mine, its, [error * b[2] + length * removed + 10 * x for b, x in zip(its, late, strict=True)])
        if k == len(mine) == len(its):
            return "same" if length <= 1e-9 else "graze", ""
        if k >= certain and len(steady) < len(others):
            return "undecided", ""
        words = words or f"{_told(mine, k)}, expected {_told(its, k)}"
    return "differs", words


def _modes(stretches: Stretches) -> list[int]:
    return [stretch[1] for stretch in stretches]


def agreeing(one: Stretches, other: Stretches, late: Sequence[float] | None = None) -> int:
    """How many stretches from the start have the same mode, and begin no further apart than `late`."""
    for k, (a, b) in enumerate(zip(one, other, strict=False)):
        if a[1] != b[1] or (late is not None and abs(a[0] - b[0]) > late[k]):
            return k
    return min(len(one), len(other))


def _told(stretches: Stretches, k: int) -> str:
    return f"mode {stretches[k][1]:+d} from t = {stretches[k][0]!r}" if k < len(stretches) else "nothing more"
