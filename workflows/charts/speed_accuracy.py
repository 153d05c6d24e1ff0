"""The chart of speed against accuracy, measured: what each method costs and how far off it is.

Cost is counted in *products*: the wall time of a run over that of one product of an n x n float64 matrix with a
vector (numpy), measured just before and just after the run, so that a drifting machine cancels. Error is
max |z - z_ref| at t_end, for each law against a reference of its own; an error below what two references agree to
is known to be no larger than that, and no more is claimed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import median
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from stickslip import sim
from stickslip.pipeline.toml import BlockNumbers, Count, Positive, as_tuple, distinct
from stickslip.workflows.charts import ChartScene, Say
from stickslip.workflows.charts.alone import Product, versions
from stickslip.workflows.charts.peers import (
    METHODS,
    Floats,
    GivenUp,
    Method,
    MethodError,
    Model,
    Problem,
    Ratio,
    Solver,
    random_problem,
)

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

Outcome = Literal["measured", "failed", "too slow", "absent"]


class SpeedScene(ChartScene):
    """A scene with ``chart = "speed_accuracy"``; dimensionless but for `seconds_a_run`."""

    chart: Literal["speed_accuracy"] = Field(description="kind of the chart", examples=["speed_accuracy"])
    title: str = Field(default="Speed against accuracy", description="one line for the report's head")
    n: BlockNumbers = Field(description="number of blocks, or a list of numbers", examples=[[20, 200]])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(description="width of the sigmoid", examples=[0.03])
    ratios: Annotated[tuple[Ratio, ...], BeforeValidator(as_tuple), AfterValidator(distinct)] = Field(
        min_length=1, description="stiffness ratios r_i", examples=[["one", "uniform"]]
    )
    t_end: Positive = Field(description="end of each run", examples=[25.0])
    tolerances: Annotated[
        tuple[Annotated[float, Field(ge=_FINEST, le=_COARSEST)], ...],
        BeforeValidator(as_tuple),
        AfterValidator(distinct),
    ] = Field(min_length=1, description="tolerances asked of each method", examples=[[1e-4, 1e-6]])
    steps: Annotated[tuple[Positive, ...], BeforeValidator(as_tuple), AfterValidator(distinct)] = Field(
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


# ---------------------------------------------------------------------------------------------- what is kept


@dataclass(frozen=True)
class Cost:
    """One method at one tolerance on one problem: a row of the table `costs`.

    `ratio` is null for the exact law, which has none; `tolerance` for a method of a fixed step, which has `step`
    instead; both where nothing came to be asked; the numbers where the outcome is not "measured". With `is_bound` the
    error is at most `error`. `computed` counts the products with K that the method says it took, null if it does not.
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
    product_seconds: float | None = None
    n_runs: int = 0


@dataclass(frozen=True)
class Reference:
    """What the errors of one law on one problem are taken against: a row of the table `references`.

    `floor` is max |z - z_check| at t_end; null, with a reason, if one of the two could not be computed.
    `n_events` counts the events of the exact law; null for the sigmoid.
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
    """All that the chart is made of; plain values, which JSON carries."""

    costs: list[Cost]
    references: list[Reference]
    versions: dict[str, str]

    @classmethod
    def restore(cls, found: dict[str, Any]) -> Measured:
        costs, references = (
            [Cost(**row) for row in found["costs"]],
            [Reference(**row) for row in found["references"]],
        )
        return cls(costs, references, found["versions"])


# ---------------------------------------------------------------------------------------------- measuring


def measure(scene: SpeedScene, say: Say) -> Measured:
    """Run every method on every problem of a scene, in this process; `say` is told of each as it is done."""
    costs: list[Cost] = []
    references: list[Reference] = []
    for n in scene.n:
        ratios: tuple[Ratio | None, ...] = (None, *scene.ratios)  # None: the exact law
        for ratio in ratios:
            model: Model = "coulomb" if ratio is None else "sigmoid"
            problem = scene.problem(n, ratio or "one")
            reference, z = _reference(problem, model, ratio)
            references.append(reference)
            product = Product(np.asarray(problem.system.stiffness))
            for method in METHODS:
                settings = scene.steps if method.control == "step" else scene.tolerances
                if method.model != model or not settings:
                    continue
                row = Cost(n, ratio, model, method.name, None, None, "measured")
                if not method.is_installed:
                    found = [replace(row, outcome="absent", reason=f"{method.package} is not installed")]
                elif z is None or reference.floor is None:
                    found = [replace(row, outcome="failed", reason=f"no reference: {reference.reason}")]
                else:
                    found = list(_curve(method, problem, z, reference.floor, product, scene, settings, row))
                costs += found
                done = sum(cost.outcome == "measured" for cost in found)
                say(f"n = {n}{f', r {ratio}' if ratio else ''}: {method.name}, {done} of {len(settings)}")
    return Measured(costs, references, versions("scipy", "CyRK", "scikit-sundae"))


def _reference(problem: Problem, model: Model, ratio: str | None) -> tuple[Reference, Floats | None]:
    """z at t_end as well as it can be had, and how well a second computation agrees."""
    patient = replace(problem, patience=math.inf)
    (name, tolerance), (check, check_tolerance) = REFERENCES[model]
    found = Reference(problem.system.n, ratio, model, f"{name} at {tolerance:g}", f"{check} at {check_tolerance:g}")
    try:
        z = _method(name).prepare(patient)(tolerance).z
        apart = np.abs(z - _method(check).prepare(patient)(check_tolerance).z).max()
        if model == "coulomb":
            run = sim.simulate(problem.system, problem.z0, problem.w0, problem.t_end, tol=tolerance)
            found = replace(found, n_events=run.stats.n_events)
    except (MethodError, sim.IntegrationError) as error:
        return replace(found, reason=str(error)), None
    # two computations may agree to the bit; no error below rounding is claimed all the same
    return replace(found, floor=float(max(apart, np.spacing(np.abs(z).max())))), z


def _method(name: str) -> Method:
    return next(method for method in METHODS if method.name == name)


def _curve(
    method: Method,
    problem: Problem,
    z: Floats,
    floor: float,
    product: Product,
    scene: SpeedScene,
    settings: tuple[float, ...],
    row: Cost,
) -> Iterator[Cost]:
    """One row a tolerance or step, from the coarsest to the finest."""
    solve = method.prepare(problem)
    short = replace(problem, t_end=1e-3 * problem.t_end)
    with suppress(MethodError, sim.IntegrationError):  # what fails here fails again below, and is kept there
        method.prepare(short)(settings[-1])  # what is compiled or loaded at a first call is not timed
    too_slow: str | None = None
    for setting in reversed(settings):
        is_step = method.control == "step"
        asked = replace(row, step=setting) if is_step else replace(row, tolerance=setting)
        if too_slow is not None:
            yield replace(asked, outcome="too slow", reason=too_slow)
            continue
        start = time.perf_counter()
        try:
            found = _timed(solve, setting, z, floor, product, scene, asked)
        except GivenUp as error:
            found = replace(asked, outcome="too slow", reason=str(error))
        except (MethodError, sim.IntegrationError) as error:
            found = replace(asked, outcome="failed", reason=str(error))
        took = time.perf_counter() - start if found.seconds is None else found.seconds
        if took > scene.seconds_a_run:
            too_slow = f"took {took:.2g} s at {setting:g}: more than {scene.seconds_a_run:g} s"
        yield found


def _timed(
    solve: Solver, setting: float, z: Floats, floor: float, product: Product, scene: SpeedScene, row: Cost
) -> Cost:
    """Repeated runs at one setting, each between two measurements of the product."""
    seconds: list[float] = []
    units: list[float] = []
    while len(seconds) < scene.repeats and (not seconds or seconds[-1] <= scene.seconds_a_run):
        before = product.seconds()
        start = time.perf_counter()
        reached = solve(setting)
        seconds.append(time.perf_counter() - start)
        units.append(0.5 * (before + product.seconds()))
    error = float(np.abs(reached.z - z).max())
    if not math.isfinite(error):
        raise MethodError("z at t_end is not finite")
    products = [run / unit for run, unit in zip(seconds, units, strict=True)]
    return replace(
        row,
        error=max(error, floor),
        is_bound=error <= floor,
        products=median(products),
        products_min=min(products),
        products_max=max(products),
        computed=reached.n_products,
        seconds=median(seconds),
        product_seconds=median(units),
        n_runs=len(seconds),
    )
