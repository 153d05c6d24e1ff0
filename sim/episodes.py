"""Episodes: from all blocks stuck to all stuck again.

The quakes of a chain of blocks on a belt that drags them: R. Burridge and L. Knopoff, Bull. Seismol. Soc. Am. 57
(1967) 341-371. While all blocks stick they ride the belt: the change of z from one such interval to the next, less
the travel of the belt, is the slip of the episode between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Run
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.systems.drive import Piecewise, belt
from stickslip.sim.systems.system import System

Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Episodes:
    """The episodes of a run in order of time (dimensionless), without those cut off by its start or end.

    Attributes
    ----------
    start, end : float64, shape (m,)
        When the first block leaves, and when the last one sticks again.
    size : int32, shape (m,)
        Number of blocks that slipped.
    moment : float64, shape (m,)
        Sum over the blocks of the slip of each on its belt, positive against the mean motion of the belts: negative
        where blocks get ahead of them; slips on belts with opposite motion cancel. On belts at rest it keeps its
        sign.
    first_block : int32, shape (m,)
        The block that left first; of several at one instant the one with the lowest number.
    z_sum : float64, shape (m,)
        Sum of z over the blocks when it begins. From the begin of one episode to that of another the belts' travel is
        the change of this sum, the moments, and creep: what blocks slip while all count as stuck.
    elapsed : float64, shape (m,), or None
        Durations under adiabatic loading, where `start` and `end` are one time of the belt; else None.
    """

    start: Floats
    end: Floats
    size: NDArray[np.int32]
    moment: Floats
    first_block: NDArray[np.int32]
    z_sum: Floats
    elapsed: Floats | None = None

    @property
    def duration(self) -> Floats:
        """Durations, shape (m,)."""
        return self.end - self.start if self.elapsed is None else self.elapsed

    def __len__(self) -> int:
        return len(self.start)

    def __repr__(self) -> str:
        return f"Episodes({len(self)} of up to {self.size.max(initial=0)} blocks)"


def spans(series: EventSeries) -> Floats:
    """Start and end of every episode, shape (m, 2): when the first block leaves, and when the last sticks again."""
    since, until = _stills(series)
    return np.column_stack([until[:-1], since[1:]])


def episodes(run: Run, belt_speed: ArrayLike | Piecewise) -> Episodes:
    """The episodes of a run of an engine that keeps `Run.stills`.

    Parameters
    ----------
    run : Run
    belt_speed : float, array_like, shape (n,), or Piecewise
        v, as of the `System`.

    Raises
    ------
    TypeError, ValueError
        If the speeds are not those of belts of this run, or the run does not know its `stills`.
    """
    series, stills = run.events, run.stills
    if run.loaded is not None:
        t, elapsed, size, moment, first_block, z_sum = run.loaded
        return Episodes(t, t, size, moment, first_block, z_sum, elapsed)
    if stills is None:
        raise ValueError("run: expected one of an engine that keeps `stills`, on which moments hang, got None")
    since, until = _stills(series)
    first, last = np.searchsorted(stills.t, since), np.searchsorted(stills.t, until, side="right") - 1
    rests = first <= last  # else blocks stick so briefly that these are no events
    since, until, first, last = since[rests], until[rests], first[rests], last[rests]
    start, end = until[:-1], since[1:]
    before, after = last[:-1], first[1:]
    travel = _travel(belt(belt_speed, series.n), series.n, stills.t[before], stills.t[after])
    slip = stills.total[after] - stills.total[before] - travel
    slips = np.flatnonzero(series.mode != 0)
    leaves = slips[np.searchsorted(series.t[slips], start)]
    moment = np.where(travel > 0, -slip, slip)
    size = np.bincount(_slipping(series, start, end)[0], minlength=len(start)).astype(np.int32)
    return Episodes(start, end, size, moment, series.block[leaves], stills.total[before])


class Clusters(NamedTuple):
    """The connected parts of episodes, C of them, in order of episode and begin (dimensionless), and their slips.

    Attributes
    ----------
    episode : int32, shape (C,)
        Number of the episode that it is part of.
    start, end : float64, shape (C,)
        When its first block leaves, and when the last one sticks again.
    first_block : int32, shape (C,)
        Its nucleation site: the block that left first.
    size : int32, shape (C,)
        Its extent, in blocks.
    moment : float64, shape (C,)
        Sum of their slips, with the sign of `Episodes.moment`.
    stress_drop : float64, shape (C,)
        Mean over its blocks of the fall of the springs' force by the slips s of the episode, (K s)_i, with the same
        sign; what the belt loads meanwhile is no part of it.
    profile_cluster, profile_block : int32, shape (P,)
        For each block of each cluster: the number of the cluster, and the block, in order.
    profile_slip : float64, shape (P,)
        Its slip.
    """

    episode: NDArray[np.int32]
    start: Floats
    end: Floats
    first_block: NDArray[np.int32]
    size: NDArray[np.int32]
    moment: Floats
    stress_drop: Floats
    profile_cluster: NDArray[np.int32]
    profile_block: NDArray[np.int32]
    profile_slip: Floats


def clusters(run: Run, system: System, before: Floats, after: Floats) -> Clusters:
    """The episodes of a run, each split where its slipping blocks are not connected by springs of K.

    Blocks i and j are connected if K_ij or K_ji is not zero. Two far parts of a chain that slip at one time are one
    episode, and two clusters.

    Parameters
    ----------
    before, after : float64, shape (m, n)
        z at the start and at the end of each of the m `episodes`.
    """
    catalogue, series, n = episodes(run, system.belt_speed), run.events, system.n
    slip = after - before - _travels(system.belt_speed, n, catalogue.start, catalogue.end)
    sign = np.where(_travel(belt(system.belt_speed, n), n, catalogue.start, catalogue.end) > 0, -1.0, 1.0)[:, None]
    fall = sign * (system.stiffness @ slip.T).T
    episode, block, first, last = _slipping(series, catalogue.start, catalogue.end)
    label = _parts(episode, block, system)
    # clusters by episode and begin, their blocks in order
    begin = np.full(label.max(initial=-1) + 1, np.inf)
    np.minimum.at(begin, label, first)
    of_episode = np.zeros(len(begin), dtype=np.int64)
    of_episode[label] = episode
    rank = np.empty(len(begin), dtype=np.int64)
    rank[np.lexsort((begin, of_episode))] = np.arange(len(begin))
    cluster = rank[label]
    order = np.lexsort((block, cluster))
    cluster, episode, block = cluster[order], episode[order], block[order]
    first, last = first[order], last[order]
    size = np.bincount(cluster, minlength=len(begin))
    slips = (sign * slip)[episode, block]
    head = np.cumsum(size) - size
    leads = np.lexsort((block, first, cluster))[head]
    end = np.zeros(len(begin))
    np.maximum.at(end, cluster, last)
    drop = np.bincount(cluster, fall[episode, block], len(begin)) / np.maximum(size, 1)
    return Clusters(
        episode[head].astype(np.int32), first[leads], end, block[leads].astype(np.int32), size.astype(np.int32),
        np.bincount(cluster, slips, len(begin)).astype(np.float64), drop, cluster.astype(np.int32),
        block.astype(np.int32), slips,
    )  # fmt: skip


def _slipping(series: EventSeries, start: Floats, end: Floats) -> tuple[Ints, Ints, Floats, Floats]:
    """Episode, block, first slip and last event of each block that slips in an episode, in that order, shape (P,)."""
    span = np.searchsorted(start, series.t, side="right") - 1
    inside = (span >= 0) & (series.t <= np.append(end, np.inf)[span])
    t, key = series.t[inside], span[inside] * series.n + series.block[inside]
    slips = series.mode[inside] != 0
    pairs, leaves = np.unique(key[slips], return_index=True)
    last = np.zeros(len(pairs))
    place = np.searchsorted(pairs, key)
    has_left = (place < len(pairs)) & (pairs[np.minimum(place, len(pairs) - 1)] == key) if len(pairs) else place > 0
    np.maximum.at(last, place[has_left], t[has_left])
    return pairs // series.n, pairs % series.n, t[slips][leaves], last


def _parts(episode: Ints, block: Ints, system: System) -> NDArray[np.int32]:
    """The number of the connected part of each slipping block of each episode, shape (P,)."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    springs = sparse.csr_array(system.stiffness)
    springs = sparse.csr_array(abs(springs) + abs(springs).T)
    n_near = np.diff(springs.indptr)[block]
    node = np.repeat(np.arange(len(block)), n_near)
    offset = np.arange(len(node)) - np.repeat(np.cumsum(n_near) - n_near, n_near)
    neighbours = springs.indices[springs.indptr[block][node] + offset]
    key, key_of_neighbour = episode * system.n + block, episode[node] * system.n + neighbours
    place = np.minimum(np.searchsorted(key, key_of_neighbour), max(len(key) - 1, 0))
    tied = key[place] == key_of_neighbour if len(key) else place > 0
    graph = sparse.coo_array((np.ones(tied.sum()), (node[tied], place[tied])), shape=(len(key), len(key)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _travels(belt_speed: float | Floats | Piecewise, n: int, since: Floats, until: Floats) -> Floats:
    """The travel of each of n belts between two times, shape (m, n)."""
    speeds = belt(belt_speed, n)
    if isinstance(speeds, Piecewise):
        travel = np.asarray(speeds.integral(until) - speeds.integral(since))
        return np.broadcast_to(travel.reshape(len(since), -1), (len(since), n))
    return np.broadcast_to(speeds, n) * (until - since)[:, None]


def _travel(belt_speed: float | Floats | Piecewise, n: int, since: Floats, until: Floats) -> Floats:
    """The sum of the travels of n belts between two times."""
    if isinstance(belt_speed, Piecewise):
        return np.asarray((belt_speed.integral(until) - belt_speed.integral(since)).sum(axis=-1))
    return np.broadcast_to(belt_speed, n).sum() * (until - since)


def _stills(series: EventSeries) -> tuple[Floats, Floats]:
    """Starts and ends of the all-stuck intervals."""
    t, n_stick = series.change_points()
    is_still = n_stick == series.n
    return t[is_still], np.append(t[1:], series.t_end)[is_still]
