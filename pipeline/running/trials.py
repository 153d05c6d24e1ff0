"""Functions of a user's own are tried on a run of the scene before others are made."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from heapq import nsmallest

from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.errors import SceneError
from stickslip.pipeline.own.trial import Trial, tried
from stickslip.pipeline.records.own import KEY, OwnRecord
from stickslip.pipeline.records.record import Made
from stickslip.pipeline.running.worker import made
from stickslip.pipeline.scene.scene import Scene


def check_functions(scene: Scene, todo: Sequence[Batch]) -> None:
    """Try what functions of the user's own measure on the cheapest of some members, twice and in two processes.

    One process has measured the next cheapest before, the other measures it afterwards: that shows what is kept from
    call to call. A number that is not finite is no mistake, for it may be of this run, and neither is anything that
    goes wrong with the next cheapest; a run that fails says so itself. Raises `SceneError` if a function raises,
    returns what it does not declare, or not the same each time, or takes too long.
    """
    record = scene.own_record
    if record is None or not todo:
        return
    firsts = (member for batch in todo for member in batch.members.firsts())
    members = nsmallest(2, firsts, key=lambda member: member.cost)
    names = ", ".join(measure.function.name for measure in record.functions)
    facts = tried(
        Trial(
            KEY,
            str(scene.folder.resolve()),
            partial(_attempt, record, members[0], members),
            f"{names}, on the run {members[0].member_id}",
            "the columns that it declares",
            "expected the same each time for the same run, got values that differ; draw nothing at random, or with"
            " a seed of its own, and keep nothing from call to call",
            partial(_runs, record, members),
            partial(_attempt, record, members[0], members[::-1]),
        )
    )
    loaded = {name for measure in record.functions for name, _ in measure.function.beside}
    late = sorted(facts["beside"].keys() - loaded)
    if late:
        raise SceneError(
            f"{KEY}: {names}: expected {late[0]} to be read when the module is loaded, so that a change of it is"
            f" noticed, got it read later; read it at the top of the module"
        )


@lru_cache(maxsize=2)
def _run(record: OwnRecord, member: Member) -> Made | None:
    """In a child: a member that was run for a record; None if that failed."""
    try:
        return made(member, record)
    except Exception:  # noqa: BLE001  it fails again, and its row says so
        return None


def _runs(record: OwnRecord, members: Sequence[Member]) -> None:
    """In a child: run some members."""
    for member in members:
        _run(record, member)


def _attempt(record: OwnRecord, strict: Member, members: Sequence[Member]) -> tuple[bytes, dict[str, str]]:
    """In a child: what all functions of a record measure of members in turn; of one, nothing may go wrong."""
    values = [
        (member.member_id, _measured(record, member, member.member_id == strict.member_id)) for member in members
    ]
    return repr(sorted(values)).encode(), {}


def _measured(record: OwnRecord, member: Member, is_strict: bool) -> str:
    run = _run(record, member)
    if run is None:
        return ""
    for measure in record.functions if is_strict else ():
        measured = record.measured(measure, run)
        if measured.is_wrong:
            words = measured.problem.removeprefix(f"{KEY}: {measure.function.name}: ")
            raise SceneError(
                f"{KEY}: {measure.function.name}, on the run {member.member_id}: {words}; correct the function"
            )
    return repr(record.of(run))
