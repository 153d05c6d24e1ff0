"""The chart of cost and size: a run of either engine, and an ensemble.

Systems of different n are alike if the force that couples a block is: of n - 1 random springs it goes as
kappa sqrt(n), so kappa goes as 1 / sqrt(n), and events per block and unit of time stay what they are. Runs start
behind the burn-in, where all blocks still do the same at once. Cost is wall time, and products (`cost`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import matplotlib
import numpy as np
import scipy.sparse
from matplotlib.figure import Figure
from pydantic import Field
from scipy.stats import linregress, t

from stickslip import sim
from stickslip.analysis.style import CYCLE, STYLE, legend, subplots
from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.pipeline.cluster import local
from stickslip.pipeline.design import MATRIX
from stickslip.pipeline.toml import BlockNumbers, Blocks, Count, Positive
from stickslip.workflows.charts import ChartScene, Say, Shown
from stickslip.workflows.charts.cost import Product, timed
from stickslip.workflows.charts.peers import W0, Z0, random_system, seed_of
from stickslip.workflows.charts.runner import frame

#: The n at which the stiffnesses have the scale `kappa` of the scene: the paper's.
KAPPA_AT = 200
#: The level of the intervals.
CONFIDENCE = 0.95

Tolerance = Annotated[float, Field(gt=1e-16, lt=1e-2)]
System = Literal["random", "chain"]
Engine = Literal["coulomb", "sigmoid"]

#: What is measured together over n, and what it is called.
GROUPS: dict[tuple[System, Engine], str] = {
    ("random", "coulomb"): "Random systems, exact engine",
    ("chain", "coulomb"): "Chains, exact engine",
    ("random", "sigmoid"): "Random systems, sigmoid engine",
}
#: quantity -> what of a row it is, over what.
QUANTITIES: dict[str, tuple[str, str | None]] = {
    "seconds per event": ("seconds", "n_events"),
    "seconds per unit of time": ("seconds", "t"),
    "seconds per product": ("product_seconds", None),
    "events per unit of time": ("n_events", "t"),
    "products with K per unit of time": ("n_products", "t"),
}


class ScalingScene(ChartScene):
    """A scene with ``chart = "scaling"``; dimensionless."""

    libraries = ("scipy", "dask")

    chart: Literal["scaling"] = Field(description="kind of the chart", examples=["scaling"])
    title: str = Field(default="Cost and size", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks of the random systems", examples=[[100, 200, 500]])
    kappa: Positive = Field(default=0.2, description="scale of the stiffnesses at n = 200", examples=[0.2])
    chain_n: BlockNumbers = Field(description="number of blocks of the chains", examples=[[100, 1000, 10000]])
    chain_kappa: Positive = Field(
        default=1.5, description="scale of the couplings to the neighbours in a chain", examples=[1.5]
    )
    tol: Tolerance = Field(default=1e-10, description="tolerance of the exact engine", examples=[1e-10])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.03, description="width of the sigmoid", examples=[0.03]
    )
    rtol: Tolerance = Field(
        default=1e-6, description="tolerance of the sigmoid engine, relative and absolute alike", examples=[1e-6]
    )
    t_burn: Positive = Field(default=5.0, description="time before which nothing is measured", examples=[5.0])
    t_run: Positive = Field(default=20.0, description="length of each run", examples=[20.0])
    repeats: Count = Field(default=5, description="number of runs of each", examples=[5])
    ensemble_n: Blocks = Field(default=200, description="number of blocks of the ensemble", examples=[200])
    ensemble_t_end: Positive = Field(default=1000.0, description="end of the ensemble's runs", examples=[1000.0])
    members: Count = Field(default=40, description="number of members of the ensemble", examples=[40])
    workers: Count = Field(default=2, description="number of local workers", examples=[2])

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
        """Tables: `costs`, `growth`, `throughput`."""
        groups = [Group(*which, measured.costs) for which in GROUPS]
        fits = [fit for group in groups for fit in group.fits.values()]
        tables = {
            "costs": frame(measured.costs, Cost),
            "growth": frame(fits, Growth),
            "throughput": frame(measured.throughput, Throughput),
        }
        facts = {"groups": groups, "fits": fits, "quantities": QUANTITIES}
        return Shown(facts, tables, {"cost_against_size": partial(cost_against_size, groups)})


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Cost:
    """What a run of one engine at one n costs: a row of the table `costs`.

    Seconds and products are medians over the repeats, with the least and the most. Numbers are null, with a reason,
    where the run did not end well; products are null for chains, whose K is never dense.
    """

    system: System
    engine: Engine
    n: int
    reason: str | None = None
    n_entries: int | None = None
    t: float | None = None
    n_events: int | None = None
    n_products: int | None = None
    seconds: float | None = None
    seconds_min: float | None = None
    seconds_max: float | None = None
    products: float | None = None
    products_min: float | None = None
    products_max: float | None = None
    product_seconds: float | None = None
    n_runs: int = 0

    def of(self, quantity: str) -> float | None:
        """One of `QUANTITIES`; None where it has none."""
        part, over = QUANTITIES[quantity]
        value, whole = getattr(self, part), 1.0 if over is None else getattr(self, over)
        return value / whole if value is not None and whole else None

    @property
    def rest(self) -> float | None:
        """The share of the run that is not products with K, at the price of numpy's; None for chains."""
        if self.product_seconds is None or self.n_products is None or not self.seconds:
            return None
        return max(0.0, 1.0 - self.n_products * self.product_seconds / self.seconds)


@dataclass(frozen=True)
class Throughput:
    """Members that an engine ran through the pipeline, on workers that have started and loaded.

    A row of the table `throughput`. `tolerance` is a number, or "picked": what a scene that gives none gets, for
    statistics.
    """

    engine: Engine
    tolerance: str
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
    """Load what an engine compiles or loads at a first call: it is not timed."""
    system = sim.draw_system("antisymmetric", 3, 0)
    sim.simulate(system, Z0, W0, 0.1)
    sim.simulate(system, Z0, W0, 0.1, engine="sigmoid", eps=0.1)


def cost(scene: ScalingScene, system: System, engine: Engine, n: int) -> Cost:
    """Runs over a fixed time, from the exact engine's state at `t_burn`."""
    row, drawn = Cost(system, engine, n), scene.drawn(system, n)
    settings: dict[str, Any] = {"tol": scene.tol} if engine == "coulomb" else _smooth(scene)
    try:
        start = sim.simulate(drawn, Z0, W0, scene.t_burn, tol=scene.tol, stop_early=False)
        run = partial(
            # to the end: whether a collapse is certain is a question of its own, with a cost of its own
            sim.simulate, drawn, start.z, start.w, scene.t_burn + scene.t_run, t_start=scene.t_burn, engine=engine,
            stop_early=False, **settings,
        )  # fmt: skip
        product = Product(drawn.stiffness) if isinstance(drawn.stiffness, np.ndarray) else None
        found, timing = timed(run, product, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, reason=str(error))
    if found.outcome != "finished":
        return replace(row, reason=found.reason)
    stats = found.stats
    return replace(
        row, n_entries=int(drawn.stiffness.size), t=scene.t_run, n_events=stats.n_events, n_products=stats.n_products,
        **timing._asdict(),
    )  # fmt: skip


def _smooth(scene: ScalingScene) -> dict[str, float]:
    return {"eps": scene.eps, "rtol": scene.rtol, "atol": scene.rtol}


def throughput(scene: ScalingScene, say: Say) -> list[Throughput]:
    """The ensemble, engine by engine, at the scene's tolerances and at those picked for statistics."""
    engines: tuple[tuple[Engine, str, dict[str, float]], ...] = (
        ("coulomb", f"{scene.tol:g}", {"tol": scene.tol}),
        ("coulomb", "picked", {}),
        ("sigmoid", f"{scene.rtol:g}", _smooth(scene)),
        ("sigmoid", "picked", {"eps": scene.eps}),
    )
    rows, of_scene = [], (scene.ensemble_n, scene.ensemble_t_end, scene.members, scene.workers)
    with local(scene.workers) as client:
        client.run(warm)
        for engine, tolerance, settings in engines:
            ensemble = parse_scene(ensemble_source(scene, engine, settings))
            with TemporaryDirectory() as directory:
                start = time.perf_counter()
                status = run_ensemble(ensemble, Path(directory) / "ensemble", scheduler=client)
                seconds = time.perf_counter() - start
            rows.append(Throughput(engine, tolerance, *of_scene, status.outcomes.get("failed", 0), seconds))
            say(f"ensemble, {engine} engine, tolerance {tolerance}: {seconds:.3g} s")
    return rows


def ensemble_source(scene: ScalingScene, engine: Engine, settings: dict[str, float]) -> bytes:
    """The scene file of the ensemble for one engine, of which nothing is analysed."""
    return f"""
[system]
coupling = "antisymmetric"
n = {scene.ensemble_n}
kappa = {scene.kappa_at(scene.ensemble_n)}
[start]
z = {Z0}
w = {W0}
[run]
t_end = {scene.ensemble_t_end}
matrices = {scene.members}
seed = {scene.seed}
[analysis]
t_burn = 0.0
dt = 1.0
[[engine]]
name = "{engine}"
{"".join(f"{name} = {value}{chr(10)}" for name, value in settings.items())}""".encode()


# ---------------------------------------------------------------------------------------------- exponents


@dataclass(frozen=True)
class Growth:
    """value ~ n^exponent, fitted by least squares of log value on log n: a row of the table `growth`.

    `low` and `high` are the interval at `CONFIDENCE` (Student's t); null, with a reason, where there are too few n.
    """

    system: str
    engine: str
    quantity: str
    n_points: int
    exponent: float | None = None
    low: float | None = None
    high: float | None = None
    reason: str | None = None


def growth(n: Sequence[int], values: Sequence[float], system: str, engine: str, quantity: str) -> Growth:
    """Fit an exponent to values > 0 at distinct n."""
    found = Growth(system, engine, quantity, len(n))
    if len(n) < 3:
        return replace(found, reason=f"an exponent with an error takes three n, got {len(n)}")
    line = linregress(np.log(n), np.log(values))
    half = float(t.ppf(0.5 * (1 + CONFIDENCE), len(n) - 2) * line.stderr)
    exponent = float(line.slope)
    return replace(found, exponent=exponent, low=exponent - half, high=exponent + half)


class Group:
    """The rows of one kind of system and one engine, and their exponents by quantity."""

    def __init__(self, system: System, engine: Engine, costs: Sequence[Cost]) -> None:
        self.system, self.engine, self.name = system, engine, GROUPS[system, engine]
        self.rows = [row for row in costs if (row.system, row.engine) == (system, engine)]
        self.known = {
            quantity: [(row.n, value) for row in self.rows if (value := row.of(quantity))] for quantity in QUANTITIES
        }
        self.fits = {
            quantity: growth([n for n, _ in points], [value for _, value in points], system, engine, quantity)
            for quantity, points in self.known.items()
            if points
        }


# ---------------------------------------------------------------------------------------------- the figure


def cost_against_size(groups: Sequence[Group]) -> Figure:
    """Cost against the number of blocks, log-log, with the fit dashed; and the share that is not products."""
    panels = (
        ("time per event (µs)", "seconds per event", 1e-6),
        ("time per unit of time (ms)", "seconds per unit of time", 1e-3),
    )
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(panels) + 1, 3.1)
        for k, group in enumerate(groups):
            look: dict[str, Any] = {"color": CYCLE[k], "marker": "osD"[k], "markersize": 4}
            for ax, (label, quantity, unit) in zip(axes[0], panels, strict=False):
                ax.set(title=label, xscale="log", yscale="log", xlabel="number of blocks n")
                n, values = np.array(group.known[quantity]).reshape(-1, 2).T
                ax.plot(n, values / unit, linestyle="none", label=group.name, **look)
                exponent = group.fits[quantity].exponent if quantity in group.fits else None
                if exponent is not None:
                    level = np.exp(np.log(values / n**exponent).mean())
                    ax.plot(n, level * n**exponent / unit, color=CYCLE[k], linestyle="--", linewidth=0.9)
                    place: dict[str, Any] = {"transform": ax.transAxes, "va": "top"}
                    ax.text(0.05, 0.97 - 0.08 * k, f"$n^{{{exponent:.2f}}}$", color=CYCLE[k], **place)
            known = [(row.n, row.rest) for row in group.rows if row.rest is not None]
            axes[0, -1].plot(*np.array(known).reshape(-1, 2).T, **look)
        axes[0, -1].set(title="share that is not products", xscale="log", xlabel="number of blocks n", ylim=(0, 1))
        legend(figure, 3)
    return figure
