"""The quantities of a run's window: each has two sums, which add over runs and matrices, and a statistic of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.series.cascades import EVENTS, Window, sums
from stickslip.analysis.stats.estimates import Statistic, correlation_time, gamma, ratio


def exit_rate(win: Window) -> float:
    """Exits per unit of time."""
    return float(np.maximum(-win.step, 0).sum()) / (win.t_stop - win.t_start)


def _cascades(win: Window) -> tuple[float, float]:
    total, count = sums(win.step)[EVENTS]
    return float(total), float(count)


@dataclass(frozen=True)
class Quantity:
    """A quantity: its name for readers, its two sums over a window, and the statistic of the sums."""

    label: str
    sums: Callable[[Window], tuple[float, float]]
    of: Statistic = ratio


#: By the name under which a scene declares a margin.
QUANTITIES: Mapping[str, Quantity] = {
    "mean": Quantity("mean n_stick", lambda win: (win.time_mean(), 1.0)),
    "variance": Quantity("variance of n_stick in time", lambda win: (win.time_variance(), 1.0)),
    "rate": Quantity("exit rate", lambda win: (exit_rate(win), 1.0)),
    "gamma": Quantity("gamma", _cascades, gamma),
    # a window in which n_stick does not change has no correlation time and is not counted
    "correlation_time": Quantity(
        "correlation time", lambda win: (0.0, 0.0) if (tau := correlation_time(win).value) is None else (tau, 1.0)
    ),
}
