"""The drawing of the README beside the page: `python docs/slips.py`."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes

from stickslip import draw_system, simulate
from stickslip.analysis.style import WIDTH, panel, svg

SPAN = (600.0, 650.0)


@panel(4.2, WIDTH)
def slips(ax: Axes) -> None:
    """Which block of the first system of the scene `cascades` slips when."""
    system = draw_system("antisymmetric", n=200, seed=0)
    run = simulate(system, -0.7, -0.4, SPAN[1], tol=1e-10)
    run.plot("space_time", ax, span=SPAN)


if __name__ == "__main__":
    (Path(__file__).parent / "slips.svg").write_text(svg(slips()), encoding="utf-8")
