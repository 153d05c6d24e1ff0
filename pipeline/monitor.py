"""Following a run from outside: who writes the dataset, how fast, how long it will take."""

from __future__ import annotations

import os
import re
import socket
import time
from dataclasses import dataclass

from stickslip.pipeline.integrity import Status, status
from stickslip.pipeline.ledger import read_manifest, read_tasks
from stickslip.pipeline.storage import LOCK, Lock, Where, place_of


@dataclass(frozen=True)
class Began:
    """When a run began, in seconds since 1970, and how many members, of what cost, were there then."""

    at: float
    n_members: int
    cost: float

    @property
    def line(self) -> str:
        """The line of the lock file that says so."""
        return f"began {self.at:.3f} {self.n_members} {self.cost!r}"


@dataclass(frozen=True)
class Running:
    """The process that writes a dataset, as the lock file has it."""

    owner: str
    began: Began
    dashboard: str | None


@dataclass(frozen=True)
class View:
    """A dataset at one moment; `rate`, in members a second, and `eta`, in seconds, are None as long as unknown."""

    status: Status
    n_planned: int  #: shards
    running: Running | None
    rate: float | None
    eta: float | None


class Follower:
    """Looks at a dataset as often as it is asked to.

    Raises
    ------
    StoreError
        Here and on looking, if there is no readable dataset.
    """

    def __init__(self, path: Where) -> None:
        self._path = place_of(path)
        tasks = read_tasks(self._path, read_manifest(self._path))
        self._costs = {batch.name: batch.cost for batch, _ in tasks}

    def look(self) -> View:
        """How far it is now."""
        found = status(self._path)
        done = read_manifest(self._path).shards
        current = running(self._path)
        rate = eta = None
        if current is not None:
            elapsed = time.time() - current.began.at
            cost = sum(self._costs.get(name, 0.0) for name in done)
            n_new, new = found.n_done - current.began.n_members, cost - current.began.cost
            if elapsed > 0 and n_new > 0 and new > 0:
                rate = n_new / elapsed
                eta = elapsed * (sum(self._costs.values()) - cost) / new
        return View(found, len(self._costs), current, rate, eta)


def running(path: Where) -> Running | None:
    """Who writes the dataset now, if anybody does: a dead process leaves an empty lock."""
    place = place_of(path)
    try:
        lock = Lock.parse(place.read(LOCK))
    except OSError:
        return None
    here = re.fullmatch(r"process (\d+) on (.*)", lock.owner)
    if here is None or (here[2] == socket.gethostname() and not _is_alive(int(here[1]))) or not lock.is_held:
        return None
    try:
        at, n_members, cost = lock.notes["began"].split()
        return Running(lock.owner, Began(float(at), int(n_members), float(cost)), lock.notes.get("dashboard"))
    except (KeyError, ValueError):  # it has only just begun
        return None


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # somebody else's
        return True
    return True
