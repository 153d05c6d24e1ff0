"""What runs settle on, told apart within a system.

Kinds are those of `stickslip.sim.attractors`. Cycles of one system are told apart by their events and exits a period,
their period, and the state at their section. States of rest are not: a block may stick anywhere between two bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stickslip.sim.numerics.arguments import Floats

#: The kinds, in the order of pictures and tables.
REST, SLIDING, PERIODIC, TORUS, IRREGULAR, ESCAPING, UNDECIDED = KINDS = (
    "rest", "sliding", "periodic", "torus", "irregular", "escaping", "undecided",
)  # fmt: skip
#: Two cycles are one if period and states agree within this, of the period and of the largest number in the states:
#: runs at loose tolerances come back within 1e-4.
ONE_CYCLE = 1e-3
#: So many cycles of one system are told apart; the rest are one.
_MOST_CYCLES = 100


class Cycle(NamedTuple):
    """A cycle of a run: events and exits a period, the period, z and w at its section, shape (n,) each."""

    n_events: int
    n_exits: int
    period: float
    z: Floats
    w: Floats


def alike(cycles: Sequence[Cycle]) -> list[int]:
    """The number of the cycle of each run of one system, from 1 on, those of most runs first; 0 for those of no more.

    z counts only relative to the first block's, so that a cycle that drifts along is one wherever it is.
    """
    if not cycles:
        return []
    states = np.array([np.concatenate([[cycle.period], cycle.w, cycle.z - cycle.z[0]]) for cycle in cycles])
    sizes = np.array([max(np.abs(cycle.w).max(), np.ptp(cycle.z), np.abs(cycle.z).max() * 1e-3) for cycle in cycles])
    allowed = ONE_CYCLE * np.column_stack([states[:, 0], np.repeat(sizes[:, None], states.shape[1] - 1, axis=1)])
    counts = np.array([(cycle.n_events, cycle.n_exits) for cycle in cycles])
    number = np.zeros(len(cycles), dtype=np.int64)
    for k in range(1, _MOST_CYCLES + 1):
        unnumbered = np.flatnonzero(number == 0)
        if not len(unnumbered):
            break
        example = unnumbered[0]
        is_same = (np.abs(states[unnumbered] - states[example]) <= allowed[example]).all(axis=1)
        number[unnumbered[is_same & (counts[unnumbered] == counts[example]).all(axis=1)]] = k
    runs = np.bincount(number, minlength=1)
    order = 1 + np.argsort(-runs[1:], kind="stable")
    rank = np.zeros(len(runs), dtype=np.int64)
    rank[order] = np.arange(1, len(runs))
    return rank[number].tolist()


class Plane(NamedTuple):
    """The starts of the runs of one system, by the one or two numbers of them that vary.

    `names` of these numbers; `points`, shape (m, 1) or (m, 2), of the runs in their order.
    """

    names: tuple[str, ...]
    points: Floats


def plane(z: Floats, w: Floats, names: Sequence[str] = ()) -> Plane | None:
    """What varies of some starts, z and w of shape (m, n); None if that is nothing, or more than two numbers.

    Numbers that are the same in every start count once. `names` are those of the blocks, if they have some.
    """
    n = z.shape[1]
    varying: dict[bytes, list[tuple[str, int]]] = {}
    for key, values in (("z", z), ("w", w)):
        for block in range(n):
            if np.ptp(values[:, block]) > 0:
                varying.setdefault(values[:, block].tobytes(), []).append((key, block))
        if len(varying) > 2:
            return None
    if not varying:
        return None
    words = tuple(_name(numbers, n, names) for numbers in varying.values())
    return Plane(words, np.column_stack([np.frombuffer(column) for column in varying]))


def _name(numbers: Sequence[tuple[str, int]], n: int, names: Sequence[str]) -> str:
    """In words, which numbers of a start these are."""
    words = {"z": "displacement z", "w": "velocity w"}
    phrases = []
    for key in sorted({key for key, _ in numbers}, reverse=True):
        blocks = [block for name, block in numbers if name == key]
        if len(blocks) == n:
            suffix = "" if n == 1 else " of all blocks"
        elif names:
            suffix = f" of {', '.join(names[block] for block in blocks)}"
        else:
            suffix = f" of block{'s' if len(blocks) > 1 else ''} {', '.join(map(str, blocks))}"
        phrases.append(words[key] + suffix)
    return " and ".join(phrases)
