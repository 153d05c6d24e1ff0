"""What a reader of the data must declare before any number is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class AnalysisSettings:
    """The declared choices of an analysis.

    Parameters
    ----------
    t_burn : float
        Statistics use [t_burn, t_end] (dimensionless): the shared start is not yet forgotten before.
    dt : tuple of float
        Sampling steps of the sampled definitions (dimensionless); the first is the one drawn in figures.
    resamples : int
        Random orders drawn for each member by the null model.
    confidence : float
        Level of every interval, in (0, 1).
    seed : int
        Root of the null model's random orders.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    t_burn: float
    dt: tuple[float, ...]
    resamples: int
    confidence: float
    seed: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", tuple(float(dt) for dt in self.dt))
        if not (math.isfinite(self.t_burn) and self.t_burn >= 0):
            raise ValueError(f"t_burn: expected a finite number >= 0, got {self.t_burn!r}")
        if not self.dt or len(set(self.dt)) < len(self.dt):
            raise ValueError(f"dt: expected one or more different sampling steps, got {self.dt!r}")
        if not all(math.isfinite(dt) and dt > 0 for dt in self.dt):
            raise ValueError(f"dt: expected finite numbers > 0, got {self.dt!r}")
        if self.resamples < 2:
            raise ValueError(f"resamples: expected an integer >= 2, got {self.resamples!r}; 200 is a usual choice")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence: expected a number in (0, 1), got {self.confidence!r}; try 0.95")
        if self.seed < 0:
            raise ValueError(f"seed: expected an integer >= 0, got {self.seed!r}")
