"""The drawing of the guide's section on pictures of a run: `python docs/pictures.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stickslip import Rational, draw_system, simulate
from stickslip.analysis.style import WIDTH, panel, svg


@panel(5.2, WIDTH, nrows=2, ncols=2)
def pictures(axes: np.ndarray) -> None:
    """The chain of `guide/python.md`: a picture of each kind but n_stick."""
    chain = draw_system(
        "chain", n=40, seed=1, kappa=4.0, leaf=0.3, damping=0.3, belt_speed=-0.02, weakening=Rational(2.0)
    )
    start = np.random.default_rng(0).uniform(-0.3, 0.3, chain.n)
    run = simulate(chain, start, -0.02, 300.0, t_eval=np.linspace(0.0, 300.0, 6001))
    (whole, times), (phase, spectrum) = axes
    run.plot("space_time", whole)
    run.plot("time", times, of="w", blocks=[20, 21], span=(90.0, 120.0))
    run.plot("phase", phase, block=20, span=(90.0, 120.0))
    run.plot("spectrum", spectrum, block=20)
    for ax, kind in zip(axes.flat, ("space_time", "time", "phase", "spectrum"), strict=True):
        ax.set_title(kind)


if __name__ == "__main__":
    (Path(__file__).parent / "pictures.svg").write_text(svg(pictures()), encoding="utf-8")
