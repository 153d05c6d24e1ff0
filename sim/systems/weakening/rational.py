"""Friction that falls as one over the speed of slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.systems.weakening.law import Weakening, known_by_code, parameter

if TYPE_CHECKING:
    from stickslip.sim.numerics.lanes import Lane


@known_by_code
@dataclass(frozen=True)
class Rational(Weakening):
    """mu / (1 + rate |u|): the law of Carlson and Langer, Phys. Rev. A 40 (1989) 6470.

    Static friction is what it is without weakening: a block that leaves stick drops to mu at once, if that is less.
    Theirs is static 1, friction 1 - sigma, rate 2 alpha / (1 - sigma), without back slip.

    Raises
    ------
    TypeError, ValueError
        If the rate is no number > 0.
    """

    name = "rational"
    formula = "friction / (1 + rate |w - v|)"

    rate: float = parameter(
        "rate of the law `rational`",
        column="rate at which friction falls with slip; null if not rational",
        example=3.0,
        power=-1,
    )

    @property
    def steepness(self) -> float:
        return self.rate

    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        return friction, np.zeros_like(friction)

    @staticmethod
    def shape(x: Any) -> Any:
        return 1.0 / (1.0 + x)

    @staticmethod
    def on_lanes(x: Lane) -> tuple[Lane, Lane]:
        value = 1.0 / (1.0 + x)
        return value, -(value * value)

    @staticmethod
    def recurrence(k: int, z: Floats, x0: Floats, scale: Floats, series: Floats) -> None:
        """From (1 + x) S = 1: S_k = -S_0 sum_{j=1..k} x_j S_{k-j}."""
        s = series[0]
        s[k] = 0.0
        j = 1
        while j <= k:
            weight = j + 1.0
            for i in range(len(x0)):
                s[k, i] += weight * z[j + 1, i] * s[k - j, i]
            j += 1
        for i in range(len(x0)):
            s[k, i] *= -scale[i] * s[0, i]
