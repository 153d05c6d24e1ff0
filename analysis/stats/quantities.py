"""The quantities of a run's window: each is a statistic of two sums, which add over runs and matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.series.windows import Windows
from stickslip.analysis.stats.effective import correlation_times
from stickslip.analysis.stats.estimates import Statistic, gamma, ratio

Sums = Callable[[Windows], np.ndarray]  # of R runs, shape (R, number of names)


def _cascades(runs: Windows) -> np.ndarray:
    run, depth = runs.falls
    return np.column_stack([np.bincount(run, depth, len(runs)), np.bincount(run, minlength=len(runs))])


def _correlation(runs: Windows) -> np.ndarray:
    taus = correlation_times(runs)  # of a window in which n_stick does not change there is none, which is not counted
    return np.column_stack([taus, taus > 0])


#: What is summed over runs, by name, and how it is found in their windows. Names together are found together.
SUMS: Mapping[tuple[str, ...], Sums] = {
    ("runs",): lambda runs: np.ones((len(runs), 1)),
    ("mean",): lambda runs: runs.mean[:, None],
    ("variance",): lambda runs: runs.variance[:, None],
    ("rate",): lambda runs: (runs.exits / runs.span)[:, None],
    ("slipped", "cascades"): _cascades,
    ("tau", "timed"): _correlation,
}


@dataclass(frozen=True)
class Quantity:
    """A quantity: names in tables and sentences, two sums, their statistic, what it counts, if any, its dimension."""

    label: str
    title: str
    parts: tuple[str, str]
    of: Statistic = ratio
    things: str = ""
    dimension: str = ""

    def sums(self, runs: Windows) -> np.ndarray:
        """Its two sums over each window, shape (R, 2)."""
        by_name: dict[str, np.ndarray] = {}
        for names, function in SUMS.items():
            if not set(names).isdisjoint(self.parts):
                by_name |= zip(names, function(runs).T, strict=True)
        return np.column_stack([by_name[name] for name in self.parts])


#: By the name under which a scene declares a margin.
QUANTITIES: Mapping[str, Quantity] = {
    "mean": Quantity("mean n_stick", "mean number of sticking blocks", ("mean", "runs"), things="sticking blocks"),
    "variance": Quantity(
        "variance of n_stick in time", "variance of the number of sticking blocks", ("variance", "runs")
    ),
    "rate": Quantity(
        "exit rate", "rate of slip onsets", ("rate", "runs"), things="slip onsets", dimension="frequency"
    ),
    "gamma": Quantity("gamma", "decay rate of cascade sizes", ("slipped", "cascades"), gamma),
    "correlation_time": Quantity("correlation time", "correlation time", ("tau", "timed"), dimension="time"),
}
