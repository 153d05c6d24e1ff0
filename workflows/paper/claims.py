"""What the text claims beside its figures, counted: uniqueness, single blocks, survival, the certificate."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from stickslip import sim
from stickslip.pipeline import parse_scene, run_scene
from stickslip.pipeline.query import members as read_members
from stickslip.pipeline.query import series as read_series
from stickslip.workflows.charts.peers import W0, Z0
from stickslip.workflows.paper.blocks import V, corner, pair, sampled
from stickslip.workflows.paper.runs import Fate, fate
from stickslip.workflows.paper.scene import COUPLING, PaperScene

#: Forward uniqueness: how far apart two runs start, how long they are followed, from which directions.
APART, FOLLOWED, DIRECTIONS = 1e-6, 10.0, 16
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


def around_a_double_exit() -> list[Pair]:
    """Around the double exit {+,+}: two runs that start `APART` apart, in directions that exit in either order."""
    system = pair(1)
    belt = np.full(2, V)
    start = corner(system, (1, 1)) - 0.5 * belt
    times = np.linspace(0.0, FOLLOWED, 201)
    z, w = sampled(system, start, belt, times)
    found = []
    for k in range(DIRECTIONS):
        angle = 2.0 * np.pi * k / DIRECTIONS
        moved = start + APART * np.array([np.cos(angle), np.sin(angle)])
        other_z, other_w = sampled(system, moved, belt, times)
        apart = np.sqrt(((other_z - z) ** 2).sum(axis=1) + ((other_w - w) ** 2).sum(axis=1))
        found.append(Pair(angle, len(sim.simulate(system, moved, belt, FOLLOWED).events), float(apart.max())))
    return found


def one_block(scene: PaperScene) -> OneBlock:
    """Single blocks with random constants and starts: does one ever stick again after its exit?"""
    n_exits = n_again = 0
    for block in range(scene.blocks):
        rng = np.random.default_rng(scene.key(_ONE_BLOCK, block))
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


def survival(scene: PaperScene) -> list[Survival]:
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


def _fates_at(scene: PaperScene, n: int, fates: list[Fate]) -> Survival:
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


def survival_source(scene: PaperScene) -> bytes:
    """The scene file of the survival curve's ensemble; it gives no tolerances: they are picked."""
    return f"""[system]
coupling = "{COUPLING}"
n = {list(scene.survival_n)}
[start]
z = {Z0!r}
w = {W0!r}
[run]
t_end = {scene.survival_t_end!r}
matrices = {scene.survival_matrices}
seed = {scene.seed}
[[engine]]
name = "coulomb"
[analysis]
t_burn = 0.0
dt = 1.0
""".encode()


def certified(scene: PaperScene, n: int, matrix: int) -> Certified:
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
