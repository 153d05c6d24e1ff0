"""`stickslip report`: the page of a dataset, or of two that are compared."""

from __future__ import annotations

import argparse
import gc
from contextlib import nullcontext
from typing import TYPE_CHECKING

from stickslip.pipeline.errors import printable
from stickslip.workflows.commands.command import DONE, Command, Wrong

if TYPE_CHECKING:
    from stickslip.analysis import Report as Built
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.places.place import Place, Where
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.progress import Watch


class Report(Command):
    """`stickslip report`."""

    name = "report"
    words = "rewrite the report of a dataset, or compare it with another"
    examples = (
        ("stickslip report runs/quick", "writes runs/quick/report.html"),
        ("stickslip report runs/a --compare runs/b", "do their statistics agree?"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        parser.add_argument("--compare", metavar="DIR2", help="compare the statistics of DIR with those of DIR2")
        parser.add_argument(
            "--out", metavar="DIR3", help="directory of the comparison (default: DIR/compared/<name of DIR2>)"
        )

    def __call__(self, arguments: argparse.Namespace) -> int:
        if arguments.compare is None:
            if arguments.out is not None:
                raise Wrong("--out: expected with --compare alone; a report belongs to its dataset")
            write_report(arguments.directory)
        else:
            _write_comparison(arguments.directory, arguments.compare, arguments.out)
        return DONE


def write_report(directory: Where, asking: Asking | None = None, watch: Watch | None = None) -> None:
    from stickslip.analysis.report import PAGE
    from stickslip.pipeline.dataset.opened import open_dataset
    from stickslip.pipeline.dataset.status import Tally
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.fresh import is_current

    opened = open_dataset(directory)
    if is_current(opened):
        if watch is not None:
            watch.close()
        print(printable(f"report  {opened.place.named(PAGE)}, unchanged"))
    else:
        with Asking() if asking is None else nullcontext(asking) as processes:
            _build(opened, processes, watch)
    found = Tally.of(opened.tasks, opened.manifest.shards)
    if not found.is_complete:
        print(f"note: {found.n_members - found.n_done} of {found.n_members} members are still to run")


def _build(opened: Opened, asking: Asking, watch: Watch | None) -> None:
    gc.disable()  # what is loaded and found stays: no need to look through all of it again and again
    try:
        from stickslip.workflows.progress import Watch
        from stickslip.workflows.reporting import report

        with Watch(opened.place) if watch is None else watch as bar:
            built = report(opened, asking, bar.answered)
        publish(built, opened.place)
    finally:
        gc.enable()


def publish(built: Built, where: Where) -> None:
    from stickslip.workflows.reporting import write

    page = write(built, where)
    print("\n".join([*built.headline, printable(f"report  {page}")]))


def _write_comparison(first: Where, second: Where, out: Where | None) -> None:
    from stickslip.pipeline.places.locate import place_of
    from stickslip.workflows.fresh import name_of
    from stickslip.workflows.reporting import compared

    place = place_of(f"{str(place_of(first)).rstrip('/')}/compared/{name_of(second)}" if out is None else out)
    check_no_ensemble(place)
    try:
        built = compared(first, second)
    except ValueError as error:
        raise Wrong(str(error)) from None
    publish(built, place)


def check_no_ensemble(out: Place) -> None:
    from stickslip.pipeline.places.place import MANIFEST

    if MANIFEST in out.names():
        raise Wrong(f"--out: {out} holds an ensemble, whose report would be lost; choose another directory")
