"""What the text claims beside its figures, counted: uniqueness, single blocks, survival, the certificate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from stickslip import sim
from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.style import BLUE, GREEN, ORANGE, STYLE, subplots
from stickslip.pipeline import parse_scene, run_scene
from stickslip.pipeline.query import members as read_members
from stickslip.pipeline.query import series as read_series
from stickslip.workflows.charts.peers import Floats, ensemble, seed_of
from stickslip.workflows.paper.figures_1_2 import V, corner, pair
from stickslip.workflows.paper.figures_3_to_5 import Fate, fate
from stickslip.workflows.paper.systems import PaperSystems

#: Forward uniqueness: how far apart two runs start, how long they are followed, from which directions.
APART, FOLLOWED, DIRECTIONS = 1e-6, 10.0, 16
#: The level of the intervals.
CONFIDENCE = 0.95
#: What the seeds of the random single blocks are for, beside the words in `stickslip.pipeline.design`.
_ONE_BLOCK = 1000


@dataclass(frozen=True)
class Pair:
    """Two runs that start `APART` apart around a double exit: the most they are apart after that."""

    direction: float
    n_events: int
    apart: float


@dataclass(frozen=True)
class OneBlock:
    """Random single blocks: how many ever exit from stick, and how many stick again after it."""

    n_blocks: int
    n_exits: int
    n_again: int


@dataclass(frozen=True)
class Survival:
    """What became of the draws at one n: a row of the table `survival`.

    `stable` counts the draws whose all-slip state is linearly stable, `stable_silent` and `stable_moving` those of
    them that are silent without a certificate or still move.
    """

    n: int
    n_draws: int
    certified: int
    silent: int
    sustained: int
    diverged: int
    failed: int
    stable: int
    stable_silent: int
    stable_moving: int

    @property
    def moving(self) -> int:
        return self.sustained + self.diverged


@dataclass(frozen=True)
class Certified:
    """One run of which a certificate was asked: a row of the table `certificate`.

    `t_certified`, and `n_after`, the events of the certified run continued to the end, are null if it got none.
    """

    n: int
    matrix: int
    outcome: str
    t_last: float | None
    t_certified: float | None
    n_after: int | None

    @property
    def lateness(self) -> float | None:
        """From the last event to the certificate."""
        return None if self.t_certified is None or self.t_last is None else self.t_certified - self.t_last


def around_a_double_exit() -> list[Pair]:
    """Around the double exit {+,+}: two runs that start `APART` apart, in directions that exit in either order."""
    system, belt = pair(1), np.full(2, V)
    start = corner(system, (1, 1)) - 0.5 * belt
    times = np.linspace(0.0, FOLLOWED, 201)

    def run(z0: Floats) -> sim.Run:
        return sim.simulate(system, z0, belt, FOLLOWED, t_eval=times, stop_early=False)

    middle, found = run(start).samples, []
    for k in range(DIRECTIONS):
        angle = 2.0 * np.pi * k / DIRECTIONS
        moved = run(start + APART * np.array([np.cos(angle), np.sin(angle)]))
        apart = ((moved.samples.z - middle.z) ** 2 + (moved.samples.w - middle.w) ** 2).sum(axis=1)
        found.append(Pair(angle, len(moved.events), float(np.sqrt(apart.max()))))
    return found


def one_block(scene: PaperSystems) -> OneBlock:
    """Single blocks with random constants and starts: does one ever stick again after its exit?"""
    n_exits = n_again = 0
    for block in range(scene.blocks):
        rng = np.random.default_rng(seed_of(scene.seed, _ONE_BLOCK, block))
        rho, kappa, mu = rng.uniform(0.05, 4.0), rng.uniform(0.05, 2.0), rng.uniform(0.2, 2.0)
        v = rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 1.0)
        reach = mu / kappa
        events = sim.simulate(
            sim.System([[kappa]], rho, mu, v), rng.uniform(-3.0, 3.0) * reach, rng.uniform(-2.0, 2.0),
            10.0 * (reach / abs(v) + 1.0 / rho + 10.0), stop_early=False,
        ).events  # fmt: skip
        exits = events.t[events.previous_mode == 0]
        n_exits += len(exits) > 0
        n_again += len(exits) > 0 and bool((events.t[events.mode == 0] > exits[0]).any())
    return OneBlock(scene.blocks, n_exits, n_again)


def survival(scene: PaperSystems) -> list[Survival]:
    """The ensemble of the survival curve, by the pipeline; its matrices' all-slip systems, here."""
    source = survival_source(scene)
    with TemporaryDirectory() as directory:
        out = Path(directory) / "ensemble"
        run_scene(parse_scene(source), source, out, scene.workers)
        rows = read_members(out, ["member_id", "n", "matrix", "outcome"])
        n_stick = {member_id: (t, values) for member_id, t, values in read_series(out)}
    fates: dict[tuple[int, int], Fate] = {}
    for member_id, n, matrix, outcome in rows.itertuples(index=False):
        t, values = n_stick.get(member_id, (np.zeros(1), np.zeros(1)))  # one that failed has none
        fates[int(n), int(matrix)] = fate(outcome, t, values, scene.survival_t_end)
    return [_fates_at(scene, n, [fates[n, k] for k in range(scene.survival_matrices)]) for n in scene.survival_n]


def _fates_at(scene: PaperSystems, n: int, fates: list[Fate]) -> Survival:
    stable = [is_stable(scene.system(n, matrix)) for matrix in range(len(fates))]
    of_stable = Counter(one for one, is_one in zip(fates, stable, strict=True) if is_one)
    counts = Counter(fates)
    return Survival(
        n, len(fates), certified=counts["certified"], silent=counts["silent"], sustained=counts["sustained"],
        diverged=counts["diverged"], failed=counts["failed"], stable=sum(stable), stable_silent=of_stable["silent"],
        stable_moving=of_stable["sustained"] + of_stable["diverged"],
    )  # fmt: skip


def is_stable(system: sim.System) -> bool:
    """Whether the all-slip system is linearly stable: every eigenvalue decays."""
    return bool(np.linalg.eigvals(system.slip_matrix()).real.max() < 0.0)


def survival_source(scene: PaperSystems) -> bytes:
    """The scene file of the survival curve's ensemble; it gives no tolerances: they are picked."""
    run = {"t_end": scene.survival_t_end, "matrices": scene.survival_matrices, "seed": scene.seed}
    return ensemble({"n": list(scene.survival_n)}, run, {"name": "coulomb"})


def certified(scene: PaperSystems, n: int, matrix: int) -> Certified:
    """Run a draw until it is certified, and the certified state on, with nothing that could end that run early."""
    system, t_end = scene.system(n, matrix), scene.certificate_t_end
    run = scene.run(system, t_end, "coulomb")
    t_last = float(run.events.t[-1]) if len(run.events) else None
    if run.outcome != "collapsed":
        return Certified(n, matrix, run.outcome, t_last, None, None)
    assert run.t_collapse is not None
    there = scene.run(system, run.t_collapse, "coulomb")
    after = sim.simulate(system, there.z, there.w, t_end, t_start=run.t_collapse, stop_early=False)
    return Certified(n, matrix, run.outcome, t_last, run.t_collapse, len(after.events))


# ---------------------------------------------------------------------------------------------- what was found


class Share(NamedTuple):
    """A share with its interval."""

    value: float
    low: float
    high: float


def share(found: int, tried: int) -> Share:
    """found / tried with its Wilson interval; tried > 0."""
    return Share(found / tried, *wilson(found, tried, CONFIDENCE))


@dataclass(frozen=True)
class Claim:
    """One claim counted: a row of the table `claims`.

    `found` of `tried` have what the claim says, or, of a claim that something never happens, contradict it;
    null where `value` is measured instead.
    """

    claim: str
    n: int
    tried: int
    found: int | None = None
    low: float | None = None
    high: float | None = None
    value: float | None = None


def claims(uniqueness: Sequence[Pair], blocks: Sequence[OneBlock], fates: Sequence[Survival]) -> Iterator[Claim]:
    """The rows of the table `claims`."""
    if uniqueness:
        worst = max(pair.apart for pair in uniqueness) / APART
        yield Claim("forward uniqueness: distance over distance at start", 2, len(uniqueness), value=worst)
    for one in blocks:
        if one.n_exits:
            _, low, high = share(one.n_again, one.n_exits)
            yield Claim("one block sticks again after its exit", 1, one.n_exits, one.n_again, low, high)
    for name, count in (("all-slip state linearly stable", "stable"), ("diverged", "diverged")):
        for row in fates:
            _, low, high = share(getattr(row, count), row.n_draws)
            yield Claim(name, row.n, row.n_draws, getattr(row, count), low, high)


def lateness(certificate: Sequence[Certified]) -> list[dict[str, Any]]:
    """The certificate by n, and over all n (null): how many runs got it, with an event after it, how late it came."""
    rows = []
    for n in (*dict.fromkeys(row.n for row in certificate), None):
        some = [row for row in certificate if n in (None, row.n)]
        late = [row.lateness for row in some if row.lateness is not None]
        rows.append({
            "n": n, "runs": len(some), "certified": sum(row.t_certified is not None for row in some),
            "alarms": sum(bool(row.n_after) for row in some), "median": median(late) if late else None,
            "most": max(late, default=None),
        })  # fmt: skip
    return rows


def survival_curve(rows: Sequence[Survival], t_end: float) -> Figure:
    """Share of draws still moving at t_end, of those whose all-slip state is stable, and of those diverged."""
    curves = (
        ("moving", BLUE, "o", "-", f"still moving at t = {t_end:g}"),
        ("stable", GREEN, "s", "--", "all-slip state linearly stable"),
        ("diverged", ORANGE, "^", ":", "diverged"),
    )
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, 1, 2.9)
        ax = axes[0, 0]
        for k, (name, colour, marker, dash, label) in enumerate(curves):
            value, low, high = np.array([share(getattr(row, name), row.n_draws) for row in rows]).T
            n = np.array([row.n for row in rows]) + 2.0 * (k - 1)  # side by side, so that bars can be seen
            ax.errorbar(n, value, yerr=np.maximum([value - low, high - value], 0.0), color=colour, marker=marker,
                        linestyle=dash, markersize=4, elinewidth=0.9, capsize=2, label=label)  # fmt: skip
        ax.set(xlabel="number of blocks n", ylabel="share of draws", ylim=(-0.03, 1.03))
        figure.legend(loc="outside lower center", ncols=3)
    return figure
