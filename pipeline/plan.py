"""Which shards a dataset consists of: fixed when a scene is first run, extended when it grows, never packed anew."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from stickslip.pipeline.design import Batch, Member, as_batch, batches, expand
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.scene import Scene, parse_scene
from stickslip.pipeline.schema import Recording

#: A shard to be: its members, and what to keep of them.
Task = tuple[Batch, Recording]


class PlanError(ValueError):
    """The members that are planned are not those of the scene."""


def tasks(scene: Scene, earlier: Sequence[str], packing: Sequence[Sequence[int]]) -> list[Task]:
    """The shards of a dataset, in order.

    Parameters
    ----------
    scene : Scene
    earlier : sequence of str
        Sources of the scenes that it grew from, the first one first.
    packing : sequence of sequences of int
        For each of these and for `scene`: the number of members of each shard that it added.

    Raises
    ------
    PlanError
        If the numbers are not those of the scenes' members, or an earlier scene cannot be read.
    """
    try:
        scenes = [*(parse_scene(source.encode()) for source in earlier), scene]
    except SceneError as error:
        raise PlanError(str(error)) from error
    planned: list[Task] = []
    known: set[str] = set()
    for stage, sizes in zip(scenes, packing, strict=True):
        new = added(stage, known)
        if sum(sizes) != len(new):
            raise PlanError(f"expected shards of {len(new)} members together, got {sum(sizes)}")
        rest, recording = iter(new), Recording.of(stage)
        for size in sizes:
            batch = as_batch(len(planned), tuple(islice(rest, size)), stage.hash)
            planned.append((batch, recording))
        known.update(member.member_id for member in new)
    return planned


def added(scene: Scene, known: set[str]) -> list[Member]:
    """The members of a scene that are not yet known by their ids."""
    return [member for member in expand(scene) if member.member_id not in known]


def pack(scene: Scene, known: set[str]) -> tuple[int, ...]:
    """The number of members of each shard that a scene adds to the known members."""
    return tuple(len(batch.members) for batch in batches(added(scene, known), scene.hash))


def grows(stored: Scene, wanted: Scene) -> bool:
    """Whether all that the stored scene says holds for the wanted one too, which adds members and changes none."""
    one, other = Recording.of(stored), Recording.of(wanted)
    if (one.parts, one.separation) != (other.parts, other.separation) or wanted.n_members <= stored.n_members:
        return False
    members = {member.member_id: member for member in expand(wanted)}
    return all(members.get(member.member_id) == member for member in expand(stored))
