"""The drawing of the guide's page on the exact engine: `python docs/exact_engine.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from stickslip.analysis.style import BLUE, GREEN, GREY, ORANGE, PURPLE, blank, styled, svg
from stickslip.sim import System, simulate
from stickslip.workflows.gallery.theory.folds import sticking_lambda, two_blocks

_T_END = 8.0
#: About here block 1 slips, and block 2 too.
_T_SERIES = 2.0
_COLOURS = (BLUE, ORANGE)


def exact_engine() -> Figure:
    """Two blocks from rest on the belt: what is watched, what is found, and how far a series reaches."""
    system = two_blocks(1.1, 1.6, 0.5, rho=0.1, mu=1.0, v=-1.0)
    t = np.linspace(0.0, _T_END, 2001)
    run = simulate(system, 0.0, -1.0, _T_END, t_eval=t, tol=1e-13, stop_early=False)
    modes = np.array([run.events.mode_at(time) for time in t])
    with styled():
        figure = blank(4.2)
        grid = figure.add_gridspec(2, 2, width_ratios=(3, 2))
        speeds = figure.add_subplot(grid[0, 0])
        forces = figure.add_subplot(grid[1, 0], sharex=speeds)
        reach = figure.add_subplot(grid[:, 1])
        lam = sticking_lambda(system, run.samples.z)
        for i, colour in enumerate(_COLOURS):
            speeds.plot(t, run.samples.w[:, i] - system.belt_speed, color=colour, label=f"block {i + 1}")
            forces.plot(t, np.where(modes[:, i] == 0, lam[:, i], np.nan), color=colour)
        for time, block, mode in zip(run.events.t, run.events.block, run.events.mode, strict=True):
            ax, y = (speeds, 0.0) if mode == 0 else (forces, float(mode))
            ax.plot(time, y, "o" if mode == 0 else "s", color=_COLOURS[block], markersize=5, clip_on=False)
            for both in (speeds, forces):
                both.axvline(time, color=GREY, linewidth=0.5, linestyle=":")
        speeds.axhline(0.0, color=GREY, linewidth=0.6)
        speeds.set(title="w - v: a slipping block reaches the belt (o)", ylabel="w - v")
        speeds.legend(loc="upper right")
        forces.axhspan(-1.0, 1.0, color=GREY, alpha=0.12, linewidth=0)
        forces.set(title="lambda: a sticking block leaves at +1 or -1 (squares)", ylabel="lambda", xlabel="t")
        forces.set_ylim(-1.25, 1.25)
        _reach(reach, system)
    return figure


def _reach(ax: matplotlib.axes.Axes, system: System) -> None:
    """Error of the series of w about one instant, by order, against the step."""
    h = np.linspace(0.02, 4.0, 300)
    run = simulate(
        system, 0.0, -1.0, _T_SERIES + h[-1], t_eval=[_T_SERIES, *(_T_SERIES + h)], tol=1e-15, stop_early=False
    )
    start, later = run.samples.first(1), run.samples.w[1:]
    series = _series(system, start.z[0], start.w[0], run.events.mode_at(_T_SERIES), 32)
    for order, colour in ((8, GREEN), (16, PURPLE), (32, BLUE)):
        powers = np.arange(1, order + 1)
        w = (powers[:, None, None] * series[1 : order + 1, None] * h[:, None] ** (powers - 1)[:, None, None]).sum(0)
        error = np.abs(w - later).max(axis=1)
        ax.semilogy(h, np.maximum(error, 1e-17), color=colour, label=f"order {order}")
    ax.axhline(1e-10, color=GREY, linewidth=0.8, linestyle="--")
    ax.annotate(
        "tol = 1e-10", (h[-1], 1e-10), ha="right", xytext=(0, -10), textcoords="offset points", fontsize=8, color=GREY
    )
    ax.set(title=f"Error of the series about t = {_T_SERIES:g}", xlabel="step h", ylabel="largest error of w")
    ax.set_ylim(1e-17, 1e3)
    ax.legend(loc="upper left")


def _series(system: System, z: np.ndarray, w: np.ndarray, mode: np.ndarray, order: int) -> np.ndarray:
    """c_k, shape (order + 1, n), of blocks that slip: the recurrence of `stickslip.sim.engines.coulomb.taylor`."""
    c = np.zeros((order + 1, system.n))
    c[0], c[1] = z, w
    for k in range(order - 1):
        push = system.friction * mode if k == 0 else 0.0
        c[k + 2] = -(system.damping * (k + 1) * c[k + 1] + system.stiffness @ c[k] + push) / ((k + 2) * (k + 1))
    return c


if __name__ == "__main__":
    (Path(__file__).parent / "exact_engine.svg").write_text(svg(exact_engine()), encoding="utf-8")
