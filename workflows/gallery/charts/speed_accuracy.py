"""The chart of speed against accuracy: what each method costs and how far off it is.

Cost is counted in products (`cost`). Error is max |z - z_ref| at t_end, for each law against a reference of its own;
an error below what two references agree to is known to be no larger than that, and no more is claimed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pydantic import Field

from stickslip.analysis.by_key import by_key
from stickslip.analysis.style import CYCLE, GREEN, GREY, PURPLE, WIDTH, legend, panel
from stickslip.pipeline.scene.toml import BlockNumbers, Count, Positive
from stickslip.workflows.gallery.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.gallery.charts.cost import Product
from stickslip.workflows.gallery.charts.formats import power
from stickslip.workflows.gallery.charts.peers import METHODS, Model, Problem, Ratio, methods_of, random_problem
from stickslip.workflows.gallery.charts.runner import frames
from stickslip.workflows.gallery.charts.trials import Reference, Setting, Trial, referenced, trials

#: A run that can be stopped is given up after so many times `seconds_a_run`.
PATIENCE = 5.0
#: For each law, method and tolerance of the reference, and of the second computation that checks it: for the sigmoid
#: an independent method; the exact law's other methods are coarser, so its truncation is varied.
REFERENCES: dict[Model, tuple[Setting, Setting]] = {
    "coulomb": (("coulomb engine", 1e-15), ("coulomb engine", 1e-13)),
    "sigmoid": (("sigmoid engine", 1e-12), ("SciPy DOP853", 1e-12)),
}
#: Finer tolerances would ask more of a method than its reference gives.
_FINEST, _COARSEST = 1e-11, 5e-3
#: Errors at which methods are compared: the first two in the answer, all in the table.
TARGETS = (1e-4, 1e-6, 1e-8)
#: What reading K costs a product at least, in products: two vectors share a pass over it, or it is in float32.
_LEAST = 0.5
_OURS = {method.name for method in METHODS if method.is_ours}


class SpeedScene(ChartScene):
    """A scene with ``chart = "speed_accuracy"``; dimensionless but for `seconds_a_run`."""

    libraries = ("scipy", "CyRK", "scikit-sundae", "diffrax")

    chart: Literal["speed_accuracy"] = Field(description="kind of the chart", examples=["speed_accuracy"])
    title: str = Field(default="Speed against accuracy", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks, or a list of numbers", examples=[[20, 200]])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(description="width of the sigmoid", examples=[0.03])
    ratios: Several[Ratio] = Field(min_length=1, description="stiffness ratios r_i", examples=[["one", "uniform"]])
    t_end: Positive = Field(description="end of each run", examples=[25.0])
    tolerances: Several[Annotated[float, Field(ge=_FINEST, le=_COARSEST)]] = Field(
        min_length=1, description="tolerances asked of each method", examples=[[1e-4, 1e-6]]
    )
    steps: Several[Positive] = Field(
        default=(), description="steps of the methods of a fixed step; none leaves them out", examples=[[0.1, 0.01]]
    )
    repeats: Count = Field(default=5, description="number of runs of each")
    seconds_a_run: Positive = Field(
        default=1.0, description="seconds of a run after which no finer tolerance is asked"
    )

    def problem(self, n: int, ratio: Ratio) -> Problem:
        """The system of matrix 0 of an ensemble with this seed, and its first draw of the ratios."""
        patience = PATIENCE * self.seconds_a_run
        return random_problem(self.seed, n, self.t_end, self.eps, ratio, patience=patience)

    def extent(self) -> str:
        return f"{len(METHODS)} methods on {len(self.n) * (1 + len(self.ratios))} problems"

    def measure(self, say: Say) -> Measured:
        """Run every method on every problem."""
        costs: list[Cost] = []
        references: list[Standard] = []
        for n in self.n:
            ratios: tuple[Ratio | None, ...] = (None, *self.ratios)  # None: the exact law
            for ratio in ratios:
                model: Model = "coulomb" if ratio is None else "sigmoid"
                problem = self.problem(n, ratio or "one")
                standard, solution = referenced(Standard(n=n, ratio=ratio, model=model), *REFERENCES[model], problem)
                references.append(standard)
                product, row = Product(np.asarray(problem.system.stiffness)), Cost(n=n, ratio=ratio, model=model)
                setup = (problem, standard, solution)
                for method, settings in methods_of(model, self.tolerances, self.steps):
                    rows = list(trials(row, method, *setup, settings, self.seconds_a_run, product, self.repeats))
                    costs += rows
                    n_measured = sum(cost.outcome == "measured" for cost in rows)
                    say(f"n = {n}{f', r {ratio}' if ratio else ''}: {method.name}, {n_measured} of {len(settings)}")
        return Measured(costs, references)

    def show(self, measured: Measured) -> Shown:
        """Tables: `costs`, `at_error`, `references`."""
        panels = _panels(measured)
        at_error = [
            {"n": panel.n, "ratio": panel.ratio, "model": row["model"], "method": row["method"], "error": error,
             "products": row[power(error)]}
            for panel in panels for row in panel.at_error for error in TARGETS
        ]  # fmt: skip
        return Shown(
            {"panels": panels, "targets": TARGETS},
            frames(measured, "costs", "references") | {"at_error": pd.DataFrame(at_error)},
            {"error_against_cost": partial(error_against_cost, panels)},
        )


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True, kw_only=True)
class Cost(Trial):
    """One method at one tolerance or step: a row of the table `costs`; `ratio` is null for the exact law."""

    n: int
    ratio: str | None
    model: Model


@dataclass(frozen=True, kw_only=True)
class Standard(Reference):
    """The reference of one law on one problem: a row of the table `references`."""

    n: int
    ratio: str | None
    model: Model


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    costs: list[Cost]
    references: list[Standard]


# ---------------------------------------------------------------------------------------------- comparing


def products_at(errors: Sequence[float], products: Sequence[float], target: float) -> float | None:
    """Cost at which a method's error is reliably at most `target`; None if the method did not get there.

    Points are in order of tolerance, from the coarsest. After the last point whose error is above the target the
    cost is read off the line to the next point, log against log; a point below the target by luck, with one above
    it at a finer tolerance, does not count. A later point that is cheaper still does.
    """
    above = [k for k, error in enumerate(errors) if error > target]
    start = above[-1] + 1 if above else 0
    if start == len(errors):
        return None
    costs = list(products[start:])
    if above:
        e, c = np.log(errors[start - 1 : start + 1]), np.log(products[start - 1 : start + 1])
        costs.append(float(np.exp(c[0] + (c[1] - c[0]) * (np.log(target) - e[0]) / (e[1] - e[0]))))
    return min(costs)


@dataclass(frozen=True)
class Panel:
    """One problem: the sigmoid at one n and ratio, beside the exact law at that n; curves of measured points."""

    n: int
    ratio: str
    curves: dict[str, list[Cost]]
    floor: float | None
    n_events: int | None

    @property
    def title(self) -> str:
        return f"n = {self.n}, {'r = 1' if self.ratio == 'one' else 'r uniform in (0, 1]'}"

    @property
    def at_error(self) -> list[dict[str, Any]]:
        """Of each method its law, and by error of `TARGETS` its products; None where it did not get there."""
        return [
            {"method": method.name, "model": method.model}
            | {power(error): products_at(*_points(self.curves[method.name]), error) for error in TARGETS}
            for method in METHODS
            if method.name in self.curves
        ]

    def ranking(self, error: float) -> list[tuple[float, str]]:
        """(products, method) at an error, of the methods of the sigmoid that got there, the cheapest first."""
        rows = [row for row in self.at_error if row["model"] == "sigmoid"]
        return sorted((row[power(error)], row["method"]) for row in rows if row[power(error)] is not None)

    def tolerances(self) -> list[tuple[str, float, float]]:
        """(engine, least, most) of an engine's errors over its tolerances."""
        rows = []
        for name in (method.name for method in METHODS if method.is_ours):
            ratios = [c.error / c.tolerance for c in self.curves.get(name, ()) if c.error and c.tolerance]
            rows += [(name, min(ratios), max(ratios))] if ratios else []
        return rows


def _points(curve: Sequence[Cost]) -> tuple[list[float], list[float]]:
    pairs = [(c.error, c.products) for c in curve if c.error is not None and c.products is not None]
    return [error for error, _ in pairs], [products for _, products in pairs]


def _panels(measured: Measured) -> list[Panel]:
    n_events = {reference.n: reference.n_events for reference in measured.references if reference.ratio is None}
    panels = []
    for reference in measured.references:
        if reference.ratio is not None:
            costs = [c for c in measured.costs if c.n == reference.n and c.ratio in (None, reference.ratio)]
            curves = by_key(costs, lambda cost: cost.method)
            panels.append(Panel(reference.n, reference.ratio, curves, reference.floor, n_events[reference.n]))
    return panels


# ---------------------------------------------------------------------------------------------- the figure

_PEERS = (GREEN, PURPLE, "#E69F00", "#56B4E9", GREY, "black")
_MARKERS = "^vDPX<>phd"


def error_against_cost(panels: Sequence[Panel]) -> Figure:
    """One panel a problem, the engines in the foreground.

    An error that is a bound is drawn hollow, the least that an engine's products could cost as a thin line; dotted is
    the floor of the errors, dashed one product an event.
    """
    names = list(dict.fromkeys(name for panel in panels for name, curve in panel.curves.items() if _points(curve)[0]))
    style: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(name for name in names if name in _OURS):
        style[name] = {"color": CYCLE[k % 2], "marker": "os"[k % 2], "linewidth": 2.2, "markersize": 5, "zorder": 3}
    for k, name in enumerate(name for name in names if name not in _OURS):
        look = {"color": _PEERS[k % 6], "marker": _MARKERS[k % 10], "linestyle": "-" if k < 6 else "--"}
        style[name] = look | {"linewidth": 0.9, "markersize": 4}
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    grid = {"nrows": rows, "ncols": columns, "sharex": True, "sharey": True, "squeeze": False}
    return panel(0.9 + 2.7 * rows, WIDTH, **grid)(_draw)(panels, {name: style[name] for name in names})


def _draw(axes: np.ndarray, panels: Sequence[Panel], style: Mapping[str, dict[str, Any]]) -> None:
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for ax, problem in zip(axes.flat, panels, strict=False):
        ax.set(title=problem.title, xscale="log", yscale="log")
        for name in (name for name in style if name in problem.curves):
            points = [cost for cost in problem.curves[name] if cost.error is not None]
            ax.plot([c.products for c in points], [c.error for c in points], label=name, **style[name])
            if bounds := [(c.products, c.error) for c in points if c.is_bound]:
                hollow = style[name] | {"linestyle": "none", "markerfacecolor": "white", "zorder": 4}
                ax.plot(*zip(*bounds, strict=True), **hollow)
            if name in _OURS and (floor := [(_LEAST * c.computed, c.error) for c in points if c.computed]):
                ax.plot(*zip(*floor, strict=True), color=style[name]["color"], linewidth=0.8)
        if problem.floor is not None:
            ax.axhline(problem.floor, color=GREY, linestyle=":", linewidth=0.8)
        if problem.n_events:
            ax.axvline(problem.n_events, color=GREY, linestyle="--", linewidth=0.8)
    for ax in axes[:, 0]:
        ax.set_ylabel("error, max |z − z$_{ref}$|")
    for ax in axes[-1]:
        ax.set_xlabel("cost, products of K with a vector")
    legend(axes.flat, 4)
