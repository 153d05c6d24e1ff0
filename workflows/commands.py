"""The command `stickslip`: what each of its commands does, and the exit codes, which `workflows.parser` explains."""

from __future__ import annotations

import argparse
import gc
import os
import shlex
import sys
from collections.abc import Sized
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from stickslip.pipeline.errors import AddressError, QueryError, SceneError, ScheduleError, StoreError
from stickslip.pipeline.machine.processes import forked_workers, loading, one_thread
from stickslip.pipeline.machine.signals import Interrupted, interruptible
from stickslip.workflows.parser import NO_FOLDER, completion, parser

if TYPE_CHECKING:
    from stickslip.analysis import Report
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.places.place import Place, Where
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.progress import Watch

# The rooms below load dask, pyarrow and matplotlib: each command imports what it needs, so that --help is quick.

_DONE, _UNFINISHED, _WRONG = 0, 1, 2


def _run(arguments: argparse.Namespace) -> int:
    from stickslip.pipeline.places.directory import Directory
    from stickslip.pipeline.places.locate import place_of
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.scenes import chart_of, find, shipped

    file = find(arguments.scene)
    if not file.exists() and file.suffix != ".toml":
        from stickslip.sim.numerics.arguments import did_you_mean

        names = [*shipped(), *(str(near) for near in sorted(file.parent.glob("*.toml")))]
        raise _Wrong(
            f"SCENE: expected a file or one of the scenes {', '.join(shipped())}, got {arguments.scene!r}"
            + (did_you_mean(arguments.scene, names) or "; `stickslip scenes` says what they are")
        )
    out = place_of(arguments.out if arguments.out is not None else Path("runs") / file.stem)
    if isinstance(out, Directory):
        _check_directory(out.path, file)
    is_chart = chart_of(file) is not None
    if arguments.scheduler is not None and (is_chart or arguments.dry_run or arguments.only is not None):
        raise _Wrong(
            "--scheduler: expected none with a chart, --dry-run or --only, which use this machine; leave it out"
        )
    if is_chart and (arguments.only is not None or arguments.retry_failed):
        raise _Wrong("--only, --retry-failed: expected none with a chart, which has no members; leave it out")
    if is_chart:
        return _run_chart(arguments, file, out)
    if arguments.dry_run:
        return _say_estimate(arguments, file, out)
    if arguments.only is not None:
        return _run_member(file, arguments.only)
    # before all else: what these load, and what is loaded here, takes a second or two each
    are_forked = arguments.is_program and arguments.workers > 0 and arguments.scheduler is None
    with (
        forked_workers() if are_forked else nullcontext(),
        nullcontext() if arguments.no_report else Asking() as asking,
    ):
        return _run_ensemble(arguments, file, out, asking)


def _run_ensemble(arguments: argparse.Namespace, file: Path, out: Place, asking: Asking | None) -> int:
    with loading() if arguments.is_program else nullcontext():
        from stickslip.pipeline import run_ensemble
        from stickslip.pipeline.machine.signals import last_act
        from stickslip.pipeline.places.directory import Directory
        from stickslip.pipeline.places.place import DATA, SCENE
        from stickslip.workflows.progress import Watch, clock
        from stickslip.workflows.scenes import load

    scene = load(file)

    def how_to_go_on() -> None:
        print(f"\ninterrupted; finished work is kept. Resume with:\n  {_again(arguments, out)}", file=sys.stderr)

    try:
        with Watch(out) as watch, last_act(how_to_go_on):
            if asking is not None:
                # while workers compute
                Thread(target=import_module, args=("stickslip.workflows.reporting",), daemon=True).start()
            status = run_ensemble(
                scene,
                out,
                arguments.workers,
                arguments.scheduler,
                on_progress=watch,
                retry_failed=arguments.retry_failed,
                accept_version=arguments.accept_version,
                dashboard=arguments.dashboard,
            )
            if asking is not None:
                _write_report(out, asking, watch)
    except Interrupted as interrupt:
        how_to_go_on()
        return interrupt.exit_code
    print(f"data    {out.named(DATA)}: {status.n_done} members, {status.n_bytes / 1e6:.2f} MB")
    for reason, count in status.failures.items():
        print(f"failed  {count}: {reason}", file=sys.stderr)
    if status.failures:
        arguments.retry_failed = True
        copy = out.named(SCENE) if isinstance(out, Directory) else arguments.scene
        alone = ["stickslip", "run", copy, "--only", str(status.first_failed)]
        print(f"again   {_again(arguments, out)}\nalone   {shlex.join(alone)}", file=sys.stderr)
    if asking is None:
        print(f"report  not written; write it with: {shlex.join(['stickslip', 'report', str(out)])}")
    print(f"time    {clock(watch.elapsed)}, not counting the report")
    return _UNFINISHED if status.failures else _DONE


def _say_estimate(arguments: argparse.Namespace, file: Path, out: Place) -> int:
    from stickslip.pipeline.dataset.writer import Store
    from stickslip.pipeline.running import ends
    from stickslip.pipeline.running.cluster import check_memory
    from stickslip.pipeline.running.estimate import WITHIN, estimate
    from stickslip.workflows.progress import clock
    from stickslip.workflows.scenes import load

    scene = load(file)
    scene.check_engines()
    ends.check(scene)
    check_memory(scene, arguments.workers)
    store = Store(out, scene, arguments.retry_failed, arguments.accept_version)
    planned, to_go = ([batch for batch, _ in tasks] for tasks in store.look())
    shards = f"{len(planned)} shard{'s' * (len(planned) > 1)}"
    print(f"{file}: {scene.n_members} members in {shards}, into {out}", flush=True)
    if scene.extent:
        print(f"grid    {scene.extent}", flush=True)
    n_to_go = sum(len(batch.members) for batch in to_go)
    if n_to_go < scene.n_members:
        print(f"to go   {n_to_go} members in {len(to_go)} of the shards; the others are there", flush=True)
    if not to_go:
        return _DONE
    found = estimate(scene, to_go, arguments.workers)
    for reason, count in found.failures.items():
        print(f"failed  {count} of the pilot: {reason}")
    if found.failures:
        return _UNFINISHED
    workers = f"{found.workers} worker{'s' * (found.workers > 1)}"
    low, high = clock(found.seconds / WITHIN), clock(found.seconds * WITHIN)
    size, core = found.n_bytes / 1e6, found.core_seconds
    print(
        f"time    {clock(found.seconds)} ({low} to {high}) on {workers}, not counting start and report;"
        f" {core / WITHIN:.2g} to {core * WITHIN:.2g} s of a core\n"
        f"disk    {size:.2g} MB ({size / WITHIN:.2g} to {size * WITHIN:.2g})"
    )
    return _DONE


def _run_member(file: Path, member_id: str) -> int:
    from stickslip.pipeline import run_member
    from stickslip.workflows.scenes import load

    scene = load(file)
    try:
        row = run_member(scene, member_id)
    except ValueError as error:
        raise _Wrong(f"--only: {error}") from None
    for name, value in row.items():
        if value is not None:
            shown = f"{len(value)} values" if isinstance(value, Sized) and not isinstance(value, str) else value
            print(f"{name:18} {shown}")
    return _UNFINISHED if row["outcome"] == "failed" else _DONE


def _check_directory(out: Path, file: Path) -> None:
    """Refuse a directory in which a dataset would be in the way of something else."""
    from stickslip.pipeline.places.place import MANIFEST

    place, here = out.resolve(), Path(__file__).resolve().parents[1]
    if any(place.is_relative_to(here / floor) for floor in ("sim", "pipeline", "analysis", "workflows", "stickslip")):
        raise _Wrong(f"--out: expected a directory for data, got {out}, which is inside the program; choose another")
    if place.exists() and not place.is_dir():
        raise _Wrong(f"--out: expected a directory, got the file {out}; choose another")
    if place == file.resolve().parent and not (place / MANIFEST).exists():
        raise _Wrong(f"--out: expected a directory of its own, got {out}, where the scene file is; choose another")


def _check_no_ensemble(out: Place) -> None:
    from stickslip.pipeline.places.place import MANIFEST

    if MANIFEST in out.names():
        raise _Wrong(f"--out: {out} holds an ensemble, whose report would be lost; choose another directory")


def _run_chart(arguments: argparse.Namespace, file: Path, out: Place) -> int:
    from stickslip.pipeline.places.directory import Directory
    from stickslip.workflows.gallery.charts import load_chart

    scene = load_chart(file)
    if arguments.dry_run:
        print(f"{file}: a chart of {scene.extent()}, in one process, into {out}")
        return _DONE
    _check_no_ensemble(out)
    try:
        if isinstance(out, Directory):
            out.path.mkdir(parents=True, exist_ok=True)  # before the minutes of measuring
        measured = scene.measure(lambda line: print(line, file=sys.stderr, flush=True))
        from stickslip.workflows.gallery.charts.runner import report

        _publish(report(scene, measured), out)
    except Interrupted as interrupt:
        print("\ninterrupted; nothing was written", file=sys.stderr)
        return interrupt.exit_code
    return _DONE


def _again(arguments: argparse.Namespace, out: Place) -> str:
    where = ["--scheduler", arguments.scheduler] if arguments.scheduler else ["--workers", str(arguments.workers)]
    flags = [flag for flag in ("--retry-failed", "--no-report") if getattr(arguments, flag[2:].replace("-", "_"))]
    return shlex.join(["stickslip", "run", arguments.scene, "--out", str(out), *where, *flags])


def _write_report(directory: Where, asking: Asking | None = None, watch: Watch | None = None) -> None:
    from stickslip.analysis.report import PAGE
    from stickslip.pipeline.dataset.opened import open_dataset
    from stickslip.pipeline.dataset.status import Tally
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.fresh import is_current

    opened = open_dataset(directory)
    if is_current(opened):
        if watch is not None:
            watch.close()
        print(f"report  {opened.place.named(PAGE)}, unchanged")
    else:
        with Asking() if asking is None else nullcontext(asking) as processes:
            _build_report(opened, processes, watch)
    found = Tally.of(opened.tasks, opened.manifest.shards)
    if not found.is_complete:
        print(f"note: {found.n_members - found.n_done} of {found.n_members} members are still to run")


def _build_report(opened: Opened, asking: Asking, watch: Watch | None) -> None:
    gc.disable()  # what is loaded and found stays: no need to look through all of it again and again
    try:
        from stickslip.workflows.progress import Watch
        from stickslip.workflows.reporting import report

        with Watch(opened.place) if watch is None else watch as bar:
            built = report(opened, asking, bar.answered)
        _publish(built, opened.place)
    finally:
        gc.enable()


def _publish(built: Report, where: Where) -> None:
    from stickslip.workflows.reporting import write

    page = write(built, where)
    print("\n".join([*built.headline, f"report  {page}"]))


def _report(arguments: argparse.Namespace) -> int:
    if arguments.compare is None:
        if arguments.out is not None:
            raise _Wrong("--out: expected with --compare alone; a report belongs to its dataset")
        _write_report(arguments.directory)
    else:
        _write_comparison(arguments.directory, arguments.compare, arguments.out)
    return _DONE


def _write_comparison(first: Where, second: Where, out: Where | None) -> None:
    from stickslip.pipeline.places.locate import place_of
    from stickslip.workflows.fresh import name_of
    from stickslip.workflows.reporting import compared

    place = place_of(f"{str(place_of(first)).rstrip('/')}/compared/{name_of(second)}" if out is None else out)
    _check_no_ensemble(place)
    try:
        built = compared(first, second)
    except ValueError as error:
        raise _Wrong(str(error)) from None
    _publish(built, place)


def _status(arguments: argparse.Namespace) -> int:
    from stickslip.workflows.progress import say, watch

    try:
        (watch if arguments.watch else say)(arguments.directory)
    except Interrupted as interrupt:  # ends the watching, not the run
        return interrupt.exit_code
    return _DONE


def _verify(arguments: argparse.Namespace) -> int:
    from stickslip.pipeline import verify

    problems = verify(arguments.directory)
    print("\n".join(problems) if problems else f"{arguments.directory}: every shard is as the manifest says")
    return _UNFINISHED if problems else _DONE


def _query(arguments: argparse.Namespace) -> int:
    from stickslip.pipeline.query import answer
    from stickslip.workflows.export import form_of, write

    form = form_of(arguments.format, arguments.out)
    try:
        with answer(arguments.directory, arguments.sql) as batches:
            write(batches, form, arguments.out, arguments.directory)
    except Interrupted as interrupt:
        print("\ninterrupted; no answer was written", file=sys.stderr)
        return interrupt.exit_code
    return _DONE


def _export(arguments: argparse.Namespace) -> int:
    from stickslip.workflows.netcdf import write

    write(arguments.directory, arguments.netcdf)
    print(f"data    {arguments.netcdf}")
    return _DONE


def _scenes(arguments: argparse.Namespace) -> int:
    from stickslip.workflows.scaffold import listing

    print("\n".join(listing()))
    return _DONE


def _init(arguments: argparse.Namespace) -> int:
    from stickslip.workflows.scaffold import NotWritten, new_scene

    try:
        print("\n".join(new_scene(arguments.file)))
    except NotWritten as error:
        raise _Wrong(error) from None
    return _DONE


def _schema(arguments: argparse.Namespace) -> int:
    from stickslip.workflows.scaffold import key_lines, schema_text

    if arguments.chart is not None:
        from stickslip.workflows.gallery.charts import CHARTS

        if arguments.chart not in CHARTS:
            raise _Wrong(
                f"CHART: expected one of {', '.join(CHARTS)}, got {arguments.chart!r}; leave it out for ensembles"
            )
    print("\n".join(key_lines(arguments.chart)) if arguments.keys else schema_text(arguments.chart).rstrip())
    return _DONE


def _completion(arguments: argparse.Namespace) -> int:
    print(completion(parser(), arguments.shell))
    return _DONE


class _Wrong(ValueError):
    """A mistake in what was asked for that no room below sees."""


_COMMANDS = {
    "run": _run,
    "status": _status,
    "verify": _verify,
    "report": _report,
    "query": _query,
    "export": _export,
    "scenes": _scenes,
    "init": _init,
    "schema": _schema,
    "completion": _completion,
}


def main(argv: list[str] | None = None) -> int:
    """Run the command with `argv` (the process's own by default); returns the exit code."""
    arguments = parser().parse_args(argv, argparse.Namespace(is_program=argv is None))
    try:
        with interruptible(), one_thread():  # a report's products are small, and a member's digits are a worker's
            return _COMMANDS[arguments.command](arguments)
    except Interrupted as interrupt:
        print("\ninterrupted", file=sys.stderr)
        return interrupt.exit_code
    except (_Wrong, SceneError, QueryError, AddressError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _WRONG
    except (StoreError, ScheduleError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _UNFINISHED
    except BrokenPipeError:  # the reader, `head` for one, has seen enough; nothing can be told it any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _UNFINISHED
    except OSError as error:  # a scene, a report or an answer that cannot be written
        remedy = "make room or choose another place, then rerun the command"
        print(f"stickslip: {error}; {NO_FOLDER if isinstance(error, FileNotFoundError) else remedy}", file=sys.stderr)
        return _UNFINISHED
    except import_module("stickslip.sim.kernels.cache").CacheError as error:  # loaded only if it is none of the above
        print(f"stickslip: {error}", file=sys.stderr)
        return _WRONG
