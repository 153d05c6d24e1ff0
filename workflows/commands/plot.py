"""`stickslip plot`: a picture of one member, from the events that its dataset keeps."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from stickslip.workflows.commands.command import DONE, Command, Wrong

if TYPE_CHECKING:
    from stickslip.pipeline.dataset.opened import Opened

_HEIGHT = 4.0  # inches


class Plot(Command):
    """Draw a member of a dataset that records events: which block slips when."""

    examples = (
        ("stickslip plot runs/mine n100-m000-coulomb-1e-10 --out slips.svg", ""),
        ("stickslip plot runs/mine n100-m000-coulomb-1e-10 --span 200 250 --out slips.png", "between two times"),
        ("stickslip plot runs/mine n100-m000-coulomb-1e-10 --kind spectrum --out spectrum.pdf", ""),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("directory", metavar="DIR")
        parser.add_argument("member", metavar="MEMBER", help="its member_id, as in the view `members`")
        parser.add_argument(
            "--kind",
            default="space_time",
            metavar="KIND",
            help="space_time (default); n_stick; slip: how often each block of a grid slips, as a map; or spectrum:"
            " that of n_stick",
        )
        parser.add_argument(
            "--span", nargs=2, type=float, metavar=("T0", "T1"), help="times between which to draw (default: all)"
        )
        parser.add_argument(
            "--out", type=Path, metavar="FILE", required=True, help="file to write, ending in .svg, .pdf or .png"
        )

    def __call__(self, arguments: argparse.Namespace) -> int:
        from stickslip.workflows.export import whole

        content = _picture(arguments)
        with whole(arguments.out, arguments.directory) as stream:
            stream.write(content)
        print(f"picture {arguments.out}")
        return DONE


def _picture(arguments: argparse.Namespace) -> bytes:
    """The contents of the file that was asked for."""
    from stickslip.analysis.style import FORMS, WIDTH, panel
    from stickslip.pipeline.dataset.opened import open_dataset
    from stickslip.pipeline.query import events

    ending = arguments.out.suffix.lower()
    if ending not in FORMS:
        raise Wrong(f"--out: expected a file named {', '.join(FORMS)}, got {arguments.out}")
    opened = open_dataset(arguments.directory)
    series = events(opened, arguments.member)
    options = {} if arguments.span is None else {"span": arguments.span}
    if arguments.kind in ("space_time", "slip"):
        width = _grid(opened, arguments.member)
        if arguments.kind == "slip" and not width:
            raise Wrong("--kind: 'slip' is a map of a grid, and these blocks form none; draw space_time")
        options |= width
    draw = panel(_HEIGHT, WIDTH)(lambda ax: series.plot(arguments.kind, ax, **options))
    try:
        return FORMS[ending](draw())
    except ValueError as error:
        raise Wrong(f"--{error}") from None


def _grid(opened: Opened, member: str) -> dict[str, int]:
    """How long the rows are if the member's blocks form a grid, as an option of the picture."""
    from stickslip.pipeline.query import members
    from stickslip.sim.systems.graphs import grid_width

    row = members(opened, ["n", "coupling"], [("member_id", "=", member)]).iloc[0]
    return {"width": grid_width(int(row["n"]))} if row["coupling"] == "grid" else {}
