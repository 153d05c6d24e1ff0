"""The command `stickslip`.

Exit codes: 0 done; 1 the work could not be finished or the data are damaged; 2 what was asked for is wrong;
130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

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
    run.add_argument("--dry-run", action="store_true", help="say what would be run, and run nothing")

    for name, words in (
        ("status", "how far a run is"),
        ("verify", "check every byte of a dataset"),
        ("report", "write the report of a dataset anew"),
    ):
        commands.add_parser(name, help=words).add_argument("directory", type=Path, metavar="DIR")
    query = commands.add_parser("query", help="ask a dataset in SQL (views: members, n_stick, events)")
    query.add_argument("directory", type=Path, metavar="DIR")
    query.add_argument("sql", metavar="SQL")
    commands.add_parser("scenes", help="list the scenes that ship")
    return parser


def _count(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a count of at least 1, got {text!r}")
    return value


def _run(arguments: argparse.Namespace) -> int:
    from pipeline import batches, expand, load_scene, run_scene
    from workflows.progress import Watch, clock
    from workflows.scenes import chart_of, find, shipped

    file = find(arguments.scene)
    if not file.exists() and file.suffix != ".toml":
        raise _Wrong(
            f"SCENE: expected a file or one of the scenes {', '.join(shipped())}, got {arguments.scene!r};"
            " `stickslip scenes` says what they are"
        )
    out = arguments.out if arguments.out is not None else Path("runs") / file.stem
    if chart_of(file) is not None:
        return _run_chart(arguments, file, out)
    scene = load_scene(file)
    if arguments.dry_run:
        members = expand(scene)
        print(f"{file}: {len(members)} members in {len(batches(members, scene.hash))} shards, into {out}")
        return _DONE
    try:
        with Watch() as watch:
            status = run_scene(
                scene, file.read_bytes(), out, arguments.workers, arguments.scheduler, on_progress=watch
            )
    except KeyboardInterrupt:
        print(f"\ninterrupted; what is done is kept. Go on with:\n  {_again(arguments, out)}", file=sys.stderr)
        return _INTERRUPTED
    _write_report(out)
    print(f"data    {out / 'data'}: {status.n_done} members, {status.n_bytes / 1e6:.2f} MB")
    for reason, count in status.failures.items():
        print(f"failed  {count}: {reason}", file=sys.stderr)
    print(f"time    {clock(watch.elapsed)}")
    return _UNFINISHED if status.failures else _DONE


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
    where = f"--scheduler {arguments.scheduler}" if arguments.scheduler else f"--workers {arguments.workers}"
    return f"stickslip run {arguments.scene} --out {out} {where}"


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
    from pipeline import status

    found = status(arguments.directory)
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in found.outcomes.items()) or "none yet"
    print(f"members {found.n_done} of {found.n_members} done: {outcomes}")
    print(f"shards  {found.n_shards}, {found.n_bytes / 1e6:.2f} MB")
    for reason, count in found.failures.items():
        print(f"failed  {count}: {reason}")
    return _DONE


def _verify(arguments: argparse.Namespace) -> int:
    from pipeline import verify

    problems = verify(arguments.directory)
    print("\n".join(problems) if problems else f"{arguments.directory}: every shard is as the manifest says")
    return _UNFINISHED if problems else _DONE


def _query(arguments: argparse.Namespace) -> int:
    from pipeline.query import sql

    print(sql(arguments.directory, arguments.sql).to_string(index=False))
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
    from pipeline import QueryError, SceneError, ScheduleError, StoreError

    try:
        return _COMMANDS[arguments.command](arguments)
    except (SceneError, QueryError, _Wrong) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _WRONG
    except (StoreError, ScheduleError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return _UNFINISHED
    except BrokenPipeError:  # the reader, `head` for one, has seen enough; nothing can be told it any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _UNFINISHED


if __name__ == "__main__":
    sys.exit(main())
