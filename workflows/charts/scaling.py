"""How cost grows with the system, measured: a run of either engine, an ensemble, and what lockstep could save.

Systems of different n are alike if the force that couples a block is: of n - 1 random springs it goes as
kappa sqrt(n), so kappa goes as 1 / sqrt(n), and events per block and unit of time stay what they are. Runs start
behind the burn-in, where all blocks still do the same at once. Cost is wall time, and *products*: wall time over
that of one product of a dense K of that n with a vector (numpy, float64), measured just before and after.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import scipy.sparse
from pydantic import AfterValidator, BeforeValidator, Field

from stickslip import sim
from stickslip.pipeline import parse_scene, run_scene
from stickslip.pipeline.cluster import local
from stickslip.pipeline.design import MATRIX
from stickslip.pipeline.toml import BlockNumbers, Blocks, Count, Positive, as_tuple, distinct
from stickslip.workflows.charts import ChartScene, Say
from stickslip.workflows.charts.alone import Product, versions
from stickslip.workflows.charts.peers import W0, Z0, Floats

#: The n at which the stiffnesses have the scale `kappa` of the scene: the paper's.
KAPPA_AT = 200

#: Events are looked for in windows of this share of `t_most`.
_WINDOW = 1 / 32
#: A run that comes this far is one of a system that diverges: what it costs says nothing about cascades.
_FAR_OUT = 1e6

Settings = dict[str, Any]
Tolerance = Annotated[float, Field(gt=1e-16, lt=1e-2)]


class ScalingScene(ChartScene):
    """A scene with ``chart = "scaling"``; dimensionless."""

    chart: Literal["scaling"] = Field(description="kind of the chart", examples=["scaling"])
    title: str = Field(default="Cost and size", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks of the random systems", examples=[[100, 200, 500]])
    kappa: Positive = Field(default=0.2, description="scale of the stiffnesses at n = 200", examples=[0.2])
    tol: Tolerance = Field(default=1e-10, description="tolerance of the exact engine", examples=[1e-10])
    events: Count = Field(description="number of events in each run", examples=[2000])
    t_burn: Positive = Field(default=5.0, description="time before which nothing is measured", examples=[5.0])
    t_most: Positive = Field(default=100.0, description="longest run of one matrix", examples=[100.0])
    matrices: Count = Field(default=40, description="largest number of matrices", examples=[40])
    repeats: Count = Field(default=5, description="number of runs of each", examples=[5])
    chain_n: BlockNumbers = Field(description="number of blocks of the chains", examples=[[100, 1000, 10000]])
    chain_kappa: Positive = Field(
        default=1.5, description="scale of the couplings to the neighbours in a chain", examples=[1.5]
    )
    sigmoid_n: BlockNumbers = Field(
        description="number of blocks of the random systems run with the sigmoid engine", examples=[[100, 200, 500]]
    )
    sigmoid_t: Positive = Field(default=20.0, description="length of each sigmoid run", examples=[20.0])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.03, description="width of the sigmoid", examples=[0.03]
    )
    rtol: Tolerance = Field(
        default=1e-6, description="tolerance of the sigmoid engine, relative and absolute alike", examples=[1e-6]
    )
    ensemble_n: Blocks = Field(default=200, description="number of blocks of the ensemble", examples=[200])
    ensemble_t_end: Positive = Field(default=1000.0, description="end of the ensemble's runs", examples=[1000.0])
    members: Count = Field(default=40, description="number of members of the ensemble", examples=[40])
    workers: Count = Field(default=2, description="number of local workers", examples=[2])
    vectors: Annotated[tuple[Count, ...], BeforeValidator(as_tuple), AfterValidator(distinct)] = Field(
        default=(1, 2, 4, 8, 16), min_length=1, description="numbers of vectors that share a product",
        examples=[[1, 4, 16]],
    )  # fmt: skip

    def kappa_at(self, n: int) -> float:
        """The scale of the stiffnesses that couples n blocks as strongly as `kappa` couples `KAPPA_AT`."""
        return self.kappa * math.sqrt(KAPPA_AT / n)

    def key(self, n: int, matrix: int) -> np.random.SeedSequence:
        """The seed of that matrix, as an ensemble with this seed has it."""
        return np.random.SeedSequence(self.seed, spawn_key=(MATRIX, n, matrix))

    def random(self, n: int, matrix: int) -> sim.System:
        """A random system; at n = `KAPPA_AT` that of an ensemble with this seed."""
        return sim.draw_system("antisymmetric", n, self.key(n, matrix), kappa=self.kappa_at(n))

    def chain(self, n: int, matrix: int) -> sim.System:
        """Blocks in a row, each coupled to its neighbours alone; K is sparse.

        K_ii and R as in the random systems at n = `KAPPA_AT`; K_i,i+1 = -K_i+1,i uniform in
        [-chain_kappa, chain_kappa]. Not reciprocal, as those are not: springs that pull both ways alike come to rest.
        """
        rng = np.random.default_rng(self.key(n, matrix))
        damping, ground = rng.uniform(3.5, 7.0, n), np.abs(rng.uniform(-self.kappa, self.kappa, n))
        coupling = rng.uniform(-self.chain_kappa, self.chain_kappa, n - 1)
        stiffness = scipy.sparse.diags_array([-coupling, ground, coupling], offsets=[-1, 0, 1], format="csc")
        return sim.System(stiffness, damping)

    @property
    def exact(self) -> Settings:
        return {"engine": "coulomb", "tol": self.tol}

    @property
    def smooth(self) -> Settings:
        return {"engine": "sigmoid", "eps": self.eps, "rtol": self.rtol, "atol": self.rtol}


# ---------------------------------------------------------------------------------------------- what is kept


@dataclass(frozen=True)
class Cost:
    """What runs of one engine at one n cost: a row of the table `costs`.

    `t` and the counts are sums over the matrices, seconds and products medians over the repeats of that sum, with the
    least and the most. Numbers are null, with a reason, where the outcome is not "measured"; products are null for
    chains, whose K is never dense. Of `n_matrices` measured, `n_rest` came to rest and are measured to their last
    event; `n_diverged` of those tried left every bound and are measured, if at all, before.
    """

    system: Literal["random", "chain"]
    engine: Literal["coulomb", "sigmoid"]
    n: int
    outcome: Literal["measured", "failed"] = "measured"
    reason: str | None = None
    n_matrices: int = 0
    n_rest: int = 0
    n_diverged: int = 0
    n_entries: int | None = None
    t: float | None = None
    n_events: int | None = None
    n_steps: int | None = None
    n_products: int | None = None
    seconds: float | None = None
    seconds_min: float | None = None
    seconds_max: float | None = None
    products: float | None = None
    products_min: float | None = None
    products_max: float | None = None
    product_seconds: float | None = None
    n_runs: int = 0


@dataclass(frozen=True)
class Throughput:
    """Members that an engine ran through the pipeline: a row of the table `throughput`.

    `tolerance` is a number, or "picked": what a scene that gives none gets, for statistics. `seconds` is the time on
    workers that have started and loaded, `seconds_with_start` that of a run that starts its own.
    """

    engine: Literal["coulomb", "sigmoid"]
    tolerance: str
    n: int
    t_end: float
    n_members: int
    n_workers: int
    n_failed: int
    seconds: float
    seconds_with_start: float


@dataclass(frozen=True)
class Lockstep:
    """One product of K with `n_vectors` vectors at once: a row of the table `lockstep`.

    `share` is its time for each vector over that of one product with one vector; medians over the repeats.
    """

    n: int
    n_vectors: int
    seconds: float
    product_seconds: float
    share: float


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of; plain values, which JSON carries.

    `smooth` is the sigmoid engine's row at the ensemble's n.
    """

    costs: list[Cost]
    throughput: list[Throughput]
    lockstep: list[Lockstep]
    smooth: Cost
    versions: dict[str, str]

    @classmethod
    def restore(cls, found: dict[str, Any]) -> Measured:
        return cls(
            [Cost(**row) for row in found["costs"]],
            [Throughput(**row) for row in found["throughput"]],
            [Lockstep(**row) for row in found["lockstep"]],
            Cost(**found["smooth"]),
            found["versions"],
        )


# ---------------------------------------------------------------------------------------------- measuring


def measure(scene: ScalingScene, say: Say) -> Measured:
    """Measure all of a scene; the runs in this process, the ensemble on local workers of its own."""
    warm()
    costs: list[Cost] = []

    def told(row: Cost) -> Cost:
        cost = f"{row.seconds:.3g} s" if row.seconds is not None else f"{row.outcome}: {row.reason}"
        say(f"{row.system}, n = {row.n}, {row.engine} engine: {cost}")
        return row

    for n in scene.n:
        costs.append(told(exact_cost(scene, "random", n)))
    for n in scene.chain_n:
        costs.append(told(exact_cost(scene, "chain", n)))
    for n in scene.sigmoid_n:
        costs.append(told(sigmoid_cost(scene, n)))
    of_ensemble = (row for row in costs if (row.engine, row.n) == ("sigmoid", scene.ensemble_n))
    smooth = next(of_ensemble, None) or told(sigmoid_cost(scene, scene.ensemble_n))
    shared = lockstep(scene)
    return Measured(costs, throughput(scene, say), shared, smooth, versions("scipy", "dask"))


def warm() -> None:
    """Load what an engine compiles or loads at a first call: it is not timed."""
    system = sim.draw_system("antisymmetric", 3, 0)
    each: tuple[Settings, ...] = ({"engine": "coulomb"}, {"engine": "sigmoid", "eps": 0.1})
    for settings in each:
        sim.simulate(system, Z0, W0, 0.1, **settings)


@dataclass(frozen=True, eq=False)
class _Piece:
    """One timed run: from a state behind the burn-in to `t_end`."""

    system: sim.System
    z: Floats
    w: Floats
    t_start: float
    t_end: float

    def run(self, settings: Settings) -> sim.Run:
        # to the end: whether a collapse is certain is a question of its own, with a cost of its own
        run = sim.simulate(
            self.system, self.z, self.w, self.t_end, t_start=self.t_start, stop_early=False, **settings
        )
        if max(np.abs(run.z).max(), np.abs(run.w).max()) > _FAR_OUT:
            return replace(run, outcome="diverged", reason=f"|z| or |w| passed {_FAR_OUT:g}")
        return run


_End = Literal["enough", "t_most", "rest", "diverged"]


def _burnt(system: sim.System, scene: ScalingScene) -> _Piece | None:
    """A piece of no length at `t_burn`; None if the system diverged before."""
    run = _Piece(system, np.full(system.n, Z0), np.full(system.n, W0), 0.0, scene.t_burn).run(scene.exact)
    if run.outcome != "finished":
        return None
    return _Piece(system, run.z, run.w, scene.t_burn, scene.t_burn)


def _piece(system: sim.System, scene: ScalingScene, missing: int) -> tuple[_Piece | None, int, _End]:
    """A piece with as many of the missing events as the system has before `t_most`, their number, and what ended it.

    A piece that has them all ends at the last; one that came to rest, at its last event.
    """
    start = _burnt(system, scene)
    if start is None:
        return None, 0, "diverged"
    times, window, t_last = np.empty(0), start, start.t_start + scene.t_most
    end: _End = "enough"
    while len(times) < missing:
        if window.t_end >= t_last:
            end = "t_most"
            break
        # on from the window before: the same run but for rounding, and no time is gone through twice
        window = replace(window, t_start=window.t_end, t_end=min(window.t_end + _WINDOW * scene.t_most, t_last))
        run = window.run(scene.exact)
        if run.outcome != "finished":
            end, window = "diverged", replace(window, t_end=window.t_start)
            break
        times, window = np.append(times, run.events.t), replace(window, z=run.z, w=run.w)
    t_end = window.t_end
    if end == "enough":
        times = times[:missing]
        t_end = float(times[-1])
    elif end == "t_most" and not (times > t_last - 0.5 * scene.t_most).any():
        end, t_end = "rest", float(times[-1]) if len(times) else start.t_start
    piece = replace(start, t_end=t_end) if t_end > start.t_start and len(times) else None
    return piece, len(times), end


def exact_cost(scene: ScalingScene, system: Literal["random", "chain"], n: int) -> Cost:
    """Runs of the exact engine over as many matrices as it takes to see `events` events."""
    row = Cost(system, "coulomb", n)
    draw = scene.random if system == "random" else scene.chain
    pieces: list[_Piece] = []
    ends: Counter[_End] = Counter()
    missing = scene.events
    try:
        for matrix in range(scene.matrices):
            if missing <= 0:
                break
            piece, n_events, end = _piece(draw(n, matrix), scene, missing)
            ends[end] += 1
            if piece is not None:
                pieces.append(piece)
                missing -= n_events
        row = replace(row, n_rest=ends["rest"], n_diverged=ends["diverged"])
        if not pieces:
            return replace(row, outcome="failed", reason=f"no event after t_burn in {ends.total()} matrices")
        return _timed(row, pieces, scene.exact, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, outcome="failed", reason=str(error))


def sigmoid_cost(scene: ScalingScene, n: int) -> Cost:
    """Runs of the sigmoid engine on matrix 0, over a fixed time from the exact engine's state at `t_burn`."""
    row = Cost("random", "sigmoid", n)
    try:
        start = _burnt(scene.random(n, 0), scene)
        if start is None:
            return replace(row, outcome="failed", n_diverged=1, reason="diverged before t_burn")
        return _timed(row, [replace(start, t_end=scene.t_burn + scene.sigmoid_t)], scene.smooth, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, outcome="failed", reason=str(error))


def _timed(row: Cost, pieces: Sequence[_Piece], settings: Settings, repeats: int) -> Cost:
    """Repeated runs of all pieces one after the other, each time between two measurements of the product."""
    first = pieces[0].system.stiffness
    product = Product(first) if isinstance(first, np.ndarray) else None
    seconds: list[float] = []
    units: list[float] = []
    runs: list[sim.Run] = []
    for _ in range(repeats):
        before = product.seconds() if product else 0.0
        start = time.perf_counter()
        runs = [piece.run(settings) for piece in pieces]
        seconds.append(time.perf_counter() - start)
        units.append(0.5 * (before + product.seconds()) if product else 0.0)
    stopped = [run for run in runs if run.outcome != "finished"]
    if stopped:
        return replace(row, outcome="failed", n_diverged=len(stopped), reason=stopped[0].reason)
    row = replace(
        row,
        n_matrices=len(pieces),
        n_entries=stored(first),
        t=sum(piece.t_end - piece.t_start for piece in pieces),
        n_events=sum(run.stats.n_events for run in runs),
        n_steps=sum(run.stats.n_steps for run in runs),
        n_products=sum(run.stats.n_products for run in runs),
        seconds=median(seconds),
        seconds_min=min(seconds),
        seconds_max=max(seconds),
        n_runs=repeats,
    )
    if product is None:
        return row
    products = [run / unit for run, unit in zip(seconds, units, strict=True)]
    return replace(
        row,
        products=median(products),
        products_min=min(products),
        products_max=max(products),
        product_seconds=median(units),
    )


def stored(stiffness: Floats | scipy.sparse.csc_array) -> int:
    """How many entries of K are kept in memory."""
    return int(stiffness.size)


# ---------------------------------------------------------------------------------------------- lockstep, ensemble


class _Shared(Product):
    """One product of a matrix with several vectors at once."""

    def __init__(self, matrix: Floats, n_vectors: int) -> None:
        super().__init__(matrix)
        self._x, self._out = np.ones((len(matrix), n_vectors)), np.empty((len(matrix), n_vectors))


def lockstep(scene: ScalingScene) -> list[Lockstep]:
    """One product of K with several vectors at once, at the ensemble's n."""
    n = scene.ensemble_n
    matrix = np.asarray(scene.random(n, 0).stiffness)
    product, found = Product(matrix), []
    for m in scene.vectors:
        several = _Shared(matrix, m)
        pairs = [(several.seconds(), product.seconds()) for _ in range(scene.repeats)]
        share = median(together / (m * one) for together, one in pairs)
        found.append(Lockstep(n, m, median(t for t, _ in pairs), median(one for _, one in pairs), share))
    return found


def throughput(scene: ScalingScene, say: Say) -> list[Throughput]:
    """The ensemble, engine by engine, on workers that are there and on workers that have to be started."""
    smooth = {"eps": scene.eps}
    engines: tuple[tuple[Literal["coulomb", "sigmoid"], str, Settings], ...] = (
        ("coulomb", f"{scene.tol:g}", {"tol": scene.tol}),
        ("coulomb", "picked", {}),
        ("sigmoid", f"{scene.rtol:g}", smooth | {"rtol": scene.rtol, "atol": scene.rtol}),
        ("sigmoid", "picked", smooth),
    )
    found = []
    with local(scene.workers) as client:
        client.run(warm)
        for engine, tolerance, settings in engines:
            seconds, n_failed = _pipeline(scene, engine, settings, scheduler=client)
            found.append((engine, tolerance, settings, n_failed, seconds))
    rows = []
    for engine, tolerance, settings, n_failed, seconds in found:
        with_start, _ = _pipeline(scene, engine, settings, workers=scene.workers)
        rows.append(
            Throughput(
                engine, tolerance, scene.ensemble_n, scene.ensemble_t_end, scene.members, scene.workers, n_failed,
                seconds, with_start,
            )
        )  # fmt: skip
        say(f"ensemble, {engine} engine, tolerance {tolerance}: {seconds:.3g} s, {with_start:.3g} s with start-up")
    return rows


def _pipeline(scene: ScalingScene, engine: str, settings: Settings, **where: Any) -> tuple[float, int]:
    """Seconds that the pipeline takes for the ensemble, and how many members failed."""
    source = ensemble_source(scene, engine, settings)
    with TemporaryDirectory() as directory:
        start = time.perf_counter()
        status = run_scene(parse_scene(source), source, Path(directory) / "ensemble", **where)
        return time.perf_counter() - start, status.outcomes.get("failed", 0)


def ensemble_source(scene: ScalingScene, engine: str, settings: Settings) -> bytes:
    """The scene file of the ensemble for one engine."""
    keys = "\n".join(f"{key} = {value!r}" for key, value in settings.items())
    return f"""[system]
coupling = "antisymmetric"
n = {scene.ensemble_n}
kappa = {scene.kappa_at(scene.ensemble_n)!r}
[start]
z = {Z0!r}
w = {W0!r}
[run]
t_end = {scene.ensemble_t_end!r}
matrices = {scene.members}
seed = {scene.seed}
[[engine]]
name = "{engine}"
{keys}
[analysis]
t_burn = 0.0
dt = 1.0
""".encode()
