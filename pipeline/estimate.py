"""What a scene will take, before it is run: members, shards, bytes and time, the last two as intervals.

`Member.cost` says how work grows within one kind of members (one n, one setting of an engine), up to a factor that
the machine and the scene's physics set. A pilot finds that factor: of each kind it runs members of several matrices,
cut short where they are long, and compares. The interval then holds

- how much the factor differs between members of a kind, by the number of members seen and to come,
- how far the runs seen had to be stretched to the end of the whole ones,
- how much a core slows when its neighbours work too, and how long workers take to start,
- how busy the machine is with other things now, and may go on to be.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from pipeline.members import Batch, Member
from pipeline.scene import Scene
from pipeline.shards import Recording, encode, row

#: Seconds that a pilot may take; less where the estimate itself is short.
PILOT = (1.0, 5.0)
_SHARE = 0.02

# Of the logarithm of the factor: what the spread within a kind is taken for until it is known (as if from so many
# members), what each doubling of a run that was cut short adds, and what may change between pilot and run.
_SPREAD, _PRIOR = 0.4, 3
_PER_DOUBLING = 0.1
_MACHINE = 0.1

# Seconds, measured on two cores: from the start of a run to its first batch (dask, workers, their libraries and
# kernels) and to an end; what a batch costs beside its members; how fast a core is while the others work too.
_START = (1.5, 3.0, 6.0)
_PER_BATCH = (0.005, 0.02, 0.05)
_PARALLEL = (1.0, 0.93, 0.75)

#: What members of a kind share beside n.
_SETTINGS = ("engine", "tol", "eps", "ratio", "rtol", "atol", "stick", "threshold", "thresholds")

#: Bytes of a row's scalars, most of which are those of the row before.
_SCALARS = 20.0

#: Low, middle, high.
Interval: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Estimate:
    """What a run will take. Intervals are (low, middle, high), meant to hold nine times in ten."""

    n_members: int
    n_shards: int
    n_bytes: Interval
    core_seconds: Interval
    seconds: Interval
    workers: int
    n_pilot: int
    n_kinds: int
    pilot_seconds: float


@dataclass
class _Kind:
    """Members that differ by their draws and changes only, and what the pilot saw of them."""

    members: list[Member]
    factors: list[float] = field(default_factory=list)
    stretched: list[float] = field(default_factory=list)
    bytes: list[float] = field(default_factory=list)

    @property
    def cost(self) -> float:
        return sum(member.cost for member in self.members)

    @property
    def factor(self) -> float:
        return float(np.mean(self.factors))


def estimate(scene: Scene, packed: list[Batch], workers: int) -> Estimate:
    """Estimate a run of some batches of a scene, by a pilot of a few seconds.

    Parameters
    ----------
    scene : Scene
    packed : list of Batch
        What is to be run.
    workers : int
        Local processes; more than the machine has cores count as so many.
    """
    start = time.perf_counter()
    kinds = _kinds([member for batch in packed for member in batch.members])
    # what is shared between members is known by its formula; the pilot runs them alone
    recording = replace(
        Recording.of(scene),
        parts=tuple(part for part in scene.records if part not in ("growth_rate", "separation")),
        separation=None,
    )
    _pilot(kinds, recording)
    work, spread = _work(kinds)
    core_seconds = (work * math.exp(-1.65 * spread), work, work * math.exp(1.65 * spread))
    n_workers = max(1, min(workers, len(packed), len(os.sched_getaffinity(0))))
    busy = _busy(n_workers)
    # the last batch may run alone
    tail = (0.0, 0.5, 1.0) if n_workers > 1 else (0.0, 0.0, 0.0)
    last = max(batch.cost for batch in packed) * work / sum(batch.cost for batch in packed)
    low, middle, high = (
        begin * slower + (core + len(packed) * each) / (n_workers * speed) * among + end * last
        for begin, core, each, speed, end, slower, among in zip(
            _START, core_seconds, _PER_BATCH, _PARALLEL, tail, *busy, strict=True
        )
    )
    return Estimate(
        n_members=sum(len(kind.members) for kind in kinds),
        n_shards=len(packed),
        n_bytes=_bytes(kinds, recording, len(packed)),
        core_seconds=core_seconds,
        seconds=(low, middle, high),
        workers=n_workers,
        n_pilot=sum(len(kind.factors) for kind in kinds),
        n_kinds=len(kinds),
        pilot_seconds=time.perf_counter() - start,
    )


def _busy(n_workers: int) -> tuple[Interval, Interval]:
    """How much slower a core is for its other users, and how much of that the pilot, alone, has not seen."""
    n_cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    slower = max(1.0, (load + n_workers) / n_cores)
    seen = max(1.0, (load + 1) / n_cores)
    among = slower / seen
    # the others may end, or have only begun
    return (1.0, math.sqrt(slower), slower), (1.0 / seen, among, among * math.sqrt(seen))


def _kinds(members: list[Member]) -> list[_Kind]:
    kinds: dict[tuple, _Kind] = {}
    for member in members:
        coupled = member.perturbation_reading == "damping matrix"
        key = (member.n, coupled, *(getattr(member, name) for name in _SETTINGS))
        kinds.setdefault(key, _Kind([])).members.append(member)
    return list(kinds.values())


def _pilot(kinds: list[_Kind], recording: Recording) -> None:
    """Run members of each kind, those of most work first, as long as the time lasts."""
    for member in {kind.members[0].engine: kind.members[0] for kind in kinds}.values():
        row(replace(member, n=5, t_end=min(member.t_end, 60.0)), recording)  # kernels are loaded, or compiled
    expected = sum(kind.cost for kind in kinds)
    left = min(max(_SHARE * expected, PILOT[0]), PILOT[1])
    kinds = sorted(kinds, key=lambda kind: -kind.cost)
    for k, kind in enumerate(kinds):  # each once; what one leaves is the others'
        left -= _try(kind, kind.members[0], left / (len(kinds) - k) * (1.0 if len(kinds) == 1 else 0.7), recording)
    for again in range(1, 8):
        for kind in kinds:
            others = list(_spread_out(kind.members, 8))
            if again >= len(others) or kind.factor * others[again].cost > left:
                continue
            left -= _try(kind, others[again], left, recording)


def _spread_out(members: list[Member], count: int) -> Iterator[Member]:
    """The first and others, evenly spaced, which are of other matrices and changes."""
    for k in range(min(count, len(members))):
        yield members[k * len(members) // min(count, len(members))]


def _try(kind: _Kind, member: Member, seconds: float, recording: Recording) -> float:
    """Run a member, or as much of it as fits; returns the seconds it took."""
    whole = replace(member, shared_cost=0.0)
    factor = kind.factor if kind.factors else 1.0
    share = min(1.0, max(seconds, 0.0) / (factor * whole.cost))
    part = whole if share > 0.7 else replace(whole, t_end=max(share * whole.t_end, min(10.0, whole.t_end)))
    start = time.perf_counter()
    found = row(part, recording)
    took = time.perf_counter() - start
    kind.factors.append(took / part.cost)
    kind.stretched.append(math.log2(whole.t_end / part.t_end))
    kind.bytes.append(_row_bytes(found, recording) * whole.t_end / part.t_end)
    return took


def _work(kinds: list[_Kind]) -> tuple[float, float]:
    """Work of all members, in seconds of a core, and the standard deviation of its logarithm."""
    logs = [np.log(kind.factors) for kind in kinds]
    freedom = sum(len(log) - 1 for log in logs)
    squares = sum(float(((log - log.mean()) ** 2).sum()) for log in logs)
    variance = (squares + _PRIOR * _SPREAD**2) / (freedom + _PRIOR)
    total = sum(kind.cost * kind.factor for kind in kinds)
    apart = stretched = 0.0
    for kind in kinds:
        share = kind.cost * kind.factor / total
        apart += share**2 * variance * (1 / len(kind.factors) + 1 / len(kind.members))
        stretched += share * _PER_DOUBLING * float(np.mean(kind.stretched))  # they err alike: no averaging
    return total, math.sqrt(apart + stretched**2 + _MACHINE**2)


def _row_bytes(found: dict[str, Any], recording: Recording) -> float:
    """What a row adds to a shard: its lists, and some scalars that repeat."""
    whole, bare = (len(encode([values], recording.schema)) for values in (found, _bare(found)))
    return whole - bare + _SCALARS


def _bare(found: dict[str, Any]) -> dict[str, Any]:
    return {name: [] if isinstance(value, np.ndarray | list) else value for name, value in found.items()}


def _bytes(kinds: list[_Kind], recording: Recording, n_shards: int) -> Interval:
    head = len(encode([_bare(row(replace(kinds[0].members[0], t_end=1e-3), recording))], recording.schema))
    rows = sum(len(kind.members) * float(np.mean(kind.bytes)) for kind in kinds)
    low, middle, high = (n_shards * head + rows * factor for factor in (0.45, 1.0, 1.4))  # short lists share pages
    return low, middle, high
