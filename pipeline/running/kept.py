"""Rows of a finished dataset to which records are added: computed from what is kept, or by running members again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn, cast

import numpy as np
import pyarrow as pa

from stickslip import sim
from stickslip.pipeline.dataset.schema import Values, schema_of
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.errors import StoreError, foreign
from stickslip.pipeline.records import ALWAYS
from stickslip.pipeline.records.record import Made, NotKeptError, Record, stop_early
from stickslip.pipeline.records.slips.thresholds import has_several
from stickslip.pipeline.running.ends import end_of
from stickslip.pipeline.scene.columns import DESIGN, MEMBER, Recording

#: Runs members: the columns of each, as `stickslip.pipeline.running.worker.run_members`.
Runs = Callable[[Sequence[Member], Recording], list[dict[str, Any]]]

#: Columns that no record reads: they are the member's own, or made of its events.
_UNREAD = {column.name for column in (*MEMBER, *DESIGN)} - {"t_end"} | {"t", "n_stick"}


@dataclass(frozen=True)
class Kept:
    """The rows of some members, in order, and the records that they have."""

    table: pa.Table
    records: tuple[Record, ...]

    def extended(self, members: Sequence[Member], recording: Recording, run: Runs) -> dict[str, Values]:
        """The columns of `recording`: those that are kept as they are, and those of the new records.

        `run` is called with the members for which the rows do not hold what a new record needs.

        Raises
        ------
        StoreError
            If a run that is made again is not the one that is kept, or a record cannot be computed.
        """
        new = added(recording.records, self.records)
        held = held_by(self.records)
        rows: list[dict[str, Any]] = [{} for _ in members]
        again = []
        for k, (member, outcome) in enumerate(zip(members, self.table["outcome"].to_pylist(), strict=True)):
            if must_run(member, outcome, new, held):
                again.append(k)
            elif outcome != "failed":
                rows[k] = self._computed(member, k, new)
        # a record may take from those before it, and a run ends earlier where one asks for its certificate
        asked = tuple(
            record
            for record in recording.records
            if record in new or record.is_certified or any(record.name in each.needs for each in new)
        )
        found = run([members[k] for k in again], replace(recording, records=asked))
        self._check([members[k] for k in again], again, found, [one for one in asked if one not in new])
        for k, one in zip(again, found, strict=True):
            rows[k] = one
        kept = self.table.column_names
        return {
            field.name: self.table[field.name].combine_chunks().cast(field.type)
            if field.name in kept
            else [row.get(field.name) for row in rows]
            for field in schema_of(recording)
        }

    def needs_runs(self, members: Sequence[Member], recording: Recording) -> bool:
        """Whether a member has to be run again."""
        new, outcomes = added(recording.records, self.records), self.table["outcome"].to_pylist()
        held = held_by(self.records)
        return any(must_run(*one, new, held) for one in zip(members, outcomes, strict=True))

    @cached_property
    def _of_runs(self) -> dict[str, pa.Array]:
        """The columns that say what came of the members, not what they are."""
        names = [name for name in self.table.column_names if name not in _UNREAD]
        return {name: self.table[name].combine_chunks() for name in names}

    def _computed(self, member: Member, k: int, new: Sequence[Record]) -> dict[str, Any]:
        """The columns of new records of a member, from its row."""
        row = {name: values[k] for name, values in self._of_runs.items()}
        has_system = any("system" in record.needs for record in new)
        made = Made(
            member,
            member.system() if has_system else cast("sim.System", _NotKept("system")),
            _run(row, self.records, has_several(dict(member.settings))),
            member.start(end_of(member)) if has_system else cast("tuple[Any, Any]", _NotKept("start")),
            cast("Callable[..., sim.Samples]", _NotKept("again")),
            {name: _value(one) for name, one in row.items() if one.is_valid},
            stop_early(self.records),
        )
        found: dict[str, Any] = {}
        for record in new:
            if record.applies(member):
                try:
                    found |= record.of(made)
                except Exception as error:
                    raise StoreError(
                        f"record.{record.name}: expected a value for {member.member_id}, got {foreign(error)}; the"
                        f" dataset is as it was: leave the record out"
                    ) from error
                made.found.update(found)
        return found

    def _check(
        self, members: Sequence[Member], at: list[int], found: list[dict[str, Any]], others: Sequence[Record]
    ) -> None:
        """See that runs that were made again are those that are kept."""
        of_kept = self.table.take(pa.array(at, pa.int64()))
        for column in (column for record in (ALWAYS, *others) for column in record.kept):
            before = of_kept[column.name].combine_chunks()
            now = pa.array([one.get(column.name) for one in found], before.type)
            if not now.equals(before):
                k = next(k for k in range(len(now)) if now[k] != before[k])
                failed = found[k].get("reason") if found[k]["outcome"] == "failed" else None
                raise StoreError(
                    f"{members[k].member_id}: expected the run that is kept, got another ({failed or column.name});"
                    f" the dataset is as it was: extend it on the machine that ran it, with the same versions, or run"
                    f" the scene with the record into another directory"
                )


def added(records: Sequence[Record], kept: Sequence[Record]) -> tuple[Record, ...]:
    """Those of `records` that are not kept."""
    return tuple(one for one in records if one not in kept)


def held_by(kept: Sequence[Record]) -> Set[str]:
    """What a row holds of a run by the records that are kept, and what is had without one: names as in `needs`."""
    return {"system", *(record.name for record in kept)}


def reads_more(record: Record, held: Set[str]) -> bool:
    """Whether a record reads more of a run than what is held of it: names as in `Record.needs`."""
    return record.is_sampled or not record.needs <= held


def must_run(member: Member, outcome: str, new: Sequence[Record], held: Set[str]) -> bool:
    """Whether a member is run again for new records, of a dataset that holds so much of it."""
    return outcome != "failed" and any(reads_more(one, held) for one in new if one.applies(member))


def _run(row: Mapping[str, pa.Scalar], kept: Sequence[Record], has_thresholds: bool) -> sim.Run:
    """A run as far as a row has it; with other definitions of sticking, `thresholds`, or not."""
    names = {record.name for record in kept}
    outcome, t_stop = row["outcome"].as_py(), row["t_stop"].as_py()
    # nothing happens any more after a collapse: the run is known to the end
    end = t_stop if outcome == "diverged" else row["t_end"].as_py()
    events: Any = _NotKept("events")
    if "events" in names:
        t, block, mode = (_value(row[f"event_{name}"]) for name in ("t", "block", "mode"))
        events = sim.EventSeries(t, block, mode, _value(row["initial_mode"]), t_start=0.0, t_end=end)
    z, w = (_value(row[name]) if "end" in names else cast("Any", _NotKept(name)) for name in ("z_end", "w_end"))
    counts = [row[name].as_py() for name in ("n_steps", "n_rejected", "n_products", "n_events")]
    return sim.Run(
        z=z,
        w=w,
        t_end=end,
        events=events,
        outcome=outcome,
        reason=row["reason"].as_py() or "",
        stats=sim.Stats(*counts),
        t_collapse=t_stop if outcome == "collapsed" else None,
        samples=cast("sim.Samples", _NotKept("samples")),
        stills=cast("Any", _NotKept("stills")),
        by_threshold=cast("Any", _NotKept("by_threshold")) if has_thresholds else {},
    )


def _value(entry: pa.Scalar) -> Any:
    """A value of a row; a list of numbers as an array of its own."""
    if isinstance(entry, pa.ListScalar) and pa.types.is_primitive(entry.type.value_type):
        return np.array(entry.values.to_numpy(zero_copy_only=False))
    return entry.as_py()


class _NotKept:
    """Stands for what a row does not hold."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __getattr__(self, name: str) -> NoReturn:
        self._refuse()

    def __array__(self, *_: object, **__: object) -> NoReturn:
        self._refuse()

    def __iter__(self) -> NoReturn:
        self._refuse()

    def __bool__(self) -> NoReturn:
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise NotKeptError(
            f"{self._what}: expected a record that names in `needs` what it reads, got one that does not"
        )
