"""The chart of limits: what is left of a run's time once its products with K are taken away.

A run of so many products cannot end before their arithmetic does, at the rate at which this machine multiplies
matrices. If each product reads K, it cannot end before K is read so often either: the time of as many products by
numpy. Products of several vectors at a time, in single precision, or of some rows alone go below that.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from pydantic import Field

from stickslip import sim
from stickslip.analysis.style import CYCLE, GREY, WIDTH, legend, panel
from stickslip.pipeline.scene.toml import BlockNumbers, Count, Positive
from stickslip.workflows.gallery.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.gallery.charts.cost import Product, Timing, timed
from stickslip.workflows.gallery.charts.peers import W0, Z0, random_ratios
from stickslip.workflows.gallery.charts.runner import frames
from stickslip.workflows.gallery.charts.scaling import ScalingScene, Tolerance, warm

#: Rows of the matrices whose product gives the rate of arithmetic.
_ROWS = 768


class LimitScene(ChartScene):
    """A scene with ``chart = "limit"``; dimensionless."""

    libraries = ("scipy",)

    chart: Literal["limit"] = Field(description="kind of the chart", examples=["limit"])
    title: str = Field(default="Time over its limits", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks of the random systems", examples=[[20, 200, 1000]])
    chain_n: BlockNumbers = Field(description="number of blocks of the chains", examples=[[1000]])
    tolerances: Several[Tolerance] = Field(
        default=(1e-5, 1e-10), description="tolerances of the exact engine", examples=[[1e-5, 1e-10]]
    )
    eps: Positive = Field(default=0.03, description="width of the sigmoid")
    rtol: Tolerance = Field(default=1e-6, description="tolerance of the sigmoid engine, relative and absolute alike")
    t_end: Positive = Field(default=25.0, description="end of each run")
    repeats: Count = Field(default=5, description="number of runs of each")

    def extent(self) -> str:
        return f"{len([*self.cases()])} runs, each beside its limits"

    def cases(self) -> Iterator[tuple[str, Literal["random", "chain"], int, dict[str, Any]]]:
        """Engine in words, kind of system, number of blocks, and settings."""
        exact = [(f"exact, tol = {tol:g}", {"tol": tol}) for tol in self.tolerances]
        smooth = {"engine": "sigmoid", "eps": self.eps, "rtol": self.rtol, "atol": self.rtol}
        for n in self.n:
            for name, settings in exact:
                yield name, "random", n, settings
            yield "sigmoid, r = 1", "random", n, smooth
            yield "sigmoid, r uniform", "random", n, smooth | {"ratio": random_ratios(self.seed, n, 0)}
        for n in self.chain_n:
            for name, settings in exact:
                yield name, "chain", n, settings

    def measure(self, say: Say) -> Measured:
        """Every run in this process, between two measurements of the product."""
        warm()
        systems, rate = ScalingScene(chart="scaling", n=self.n, chain_n=self.chain_n, seed=self.seed), arithmetic()
        costs = []
        for method, kind, n, settings in self.cases():
            system = systems.drawn(kind, n)
            run = partial(sim.simulate, system, Z0, W0, self.t_end, stop_early=False, **settings)
            result, timing = timed(run, Product(system.stiffness), self.repeats)
            entries = int(system.stiffness.size)
            row = Cost(
                systems=kind, n=n, method=method, way=result.stats.method, n_products=result.stats.n_products,
                arithmetic_seconds=2.0 * entries * result.stats.n_products / rate, **asdict(timing),
            )  # fmt: skip
            costs.append(row)
            say(f"{row.name}: {row.over_reading:.3g} times its products, {row.over_arithmetic:.3g} their arithmetic")
        return Measured(costs, rate)

    def show(self, measured: Measured) -> Shown:
        """Table: `costs`."""
        far = sorted(measured.costs, key=lambda row: row.over_reading)
        return Shown(
            {"nearest": far[0], "farthest": far[-1]},
            frames(measured, "costs"),
            {"time_over_limits": partial(time_over_limits, measured.costs)},
        )


@dataclass(frozen=True, kw_only=True)
class Cost(Timing):
    """A run and its limits: a row of the table `costs`; `arithmetic_seconds` are those of its products."""

    systems: str
    n: int
    method: str
    way: str
    n_products: int
    arithmetic_seconds: float

    @property
    def name(self) -> str:
        return f"{'chain, ' * (self.systems == 'chain')}n = {self.n:,}, {self.method}"

    @property
    def over_arithmetic(self) -> float:
        """Time over that of the arithmetic of its products."""
        assert self.seconds is not None
        return self.seconds / self.arithmetic_seconds

    @property
    def over_reading(self) -> float:
        """Time over that of as many products by numpy, or SciPy where K is sparse."""
        assert self.products is not None
        return self.products / self.n_products


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of; `rate` in operations a second."""

    costs: list[Cost]
    rate: float


def arithmetic() -> float:
    """Additions and multiplications a second, of matrices by numpy in float64, on one thread."""
    left = right = np.ones((_ROWS, _ROWS))
    out, seconds = np.empty_like(left), []
    for _ in range(5):
        start = time.perf_counter()
        np.dot(left, right, out=out)
        seconds.append(time.perf_counter() - start)
    return float(2.0 * _ROWS**3 / min(seconds))


@panel(5.6, WIDTH)
def time_over_limits(ax: Axes, costs: Sequence[Cost]) -> None:
    """The time of each run over both limits, a row a run."""
    rows = range(len(costs))
    for values, marker, colour, label in (
        ([row.over_reading for row in costs], "o", CYCLE[0], "over products by numpy"),
        ([row.over_arithmetic for row in costs], "s", CYCLE[1], "over arithmetic"),
    ):
        ax.plot(values, rows, marker, color=colour, markersize=4, label=label)
    ax.axvline(1.0, color=GREY, linewidth=0.8)
    ax.set(xscale="log", xlabel="time of a run over its limit", yticks=rows, yticklabels=[row.name for row in costs])
    ax.invert_yaxis()
    legend([ax], 2)
