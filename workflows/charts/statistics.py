"""The chart of statistics against cost, measured: how loose a method may be before a statistic of long runs moves.

A path that is wrong may still sample the right statistic. Each setting of each method runs on the same random
matrices; its *bias* is the paired difference from the reference of its own law, with a jackknife-t interval over
matrices. The yardstick is the *sampling error* of the statistic in a study of `study` matrices, half the width of its
interval there. A setting is *sufficient* if for every statistic the whole interval of the bias lies within that
error; the *loosest* is the last that is, counted from the tightest. Dimensionless; cost in products, as in `speed`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from scipy import stats

from stickslip import sim
from stickslip.analysis.stats.cascades import Law, sizes, window
from stickslip.analysis.stats.estimates import Estimate, gamma, gamma_difference, over_matrices, ratio
from stickslip.pipeline.toml import Blocks, Natural, Positive, as_tuple, distinct
from stickslip.workflows.charts import ChartScene, Say
from stickslip.workflows.charts.alone import Product, versions
from stickslip.workflows.charts.peers import W0, Z0, Model, random_problem
from stickslip.workflows.charts.steppers import moreau_jean

#: Engine and tolerance that each law's biases are taken against.
REFERENCES: dict[Model, tuple[str, float]] = {
    "coulomb": ("coulomb engine", 1e-12),
    "sigmoid": ("sigmoid engine", 1e-8),
}
#: For each method, the law that it solves.
METHODS: dict[str, Model] = {"coulomb engine": "coulomb", "Moreau-Jean": "coulomb", "sigmoid engine": "sigmoid"}
#: A tolerance that is charted is this many times its reference's at least.
_COARSER = 10.0

_Pairs = Annotated[int, Field(ge=2)]


class StatisticsScene(ChartScene):
    """A scene with ``chart = "statistics"``; dimensionless."""

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
    coulomb_tolerances: Annotated[
        tuple[Annotated[float, Field(ge=_COARSER * REFERENCES["coulomb"][1], lt=1e-2)], ...],
        BeforeValidator(as_tuple),
        AfterValidator(distinct),
    ] = Field(min_length=1, description="tolerances of the coulomb engine", examples=[[1e-10, 1e-4]])
    sigmoid_tolerances: Annotated[
        tuple[Annotated[float, Field(ge=_COARSER * REFERENCES["sigmoid"][1], lt=0.1)], ...],
        BeforeValidator(as_tuple),
        AfterValidator(distinct),
    ] = Field(min_length=1, description="tolerances of the sigmoid engine, both alike", examples=[[1e-6, 1e-3]])
    steps: Annotated[tuple[Positive, ...], BeforeValidator(as_tuple), AfterValidator(distinct)] = Field(
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


# ---------------------------------------------------------------------------------------------- what is kept


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
    """All that the chart is made of; plain values, which JSON carries."""

    runs: list[Ran]
    study: int
    confidence: float
    versions: dict[str, str]

    @classmethod
    def restore(cls, found: dict[str, Any]) -> Measured:
        return cls(**{**found, "runs": [Ran(**row) for row in found["runs"]]})


# ---------------------------------------------------------------------------------------------- measuring


def measure(scene: StatisticsScene, say: Say) -> Measured:
    """Run every setting on every matrix of a scene, in this process; `say` is told of each matrix as it is done."""
    asked = [(method, setting) for method, settings in scene.settings.items() for setting in settings]
    asked = [*REFERENCES.values(), *asked]
    runs: list[Ran] = []
    for matrix in range(scene.matrices):
        system = random_problem(scene.seed, scene.n, scene.t_end, scene.eps, "one", matrix).system
        if matrix == 0:
            for method, setting in asked:  # what is compiled at a first call is not timed
                _run(scene, system, method, setting, 1e-3 * scene.t_end)
        product = Product(np.asarray(system.stiffness))
        runs += [_ran(scene, system, product, matrix, *one) for one in asked]
        done = sum(ran.outcome == "finished" for ran in runs[-len(asked) :])
        say(f"matrix {matrix + 1} of {scene.matrices}: {done} of {len(asked)} runs finished")
    return Measured(runs, scene.study, scene.confidence, versions("scipy"))


def _run(scene: StatisticsScene, system: sim.System, method: str, setting: float, t_end: float) -> sim.Run:
    if method == "Moreau-Jean":
        return moreau_jean(system, Z0, W0, t_end, setting)
    if method == "coulomb engine":
        return sim.simulate(system, Z0, W0, t_end, engine="coulomb", tol=setting)
    return sim.simulate(system, Z0, W0, t_end, engine="sigmoid", eps=scene.eps, rtol=setting, atol=setting)


def _ran(
    scene: StatisticsScene, system: sim.System, product: Product, matrix: int, method: str, setting: float
) -> Ran:
    """One run between two measurements of the product."""
    before = product.seconds()
    start = time.perf_counter()
    try:
        run = _run(scene, system, method, setting, scene.t_end)
    except sim.IntegrationError as error:
        return Ran(matrix, method, setting, "failed", str(error))
    seconds = time.perf_counter() - start
    unit = 0.5 * (before + product.seconds())
    if run.outcome != "finished":
        return Ran(matrix, method, setting, run.outcome, run.reason)
    seen = window(*run.events.change_points(), scene.t_burn, scene.t_end)
    found = sizes(seen, Law("events"))
    is_exit = (run.events.previous_mode == 0) & (run.events.t > scene.t_burn)
    return Ran(
        matrix, method, setting, "finished",
        mean=seen.time_mean(),
        deviation=seen.time_variance() ** 0.5,
        exit_rate=float(np.count_nonzero(is_exit)) / system.n / (scene.t_end - scene.t_burn),
        total_size=int(found.sum()),
        n_cascades=len(found),
        products=seconds / unit,
        seconds=seconds,
    )  # fmt: skip


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
        yield Compared(
            model, method, setting, statistic, len(both), value.value, bias.value, bias.low, bias.high, allowed.value,
            products, is_within(bias, allowed.value), is_reference, bias.reason or allowed.reason or None,
        )  # fmt: skip


def is_within(bias: Estimate, allowed: float | None) -> bool:
    """Whether the whole interval of a bias lies within plus or minus `allowed`; without an interval it does not."""
    if bias.low is None or bias.high is None or allowed is None:
        return False
    return -allowed <= bias.low and bias.high <= allowed


def loosest(measured: Measured) -> dict[str, float | None]:
    """For each method the loosest setting that is sufficient, as are all tighter ones; None if there is none."""
    return loosest_of(compared(measured))


def loosest_of(rows: Sequence[Compared]) -> dict[str, float | None]:
    """`loosest`, from rows of `compared`."""
    found: dict[str, float | None] = {}
    for method in METHODS:
        mine = [row for row in rows if row.method == method and not row.is_reference]
        if not mine:
            continue
        found[method] = None
        for setting in sorted({row.setting for row in mine}):
            if not all(row.is_sufficient for row in mine if row.setting == setting):
                break
            found[method] = setting
    return found
