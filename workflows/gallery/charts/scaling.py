"""The chart of cost and size: a run of either engine, and an ensemble.

Systems of different n are alike if the force that couples a block is: of n - 1 random springs it goes as
kappa sqrt(n), so kappa goes as 1 / sqrt(n), and events per block and unit of time stay what they are. Runs start
behind the burn-in, where all blocks still do the same at once. Cost is wall time, and products (`cost`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import scipy.sparse
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from pydantic import Field

from stickslip import sim
from stickslip.analysis.style import CYCLE, GREY, WIDTH, legend, panel
from stickslip.pipeline import Scene, run_ensemble
from stickslip.pipeline.ensemble.member import MATRIX
from stickslip.pipeline.running.cluster import local
from stickslip.pipeline.scene.toml import BlockNumbers, Blocks, Count, Positive
from stickslip.workflows.gallery.charts import ChartScene, Say, Shown
from stickslip.workflows.gallery.charts.cost import Product, Timing, timed
from stickslip.workflows.gallery.charts.peers import W0, Z0, random_system, seed_of
from stickslip.workflows.gallery.charts.runner import frames

#: The n at which the stiffnesses have the scale `kappa` of the scene: the paper's.
KAPPA_AT = 200

Tolerance = Annotated[float, Field(gt=1e-16, lt=1e-2)]
System = Literal["random", "chain"]
Engine = Literal["coulomb", "sigmoid"]

#: What is measured together over n, and what it is called.
GROUPS: dict[tuple[System, Engine], str] = {
    ("random", "coulomb"): "Random systems, exact engine",
    ("chain", "coulomb"): "Chains, exact engine",
    ("random", "sigmoid"): "Random systems, sigmoid engine",
}


class ScalingScene(ChartScene):
    """A scene with ``chart = "scaling"``; dimensionless."""

    libraries = ("scipy", "dask")

    chart: Literal["scaling"] = Field(description="kind of the chart", examples=["scaling"])
    title: str = Field(default="Cost and size", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks of the random systems", examples=[[100, 200, 500]])
    kappa: Positive = Field(default=0.2, description="scale of the stiffnesses at n = 200")
    chain_n: BlockNumbers = Field(description="number of blocks of the chains", examples=[[100, 1000, 10000]])
    chain_kappa: Positive = Field(default=1.5, description="scale of the couplings to the neighbours in a chain")
    tol: Tolerance = Field(default=1e-10, description="tolerance of the exact engine")
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(default=0.03, description="width of the sigmoid")
    rtol: Tolerance = Field(default=1e-6, description="tolerance of the sigmoid engine, relative and absolute alike")
    t_burn: Positive = Field(default=5.0, description="time before which nothing is measured")
    t_run: Positive = Field(default=20.0, description="length of each run")
    repeats: Count = Field(default=5, description="number of runs of each")
    ensemble_n: Blocks = Field(default=200, description="number of blocks of the ensemble")
    ensemble_t_end: Positive = Field(default=1000.0, description="end of the ensemble's runs")
    members: Count = Field(default=40, description="number of members of the ensemble")
    workers: Count = Field(default=2, description="number of local workers")

    def kappa_at(self, n: int) -> float:
        """The scale of the stiffnesses that couples n blocks as strongly as `kappa` couples `KAPPA_AT`."""
        return self.kappa * math.sqrt(KAPPA_AT / n)

    def drawn(self, system: System, n: int) -> sim.System:
        """A random system; at n = `KAPPA_AT` that of an ensemble with this seed. Or blocks in a row, K sparse.

        In a chain each block is coupled to its neighbours alone. K_ii and R are as in the random systems at n =
        `KAPPA_AT`; K_i,i+1 = -K_i+1,i is uniform in [-chain_kappa, chain_kappa]: springs that pull both ways alike
        come to rest.
        """
        if system == "random":
            return random_system(self.seed, n, 0, kappa=self.kappa_at(n))
        rng = np.random.default_rng(seed_of(self.seed, MATRIX, n, 0))
        damping, ground = rng.uniform(3.5, 7.0, n), np.abs(rng.uniform(-self.kappa, self.kappa, n))
        coupling = rng.uniform(-self.chain_kappa, self.chain_kappa, n - 1)
        stiffness = scipy.sparse.diags_array([-coupling, ground, coupling], offsets=[-1, 0, 1], format="csc")
        return sim.System(stiffness, damping)

    def extent(self) -> str:
        return (
            f"{len(self.n)} random systems with either engine and {len(self.chain_n)} chains, and an ensemble of"
            f" {self.members} members with either on {self.workers} workers"
        )

    def measure(self, say: Say) -> Measured:
        """The runs in this process, the ensemble on local workers of its own."""
        warm()
        costs = []
        for system, engine in GROUPS:
            for n in self.n if system == "random" else self.chain_n:
                row = cost(self, system, engine, n)
                costs.append(row)
                say(f"{GROUPS[system, engine]}, n = {n}: {row.reason or f'{row.seconds:.3g} s'}")
        return Measured(costs, throughput(self, say))

    def show(self, measured: Measured) -> Shown:
        """Tables: `costs`, `throughput`."""
        groups = {
            name: [row for row in measured.costs if (row.system, row.engine) == which]
            for which, name in GROUPS.items()
        }
        figures = {"cost_against_size": partial(cost_against_size, groups)}
        return Shown({"groups": groups}, frames(measured, "costs", "throughput"), figures)


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Cost(Timing):
    """Cost of a run of one engine at one n: a row of the table `costs`.

    Numbers are null, with a reason, where the run did not end well; products are null for chains, whose K is never
    dense.
    """

    system: System
    engine: Engine
    n: int
    reason: str | None = None
    n_entries: int | None = None
    t: float | None = None
    n_events: int | None = None
    n_products: int | None = None

    @property
    def event(self) -> float | None:
        """Seconds of an event; None where there was none."""
        return self.seconds / self.n_events if self.seconds is not None and self.n_events else None

    @property
    def unit(self) -> float | None:
        """Seconds of a unit of time."""
        return self.seconds / self.t if self.seconds is not None and self.t else None

    @property
    def over_products(self) -> float | None:
        """The time of the run over that of its products with K, at the price of numpy's; None for chains."""
        if self.product_seconds is None or self.seconds is None or not self.n_products:
            return None
        return self.seconds / (self.n_products * self.product_seconds)


@dataclass(frozen=True)
class Throughput:
    """Members that an engine ran through the pipeline, on workers that have started and loaded.

    A row of the table `throughput`; at the tolerances picked for statistics, which a scene that gives none gets.
    """

    engine: Engine
    n: int
    t_end: float
    n_members: int
    n_workers: int
    n_failed: int
    seconds: float

    @property
    def rate(self) -> float:
        """Members a minute."""
        return 60.0 * self.n_members / self.seconds

    @property
    def each(self) -> float:
        """Seconds of a worker for a member."""
        return self.seconds * self.n_workers / self.n_members


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    costs: list[Cost]
    throughput: list[Throughput]


def warm() -> None:
    """Let an engine compile and load what its first call needs, untimed."""
    system = sim.draw_system("antisymmetric", 3, 0)
    sim.simulate(system, Z0, W0, 0.1)
    sim.simulate(system, Z0, W0, 0.1, engine="sigmoid", eps=0.1)


def cost(scene: ScalingScene, system: System, engine: Engine, n: int) -> Cost:
    """Runs over a fixed time, from the exact engine's state at `t_burn`."""
    row, blocks = Cost(system, engine, n), scene.drawn(system, n)
    settings: dict[str, Any] = {"tol": scene.tol}
    if engine == "sigmoid":
        settings = {"eps": scene.eps, "rtol": scene.rtol, "atol": scene.rtol}
    try:
        start = sim.simulate(blocks, Z0, W0, scene.t_burn, tol=scene.tol, stop_early=False)
        run = partial(
            # to the end: whether a collapse is certain is a question of its own, with a cost of its own
            sim.simulate, blocks, start.z, start.w, scene.t_burn + scene.t_run, t_start=scene.t_burn, engine=engine,
            stop_early=False, **settings,
        )  # fmt: skip
        product = Product(blocks.stiffness) if isinstance(blocks.stiffness, np.ndarray) else None
        result, timing = timed(run, product, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, reason=str(error))
    if result.outcome != "finished":
        return replace(row, reason=result.reason)
    stats = result.stats
    return replace(
        row,
        n_entries=int(blocks.stiffness.size),
        t=scene.t_run,
        n_events=stats.n_events,
        n_products=stats.n_products,
        **asdict(timing),
    )


def throughput(scene: ScalingScene, say: Say) -> list[Throughput]:
    """The ensemble, engine by engine."""
    rows, of_scene = [], (scene.ensemble_n, scene.ensemble_t_end, scene.members, scene.workers)
    engines: dict[Engine, dict[str, float]] = {"coulomb": {}, "sigmoid": {"eps": scene.eps}}
    with local(scene.workers) as client:
        client.run(warm)
        for engine, settings in engines.items():
            with TemporaryDirectory() as directory:
                start = time.perf_counter()
                out = Path(directory) / "ensemble"
                status = run_ensemble(ensemble(scene, engine, **settings), out, scheduler=client)
                seconds = time.perf_counter() - start
            rows.append(Throughput(engine, *of_scene, status.outcomes.get("failed", 0), seconds))
            say(f"ensemble, {engine} engine: {seconds:.3g} s")
    return rows


def ensemble(scene: ScalingScene, engine: Engine, **settings: float) -> Scene:
    """The scene of the ensemble for one engine, of which nothing is analysed."""
    n = scene.ensemble_n
    return Scene(
        system={"coupling": "antisymmetric", "n": n, "kappa": scene.kappa_at(n)},
        start={"z": Z0, "w": W0},
        run={"t_end": scene.ensemble_t_end, "matrices": scene.members, "seed": scene.seed},
        engine=[{"name": engine, **settings}],
        analysis={"t_burn": 0.0, "dt": 1.0},
    )


# ---------------------------------------------------------------------------------------------- the figure


_PANELS = (
    ("time per event (µs)", "event", 1e-6),
    ("time per unit of time (ms)", "unit", 1e-3),
    ("time over that of its products", "over_products", 1.0),
)


@panel(3.1, WIDTH, ncols=3)
def cost_against_size(axes: Sequence[Axes], groups: Mapping[str, Sequence[Cost]]) -> None:
    """Cost against the number of blocks, and over that of the products alone, log-log."""
    for ax, (title, quantity, unit) in zip(axes, _PANELS, strict=True):
        ax.set(title=title, xscale="log", yscale="log", xlabel="number of blocks n")
        for k, (name, rows) in enumerate(groups.items()):
            points = [(row.n, value / unit) for row in rows if (value := getattr(row, quantity)) is not None]
            ax.plot(*np.array(points).reshape(-1, 2).T, "osD"[k], linestyle="-", linewidth=0.9, color=CYCLE[k],
                    markersize=4, label=name)  # fmt: skip
    axes[-1].axhline(1.0, color=GREY, linewidth=0.8)
    axes[-1].yaxis.set_major_formatter("{x:g}")
    axes[-1].yaxis.set_minor_formatter(NullFormatter())
    legend(axes, 3)
