"""Figure 6: the fast flow, and modes in slow time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from scipy.linalg import expm

from stickslip import sim
from stickslip.analysis.style import BLUE, CYCLE, GREY, ORANGE, panel
from stickslip.workflows.gallery.charts.peers import Floats
from stickslip.workflows.gallery.paper.figures_1_2 import V, pair
from stickslip.workflows.gallery.theory.blowup import Blowup
from stickslip.workflows.gallery.theory.laws import Coulomb, Modified, SwitchingLaw
from stickslip.workflows.gallery.theory.slow_time import Segment, run_with_law

#: Figure 6: F_1 = -F_2.
FORCE = 0.5
#: Two blocks under the modified law: how long before they reach the belt the runs start, and end after it.
BEFORE, AFTER = 0.1, 2.0
#: Modes in slow time are followed to here.
SHOWN = 0.01


@dataclass(frozen=True)
class BlowUp:
    """Figure 6: the fast field on a grid of (lambda_1, lambda_2), and modes as (lambda_1, lambda_2, is stable)."""

    law: str
    axis: Floats
    rate: Floats
    modes: list[tuple[float, float, bool]]


@dataclass(frozen=True)
class SlowEvent:
    """What happens to two blocks on the belt: a row of the table `hidden`; `block` is -1 if it concerns both."""

    from_side: int
    t: float
    kind: str
    cause: str
    block: int
    lambda_1_before: float
    lambda_2_before: float
    lambda_1_after: float
    lambda_2_after: float


@dataclass(frozen=True)
class SlowRun:
    """Two blocks that reach the belt at one instant, t = 0, from slip to one side, under the modified law.

    `lam` are lambda_1, lambda_2 at the times `t`.
    """

    side: int
    t: Floats
    lam: Floats
    events: list[SlowEvent]


def blow_ups() -> list[BlowUp]:
    """The fast system under both laws at F_1 = -F_2 = `FORCE`, mu = 1, the factors of the sigmoid kept."""
    axis = np.linspace(-1.0, 1.0, 41)
    force = np.array([FORCE, -FORCE])
    laws: dict[str, SwitchingLaw] = {"Coulomb": Coulomb(), "modified": Modified()}
    flows = []
    for name, law in laws.items():
        blow_up = Blowup(law, np.ones(2))
        rate = np.array([[blow_up.rhs(force, np.array([x, y])) for x in axis] for y in axis])
        modes = [(float(m.lam[0]), float(m.lam[1]), m.is_stable) for m in blow_up.sticking_modes(force)]
        flows.append(BlowUp(name, axis, np.moveaxis(rate, 2, 0), modes))
    return flows


def held(system: sim.System) -> Floats:
    """Where F_1 = -F_2 = `FORCE` with both blocks on the belt; shape (2,)."""
    force = np.array([FORCE, -FORCE])
    return np.asarray(np.linalg.solve(system.stiffness, force - system.damping * system.belt_speed))


def slow_run(side: int) -> SlowRun:
    """From slip of both blocks to one side, through the state of figure 6, to the exits.

    The start is the solution of the slipping system traced back from that state, in closed form.
    """
    system, law = pair(1), Modified()
    slip = np.full(2, side)
    at_belt = np.concatenate([held(system), np.full(2, V)])
    equilibrium = np.concatenate([system.rest_state(slip), np.zeros(2)])
    start = equilibrium + expm(-BEFORE * system.slip_matrix()) @ (at_belt - equilibrium)
    run = run_with_law(system, law, start[:2], start[2:], BEFORE + AFTER)
    blow_up = Blowup(law, system.friction)
    paths = [_mode_of(system, blow_up, segment) for segment in run.segments if not segment.slip.any()]
    times, lam = (np.concatenate(pieces) for pieces in zip(*paths, strict=True))
    events = [
        SlowEvent(side, _tidy(e.t - BEFORE), e.kind, e.cause, e.block, *_tidy(e.lam_before), *_tidy(e.lam))
        for e in run.events
    ]
    return SlowRun(side, times - BEFORE, lam.T, events)


def _tidy(value: Any) -> Any:
    """Plain numbers, rounded to 12 decimals so that zero is zero."""
    return (np.round(value, 12) + 0.0).tolist()


def _mode_of(system: sim.System, blow_up: Blowup, segment: Segment) -> tuple[Floats, list[Floats]]:
    """lambda on a segment in which all blocks stick: at each time the stable mode next to the one before."""
    times = np.linspace(segment.t_start, segment.t_end, 61)
    path = [segment.lam_start]
    for t in times[1:-1]:
        force = system.holding_force(segment.z + V * (t - segment.t_start))
        stable = [mode.lam for mode in blow_up.sticking_modes(force) if mode.is_stable]
        path.append(min(stable, key=lambda lam: float(np.abs(lam - path[-1]).max())))
    return times, [*path, segment.lam_end]


def modes_in_time() -> list[tuple[float, float, bool]]:
    """(t, lambda_2, is stable) of every sticking mode of the modified law, about the time at which one is lost."""
    system = pair(1)
    blow_up, start = Blowup(Modified(), system.friction), held(system)
    return [
        (float(t), float(mode.lam[1]), mode.is_stable)
        for t in np.linspace(0.0, SHOWN, 81)
        for mode in blow_up.sticking_modes(system.holding_force(start + V * t))
        if mode.kind != "degenerate"
    ]


# ---------------------------------------------------------------------------------------------- drawings


@panel()
def fast_flow(ax: Axes, flow: BlowUp) -> None:
    """The fast flow in the box of (lambda_1, lambda_2), stable modes filled, others open."""
    right, up = flow.rate
    ax.streamplot(flow.axis, flow.axis, right, up, color=BLUE, density=0.7, linewidth=0.8, broken_streamlines=False)
    for is_stable, label in ((True, "sticking mode, stable"), (False, "sticking mode, saddle")):
        modes = [(x, y) for x, y, holds in flow.modes if holds == is_stable]
        if modes:
            ax.plot(*zip(*modes, strict=True), "o", color=ORANGE if is_stable else "white", markersize=8, zorder=5,
                    markeredgecolor="black", linestyle="none", label=label)  # fmt: skip
    title = f"({'a' if flow.law == 'Coulomb' else 'b'}) {flow.law} law"
    ax.set(title=title, xlabel="λ₁", ylabel="λ₂", xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
    ax.spines[["top", "right"]].set_visible(True)
    ax.figure.legend(loc="outside lower center", ncols=2, fontsize=7)


@panel()
def slow_modes(ax: Axes, points: Sequence[tuple[float, float, bool]], runs: Sequence[SlowRun]) -> None:
    """lambda_2 of the sticking modes in slow time, and of the two runs."""
    for is_wanted, marker, size, label in ((True, "o", 3.5, "mode, stable"), (False, "x", 3.0, "mode, saddle")):
        values = [(t, y) for t, y, is_stable in points if is_stable == is_wanted]
        ax.plot(*np.array(values).reshape(-1, 2).T, marker, color=GREY, markersize=size, alpha=0.4, label=label)
    for k, run in enumerate(runs):
        early = run.t <= SHOWN
        label = "run from λ = " + ("(1, 1)" if run.side > 0 else "(−1, −1)")
        ax.plot(run.t[early], run.lam[1, early], ("-", "--")[k], color=CYCLE[k], linewidth=2, label=label)
    ax.set(title="(c) modified law in slow time", xlabel="time t", ylabel="λ₂")
    ax.legend(fontsize=7, loc="center right")
