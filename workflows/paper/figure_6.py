"""Figure 6 and what it leaves open: the fast flow, modes in slow time, a state with more than one future."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import expm

from stickslip import sim
from stickslip.analysis.style import BLUE, CYCLE, GREY, ORANGE, STYLE, blank, subplots
from stickslip.sim.theory.blowup import Blowup, Mode, continuations
from stickslip.sim.theory.laws import Coulomb, Modified, StaticAboveKinetic, SwitchingLaw
from stickslip.sim.theory.slow_time import LawRun, Segment, run_with_law
from stickslip.workflows.charts.peers import Floats
from stickslip.workflows.paper.figures_1_2 import ONE, V, pair, single

#: Figure 6: F_1 = -F_2.
FORCE = 0.5
#: Two blocks under the modified law: how long before they reach the belt the runs start, and end after it.
BEFORE, AFTER = 0.1, 2.0
#: Static over kinetic friction of the state with two futures, and how long these are followed.
RATIO, FUTURE = 1.5, 30.0


@dataclass(frozen=True)
class BlowUp:
    """Figure 6: the fast field on a grid of (lambda_1, lambda_2), and modes as (lambda_1, lambda_2, is stable)."""

    law: str
    axis: list[float]
    rate: list[list[list[float]]]
    modes: list[tuple[float, float, bool]]


@dataclass(frozen=True)
class SlowEvent:
    """What happens to two blocks on the belt: a row of the table `hidden`; `block` is -1 where it is none's alone."""

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
    t: list[float]
    lam: list[list[float]]
    events: list[SlowEvent]


@dataclass(frozen=True)
class Branches:
    """Sticking modes while both blocks drift with the belt, nodes and saddles: (t, lambda_1, lambda_2, is stable)."""

    points: list[tuple[float, float, float, bool]]


@dataclass(frozen=True)
class Future:
    """One way on from a state: what the block does at once, then z and z' in time, and events (t, kind)."""

    begins: str
    t: list[float]
    z: list[float]
    w: list[float]
    events: list[tuple[float, str]]

    def times(self, kind: str) -> list[float]:
        return [t for t, one in self.events if one == kind]


@dataclass(frozen=True)
class Undetermined:
    """The block of figure 1 under static friction above kinetic, on the belt at z.

    `open` are the intervals of z with more than one forward solution, `n_coulomb` how many the state has under
    Coulomb's law. `resistance` is s on `axis`, `target` the s that holds the block, `modes` (lambda, is stable).
    """

    ratio: float
    v: float
    z: float
    open: list[list[float]]
    n_coulomb: int
    axis: list[float]
    resistance: list[float]
    target: float
    modes: list[tuple[float, bool]]
    futures: list[Future]


def blow_ups() -> list[BlowUp]:
    """The fast system under both laws at F_1 = -F_2 = `FORCE`, mu = 1, the factors of the sigmoid kept."""
    axis = np.linspace(-1.0, 1.0, 41)
    force = np.array([FORCE, -FORCE])
    laws: dict[str, SwitchingLaw] = {"Coulomb": Coulomb(), "modified": Modified()}
    found = []
    for name, law in laws.items():
        blow_up = Blowup(law, np.ones(2))
        rate = np.array([[blow_up.rhs(force, np.array([x, y])) for x in axis] for y in axis])
        modes = [(float(m.lam[0]), float(m.lam[1]), m.is_stable) for m in blow_up.sticking_modes(force)]
        found.append(BlowUp(name, axis.tolist(), np.moveaxis(rate, 2, 0).tolist(), modes))
    return found


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
    rest = np.concatenate([system.rest_state(slip), np.zeros(2)])
    start = rest + expm(-BEFORE * system.slip_matrix()) @ (at_belt - rest)
    run = run_with_law(system, law, start[:2], start[2:], BEFORE + AFTER)
    blow_up = Blowup(law, system.friction)
    held_by = [(segment, *_mode_of(system, blow_up, segment)) for segment in run.segments if not segment.slip.any()]
    times = [float(t) - BEFORE for _, when, _ in held_by for t in when]
    lam = [one for _, _, path in held_by for one in path]
    events = [
        SlowEvent(side, _tidy(e.t - BEFORE), e.kind, e.cause, e.block, *_tidy(e.lam_before), *_tidy(e.lam))
        for e in run.events
    ]
    return SlowRun(side, times, np.array(lam).T.tolist(), events)


def _tidy(value: Any) -> Any:
    """Plain numbers without what lies far below their error, so that zero is zero."""
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


def branches(t_end: float) -> Branches:
    """Every sticking mode of the modified law at times from 0 to `t_end`, dense about the start."""
    system = pair(1)
    blow_up, start = Blowup(Modified(), system.friction), held(system)
    times = np.concatenate([np.linspace(0.0, 0.03 * t_end, 120), np.linspace(0.03 * t_end, t_end, 100)[1:]])
    return Branches(
        [
            (float(t), float(mode.lam[0]), float(mode.lam[1]), mode.is_stable)
            for t in times
            for mode in blow_up.sticking_modes(system.holding_force(start + V * t))
            if mode.kind != "degenerate"
        ]
    )


def undetermined() -> Undetermined:
    """Look for a state on the belt with more than one forward solution, and follow every one of them.

    The friction law is odd, so there are such states at both ends of the stick interval; the one in the middle of
    those at the exit is taken.
    """
    v = -ONE[3]
    system, law = single(v), StaticAboveKinetic(RATIO)
    found = _open(system, law, np.linspace(-2.5, 2.5, 101))
    z = 0.5 * sum(found[0])
    blow_up = Blowup(law, system.friction)
    force = system.holding_force(z)
    axis = np.linspace(-1.0, 1.0, 201)
    futures = [_future(system, law, z, mode) for mode in continuations(system, law, z, v)]
    return Undetermined(
        RATIO, v, z, found, len(continuations(system, Coulomb(), z, v)), axis.tolist(),
        [float(law.resistance(np.array([lam]))[0]) for lam in axis], float(-force[0] / system.friction[0]),
        [(float(mode.lam[0]), mode.is_stable) for mode in blow_up.sticking_modes(force)], futures,
    )  # fmt: skip


def _open(system: sim.System, law: SwitchingLaw, grid: Floats) -> list[list[float]]:
    """Intervals of z, the block on the belt, in which the state has more than one forward solution."""

    def is_open(z: float) -> bool:
        return len(continuations(system, law, z, system.belt_speed)) > 1

    ends = []
    for low, high in pairwise(grid):
        if is_open(low) != (is_at_high := is_open(high)):
            for _ in range(40):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if is_open(middle) == is_at_high else (middle, high)
            ends.append(float(high))
    return [list(pair) for pair in zip(ends[::2], ends[1::2], strict=True)]


def _future(system: sim.System, law: SwitchingLaw, z: float, mode: Mode) -> Future:
    """The run that begins in one of the modes."""
    run = run_with_law(system, law, z, system.belt_speed, FUTURE, entry=mode.lam)
    side = int(mode.slip[0])
    begins = "sticks on" if side == 0 else f"slips at once to the {'right' if side > 0 else 'left'}"
    t, x = _sampled(system, run)
    return Future(begins, t.tolist(), x[:, 0].tolist(), x[:, 1].tolist(), [(e.t, e.kind) for e in run.events])


def _sampled(system: sim.System, run: LawRun) -> tuple[Floats, Floats]:
    """Times and (z, w) of one block: in closed form, as a block either rides the belt or is a linear oscillator."""
    step = 0.05
    times, states = [], []
    for segment in run.segments:
        t = np.append(np.arange(segment.t_start, segment.t_end, step), segment.t_end)
        since = t - segment.t_start
        start = np.concatenate([segment.z, segment.w])
        if segment.slip[0] == 0:
            x = start + np.outer(since, [system.belt_speed, 0.0])
        else:
            rest = np.concatenate([system.rest_state(segment.slip), np.zeros(1)])
            x = rest + expm(since[:, None, None] * system.slip_matrix()) @ (start - rest)
        times.append(t)
        states.append(x)
    return np.concatenate(times), np.concatenate(states)


# ---------------------------------------------------------------------------------------------- drawings


def fast_flows(blow_ups: Sequence[BlowUp]) -> Figure:
    """The fast flow in the box of (lambda_1, lambda_2), stable modes filled, others open."""
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(blow_ups), 3.7, sharey=True)
        for letter, ax, one in zip("ab", axes[0], blow_ups, strict=True):
            axis = np.asarray(one.axis)
            ax.streamplot(
                axis, axis, *np.array(one.rate), color=BLUE, density=0.7, linewidth=0.8,
                broken_streamlines=False,
            )  # fmt: skip
            for x, y, is_stable in one.modes:
                ax.plot([x], [y], "o", color=ORANGE if is_stable else "white", markeredgecolor="black",
                        markersize=8, zorder=5)  # fmt: skip
            ax.set(title=f"({letter}) {one.law} law", xlabel="λ₁", xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
            ax.set_xticks(ticks := [-1.0, -0.5, 0.0, 0.5, 1.0])
            ax.set_yticks(ticks)
            ax.spines[["top", "right"]].set_visible(True)
        axes[0, 0].set_ylabel("λ₂")
        handles = [
            axes[0, 0].plot([], [], "o", color=colour, markeredgecolor="black", markersize=8, label=label)[0]
            for colour, label in ((ORANGE, "sticking mode, stable"), ("white", "sticking mode, saddle"))
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def slow_modes(branches: Branches, runs: Sequence[SlowRun]) -> Figure:
    """lambda_2 of the sticking modes in slow time: about the saddle-node, and up to the exit."""
    points = branches.points
    t_end = max(run.t[-1] for run in runs)
    lost = max((t for t, *_, is_stable in points if not is_stable), default=0.0)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 2, 3.0, sharey=True)
        kinds = ((True, "o", 3.5, "mode, stable"), (False, "x", 3.0, "mode, saddle"))
        panels = (("(c) at first", 2.0 * lost or t_end), ("(d) to the exit", 1.05 * t_end))
        for ax, (title, end) in zip(axes[0], panels, strict=True):
            for is_wanted, marker, size, label in kinds:
                seen = [(t, y) for t, _, y, is_stable in points if is_stable == is_wanted and t <= end]
                ax.plot(*np.array(seen).reshape(-1, 2).T, marker, color=GREY, markersize=size, alpha=0.4, label=label)
            for k, run in enumerate(runs):
                label = "from λ = " + ("(1, 1)" if run.side > 0 else "(−1, −1)")
                ax.plot(
                    run.t, run.lam[1], color=CYCLE[k], linestyle="-" if k == 0 else "--", linewidth=2.2, label=label
                )
            ax.axhline(1.0, color="black", linewidth=0.8)
            ax.set(title=title, xlabel="time t", xlim=(-0.03 * end, end))
        axes[0, 0].set_ylabel("λ₂")
        axes[0, 1].annotate("face λ₂ = 1: exit", (0.0, 1.0), xytext=(4, -10), textcoords="offset points", fontsize=7)
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def open_futures(found: Undetermined) -> Figure:
    """A friction law that is not monotone: where it balances a force, and the runs that begin in one state."""
    with matplotlib.rc_context(STYLE):
        figure = blank(2.9)
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.7])
        left.plot(found.axis, found.resistance, color=BLUE, label="s(λ)")
        left.axhline(found.target, color=GREY, linestyle="--", linewidth=0.9, label="−F/μ")
        for lam, is_stable in found.modes:
            left.plot([lam], [found.target], "o", color=ORANGE if is_stable else "white", markeredgecolor="black",
                      markersize=7, zorder=5)  # fmt: skip
        left.set(title="(e) static above kinetic", xlabel="λ", ylabel="friction / μ, s(λ)", xlim=(-1, 1))
        left.legend(loc="lower right")
        for k, one in enumerate(found.futures):
            right.plot(
                one.t,
                np.asarray(one.w) - found.v,
                color=CYCLE[k],
                linestyle=("-", "--", "-.")[k],
                linewidth=1.6,
                label=one.begins,
            )
        right.set(title="(f) runs from one state", xlabel="time t", ylabel="relative velocity z' − v")
        right.set_ylim(top=1.35 * right.get_ylim()[1])
        right.legend(loc="upper right", ncols=2)
    return figure
