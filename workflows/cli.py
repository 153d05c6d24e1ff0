"""The command `stickslip`.

Exit codes: 0 done; 1 the work could not be finished, members failed, or the data are damaged; 2 what was asked for
is wrong; 130 interrupted by Ctrl-C (SIGINT); 143 ended by SIGTERM.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline import Scene

# The rooms below load dask, pyarrow and matplotlib: each command imports what it needs, so that --help is quick.

_DONE, _UNFINISHED, _WRONG, _INTERRUPTED = 0, 1, 2, 130

_EXAMPLES = """examples:
  stickslip scenes                            what can be run
  stickslip run cascades                      run it, write runs/cascades and its report
  stickslip run my-scene.toml --workers 4     run your own
  stickslip query runs/cascades "SELECT engine, avg(n_exits) FROM members GROUP BY engine"
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="stickslip",
        description="Cascades of stick and slip in groups of blocks held by dry friction.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run a scene, or what is missing of it, and write its report")
    run.add_argument("scene", metavar="SCENE", help="a scene file, or the name of one that ships")
    run.add_argument("--out", type=Path, metavar="DIR", help="directory of the dataset (default: runs/<scene>)")
    where = run.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_count, default=2, metavar="N", help="local processes (default: 2)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="address of a running dask cluster")
    run.add_argument("--retry-failed", action="store_true", help="run the shards of failed members again")
    run.add_argument("--accept-version", action="store_true", help="go on with data that another version began")
    run.add_argument("--only", metavar="MEMBER", help="run one member and show its row; write nothing")
    run.add_argument("--dry-run", action="store_true", help="say what would be run, and run nothing")

    status = commands.add_parser("status", help="how far a run is, how fast it goes, and what failed")
    status.add_argument("directory", type=Path, metavar="DIR")
    status.add_argument("--watch", action="store_true", help="go on saying so until the run ends")

    for name, words in (
        ("verify", "check every byte of a dataset"),
        ("report", "write the report of a dataset anew"),
    ):
        commands.add_parser(name, help=words).add_argument("directory", type=Path, metavar="DIR")
    query = commands.add_parser("query", help="ask a dataset in SQL (views: members, n_stick, cascades, ...)")
    query.add_argument("directory", type=Path, metavar="DIR")
    query.add_argument("sql", metavar="SQL")
    query.add_argument(
        "--format", choices=("table", "csv", "parquet"), help="of the answer (default: as FILE ends; else a table)"
    )
    query.add_argument("--out", type=Path, metavar="FILE", help="where the answer goes (default: here)")
    commands.add_parser("scenes", help="list the scenes that ship")
    return parser


def _count(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a count of at least 1, got {text!r}")
    return value


def _run(arguments: argparse.Namespace) -> int:
    from pipeline import Interrupted, batches, expand, load_scene, run_scene
    from pipeline.interrupt import last_act
    from workflows.progress import Watch, clock, in_words
    from workflows.scenes import chart_of, find, shipped

    file = find(arguments.scene)
    if not file.exists() and file.suffix != ".toml":
        raise _Wrong(
            f"SCENE: expected a file or one of the scenes {', '.join(shipped())}, got {arguments.scene!r};"
            " `stickslip scenes` says what they are"
        )
    out = arguments.out if arguments.out is not None else Path("runs") / file.stem
    _check_place(out, file)
    if chart_of(file) is not None:
        return _run_chart(arguments, file, out)
    scene = load_scene(file)
    if arguments.dry_run:
        from pipeline.estimate import estimate

        packed = batches(expand(scene), scene.hash)
        print(
            f"{file}: {scene.n_members} members in {len(packed)} shard{'s' * (len(packed) > 1)}, into {out}",
            flush=True,
        )
        print("\n".join(in_words(estimate(scene, packed, arguments.workers))))
        return _DONE
    if arguments.only is not None:
        return _run_member(scene, arguments.only)

    def how_to_go_on() -> None:
        print(f"\ninterrupted; what is done is kept. Go on with:\n  {_again(arguments, out)}", file=sys.stderr)

    try:
        with Watch(out) as watch, last_act(how_to_go_on):
            status = run_scene(
                scene,
                file.read_bytes(),
                out,
                arguments.workers,
                arguments.scheduler,
                on_progress=watch,
                retry_failed=arguments.retry_failed,
                accept_version=arguments.accept_version,
            )
            _write_report(out)
    except Interrupted as interrupt:
        how_to_go_on()
        return interrupt.exit_code
    print(f"data    {out / 'data'}: {status.n_done} members, {status.n_bytes / 1e6:.2f} MB")
    for reason, count in status.failures.items():
        print(f"failed  {count}: {reason}", file=sys.stderr)
    if status.failures:
        arguments.retry_failed = True
        alone = ["stickslip", "run", str(out / "scene.toml"), "--only", str(status.first_failed)]
        print(f"again   {_again(arguments, out)}\nalone   {shlex.join(alone)}", file=sys.stderr)
    print(f"time    {clock(watch.elapsed)}")
    return _UNFINISHED if status.failures else _DONE


def _run_member(scene: Scene, member_id: str) -> int:
    from pipeline import run_member

    try:
        row = run_member(scene, member_id)
    except ValueError as error:
        raise _Wrong(f"--only: {error}") from None
    for name, value in row.items():
        if value is not None:
            print(f"{name:18} {value if not hasattr(value, '__len__') or isinstance(value, str) else len(value)}")
    return _UNFINISHED if row["outcome"] == "failed" else _DONE


def _check_place(out: Path, file: Path) -> None:
    """Refuse a directory in which a dataset would be in the way of something else."""
    place, here = out.resolve(), Path(__file__).resolve().parents[1]
    if any(place.is_relative_to(here / floor) for floor in ("sim", "pipeline", "analysis", "workflows")):
        raise _Wrong(f"--out: expected a directory for data, got {out}, which is inside the program; name another")
    if place.exists() and not place.is_dir():
        raise _Wrong(f"--out: expected a directory, got the file {out}; name another")
    if place == file.resolve().parent and not (place / "manifest.json").exists():
        raise _Wrong(f"--out: expected a directory of its own, got {out}, where the scene file is; name another")


def _run_chart(arguments: argparse.Namespace, file: Path, out: Path) -> int:
    from workflows.charts import ChartError, load_chart
    from workflows.charts.alone import measure_alone

    kind, scene = load_chart(file)
    if arguments.scheduler:
        raise _Wrong("--scheduler: expected none with a chart, which is measured on one core here; leave it out")
    if arguments.dry_run:
        print(f"{file}: a chart of {kind.extent(scene)}, in one process, into {out}")
        return _DONE
    if (out / "manifest.json").exists():
        raise _Wrong(f"--out: {out} holds an ensemble, whose report would be lost; name another directory")
    try:
        out.mkdir(parents=True, exist_ok=True)  # before the minutes of measuring
        built = kind.build(scene, measure_alone(file))
        page = built.write(out)
    except (ChartError, OSError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _UNFINISHED
    except KeyboardInterrupt:
        print("\ninterrupted; nothing was written", file=sys.stderr)
        return _INTERRUPTED
    print("\n".join(built.headline))
    print(f"report  {page}")
    return _DONE


def _again(arguments: argparse.Namespace, out: Path) -> str:
    where = ["--scheduler", arguments.scheduler] if arguments.scheduler else ["--workers", str(arguments.workers)]
    retry = ["--retry-failed"] if arguments.retry_failed else []
    return shlex.join(["stickslip", "run", arguments.scene, "--out", str(out), *where, *retry])


def _write_report(directory: Path) -> None:
    from workflows.reporting import report

    built, status = report(directory)
    page = built.write(directory)
    if not status.is_complete:
        print(f"note: {status.n_members - status.n_done} of {status.n_members} members are still to run")
    print("\n".join(built.headline))
    print(f"report  {page}")


def _report(arguments: argparse.Namespace) -> int:
    _write_report(arguments.directory)
    return _DONE


def _status(arguments: argparse.Namespace) -> int:
    from workflows.progress import say, watch

    try:
        (watch if arguments.watch else say)(arguments.directory)
    except KeyboardInterrupt:  # of the looking: the run goes on
        return _INTERRUPTED
    return _DONE


def _verify(arguments: argparse.Namespace) -> int:
    from pipeline import verify

    problems = verify(arguments.directory)
    print("\n".join(problems) if problems else f"{arguments.directory}: every shard is as the manifest says")
    return _UNFINISHED if problems else _DONE


def _query(arguments: argparse.Namespace) -> int:
    from pipeline.query import answer
    from workflows.answers import form_of, write

    form = form_of(arguments.format, arguments.out)
    try:
        with answer(arguments.directory, arguments.sql) as batches:
            write(batches, form, arguments.out, arguments.directory)
    except KeyboardInterrupt:
        print("\ninterrupted; no answer was written", file=sys.stderr)
        return _INTERRUPTED
    return _DONE


def _scenes(arguments: argparse.Namespace) -> int:
    from pipeline import load_scene
    from workflows.charts import load_chart
    from workflows.scenes import chart_of, shipped

    for name, file in shipped().items():
        if chart_of(file) is not None:
            _, chart = load_chart(file)
            print(f"{name:14} {'a chart':>14}  {chart.title}. {chart.about}")
            continue
        scene = load_scene(file)
        print(f"{name:14} {scene.n_members:6} members  {scene.title}. {scene.about}")
    return _DONE


class _Wrong(ValueError):
    """A mistake in what was asked for that no room below sees."""


_COMMANDS = {
    "run": _run,
    "status": _status,
    "verify": _verify,
    "report": _report,
    "query": _query,
    "scenes": _scenes,
}


def main(argv: list[str] | None = None) -> int:
    """Run the command with `argv` (the process's own by default); returns the exit code."""
    arguments = _parser().parse_args(argv)
    from pipeline import Interrupted, QueryError, SceneError, ScheduleError, StoreError, interruptible

    try:
        with interruptible():
            return _COMMANDS[arguments.command](arguments)
    except Interrupted as interrupt:
        print("\ninterrupted", file=sys.stderr)
        return interrupt.exit_code
    except (SceneError, QueryError, _Wrong) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _WRONG
    except (StoreError, ScheduleError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _UNFINISHED
    except BrokenPipeError:  # the reader, `head` for one, has seen enough; nothing can be told it any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _UNFINISHED
    except OSError as error:  # a report or an answer that cannot be written
        print(f"stickslip: {error}; make room or name another place, then give the command again", file=sys.stderr)
        return _UNFINISHED


if __name__ == "__main__":
    sys.exit(main())
