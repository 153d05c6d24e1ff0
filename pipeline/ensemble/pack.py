"""The shards of a dataset: members packed into batches, scene by scene as it grew."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from stickslip.pipeline.design.design import Coordinates
from stickslip.pipeline.ensemble.expand import Members, expand
from stickslip.pipeline.ensemble.numbering import Numbering
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.scene.columns import Recording
from stickslip.pipeline.scene.scene import Scene, parse_scene

#: Work in a batch, in units of `Member.cost`, about a second each. It does not depend on the number of workers: the
#: names and bytes of shards would then depend on it too.
TARGET_COST = 1.0
#: A scene of more than `_MANY` batches has larger ones, up to `_LARGER` times as large.
_LARGER, _MANY = 5.0, 500
#: A batch is at most this share of the work that is left, so that workers end together, but at least that of a batch.
_OF_REST, _SMALLEST = 0.25, 0.25


@dataclass(frozen=True)
class Batch:
    """Consecutive members that are computed together and kept in one shard."""

    number: int  #: its place among the dataset's shards
    members: Members
    recording: Recording  #: what to keep of them
    #: Of all members of their scene; in another process there are their coordinates alone.
    numbering: Numbering | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "numbering": None, "coordinates": self.coordinates}

    @cached_property
    def coordinates(self) -> Coordinates | None:
        """Where its members stand in the design of their scene, by the numbers of the dataset."""
        return None if self.numbering is None else self.numbering.of(self.members.places)

    @cached_property
    def name(self) -> str:
        """The name of the shard, which tells what it holds."""
        content = "\n".join([self.recording.scene_hash, *self.members.ids()])
        return f"shard-{self.number:05d}-{hashlib.sha256(content.encode()).hexdigest()[:12]}.parquet"

    @cached_property
    def cost(self) -> float:
        """Estimated work, about seconds of one core."""
        return sum(self.members.costs())


def number_of(name: str) -> int:
    """The number of a shard, from its name; -1 if it is not the name of one."""
    match = re.match(r"shard-([0-9]{1,10})-", name)
    return -1 if match is None else int(match[1])


def _sizes(members: Members) -> list[int]:
    """The numbers of members of the batches."""
    remaining = sum(members.costs())
    largest = min(max(TARGET_COST, remaining / _MANY), _LARGER * TARGET_COST)
    sizes: list[int] = []
    room = -math.inf
    for cost in members.costs():
        if cost > room:
            sizes.append(0)
            room = min(largest, max(_OF_REST * remaining, _SMALLEST * largest))
        sizes[-1] += 1
        room -= cost
        remaining -= cost
    return sizes


class PlanError(ValueError):
    """The packing does not fit the members of the scene."""


def tasks(scene: Scene, earlier: Sequence[str] = (), packing: Sequence[Sequence[int]] | None = None) -> list[Batch]:
    """The shards of a dataset, in order.

    Raises `PlanError` if the numbers are not those of the scenes' members, or an earlier scene cannot be read.

    Parameters
    ----------
    earlier : sequence of str
        Sources of the scenes that it grew from, the first one first.
    packing : sequence of sequences of int
        For each of these and for `scene`: the number of members of each shard that it added; left out, as `pack`
        packs `scene` alone.
    """
    try:
        scenes = [*(parse_scene(source.encode(), folder=scene.folder) for source in earlier), scene]
    except SceneError as error:
        raise PlanError(str(error)) from error
    planned: list[Batch] = []
    packing = [pack(scene, None)] if packing is None else packing
    for stage, numbering, sizes in zip(scenes, numberings(scenes), packing, strict=True):
        new = expand(stage).at(numbering.added.tolist()) if numbering.before else expand(stage)
        if sum(sizes) != len(new):
            raise PlanError(f"expected shards of {len(new)} members together, got {sum(sizes)}")
        recording, start = stage.recording, 0
        for size in sizes:
            planned.append(Batch(len(planned), new[start : start + size], recording, numbering))
            start += size
    return planned


def numberings(scenes: Sequence[Scene]) -> list[Numbering]:
    """How the members of scenes that grew from each other are numbered.

    Raises `PlanError` if one lacks members of the scene before it.
    """
    chain: list[Numbering] = []
    for scene in scenes:
        chain.append(Numbering(expand(scene).ensemble, chain[-1] if chain else None))
        try:
            chain[-1].kept  # noqa: B018
        except KeyError as error:
            raise PlanError(f"expected all members of the scene that it grew from, got none of {error}") from None
    return chain


def added(scene: Scene, earlier: Scene | None) -> Members:
    """The members that a scene adds to the one that it grew from; all of them if it grew from none."""
    members = expand(scene)
    return members if earlier is None else members.at(numberings([earlier, scene])[-1].added.tolist())


def pack(scene: Scene, earlier: Scene | None) -> tuple[int, ...]:
    """The number of members of each shard that a scene adds to the one that it grew from."""
    return tuple(_sizes(added(scene, earlier)))


def grows(stored: Scene, larger: Scene) -> bool:
    """Whether the wanted scene has all members of the stored one, unchanged, and more, and keeps the same of them."""
    recording, larger_recording = stored.recording, larger.recording
    return recording == replace(larger_recording, scene_hash=recording.scene_hash) and _adds_to(stored, larger)


def lacked(stored: Scene, larger: Scene) -> list[str]:
    """Columns that data of the stored scene lack, in words, if it is these that keep it from being the wanted one."""
    stored_columns = {column.name: column for column in stored.recording.columns}
    columns = [column for column in larger.recording.columns if stored_columns.get(column.name) != column]
    new = [column.name for column in columns if column.name not in stored_columns]
    names = new or [f"{column.name} of another kind" for column in columns]
    return names if names and (_adds_to(stored, larger) or expand(stored) == expand(larger)) else []


def _adds_to(stored: Scene, larger: Scene) -> bool:
    if larger.n_members <= stored.n_members:
        return False
    members = expand(larger)
    place = {name: k for k, name in enumerate(members.ids())}
    return all(member.member_id in place and members[place[member.member_id]] == member for member in expand(stored))
