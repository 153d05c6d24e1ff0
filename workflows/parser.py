"""What may be typed after `stickslip`, the help that says so, and how a shell completes it. Loads nothing early."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from stickslip.workflows.scenes import shipped

_CODES = """exit codes:
  0    done
  1    failed or incomplete: members failed, data are missing or damaged, a directory holds something else; the
       message says what to do, and finished work is kept
  2    wrong option, scene or query; nothing was done
  130  interrupted by Ctrl-C (SIGINT)
  143  ended by SIGTERM
"""

#: What is said of a file that cannot be written for want of its folder.
NO_FOLDER = "the folder does not exist: create it or choose another"


class _Version(argparse.Action):
    """Looks the version up when it is asked for; argparse's own action wants it before."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from stickslip.version import __version__

        print(f"stickslip {__version__}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command."""
    whole = argparse.ArgumentParser(
        prog="stickslip",
        description="Cascades of stick and slip in groups of blocks held by dry friction.",
        epilog=_examples(
            ("stickslip scenes", "list what can be run"),
            ("stickslip run cascades", "run it, write runs/cascades and its report"),
            ("stickslip init mine.toml", "begin a scene of your own"),
            ("stickslip run mine.toml --workers 4", "run it on four cores"),
            ('stickslip query runs/cascades "SELECT engine, avg(n_exits) FROM members GROUP BY engine"', ""),
        )
        + "\n"
        + _CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    whole.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, words: str, *examples: tuple[str, str]) -> argparse.ArgumentParser:
        return commands.add_parser(
            name,
            help=words,
            description=f"{words[0].upper()}{words[1:]}.",
            epilog=_examples(*examples),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    _run(
        command(
            "run",
            "run a scene, or what is missing of it, and write its report",
            ("stickslip run quick", "a scene that ships, into runs/quick"),
            ("stickslip run mine.toml --dry-run", "what your own scene would take"),
            ("stickslip run mine.toml --out data/first --workers 4", ""),
            ("stickslip run mine.toml", "after an interruption: resumes"),
        )
    )
    status = command(
        "status",
        "show how far a run is, how fast it goes and what failed",
        ("stickslip status runs/quick", ""),
        ("stickslip status runs/quick --watch", "until the run ends"),
    )
    status.add_argument("directory", metavar="DIR")
    status.add_argument("--watch", action="store_true", help="repeat until the run ends")

    verify = command("verify", "check every byte of a dataset", ("stickslip verify runs/quick", ""))
    verify.add_argument("directory", metavar="DIR")

    report = command(
        "report",
        "rewrite the report of a dataset, or compare it with another",
        ("stickslip report runs/quick", "writes runs/quick/report.html"),
        ("stickslip report runs/a --compare runs/b", "do their statistics agree?"),
    )
    report.add_argument("directory", metavar="DIR")
    report.add_argument("--compare", metavar="DIR2", help="compare the statistics of DIR with those of DIR2")
    report.add_argument(
        "--out", metavar="DIR3", help="directory of the comparison (default: DIR/compared/<name of DIR2>)"
    )

    query = command(
        "query",
        "query a dataset in SQL (views: members, n_stick, cascades, ...)",
        ('stickslip query runs/quick "SELECT outcome, count(*) FROM members GROUP BY outcome"', ""),
        ('stickslip query runs/quick "SELECT * FROM n_stick" --out n_stick.parquet', ""),
    )
    query.add_argument("directory", metavar="DIR")
    query.add_argument("sql", metavar="SQL")
    query.add_argument(
        "--format",
        choices=("table", "csv", "parquet"),
        help="format of the answer (default: from the ending of FILE, else a table)",
    )
    query.add_argument(
        "--out", type=Path, metavar="FILE", help="file to write the answer to (default: standard output)"
    )

    export = command(
        "export",
        "write a dataset as one file of another form",
        ("stickslip export runs/quick --netcdf quick.nc", "for xarray and others"),
    )
    export.add_argument("directory", metavar="DIR")
    export.add_argument("--netcdf", type=Path, metavar="FILE", required=True, help="file to write, in NetCDF-4")

    command("scenes", "list the scenes that ship, with members and time", ("stickslip scenes", ""))
    init = command(
        "init",
        "write a commented scene to start from",
        ("stickslip init", "writes scene.toml"),
        ("stickslip init mine.toml", ""),
    )
    init.add_argument("file", type=Path, nargs="?", default=Path("scene.toml"), metavar="FILE")
    schema = command(
        "schema",
        "print the JSON Schema of scene files, with which editors complete and check them",
        ("stickslip schema > stickslip.schema.json", "for ensembles, as `stickslip init` writes it"),
        ("stickslip schema stability", "for the scenes of a chart"),
        ("stickslip schema --keys", "every key: default, meaning, values"),
    )
    schema.add_argument("chart", nargs="?", metavar="CHART", help="a kind of chart, the key `chart` of its scenes")
    schema.add_argument("--keys", action="store_true", help="list the keys in words instead, one a line")
    completion = command(
        "completion",
        "print a completion script for a shell",
        ('eval "$(stickslip completion bash)"', "in ~/.bashrc"),
        ('eval "$(stickslip completion zsh)"', "in ~/.zshrc, after compinit"),
        ("stickslip completion fish | source", "in ~/.config/fish/config.fish"),
    )
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish")
    return whole


def _run(run: argparse.ArgumentParser) -> None:
    run.add_argument("scene", metavar="SCENE", help="a scene file, or the name of one that ships")
    run.add_argument(
        "--out", metavar="DIR", help="directory of the dataset, or s3://bucket/dir (default: runs/<scene>)"
    )
    where = run.add_mutually_exclusive_group()
    # a default in text: argparse takes a value that is the default itself for one that was not given
    where.add_argument("--workers", type=_count, default="2", metavar="N", help="local processes (default: 2)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="address of a running dask cluster, tcp:// or tls://")
    run.add_argument(
        "--dashboard",
        action="store_true",
        help="serve dask's dashboard at 127.0.0.1, open to every user of this machine (needs bokeh)",
    )
    run.add_argument("--no-report", action="store_true", help="write no report; `stickslip report DIR` does so later")
    run.add_argument("--retry-failed", action="store_true", help="run the shards of failed members again")
    run.add_argument("--accept-version", action="store_true", help="resume data that another version began")
    run.add_argument("--only", metavar="MEMBER", help="run one member and show its row; write nothing")
    run.add_argument(
        "--dry-run",
        action="store_true",
        help="show what would be run and estimate time and disk; write nothing",
    )


def _examples(*examples: tuple[str, str]) -> str:
    width = max(len(line) for line, words in examples if words) if any(words for _, words in examples) else 0
    lines: Sequence[str] = [f"  {line:{width}}  {words}".rstrip() for line, words in examples]
    return "\n".join(["examples:", *lines, ""])


def _count(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a count of at least 1, got {text!r}")
    return value


# ---------------------------------------------------------------------------------------------- shells


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """A script by which a shell completes the command: commands, options, names of scenes, files and directories."""
    import shtab

    names = " ".join(shipped())
    complete: dict[str, Any] = {
        "DIR": shtab.DIRECTORY,
        "FILE": shtab.FILE,
        "SCENE": {
            "bash": "_stickslip_scene",
            "zsh": "_stickslip_scene",
            "fish": f"(string split ' ' '{names}'; __fish_complete_suffix .toml)",
            "preamble": {
                "bash": '_stickslip_scene() { compgen -W "' + names + "\" -- $1; compgen -f -X '!*.toml' -- $1;"
                " compgen -d -- $1; }\n",
                "zsh": f"_stickslip_scene() {{ compadd {names}; _files -g '*.toml' }}\n",
            },
        },
    }
    for action in _actions(parser):
        if action.metavar in complete:
            action.complete = complete[str(action.metavar)]  # type: ignore[attr-defined]  # shtab looks for it
    return str(shtab.complete(parser, shell=shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _actions(sub)
