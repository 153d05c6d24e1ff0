"""What a worker does: run a batch's members with compiled kernels; in a process apart, those that may kill theirs."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby, islice
from typing import Any, NamedTuple

import numpy as np

from stickslip import sim
from stickslip.pipeline.dataset.program import program
from stickslip.pipeline.dataset.schema import Values, encode, schema_of
from stickslip.pipeline.ensemble.member import NO_NUMBER, Member
from stickslip.pipeline.ensemble.pack import Batch
from stickslip.pipeline.errors import command, foreign
from stickslip.pipeline.machine.processes import Child, ChildDied
from stickslip.pipeline.places.manifest import Commit, Result, Shard
from stickslip.pipeline.records import ALWAYS
from stickslip.pipeline.records.record import Made, Record, stop_early
from stickslip.pipeline.running.ends import end_of
from stickslip.pipeline.running.taken_over import Kept, Runs
from stickslip.pipeline.scene.columns import DESIGN, Recording
from stickslip.sim.engines import ENGINES
from stickslip.sim.engines.adiabatic import Adiabatic
from stickslip.sim.engines.contract import Engine, Task
from stickslip.sim.kernels.cache import CacheError, has_kernel
from stickslip.sim.runs.series import summaries
from stickslip.sim.systems.system import work_out

#: Members that are set up at once, and entries of K that they have together, at most.
_TOGETHER, _ENTRIES = 128, 2**16
_NEVER = np.empty(0)
#: Engines whose kernels this process has, for each of their sizes.
_loaded: set[tuple[str, int]] = set()


def compute(batch: Batch, kept: Kept | None = None, run: Runs | None = None) -> Result:
    """Run a batch's members and encode their rows; a member that raises becomes a row that says so.

    Parameters
    ----------
    kept : Kept, optional
        What another dataset has of them, which is not computed again.
    run : callable, optional
        How members are run: `run_members` if left out.
    """
    start = time.perf_counter()
    run, recording = run_members if run is None else run, batch.recording
    members = tuple(batch.members)  # made once: they are made on demand
    rows: Mapping[str, Values]
    if kept is None:
        rows = columns(members, run(members, recording), recording)
    else:
        rows = kept.completed(members, recording, run)
    if batch.coordinates is not None:
        rows = {**rows, **dict(zip((column.name for column in DESIGN), batch.coordinates, strict=True))}
    shard = encode(rows, schema_of(recording))
    entry = Shard(
        sha256=hashlib.sha256(shard).hexdigest(),
        rows=len(members),
        bytes=len(shard),
        first=members[0].member_id,
        last=members[-1].member_id,
        outcomes=dict(Counter(map(str, rows["outcome"]))),
    )
    seconds = time.perf_counter() - start
    commit = Commit(shard=batch.name, entry=entry, program=program(), seconds=seconds)
    return Result(shard, commit)


#: A shard to be computed, with the rows that another dataset has, if there is one.
Order = tuple[Batch, Kept | None]


def compute_there(order: Order) -> Result:
    """As `compute`, on a worker, which loads this module and no driver."""
    return compute(*order, _run_with_kernels)


def _run_with_kernels(members: Sequence[Member], recording: Recording) -> list[dict[str, Any]]:
    load_kernels(members)
    return run_members(members, recording)


def compute_alone(order: Order) -> Result:
    """As `compute`, with members that run in a process of their own.

    When it dies, the member it was at is run again, in another; if that dies too, the member's row says so.
    """
    return compute(*order, _run_alone)


def _run_alone(members: Sequence[Member], recording: Recording) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    process: Child | None = None
    with contextlib.ExitStack() as started:
        for member in members:
            for is_second in (False, True):
                process = process or started.enter_context(Child())
                try:
                    rows += process(run_members, [member], recording)
                    break
                except ChildDied as death:
                    process = None
                    if is_second:
                        rows.append(failed(member, f"its worker died ({death})"))
    return rows


def columns(
    members: Sequence[Member], results: Sequence[dict[str, Any]], recording: Recording
) -> dict[str, list[Any]]:
    """The rows of some members, by column: what they are, and what came of them."""
    rows = [member.row() | outcome for member, outcome in zip(members, results, strict=True)]
    return {column.name: [row.get(column.name) for row in rows] for column in recording.columns}


def row(member: Member, recording: Recording) -> dict[str, Any]:
    """Run a member: its row, by column; one that raised has a row that says so."""
    return {name: value for name, (value,) in columns([member], run_members([member], recording), recording).items()}


def run_members(members: Sequence[Member], recording: Recording) -> list[dict[str, Any]]:
    """Run members: what came of each, by column; of one that raised, the words that say so."""
    results = [_result(prepared, recording) for prepared in _prepared(members, recording)]
    summarised = iter(summaries([events for events, _ in results if events is not None]))
    for events, result in results:
        if events is not None:
            t, n_stick, counts = next(summarised)
            result |= {"t": t, "n_stick": n_stick, "n_stick_end": n_stick[-1], **counts}
    return [result for _, result in results]


class _Prepared(NamedTuple):
    """A member that is set up: with its run, which starts when it is called; what failed before is raised then."""

    member: Member
    run: Callable[[], sim.Run]
    system: sim.System | None = None
    start: tuple[Any, Any] | None = None
    stop_early: bool | str = True


def _prepared(members: Sequence[Member], recording: Recording) -> Iterator[_Prepared]:
    """The members in order, set up some at a time: one by one, small systems take longer to set up than to run."""
    for n, of_size in groupby(members, key=lambda member: member.n):
        size = min(_TOGETHER, max(1, _ENTRIES // n**2))
        while group := list(islice(of_size, size)):
            yield from _set_up(group, recording)


def _set_up(members: Sequence[Member], recording: Recording) -> list[_Prepared]:
    """Some members of as many blocks; those with the same settings may be set up, and begun, together."""
    prepared: list[_Prepared] = []
    alike: dict[Engine | Adiabatic, dict[int, Task]] = {}
    early = stop_early(recording.records)
    for k, member in enumerate(members):
        try:
            system, start = member.system(), member.start(end_of(member))
            engine, task = member.task(system, start, _times(member, recording), early)
        except Exception as error:  # noqa: BLE001  as in `_result`
            prepared.append(_Prepared(member, partial(_raise, error)))
            continue
        prepared.append(_Prepared(member, partial(engine.integrate, task), system, start, early))
        alike.setdefault(engine, {})[k] = task
    plain = {task.system: None for tasks in alike.values() for task in tasks.values() if task.system.is_plain}
    if len(plain) > 1:
        work_out([*plain])
    for engine, tasks in alike.items():
        with contextlib.suppress(Exception):  # each is then set up alone, when it is run, and says what is wrong
            for k, run in zip(tasks, engine.prepare([*tasks.values()]), strict=True):
                prepared[k] = prepared[k]._replace(run=run)
    return prepared


def _raise(error: Exception) -> sim.Run:
    raise error


def _result(prepared: _Prepared, recording: Recording) -> tuple[sim.EventSeries | None, dict[str, Any]]:
    """A member's events and what else came of it."""
    try:
        return _kept(_made(prepared), recording)
    except CacheError:  # no member of this machine can be run
        raise
    except Exception as error:  # noqa: BLE001  whatever went wrong is this member's outcome, not its neighbours'
        return None, failed(prepared.member, foreign(error))


def failed(member: Member, reason: str) -> dict[str, Any]:
    """The result of a member that could not be run."""
    # words of an exception may hold what Parquet's text cannot
    reason = reason.encode(errors="replace").decode()
    command_line = command("run", "scene.toml", "--only", member.member_id)
    return {"outcome": "failed", "reason": reason, "reproduce": command_line}


def _kept(result: Made, recording: Recording) -> tuple[sim.EventSeries, dict[str, Any]]:
    """What is kept of a run."""
    if not np.isfinite(result.run.events.t).all():
        raise FloatingPointError("the engine returned an event at a time that is not finite")
    for record in (ALWAYS, *recording.records):
        if record.applies(result.member):
            result.found.update(record.of(result))
    return result.run.events, result.found


def made(member: Member, record: Record) -> Made:
    """A member that was run for one record, which has computed nothing yet."""
    (prepared,) = _prepared([member], Recording("", records=(record,)))
    return _made(prepared)


def _made(prepared: _Prepared) -> Made:
    run = prepared.run()
    assert prepared.system is not None  # else that has raised
    assert prepared.start is not None
    values = _drawn_start(prepared.member, prepared.start)
    return Made(prepared.member, prepared.system, run, prepared.start, _again, values, prepared.stop_early)


def _drawn_start(member: Member, start: tuple[Any, Any]) -> dict[str, Any]:
    """z0 and w0 of a start that is drawn or read, before it is moved, where all blocks have the same number."""
    if not any(isinstance(value, NO_NUMBER) for value in (member.begin.z0, member.begin.w0)):
        return {}
    if member.change.twin_size is not None:
        start = replace(member, change=member.change._replace(twin_size=None)).start(end_of(member))
    pairs = zip(("z0", "w0"), map(np.ravel, start), member.state_scales, strict=True)
    return {name: float(value[0] * scale) for name, value, scale in pairs if (value == value[0]).all()}


def _again(member: Member, times: tuple[float, ...]) -> sim.Samples:
    return _states(replace(member, member_id=""), times)


@lru_cache(maxsize=8)  # copies of one run are neighbours in the scene's order; their ids are no part of the key
def _states(member: Member, times: tuple[float, ...]) -> sim.Samples:
    return member.simulate(times, end_of(member)).samples


def _times(member: Member, recording: Recording) -> np.ndarray:
    """When a run is sampled: at all times that some record asks for, in order."""
    asking = [record.times(member) for record in recording.records if record.applies(member)]
    return np.unique(np.concatenate(asking)) if any(map(len, asking)) else _NEVER


def cold_engines(engines: Iterable[str]) -> tuple[str, ...]:
    """Those with kernels that are still to be compiled here, once a version of `sim`, by name."""
    kernels = {engine: ENGINES[engine].kernels for engine in sorted(engines)}
    return tuple(engine for engine, package in kernels.items() if package and not has_kernel(package))


def load_kernels(members: Iterable[Member]) -> None:
    """Load the kernels that members need, or compile them, in a process of a worker's own."""
    n_before = len(_loaded)
    for member in members:
        size = max((size for size in ENGINES[member.engine].sizes if size <= member.n), default=member.n)
        if (member.engine, size) not in _loaded:
            source = member.source._replace(n=size, names=())
            of_all = tuple(term for term in member.terms if term[0] not in ("drive_block", "contacts"))
            tiny = replace(member, member_id="", source=source, terms=of_all, t_end=1e-6)
            tiny = replace(tiny, method=tiny.method._replace(load=None))
            if member.source.origin is not None:
                numbers = {"kappa": 0.1, "leaf": 0.1, "damping": 1.0, "friction": 1.0, "static": 1.0, "mass": 1.0}
                terms = dict(tiny.terms) | numbers | {"belt_speed": -0.2}
                source = tiny.source._replace(origin=None, coupling="chain", parameters=())
                begin = tiny.begin._replace(z0=0.0, w0=0.0, ends=None)
                tiny = replace(tiny, source=source, terms=tuple(terms.items()), begin=begin)
            row(tiny, Recording(""))
            _loaded.add((member.engine, size))
    if len(_loaded) > n_before:
        gc.collect()
        gc.freeze()  # what is loaded stays: to go through it again and again took a sixth of a worker's time
