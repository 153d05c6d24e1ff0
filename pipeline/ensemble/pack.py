"""The shards of a dataset: members packed into batches, scene by scene as it grew."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene, parse_scene

#: Work in a batch, in units of `Member.cost` (about a second each), and how many times as much in a scene of more
#: than so many batches. Not chosen by the number of workers, on which the shards' names and bytes would then depend.
TARGET_COST = 1.0
_LARGER, _MANY = 5.0, 500
#: A batch is at most such a part of what is left, so that workers end together; but not below such a part of a batch.
_OF_REST, _SMALLEST = 0.25, 0.25


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive members that are computed together and kept in one shard, `name`."""

    name: str
    members: tuple[Member, ...]

    @property
    def cost(self) -> float:
        """Estimated work, about seconds of one core."""
        return sum(member.cost for member in self.members)


def _sizes(members: Sequence[Member]) -> list[int]:
    """The numbers of members of the batches."""
    costs = [member.cost for member in members]
    rest = sum(costs)
    largest = min(max(TARGET_COST, rest / _MANY), _LARGER * TARGET_COST)
    sizes: list[int] = []
    room = -math.inf
    for cost in costs:
        if cost > room:
            sizes.append(0)
            room = min(largest, max(_OF_REST * rest, _SMALLEST * largest))
        sizes[-1] += 1
        room -= cost
        rest -= cost
    return sizes


def as_batch(number: int, members: tuple[Member, ...], scene_hash: str) -> Batch:
    """The batch of some members; `number` is its place among the dataset's shards."""
    content = "\n".join([scene_hash, *(member.member_id for member in members)])
    return Batch(f"shard-{number:05d}-{hashlib.sha256(content.encode()).hexdigest()[:12]}.parquet", members)


#: A shard to be: its members, and what to keep of them.
Task = tuple[Batch, Recording]


class PlanError(ValueError):
    """The members that are planned are not those of the scene."""


def tasks(scene: Scene, earlier: Sequence[str] = (), packing: Sequence[Sequence[int]] | None = None) -> list[Task]:
    """The shards of a dataset, in order.

    Parameters
    ----------
    scene : Scene
    earlier : sequence of str
        Sources of the scenes that it grew from, the first one first.
    packing : sequence of sequences of int
        For each of these and for `scene`: the number of members of each shard that it added; left out, as `pack`
        packs `scene` alone.

    Raises
    ------
    PlanError
        If the numbers are not those of the scenes' members, or an earlier scene cannot be read.
    """
    try:
        scenes = [*(parse_scene(source.encode(), folder=scene.folder) for source in earlier), scene]
    except SceneError as error:
        raise PlanError(str(error)) from error
    planned: list[Task] = []
    known: set[str] = set()
    packing = [pack(scene, known)] if packing is None else packing
    for stage, sizes in zip(scenes, packing, strict=True):
        new = added(stage, known)
        if sum(sizes) != len(new):
            raise PlanError(f"expected shards of {len(new)} members together, got {sum(sizes)}")
        rest, recording = iter(new), Recording.of(stage)
        for size in sizes:
            batch = as_batch(len(planned), tuple(islice(rest, size)), recording.scene_hash)
            planned.append((batch, recording))
        known.update(member.member_id for member in new)
    return planned


def added(scene: Scene, known: set[str]) -> list[Member]:
    """The members of a scene that are not yet known by their ids."""
    return [member for member in expand(scene) if member.member_id not in known]


def pack(scene: Scene, known: set[str]) -> tuple[int, ...]:
    """The number of members of each shard that a scene adds to the known members."""
    return tuple(_sizes(added(scene, known)))


def grows(stored: Scene, wanted: Scene) -> bool:
    """Whether all that the stored scene says holds for the wanted one too, which adds members and changes none."""
    one, other = Recording.of(stored), Recording.of(wanted)
    if one != replace(other, scene_hash=one.scene_hash) or wanted.n_members <= stored.n_members:
        return False
    members = {member.member_id: member for member in expand(wanted)}
    return all(members.get(member.member_id) == member for member in expand(stored))
