"""The chart of stability, measured: where each method stops working, and whether it says so.

A *map* holds one method on one axis of stiffness, a cell for each stiffness and each tolerance or step:

    layer     the sigmoid's equations with mu / delta_i = stiffness for every block (mu = 1)
    bond      the exact law, a spring of that stiffness added between the first two blocks
    damping   the exact law, the damping of the first block times that factor

The error of a cell is max |z - z_ref| at t_end. Its outcome says whether that is what was asked for, less, or wrong
with no word said. Dimensionless but for `patience`.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from stickslip import sim
from stickslip.pipeline.toml import Blocks, Count, Positive, as_tuple, distinct
from stickslip.workflows.charts import ChartScene, Say
from stickslip.workflows.charts.alone import versions
from stickslip.workflows.charts.hard_cases import Verdict, judged
from stickslip.workflows.charts.peers import (
    METHODS,
    Floats,
    GivenUp,
    Method,
    MethodError,
    Model,
    Problem,
    Solver,
    random_problem,
)
from stickslip.workflows.charts.steppers import whole_steps

Axis = Literal["layer", "bond", "damping"]
Outcome = Literal["right", "rough", "wrong", "failed", "too slow", "not judged", "absent"]

#: The law that each axis makes stiff.
LAWS: dict[Axis, Model] = {"layer": "sigmoid", "bond": "coulomb", "damping": "coulomb"}
#: The sigmoid's reference and the method that checks it; coarser tolerances of the second lose the thinnest layers.
_LAYER, _LAYER_CHECK = ("sigmoid engine", 1e-11), ("SciPy Radau", 1e-10)
#: The exact law's reference is the other engine, with layers so thin that the two laws differ by less than is asked.
_WIDTH, _WIDER, _THIN_TOLERANCE = 1e-10, 1e-9, 1e-11
_EXACT_CHECK = ("coulomb engine", 1e-13)
#: Seconds that the check of a reference may take, by an estimate from the column before.
_CHECK_SECONDS = 5.0

Tolerances = Annotated[
    tuple[Annotated[float, Field(ge=1e-9, le=1e-2)], ...], BeforeValidator(as_tuple), AfterValidator(distinct)
]
Steps = Annotated[tuple[Positive, ...], BeforeValidator(as_tuple), AfterValidator(distinct)]


class StabilityScene(ChartScene):
    """A scene with ``chart = "stability"``; dimensionless but for `patience`."""

    chart: Literal["stability"] = Field(description="kind of the chart", examples=["stability"])
    title: str = Field(default="Where methods stop working", description="one line for the report's head")
    n: Blocks = Field(description="number of blocks", examples=[20])
    t_end: Positive = Field(description="end of each run", examples=[10.0])
    stiffness: Annotated[
        tuple[Annotated[float, Field(gt=1, le=1e9)], ...], BeforeValidator(as_tuple), AfterValidator(distinct)
    ] = Field(min_length=1, description="values of mu / delta, the stiffness of the layer", examples=[[10.0, 1e4]])
    factors: Annotated[
        tuple[Annotated[float, Field(ge=1, le=1e9)], ...], BeforeValidator(as_tuple), AfterValidator(distinct)
    ] = Field(
        default=(),
        description="stiffnesses of the bond, and factors of one block's damping; none leaves the exact law out",
        examples=[[1.0, 1e4]],
    )
    tolerances: Tolerances = Field(
        min_length=1, description="tolerances asked of each method", examples=[[1e-3, 1e-6]]
    )
    steps: Steps = Field(
        default=(), description="steps of the methods of a fixed step; none leaves them out", examples=[[0.1, 0.01]]
    )
    factor: Annotated[float, Field(ge=1)] = Field(
        default=10.0, description="error over tolerance up to which a run is right", examples=[10.0]
    )
    right_below: Positive = Field(
        default=1e-3, description="error up to which a run of a fixed step is right", examples=[1e-3]
    )
    wrong_above: Positive = Field(
        default=1e-2, description="error above which a run that reports success is wrong", examples=[1e-2]
    )
    patience: Positive = Field(default=0.5, description="seconds after which a run is too slow", examples=[0.5])
    max_steps: Count = Field(
        default=100_000, description="number of fixed steps beyond which a run is not started", examples=[100_000]
    )
    cases: bool = Field(default=True, description="whether to run the hard cases too", examples=[True])

    @model_validator(mode="after")
    def _classes_in_order(self) -> StabilityScene:
        least = max(self.factor * self.tolerances[-1], self.right_below if self.steps else 0.0)
        if self.wrong_above < least * (1 - 1e-12):
            raise ValueError(
                f"wrong_above: expected at least {least:g}, the largest error that is right, got"
                f" {self.wrong_above:g}; raise it, or ask for finer tolerances"
            )
        return self

    def problem(self, axis: Axis, stiffness: float) -> Problem:
        """Matrix 0 of an ensemble with this seed, made stiff."""
        width = 1.0 / stiffness if axis == "layer" else _WIDTH
        problem = random_problem(self.seed, self.n, self.t_end, width, "one", patience=self.patience)
        system = problem.system
        matrix, damping = np.array(system.stiffness), np.array(system.damping)
        if axis == "bond":
            matrix[:2, :2] += stiffness * np.array([[1.0, -1.0], [-1.0, 1.0]])[: self.n, : self.n]
        elif axis == "damping":
            damping[0] *= stiffness
        return replace(problem, system=sim.System(matrix, damping, system.friction, system.belt_speed))

    @property
    def axes(self) -> dict[Axis, tuple[float, ...]]:
        """The columns of each axis's maps."""
        exact: dict[Axis, tuple[float, ...]] = {"bond": self.factors, "damping": self.factors} if self.factors else {}
        return {"layer": self.stiffness, **exact}


# ---------------------------------------------------------------------------------------------- what is kept


@dataclass(frozen=True)
class Cell:
    """One method at one stiffness and one setting: a row of the table `cells`.

    `tolerance` is null for a method of a fixed step, which has `step` instead, both for one that is absent; `error`
    is null where there is no finite z, `seconds` where nothing was run.
    """

    axis: Axis
    stiffness: float
    method: str
    tolerance: float | None
    step: float | None
    outcome: Outcome
    error: float | None = None
    reason: str | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Reference:
    """What the errors of one column are taken against: a row of the table `references`.

    `floor` is max |z - z_check| at t_end; `to_exact` is max |z - z| to the exact law's run, that is what the sigmoid
    itself is off by; null, with a reason, where they could not be computed.
    """

    axis: Axis
    stiffness: float
    reference: str
    check: str
    floor: float | None = None
    to_exact: float | None = None
    reason: str | None = None


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of; plain values, which JSON carries."""

    cells: list[Cell]
    references: list[Reference]
    cases: list[Verdict]
    versions: dict[str, str]

    @classmethod
    def restore(cls, found: dict[str, Any]) -> Measured:
        return cls(
            [Cell(**row) for row in found["cells"]],
            [Reference(**row) for row in found["references"]],
            [Verdict(**row) for row in found["cases"]],
            found["versions"],
        )


# ---------------------------------------------------------------------------------------------- measuring


def measure(scene: StabilityScene, say: Say) -> Measured:
    """Fill every map and judge every hard case, in this process; `say` is told of each as it is done."""
    cells: list[Cell] = []
    references: list[Reference] = []
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # methods at their limits overflow and warn; what came of it is in the cell
        for axis, columns in scene.axes.items():
            problems = [scene.problem(axis, stiffness) for stiffness in columns]
            found = _references(axis, columns, problems)
            references += [reference for reference, _ in found]
            say(f"{axis}: references of {len(columns)} columns")
            for method in METHODS:
                settings = scene.steps if method.control == "step" else scene.tolerances
                if method.model != LAWS[axis] or not settings:
                    continue
                rows = list(_map(scene, axis, method, problems, columns, found, settings))
                cells += rows
                right = sum(cell.outcome == "right" for cell in rows)
                say(f"{axis}: {method.name}, {right} of {len(rows)} right")
        cases = judged(scene.patience, say) if scene.cases else []
    return Measured(cells, references, cases, versions("scipy", "CyRK", "scikit-sundae"))


def _method(name: str) -> Method:
    return next(method for method in METHODS if method.name == name)


def _references(
    axis: Axis, columns: Sequence[float], problems: Sequence[Problem]
) -> list[tuple[Reference, Floats | None]]:
    """z at t_end as well as it can be had, column by column, and how well a second computation agrees."""
    found: list[tuple[Reference, Floats | None]] = []
    took, before = 0.0, columns[0]  # of the exact law's check, one column back
    for stiffness, problem in zip(columns, problems, strict=True):
        patient = replace(problem, patience=math.inf)
        name, tolerance = _LAYER if axis == "layer" else ("sigmoid engine", _THIN_TOLERANCE)
        words = f"{name} at {tolerance:g}" + ("" if axis == "layer" else f", delta = {_WIDTH:g}")
        is_exact = took * stiffness / before <= _CHECK_SECONDS
        if axis == "layer":
            (check, check_tolerance), other = _LAYER_CHECK, patient
        elif is_exact:
            (check, check_tolerance), other = _EXACT_CHECK, patient
        else:  # nothing else gets there: the same engine with other layers
            check, check_tolerance = name, tolerance
            other = replace(patient, delta=np.full(patient.system.n, _WIDER))
        wider = "" if other is patient else f", delta = {_WIDER:g}"
        row = Reference(axis, stiffness, words, f"{check} at {check_tolerance:g}{wider}")
        z: Floats | None = None
        try:
            reached = _method(name).prepare(patient)(tolerance).z
            start = time.perf_counter()
            checked = _method(check).prepare(other)(check_tolerance).z
            if axis != "layer" and is_exact:
                took, before = time.perf_counter() - start, stiffness
            row = replace(row, floor=float(max(np.abs(reached - checked).max(), np.spacing(np.abs(reached).max()))))
            z = reached
            if axis == "layer":
                exact = _method("coulomb engine").prepare(patient)(_EXACT_CHECK[1]).z
                row = replace(row, to_exact=float(np.abs(reached - exact).max()))
        except (MethodError, sim.IntegrationError) as error:
            row = replace(row, reason=str(error))
        found.append((row, z))
    return found


def _map(
    scene: StabilityScene,
    axis: Axis,
    method: Method,
    problems: Sequence[Problem],
    columns: Sequence[float],
    references: Sequence[tuple[Reference, Floats | None]],
    settings: tuple[float, ...],
) -> Iterator[Cell]:
    """The cells of one method, row by row from the coarsest setting, each row from the mildest column."""
    is_step = method.control == "step"
    if not method.is_installed:
        yield Cell(axis, columns[0], method.name, None, None, "absent", reason=f"{method.package} is not installed")
        return
    solvers = [method.prepare(problem) for problem in problems]  # what is compiled there is not timed
    with suppress(MethodError, sim.IntegrationError):  # nor what is compiled at a first call
        method.prepare(replace(problems[0], t_end=1e-3 * scene.t_end))(settings[-1])
    for setting in reversed(settings):
        took, before = 0.0, columns[0]
        for stiffness, solve, (reference, z) in zip(columns, solvers, references, strict=True):
            asked = Cell(axis, stiffness, method.name, None, None, "not judged")
            asked = replace(asked, step=setting) if is_step else replace(asked, tolerance=setting)
            n_steps = whole_steps(scene.t_end, setting) if is_step else 0
            expected = took * stiffness / before
            if z is None or reference.floor is None:
                yield replace(asked, reason=f"no reference: {reference.reason}")
            elif n_steps > scene.max_steps:
                yield replace(asked, outcome="too slow", reason=f"not started: {n_steps:,} steps")
            elif not _can_be_stopped(method) and expected > scene.patience:
                reason = f"not started: took {took:.2g} s at {before:g}, and cost may grow with the stiffness"
                yield replace(asked, outcome="too slow", reason=reason)
            else:
                cell = classified(scene, solve, setting, z, reference.floor, asked)
                if cell.seconds is not None:
                    took, before = cell.seconds, stiffness
                yield cell


def _can_be_stopped(method: Method) -> bool:
    """Whether it calls back to Python or, with a fixed step, says before how long it is."""
    return method.control == "step" or not (method.is_ours or method.package == "CyRK")


def classified(scene: StabilityScene, solve: Solver, setting: float, z: Floats, floor: float, cell: Cell) -> Cell:
    """Run a method once and say what came of it.

    Right: the error is at most `factor` times the tolerance, or `right_below` for a fixed step. Wrong: it is above
    `wrong_above`, or no number at all, and the method reports success. Rough: between.
    """
    promised = scene.right_below if cell.tolerance is None else scene.factor * cell.tolerance
    start = time.perf_counter()
    try:
        reached = solve(setting).z
    except GivenUp as error:
        return replace(cell, outcome="too slow", reason=str(error), seconds=time.perf_counter() - start)
    except (MethodError, sim.IntegrationError) as error:
        return replace(cell, outcome="failed", reason=str(error), seconds=time.perf_counter() - start)
    cell = replace(cell, seconds=time.perf_counter() - start)
    if not np.isfinite(reached).all():
        return replace(cell, outcome="wrong", reason="z at t_end is not finite, returned as a success")
    apart = float(np.abs(reached - z).max())
    cell = replace(cell, error=max(apart, floor))
    if floor > promised:
        return replace(cell, outcome="not judged", reason=f"the references agree to {floor:.1e} only")
    if apart <= promised:
        return replace(cell, outcome="right")
    return replace(cell, outcome="wrong" if apart > scene.wrong_above else "rough")
