"""The chart `paper`: the paper's six figures, computed again, and its claims, judged.

Exact law unless a law is named; dimensionless.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from stickslip.analysis.answer import Recipe
from stickslip.analysis.rows import frame_of
from stickslip.pipeline.scene.toml import BlockNumbers, Blocks, Count, Positive, PositiveNumbers
from stickslip.sim.numerics.arguments import apart
from stickslip.workflows.gallery.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.gallery.charts.claims import table
from stickslip.workflows.gallery.paper import figure_6, figures_1_2, figures_3_to_5
from stickslip.workflows.gallery.paper.claims import STRONGEST, judge
from stickslip.workflows.gallery.paper.figure_6 import BlowUp, SlowRun
from stickslip.workflows.gallery.paper.figures_1_2 import ONE, Parallelogram, Portrait, Uniqueness
from stickslip.workflows.gallery.paper.figures_3_to_5 import Cascades, Pairing, Row, Trace, panels
from stickslip.workflows.gallery.paper.runs import OF_TEXT, SCALES, Ask, run_all


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of. Empty where a figure is not asked for."""

    portraits: list[Portrait]
    parallelograms: list[Parallelogram]
    uniqueness: list[Uniqueness]
    runs: list[Row]
    traces: list[Trace]
    cascades: list[Cascades]
    pairings: list[Pairing]
    blow_ups: list[BlowUp]
    slow_runs: list[SlowRun]
    modes: list[tuple[float, float, bool]]


class PaperScene(ChartScene):
    """A scene with ``chart = "paper"``; dimensionless."""

    libraries = ("scipy",)

    chart: Literal["paper"] = Field(description="kind of the chart", examples=["paper"])
    title: str = Field(default="The paper, claim by claim", description="one line for the report's head")
    figures: Several[Annotated[int, Field(ge=1, le=6)]] = Field(
        min_length=1, description="numbers of the figures", examples=[[3, 5]]
    )
    n: BlockNumbers = Field(
        default=(20, 100, 200),
        description="numbers of blocks of figure 3; the last is that of figures 4 and 5",
        examples=[[20, 200]],
    )
    draws: Count = Field(default=20, description="number of matrices for each n but the last")
    beyond: Blocks = Field(default=250, description="number of blocks at which runs escape")
    matrices: Count = Field(default=40, description="number of matrices for the last n")
    t_end: Positive = Field(default=1500.0, description="end of these runs")
    t_burn: Positive = Field(default=600.0, description="time before which nothing is counted")
    t_shown: Positive = Field(default=200.0, description="time to which figures 3 and 4 are drawn")
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(default=0.03, description="width of the sigmoid")
    few: Count = Field(default=3, description="number of matrices for each change of the system")
    t_few: Positive = Field(default=1000.0, description="end of changed runs")
    size: Positive = Field(default=0.01, description="size of the perturbations of kappa and rho")
    changed: Count = Field(default=20, description="number of matrices on which small changes are followed to t_end")
    noise: PositiveNumbers = Field(
        default=(0.01, 0.02, 0.03, 0.05, 0.07, 0.1),
        description="sizes of the noise on all dampings",
        examples=[[0.1]],
    )
    escapes: Count = Field(default=8, description="number of matrices for each size of the noise")
    dt: PositiveNumbers = Field(default=(0.1, 0.3, 1.0), description="sampling steps of cascades", examples=[[0.1]])
    workers: Count = Field(default=2, description="number of local workers")

    @model_validator(mode="after")
    def _in_order(self) -> PaperScene:
        for early, late in (("t_shown", "t_few"), ("t_burn", "t_few"), ("t_burn", "t_end")):
            if getattr(self, early) >= getattr(self, late):
                end, start = apart(getattr(self, late), getattr(self, early))
                raise ValueError(
                    f"{early}: expected less than {late} = {end}, got {start}; shorten the one or lengthen the other"
                )
        return self

    def extent(self) -> str:
        numbers = ", ".join(map(str, self.figures))
        return f"figure{'s' if len(self.figures) > 1 else ''} {numbers} of the paper, {len(list(self.asks()))} runs"

    def asks(self) -> Iterator[Ask]:
        """The runs of random systems that the figures and their claims need, the longest first."""
        n, matrices = self.n[-1], range(self.few)
        if 4 in self.figures:
            for matrix, law in product(range(2 * self.few), ("algebraic", "arctan", "sigmoid")):
                yield Ask("sigmoids", law, n, matrix, self.t_few, law=law, keeps_exits=law == "sigmoid")
            noises = (("dampings", "damping matrix", self.noise), ("scaled", "scale", (STRONGEST,)))
            for study, reading, sizes in noises:
                for matrix, size in product(range(self.escapes), sizes):
                    yield Ask(study, f"{size:g}", n, matrix, self.t_few, "sigmoid", reading=reading, size=size)
            for blocks in dict.fromkeys((self.n[0], n)):
                yield Ask("base", "", blocks, 0, self.t_few, "sigmoid")
                for draw in range(3):
                    yield Ask("r", f"r, draw {draw}", blocks, 0, self.t_few, "sigmoid", detail="r", draw=draw)
            changes: dict[str, dict[str, Any]] = {
                "unchanged": {},
                "start": {"detail": "start"},
                "r": {"detail": "r"},
                "constants": {"reading": "scale", "size": self.size},
            }
            for matrix, (setting, change) in product(range(self.changed), changes.items()):
                yield Ask("lasting", setting, n, matrix, self.t_end, "sigmoid", draw=matrix, **change)
            for draw in range(3):
                label = f"{100 * self.size:g}%, draw {draw}"
                yield Ask("constants", label, n, 0, self.t_few, "sigmoid", reading="scale", size=self.size, draw=draw)
        if {3, 4, 5} & set(self.figures):
            for matrix in range(self.matrices):
                is_paired = 4 in self.figures and matrix < 2 * self.few
                yield Ask("long", "", n, matrix, self.t_end, keeps_exits=is_paired)
        if 3 in self.figures:
            for blocks, matrix in product((*self.n[:-1], self.beyond), range(self.draws)):
                yield Ask("long", "", blocks, matrix, self.t_end)
            for blocks in self.n:
                yield Ask("base", "", blocks, 0, self.t_few, "sigmoid")
            for name, factor, matrix in product(SCALES, (0.5, 2.0), matrices):
                yield Ask("keys", f"{name} {factor:g}", n, matrix, self.t_few, scale=name, factor=factor)
            for detail, matrix in product(("start", "friction"), range(min(4 * self.few, self.matrices))):
                yield Ask("details", detail, n, matrix, self.t_few, detail=detail)
            for coupling, blocks, matrix in product(OF_TEXT, self.n, matrices):
                yield Ask("readings", coupling, blocks, matrix, self.t_few, coupling=coupling)

    def measure(self, say: Say) -> Measured:
        """The measurements that the figures show and the claims are judged by."""
        measured = Measured(*([] for _ in Measured.__dataclass_fields__))
        if 1 in self.figures:
            measured.portraits.extend(map(figures_1_2.portrait, (-ONE[3], ONE[3])))
        if 2 in self.figures:
            measured.parallelograms.extend((figures_1_2.parallelogram(1), figures_1_2.parallelogram(-1)))
            measured.uniqueness.append(figures_1_2.uniqueness())
        if 6 in self.figures:
            measured.blow_ups.extend(figure_6.blow_ups())
            measured.slow_runs.extend(figure_6.slow_run(side) for side in (1, -1))
            measured.modes.extend(figure_6.modes_in_time())
        asks = list(dict.fromkeys(self.asks()))
        paths = []
        for k, path in enumerate(run_all(asks, self.seed, self.eps, self.workers), start=1):
            paths.append(path)
            measured.traces.extend(figures_3_to_5.traces(path, self.t_shown, self.n))
            if k % 20 == 0 or k == len(asks):
                say(f"{k} of {len(asks)} runs")
        measured.runs.extend(figures_3_to_5.rows(paths, self.t_burn))
        measured.pairings.extend(figures_3_to_5.pairings(paths, self.t_burn))
        if 5 in self.figures:
            measured.cascades.extend(figures_3_to_5.cascade_laws(paths, self.n[-1], self.dt, self.t_burn))
        return measured

    def show(self, measured: Measured) -> Shown:
        """Tables: `claims`; and of the figures asked for `corners`, `runs`, `cascades`, `paths`, `hidden`."""
        claims = judge(self, measured)
        rows: dict[str, list[Any]] = {
            "corners": [corner for parallelogram in measured.parallelograms for corner in parallelogram.corners],
            "runs": measured.runs,
            "cascades": measured.cascades,
            "paths": measured.pairings,
            "hidden": [event for run in measured.slow_runs for event in run.events],
        }
        tables = {name: frame_of(type(of_kind[0]), of_kind) for name, of_kind in rows.items() if of_kind}
        recipes: dict[int, list[Recipe]] = {
            1: [partial(figures_1_2.phase_portrait, portrait) for portrait in measured.portraits],
            2: [
                *(partial(figures_1_2.region, parallelogram) for parallelogram in measured.parallelograms),
                *(partial(figures_1_2.velocities, parallelogram) for parallelogram in measured.parallelograms[:1]),
            ],
            3: panels(measured.traces, 3),
            4: [*panels(measured.traces, 4), partial(figures_3_to_5.escape_times, measured.runs, self.t_few)],
            5: [*panels(measured.traces, 5), partial(figures_3_to_5.size_law, measured.cascades)],
            6: [
                *(partial(figure_6.fast_flow, flow) for flow in measured.blow_ups),
                partial(figure_6.slow_modes, measured.modes, measured.slow_runs),
            ],
        }
        figures = {
            f"figure{number}_{k}": recipe
            for number in self.figures
            for k, recipe in enumerate(recipes[number], start=1)
        }
        facts = {"claims": claims, "pair": figures_1_2, "force": figure_6.FORCE, "panels": list(figures)}
        return Shown(facts, {"claims": table(claims)} | tables, figures)
