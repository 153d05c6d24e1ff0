"""`stickslip run`: an ensemble with its report, one member, a chart, or what any of them would take."""

from __future__ import annotations

import argparse
import os
import sys
import unicodedata
from collections.abc import Callable, Sequence, Sized
from contextlib import nullcontext, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from stickslip.pipeline.errors import command, printable, shortened
from stickslip.pipeline.machine.processes import forked_workers
from stickslip.pipeline.machine.signals import Interrupted
from stickslip.workflows.commands.command import DONE, UNFINISHED, Command, Wrong, add_places, loads
from stickslip.workflows.commands.report import check_no_ensemble, publish, write_report

if TYPE_CHECKING:
    from stickslip.pipeline import Batch, Scene
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.places.place import Place

#: Options of `run_ensemble`.
_FLAGS = ("retry_failed", "accept_version", "dashboard", "yes")
#: Reasons for which functions of the user's own gave no value, that are shown.
_REASONS = 5


class Run(Command):
    """Run a scene, or what is missing of it, and write its report."""

    examples = (
        ("stickslip run quick", "a scene that ships, into runs/quick"),
        ("stickslip run mine.toml --dry-run", "what your own scene would take"),
        ("stickslip run mine.toml --out data/first --workers 4", ""),
        ("stickslip run mine.toml", "after an interruption: resumes"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("scene", metavar="SCENE", help="a scene file, or the name of one that ships")
        parser.add_argument(
            "--out", metavar="DIR", help="directory of the dataset, or s3://bucket/dir (default: runs/<scene>)"
        )
        add_places(parser)
        add_options(parser)
        parser.add_argument("--only", metavar="MEMBER", help="run one member and show its row; write nothing")

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.pipeline.places.locate import place_of
        from stickslip.workflows.scenes import chart_of, find, load, shipped

        check_name("SCENE", arguments.scene)
        check_name("--out", arguments.out or "")
        file = find(arguments.scene)
        if arguments.out is None and not file.stem.strip("."):  # runs/ itself, or what it is in
            raise Wrong(
                f"SCENE: expected a name that data can have under runs/, got {file.name!r}; rename it, or"
                " add --out DIR"
            )
        if not file.exists() and file.suffix != ".toml":
            from stickslip.sim.numerics.arguments import did_you_mean

            names = [*shipped(), *(str(near) for near in sorted(file.parent.glob("*.toml")))]
            raise Wrong(
                f"SCENE: expected a file or one of the scenes {', '.join(shipped())}, got {arguments.scene!r}"
                + (did_you_mean(arguments.scene, names) or "; `stickslip scenes` says what they are")
            )
        out = place_of(arguments.out if arguments.out is not None else Path("runs") / file.stem)
        check_directory(out, file)
        is_chart = chart_of(file) is not None
        if arguments.scheduler is not None and (is_chart or arguments.dry_run or arguments.only is not None):
            raise Wrong(
                "--scheduler, --slurm: expected none with a chart, --dry-run or --only, which use this machine; "
                "leave it out"
            )
        if is_chart and (arguments.only is not None or arguments.retry_failed):
            raise Wrong("--only, --retry-failed: expected none with a chart, which has no members; leave it out")
        if is_chart:
            return _run_chart(arguments, file, out)
        words = ("run", arguments.scene, "--out", str(out))
        if arguments.dry_run:
            return say_estimate(arguments, load(file), file, out)
        if arguments.only is not None:
            return _run_member(file, arguments.only)
        return run(arguments, words, lambda: load(file), file, out)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of what runs a scene."""
    for option, words in (
        ("--no-report", "write no report; `stickslip report DIR` does so later"),
        ("--retry-failed", "run the shards of failed members again"),
        ("--accept-version", "resume data that another version began, or take such rows over"),
        ("--yes", "run more than 10 million members"),
        ("--dry-run", "show what would be run and estimate time and disk; write nothing"),
    ):
        parser.add_argument(option, action="store_true", help=words)


def run(
    arguments: argparse.Namespace,
    words: Sequence[str],
    load: Callable[[], Scene],
    file: Path,
    out: Place,
    kept: Opened | None = None,
) -> int:
    """Run a scene into a place, and write its report; the exit code.

    `words` are those with which the command is given again. `load` gives the scene, and is called once workers are
    loading what they need. Questions of the user's own lie beside `file`; they are not asked of rows that are `kept`.
    """
    try:
        import dask.config  # noqa: F401  reads the files that every process of a run will read
    except ValueError as error:
        raise Wrong(f"dask: {shortened(str(error), 400)}; correct the file, or unset DASK_CONFIG") from None
    from stickslip.workflows.asking import Asking

    # the jobs of Slurm are there: whoever started them may be on a machine that is not to compute
    jobs = arguments.scheduler if arguments.slurm is not None else None
    # before all else: what these load, and what is loaded here, takes a second or two each
    are_forked = arguments.is_program and arguments.workers > 0 and arguments.scheduler is None
    own = file.parent if kept is None else None
    with (
        forked_workers() if are_forked else nullcontext(),
        nullcontext() if arguments.no_report else Asking(own, scheduler=jobs) as asking,
    ):
        with loads(arguments):
            from stickslip.pipeline import run_ensemble
            from stickslip.pipeline.machine.signals import last_act
            from stickslip.pipeline.places.directory import Directory
            from stickslip.pipeline.places.place import DATA, SCENE
            from stickslip.workflows import own_questions
            from stickslip.workflows.progress import Watch, clock

        scene = load()
        if asking is not None and asking.own is not None:
            own_questions.check(scene, asking.own, str(file))

        def how_to_go_on() -> None:
            again = _again(arguments, words)
            print(f"\ninterrupted; finished work is kept. Resume with:\n  {again}", file=sys.stderr)

        flags = {name: getattr(arguments, name) for name in _FLAGS}
        is_answered = True
        try:
            with Watch(out) as watch, last_act(how_to_go_on):
                if asking is not None:
                    Thread(target=_load_report, daemon=True).start()  # while workers compute
                status = run_ensemble(scene, out, arguments.workers, arguments.scheduler, watch, kept=kept, **flags)
                if asking is not None:
                    with loads(arguments):
                        is_answered = write_report(out, asking, watch)
        except Interrupted as interrupt:
            how_to_go_on()
            return interrupt.exit_code
    print(f"data    {printable(out.named(DATA))}: {status.n_done} members, {status.n_bytes / 1e6:.2f} MB")
    for reason, count in status.failures.items():
        print(f"failed  {count}: {reason}", file=sys.stderr)
    _say_problems(scene, out)
    if status.failures:
        arguments.retry_failed = True
        copy = out.named(SCENE) if isinstance(out, Directory) else str(file)
        alone = command("run", copy, "--only", str(status.first_failed))
        print(f"again   {_again(arguments, words)}\nalone   {alone}", file=sys.stderr)
    if asking is None:
        print(f"report  not written; write it with: {command('report', str(out))}")
    print(f"time    {clock(watch.elapsed)}, not counting the report")
    return UNFINISHED if status.failures or not is_answered else DONE


def _load_report() -> None:
    with suppress(Exception):  # it is raised again where the report is needed
        import_module("stickslip.workflows.reporting")


def _say_problems(scene: Scene, out: Place) -> None:
    """Why functions of the user's own gave no value, the commonest reasons."""
    from stickslip.pipeline.query import members

    if scene.own_record is None:
        return
    reasons = members(out, ["own_problem"])["own_problem"].value_counts()
    for reason, count in reasons.head(_REASONS).items():
        print(f"own     {count}: {printable(str(reason))}", file=sys.stderr)
    if len(reasons) > _REASONS:
        print(f"own     {reasons[_REASONS:].sum()}: others, in the column own_problem", file=sys.stderr)


def say_estimate(
    arguments: argparse.Namespace, scene: Scene, file: Path, out: Place, kept: Opened | None = None
) -> int:
    """Say what running a scene into a place would take; the exit code. Arguments are those of `run`."""
    from stickslip.pipeline.dataset.writer import Store
    from stickslip.pipeline.running import ends
    from stickslip.pipeline.running.estimate import WITHIN, check_memory, estimate
    from stickslip.pipeline.running.trials import check_functions
    from stickslip.workflows import own_questions
    from stickslip.workflows.progress import clock

    if kept is None:
        own_questions.check(scene, file.parent, str(file))
    scene.check_size(arguments.yes)
    scene.check_engines()
    ends.check(scene)
    check_memory(scene, arguments.workers)
    store = Store(out, scene, arguments.retry_failed, arguments.accept_version)
    planned, to_go = store.look()
    shards = f"{len(planned)} shard{'s' * (len(planned) > 1)}"
    print(printable(f"{file}: {scene.n_members} members in {shards}, into {out}"), flush=True)
    if scene.extent:
        print(f"grid    {scene.extent}", flush=True)
    if scene.system.assumes_masses:
        print("masses  1, as neither the files nor [system] give any", flush=True)
    n_to_go = sum(len(batch.members) for batch in to_go)
    if n_to_go < scene.n_members:
        print(f"to go   {n_to_go} members in {len(to_go)} of the shards; the others are there", flush=True)
    if kept is not None:
        to_go = _left(store.todo, kept)
    if not to_go:
        return DONE
    check_functions(scene, store.todo)
    forecast = estimate(scene, to_go, arguments.workers)
    for reason, count in forecast.failures.items():
        print(f"failed  {count} of the pilot: {reason}")
    if forecast.failures:
        return UNFINISHED
    workers = f"{forecast.workers} worker{'s' * (forecast.workers > 1)}"
    low, high = clock(forecast.seconds / WITHIN), clock(forecast.seconds * WITHIN)
    size, core = forecast.n_bytes / 1e6, forecast.core_seconds
    print(
        f"time    {clock(forecast.seconds)} ({low} to {high}) on {workers}, not counting start and report;"
        f" {core / WITHIN:.2g} to {core * WITHIN:.2g} s of a core\n"
        f"disk    {size:.2g} MB ({size / WITHIN:.2g} to {size * WITHIN:.2g})"
    )
    return DONE


def _left(todo: Sequence[Batch], kept: Opened) -> list[Batch]:
    """The members that are run beside rows that are kept, by shard."""
    from stickslip.pipeline.running.taken_over import KeptRows

    rows = KeptRows(kept)
    left = [replace(batch, members=rows.left(batch)) for batch in todo]
    n_run, n_members = (sum(len(batch.members) for batch in batches) for batches in (left, todo))
    print(f"to run  {n_run} of {n_members} members; what is kept suffices for the others", flush=True)
    return [batch for batch in left if len(batch.members)]


def _run_member(file: Path, member_id: str) -> int:
    from stickslip.pipeline import run_member
    from stickslip.workflows.scenes import load

    scene = load(file)
    try:
        row = run_member(scene, member_id)
    except ValueError as error:
        raise Wrong(f"--only: {error}") from None
    for name, value in row.items():
        if value is not None:
            shown = f"{len(value)} values" if isinstance(value, Sized) and not isinstance(value, str) else value
            print(f"{name:18} {shown}")
    return UNFINISHED if row["outcome"] == "failed" else DONE


def _run_chart(arguments: argparse.Namespace, file: Path, out: Place) -> int:
    from stickslip.pipeline.places.directory import Directory
    from stickslip.workflows.gallery import load_chart, report

    scene = load_chart(file)
    if arguments.dry_run:
        print(f"{file}: a chart of {scene.extent()}, in one process, into {out}")
        return DONE
    check_no_ensemble(out)
    try:
        if isinstance(out, Directory):
            out.make()  # before the minutes of measuring
        measured = scene.measure(lambda line: print(line, file=sys.stderr, flush=True))
        publish(report(scene, measured), out)
    except Interrupted as interrupt:
        print("\ninterrupted; nothing was written", file=sys.stderr)
        return interrupt.exit_code
    return DONE


def _again(arguments: argparse.Namespace, words: Sequence[str]) -> str:
    if arguments.slurm is not None:
        where = ["--slurm", str(arguments.slurm), *(["--job", *arguments.job] if arguments.job else [])]
    elif arguments.scheduler is not None:
        where = ["--scheduler", arguments.scheduler]
    else:
        where = ["--workers", str(arguments.workers)]
    known = ("--retry-failed", "--no-report", "--yes")
    flags = [flag for flag in known if getattr(arguments, flag[2:].replace("-", "_"))]
    return command(*words, *where, *flags)


def check_name(argument: str, name: str) -> None:
    """Refuse a name that data cannot be read under."""
    if any(unicodedata.category(c) == "Cs" for c in name):
        raise Wrong(f"{argument}: expected a name in UTF-8, got {name!a}; rename it")


def check_directory(out: Place, file: Path) -> None:
    """Refuse a directory in which a dataset would be in the way of something else, and a store that does not last."""
    from stickslip.pipeline.places.directory import Directory
    from stickslip.pipeline.places.place import MANIFEST

    if not isinstance(out, Directory):
        if "memory" in out.address.partition("://")[0].split("::"):
            raise Wrong(
                f"--out: expected a place that lasts, got {out}, which ends with this command; choose another"
            )
        return
    # of a loop of links no error comes here, but where it is opened
    place, here = Path(os.path.realpath(out.path)), Path(__file__).resolve().parents[2]
    if any(place.is_relative_to(here / floor) for floor in ("sim", "pipeline", "analysis", "workflows", "stickslip")):
        raise Wrong(f"--out: expected a directory for data, got {out}, which is inside the program; choose another")
    if place.exists() and not place.is_dir():
        raise Wrong(f"--out: expected a directory, got the file {out}; choose another")
    if place == Path(os.path.realpath(file)).parent and not (place / MANIFEST).exists():
        raise Wrong(f"--out: expected a directory of its own, got {out}, where the scene file is; choose another")
