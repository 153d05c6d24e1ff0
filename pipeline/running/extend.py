"""Adding records to a finished dataset: from what it keeps of the runs, or by running those members that it must."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from stickslip.pipeline import query
from stickslip.pipeline.dataset.extending import Extending, ended
from stickslip.pipeline.dataset.opened import Opened, open_dataset
from stickslip.pipeline.dataset.status import Status, counted
from stickslip.pipeline.ensemble.expand import expand
from stickslip.pipeline.ensemble.pack import Batch, Task
from stickslip.pipeline.own.modules import folder_with
from stickslip.pipeline.places.place import Where
from stickslip.pipeline.records.own import OwnRecord, look_at_functions, named_functions
from stickslip.pipeline.records.record import Record
from stickslip.pipeline.running import ends
from stickslip.pipeline.running.cluster import Scheduling, check_address, check_memory
from stickslip.pipeline.running.driver import Order, Progress, Workers, check_caller, fill, look_at_origins
from stickslip.pipeline.running.estimate import Estimate, estimate
from stickslip.pipeline.running.kept import Kept, added, held_by, must_run, reads_more
from stickslip.pipeline.running.trials import check_functions
from stickslip.pipeline.scene.adding import has_records, with_only, with_records
from stickslip.pipeline.scene.scene import Scene
from stickslip.sim.numerics.session import numpy_defaults

#: Bytes of shards up to which nothing is gained by sending rows to other processes, if none is run.
_HERE = 100_000_000


@dataclass(frozen=True)
class Addition:
    """Records that are to be added to a dataset.

    Attributes
    ----------
    before : Opened
        The dataset.
    scene : Scene
        Its scene with the records.
    todo : list of tuple
        The shards that are still to be computed.
    """

    before: Opened
    scene: Scene
    todo: list[Task]

    @property
    def new(self) -> tuple[Record, ...]:
        """The records that are added."""
        return added(self.scene.records, self.before.scene.records)

    @cached_property
    def again(self) -> list[Batch]:
        """The members that are run again, by shard."""
        held = held_by(self.before.scene.records)
        if not any(reads_more(record, held) for record in self.new):
            return []
        names = query.table(self.before, ["member_id", "outcome"]).to_pydict()
        outcomes = dict(zip(names["member_id"], names["outcome"], strict=True))
        members = expand(with_only(self.scene, self.new, self.before.folder))
        place = {name: k for k, name in enumerate(members.ids())}
        batches = []
        for number, (batch, _) in enumerate(self.todo):
            places = [place[one.member_id] for one in batch.members
                      if must_run(one, outcomes[one.member_id], self.new, held)]  # fmt: skip
            if places:
                batches.append(Batch(number, members.at(places), self.scene.hash))
        return batches

    @property
    def n_again(self) -> int:
        """How many members are run again."""
        return sum(len(batch.members) for batch in self.again)

    def estimate(self, workers: int) -> Estimate:
        """What it takes to run them, at least one, on local processes; see `pipeline.running.estimate`."""
        return estimate(with_only(self.scene, self.new, self.before.folder), self.again, workers)

    @property
    def seconds_of_records(self) -> float:
        """About how many seconds of a core the records take beside runs, by their formulas."""
        members = expand(with_only(self.scene, self.new, self.before.folder))
        share = sum(len(batch.members) for batch, _ in self.todo) / len(members)
        return share * sum(member.shared_cost for member in members)


def addition(path: Where | Opened, record: Mapping[str, Any], accept_version: bool = False) -> Addition:
    """What records would add to a dataset, and what that takes; nothing is written.

    Raises
    ------
    SceneError, StoreError
        As `extend`.
    """
    opened = open_dataset(path)
    scene = with_records(opened.scene, _keys(opened, record), opened.folder)
    return Addition(opened, scene, Extending(opened, scene, accept_version).look()[1])


def is_there(opened: Opened, record: Mapping[str, Any]) -> bool:
    """Whether a dataset has records already, with the functions of a user's own as they are now.

    Raises
    ------
    SceneError
        If a function of the user's own is gone.
    """
    return has_records(opened.scene, record) and has_records(opened.scene, _keys(opened, record))


def _keys(opened: Opened, record: Mapping[str, Any]) -> dict[str, Any]:
    """Keys under [record], with the digests of functions that they name."""
    keys = dict(record)
    if names := named_functions(keys.get(OwnRecord.name)):
        folder = folder_with(names[0].partition(":")[0], opened.folder)
        keys |= {OwnRecord.name: names, "functions": look_at_functions(names, folder)}
    return keys


@numpy_defaults()
def extend(
    path: Where | Opened,
    record: Mapping[str, Any],
    workers: int = 2,
    scheduler: Scheduling = None,
    on_progress: Callable[[Progress], None] | None = None,
    accept_version: bool = False,
    dashboard: bool = False,
) -> Status:
    """Add records to a finished dataset, or what is missing of an extension that was interrupted.

    A dataset that has them already stays as it is.

    What is kept of the runs, as their events, is not computed again: a record that needs no more is computed from it,
    and for others members are run again. In the end the dataset has the bytes of a run with these records from the
    start; until then it is what it was. Arguments that are not listed are those of `run_ensemble`.

    Parameters
    ----------
    path : str, Path, Place or Opened
        Directory of the dataset, or its address in an object store.
    record : mapping of str to value
        Keys under [record] of its scene: ``{"waiting": True, "t_burn": 50.0}``. The module of functions of a user's
        own, ``{"own": ["mine:quiet_share"]}``, lies beside the dataset, above it, or in the working directory.

    Raises
    ------
    SceneError
        If a key is unknown or does not apply, or the data have some of the records already; or as `run_ensemble`.
    StoreError
        If the dataset is not finished, damaged, or cannot be written; if an extension by other records was begun; or
        if a member that is run again does not run as it did.
    ValueError, AddressError, ScheduleError
        As `run_ensemble`.
    """
    check_caller(workers, scheduler)
    start = time.monotonic()
    opened = ended(open_dataset(path))
    if is_there(opened, record):
        return counted(opened, opened.tasks)
    found = addition(opened, record, accept_version)
    if isinstance(scheduler, str):
        check_address(scheduler)
    if found.scene.own_record in found.new:
        check_functions(found.scene, found.todo)
    if found.again:
        found.scene.check_engines()
        ends.check(found.scene)
        if scheduler is None:
            check_memory(found.scene, workers)
    firsts = [member for batch in found.again for member in batch.members.firsts()]
    look_at_origins(firsts)  # before the extension is begun
    n_bytes = sum(shard.bytes for shard in opened.manifest.shards.values())
    takes_little = n_bytes < _HERE and not (found.again or any("system" in one.needs for one in found.new))
    at = Workers(0, None, False) if takes_little else Workers(workers, scheduler, dashboard)
    with Extending(opened, found.scene, accept_version) as store:
        kept = opened.scene.records

        def order(task: Task) -> Order:
            return (*task, Kept(store.rows(task[0]), kept))

        fill(store, order, firsts, start, at, on_progress)
    return counted(store.opened, store.tasks)
