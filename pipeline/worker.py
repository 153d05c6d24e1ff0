"""What a worker does: run a batch's members, with compiled kernels, and alone those that may kill their process."""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import socket
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from stickslip import sim
from stickslip.pipeline.design import Batch, Member
from stickslip.pipeline.processes import Child, ChildDied
from stickslip.pipeline.quantity import Course, Distribution, Named
from stickslip.pipeline.schema import COLUMNS, RECORDED, SCHEMA, Recording, encode
from stickslip.pipeline.storage import is_locked
from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.sources import cache_directory, source_digest
from stickslip.sim.episodes import episodes
from stickslip.version import __version__

#: Seconds to wait for a process that compiles; it takes half a minute or so, and may be stuck.
_PATIENCE = 180.0

#: Engines whose kernels this process has.
_loaded: set[str] = set()

#: What a row takes over from its member, and from the settings of its engine.
_PARAMETERS = tuple(name for name in COLUMNS if hasattr(Member, name))
_SETTINGS = frozenset((*SCHEMA.names, *RECORDED))
_of_member = attrgetter(*_PARAMETERS)


@dataclass(frozen=True)
class Result:
    """A computed batch: the shard's bytes, and beside them what is not data."""

    name: str
    shard: bytes
    member_ids: tuple[str, ...]
    outcomes: dict[str, int]
    program: str
    seconds: float
    host: str
    pid: int


#: What determines numbers beside `sim`: which draws and settings a member has, and what of its run is kept.
_ROOMS = (
    "design",
    "ends",
    "engine_table",
    "quantity",
    "scene",
    "schema",
    "system_table",
    "systems",
    "tables",
    "worker",
)
_DETERMINING = [Path(__file__).with_name(f"{room}.py") for room in _ROOMS]


def program() -> str:
    """What the numbers come from: the version of stickslip, and a digest of the sources that determine them."""
    return f"{__version__}-{source_digest(*_DETERMINING)}"


def compute(batch: Batch, recording: Recording) -> Result:
    """Run a batch's members and encode their rows; a member that raises becomes a row that says so."""
    start = time.perf_counter()
    return as_result(batch, recording, [row(member, recording) for member in batch.members], start)


def compute_packed(task: bytes) -> Result:
    """As `compute`, of what is pickled; what a run asks of its workers, which so load this module and no driver."""
    batch, recording = pickle.loads(task)
    load_kernels(batch.members)
    return compute(batch, recording)


def as_result(batch: Batch, recording: Recording, rows: list[dict[str, Any]], start: float) -> Result:
    """The rows of a batch, encoded; `start` is when they were begun, by `time.perf_counter`."""
    return Result(
        name=batch.name,
        shard=encode(rows, recording.schema),
        member_ids=tuple(member.member_id for member in batch.members),
        outcomes=dict(Counter(row["outcome"] for row in rows)),
        program=program(),
        seconds=time.perf_counter() - start,
        host=socket.gethostname(),
        pid=os.getpid(),
    )


def row(member: Member, recording: Recording) -> dict[str, Any]:
    """Run a member: its row, by column; one that raised has a row that says so."""
    try:
        return _parameters(member) | _results(member, recording)
    except Exception as error:  # noqa: BLE001  whatever went wrong is this member's outcome, not its neighbours'
        message = " ".join(str(error).split())
        return failed_row(member, f"{type(error).__name__}: {message}")


def failed_row(member: Member, reason: str) -> dict[str, Any]:
    """The row of a member that could not be run."""
    # words of an exception may hold what Parquet's text cannot
    reason = reason.encode(errors="replace").decode()
    command = f"stickslip run scene.toml --only {member.member_id}"
    return _parameters(member) | {"outcome": "failed", "reason": reason, "reproduce": command}


def _parameters(member: Member) -> dict[str, Any]:
    own = zip(_PARAMETERS, _of_member(member), strict=True)
    settings = {name: value for name, value in member.settings if name in _SETTINGS}
    found = {name: None if isinstance(one, (Distribution, Course, Named)) else one for name, one in own}
    return found | settings | dict(member.parameters)


def _results(member: Member, recording: Recording) -> dict[str, Any]:
    times, base = np.empty(0), None
    if recording.separation is not None:
        times, base = _multiples(recording.separation, member.t_end), member.base
    run = member.simulate(times if base is not None else ())
    found = _measured(run)
    if "growth_rate" in recording.parts:
        found["growth_rate"] = _growth_rate(member.of_system)
    if "end" in recording.parts:
        found |= {"z_end": run.z, "w_end": run.w, "mode_end": _modes(run, member.system())}
    if "events" in recording.parts:
        found |= _events(run.events)
    if "episodes" in recording.parts:
        whole = episodes(run, member.system().belt_speed)
        found |= {f"episode_{one.name}": getattr(whole, one.name) for one in fields(whole)}
    if base is not None:
        found["separation"] = _distance(run.samples, _states(replace(base, member_id=""), tuple(times)))
    if run.by_threshold:
        changes = {c: series.change_points() for c, series in run.by_threshold.items()}
        found["by_threshold"] = [{"threshold": c, "t": t, "n_stick": n} for c, (t, n) in changes.items()]
    return found


@lru_cache(maxsize=64)
def _growth_rate(member: Member) -> float:
    return float(np.linalg.eigvals(member.system().slip_matrix()).real.max())


def _multiples(step: float, t_end: float) -> np.ndarray:
    """0, step, 2 step ... to t_end, which rounding does not lose."""
    times = step * np.arange(math.floor(t_end / step * (1 + 1e-12)) + 1)
    return np.minimum(times, t_end)


@lru_cache(maxsize=8)  # its copies come next to each other in the scene's order; whose copy asks is no part of it
def _states(member: Member, times: tuple[float, ...]) -> sim.Samples:
    return member.simulate(times).samples


def _distance(one: sim.Samples, other: sim.Samples) -> np.ndarray:
    """Distance of two runs at the times that both reached."""
    m = min(len(one), len(other))
    squares = (one.z[:m] - other.z[:m]) ** 2 + (one.w[:m] - other.w[:m]) ** 2
    return np.sqrt(squares.mean(axis=1))


def _events(series: sim.EventSeries) -> dict[str, Any]:
    return {
        "event_t": series.t,
        "event_block": series.block,
        "event_mode": series.mode,
        "initial_mode": series.initial_mode,
    }


def _modes(run: sim.Run, system: sim.System) -> np.ndarray:
    """The mode of each block at the end; one that slips after a collapse may have turned round unseen."""
    mode = run.events.initial_mode.copy()
    mode[run.events.block] = run.events.mode  # of several of one block the last one stays
    return np.where(mode == 0, 0, np.where(run.w > system.belt_speed_at(run.t_end), 1, -1)).astype(np.int8)


def _measured(run: sim.Run) -> dict[str, Any]:
    t, n_stick = run.events.change_points()
    if not np.isfinite(t).all():
        raise FloatingPointError("the engine returned an event at a time that is not finite")
    return {
        "outcome": run.outcome,
        "reason": run.reason or None,
        "t_stop": run.t_end if run.t_collapse is None else run.t_collapse,
        "n_stick_end": n_stick[-1],
        **run.events.counts(),
        "n_events": run.stats.n_events,
        "n_steps": run.stats.n_steps,
        "n_rejected": run.stats.n_rejected,
        "n_products": run.stats.n_products,
        "t": t,
        "n_stick": n_stick,
    }


# ---------------------------------------------------------------------------------------------- in a process apart


def compute_alone(batch: Batch, recording: Recording) -> Result:
    """As `compute`, in a process of its own.

    When it dies, the member it was at is run again, in another; if that dies too, the member's row says so.
    """
    start = time.perf_counter()
    rows: list[dict[str, Any]] = []
    process: Child | None = None
    with contextlib.ExitStack() as started:
        for member in batch.members:
            for is_second in (False, True):
                process = process or started.enter_context(Child(_row))
                try:
                    rows.append(process((member, recording)))
                    break
                except ChildDied as death:
                    process = None
                    if is_second:
                        rows.append(failed_row(member, f"its worker died ({death})"))
    return as_result(batch, recording, rows, start)


def compute_alone_packed(task: bytes) -> Result:
    """As `compute_alone`, of what is pickled."""
    return compute_alone(*pickle.loads(task))


def _row(task: tuple[Member, Recording]) -> dict[str, Any]:
    return row(*task)


# ---------------------------------------------------------------------------------------------- kernels


def is_cold(engine: str) -> bool:
    """Whether an engine has kernels that are still to be compiled here: some ten seconds, once a version of `sim`."""
    kernels = ENGINES[engine].kernels
    return bool(kernels) and not any(cache_directory().glob(f"{kernels}.*.nbc"))


def one_an_engine(members: Iterable[Member]) -> dict[str, Member]:
    """A member of each engine."""
    return {member.engine: member for member in reversed(list(members))}


def load_kernels(members: Iterable[Member]) -> None:
    """Load the kernels that members need, or compile them; if another process does so now, wait and load its own."""
    for engine, member in one_an_engine(members).items():
        if engine not in _loaded:
            with _alone(engine) if is_cold(engine) else contextlib.nullcontext():
                tiny = replace(member, member_id="", n=min(member.n, 3), t_end=1e-6)
                if member.origin is not None:
                    tiny = replace(tiny, origin=None, coupling="chain", kappa=0.1, leaf=0.1, belt_speed=-0.2)
                    tiny = replace(tiny, damping=1.0, friction=1.0, static=None, mass=None)
                    tiny = replace(tiny, z0=0.0, w0=0.0)
                row(tiny, Recording("", (), None))
            _loaded.add(engine)


@contextlib.contextmanager
def _alone(engine: str) -> Iterator[None]:
    """Be the only process of this machine in here, unless nothing can be locked, or another takes too long."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            directory = cache_directory()
            directory.mkdir(parents=True, exist_ok=True)
            lock = os.open(directory / f"{engine}.lock", os.O_RDONLY | os.O_CREAT, 0o644)
            held.callback(os.close, lock)
            end = time.monotonic() + _PATIENCE
            while not is_locked(lock) and time.monotonic() < end:
                time.sleep(0.05)
        yield
