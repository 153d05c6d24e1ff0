"""What a run will take, before it is made: memory, and time and disk, from some members that are run here.

`Member.cost` says how work grows within one kind of members (one n, one setting of an engine), up to a factor that
the machine and the scene's physics set. A pilot finds it: members of each kind, of several matrices, cut short where
they are long.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

from distributed.system import MEMORY_LIMIT

from stickslip.pipeline.dataset.schema import encode, schema_of
from stickslip.pipeline.ensemble.expand import Members
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.machine.processes import n_cores
from stickslip.pipeline.records.record import Memory
from stickslip.pipeline.running.worker import columns, run_members
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene

#: Seconds that the members of a pilot may take together, and how many of a kind are run at most.
PILOT, _ENOUGH = 3.0, 256
#: The factor by which the truth may lie above or below, nine times in ten.
WITHIN = 2.0


def check_memory(scene: Scene, workers: int) -> None:
    """See that a worker of this machine can hold the scene's largest system, from the numbers alone.

    Raises `SceneError` if it cannot.
    """
    n = max(scene.system.n)
    room = MEMORY_LIMIT / max(1, min(workers, scene.n_members))
    takes = [("system.n", Memory(scene.system.bytes_of_system, "drawing a system", "lower n"))]
    of_records = ((f"record.{record.name}", record.memory(scene.facts)) for record in scene.records)
    takes += [(key, memory) for key, memory in of_records if memory is not None]
    for key, (needed, what, advice) in takes:
        if needed > room:
            raise SceneError(
                f"{key}: expected what a worker can hold, got n = {n}, with which {what} takes {needed / 1e9:.3g} GB "
                f"where each has {room / 1e9:.3g} GB; {advice}, or use fewer workers or a larger machine"
            )


@dataclass(frozen=True)
class Estimate:
    """What a run will take, up to a factor `WITHIN`; members that fail say nothing about the others."""

    workers: int  #: that have a shard, and a core, of their own
    core_seconds: float
    seconds: float
    n_bytes: float
    failures: dict[str, int]  #: members of the pilot that failed, by reason


def estimate(scene: Scene, packed: Sequence[Batch], workers: int) -> Estimate:
    """Estimate a run of some batches of a scene, at least one, on local processes."""
    kinds: dict[tuple[Any, ...], list[Members]] = {}  # whose work grows by one formula
    for members in (members for batch in packed for members in batch.members.by_variant()):
        example = members[0]
        is_coupled = example.change.reading == "damping matrix"
        kinds.setdefault((example.n, example.engine, example.settings, is_coupled), []).append(members)
    # what is shared between members is known by its formula; the pilot runs them alone
    recording = replace(scene.recording, records=tuple(record for record in scene.records if not record.is_shared))
    core_seconds = n_bytes = head = 0.0
    failures: Counter[str] = Counter()
    for groups in kinds.values():
        factor, a_head, a_row, reasons = _pilot(groups, PILOT / len(kinds), recording)
        core_seconds += factor * sum(len(members) * members[0].cost for members in groups)
        head, n_bytes = max(head, a_head), n_bytes + sum(map(len, groups)) * a_row
        failures.update(reasons)
    count = max(1, min(workers, len(packed), n_cores()))
    # the last batch may run alone
    tail = packed[-1].cost / sum(batch.cost for batch in packed) * (count > 1)
    seconds = core_seconds * (1.0 / count + 0.5 * tail)
    return Estimate(count, core_seconds, seconds, n_bytes + head * len(packed), dict(failures.most_common()))


def _pilot(groups: Sequence[Members], seconds: float, recording: Recording) -> tuple[float, float, float, list[str]]:
    """Of one kind: seconds of a core for a unit of cost, bytes of a first row and of a further one, failures."""
    # the golden section spreads any number of places evenly over matrices and changes
    ends = [*accumulate(map(len, groups))]
    places = [int(k * 0.6180339887498949 % 1.0 * ends[-1]) for k in range(min(_ENOUGH, ends[-1]))]
    chosen = ((groups[group := bisect_right(ends, k)], k - ends[group]) for k in places)
    chosen_members = [replace(members[k + len(members)], shared_cost=0.0) for members, k in chosen]
    # each point of a sweep may need kernels of its own, and to compile or load them is no part of the work
    points = {_point(member): member for member in chosen_members}
    run_members([replace(point, t_end=1e-6) for point in points.values()], recording)
    tried, table, factor = _run(chosen_members[:1], min(0.2 * seconds / chosen_members[0].cost, 1.0), recording)
    # as many as there is time for, run together as in a batch
    expected = factor * chosen_members[0].cost
    share = min(0.4 * seconds / expected, 1.0)
    sample = chosen_members[1 : 1 + max(1, int(seconds / (share * expected)))]
    if sample:
        further, of_sample, factor = _run(sample, share, recording)
        tried, table = tried + further, {name: values + of_sample[name] for name, values in table.items()}
    # the first row of a shard takes more than the next ones, which are like it
    n_rows, schema = 1 + len(sample), schema_of(recording)
    n_first, n_all = (len(encode({name: table[name][:k] for name in table}, schema)) for k in (1, n_rows))
    a_row = (n_all - n_first) / (tried * (1.0 - 1.0 / n_rows)) if sample else n_first / tried
    outcomes = zip(table["outcome"], table["reason"], strict=True)
    return factor, n_first, a_row, [reason for outcome, reason in outcomes if outcome == "failed"]


def _point(member: Member) -> Member:
    """What members share that differ only in their draws."""
    source, change, begin = member.source._replace(matrix=0), member.change, member.begin._replace(draw=None)
    return replace(member, member_id="", source=source, change=change._replace(draw=None), begin=begin)


def _run(members: Sequence[Member], share: float, recording: Recording) -> tuple[float, dict[str, list[Any]], float]:
    """Run a share of each member: how many whole ones that makes, their columns, core-seconds for a unit of cost."""
    shortened = [replace(member, t_end=max(share * member.t_end, min(10.0, member.t_end))) for member in members]
    start = time.process_time()
    table = columns(shortened, run_members(shortened, recording), recording)
    took = max(time.process_time() - start, 1e-6)
    # one that ended early would also have done so if it were run whole
    shares = [
        short_member.cost / member.cost if outcome == "finished" else 1.0
        for short_member, member, outcome in zip(shortened, members, table["outcome"], strict=True)
    ]
    return sum(shares), table, took / sum(a * member.cost for a, member in zip(shares, members, strict=True))
