"""The chart of stability: where each method stops working, and whether it says so.

A *map* holds one method on one axis of stiffness, a cell for each stiffness and each tolerance or step:

    layer     the sigmoid's equations with mu / delta_i = stiffness for every block (mu = 1)
    bond      the exact law, a spring of that stiffness added between the first two blocks
    damping   the exact law, the damping of the first block times that factor

The error of a cell is max |z - z_ref| at t_end. Its outcome says whether that is what was asked for, less, or wrong
with no word said. Dimensionless but for `patience`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from pydantic import Field

from stickslip import sim
from stickslip.analysis.by_key import by_key
from stickslip.analysis.style import GREY, WIDTH, panel
from stickslip.pipeline.scene.toml import Blocks, Positive
from stickslip.workflows.gallery.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.gallery.charts.peers import METHODS, Model, Problem, methods_of, random_problem
from stickslip.workflows.gallery.charts.runner import frames
from stickslip.workflows.gallery.charts.trials import Outcome, Reference, Setting, Trial, referenced, trials

Axis = Literal["layer", "bond", "damping"]

#: The law that each axis makes stiff, and what the axis is called along its maps.
LAWS: dict[Axis, Model] = {"layer": "sigmoid", "bond": "coulomb", "damping": "coulomb"}
_XLABELS: dict[Axis, str] = {
    "layer": "stiffness μ / δ",
    "bond": "stiffness of one bond",
    "damping": "factor of one damping",
}
#: Method and tolerance of each law's reference, and of what checks it; coarser tolerances of Radau lose the
#: thinnest layers. The exact law is checked by the other engine, with layers so thin that the laws hardly differ.
REFERENCES: dict[Model, tuple[Setting, Setting]] = {
    "sigmoid": (("sigmoid engine", 1e-11), ("SciPy Radau", 1e-10)),
    "coulomb": (("coulomb engine", 1e-13), ("sigmoid engine", 1e-11)),
}
_WIDTH = 1e-10
#: A run is right up to so many times its tolerance; of a fixed step, which promises nothing, up to this error.
FACTOR, RIGHT_BELOW = 10.0, 1e-3
#: Beyond this error a run that reports success is wrong.
WRONG_ABOVE = 1e-2


class StabilityScene(ChartScene):
    """A scene with ``chart = "stability"``; dimensionless but for `patience`."""

    libraries = ("scipy", "CyRK", "scikit-sundae", "diffrax")

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
    tolerances: Several[Annotated[float, Field(ge=1e-9, le=WRONG_ABOVE / FACTOR)]] = Field(
        min_length=1, description="tolerances asked of each method", examples=[[1e-3, 1e-6]]
    )
    steps: Several[Positive] = Field(
        default=(), description="steps of the methods of a fixed step; none leaves them out", examples=[[0.1, 0.01]]
    )
    patience: Positive = Field(default=0.5, description="seconds after which a run is too slow")

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
        n_cells = sum(
            len(columns) * len(settings)
            for axis, columns in self.axes.items()
            for _, settings in methods_of(LAWS[axis], self.tolerances, self.steps)
        )
        return f"{n_cells} cells"

    def measure(self, say: Say) -> Measured:
        """Fill every map, column by column."""
        cells: list[Cell] = []
        references: list[Column] = []
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # methods at their limits overflow and warn; what came of it is kept
            for axis, columns in self.axes.items():
                model = LAWS[axis]
                for stiffness in columns:
                    problem, blank = self.problem(axis, stiffness), Column(axis=axis, stiffness=stiffness)
                    column, solution = referenced(blank, *REFERENCES[model], problem)
                    references.append(column)
                    row = Cell(axis=axis, stiffness=stiffness)
                    for method, settings in methods_of(model, self.tolerances, self.steps):
                        rows = trials(row, method, problem, column, solution, settings, self.patience)
                        cells += [judged(cell, column.floor) for cell in rows]
                    say(f"{axis}, {stiffness:g}: {len(cells)} cells")
        return Measured(cells, references)

    def show(self, measured: Measured) -> Shown:
        """Tables: `cells`, `references`."""
        groups = {axis: maps for axis in LAWS if (maps := _maps(measured.cells, axis))}
        maps = [panel for group in groups.values() for panel in group]
        cells = by_key((cell for panel in maps for cell in panel.cells), lambda cell: cell.method)
        outcomes = {name: Counter(cell.outcome for cell in members) for name, members in cells.items()}
        ours = [method.name for method in METHODS if method.is_ours and method.name in outcomes]
        facts = {
            "groups": groups,
            "engines": {name: outcomes[name] for name in ours},
            "others": {name: outcomes[name] for name in outcomes if name not in ours},
            "events": {name: [cell for cell in cells[name] if cell.apart is not None] for name in ours},
            "rule": {"factor": FACTOR, "right_below": RIGHT_BELOW, "wrong_above": WRONG_ABOVE},
        }
        figures = {f"{axis}_maps": partial(maps_of, panels) for axis, panels in groups.items()}
        return Shown(facts, frames(measured, "cells", "references"), figures)


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True, kw_only=True)
class Cell(Trial):
    """One method at one stiffness and one setting: a row of the table `cells`."""

    axis: Axis
    stiffness: float

    @property
    def setting(self) -> float:
        return self.tolerance or self.step or 0.0


@dataclass(frozen=True, kw_only=True)
class Column(Reference):
    """The reference for the errors of one column: a row of the table `references`."""

    axis: Axis
    stiffness: float


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    cells: list[Cell]
    references: list[Column]


def judged(cell: Cell, floor: float | None) -> Cell:
    """The cell of a run that reported success, judged right, rough or wrong if the references can tell."""
    if cell.outcome != "measured" or cell.error is None or floor is None:
        return cell
    promised = RIGHT_BELOW if cell.tolerance is None else FACTOR * cell.tolerance
    if floor > promised:
        return replace(cell, outcome="not judged", reason=f"the references agree to {floor:.1e} only")
    if cell.error <= promised:
        return replace(cell, outcome="right")
    return replace(cell, outcome="wrong" if cell.error > WRONG_ABOVE else "rough")


# ---------------------------------------------------------------------------------------------- results


@dataclass(frozen=True)
class Map:
    """The cells of one method on one axis."""

    axis: Axis
    method: str
    cells: list[Cell]

    def of(self, outcome: Outcome) -> list[Cell]:
        """Those with an outcome, the mildest first."""
        return sorted((cell for cell in self.cells if cell.outcome == outcome), key=lambda cell: cell.stiffness)

    @property
    def worst(self) -> Cell | None:
        """The cell that goes past its tolerance by the largest factor."""
        candidates = [cell for cell in self.cells if cell.error is not None and cell.tolerance is not None]
        return max(candidates, key=lambda cell: (cell.error or 0.0) / cell.setting, default=None)


def _maps(cells: Sequence[Cell], axis: Axis) -> list[Map]:
    drawn = [cell for cell in cells if cell.axis == axis and cell.outcome != "absent"]
    return [Map(axis, method, mine) for method, mine in by_key(drawn, lambda cell: cell.method).items()]


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


_COLUMNS = 4  # of maps


def maps_of(maps: Sequence[Map]) -> Figure:
    """Result of each method over stiffness and tolerance or step; each cell has the power of ten of the error."""
    rows = -(-len(maps) // _COLUMNS)
    return panel(0.75 + 1.75 * rows, WIDTH, nrows=rows, ncols=_COLUMNS, squeeze=False)(_draw_all)(maps)


def _draw_all(axes: np.ndarray, maps: Sequence[Map]) -> None:
    for ax in axes.flat[len(maps) :]:
        ax.set_axis_off()
    label = ""
    for k, (ax, of_method) in enumerate(zip(axes.flat, maps, strict=False)):
        _draw(ax, of_method)
        previous, label = label, "tolerance" if of_method.cells[0].step is None else "step h"
        if k % _COLUMNS == 0 or label != previous:
            ax.set_ylabel(label)
        if k + _COLUMNS >= len(maps):
            ax.set_xlabel(_XLABELS[of_method.axis])
    handles: list[Any] = [
        Patch(facecolor=fill, edgecolor=GREY, linewidth=0.5, label=words if mark is None else f"{words} ({mark})")
        for outcome, (fill, _, mark, words) in _OUTCOMES.items()
        if any(cell.outcome == outcome for of_method in maps for cell in of_method.cells)
    ]
    ax.figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _draw(ax: Axes, cells_of: Map) -> None:
    stiffness = sorted({cell.stiffness for cell in cells_of.cells})
    settings = sorted({cell.setting for cell in cells_of.cells})
    for cell in cells_of.cells:
        fill, ink, mark, _ = _OUTCOMES[cell.outcome]
        x, y = stiffness.index(cell.stiffness), settings.index(cell.setting)
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill, edgecolor="white", linewidth=0.5))
        text = mark if mark else (f"{np.log10(cell.error):.0f}".replace("-", "−") if cell.error else "∞")
        ax.text(x, y, text, color=ink, fontsize=6 if len(stiffness) < 9 else 5, ha="center", va="center_baseline")
    ax.set(xlim=(-0.5, len(stiffness) - 0.5), ylim=(-0.5, len(settings) - 0.5), title=cells_of.method)
    for axis, values in ((ax.xaxis, stiffness), (ax.yaxis, settings)):
        powers = np.log10(values)
        places = [k for k, power in enumerate(powers) if abs(power - round(power)) < 1e-9]
        places = places[::2] if axis is ax.xaxis and len(places) > 6 else places
        axis.set_ticks(places, [f"$10^{{{powers[k]:.0f}}}$" for k in places])
    ax.tick_params(length=0, labelsize=7)
    ax.spines[:].set_visible(False)
