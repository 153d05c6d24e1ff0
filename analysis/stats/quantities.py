"""What a run's window gives, by quantity: two sums, which add over runs and matrices, and the statistic of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from stickslip.analysis.stats.cascades import Law, Window, sizes
from stickslip.analysis.stats.estimates import Statistic, correlation_time, gamma, ratio

BAND = (15.0, 25.0)  # periods around the paper's 20
_SAMPLES = 4096  # samples of a window for its spectrum: dt = 0.1 for 400 units
#: The one quantity that is no number: shares of time at each n_stick.
DISTRIBUTION = "distribution"


def band_share(win: Window, periods: tuple[float, float] = BAND) -> float:
    """Share of the variance of n_stick in a band of periods: a Hann-tapered periodogram of `_SAMPLES` samples."""
    dt = (win.t_stop - win.t_start) / _SAMPLES
    samples = win.path()[win.grid_index(dt)][:_SAMPLES].astype(np.float64)
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(len(samples)) / len(samples))
    spectrum = np.abs(np.fft.rfft((samples - samples.mean()) * taper)) ** 2
    frequency = np.fft.rfftfreq(len(samples), dt)
    total = float(spectrum[1:].sum())
    inside = (frequency >= 1 / periods[1]) & (frequency <= 1 / periods[0])
    return float(spectrum[inside].sum()) / total if total else 0.0


def exit_rate(win: Window) -> float:
    """Exits a unit of time."""
    return float(np.maximum(-win.step, 0).sum()) / (win.t_stop - win.t_start)


def _cascades(win: Window) -> tuple[float, float]:
    found = sizes(win, Law("events"))
    return float(found.sum()), float(len(found))


@dataclass(frozen=True)
class Quantity:
    """A quantity by its name for readers: the sums of a window, and what they come to."""

    label: str
    sums: Callable[[Window], tuple[float, float]]
    of: Statistic = ratio


#: By the name that a scene declares a margin for.
QUANTITIES: Mapping[str, Quantity] = {
    "mean": Quantity("mean n_stick", lambda win: (win.time_mean(), 1.0)),
    "variance": Quantity("variance of n_stick in time", lambda win: (win.time_variance(), 1.0)),
    "rate": Quantity("exit rate", lambda win: (exit_rate(win), 1.0)),
    "gamma": Quantity("gamma", _cascades, gamma),
    # nothing is counted where n_stick does not change
    "correlation_time": Quantity(
        "correlation time", lambda win: (0.0, 0.0) if (tau := correlation_time(win).value) is None else (tau, 1.0)
    ),
    "band": Quantity("variance at periods 15–25", lambda win: (band_share(win), 1.0)),
}
#: Every name that a margin can be declared for, with its label.
LABELS = {name: one.label for name, one in QUANTITIES.items()} | {DISTRIBUTION: "stationary distribution of n_stick"}
