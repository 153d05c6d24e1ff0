"""What a command of `stickslip` is."""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import ClassVar

from stickslip.pipeline.machine.processes import loading

#: Exit codes, as the help of the whole command explains them.
DONE, UNFINISHED, WRONG = 0, 1, 2


class Wrong(ValueError):
    """A mistake in what was asked for that no room below sees."""


class Command(ABC):
    """A word after `stickslip`, which is the name of the class, and what it does, which the docstring says in help.

    Modules of commands load nothing heavy before they are called, so that --help is quick.
    """

    #: Pairs of a command line and what it is for.
    examples: ClassVar[tuple[tuple[str, str], ...]]

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Tell the command's own parser what it takes; by default nothing."""
        del parser

    @abstractmethod
    def __call__(self, arguments: argparse.Namespace) -> int:
        """Run it and return the exit code.

        Beside its own arguments it finds `is_program`, whether this process is the command's own, and `parser`, that
        of the whole command.
        """


def loads(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """`loading`, in the command's own process: what a command loads and finds stays until it ends."""
    return loading() if arguments.is_program else nullcontext()


def add_places(parser: argparse.ArgumentParser) -> None:
    """The options that say where members are run."""
    where = parser.add_mutually_exclusive_group()
    # a default in text: argparse takes a value that is the default itself for one that was not given
    where.add_argument("--workers", type=count, default="2", metavar="N", help="local processes (default: 2)")
    add_clusters(where, parser)
    parser.add_argument(
        "--dashboard",
        action="store_true",
        help="serve dask's dashboard at 127.0.0.1, open to every user of this machine (needs bokeh)",
    )


def add_clusters(where: argparse._MutuallyExclusiveGroup, parser: argparse.ArgumentParser) -> None:
    """The options for a cluster; `scheduler` reads them."""
    where.add_argument("--scheduler", metavar="ADDRESS", help="address of a running dask cluster, tcp:// or tls://")
    where.add_argument("--slurm", type=count, metavar="N", help="N processes in jobs of Slurm")
    parser.add_argument(
        "--job",
        nargs="+",
        default=[],
        metavar="OPTION[=VALUE]",
        help="with --slurm: sbatch's options for each job (default: cpus-per-task=16 time=120 mem-per-cpu=2G)",
    )


@contextmanager
def scheduler(arguments: argparse.Namespace) -> Iterator[None]:
    """Within: jobs of Slurm, if they are asked for, are what `arguments.scheduler` stands for."""
    if getattr(arguments, "slurm", None) is None:
        if getattr(arguments, "job", []):
            raise Wrong("--job: expected with --slurm, whose jobs it is about; leave it out, or add --slurm N")
        yield
        return
    from stickslip.pipeline.running.slurm import job_settings, jobs

    try:
        settings = job_settings(arguments.slurm, arguments.job)
    except ValueError as error:
        raise Wrong(f"--job: {error}") from None
    with jobs(arguments.slurm, settings) as arguments.scheduler:
        yield


def count(text: str) -> int:
    """A count from the command line."""
    value = int(text) if text.isascii() and text.isdigit() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a count of at least 1, got {text!r}")
    return value


def listed(examples: tuple[tuple[str, str], ...]) -> str:
    """Examples as the help shows them, in two columns."""
    width = max((len(line) for line, words in examples if words), default=0)
    return "\n".join(["examples:", *(f"  {line:{width}}  {words}".rstrip() for line, words in examples), ""])
