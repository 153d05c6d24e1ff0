"""Rows that a dataset has of members of another scene: what they hold of a run is not computed again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NoReturn, cast

import numpy as np
import pyarrow as pa

from stickslip import sim
from stickslip.pipeline.dataset.opened import Opened
from stickslip.pipeline.dataset.schema import Values, schema_of
from stickslip.pipeline.ensemble.expand import Members
from stickslip.pipeline.ensemble.member import Member
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.records import ALWAYS
from stickslip.pipeline.records.record import Made, NotKeptError, Record, stop_early
from stickslip.pipeline.records.slips.thresholds import has_several
from stickslip.pipeline.running.ends import end_of
from stickslip.pipeline.scene.columns import Recording

#: Runs members: the columns of each, as `stickslip.pipeline.running.worker.run_members`.
Runs = Callable[[Sequence[Member], Recording], list[dict[str, Any]]]

#: Shards that are in memory at once: the members of a new one are in a few of them.
_SHARDS = 8


class KeptRows:
    """The rows of a dataset, for a scene of which some members are the same.

    Raises `StoreError` if a shard is damaged.
    """

    def __init__(self, opened: Opened) -> None:
        opened.check()
        self.opened = opened
        self._batches = {batch.name: batch for batch in opened.tasks if batch.name in opened.manifest.shards}
        self._place = {
            member_id: (name, row)
            for name, batch in self._batches.items()
            for row, member_id in enumerate(batch.members.ids())
        }
        self._read = lru_cache(_SHARDS)(self._read_shard)
        self._failed = lru_cache(None)(self._failed_rows)

    def of(self, batch: Batch) -> Kept:
        """The rows of a shard's members that did not fail."""
        shards: dict[str, dict[int, int]] = {}
        for place, (name, row) in self._there(batch.members).items():
            shards.setdefault(name, {})[place] = row
        tables = [self._read(name).take(pa.array(rows.values(), pa.int64())) for name, rows in shards.items()]
        table = pa.concat_tables([schema_of(self.opened.scene.recording).empty_table(), *tables])
        places = tuple(place for rows in shards.values() for place in rows)
        return Kept(table.combine_chunks(), places, self.opened.scene.records)

    def left(self, batch: Batch) -> Members:
        """The members of a shard that are run."""
        stored, records = self._there(batch.members), self.opened.scene.records
        places = (
            k
            for k, member in enumerate(batch.members)
            if k not in stored or must_run(member, batch.recording.records, records)
        )
        return batch.members.at([*places])

    def _there(self, members: Members) -> dict[int, tuple[str, int]]:
        """Where the dataset has members, by their places, but for those that failed."""
        stored = {}
        for place, member in enumerate(members):
            name, row = self._place.get(member.member_id, ("", 0))
            if name and self._batches[name].members[row] == member and row not in self._failed(name):
                stored[place] = (name, row)
        return stored

    def _failed_rows(self, name: str) -> frozenset[int]:
        if not self.opened.manifest.shards[name].n_failed:
            return frozenset()
        outcomes = self._read(name)["outcome"].to_pylist()
        return frozenset(row for row, outcome in enumerate(outcomes) if outcome == "failed")

    def _read_shard(self, name: str) -> pa.Table:
        ((_, table),) = self.opened.stored(self.opened.schema.names, [name])
        self.opened.check_members(name, table)
        return table


@dataclass(frozen=True)
class Kept:
    """Rows of some members of a batch."""

    table: pa.Table
    places: tuple[int, ...]  #: those of the members in the batch, one a row
    records: tuple[Record, ...]  #: what the dataset of the rows keeps

    def completed(self, members: Sequence[Member], recording: Recording, run: Runs) -> Mapping[str, Values]:
        """The columns of all members: kept, computed from what is kept, or of runs.

        `run` is called with the members of which the rows lack something.
        """
        new = [record for record in recording.records if record not in self.records]
        rows: dict[int, int] = {}
        computed: list[dict[str, Any]] = []
        for row, place in enumerate(self.places):
            member = members[place]
            if not must_run(member, recording.records, self.records):
                with suppress(NotKeptError):
                    computed.append(member.row() | self._computed(member, row, new))
                    rows[place] = row
        rerun = [place for place in range(len(members)) if place not in rows]
        results = run([members[place] for place in rerun], recording)
        ran = [members[place].row() | result for place, result in zip(rerun, results, strict=True)]
        changed = {
            column.name for record in self.records if record not in recording.records for column in record.kept
        }
        table, order = self.table.take(pa.array(rows.values(), pa.int64())), np.argsort([*rows, *rerun])

        def values(field: pa.Field) -> pa.Array:
            name, kind = field.name, field.type
            is_kept = name in table.column_names and name not in changed
            stored = table[name].combine_chunks().cast(kind) if is_kept else _array(computed, name, kind)
            return pa.concat_arrays([stored, _array(ran, name, kind)]).take(pa.array(order, pa.int64()))

        return {field.name: values(field) for field in schema_of(recording)}

    @cached_property
    def _of_runs(self) -> dict[str, pa.Array]:
        """The columns that say what came of the members, but for those that are made of the events."""
        names = {column.name for record in (ALWAYS, *self.records) for column in record.kept}
        return {name: self.table[name].combine_chunks() for name in names - {"t", "n_stick"}}

    def _computed(self, member: Member, row: int, new: Sequence[Record]) -> dict[str, Any]:
        """The columns of new records of a member, from its row."""
        values = {name: _value(column[row]) for name, column in self._of_runs.items() if column[row].is_valid}
        result = _OfRow(member, values, self.records)
        computed: dict[str, Any] = {}
        for record in new:
            if record.applies(member):
                computed |= record.of(result)
                result.found.update(computed)
        return computed


def must_run(member: Member, records: Sequence[Record], stored: Sequence[Record]) -> bool:
    """Whether a row with the records that are kept holds too little of a member's run for others."""
    names = {"system", *(record.name for record in stored)}
    return stop_early(records) != stop_early(stored) or any(
        record.is_sampled or not record.needs <= names
        for record in records
        if record not in stored and record.applies(member)
    )


def _array(rows: Sequence[Mapping[str, Any]], name: str, kind: pa.DataType) -> pa.Array:
    return pa.array([row.get(name) for row in rows], kind)


def _value(entry: pa.Scalar) -> Any:
    """A value of a row; a list of numbers as an array of its own."""
    if isinstance(entry, pa.ListScalar) and pa.types.is_primitive(entry.type.value_type):
        return np.array(entry.values.to_numpy(zero_copy_only=False))
    return entry.as_py()


class _OfRow(Made):
    """A member as its row has it; what the row does not hold is a `NotKeptError`."""

    is_whole = False
    _member: Member
    _held: set[str]

    def __init__(self, member: Member, values: dict[str, Any], records: Sequence[Record]) -> None:
        names = {record.name for record in records}
        vars(self).update(member=member, found=values, stop_early=stop_early(records), _member=member, _held=names)

    @cached_property
    def system(self) -> sim.System:
        return self._member.system()

    @cached_property
    def start(self) -> tuple[Any, Any]:
        return self._member.start(end_of(self._member))

    @cached_property
    def events(self) -> sim.EventSeries:
        self._check("events")
        values = self.found
        # nothing happens any more after a collapse: the run is known to the end
        t_end = values["t_stop"] if values["outcome"] == "diverged" else self._member.t_end
        t, block, mode = (values[f"event_{name}"] for name in ("t", "block", "mode"))
        return sim.EventSeries(t, block, mode, values["initial_mode"], t_start=0.0, t_end=t_end)

    @cached_property
    def run(self) -> sim.Run:
        self._check("end")
        if has_several(dict(self._member.settings)):
            raise NotKeptError("by_threshold")
        values, outcome = self.found, self.found["outcome"]
        return sim.Run(
            z=values["z_end"],
            w=values["w_end"],
            t_end=self.events.t_end,
            events=self.events,
            outcome=outcome,
            reason=values.get("reason", ""),
            stats=sim.Stats(*(values[name] for name in ("n_steps", "n_rejected", "n_products", "n_events"))),
            t_collapse=values["t_stop"] if outcome == "collapsed" else None,
            samples=cast("sim.Samples", _Unread("samples")),
            stills=cast("Any", _Unread("stills")),
        )

    def again(self, member: Any, times: tuple[float, ...]) -> sim.Samples:
        raise NotKeptError("samples")

    def _check(self, record: str) -> None:
        if record not in self._held:
            raise NotKeptError(record)


class _Unread:
    """Stands in a run for what no row holds."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> NoReturn:
        raise NotKeptError(self._name)

    def __len__(self) -> NoReturn:
        raise NotKeptError(self._name)
