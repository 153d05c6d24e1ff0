"""The chart of stability: where each method stops working, and whether it says so.

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
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Annotated, Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from pydantic import Field, model_validator

from stickslip import sim
from stickslip.analysis.answer import Recipe
from stickslip.analysis.style import GREY, STYLE, subplots
from stickslip.pipeline.toml import Blocks, Count, Positive
from stickslip.sim.engines.moreau import whole_steps
from stickslip.workflows.charts import ChartScene, Say, Several, Shown, hard_cases, slope
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
    distance,
    methods_of,
    random_problem,
    reached,
    warm,
)
from stickslip.workflows.charts.runner import frame
from stickslip.workflows.charts.slope import Creep, creep

Axis = Literal["layer", "bond", "damping"]
Outcome = Literal["right", "rough", "wrong", "failed", "too slow", "not judged", "absent"]

#: The law that each axis makes stiff.
LAWS: dict[Axis, Model] = {"layer": "sigmoid", "bond": "coulomb", "damping": "coulomb"}
#: The sigmoid's reference and the method that checks it; coarser tolerances of the second lose the thinnest layers.
_LAYER, _LAYER_CHECK = ("sigmoid engine", 1e-11), ("SciPy Radau", 1e-10)
#: The exact law's reference is the other engine, with layers so thin that the two laws differ by less than is asked.
_WIDTH, _WIDER, _THIN = 1e-10, 1e-9, ("sigmoid engine", 1e-11)
_EXACT_CHECK = ("coulomb engine", 1e-13)
#: Seconds that the check of a reference may take, by an estimate from the column before.
_CHECK_SECONDS = 5.0
#: What each axis is called along its maps, and the figures: each the maps of one law.
_XLABELS: dict[Axis, str] = {
    "layer": "stiffness μ / δ",
    "bond": "stiffness of one bond",
    "damping": "factor of one damping",
}
_FIGURES: dict[str, tuple[Axis, ...]] = {"The smoothed law": ("layer",), "The exact law": ("bond", "damping")}
#: RK4 is stable on y' = -k y for h k below this: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II.
_RK4_LIMIT = 2.785293563
#: The shares of a limit within which, and beyond which, cells of a fixed step are told apart.
_WITHIN, _BEYOND = 0.5, 2.0
#: Explicit methods whose step is set by stability once the layer is stiff: cost grows as the stiffness.
_EXPLICIT = ("CyRK DOP853", "SciPy DOP853", "SciPy RK45")


class StabilityScene(ChartScene):
    """A scene with ``chart = "stability"``; dimensionless but for `patience`."""

    libraries = ("scipy", "CyRK", "scikit-sundae", "diffrax", "mujoco")

    chart: Literal["stability"] = Field(description="kind of the chart", examples=["stability"])
    title: str = Field(default="Where methods stop working", description="one line for the report's head")
    n: Blocks = Field(description="number of blocks", examples=[20])
    t_end: Positive = Field(description="end of each run", examples=[10.0])
    stiffness: Several[Annotated[float, Field(gt=1, le=1e9)]] = Field(
        min_length=1, description="values of mu / delta, the stiffness of the layer", examples=[[10.0, 1e4]]
    )
    factors: Several[Annotated[float, Field(ge=1, le=1e9)]] = Field(
        default=(),
        description="stiffnesses of the bond, and factors of one block's damping; none leaves the exact law out",
        examples=[[1.0, 1e4]],
    )
    tolerances: Several[Annotated[float, Field(ge=1e-9, le=1e-2)]] = Field(
        min_length=1, description="tolerances asked of each method", examples=[[1e-3, 1e-6]]
    )
    steps: Several[Positive] = Field(
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

    def extent(self) -> str:
        found = sum(
            len(columns) * len(settings)
            for axis, columns in self.axes.items()
            for _, settings in methods_of(LAWS[axis], self.tolerances, self.steps)
        )
        return f"{found} cells{' and the hard cases' if self.cases else ''}"

    def measure(self, say: Say) -> Measured:
        """Fill every map and judge every hard case."""
        cells: list[Cell] = []
        references: list[Reference] = []
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # methods at their limits overflow and warn; what came of it is kept
            for axis, columns in self.axes.items():
                problems = [self.problem(axis, stiffness) for stiffness in columns]
                found = _references(axis, columns, problems)
                references += [reference for reference, _ in found]
                say(f"{axis}: references of {len(columns)} columns")
                for method, settings in methods_of(LAWS[axis], self.tolerances, self.steps):
                    rows = list(_map(self, axis, method, problems, found, settings))
                    cells += rows
                    right = sum(cell.outcome == "right" for cell in rows)
                    say(f"{axis}: {method.name}, {right} of {len(rows)} right")
            cases = judged(self.patience, say) if self.cases else []
        return Measured(cells, references, cases, creep(say) if self.cases else [])

    def show(self, measured: Measured) -> Shown:
        """Tables: `cells`, `references`, `cases`, `creep`."""
        groups = {axis: maps for axis in LAWS if (maps := _maps(measured.cells, axis))}
        figures: dict[str, Recipe] = {}
        pictures = []
        for title, axes in _FIGURES.items():
            if drawn := [one for axis in axes for one in groups.get(axis, [])]:
                pictures.append((title, f"stability_maps_{len(figures) + 1}"))
                figures[pictures[-1][1]] = partial(stability_maps, drawn)
        cases: dict[str, dict[str, Verdict]] = {}
        for case in measured.cases:
            cases.setdefault(case.case, {})[case.method] = case
        facts = {
            "groups": {axis: _group(self, axis, maps) for axis, maps in groups.items()},
            "short": _in_short([one for maps in groups.values() for one in maps], measured.cases),
            "answers": _answers(measured.cases),
            "pictures": pictures,
            "known": hard_cases,
            "slope": slope,
            "cases": cases,
        }
        tables = {
            "cells": frame(measured.cells, Cell),
            "references": frame(measured.references, Reference),
            "cases": frame(measured.cases, Verdict),
            "creep": frame(measured.creep, Creep),
        }
        return Shown(facts, tables, figures)


# ---------------------------------------------------------------------------------------------- measuring


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

    @property
    def setting(self) -> float:
        return self.tolerance or self.step or 0.0


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
    """All that the chart is made of."""

    cells: list[Cell]
    references: list[Reference]
    cases: list[Verdict]
    creep: list[Creep]


def _references(
    axis: Axis, columns: Sequence[float], problems: Sequence[Problem]
) -> list[tuple[Reference, Floats | None]]:
    """z at t_end as well as it can be had, column by column, and how well a second computation agrees."""
    found: list[tuple[Reference, Floats | None]] = []
    took, before = 0.0, columns[0]  # of the exact law's check, one column back
    for stiffness, problem in zip(columns, problems, strict=True):
        if axis == "layer":
            by, check, checked = _LAYER, _LAYER_CHECK, problem
        elif took * stiffness / before <= _CHECK_SECONDS:
            by, check, checked = _THIN, _EXACT_CHECK, problem
        else:  # nothing else gets there: the same engine with other layers
            by, check = _THIN, _THIN
            checked = replace(problem, delta=np.full(problem.system.n, _WIDER))
        width = "" if axis == "layer" else f", delta = {_WIDTH:g}"
        wider = "" if checked is problem else f", delta = {_WIDER:g}"
        row = Reference(axis, stiffness, f"{by[0]} at {by[1]:g}{width}", f"{check[0]} at {check[1]:g}{wider}")
        z: Floats | None = None
        try:
            reference = reached(*by, problem)
            start = time.perf_counter()
            row = replace(row, floor=distance(reference, reached(*check, checked)))
            if check == _EXACT_CHECK:
                took, before = time.perf_counter() - start, stiffness
            z = reference
            if axis == "layer":
                row = replace(row, to_exact=float(np.abs(z - reached(*_EXACT_CHECK, problem)).max()))
        except (MethodError, sim.IntegrationError) as error:
            row = replace(row, reason=str(error))
        found.append((row, z))
    return found


def _map(
    scene: StabilityScene,
    axis: Axis,
    method: Method,
    problems: Sequence[Problem],
    references: Sequence[tuple[Reference, Floats | None]],
    settings: tuple[float, ...],
) -> Iterator[Cell]:
    """The cells of one method, row by row from the coarsest setting, each row from the mildest column."""
    mildest = references[0][0].stiffness
    if not method.is_installed:
        yield Cell(axis, mildest, method.name, None, None, "absent", reason=f"{method.package} is not installed")
        return
    solvers = [method.prepare(problem) for problem in problems]  # what is compiled there is not timed
    warm(method, problems[0], settings[-1])
    for setting in reversed(settings):
        n_steps = whole_steps(scene.t_end, setting) if method.control == "step" else 0
        took, before = 0.0, mildest
        for solve, (reference, z) in zip(solvers, references, strict=True):
            stiffness = reference.stiffness
            cell = Cell(axis, stiffness, method.name, None, None, "not judged")
            cell = replace(cell, step=setting) if n_steps else replace(cell, tolerance=setting)
            if z is None or reference.floor is None:
                yield replace(cell, reason=f"no reference: {reference.reason}")
            elif n_steps > scene.max_steps:
                yield replace(cell, outcome="too slow", reason=f"not started: {n_steps:,} steps")
            elif not method.can_be_stopped and took * stiffness / before > scene.patience:
                reason = f"not started: took {took:.2g} s at {before:g}, and cost may grow with the stiffness"
                yield replace(cell, outcome="too slow", reason=reason)
            else:
                cell = classified(scene, solve, setting, z, reference.floor, cell)
                if cell.seconds is not None:
                    took, before = cell.seconds, stiffness
                yield cell


def classified(scene: StabilityScene, solve: Solver, setting: float, z: Floats, floor: float, cell: Cell) -> Cell:
    """Run a method once and say what came of it.

    Right: the error is at most `factor` times the tolerance, or `right_below` for a fixed step. Wrong: it is above
    `wrong_above`, or no number at all, and the method reports success. Rough: between.
    """
    promised = scene.right_below if cell.tolerance is None else scene.factor * cell.tolerance
    start = time.perf_counter()
    try:
        found = solve(setting).z
    except (MethodError, sim.IntegrationError) as error:
        outcome: Outcome = "too slow" if isinstance(error, GivenUp) else "failed"
        return replace(cell, outcome=outcome, reason=str(error), seconds=time.perf_counter() - start)
    cell = replace(cell, seconds=time.perf_counter() - start)
    if not np.isfinite(found).all():
        return replace(cell, outcome="wrong", reason="z at t_end is not finite, returned as a success")
    apart = float(np.abs(found - z).max())
    cell = replace(cell, error=max(apart, floor))
    if floor > promised:
        return replace(cell, outcome="not judged", reason=f"the references agree to {floor:.1e} only")
    if apart <= promised:
        return replace(cell, outcome="right")
    return replace(cell, outcome="wrong" if apart > scene.wrong_above else "rough")


# ---------------------------------------------------------------------------------------------- what came of it


@dataclass(frozen=True)
class Map:
    """The cells of one method on one axis."""

    axis: Axis
    method: str
    cells: list[Cell]

    def of(self, outcome: Outcome) -> list[Cell]:
        return [cell for cell in self.cells if cell.outcome == outcome]

    @property
    def of_wrong(self) -> list[Cell]:
        """The cells that are wrong, the mildest first."""
        return sorted(self.of("wrong"), key=lambda cell: cell.stiffness)

    @property
    def is_ours(self) -> bool:
        return any(method.is_ours for method in METHODS if method.name == self.method)

    @property
    def worst(self) -> Cell | None:
        """The cell that goes past its tolerance by the largest factor."""
        asked = [cell for cell in self.cells if cell.error is not None and cell.tolerance is not None]
        return max(asked, key=lambda cell: (cell.error or 0.0) / cell.setting, default=None)

    @property
    def limit(self) -> tuple[float, float] | None:
        """(limit, power): a fixed step is stable for h < limit / stiffness ** power; None where theory sets none."""
        if (self.axis, self.method) == ("layer", "RK4"):
            return _RK4_LIMIT, 1.0
        if (self.axis, self.method) == ("bond", "Moreau-Jean"):  # the midpoint rule on z'' = -2 k z
            return 2.0 / math.sqrt(2.0), 0.5
        return None

    def about_its_limit(self) -> dict[str, Any] | None:
        """What a fixed step does within and beyond its limit."""
        if self.limit is None:
            return None
        limit, exponent = self.limit
        share = {cell: (cell.step or 0.0) * cell.stiffness**exponent / limit for cell in self.cells}
        inside = [cell.error for cell in self.cells if share[cell] < _WITHIN and cell.error is not None]
        outside = [c for c in self.cells if share[c] > _BEYOND and c.outcome not in ("too slow", "not judged")]
        ratios = [cell.error / cell.setting for cell in outside if cell.error is not None]
        return {
            "method": self.method,
            "limit": limit,
            "inside": max(inside, default=None),
            "n_outside": len(outside),
            "outside": Counter(cell.outcome for cell in outside),
            "ratio": median(ratios) if ratios else None,
        }

    def growth(self, tolerance: float) -> float | None:
        """Cost at the stiffest cell that was finished over that at the one before, to the power of one decade."""
        row = [c for c in self.cells if c.tolerance == tolerance and c.error is not None and c.seconds]
        row.sort(key=lambda cell: cell.stiffness)
        if len(row) < 2:
            return None
        before, last = row[-2:]
        decades = math.log10(last.stiffness / before.stiffness)
        return float(((last.seconds or 1.0) / (before.seconds or 1.0)) ** (1.0 / decades))


def _maps(cells: Sequence[Cell], axis: Axis) -> list[Map]:
    found: dict[str, list[Cell]] = {}
    for cell in cells:
        if cell.axis == axis and cell.outcome != "absent":
            found.setdefault(cell.method, []).append(cell)
    return [Map(axis, method, mine) for method, mine in found.items()]


def _group(scene: StabilityScene, axis: Axis, maps: Sequence[Map]) -> dict[str, Any]:
    """What is said of the maps of one axis."""
    growths = {one.method: one.growth(scene.tolerances[0]) for one in maps}
    return {
        "maps": maps,
        "ranked": sorted(maps, key=lambda one: -len(one.of("right")) / len(one.cells)),
        "engine": next((one for one in maps if one.is_ours), None),
        "limits": [found for one in maps if (found := one.about_its_limit())],
        "growth": growths.get("coulomb engine"),
        "explicit": [(name, growths[name]) for name in _EXPLICIT if growths.get(name) is not None],
    }


def _in_short(maps: Sequence[Map], cases: Sequence[Verdict]) -> dict[str, Any]:
    """How often each engine is wrong without a word, in all; and which other methods are."""
    wrong = Counter(case.method for case in cases if case.answer == "wrong")
    cells: dict[str, list[Cell]] = {}
    for one in maps:
        wrong[one.method] += len(one.of("wrong"))
        cells.setdefault(one.method, []).extend(one.cells)
    ours = [method.name for method in METHODS if method.is_ours]
    engines = [
        (name, wrong[name], len(cells.get(name, [])), Counter(cell.outcome for cell in cells.get(name, [])))
        for name in ours
        if name in cells or any(case.method == name for case in cases)
    ]
    others = [name for name in cells if name not in ours]
    return {"engines": engines, "others": others, "guilty": [name for name in others if wrong[name]]}


def _answers(cases: Sequence[Verdict]) -> dict[str, dict[str, list[str]]]:
    """For each method, the hard cases by their answers."""
    found: dict[str, dict[str, list[str]]] = {}
    for case in cases:
        mine = found.setdefault(case.method, {answer: [] for answer in ("right", "refused", "too slow", "wrong")})
        mine[case.answer].append(case.case)
    return found


# ---------------------------------------------------------------------------------------------- figures

#: Fill, ink and mark of each outcome; apart in grey too, and by their marks. The first three show the error.
_OUTCOMES = {
    "right": ("#CFE4F2", "black", None, "right"),
    "rough": ("#F2C14E", "black", None, "rough"),
    "wrong": ("#A83200", "white", None, "wrong, reported as a success"),
    "failed": ("#777777", "white", "×", "failed with a message"),
    "too slow": ("white", "#777777", "…", "too slow"),
    "not judged": ("white", "#777777", "?", "not judged"),
}


def stability_maps(maps: Sequence[Map], columns: int = 4) -> Figure:
    """What came of each method over stiffness and tolerance or step; in a cell the power of ten of its error.

    A limit by theory is dashed.
    """
    rows = -(-len(maps) // columns)
    with matplotlib.rc_context(STYLE | {"xtick.labelsize": 7, "ytick.labelsize": 7}):
        figure, axes = subplots(rows, columns, 0.75 + 1.75 * rows)
        for ax in axes.flat[len(maps) :]:
            ax.set_axis_off()
        label = ""
        for k, (ax, one) in enumerate(zip(axes.flat, maps, strict=False)):
            _draw(ax, one)
            before, label = label, "tolerance" if one.cells[0].step is None else "step h"
            if k % columns == 0 or label != before:
                ax.set_ylabel(label)
            if k + columns >= len(maps):
                ax.set_xlabel(_XLABELS[one.axis])
        handles: list[Any] = [
            Patch(facecolor=fill, edgecolor=GREY, linewidth=0.5, label=words if mark is None else f"{words} ({mark})")
            for outcome, (fill, _, mark, words) in _OUTCOMES.items()
            if any(cell.outcome == outcome for one in maps for cell in one.cells)
        ]
        if any(ax.lines for ax in axes.flat):
            handles.append(Line2D([], [], color="black", linestyle="--", label="limit by theory"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw(ax: Axes, one: Map) -> None:
    stiffness = sorted({cell.stiffness for cell in one.cells})
    settings = sorted({cell.setting for cell in one.cells})
    for cell in one.cells:
        fill, ink, mark, _ = _OUTCOMES[cell.outcome]
        x, y = stiffness.index(cell.stiffness), settings.index(cell.setting)
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill, edgecolor="white", linewidth=0.5))
        text = mark if mark else (f"{np.log10(cell.error):.0f}".replace("-", "−") if cell.error else "∞")
        ax.text(x, y, text, color=ink, fontsize=6 if len(stiffness) < 9 else 5, ha="center", va="center_baseline")
    if one.limit is not None and len(stiffness) > 1 and len(settings) > 1:
        at = np.geomspace(stiffness[0], stiffness[-1], 400)
        h = one.limit[0] / at ** one.limit[1]
        seen = (settings[0] <= h) & (h <= settings[-1])
        x_line = np.interp(np.log10(at[seen]), np.log10(stiffness), range(len(stiffness)))
        y_line = np.interp(np.log10(h[seen]), np.log10(settings), range(len(settings)))
        if seen.any():
            ax.plot(x_line, y_line, color="black", linestyle="--", linewidth=1.2)
    ax.set(xlim=(-0.5, len(stiffness) - 0.5), ylim=(-0.5, len(settings) - 0.5), title=one.method)
    for axis, values in ((ax.xaxis, stiffness), (ax.yaxis, settings)):
        powers = np.log10(values)
        places = [k for k, power in enumerate(powers) if abs(power - round(power)) < 1e-9]
        places = places[::2] if axis is ax.xaxis and len(places) > 6 else places
        axis.set_ticks(places, [f"$10^{{{powers[k]:.0f}}}$" for k in places])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
