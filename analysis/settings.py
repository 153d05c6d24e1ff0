"""What must be declared before any number is computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.pipeline.design.values import LEAST_RANGE


@dataclass(frozen=True)
class AnalysisSettings:
    """The declared choices of an analysis.

    Parameters
    ----------
    t_burn : float
        Statistics use [t_burn, t_end] (dimensionless): before t_burn the shared start still shows.
    dt : tuple of float
        Sampling steps of the sampled definitions of a cascade (dimensionless), shown in tables.
    resamples : int
        Largest number of surrogates a member, for the values under chance.
    confidence : float
        Level of every interval, from 0.5 to 0.999999.
    seed : int
        Seed from which all random numbers derive.
    map_dt : tuple of float
        Sampling steps for figures; default: those of `dt`.
    tau : tuple of float
        Exits closer than such a gap count as a pair (dimensionless).
    smallest : int
        Smallest size of a cascade that laws of sizes are fitted to.
    magnitude_range : tuple of float, optional
        The magnitudes, from the least to the most, that b is of; default: those that a power law is found to hold on.
    margins : mapping of str to float
        The largest difference of two runs that counts as equivalence, by name of ``QUANTITIES`` in
        ``analysis.stats.quantities``.
    published : mapping of str to float
        Shares of runs that are known from elsewhere, by kind of attractor; estimates are set beside them.
    question : tuple of str
        Primary questions, in the order in which they lead the report; default: chosen from what the data hold.
    names : tuple of str
        Names of the blocks; empty if they have none.
    units : Units
        That the data are in; none if they are dimensionless.
    time : float
        One dimensionless unit of time, in these units.

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
    map_dt: tuple[float, ...] = ()
    tau: tuple[float, ...] = (0.05, 0.2, 1.0)
    smallest: int = 1
    magnitude_range: tuple[float, float] | None = None
    margins: Mapping[str, float] = field(default_factory=dict)
    question: tuple[str, ...] = ()
    published: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    units: Units = DIMENSIONLESS
    time: float = 1.0

    def at(self, t: float) -> str:
        """A time in words, with its unit."""
        return f"{t:g} {self.units.time}".rstrip()

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", tuple(float(dt) for dt in self.dt))
        object.__setattr__(self, "map_dt", tuple(float(dt) for dt in self.map_dt) or self.dt)
        object.__setattr__(self, "tau", tuple(float(tau) for tau in self.tau))
        steps = [(name, getattr(self, name)) for name in ("dt", "map_dt", "tau")]
        least, most = self.magnitude_range or (0.0, LEAST_RANGE)
        is_wide = math.isfinite(least) and math.isfinite(most) and most - least >= LEAST_RANGE
        wide = f"two magnitudes, the second by {LEAST_RANGE} or more the larger"
        for name, is_valid, expected, remedy in (
            ("t_burn", math.isfinite(self.t_burn) and self.t_burn >= 0, "a finite number >= 0", ""),
            *((name, len({*dts}) == len(dts) > 0, "one or more different numbers", "") for name, dts in steps),
            *((name, all(0 < dt < math.inf for dt in dts), "finite numbers > 0", "") for name, dts in steps),
            ("smallest", self.smallest >= 1, "an integer >= 1", ""),
            ("magnitude_range", is_wide, wide, ""),
            ("resamples", self.resamples >= 2, "an integer >= 2", "; 200 is a usual choice"),
            # near 1 the quantiles of an interval are infinite
            ("confidence", 0.5 <= self.confidence <= 0.999999, "a number from 0.5 to 0.999999", "; try 0.95"),
            ("seed", self.seed >= 0, "an integer >= 0", ""),
        ):
            if not is_valid:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)!r}{remedy}")
