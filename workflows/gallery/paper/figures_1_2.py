"""Figures 1 and 2: one block and two under the exact law, sampled between events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

from stickslip import sim
from stickslip.analysis.style import BLUE, CYCLE, GREY, ORANGE, PURPLE, legend, panel
from stickslip.workflows.gallery.charts.peers import Floats
from stickslip.workflows.gallery.theory import folds
from stickslip.workflows.gallery.theory.blowup import continuations
from stickslip.workflows.gallery.theory.laws import Coulomb, StaticAboveKinetic

#: Figure 1, of which the paper gives no constants: rho, kappa, mu, |v|.
ONE = (0.1, 1.0, 1.0, 0.5)
#: Figure 2: rho, kappa_1, kappa_2, kappa_12, mu, v as the caption has them.
RHO, KAPPA_1, KAPPA_2, KAPPA_12, MU, V = 0.1, 1.1, 1.6, 0.5, 1.0, -1.0
#: Forward uniqueness: how far apart two runs start, how long they are followed, from which directions.
APART, FOLLOWED, DIRECTIONS = 1e-6, 10.0, 16
#: Static over kinetic friction of a law that loses monotonicity.
RATIO = 1.5


@dataclass(frozen=True)
class Portrait:
    """Figure 1: one block's (z, w) for one v; paths are (z, w, whether it leaves the exit point)."""

    v: float
    stick: list[float]
    exit: float
    paths: list[tuple[Floats, Floats, bool]]


@dataclass(frozen=True)
class Corner:
    """Where both blocks are at the edge of sticking: a row of the table `corners`; folds are visible or invisible."""

    sign: int
    lambda_1: int
    lambda_2: int
    z_1: float
    z_2: float
    fold_1: str
    fold_2: str

    @property
    def label(self) -> str:
        """The signs of lambda."""
        return "".join("+" if side > 0 else "-" for side in (self.lambda_1, self.lambda_2))

    @property
    def kind(self) -> str:
        return ("double entry", "mixed", "double exit")[(self.fold_1, self.fold_2).count("visible")]

    @property
    def misprint(self) -> float:
        """How far eq. (8) as printed is off it."""
        return float(np.abs(printed_corner(self.lambda_1, self.lambda_2) - (self.z_1, self.z_2)).max())


@dataclass(frozen=True)
class Parallelogram:
    """Figure 2 under one sign: corners, in order around, and the runs, sampled, of the cases a, b and c."""

    sign: int
    corners: list[Corner]
    runs: dict[str, sim.Run]


@dataclass(frozen=True)
class Uniqueness:
    """Around the double exit {+,+}: the growth of a small distance, and the number of futures of a state.

    `apart` are the greatest distances that runs reach which start `APART` from the one through the corner, a
    direction each, `n_events` their events; `coulomb` and `static` count the forward solutions of one block that
    sticks where |F| is between mu and `RATIO` mu.
    """

    apart: list[float]
    n_events: list[int]
    coulomb: int
    static: int


_LOOKS = {"double exit": ("o", ORANGE), "mixed": ("D", "white"), "double entry": ("s", BLUE)}


def single(v: float) -> sim.System:
    """The block of figure 1."""
    rho, kappa, mu, _ = ONE
    return sim.System([[kappa]], rho, mu, v)


def portrait(v: float) -> Portrait:
    """Paths from outside, and the one from the exit point."""
    system = single(v)
    stick = folds.stick_interval(system)
    leaves = stick.exit
    assert leaves is not None  # the belt moves
    turn = -np.sign(v)
    starts = [(turn * z0, turn * w0) for z0, w0 in ((3.0, 1.0), (-3.0, -0.6), (-1.6, 1.2), (2.2, -1.0))]
    times = np.linspace(0.0, 9.0, 181)
    paths = []
    for z0, w0 in [*starts, (leaves, v)]:
        path = sim.simulate(system, z0, w0, times[-1], t_eval=times, stop_early=False).samples
        paths.append((path.z[:, 0], path.w[:, 0], (z0, w0) == (leaves, v)))
    return Portrait(v, [stick.low, stick.high], leaves, paths)


def pair(sign: Literal[1, -1]) -> sim.System:
    """The system of figure 2; `sign` +1: the coupling of eq. (6) as printed, -1: the one that section 3 uses."""
    return folds.two_blocks(KAPPA_1, KAPPA_2, KAPPA_12, RHO, MU, V, sign)


def corner(system: sim.System, sides: tuple[int, int]) -> Floats:
    """Where both blocks are at the edge of sticking, lambda = `sides`; shape (2,)."""
    (match,) = (corner for corner in folds.corners(system) if corner.sides == sides)
    return match.point


def parallelogram(sign: Literal[1, -1]) -> Parallelogram:
    """Corners and the paths (a), (b), (c) under one sign of the coupling."""
    system = pair(sign)
    corners: list[Corner] = []
    for vertex in folds.parallelogram(system):
        (a, b), (x, y), (fold_1, fold_2) = vertex.sides, vertex.point, vertex.visibility
        corners.append(Corner(sign, a, b, float(x), float(y), str(fold_1), str(fold_2)))
    lead = 0.5  # time on the belt before the corner
    belt = np.full(2, V)
    starts = {"a": np.zeros(2), "b": corner(system, (1, 1)) - lead * belt, "c": corner(system, (1, -1))}
    times = np.linspace(0.0, 3.0, 301)
    runs = {
        case: sim.simulate(system, z0, belt, times[-1], t_eval=times, stop_early=False) for case, z0 in starts.items()
    }
    return Parallelogram(sign, corners, runs)


def uniqueness() -> Uniqueness:
    """Runs from all sides of the double exit, which exit in either order, and the futures of one block."""
    system, belt = pair(1), np.full(2, V)
    start = corner(system, (1, 1)) - 0.5 * belt
    times = np.linspace(0.0, FOLLOWED, 201)

    def run(z0: Floats) -> sim.Run:
        return sim.simulate(system, z0, belt, FOLLOWED, t_eval=times, stop_early=False)

    middle, distances, n_events = run(start).samples, [], []
    for angle in 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        neighbour = run(start + APART * np.array([np.cos(angle), np.sin(angle)]))
        distance = ((neighbour.samples.z - middle.z) ** 2 + (neighbour.samples.w - middle.w) ** 2).sum(axis=1)
        distances.append(float(np.sqrt(distance.max())))
        n_events.append(len(neighbour.events))
    rho, kappa, mu, speed = ONE
    block, z = single(-speed), (rho * speed - 0.5 * (1.0 + RATIO) * mu) / kappa
    futures = (len(continuations(block, law, z, -speed)) for law in (Coulomb(), StaticAboveKinetic(RATIO)))
    return Uniqueness(distances, n_events, *futures)


def printed_corner(lambda_1: int, lambda_2: int) -> np.ndarray:
    """Eq. (8) as the paper prints it, shape (2,)."""
    p, q = RHO * V + lambda_1 * MU, RHO * V + lambda_2 * MU
    k1, k2, k12 = KAPPA_1, KAPPA_2, KAPPA_12
    k = k1 * k2 - k12 * (k1 + k2)
    return -p / k * np.array([k12 - k1, k12]) - q / k * np.array([k12, k12 - k2])


# ---------------------------------------------------------------------------------------------- drawings

#: In the plane of displacements paths are drawn for so long: how they leave, not where they end.
_LEAVING = 1.5
#: Line styles beside the colours, so that grey print tells curves apart.
_DASHES = ("-", "--", "-.")


@panel()
def phase_portrait(ax: Axes, plane: Portrait) -> None:
    """Figure 1: z against z'; the stick interval thick, the exit point E marked, its path bold."""
    ax.axhline(plane.v, color=GREY, linestyle="--", linewidth=0.9, label="z' = v, crossed")
    for z, w, is_exit in plane.paths:
        colour, width, label = (ORANGE, 2.4, "path from E") if is_exit else (BLUE, 0.9, "_")
        ax.plot(z, w, color=colour, linewidth=width, zorder=2 + is_exit, label=label)
        k = len(z) // 10  # where an arrow shows the direction
        ax.annotate("", (z[k + 1], w[k + 1]), (z[k], w[k]), arrowprops={"arrowstyle": "-|>", "color": colour})
    ax.plot(
        plane.stick, [plane.v, plane.v], color="black", linewidth=3.0, solid_capstyle="butt", zorder=4, label="sticks"
    )
    ax.plot([plane.exit], [plane.v], "o", color=ORANGE, markeredgecolor="black", markersize=6, zorder=5)
    place = (0, 8 if plane.v > 0 else -14)
    ax.annotate("E", (plane.exit, plane.v), place, textcoords="offset points", ha="center", fontweight="bold")
    title = f"({'i' if plane.v < 0 else 'ii'}) v = {plane.v:g}".replace("-", "−")
    ax.set(title=title, xlabel="displacement z", ylabel="velocity z'")
    ax.legend(loc="upper right" if plane.v < 0 else "lower left", fontsize=7)


@panel(nrows=3, sharex=True)
def velocities(axes: Sequence[Axes], plane: Parallelogram) -> None:
    """Figure 2: z' - v of both blocks in the cases (a), (b), (c); dotted: exits."""
    for ax, (case, run) in zip(axes, plane.runs.items(), strict=True):
        for block, w in enumerate(run.samples.w.T):
            ax.plot(run.samples.t, w - V, _DASHES[block], color=CYCLE[block], label=f"block {block + 1}")
        for t, block, mode in zip(run.events.t, run.events.block, run.events.mode, strict=True):
            ax.axvline(t, color=CYCLE[block], linestyle=":" if mode else "-", linewidth=0.8)
        ax.set_title(f"({case}) {_sign(plane)}")
    axes[0].legend(fontsize=7, loc="upper left")
    axes[-1].set_xlabel("time t")
    axes[0].figure.supylabel("relative velocity z' − v", fontsize=9)


@panel()
def region(ax: Axes, plane: Parallelogram) -> None:
    """Figure 2: (z_1, z_2) with folds, corners and the three cases.

    Solid edges are visible folds (exits), dashed ones invisible (entries).
    """
    z = np.array([(corner.z_1, corner.z_2) for corner in plane.corners])
    span = np.ptp(z, axis=0)
    ax.fill(*z.T, color=GREY, alpha=0.15, linewidth=0)
    for k, corner in enumerate(plane.corners):
        following = (k + 1) % len(plane.corners)
        # of two neighbours one lambda is the same: that block's fold is the edge between them
        block = 0 if corner.lambda_1 == plane.corners[following].lambda_1 else 1
        leaves = (corner.label[block] == "+") == (V < 0)
        dash, label = ("-", "visible fold") if leaves else ("--", "invisible fold")
        ax.plot(*z[[k, following]].T, dash, color="black", linewidth=1.4, label=label)
        along = (z[following] - z[k]) / span
        outward = np.array([along[1], -along[0]]) / np.hypot(*along)  # corners run counter-clockwise
        x, y = z[[k, following]].mean(axis=0) + 0.06 * outward * span
        slope = np.degrees(np.arctan2(z[following, 1] - z[k, 1], z[following, 0] - z[k, 0]))
        ax.text(x, y, f"fold of {block + 1}", fontsize=7, ha="center", va="center", rotation_mode="anchor",
                rotation=(slope + 90) % 180 - 90, transform_rotates_text=True)  # fmt: skip
    for corner in plane.corners:
        marker, colour = _LOOKS[corner.kind]
        x, y = corner.z_1, corner.z_2
        ax.plot([x], [y], marker, color=colour, markeredgecolor="black", markersize=7, linestyle="none", zorder=5,
                label=corner.kind)  # fmt: skip
        right = x > z[:, 0].mean()
        ax.annotate(f"{{{','.join(corner.label)}}}".replace("-", "−"), (x, y), xytext=(9 if right else -9, 5),
                    textcoords="offset points", ha="left" if right else "right", va="bottom", fontsize=8)  # fmt: skip
    for (case, run), colour, dash in zip(plane.runs.items(), (BLUE, ORANGE, PURPLE), _DASHES, strict=True):
        path = run.samples.z[run.samples.t <= _LEAVING]
        ax.plot(*path.T, dash, color=colour, linewidth=1.8, zorder=4, label=f"path ({case})")
        ax.plot(*path[0], ".", color=colour, zorder=6)
    low, high = z.min(axis=0), z.max(axis=0)
    margin = 0.3 * (high - low)
    reading = "eq. (6)" if plane.sign > 0 else "section 3"
    ends = dict(zip(("xlim", "ylim"), np.transpose([low - margin, high + margin]), strict=True))
    ax.set(title=f"{_sign(plane)}, {reading}", xlabel="displacement z₁", ylabel="z₂", **ends)
    start = low - margin + np.array([0.66, 0.96]) * (span + 2 * margin)
    drift = start + 0.2 * float(span.min()) * np.sign(V)
    ax.annotate("", drift, start, arrowprops={"arrowstyle": "-|>", "color": GREY})
    ax.annotate("drift (v, v)", start, xytext=(4, 0), textcoords="offset points", fontsize=7, color=GREY, va="center")
    legend([ax], 3, fontsize=7)


def _sign(plane: Parallelogram) -> str:
    return f"s = {plane.sign:+d}".replace("-", "−")
