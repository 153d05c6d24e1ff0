"""The engines' kernels in a worker: loaded before they are needed, compiled by one process for all of a machine."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

from stickslip.pipeline.design import Member
from stickslip.pipeline.schema import Recording, row
from stickslip.sim.engines.compile import cache_directory

#: Seconds to wait for a process that compiles; it takes half a minute or so, and may be stuck.
_PATIENCE = 180.0

#: Engines whose kernels this process has.
_loaded: set[str] = set()


def is_cold(engine: str) -> bool:
    """Whether an engine's kernels are still to be compiled here: some ten seconds, once a version of `sim`."""
    return next(cache_directory().glob(f"{engine}.*.nbc"), None) is None


def one_an_engine(members: Iterable[Member]) -> dict[str, Member]:
    """A member of each engine."""
    return {member.engine: member for member in reversed(list(members))}


def load(members: Iterable[Member]) -> None:
    """Load the kernels that members need, or compile them; if another process does so now, wait and load its own."""
    for engine, member in one_an_engine(members).items():
        if engine not in _loaded:
            with _alone(engine) if is_cold(engine) else contextlib.nullcontext():
                row(replace(member, member_id="", n=min(member.n, 3), t_end=1e-6), Recording("", (), None))
            _loaded.add(engine)


@contextlib.contextmanager
def _alone(engine: str) -> Iterator[None]:
    """Be the only process of this machine in here, unless nothing can be locked, or another takes too long."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock = os.open(cache_directory() / f"{engine}.lock", os.O_RDONLY | os.O_CREAT, 0o644)
            held.callback(os.close, lock)
            end = time.monotonic() + _PATIENCE
            while not _is_locked(lock) and time.monotonic() < end:
                time.sleep(0.05)
        yield


def _is_locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
