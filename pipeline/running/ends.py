"""Starts that are the ends of another dataset's members: which of them, and the state that they ended in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

from stickslip.pipeline import query
from stickslip.pipeline.dataset.opened import open_dataset
from stickslip.pipeline.design.units import Units
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.member import Member, State
from stickslip.pipeline.errors import SceneError, StoreError
from stickslip.pipeline.records import End
from stickslip.pipeline.scene.scene import Scene
from stickslip.pipeline.scene.system_table import QUANTITIES

#: Of several members of the same system those are kept that agree in these, one after the other, if any do.
_ALIKE: tuple[Callable[[Member], Any], ...] = (
    lambda member: member.begin.draw,
    *(partial(lambda name, member: member.term(name), name) for name in (*QUANTITIES, "back_slip")),
    lambda member: member.source.parameters,
    lambda member: member.change.twin_size,
    lambda member: member.engine,
    lambda member: member.settings,
    lambda member: member.ratio_draw,
)


def check(scene: Scene) -> None:
    """See that each member of a scene has an end to start at; asked before a scene is run, not when it is read.

    Raises `SceneError` if one has none, or several.
    """
    if scene.ends is None:
        return
    dataset = _with_ends(scene.ends.at, scene.ends.sha256)
    if dataset.units != scene.unit_names:
        raise SceneError(
            f"start.dataset: expected a dataset in the units of the scene, {scene.unit_names or 'none'}, got"
            f" {scene.ends.name} in {dataset.units or 'none'}; write the same [units]"
        )
    for member in expand(scene):
        name = dataset.match(member)
        outcome = dataset.outcomes.get(name)
        if outcome not in ("finished", "collapsed"):
            raise SceneError(
                f"start.dataset: expected members that came to their end, got {name} of {scene.ends.name}, which is "
                f"{outcome or 'not done'}; rerun its scene, or leave out what starts there"
            )


def end_of(member: Member) -> State | None:
    """z and w, each of shape (n,), at the end at which a member starts; None if it starts at none.

    Raises `SceneError` if the dataset is gone or has changed; or as `check`.
    """
    ends = member.begin.ends
    if ends is None:
        return None
    dataset = _with_ends(ends.at, ends.sha256)
    (z, w), (length, speed) = dataset.states[dataset.match(member)], member.state_scales
    return z / length, w / speed


@dataclass(frozen=True)
class _WithEnds:
    """A dataset with ends: members by what they must share with others, outcomes, and states in its units."""

    at: str
    like: Mapping[tuple[Any, ...], Sequence[Member]]
    outcomes: Mapping[str, str]
    units: Units
    states: Mapping[str, State]

    def match(self, member: Member) -> str:
        """The id of the one at whose end a member starts."""
        candidates = self.like.get(_same(member), ())
        for trait in _ALIKE:
            candidates = [candidate for candidate in candidates if trait(candidate) == trait(member)] or candidates
        draw = member.begin.draw
        if not candidates or (draw is not None and candidates[0].begin.draw != draw):
            raise SceneError(
                f"start.dataset: expected a member of {self.at} of the same system as {member.member_id}, found "
                f"none; seed, n, matrices and draws must be there too"
            )
        if len(candidates) > 1:
            raise SceneError(
                f"start.dataset: expected one member of {self.at} to start {member.member_id} from, got "
                f"{len(candidates)}, {candidates[0].member_id} and {candidates[1].member_id} first; sweep the same "
                f"keys here, write `draws` for starts that were drawn, or name a smaller dataset"
            )
        return candidates[0].member_id


def _same(member: Member) -> tuple[Any, ...]:
    """What a member and the one at whose end it starts must share: the system, perturbed or not."""
    return *member.source._replace(parameters=(), names=()), *member.change._replace(twin_size=None)


@lru_cache(maxsize=2)
def _with_ends(at: str, sha256: str) -> _WithEnds:
    """The dataset with ends that lies at `at`, if its data have this digest."""
    try:
        opened = open_dataset(at)
    except StoreError as error:
        raise SceneError(f"start.dataset: {error}") from None
    if opened.manifest.digest != sha256:
        raise SceneError(
            f"start.dataset: expected {at} as it was when the scene was read (digest {sha256[:12]}), got another "
            f"(digest {opened.manifest.digest[:12]}); restore it, or run the scene into another directory"
        )
    if not opened.scene.keeps(End):
        raise SceneError(
            f"start.dataset: expected a dataset with the ends of its runs, got {at} without; run its scene with "
            f"`end = true` under [record]"
        )
    like: dict[tuple[Any, ...], list[Member]] = {}
    for member in expand(opened.scene):
        like.setdefault(_same(member), []).append(member)
    columns = query.table(opened, ["member_id", "outcome"]).to_pydict()
    outcomes = dict(zip(columns["member_id"], columns["outcome"], strict=True))
    return _WithEnds(at, like, outcomes, opened.scene.unit_names, query.ends(opened))
