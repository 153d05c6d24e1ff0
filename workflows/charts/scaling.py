"""The chart of cost and size: a run of either engine, and an ensemble.

Systems of different n are alike if the force that couples a block is: of n - 1 random springs it goes as
kappa sqrt(n), so kappa goes as 1 / sqrt(n), and events per block and unit of time stay what they are. Runs start
behind the burn-in, where all blocks still do the same at once. Cost is wall time, and products (`cost`).
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import matplotlib
import numpy as np
import scipy.sparse
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field
from scipy.stats import linregress, t

from stickslip import sim
from stickslip.analysis.style import CYCLE, GREY, STYLE, legend, subplots
from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.pipeline.cluster import local
from stickslip.pipeline.design import MATRIX
from stickslip.pipeline.toml import BlockNumbers, Blocks, Count, Positive
from stickslip.workflows.charts import ChartScene, Say, Shown
from stickslip.workflows.charts.cost import Product, timed
from stickslip.workflows.charts.peers import W0, Z0, Floats, ensemble, random_system, seed_of
from stickslip.workflows.charts.runner import frame

#: The n at which the stiffnesses have the scale `kappa` of the scene: the paper's.
KAPPA_AT = 200
#: Events are looked for in windows of this share of `t_most`.
_WINDOW = 1 / 32
#: A run that comes this far is one of a system that diverges: what it costs says nothing about cascades.
_FAR_OUT = 1e6
#: The level of the intervals.
CONFIDENCE = 0.95

Settings = dict[str, Any]
Tolerance = Annotated[float, Field(gt=1e-16, lt=1e-2)]
System = Literal["random", "chain"]
Engine = Literal["coulomb", "sigmoid"]

#: quantity -> what of a row it is, over what.
QUANTITIES: dict[str, tuple[str, str | None]] = {
    "seconds per event": ("seconds", "n_events"),
    "seconds per unit of time": ("seconds", "t"),
    "seconds per step": ("seconds", "n_steps"),
    "seconds per product": ("product_seconds", None),
    "products per event": ("products", "n_events"),
    "products per unit of time": ("products", "t"),
    "events per unit of time": ("n_events", "t"),
    "steps per unit of time": ("n_steps", "t"),
    "products with K per event": ("n_products", "n_events"),
    "products with K per unit of time": ("n_products", "t"),
}

#: (system, engine) -> quantity -> the exponent claimed: an event costs O(n), a unit of time O(n^2), beside events
#: and, as their rate is O(n), with them; a product O(n^2). None: fitted, nothing claimed.
FITTED: dict[tuple[System, Engine], dict[str, float | None]] = {
    ("random", "coulomb"): {
        "seconds per event": 1.0,
        "seconds per unit of time": 2.0,
        "seconds per product": 2.0,
        "products per event": -1.0,
        "products per unit of time": 0.0,
        "events per unit of time": None,
        "products with K per unit of time": None,
    },
    ("chain", "coulomb"): {
        "seconds per event": 1.0,
        "seconds per unit of time": 2.0,
        "events per unit of time": None,
        "products with K per unit of time": None,
    },
    ("random", "sigmoid"): {"seconds per step": 2.0, "seconds per unit of time": None},
}


class ScalingScene(ChartScene):
    """A scene with ``chart = "scaling"``; dimensionless."""

    libraries = ("scipy", "dask")

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

    def kappa_at(self, n: int) -> float:
        """The scale of the stiffnesses that couples n blocks as strongly as `kappa` couples `KAPPA_AT`."""
        return self.kappa * math.sqrt(KAPPA_AT / n)

    def random(self, n: int, matrix: int) -> sim.System:
        """A random system; at n = `KAPPA_AT` that of an ensemble with this seed."""
        return random_system(self.seed, n, matrix, kappa=self.kappa_at(n))

    def chain(self, n: int, matrix: int) -> sim.System:
        """Blocks in a row, each coupled to its neighbours alone; K is sparse.

        K_ii and R as in the random systems at n = `KAPPA_AT`; K_i,i+1 = -K_i+1,i uniform in
        [-chain_kappa, chain_kappa]. Not reciprocal, as those are not: springs that pull both ways alike come to rest.
        """
        rng = np.random.default_rng(seed_of(self.seed, MATRIX, n, matrix))
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

    def extent(self) -> str:
        return (
            f"{len(self.n)} random systems and {len(self.chain_n)} chains with the exact engine, "
            f"{len(self.sigmoid_n)} with the sigmoid engine, and an ensemble of {self.members} members of each on "
            f"{self.workers} workers"
        )

    def measure(self, say: Say) -> Measured:
        """The runs in this process, the ensemble on local workers of its own."""
        warm()

        def told(row: Cost) -> Cost:
            cost = f"{row.seconds:.3g} s" if row.seconds is not None else f"{row.outcome}: {row.reason}"
            say(f"{row.system}, n = {row.n}, {row.engine} engine: {cost}")
            return row

        costs = [told(exact_cost(self, "random", n)) for n in self.n]
        costs += [told(exact_cost(self, "chain", n)) for n in self.chain_n]
        costs += [told(sigmoid_cost(self, n)) for n in self.sigmoid_n]
        return Measured(costs, throughput(self, say))

    def show(self, measured: Measured) -> Shown:
        """Tables: `costs`, `growth`, `throughput`."""
        groups = [_group(measured.costs, *which) for which in FITTED]
        fits = [fit for group in groups for fit in group.fits.values()]
        facts = {"groups": groups, "confidence": CONFIDENCE, "fits": fits}
        tables = {
            "costs": frame(measured.costs, Cost),
            "growth": frame(fits, Growth),
            "throughput": frame(measured.throughput, Throughput),
        }
        return Shown(facts, tables, {"cost_against_size": partial(cost_against_size, groups)})


# ---------------------------------------------------------------------------------------------- what is kept


@dataclass(frozen=True)
class Cost:
    """What runs of one engine at one n cost: a row of the table `costs`.

    `t` and the counts are sums over the matrices, seconds and products medians over the repeats of that sum, with the
    least and the most. Numbers are null, with a reason, where the outcome is not "measured"; products are null for
    chains, whose K is never dense. Of `n_tried` matrices `n_rest` came to rest and `n_diverged` left every bound;
    `n_matrices` had events and are measured, these to the last one and before they left.
    """

    system: System
    engine: Engine
    n: int
    outcome: Literal["measured", "failed"] = "measured"
    reason: str | None = None
    n_tried: int = 0
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

    @property
    def is_fitted(self) -> bool:
        """Whether it counts for the exponents: measured, and no system in it came to rest."""
        return self.outcome == "measured" and self.n_rest == 0


@dataclass(frozen=True)
class Throughput:
    """Members that an engine ran through the pipeline: a row of the table `throughput`.

    `tolerance` is a number, or "picked": what a scene that gives none gets, for statistics. `seconds` is the time on
    workers that have started and loaded, `seconds_with_start` that of a run that starts its own.
    """

    engine: Engine
    tolerance: str
    n: int
    t_end: float
    n_members: int
    n_workers: int
    n_failed: int
    seconds: float
    seconds_with_start: float

    @property
    def rate(self) -> float:
        """Members a minute."""
        return 60.0 * self.n_members / self.seconds

    @property
    def rate_with_start(self) -> float:
        return 60.0 * self.n_members / self.seconds_with_start


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    costs: list[Cost]
    throughput: list[Throughput]


# ---------------------------------------------------------------------------------------------- measuring


def warm() -> None:
    """Load what an engine compiles or loads at a first call: it is not timed."""
    system = sim.draw_system("antisymmetric", 3, 0)
    sim.simulate(system, Z0, W0, 0.1)
    sim.simulate(system, Z0, W0, 0.1, engine="sigmoid", eps=0.1)


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


def exact_cost(scene: ScalingScene, system: System, n: int) -> Cost:
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
        row = replace(row, n_tried=ends.total(), n_rest=ends["rest"], n_diverged=ends["diverged"])
        if not pieces:
            return replace(row, outcome="failed", reason=f"no event after t_burn in {row.n_tried} matrices")
        return _timed(row, pieces, scene.exact, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, outcome="failed", reason=str(error))


def sigmoid_cost(scene: ScalingScene, n: int) -> Cost:
    """Runs of the sigmoid engine on matrix 0, over a fixed time from the exact engine's state at `t_burn`."""
    row = Cost("random", "sigmoid", n, n_tried=1)
    try:
        start = _burnt(scene.random(n, 0), scene)
        if start is None:
            return replace(row, outcome="failed", n_diverged=1, reason="diverged before t_burn")
        return _timed(row, [replace(start, t_end=scene.t_burn + scene.sigmoid_t)], scene.smooth, scene.repeats)
    except sim.IntegrationError as error:
        return replace(row, outcome="failed", reason=str(error))


def _timed(row: Cost, pieces: Sequence[_Piece], settings: Settings, repeats: int) -> Cost:
    """Repeated runs of all pieces one after the other."""
    first = pieces[0].system.stiffness
    product = Product(first) if isinstance(first, np.ndarray) else None
    runs, timing = timed(lambda: [piece.run(settings) for piece in pieces], product, repeats)
    stopped = [run for run in runs if run.outcome != "finished"]
    if stopped:
        return replace(row, outcome="failed", n_diverged=len(stopped), reason=stopped[0].reason)
    return replace(
        row,
        n_matrices=len(pieces),
        n_entries=stored(first),
        t=sum(piece.t_end - piece.t_start for piece in pieces),
        n_events=sum(run.stats.n_events for run in runs),
        n_steps=sum(run.stats.n_steps for run in runs),
        n_products=sum(run.stats.n_products for run in runs),
        **timing._asdict(),
    )


def stored(stiffness: Floats | scipy.sparse.csc_array) -> int:
    """How many entries of K are kept in memory."""
    return int(stiffness.size)


def throughput(scene: ScalingScene, say: Say) -> list[Throughput]:
    """The ensemble, engine by engine, on workers that are there and on workers that have to be started."""
    smooth = {"eps": scene.eps}
    engines: tuple[tuple[Engine, str, Settings], ...] = (
        ("coulomb", f"{scene.tol:g}", {"tol": scene.tol}),
        ("coulomb", "picked", {}),
        ("sigmoid", f"{scene.rtol:g}", smooth | {"rtol": scene.rtol, "atol": scene.rtol}),
        ("sigmoid", "picked", smooth),
    )
    with local(scene.workers) as client:
        client.run(warm)
        there = [_pipeline(scene, engine, settings, scheduler=client) for engine, _, settings in engines]
    rows, of_scene = [], (scene.ensemble_n, scene.ensemble_t_end, scene.members, scene.workers)
    for (engine, tolerance, settings), (seconds, n_failed) in zip(engines, there, strict=True):
        with_start, _ = _pipeline(scene, engine, settings, workers=scene.workers)
        rows.append(Throughput(engine, tolerance, *of_scene, n_failed, seconds, with_start))
        say(f"ensemble, {engine} engine, tolerance {tolerance}: {seconds:.3g} s, {with_start:.3g} s with start-up")
    return rows


def _pipeline(scene: ScalingScene, engine: Engine, settings: Settings, **where: Any) -> tuple[float, int]:
    """Seconds that the pipeline takes for the ensemble, and how many members failed."""
    source = ensemble_source(scene, engine, settings)
    with TemporaryDirectory() as directory:
        start = time.perf_counter()
        status = run_ensemble(parse_scene(source), Path(directory) / "ensemble", **where)
        return time.perf_counter() - start, status.outcomes.get("failed", 0)


def ensemble_source(scene: ScalingScene, engine: Engine, settings: Settings) -> bytes:
    """The scene file of the ensemble for one engine."""
    return ensemble(
        {"n": scene.ensemble_n, "kappa": scene.kappa_at(scene.ensemble_n)},
        {"t_end": scene.ensemble_t_end, "matrices": scene.members, "seed": scene.seed},
        {"name": engine, **settings},
    )


# ---------------------------------------------------------------------------------------------- exponents


@dataclass(frozen=True)
class Growth:
    """value ~ n^exponent, fitted by least squares of log value on log n: a row of the table `growth`.

    `low` and `high` are the interval at `CONFIDENCE` (Student's t), `last` the exponent between the two largest n
    alone. Null, with a reason, where there are too few n. `claim` is the exponent expected; null where there is none.
    """

    system: str
    engine: str
    quantity: str
    claim: float | None
    n_points: int
    n_min: int | None = None
    n_max: int | None = None
    exponent: float | None = None
    standard_error: float | None = None
    low: float | None = None
    high: float | None = None
    last: float | None = None
    reason: str | None = None


def growth(
    n: Sequence[int], values: Sequence[float], system: str, engine: str, quantity: str, claim: float | None = None
) -> Growth:
    """Fit an exponent to values > 0 at distinct, ascending n."""
    found = Growth(system, engine, quantity, claim, len(n))
    if len(n) < 3:
        return replace(found, reason=f"an exponent with an error takes three n, got {len(n)}")
    x, y = np.log(n), np.log(values)
    line = linregress(x, y)
    half = float(t.ppf(0.5 * (1 + CONFIDENCE), len(n) - 2) * line.stderr)
    exponent = float(line.slope)
    return replace(
        found,
        n_min=n[0],
        n_max=n[-1],
        exponent=exponent,
        standard_error=float(line.stderr),
        low=exponent - half,
        high=exponent + half,
        last=float((y[-1] - y[-2]) / (x[-1] - x[-2])),
    )


@dataclass(frozen=True)
class Group:
    """The rows of one kind of system and one engine, and their exponents by quantity."""

    system: System
    engine: Engine
    rows: list[Cost]
    fits: dict[str, Growth]

    @property
    def kept(self) -> list[Cost]:
        return [row for row in self.rows if row.is_fitted]

    @property
    def fit(self) -> Growth:
        """That of the first quantity."""
        return next(iter(self.fits.values()))

    def ends(self, quantity: str) -> list[tuple[int, float]]:
        """A quantity at the smallest and at the largest n."""
        known = [(row.n, value) for row in self.kept if (value := row.of(quantity)) is not None]
        return list(dict.fromkeys((known[0], known[-1])))

    def points(self, quantity: str, unit: float) -> list[tuple[int, float, float, float, bool]]:
        """(n, value, least, most, whether it counts for the exponent), in that unit."""
        return [
            (
                row.n,
                value / unit,
                value / unit * row.seconds_min / row.seconds,
                value / unit * row.seconds_max / row.seconds,
                row.is_fitted,
            )
            for row in self.rows
            if (value := row.of(quantity)) and row.seconds and row.seconds_min and row.seconds_max
        ]


def _group(costs: Sequence[Cost], system: System, engine: Engine) -> Group:
    group = Group(system, engine, [row for row in costs if (row.system, row.engine) == (system, engine)], {})
    for quantity, claim in FITTED[system, engine].items():
        known = sorted((row.n, value) for row in group.kept if (value := row.of(quantity)))
        n, values = [n for n, _ in known], [value for _, value in known]
        group.fits[quantity] = growth(n, values, system, engine, quantity, claim)
    return group


# ---------------------------------------------------------------------------------------------- the figure


def cost_against_size(groups: Sequence[Group]) -> Figure:
    """Cost against the number of blocks, log-log; and the share of a run that is not products.

    A point that does not count for the exponent is hollow; dashed is the fit, dotted the growth claimed.
    """
    panels = (
        ("time per event (µs)", "seconds per event", 1e-6, 1.0),
        ("time per unit of time (ms)", "seconds per unit of time", 1e-3, 2.0),
    )
    order = sorted(groups, key=lambda group: group.system, reverse=True)
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(1, len(panels) + 1, 3.1)
        for ax, (label, quantity, unit, slope) in zip(axes[0], panels, strict=False):
            ax.set(title=label, xscale="log", yscale="log", xlabel="number of blocks n")
            for i, group in enumerate(group for group in order if quantity in group.fits):
                k, exponent = order.index(group), group.fits[quantity].exponent
                name = f"{'random systems' if group.system == 'random' else 'chains'}, {_ENGINES[group.engine]}"
                _growth(ax, group.points(quantity, unit), exponent, name, CYCLE[k], "osD"[k])
                if exponent is not None:
                    place: dict[str, Any] = {"transform": ax.transAxes, "va": "top"}
                    ax.text(0.05, 0.97 - 0.08 * i, f"$n^{{{exponent:.2f}}}$", color=CYCLE[k], **place)
            _guide(ax, slope)
        ax = axes[0, -1]
        ax.set(title="share that is not products", xscale="log", xlabel="number of blocks n", ylim=(0, 1))
        for k, group in enumerate(order):
            known = [(row.n, row.rest) for row in group.rows if row.rest is not None]
            ax.plot(*zip(*known, strict=True) if known else ((), ()), color=CYCLE[k], marker="osD"[k], markersize=4)
        legend(figure, 3)
    return figure


_ENGINES: dict[Engine, str] = {"coulomb": "exact", "sigmoid": "sigmoid"}


def _growth(
    ax: Axes,
    points: Sequence[tuple[int, float, float, float, bool]],
    exponent: float | None,
    name: str,
    colour: str,
    marker: str,
) -> None:
    """The points of one curve and the line of its exponent, through the mean of those that count."""
    for n, value, least, most, counts in points:
        bars = [[max(value - least, 0.0)], [max(most - value, 0.0)]]
        look: dict[str, Any] = {"color": colour, "markersize": 4, "linewidth": 0.9}
        ax.errorbar([n], [value], bars, fmt=marker, markerfacecolor=colour if counts else "white", **look)
    if exponent is not None:
        log_n, log_value = np.log([(n, value) for n, value, *_, counts in points if counts]).T
        line = np.exp(log_value.mean() + exponent * (log_n - log_n.mean()))
        ax.plot(np.exp(log_n), line, color=colour, linestyle="--", linewidth=0.9)
    ax.plot([], [], color=colour, marker=marker, markersize=4, linestyle="--", linewidth=0.9, label=name)


def _guide(ax: Axes, slope: float) -> None:
    """A line of a given slope along the lower edge of what is drawn."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    ends = np.array([np.sqrt(left * right), right / 1.3])
    line = low * 1.3 * (ends / ends[0]) ** slope
    ax.plot(ends, line, color=GREY, linestyle=":", linewidth=1.0)
    ax.annotate(f"$n^{{{slope:g}}}$", (ends[0], line[0]), ha="right", va="bottom", color=GREY, fontsize=8)
    ax.set(xlim=(left, right), ylim=(low, max(high, line[1])))
