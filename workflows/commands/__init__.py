"""The command `stickslip`: its commands, what it says of mistakes, and its exit codes."""

from __future__ import annotations

import argparse
import io
import os
import re
import signal
import sys
from importlib import import_module
from typing import Any

from stickslip.pipeline.errors import AddressError, QueryError, SceneError, ScheduleError, StoreError, remedy
from stickslip.pipeline.machine.processes import frugal, open_streams
from stickslip.pipeline.machine.signals import Interrupted, interruptible, leave
from stickslip.workflows.commands.command import UNFINISHED, WRONG, Wrong, listed, scheduler
from stickslip.workflows.commands.extend import Extend
from stickslip.workflows.commands.plot import Plot
from stickslip.workflows.commands.query import Export, Query
from stickslip.workflows.commands.report import Report
from stickslip.workflows.commands.run import Run
from stickslip.workflows.commands.scenes import Init, Scenes, Schema
from stickslip.workflows.commands.status import Status, Verify
from stickslip.workflows.printed import printed

#: By name, in the order of the help. A class here, and the command has it.
COMMANDS = {
    command.__name__.lower(): command()
    for command in (Run, Status, Verify, Extend, Report, Query, Export, Plot, Scenes, Init, Schema)
}

_EXAMPLES = (
    ("stickslip scenes", "list what can be run"),
    ("stickslip run cascades", "run it, write runs/cascades and its report"),
    ("stickslip init mine.toml", "begin a scene of your own"),
    ("stickslip run mine.toml --workers 4", "run it on four cores"),
    ('stickslip query runs/cascades "SELECT engine, avg(n_exits) FROM members GROUP BY engine"', ""),
)

_CODES = """exit codes:
  0    done
  1    failed or incomplete: members or a question of your own failed, data are missing or damaged, a directory
       holds something else; the message says what to do, and finished work is kept
  2    wrong option, scene or query; nothing was done
  129  its terminal was closed (SIGHUP)
  130  interrupted by Ctrl-C (SIGINT)
  143  ended by SIGTERM
"""


#: As the system says of a library for which there is no room, or of a thread.
_NO_MEMORY = re.compile("failed to map segment|cannot allocate|can't start new thread", re.IGNORECASE)


class _Version(argparse.Action):
    """Looks the version up when it is asked for; argparse's own action wants it before."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from stickslip.version import __version__

        print(f"stickslip {__version__}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command."""
    form = argparse.RawDescriptionHelpFormatter
    whole = argparse.ArgumentParser(
        prog="stickslip",
        description="Cascades of stick and slip in groups of blocks held by dry friction.",
        epilog=f"{listed(_EXAMPLES)}\n{_CODES}",
        formatter_class=form,
    )
    whole.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        about = command.__doc__ or ""
        words = about[:1].lower() + about[1:].rstrip(".")
        command.add_arguments(
            commands.add_parser(
                name, help=words, description=about, epilog=listed(command.examples), formatter_class=form
            )
        )
    return whole


def _lacks_memory(error: BaseException | None) -> bool:
    """Whether it is for want of memory, of which a library that cannot be loaded says no more than the system."""
    if error is None or isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
        return error is not None
    return _lacks_memory(error.__cause__ or error.__context__)


def main(argv: list[str] | None = None) -> int:
    """Run the command with `argv` (the process's own by default); returns the exit code."""
    if argv is None:
        open_streams()
        os.environ["MPLBACKEND"] = "agg"  # it draws files alone, whatever backend a session has
        if isinstance(sys.stdout, io.TextIOWrapper):  # names may have letters that its encoding lacks
            sys.stdout.reconfigure(errors="backslashreplace")
    with printed():
        code = _done(argv)
    if argv is None:
        leave(code)
    return code


def _lacks_directory() -> bool:
    """Whether the directory that this process works in was removed."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _is_out() -> bool:
    """Whether what was printed could be written; if not, it is told."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python tries again as it ends
        print(
            f"stickslip: the standard output cannot be written ({error.strerror}); {remedy(error)}", file=sys.stderr
        )
        return False
    return True


def _done(argv: list[str] | None) -> int:
    try:
        whole = parser()
        arguments = whole.parse_args(argv, argparse.Namespace(is_program=argv is None, parser=whole))
        # one thread: a report's products are small, and a member's digits are a worker's
        with interruptible(arguments.is_program), frugal(), scheduler(arguments):
            return COMMANDS[arguments.command](arguments)
    except Interrupted as interrupt:
        print("\ninterrupted", file=sys.stderr)
        return interrupt.exit_code
    except KeyboardInterrupt:  # before signals are ours
        return 128 + signal.SIGINT
    except SystemExit:  # of the parser, once its help is out, or a mistake is told
        if not _is_out():
            return UNFINISHED
        raise
    except (Wrong, SceneError, QueryError, AddressError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return WRONG
    except (StoreError, ScheduleError) as error:
        print(f"stickslip: {error}", file=sys.stderr)
        return UNFINISHED
    except BrokenPipeError:  # the reader, `head` for one, has seen enough; nothing can be told it any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNFINISHED
    except OSError as error:  # a scene, a report or an answer that cannot be written
        if _lacks_directory():
            print("stickslip: expected a working directory, got one that was removed; go to another", file=sys.stderr)
            return UNFINISHED
        print(f"stickslip: {error}; {remedy(error)}, then rerun the command", file=sys.stderr)
        return UNFINISHED
    except (MemoryError, ImportError) as error:
        if not _lacks_memory(error):
            raise
        why = " ".join(str(error).split()) or "out of memory"
        print(
            f"stickslip: expected memory for what is computed, got none left ({why}); raise `ulimit -v`, close"
            " other programs, or take a larger machine",
            file=sys.stderr,
        )
        return UNFINISHED
    except import_module("stickslip.sim.kernels.cache").CacheError as error:  # loaded if it is none of the above
        print(f"stickslip: {error}", file=sys.stderr)
        return WRONG
