"""What a run will take, before it is made: members, shards, bytes and time, the last two as intervals.

`Member.cost` says how work grows within one kind of members (one n, one setting of an engine), up to a factor that
the machine and the scene's physics set. A pilot finds that factor: the workers that the run will have run members of
each kind, of several matrices, at the same time, cut short where they are long. So it sees what the run will: how
long a worker takes to start, how much it slows when its neighbours work too, and how busy the machine is. The
interval then holds

- how much the factor differs between members of a kind, by the number of members seen and to come,
- how far the runs seen had to be stretched to the end of the whole ones,
- what may change on the machine between the pilot and the run, more so if others use it.

Kernels that are not compiled yet are compiled by the pilot, and found by the run.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, TypeAlias

import numpy as np
from distributed import KilledWorker
from scipy import special

from stickslip.pipeline.cluster import local
from stickslip.pipeline.design import Batch, Member
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.scene import Scene
from stickslip.pipeline.schema import Recording, encode
from stickslip.pipeline.worker import is_cold, load_kernels, row

#: Seconds that the members of a pilot may take; less where the estimate itself is short.
PILOT = (1.0, 5.0)
_SHARE = 0.04

#: Members of one kind that a pilot runs at most.
_ENOUGH = 40

# Of the logarithm of the factor: what the spread within a kind is taken for until it is known (as if from so many
# members), and what each doubling of a run that was cut short adds.
_SPREAD, _PRIOR = 0.4, 3
_PER_DOUBLING = 0.1

# Standard deviations of the logarithm of the pace: of a machine of our own, and what others, who may come or go, add
# when the pilot had to share its cores with them half and half.
_MACHINE, _OTHERS = 0.08, 0.3

# The spread of the start of a worker on its own; seconds of a batch beside its members.
_START_SPREAD, _PER_BATCH = 0.3, 0.02

#: The part of the runs that lies between the bounds of an interval.
_LEVEL = 0.9

#: What members of one kind differ by.
_DRAWS: dict[str, Any] = {
    **{"member_id": "", "matrix": 0, "ratio_draw": None, "twin_size": None, "shared_cost": 0.0},
    **{"perturbation_reading": None, "perturbation_size": 0.0, "perturbation_draw": None},
}

#: Bytes of a row's scalars, most of which are those of the row before.
_SCALARS = 20.0

#: Low, middle, high.
Interval: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Amounts:
    """What a run will take, each (low, middle, high), meant to hold nine times in ten."""

    n_bytes: Interval
    core_seconds: Interval
    seconds: Interval


@dataclass(frozen=True)
class Estimate:
    """What a run will take, as far as a pilot can tell."""

    n_members: int
    n_shards: int
    amounts: Amounts | None  #: None if members of the pilot failed, which says nothing of those that will not
    failures: dict[str, int]  #: members of the pilot that failed, by reason
    asked_workers: int
    workers: int  #: those of them that have a shard, and a core, of their own
    n_pilot: int
    n_kinds: int
    pilot_seconds: float
    start_seconds: float  #: until workers have started
    compile_seconds: float  #: that the pilot compiled kernels; 0 if they were there
    busy: float  #: seconds that the pilot took for a second of a core; above 1 others use the machine


@dataclass(frozen=True)
class _Seen:
    """A member that was run, or a part of it: seconds, those of a core, and what the whole would take."""

    seconds: float
    core_seconds: float
    whole: float
    stretched: float  #: doublings of time between the part and the whole
    bytes: float
    failure: str | None  #: why it failed, if it did


@dataclass
class _Kind:
    """Members that differ by their draws and changes only, and what the pilot saw of them."""

    members: list[Member]
    factors: list[float] = field(default_factory=list)
    stretched: list[float] = field(default_factory=list)
    bytes: list[float] = field(default_factory=list)
    n_asked: int = 0

    @property
    def cost(self) -> float:
        return sum(member.cost for member in self.members)

    @property
    def factor(self) -> float:
        return float(np.mean(self.factors))

    def next_members(self, count: int) -> Iterator[Member]:
        """Members that the pilot has not run, evenly spread over matrices and changes."""
        for _ in range(min(count, len(self.members) - self.n_asked, _ENOUGH - self.n_asked)):
            # the golden section spreads any number of places, however many will be asked for
            yield self.members[int(self.n_asked * 0.6180339887498949 % 1.0 * len(self.members))]
            self.n_asked += 1


def estimate(scene: Scene, packed: Sequence[Batch], workers: int) -> Estimate:
    """Estimate a run of some batches of a scene, by a pilot of some seconds.

    Parameters
    ----------
    scene : Scene
    packed : sequence of Batch
        What is to be run, one at least.
    workers : int
        Local processes; more than the machine has cores count as so many.

    Raises
    ------
    ScheduleError
        If a worker of the pilot dies.
    """
    start = time.perf_counter()
    kinds = _kinds([member for batch in packed for member in batch.members])
    # what is shared between members is known by its formula; the pilot runs them alone
    recording = replace(
        Recording.of(scene),
        parts=tuple(part for part in scene.records if part not in ("growth_rate", "separation")),
        separation=None,
    )
    n_workers = max(1, min(workers, len(packed), _n_cores()))
    with _workers(n_workers) as pool:
        compiled = _load(pool, n_workers, kinds)
        begin = time.perf_counter() - start - compiled
        seen = _pilot(pool, n_workers, kinds, recording)
    busy = max(1.0, sum(one.seconds for one in seen) / sum(one.core_seconds for one in seen))
    failures = Counter(one.failure for one in seen if one.failure is not None)
    return Estimate(
        n_members=sum(len(kind.members) for kind in kinds),
        n_shards=len(packed),
        amounts=None if failures else _amounts(kinds, packed, recording, n_workers, begin, busy),
        failures=dict(failures.most_common()),
        asked_workers=workers,
        workers=n_workers,
        n_pilot=len(seen),
        n_kinds=len(kinds),
        pilot_seconds=time.perf_counter() - start,
        start_seconds=begin,
        compile_seconds=compiled,
        busy=busy,
    )


def _n_cores() -> int:
    """The cores that this process may use, where the system says so; else those of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _amounts(
    kinds: list[_Kind], packed: Sequence[Batch], recording: Recording, n_workers: int, begin: float, busy: float
) -> Amounts:
    work, spread = _work(kinds)
    machine = math.hypot(_MACHINE, 2.0 * _OTHERS * (1.0 - 1.0 / busy))
    # the last batch may run alone
    tail = max(batch.cost for batch in packed) * work / sum(batch.cost for batch in packed)
    run = (work + len(packed) * _PER_BATCH) / n_workers + (0.5 * tail if n_workers > 1 else 0.0)
    apart = math.hypot(begin * _START_SPREAD, run * spread) / (begin + run)
    freedom = sum(len(kind.factors) - 1 for kind in kinds) + _PRIOR
    return Amounts(
        n_bytes=_bytes(kinds, recording, len(packed)),
        core_seconds=_interval(work / busy, math.hypot(spread, _MACHINE), freedom),
        seconds=_interval(begin + run, math.hypot(apart, machine), freedom),
    )


def _interval(middle: float, error: float, freedom: int) -> Interval:
    """By Student's t, of a logarithm with this standard error."""
    wide = math.exp(float(special.stdtrit(freedom, 0.5 + 0.5 * _LEVEL)) * error)
    return middle / wide, middle, middle * wide


def _kinds(members: list[Member]) -> list[_Kind]:
    kinds: dict[tuple[Any, ...], _Kind] = {}
    for member in members:
        is_coupled = member.perturbation_reading == "damping matrix"
        kinds.setdefault((is_coupled, replace(member, **_DRAWS)), _Kind([])).members.append(member)
    return sorted(kinds.values(), key=lambda kind: -kind.cost)


# ---------------------------------------------------------------------------------------------- the pilot


@contextlib.contextmanager
def _workers(count: int) -> Iterator[Executor]:
    with local(count) as client:
        try:
            yield client.get_executor(pure=False)
        except KilledWorker as error:
            raise ScheduleError(
                "expected the members of the pilot to end, got one whose process died; see what kills it (memory?): "
                "a run gives each member that kills its process a row that says so"
            ) from error


def _load(pool: Executor, count: int, kinds: list[_Kind]) -> float:
    """Have each worker load what it needs; the seconds that went into compiling."""
    members = [kind.members[0] for kind in kinds]
    cold = any(is_cold(member.engine) for member in members)
    loading = max(future.result() for future in [pool.submit(_load_one, members) for _ in range(count)])
    return loading if cold else 0.0


def _load_one(members: list[Member]) -> float:
    begun = time.perf_counter()
    load_kernels(members)
    took = time.perf_counter() - begun
    time.sleep(0.2)  # the next of these to a worker of its own
    return took


def _pilot(pool: Executor, count: int, kinds: list[_Kind], recording: Recording) -> list[_Seen]:
    """Run a member of each kind, then more of those of most work, as long as the time lasts."""
    expected = sum(kind.cost for kind in kinds)
    seconds = count * min(max(_SHARE * expected / count, PILOT[0]), PILOT[1])
    seen: list[_Seen] = []
    for is_first in (True, False):
        left = seconds - sum(one.seconds for one in seen)

        def asked(is_first: bool = is_first, left: float = left) -> Iterator[tuple[_Kind, Member, float]]:
            for kind in kinds:
                part = 0.4 * seconds / len(kinds) if is_first else left * kind.cost / expected
                each = (1.0 if is_first else kind.factor) * kind.members[0].cost
                for member in kind.next_members(1 if is_first else int(part / each)):
                    yield kind, member, part / each

        waiting, running = asked(), dict[Future[_Seen], tuple[_Kind, Member]]()
        while True:
            for kind, member, share in islice(waiting, 2 * count - len(running) if is_first or left > 0 else 0):
                running[pool.submit(_try, member, share, recording)] = (kind, member)
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                (kind, member), one = running.pop(future), future.result()
                kind.factors.append(one.whole / replace(member, shared_cost=0.0).cost)
                kind.stretched.append(one.stretched)
                kind.bytes.append(one.bytes)
                seen.append(one)
                left -= one.seconds
        if any(one.failure is not None for one in seen):  # there is nothing to be estimated any more
            break
    return seen


def _try(member: Member, share: float, recording: Recording) -> _Seen:
    """Run a member, or as much of it as a share of its expected seconds."""
    whole = replace(member, shared_cost=0.0)
    part = whole if share > 0.7 else replace(whole, t_end=max(share * whole.t_end, min(10.0, whole.t_end)))
    begun, cores = time.perf_counter(), time.process_time()
    found = row(part, recording)
    took, cores = time.perf_counter() - begun, time.process_time() - cores
    if found["outcome"] != "finished":  # it ended early, and the whole would too
        part = whole
    share = part.cost / whole.cost
    return _Seen(
        seconds=took,
        core_seconds=max(cores, 1e-6),
        whole=took / share,
        stretched=math.log2(1 / share),
        bytes=_row_bytes(found, recording) / share,
        failure=found["reason"] if found["outcome"] == "failed" else None,
    )


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
