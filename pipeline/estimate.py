"""What a run will take, before it is made: bytes and time, as intervals.

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
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from distributed import KilledWorker
from scipy import special

from stickslip.pipeline.cluster import local
from stickslip.pipeline.design import Batch, Member
from stickslip.pipeline.errors import ScheduleError
from stickslip.pipeline.processes import n_cores
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

#: Bytes of a row's scalars, most of which are those of the row before; what lists take, which share pages if short.
_SCALARS, _PAGES = 20.0, (0.45, 1.0, 1.4)

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

    amounts: Amounts | None  #: None if members of the pilot failed, which says nothing of those that will not
    failures: dict[str, int]  #: members of the pilot that failed, by reason
    workers: int  #: those of the workers asked for that have a shard of their own
    cores: int  #: those that they share
    n_pilot: int
    n_kinds: int
    pilot_seconds: float
    start_seconds: float  #: until workers have started
    compile_seconds: float  #: that the pilot compiled kernels; 0 if they were there
    busy: float  #: seconds that the pilot took for a second of a core; above 1 others use the machine


@dataclass(frozen=True)
class _Seen:
    """A member that was run, or a part of it: what it took, and what the whole would take."""

    seconds: float
    core_seconds: float
    factor: float  #: seconds of the whole for a unit of its cost
    stretched: float  #: doublings of time between the part and the whole
    head: int  #: bytes of a shard beside its rows
    bytes: float  #: of the row
    failure: str | None  #: why it failed, if it did


@dataclass
class _Kind:
    """Members that differ by their draws and changes only, and what the pilot saw of them."""

    members: list[Member] = field(default_factory=list)
    seen: list[_Seen] = field(default_factory=list)
    n_asked: int = 0

    @property
    def cost(self) -> float:
        return sum(member.cost for member in self.members)

    def mean(self, name: str) -> float:
        return float(np.mean([getattr(one, name) for one in self.seen]))

    def next_member(self) -> Member:
        """A member that the pilot has not run; they are evenly spread over matrices and changes."""
        self.n_asked += 1  # the golden section spreads any number of places, however many will be asked for
        return self.members[int((self.n_asked - 1) * 0.6180339887498949 % 1.0 * len(self.members))]


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
    parts = tuple(part for part in scene.records if part not in ("growth_rate", "separation"))
    recording = replace(Recording.of(scene), parts=parts, separation=None)
    wanted = min(workers, len(packed))
    cores = max(1, min(wanted, n_cores()))
    with _workers(cores) as pool:
        compiled = _load(pool, cores, kinds)
        begin = time.perf_counter() - start - compiled
        _pilot(pool, cores, kinds, recording)
    seen = [one for kind in kinds for one in kind.seen]
    busy = max(1.0, sum(one.seconds for one in seen) / sum(one.core_seconds for one in seen))
    failures = Counter(one.failure for one in seen if one.failure is not None)
    return Estimate(
        amounts=None if failures else _amounts(kinds, packed, cores, begin, busy),
        failures=dict(failures.most_common()),
        workers=wanted,
        cores=cores,
        n_pilot=len(seen),
        n_kinds=len(kinds),
        pilot_seconds=time.perf_counter() - start,
        start_seconds=begin,
        compile_seconds=compiled,
        busy=busy,
    )


def _kinds(members: list[Member]) -> list[_Kind]:
    """The kinds of some members, those of most work first."""
    kinds: dict[tuple[Any, ...], _Kind] = {}
    for member in members:
        is_coupled = member.perturbation_reading == "damping matrix"
        kinds.setdefault((member.n, member.engine, member.settings, is_coupled), _Kind()).members.append(member)
    return sorted(kinds.values(), key=lambda kind: -kind.cost)


def _amounts(kinds: list[_Kind], packed: Sequence[Batch], cores: int, begin: float, busy: float) -> Amounts:
    work, spread = _work(kinds)
    machine = math.hypot(_MACHINE, 2.0 * _OTHERS * (1.0 - 1.0 / busy))
    # the last batch may run alone
    tail = packed[-1].cost * work / sum(batch.cost for batch in packed)
    run = (work + len(packed) * _PER_BATCH) / cores + (0.5 * tail if cores > 1 else 0.0)
    apart = math.hypot(begin * _START_SPREAD, run * spread) / (begin + run)
    freedom = sum(len(kind.seen) - 1 for kind in kinds) + _PRIOR
    heads = len(packed) * max(one.head for kind in kinds for one in kind.seen)
    rows = sum(len(kind.members) * (kind.mean("bytes") + _SCALARS) for kind in kinds)
    low, middle, high = (heads + rows * factor for factor in _PAGES)
    return Amounts(
        n_bytes=(low, middle, high),
        core_seconds=_interval(work / busy, math.hypot(spread, _MACHINE), freedom),
        seconds=_interval(begin + run, math.hypot(apart, machine), freedom),
    )


def _work(kinds: list[_Kind]) -> tuple[float, float]:
    """Work of all members, in seconds of a core, and the standard deviation of its logarithm."""
    logs = [np.log([one.factor for one in kind.seen]) for kind in kinds]
    squares = sum(float(((log - log.mean()) ** 2).sum()) for log in logs)
    variance = (squares + _PRIOR * _SPREAD**2) / (sum(len(log) - 1 for log in logs) + _PRIOR)
    work = [kind.cost * kind.mean("factor") for kind in kinds]
    apart = stretched = 0.0
    for kind, one in zip(kinds, work, strict=True):
        share = one / sum(work)
        apart += share**2 * variance * (1 / len(kind.seen) + 1 / len(kind.members))
        stretched += share * _PER_DOUBLING * kind.mean("stretched")  # they err alike: no averaging
    return sum(work), math.sqrt(apart + stretched**2 + _MACHINE**2)


def _interval(middle: float, error: float, freedom: int) -> Interval:
    """By Student's t, of a logarithm with this standard error."""
    wide = math.exp(float(special.stdtrit(freedom, 0.5 + 0.5 * _LEVEL)) * error)
    return middle / wide, middle, middle * wide


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


def _pilot(pool: Executor, count: int, kinds: list[_Kind], recording: Recording) -> None:
    """Run a member of each kind, then more of those of most work, as long as the time lasts and none fails."""
    expected = sum(kind.cost for kind in kinds)
    left = count * min(max(_SHARE * expected / count, PILOT[0]), PILOT[1])
    piece = 0.4 * left / len(kinds)  # seconds that one may take
    running: dict[Future[_Seen], _Kind] = {}
    while True:
        new = [kind for kind in kinds if kind.n_asked == 0]
        more = [kind for kind in kinds if 0 < kind.n_asked < min(_ENOUGH, len(kind.members))] if left > 0 else []
        while (new or more) and len(running) < 2 * count:
            kind = new.pop(0) if new else min(more, key=lambda kind: kind.n_asked / kind.cost)
            factor = kind.mean("factor") if kind.seen else 1.0
            member = kind.next_member()
            running[pool.submit(_try, member, piece / (factor * member.cost), recording)] = kind
            more = [kind for kind in more if kind.n_asked < min(_ENOUGH, len(kind.members))]
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            one = future.result()
            running.pop(future).seen.append(one)
            left = left - one.seconds if one.failure is None else 0.0


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
    whole_row = {name: [value] for name, value in found.items()}
    bare = whole_row | {name: [[]] for name, value in found.items() if isinstance(value, np.ndarray | list)}
    full, head = (len(encode(columns, recording.schema)) for columns in (whole_row, bare))
    return _Seen(
        seconds=took,
        core_seconds=max(cores, 1e-6),
        factor=took / share / whole.cost,
        stretched=math.log2(1 / share),
        head=head,
        bytes=(full - head) / share,
        failure=found["reason"] if found["outcome"] == "failed" else None,
    )
