"""The chart of statistics against cost: how loose a method may be before a statistic of long runs moves.

A path that is wrong may still sample the right statistic. Each setting of each method runs on the same random
matrices; its *bias* is the paired difference from the reference of its own law, with a jackknife-t interval over
matrices. The yardstick is the *sampling error* of the statistic in a study of `study` matrices, half the width of its
interval there. A setting is *sufficient* if for every statistic the whole interval of the bias lies within that
error; the *loosest* is the last that is, counted from the tightest. Dimensionless; cost in products (`cost`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from statistics import median
from typing import Annotated, Any, Literal

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field, model_validator
from scipy import stats

from stickslip import sim
from stickslip.analysis.report.formats import count as counted
from stickslip.analysis.stats.cascades import Law, sizes, window
from stickslip.analysis.stats.estimates import Estimate, gamma, gamma_difference, over_matrices, ratio
from stickslip.analysis.style import BLUE, GREY, ORANGE, PURPLE, STYLE, legend, subplots
from stickslip.pipeline.toml import Blocks, Natural, Positive
from stickslip.workflows.charts import ChartScene, Say, Several, Shown
from stickslip.workflows.charts.cost import Product, timed
from stickslip.workflows.charts.peers import W0, Z0, Model, random_system
from stickslip.workflows.charts.runner import frame

#: Engine and tolerance that each law's biases are taken against.
REFERENCES: dict[Model, tuple[str, float]] = {
    "coulomb": ("coulomb engine", 1e-12),
    "sigmoid": ("sigmoid engine", 1e-8),
}
#: For each method, the law that it solves.
METHODS: dict[str, Model] = {"coulomb engine": "coulomb", "Moreau-Jean": "coulomb", "sigmoid engine": "sigmoid"}
LAWS: tuple[Model, ...] = ("coulomb", "sigmoid")
#: A tolerance that is charted is this many times its reference's at least.
_COARSER = 10.0

#: Costs that differ by less than this factor are not called different.
_ALIKE = 1.05

_Pairs = Annotated[int, Field(ge=2)]


class StatisticsScene(ChartScene):
    """A scene with ``chart = "statistics"``; dimensionless."""

    libraries = ("scipy",)

    chart: Literal["statistics"] = Field(description="kind of the chart", examples=["statistics"])
    title: str = Field(default="Where accuracy stops paying", description="one line for the report's head")
    n: Blocks = Field(description="number of blocks", examples=[200])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(description="width of the sigmoid", examples=[0.03])
    t_end: Positive = Field(description="end of each run", examples=[1000.0])
    t_burn: Natural = Field(description="time before which nothing is counted", examples=[600.0])
    matrices: _Pairs = Field(description="number of random matrices that each setting runs on", examples=[40])
    study: _Pairs = Field(
        description="number of matrices of the study whose sampling error is allowed", examples=[20]
    )
    coulomb_tolerances: Several[Annotated[float, Field(ge=_COARSER * REFERENCES["coulomb"][1], lt=1e-2)]] = Field(
        min_length=1, description="tolerances of the coulomb engine", examples=[[1e-10, 1e-4]]
    )
    sigmoid_tolerances: Several[Annotated[float, Field(ge=_COARSER * REFERENCES["sigmoid"][1], lt=0.1)]] = Field(
        min_length=1, description="tolerances of the sigmoid engine, both alike", examples=[[1e-6, 1e-3]]
    )
    steps: Several[Positive] = Field(
        default=(), description="steps of Moreau-Jean; none leaves it out", examples=[[0.1, 0.01]]
    )
    confidence: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.95, description="level of the intervals", examples=[0.95]
    )

    @model_validator(mode="after")
    def _burn_in_ends(self) -> StatisticsScene:
        if self.t_burn >= self.t_end:
            raise ValueError(
                f"t_burn: expected less than t_end = {self.t_end:g}, got {self.t_burn:g}; shorten the burn-in or"
                " lengthen the runs"
            )
        return self

    @property
    def settings(self) -> dict[str, tuple[float, ...]]:
        """What each method is asked for, from the tightest to the loosest."""
        asked = {"coulomb engine": self.coulomb_tolerances, "Moreau-Jean": self.steps}
        return asked | {"sigmoid engine": self.sigmoid_tolerances}

    def extent(self) -> str:
        methods = [asked for asked in self.settings.values() if asked]
        n_settings = sum(map(len, methods))
        return f"{n_settings} settings of {len(methods)} methods on {counted(self.matrices, 'matrix')}"

    def measure(self, say: Say) -> Measured:
        """Run every setting on every matrix."""
        asked = [(method, setting) for method, settings in self.settings.items() for setting in settings]
        asked = [*REFERENCES.values(), *asked]
        runs: list[Ran] = []
        for matrix in range(self.matrices):
            system = random_system(self.seed, self.n, matrix)
            if matrix == 0:
                for method, setting in asked:  # what is compiled at a first call is not timed
                    _run(self, system, method, setting, 1e-3 * self.t_end)
            product = Product(np.asarray(system.stiffness))
            runs += [_ran(self, system, product, matrix, *one) for one in asked]
            done = sum(ran.outcome == "finished" for ran in runs[-len(asked) :])
            say(f"matrix {matrix + 1} of {self.matrices}: {done} of {len(asked)} runs finished")
        return Measured(runs, self.study, self.confidence)

    def show(self, measured: Measured) -> Shown:
        """Tables: `settings`, `loosest`, `laws`, `runs`."""
        rows = compared(measured)
        choices = choices_of(rows)
        studies = sorted({max(measured.study // 4, 2), max(measured.study // 2, 2), measured.study})
        by_study = {study: choices_of(compared(replace(measured, study=study))) for study in studies}
        references = {model: [row for row in rows if row.is_reference and row.model == model] for model in LAWS}
        differences = _between_laws(measured, references["coulomb"])
        facts = {
            "laws": LAWS,
            "choices": choices,
            "by_study": by_study,
            "references": references,
            "asked": asked,
            "alike": _ALIKE,
            "differences": differences,
            "statistics": list(STATISTICS),
            "unfinished": [ran for ran in measured.runs if ran.outcome != "finished"],
        }
        loosest_rows = [
            {"study": study} | row for study, by in by_study.items() for one in by.values() for row in one.rows()
        ]
        tables = {
            "settings": frame(rows, Compared),
            "loosest": pd.DataFrame(loosest_rows),
            "laws": frame(differences, Difference).drop(columns="allowed"),
            "runs": frame(measured.runs, Ran),
        }
        return Shown(facts, tables, {"bias_against_cost": partial(bias_against_cost, choices, differences)})


# ---------------------------------------------------------------------------------------------- measuring


@dataclass(frozen=True)
class Ran:
    """One run: a row of the table `runs`; the numbers are null unless the outcome is "finished".

    `setting` is a tolerance, or the step of Moreau-Jean. On (t_burn, t_end]: mean and standard deviation over time of
    n_stick, exits per block and unit of time, and of the cascades by `events` the total size and the number.
    """

    matrix: int
    method: str
    setting: float
    outcome: Literal["finished", "collapsed", "diverged", "failed"]
    reason: str | None = None
    mean: float | None = None
    deviation: float | None = None
    exit_rate: float | None = None
    total_size: int | None = None
    n_cascades: int | None = None
    products: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    runs: list[Ran]
    study: int
    confidence: float


def _run(scene: StatisticsScene, system: sim.System, method: str, setting: float, t_end: float) -> sim.Run:
    if method == "Moreau-Jean":
        return sim.simulate(system, Z0, W0, t_end, engine="moreau", step=setting)
    if method == "coulomb engine":
        return sim.simulate(system, Z0, W0, t_end, engine="coulomb", tol=setting)
    return sim.simulate(system, Z0, W0, t_end, engine="sigmoid", eps=scene.eps, rtol=setting, atol=setting)


def _ran(
    scene: StatisticsScene, system: sim.System, product: Product, matrix: int, method: str, setting: float
) -> Ran:
    """One run, and its statistics."""
    try:
        run, timing = timed(lambda: _run(scene, system, method, setting, scene.t_end), product, 1)
    except sim.IntegrationError as error:
        return Ran(matrix, method, setting, "failed", str(error))
    if run.outcome != "finished":
        return Ran(matrix, method, setting, run.outcome, run.reason)
    seen = window(*run.events.change_points(), scene.t_burn, scene.t_end)
    found = sizes(seen, Law("events"))
    is_exit = (run.events.previous_mode == 0) & (run.events.t > scene.t_burn)
    return Ran(
        matrix,
        method,
        setting,
        "finished",
        mean=seen.time_mean(),
        deviation=seen.time_variance() ** 0.5,
        exit_rate=float(np.count_nonzero(is_exit)) / system.n / (scene.t_end - scene.t_burn),
        total_size=int(found.sum()),
        n_cascades=len(found),
        products=timing.products,
        seconds=timing.seconds,
    )


# ---------------------------------------------------------------------------------------------- comparing


def _ratio_difference(sums: np.ndarray) -> np.ndarray:
    return ratio(sums[:, 0:2]) - ratio(sums[:, 2:4])


@dataclass(frozen=True)
class Statistic:
    """A statistic of runs: a function of two sums over matrices, and its difference between two sets of runs."""

    columns: tuple[str, str | None]  # of `Ran`; None counts the runs
    value: Callable[[np.ndarray], np.ndarray]
    difference: Callable[[np.ndarray], np.ndarray]

    def sums(self, runs: Sequence[Ran]) -> np.ndarray:
        """Shape (runs, 2)."""
        return np.array(
            [[1.0 if name is None else float(getattr(ran, name)) for name in self.columns] for ran in runs]
        ).reshape(-1, 2)


STATISTICS: dict[str, Statistic] = {
    "mean n_stick": Statistic(("mean", None), ratio, _ratio_difference),
    "sd of n_stick": Statistic(("deviation", None), ratio, _ratio_difference),
    "exit rate": Statistic(("exit_rate", None), ratio, _ratio_difference),
    "gamma (events)": Statistic(("total_size", "n_cascades"), gamma, gamma_difference),
}


@dataclass(frozen=True)
class Compared:
    """One statistic of one method at one setting beside its law's reference: a row of the table `settings`.

    `value`, `bias` and the ends of its interval are null, with a reason, where they could not be computed; `products`
    is the median over matrices. `is_reference` marks the reference itself, whose bias is null.
    """

    model: Model
    method: str
    setting: float
    statistic: str
    n_matrices: int
    value: float | None
    bias: float | None
    low: float | None
    high: float | None
    sampling_error: float | None
    products: float | None
    is_sufficient: bool
    is_reference: bool = False
    reason: str | None = None


def sampling_error(statistic: str, runs: Sequence[Ran], study: int, confidence: float) -> Estimate:
    """Half the width of the interval that `study` matrices would give a statistic, by its scatter over `runs`.

    The standard error goes with one over the root of the number of matrices, and t has that of the study.
    """
    kind = STATISTICS[statistic]
    own = over_matrices(kind.value, kind.sums(runs), confidence)
    if own.high is None or own.value is None:
        return Estimate(reason=own.reason)
    level = 0.5 + 0.5 * confidence
    here, there = stats.t.ppf(level, len(runs) - 1), stats.t.ppf(level, study - 1)
    return Estimate(float((own.high - own.value) * there / here * (len(runs) / study) ** 0.5))


def paired(statistic: str, runs: Sequence[Ran], others: Sequence[Ran], confidence: float) -> Estimate:
    """A statistic of `runs` minus that of `others`, matrix by matrix, with its interval over matrices."""
    kind = STATISTICS[statistic]
    return over_matrices(kind.difference, np.hstack([kind.sums(runs), kind.sums(others)]), confidence)


def finished(measured: Measured, method: str, setting: float) -> dict[int, Ran]:
    """The finished runs of a setting, by matrix."""
    return {
        ran.matrix: ran
        for ran in measured.runs
        if (ran.method, ran.setting, ran.outcome) == (method, setting, "finished")
    }


def compared(measured: Measured) -> list[Compared]:
    """Every statistic of every setting, methods in their order and settings from the tightest to the loosest.

    A matrix whose reference did not finish takes no part; a setting that did not finish where its reference did is
    not sufficient, and its biases are not taken from the rest.
    """
    asked = sorted(
        {(ran.method, ran.setting) for ran in measured.runs}, key=lambda one: (list(METHODS).index(one[0]), one[1])
    )
    return [row for one in asked for row in _compared(measured, *one)]


def _compared(measured: Measured, method: str, setting: float) -> Iterator[Compared]:
    model = METHODS[method]
    reference = finished(measured, *REFERENCES[model])
    mine = finished(measured, method, setting)
    is_reference = (method, setting) == REFERENCES[model]
    left_out = [
        ran
        for ran in measured.runs
        if (ran.method, ran.setting) == (method, setting) and ran.outcome != "finished" and ran.matrix in reference
    ]
    both = sorted(reference.keys() & mine.keys())
    runs, others = [mine[matrix] for matrix in both], [reference[matrix] for matrix in both]
    products = median(ran.products for ran in runs if ran.products is not None) if runs else None
    for statistic, kind in STATISTICS.items():
        allowed = sampling_error(statistic, list(reference.values()), measured.study, measured.confidence)
        value = over_matrices(kind.value, kind.sums(runs), measured.confidence)
        bias = paired(statistic, runs, others, measured.confidence)
        if left_out:
            first = left_out[0]
            words = f"{len(left_out)} of {len(reference)} runs did not finish; matrix {first.matrix} {first.outcome}"
            bias = Estimate(reason=f"{words}: {first.reason}")
        if is_reference:
            bias = Estimate(reason="the reference")
        numbers = (value.value, bias.value, bias.low, bias.high, allowed.value, products)
        verdict = (is_within(bias, allowed.value), is_reference, bias.reason or allowed.reason or None)
        yield Compared(model, method, setting, statistic, len(both), *numbers, *verdict)


def is_within(bias: Estimate, allowed: float | None) -> bool:
    """Whether the whole interval of a bias lies within plus or minus `allowed`; without an interval it does not."""
    if bias.low is None or bias.high is None or allowed is None:
        return False
    return -allowed <= bias.low and bias.high <= allowed


# ---------------------------------------------------------------------------------------------- choosing


def asked(method: str, setting: float) -> str:
    """A setting as a user gives it, e.g. tol = 1e-4."""
    key = {"coulomb engine": "tol", "sigmoid engine": "rtol = atol", "Moreau-Jean": "h"}[method]
    return f"{key} = {_short(method, setting)}"


def _short(method: str, setting: float) -> str:
    return f"{setting:g}" if method == "Moreau-Jean" else np.format_float_scientific(setting, trim="-", exp_digits=1)


@dataclass(frozen=True)
class Setting:
    """One setting of one method with its rows, one a statistic."""

    method: str
    setting: float
    products: float | None
    rows: list[Compared]

    @property
    def failing(self) -> list[Compared]:
        """Rows that are not sufficient; those that are shown to move by the most sampling errors first."""

        def moved(row: Compared) -> float:
            if row.low is None or row.high is None or not row.sampling_error:
                return 0.0
            return max(row.low, -row.high, 0.0) / row.sampling_error

        return sorted((row for row in self.rows if not row.is_sufficient), key=moved, reverse=True)

    def __str__(self) -> str:
        return asked(self.method, self.setting)


@dataclass(frozen=True)
class Choice:
    """The settings of one method, from the tightest to the loosest, and what they allow."""

    method: str
    settings: list[Setting]

    def loosest(self, statistic: str | None = None) -> Setting | None:
        """The loosest that is sufficient, as are all tighter ones, for one statistic or for all; None if none is."""
        found = None
        for one in self.settings:
            if not all(row.is_sufficient for row in one.rows if statistic in (None, row.statistic)):
                break
            found = one
        return found

    @property
    def tightest(self) -> Setting:
        return self.settings[0]

    @property
    def cheapest(self) -> Setting | None:
        """Of the sufficient settings the one that costs least, if that is less than the loosest costs."""
        found = self.loosest()
        if found is None or found.products is None:
            return None
        known = [one for one in self.settings[: self.settings.index(found)] if one.products is not None]
        best = min(known, key=lambda one: one.products or 0.0, default=None)
        return best if best is not None and (best.products or 0.0) * _ALIKE < found.products else None

    @property
    def failing(self) -> Setting | None:
        """The tightest that is looser than the loosest; None if none was asked for."""
        found = self.loosest()
        beyond = self.settings if found is None else self.settings[self.settings.index(found) + 1 :]
        return next(iter(beyond), None)

    def rows(self) -> Iterator[dict[str, object]]:
        """Rows of the table `loosest`: first for all statistics together (statistic is null), then for each alone."""
        for statistic in (None, *STATISTICS):
            found = self.loosest(statistic)
            yield {
                "model": METHODS[self.method],
                "method": self.method,
                "statistic": statistic,
                "setting": found and found.setting,
                "products": found and found.products,
                "tightest": self.tightest.setting,
                "tightest_products": self.tightest.products,
            }


def choices_of(rows: Sequence[Compared]) -> dict[str, Choice]:
    """By method; references are left out."""
    found: dict[str, Choice] = {}
    charted = (row for row in rows if not row.is_reference)
    for (method, setting), some in groupby(charted, key=lambda row: (row.method, row.setting)):
        mine = list(some)
        choice = found.setdefault(method, Choice(method, []))
        choice.settings.append(Setting(method, setting, mine[0].products, mine))
    return found


@dataclass(frozen=True)
class Difference:
    """What the choice of the law does to one statistic, sigmoid minus exact law: a row of the table `laws`.

    `allowed` is the exact law's sampling error.
    """

    statistic: str
    difference: float | None
    low: float | None
    high: float | None
    reason: str | None
    allowed: float | None


def _between_laws(measured: Measured, exact_rows: Sequence[Compared]) -> list[Difference]:
    """Each law at its reference, on the matrices where both finished."""
    sigmoid, exact = (finished(measured, *REFERENCES[model]) for model in ("sigmoid", "coulomb"))
    both = sorted(sigmoid.keys() & exact.keys())
    pair = [sigmoid[matrix] for matrix in both], [exact[matrix] for matrix in both]
    allowed = {row.statistic: row.sampling_error for row in exact_rows}
    found = {statistic: paired(statistic, *pair, measured.confidence) for statistic in STATISTICS}
    return [
        Difference(name, one.value, one.low, one.high, one.reason or None, allowed[name])
        for name, one in found.items()
    ]


# ---------------------------------------------------------------------------------------------- the figure

#: Value and the ends of its interval, in sampling errors.
Ends = tuple[float, float, float]


def bias_against_cost(choices: dict[str, Choice], differences: Sequence[Difference]) -> Figure:
    """Bias against cost, one row a statistic, one column a law, in units of the law's own sampling error.

    What has no interval is not drawn.
    """
    reach = 2.0
    with matplotlib.rc_context(STYLE):
        figure, axes = subplots(len(STATISTICS), len(LAWS), 1.0 + 1.75 * len(STATISTICS), sharex="col", sharey=True)
        for difference, row in zip(differences, axes, strict=True):
            for model, ax in zip(LAWS, row, strict=True):
                ax.axhspan(-1.0, 1.0, color=GREY, alpha=0.18, linewidth=0, label="sampling error")
                ends = _ends(difference.difference, difference.low, difference.high, difference.allowed)
                if model == "sigmoid" and ends is not None:
                    ax.axhspan(ends[1], ends[2], color=PURPLE, alpha=0.15, linewidth=0)
                    ax.axhline(ends[0], color=PURPLE, linestyle="--", label="sigmoid minus exact law, with interval")
                for choice in (one for one in choices.values() if METHODS[one.method] == model):
                    drawn = _draw(ax, choice, difference.statistic)
                    reach = max([reach, *map(abs, drawn)])
                # linear where it is judged, logarithmic beyond
                ax.set_yscale("symlog", linthresh=2.0, linscale=1.2)
                ticks = [-100, -10, -2, -1, 0, 1, 2, 10, 100]
                ax.set_yticks(ticks, [f"{tick}".replace("-", "−") for tick in ticks])
                ax.set_xscale("log")
                ax.minorticks_off()
            row[0].set_ylabel(f"{difference.statistic}\nbias / sampling error")
        axes[0, 0].set_ylim(-4.0 * reach, 4.0 * reach)
        for ax, title, last in zip(axes[0], ("Exact law", "Sigmoid"), axes[-1], strict=True):
            ax.set_title(title)
            last.set_xlabel("cost of a run, products of K with a vector")
        legend(figure, 3)
    return figure


def _ends(value: float | None, low: float | None, high: float | None, error: float | None) -> Ends | None:
    if value is None or low is None or high is None or not error:
        return None
    return value / error, low / error, high / error


def _draw(ax: Axes, choice: Choice, statistic: str) -> list[float]:
    """The points of one method with their settings; returns the ends of their intervals."""
    colour, marker = (ORANGE, "s") if choice.method == "Moreau-Jean" else (BLUE, "o")
    points: list[tuple[float, Ends, str]] = []
    for one in choice.settings:
        (row,) = (row for row in one.rows if row.statistic == statistic)
        ends = _ends(row.bias, row.low, row.high, row.sampling_error)
        if ends is not None and row.products is not None:
            points.append((row.products, ends, _short(one.method, one.setting)))
    if not points:
        return []
    values, lows, highs = np.array([ends for _, ends, _ in points]).T
    look: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 3.5, "linewidth": 0.8, "elinewidth": 1.2}
    ax.errorbar([x for x, *_ in points], values, [values - lows, highs - values], label=choice.method, **look)
    cheapest = math.inf
    for x, _, label in points:
        # from the tightest on: a looser one that costs more would stand on the label of a tighter one
        y, side = (0.02, "bottom") if x > cheapest else (0.98, "top")
        cheapest = min(x, cheapest)
        upright: dict[str, Any] = {"rotation": 90, "ha": "center", "va": side, "fontsize": 6.5}
        ax.text(x, y, label, transform=ax.get_xaxis_transform(), color=colour, **upright)
    return [*lows, *highs]
