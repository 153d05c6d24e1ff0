"""The chart of speed against accuracy: what each method costs and how far off it is.

Cost is counted in products (`cost`). Error is max |z - z_ref| at t_end, for each law against a reference of its own;
an error below what two references agree to is known to be no larger than that, and no more is claimed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, get_args

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pydantic import Field

from stickslip import sim
from stickslip.analysis.style import CYCLE, GREEN, GREY, PURPLE, STYLE, legend, subplots
from stickslip.pipeline.toml import BlockNumbers, Count, Positive
from stickslip.workflows.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.charts.cost import Product, timed
from stickslip.workflows.charts.peers import (
    METHODS,
    GivenUp,
    Method,
    MethodError,
    Model,
    Problem,
    Ratio,
    Solution,
    distance,
    methods_of,
    random_problem,
    reached,
    solved,
    warm,
)
from stickslip.workflows.charts.runner import frame

#: A run that can be stopped is given up after so many times `seconds_a_run`.
PATIENCE = 5.0
#: For each law, method and tolerance of the reference, and of the second computation that checks it: for the sigmoid
#: an independent method; the exact law has no other implementation here, so its truncation is varied.
REFERENCES: dict[Model, tuple[tuple[str, float], tuple[str, float]]] = {
    "coulomb": (("coulomb engine", 1e-15), ("coulomb engine", 1e-13)),
    "sigmoid": (("sigmoid engine", 1e-12), ("SciPy DOP853", 1e-12)),
}
#: Finer tolerances would ask more of a method than its reference gives.
_FINEST, _COARSEST = 1e-11, 5e-3
#: Errors at which methods are compared: the first two in words, all in the table.
TARGETS = (1e-4, 1e-6, 1e-8)
#: What reading K costs a product at least, in products: two vectors share a pass over it, or it is in float32.
_LEAST = 0.5
_OURS = {method.name for method in METHODS if method.is_ours}
_SCIPY = {method.name for method in METHODS if method.is_scipy}

Outcome = Literal["measured", "failed", "too slow", "absent"]


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
    repeats: Count = Field(default=5, description="number of runs of each", examples=[5])
    seconds_a_run: Positive = Field(
        default=1.0, description="seconds of a run after which no finer tolerance is asked", examples=[1.0]
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
        references: list[Reference] = []
        for n in self.n:
            ratios: tuple[Ratio | None, ...] = (None, *self.ratios)  # None: the exact law
            for ratio in ratios:
                problem = self.problem(n, ratio or "one")
                reference, known = _reference(problem, ratio)
                references.append(reference)
                product = Product(np.asarray(problem.system.stiffness))
                for method, settings in methods_of(reference.model, self.tolerances, self.steps):
                    row = Cost(n, ratio, reference.model, method.name, None, None, "measured")
                    if not method.is_installed:
                        found = [replace(row, outcome="absent", reason=f"{method.package} is not installed")]
                    elif known is None:
                        found = [replace(row, outcome="failed", reason=f"no reference: {reference.reason}")]
                    else:
                        found = list(_curve(self, method, problem, known, reference, product, settings, row))
                    costs += found
                    done = sum(cost.outcome == "measured" for cost in found)
                    say(f"n = {n}{f', r {ratio}' if ratio else ''}: {method.name}, {done} of {len(settings)}")
        return Measured(costs, references)

    def show(self, measured: Measured) -> Shown:
        """Tables: `costs`, `at_error`, `references`."""
        panels = _panels(measured)
        at_error = [
            {"n": panel.n, "ratio": panel.ratio, "model": model, "method": name, "error": error, "products": cost}
            for panel in panels
            for model in get_args(Model)
            for error in TARGETS
            for name, cost in panel.at(error, model).items()
        ]
        return Shown(
            {"panels": panels, "targets": TARGETS},
            {
                "costs": frame(measured.costs, Cost),
                "at_error": pd.DataFrame(at_error),
                "references": frame(measured.references, Reference),
            },
            {"error_against_cost": partial(error_against_cost, panels)},
        )


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Cost:
    """One method at one tolerance on one problem: a row of the table `costs`.

    `ratio` is null for the exact law, which has none; `tolerance` for a method of a fixed step, which has `step`
    instead; both where nothing came to be asked; the numbers where the outcome is not "measured". With `is_bound` the
    error is at most `error`. `computed` counts the products with K that the method says it took, null if it does not.
    Its events are those of the reference, block by block, before `parted_at`, their times within `apart`; null are
    both of a method that has no events, and `parted_at` where all are.
    """

    n: int
    ratio: str | None
    model: Model
    method: str
    tolerance: float | None
    step: float | None
    outcome: Outcome
    reason: str | None = None
    error: float | None = None
    is_bound: bool = False
    products: float | None = None
    products_min: float | None = None
    products_max: float | None = None
    computed: int | None = None
    seconds: float | None = None
    seconds_min: float | None = None
    seconds_max: float | None = None
    product_seconds: float | None = None
    n_runs: int = 0
    parted_at: float | None = None
    apart: float | None = None


@dataclass(frozen=True)
class Reference:
    """What the errors of one law on one problem are taken against: a row of the table `references`.

    `floor` is max |z - z_check| at t_end; null, with a reason, if one of the two could not be computed.
    """

    n: int
    ratio: str | None
    model: Model
    reference: str
    check: str
    floor: float | None = None
    n_events: int | None = None
    reason: str | None = None


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    costs: list[Cost]
    references: list[Reference]


def _reference(problem: Problem, ratio: str | None) -> tuple[Reference, Solution | None]:
    """The run as well as it can be had, and how well a second computation agrees."""
    model: Model = "coulomb" if ratio is None else "sigmoid"
    (name, tolerance), (check, check_tolerance) = REFERENCES[model]
    found = Reference(problem.system.n, ratio, model, f"{name} at {tolerance:g}", f"{check} at {check_tolerance:g}")
    try:
        known = solved(name, tolerance, problem)
        floor = distance(known.z, reached(check, check_tolerance, problem))
    except (MethodError, sim.IntegrationError) as error:
        return replace(found, reason=str(error)), None
    return replace(found, floor=floor, n_events=None if known.events is None else len(known.events)), known


def compared(found: sim.EventSeries, known: sim.EventSeries) -> tuple[float | None, float]:
    """When the first block's events are no longer the known ones, if ever, and how far their times are off before."""
    parted, shared = math.inf, []
    for block in range(known.n):
        mine, its = (np.flatnonzero(series.block == block) for series in (found, known))
        n = min(len(mine), len(its))
        alike = np.append(found.mode[mine[:n]] == known.mode[its[:n]], len(mine) == len(its))
        shared.append(np.column_stack([found.t[mine[:n]], known.t[its[:n]]]))
        if not alike.all():
            first = int(np.argmin(alike))
            rest = [
                series.t[events[first]] for series, events in ((found, mine), (known, its)) if first < len(events)
            ]
            parted = min(parted, *rest)
    times = np.vstack(shared)
    times = times[times.max(axis=1) < parted]
    return None if parted == math.inf else parted, float(np.abs(times[:, 0] - times[:, 1]).max(initial=0.0))


def _curve(
    scene: SpeedScene,
    method: Method,
    problem: Problem,
    known: Solution,
    reference: Reference,
    product: Product,
    settings: tuple[float, ...],
    row: Cost,
) -> Iterator[Cost]:
    """One row a tolerance or step, from the coarsest to the finest."""
    solve = method.prepare(problem)
    warm(method, problem, settings[-1])
    too_slow: str | None = None
    for setting in reversed(settings):
        cost = replace(row, step=setting) if method.control == "step" else replace(row, tolerance=setting)
        if too_slow is not None:
            yield replace(cost, outcome="too slow", reason=too_slow)
            continue
        start = time.perf_counter()
        try:
            found, timing = timed(partial(solve, setting), product, scene.repeats, scene.seconds_a_run)
            error = float(np.abs(found.z - known.z).max())
            if not np.isfinite(error):
                raise MethodError("z at t_end is not finite")
        except (MethodError, sim.IntegrationError) as failure:
            took = time.perf_counter() - start
            outcome: Outcome = "too slow" if isinstance(failure, GivenUp) else "failed"
            yield replace(cost, outcome=outcome, reason=str(failure))
        else:
            took, floor = timing.seconds, reference.floor or 0.0
            cost = replace(cost, error=max(error, floor), is_bound=error <= floor, computed=found.n_products)
            if found.events is not None and known.events is not None:
                parted_at, apart = compared(found.events, known.events)
                cost = replace(cost, parted_at=parted_at, apart=apart)
            yield replace(cost, **timing._asdict())
        if took > scene.seconds_a_run:
            too_slow = f"took {took:.2g} s at {setting:g}: more than {scene.seconds_a_run:g} s"


# ---------------------------------------------------------------------------------------------- comparing


def products_at(errors: Sequence[float], products: Sequence[float], target: float) -> float | None:
    """Cost at which a method's error is reliably at most `target`; None if the method did not get there.

    Points are in order of tolerance, from the coarsest. After the last point whose error is above the target the
    cost is read off the line to the next point, log against log; a point below the target by luck, with one above
    it at a finer tolerance, does not count. A later point that is cheaper still does.
    """
    above = [k for k, error in enumerate(errors) if error > target]
    first = above[-1] + 1 if above else 0
    if first == len(errors):
        return None
    found = list(products[first:])
    if above:
        e, c = np.log(errors[first - 1 : first + 1]), np.log(products[first - 1 : first + 1])
        found.append(float(np.exp(c[0] + (c[1] - c[0]) * (np.log(target) - e[0]) / (e[1] - e[0]))))
    return min(found)


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

    def at(self, target: float, model: Model) -> dict[str, float | None]:
        """Products at an error, by method of a law; None where it was not reached."""
        of = [method.name for method in METHODS if method.model == model and method.name in self.curves]
        return {name: products_at(*_points(self.curves[name]), target) for name in of}

    def rows(self) -> list[tuple[str, list[float | None]]]:
        """Products at each target, one row a method."""
        at = [self.at(target, "coulomb") | self.at(target, "sigmoid") for target in TARGETS]
        return [(name, [column[name] for column in at]) for name in at[0]]

    def ranking(self, target: float) -> dict[str, Any]:
        """Who is cheapest at an error, as (products, method): the first, the next, the best of SciPy, our other."""
        ranked = sorted((cost, name) for name, cost in self.at(target, "sigmoid").items() if cost is not None)
        first, following = next(iter(ranked), None), ranked[1:]
        best = next((one for one in following if one[1] in _SCIPY), None)
        ours = next((one for one in following if one[1] in _OURS), None)
        is_apart = first and best and first[1] not in _SCIPY and following[0] != best
        return {
            "first": first,
            "next": next(iter(following), None),
            "scipy": best if is_apart else None,
            "ours": ours,
        }

    def exact(self) -> list[tuple[str, float, float, bool]]:
        """(method, products, error, whether it is an error that was asked for) of the exact law's methods."""
        found = []
        for name, cost in self.at(TARGETS[1], "coulomb").items():
            errors, products = _points(self.curves[name])
            if cost is not None:
                found.append((name, cost, TARGETS[1], True))
            elif errors:
                best = int(np.argmin(errors))
                found.append((name, products[best], errors[best], False))
        return found

    def tolerances(self) -> list[tuple[str, float, float]]:
        """(engine, least, most) of an engine's errors over its tolerances."""
        found = []
        for name in sorted(_OURS & set(self.curves), reverse=True):
            ratios = [cost.error / cost.tolerance for cost in self.curves[name] if cost.error and cost.tolerance]
            found += [(name, min(ratios), max(ratios))] if ratios else []
        return found


def _points(curve: Sequence[Cost]) -> tuple[list[float], list[float]]:
    pairs = [(c.error, c.products) for c in curve if c.error is not None and c.products is not None]
    return [error for error, _ in pairs], [products for _, products in pairs]


def _panels(measured: Measured) -> list[Panel]:
    n_events = {reference.n: reference.n_events for reference in measured.references if reference.ratio is None}
    found = []
    for reference in measured.references:
        if reference.ratio is not None:
            curves: dict[str, list[Cost]] = {}
            for cost in measured.costs:
                if cost.n == reference.n and cost.ratio in (None, reference.ratio):
                    curves.setdefault(cost.method, []).append(cost)
            found.append(Panel(reference.n, reference.ratio, curves, reference.floor, n_events[reference.n]))
    return found


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
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(rows, columns, 0.9 + 2.7 * rows, sharex=True, sharey=True)
        for ax in axes.flat[len(panels) :]:
            ax.set_axis_off()
        for ax, panel in zip(axes.flat, panels, strict=False):
            ax.set(title=panel.title, xscale="log", yscale="log")
            for name in (name for name in names if name in panel.curves):
                done = [cost for cost in panel.curves[name] if cost.error is not None]
                ax.plot([c.products for c in done], [c.error for c in done], label=name, **style[name])
                if bounds := [(c.products, c.error) for c in done if c.is_bound]:
                    hollow = style[name] | {"linestyle": "none", "markerfacecolor": "white", "zorder": 4}
                    ax.plot(*zip(*bounds, strict=True), **hollow)
                if name in _OURS and (least := [(_LEAST * c.computed, c.error) for c in done if c.computed]):
                    ax.plot(*zip(*least, strict=True), color=style[name]["color"], linewidth=0.8)
            if panel.floor is not None:
                ax.axhline(panel.floor, color=GREY, linestyle=":", linewidth=0.8)
            if panel.n_events:
                ax.axvline(panel.n_events, color=GREY, linestyle="--", linewidth=0.8)
        for ax in axes[:, 0]:
            ax.set_ylabel("error, max |z − z$_{ref}$|")
        for ax in axes[-1]:
            ax.set_xlabel("cost, products of K with a vector")
        legend(figure, 5)
    return figure
