"""What a run will take, before it is made: time and disk, from some members that are run here.

`Member.cost` says how work grows within one kind of members (one n, one setting of an engine), up to a factor that
the machine and the scene's physics set. A pilot finds it: members of each kind, of several matrices, cut short where
they are long.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stickslip.pipeline.design import Batch, Member
from stickslip.pipeline.processes import n_cores
from stickslip.pipeline.scene import Scene
from stickslip.pipeline.schema import Recording, encode
from stickslip.pipeline.worker import load_kernels, row

#: Seconds that the members of a pilot may take together, and how many of a kind are run at most.
PILOT, _ENOUGH = 3.0, 40


@dataclass(frozen=True)
class Estimate:
    """What a run will take, as a rule within a factor of two; nothing of failed members follows for the others."""

    workers: int  #: that have a shard, and a core, of their own
    core_seconds: float
    seconds: float
    n_bytes: float
    failures: dict[str, int]  #: members of the pilot that failed, by reason


def estimate(scene: Scene, packed: Sequence[Batch], workers: int) -> Estimate:
    """Estimate a run of some batches of a scene, one at least, on so many local processes."""
    kinds: dict[tuple[Any, ...], list[Member]] = {}
    for member in (member for batch in packed for member in batch.members):
        is_coupled = member.perturbation_reading == "damping matrix"
        kinds.setdefault((member.n, member.engine, member.settings, is_coupled), []).append(member)
    load_kernels(members[0] for members in kinds.values())
    # what is shared between members is known by its formula; the pilot runs them alone
    parts = tuple(part for part in scene.records if part not in ("growth_rate", "separation"))
    recording = replace(Recording.of(scene), parts=parts, separation=None)
    core_seconds = n_bytes = head = 0.0
    failures: Counter[str] = Counter()
    for members in kinds.values():
        rows, share, factor = _pilot(members, PILOT / len(kinds), recording)
        core_seconds += factor * sum(member.cost for member in members)
        # the first row of a shard takes more than the next ones, which are like it
        first, whole = (_size(some, recording) for some in (rows[:1], rows))
        a_row = (whole - first) / (share * (1.0 - 1.0 / len(rows))) if len(rows) > 1 else first / share
        head, n_bytes = max(head, first), n_bytes + len(members) * a_row
        failures.update(one["reason"] for one in rows if one["outcome"] == "failed")
    count = max(1, min(workers, len(packed), n_cores()))
    # the last batch may run alone
    tail = packed[-1].cost / sum(batch.cost for batch in packed) * (count > 1)
    seconds = core_seconds * (1.0 / count + 0.5 * tail)
    return Estimate(count, core_seconds, seconds, n_bytes + head * len(packed), dict(failures.most_common()))


def _size(rows: Sequence[dict[str, Any]], recording: Recording) -> int:
    return len(encode({name: [one[name] for one in rows] for name in recording.schema.names}, recording.schema))


def _pilot(
    members: Sequence[Member], seconds: float, recording: Recording
) -> tuple[list[dict[str, Any]], float, float]:
    """Rows of members of one kind, how many whole ones they amount to, and seconds of a core for a unit of cost."""
    rows: list[dict[str, Any]] = []
    factors: list[float] = []
    share, left = 0.0, seconds
    while left > 0 and len(rows) < min(_ENOUGH, len(members)):
        # the golden section spreads any number of places evenly over matrices and changes
        member = members[int(len(rows) * 0.6180339887498949 % 1.0 * len(members))]
        whole = replace(member, shared_cost=0.0)
        expected = whole.cost * (float(np.mean(factors)) if factors else 1.0)
        t_end = max(min(0.4 * seconds / expected, 1.0) * whole.t_end, min(10.0, whole.t_end))
        begun = time.process_time()
        rows.append(row(replace(whole, t_end=t_end), recording))
        took = time.process_time() - begun
        left -= took
        # one that ended early would have, whole
        done = replace(whole, t_end=t_end).cost / whole.cost if rows[-1]["outcome"] == "finished" else 1.0
        share += done
        factors.append(max(took, 1e-6) / (done * whole.cost))
    return rows, share, float(np.mean(factors))
