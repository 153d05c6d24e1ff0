"""`stickslip report`: the page of a dataset, or of two that are compared."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from stickslip.pipeline.errors import command, printable
from stickslip.workflows.commands.command import DONE, UNFINISHED, Command, Wrong, add_clusters, count, loads

if TYPE_CHECKING:
    from stickslip.analysis import Report as Built
    from stickslip.pipeline.dataset.opened import Opened
    from stickslip.pipeline.places.place import Place, Where
    from stickslip.workflows.asking import Asking
    from stickslip.workflows.progress import Watch


class Report(Command):
    """Rewrite the report of a dataset, or compare it with another."""

    examples = (
        ("stickslip report runs/quick", "writes runs/quick/report.html"),
        ("stickslip report runs/mine --own", "with your own questions: runs the code beside the scene"),
        ("stickslip report runs/mine --pdf", "its figures as PDF too"),
        ("stickslip report runs/a --compare runs/b", "do their statistics agree?"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        parser.add_argument("--compare", metavar="DIR2", help="compare the statistics of DIR with those of DIR2")
        parser.add_argument(
            "--out", metavar="DIR3", help="directory of the comparison (default: DIR/compared/<name of DIR2>)"
        )
        parser.add_argument(
            "--own",
            action="store_true",
            help="answer the questions module:function of the scene: runs the code beside it, or beside DIR",
        )
        parser.add_argument("--pdf", action="store_true", help="draw the figures as PDF too")
        where = parser.add_mutually_exclusive_group()
        where.add_argument("--workers", type=count, metavar="N", help="dask's local processes that look at the runs")
        add_clusters(where, parser)

    def __call__(self, arguments: argparse.Namespace) -> int:
        with loads(arguments):
            return self._written(arguments)

    def _written(self, arguments: argparse.Namespace) -> int:
        if arguments.compare is None:
            if arguments.out is not None:
                raise Wrong("--out: expected with --compare alone; a report belongs to its dataset")
            from stickslip.pipeline.dataset.opened import open_dataset
            from stickslip.workflows.asking import Asking

            opened = open_dataset(arguments.directory)
            own = opened.folder if arguments.own else None
            with Asking(own, arguments.pdf, arguments.workers, arguments.scheduler, opened) as asking:
                return DONE if write_report(opened, asking) else UNFINISHED
        if arguments.workers is not None or arguments.scheduler is not None:
            raise Wrong(
                "--workers, --scheduler, --slurm: expected without --compare, which looks at the runs here; leave "
                "them out"
            )
        if arguments.own:
            raise Wrong("--own: expected without --compare, which runs no code of the scene's; leave it out")
        if arguments.pdf:
            raise Wrong("--pdf: expected without --compare, which draws its figure as PDF in any case; leave it out")
        _write_comparison(arguments.directory, arguments.compare, arguments.out)
        return DONE


def write_report(directory: Where | Opened, asking: Asking, watch: Watch | None = None) -> bool:
    """Write the report of a dataset, unless it is up to date; False if a question of the user's own failed.

    If they may be run, the report is always made again: they may depend on anything. So is one with figures as PDF.
    """
    from stickslip.analysis.page import PAGE
    from stickslip.pipeline.dataset.opened import open_dataset
    from stickslip.workflows import own_questions
    from stickslip.workflows.fresh import has_own, is_current

    opened, is_own = open_dataset(directory), asking.own is not None
    own, problems = own_questions.names(opened.scene), dict[str, str]()
    if is_current(opened) and not asking.with_pdf and not (own and is_own):
        if watch is not None:
            watch.close()
        print(printable(f"report  {opened.place.named(PAGE)}, unchanged"))
        is_own = has_own(opened)
    else:
        problems = {**_build(opened, asking, watch).problems}
    for name, problem in problems.items():
        print(printable(f"failed  {name}: {problem}"), file=sys.stderr)
    if not is_own:
        for name in own:
            with_own = command("report", str(opened.place), "--own")
            print(printable(f"note: {name} was not run; `{with_own}` runs the code beside the scene"))
    if opened.n_done < opened.n_members:
        print(f"note: {opened.n_members - opened.n_done} of {opened.n_members} members are still to run")
    return not problems


def _build(opened: Opened, asking: Asking, watch: Watch | None) -> Built:
    from stickslip.workflows.progress import Watch
    from stickslip.workflows.reporting import report

    with Watch(opened.place) if watch is None else watch as bar:
        built = report(opened, asking, bar.answered)
    publish(built, opened.place)
    return built


def publish(built: Built, where: Where) -> None:
    from stickslip.workflows.reporting import write

    page = write(built, where)
    print("\n".join(map(printable, [*built.headline, f"report  {page}"])))


def _write_comparison(first: Where, second: Where, out: Where | None) -> None:
    from stickslip.pipeline.places.locate import place_of
    from stickslip.workflows.fresh import name_of
    from stickslip.workflows.reporting import compared

    place = place_of(first).below(f"compared/{name_of(second)}") if out is None else place_of(out)
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
