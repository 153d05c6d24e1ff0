"""`stickslip status` and `verify`: how far a run is, and whether its data are sound."""

from __future__ import annotations

import argparse
import sys

from stickslip.pipeline.machine.signals import Interrupted
from stickslip.workflows.commands.command import DONE, UNFINISHED, Command


class Status(Command):
    """Show how far a run is, how fast it goes and what failed."""

    examples = (("stickslip status runs/quick", ""), ("stickslip status runs/quick --watch", "until the run ends"))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        parser.add_argument("--watch", action="store_true", help="repeat until the run ends")

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.workflows.progress import say, watch

        try:
            found = (watch if arguments.watch else say)(arguments.directory)
        except Interrupted as interrupt:  # ends the watching, not the run
            return interrupt.exit_code
        return UNFINISHED if found.n_damaged else DONE


class Verify(Command):
    """Check every byte of a dataset."""

    examples = (("stickslip verify runs/quick", ""),)

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.pipeline import verify
        from stickslip.pipeline.dataset.opened import open_dataset

        found = open_dataset(arguments.directory)
        problems = verify(found)
        if not problems:
            n, of = len(found.manifest.shards), len(found.tasks)
            rest = "" if n == of else f", {n} of {of}; rerun the scene for the others"
            print(f"{arguments.directory}: every shard that is done is as the manifest says{rest}")
            return DONE
        print("\n".join(problems))
        print("for shards, rerun the scene: it computes what is missing or damaged, and only that", file=sys.stderr)
        return UNFINISHED
