"""How far a dataset is: what is done and what failed, who writes it, how fast, and how long that will take."""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from stickslip.pipeline.dataset.opened import Opened, open_dataset, rows_that_failed
from stickslip.pipeline.ensemble.pack import Batch, number_of
from stickslip.pipeline.errors import StoreError, command
from stickslip.pipeline.places.locate import place_of
from stickslip.pipeline.places.manifest import Shard
from stickslip.pipeline.places.place import LOCK, MANIFEST, Lock, Where, number
from stickslip.pipeline.places.plain import is_alive


@dataclass(frozen=True)
class Tally:
    """How much of a dataset is done; costs are in the units of `Member.cost`."""

    n_members: int
    n_done: int  #: sum of `outcomes`
    outcomes: dict[str, int]
    n_shards: int
    n_shards_done: int
    n_bytes: int  #: of the shards that are done
    cost: float
    cost_done: float

    @classmethod
    def of(cls, tasks: Sequence[Batch], shards: Mapping[str, Shard]) -> Tally:
        """Count those of the shards to be that are done."""
        costs = {number: batch.cost for number, batch in enumerate(tasks)}
        n_members = sum(len(batch.members) for batch in tasks)
        tally = cls(n_members, 0, {}, len(costs), 0, 0, sum(costs.values()), 0.0)
        for name, shard in shards.items():
            tally = tally.plus(shard, costs.get(number_of(name), 0.0))
        return tally

    def plus(self, shard: Shard, cost: float) -> Tally:
        """Count one shard more."""
        return replace(
            self,
            n_done=self.n_done + shard.rows,
            outcomes=dict(sorted((Counter(self.outcomes) + Counter(shard.outcomes)).items())),
            n_shards_done=self.n_shards_done + 1,
            n_bytes=self.n_bytes + shard.bytes,
            cost_done=self.cost_done + cost,
        )

    @property
    def n_failed(self) -> int:
        """Members that failed."""
        return self.outcomes.get("failed", 0)

    @property
    def is_complete(self) -> bool:
        """Whether every member has its row, whatever its outcome."""
        return self.n_done == self.n_members

    def pace(self, since: Pace | None, now: float) -> tuple[float | None, float | None]:
        """Members a second since an earlier state, and seconds to go.

        None until as many shards have come since as there are workers: before that, most of the work is in theirs.
        """
        if since is None:
            return None, None
        n_new, new = self.n_done - since.n_members, self.cost_done - since.cost
        is_early = self.n_shards_done - since.n_shards < since.n_workers and not self.is_complete
        if is_early or now <= since.at or n_new <= 0 or new <= 0:
            return None, None
        elapsed = now - since.at
        return n_new / elapsed, max(0.0, elapsed * (self.cost - self.cost_done) / new)


class Pace(NamedTuple):
    """What the pace of a run is measured from: the state at which each worker, when they were most, had a shard."""

    at: float  #: in seconds since 1970
    n_members: int
    cost: float
    n_shards: int
    n_workers: int

    @property
    def line(self) -> str:
        """The line of the lock file that says so."""
        return f"pace {self.at:.3f} {self.n_members} {self.cost!r} {self.n_shards} {self.n_workers}"

    @classmethod
    def parse(cls, words: str) -> Pace:
        """Read what the line says; ValueError if it cannot be read."""
        at, n_members, cost, n_shards, n_workers = map(number, words.split())
        return cls(at, int(n_members), cost, int(n_shards), int(n_workers))


@dataclass(frozen=True)
class Running:
    """The process that writes a dataset, as the lock file names it."""

    owner: str
    began: float  #: in seconds since 1970
    dashboard: str | None
    pace: Pace | None


@dataclass(frozen=True)
class Status(Tally):
    """A dataset at one moment; `rate`, in members a second, and `eta`, in seconds, are None as long as unknown."""

    path: str  #: the directory, or the address
    failures: dict[str, int]  #: failed members by reason
    first_failed: str | None  #: a failed member, to be run alone
    n_damaged: int  #: of the shards that are done, those whose files are gone or have another size
    n_lost: int  #: members in these
    running: Running | None
    rate: float | None
    eta: float | None


def status(path: Where | Opened) -> Status:
    """Count what is done; good to call while the dataset is being written.

    Raises
    ------
    StoreError
        If there is no readable dataset, or a shard with failed members is not what was written.
    """
    opened = open_dataset(path)
    place, shards = opened.place, opened.manifest.shards
    sizes = {batch.name: len(batch.members) for batch in opened.tasks}
    for name, shard in shards.items():
        if name in sizes and shard.rows != sizes[name]:
            raise StoreError(
                f"{place.named(MANIFEST)}: expected {sizes[name]} rows in {name}, got {shard.rows};"
                f" `{command('verify', str(place))}` says what else differs"
            )
    tally = Tally.of(opened.tasks, shards)
    # after the manifest was read: a shard is there before it is listed
    lost = opened.lost
    whole_shards = [name for name, shard in sorted(shards.items()) if shard.n_failed and name not in lost]
    failed = rows_that_failed(opened, whole_shards) if whole_shards else []
    current = running(place)
    rate, eta = tally.pace(None if current is None else current.pace, time.time())
    return Status(
        **vars(tally),
        path=str(place),
        failures=dict(Counter(reason for _, reason in failed).most_common()),
        first_failed=failed[0][0] if failed else None,
        n_damaged=len(lost),
        n_lost=sum(shards[name].rows for name in lost),
        running=current,
        rate=rate,
        eta=eta,
    )


def running(path: Where) -> Running | None:
    """Who writes the dataset now, if anybody does: a dead process may leave a lock, and others what is none."""
    place = place_of(path)
    try:
        lock = Lock.parse(place.read(LOCK))
    except OSError:
        return None
    if lock is None or not lock.is_held or (lock.host == socket.gethostname() and not is_alive(lock.pid)):
        return None
    try:
        pace = Pace.parse(lock.notes["pace"]) if "pace" in lock.notes else None
        return Running(lock.owner, number(lock.notes["began"].split()[0]), lock.notes.get("dashboard"), pace)
    except (LookupError, ValueError):  # it has only just begun
        return None
