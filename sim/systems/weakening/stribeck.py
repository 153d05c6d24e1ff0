"""Friction that falls exponentially from the static to the kinetic."""

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
class Stribeck(Weakening):
    """mu + (static - mu) exp(-|u| / speed): from the static friction, without a jump, to the kinetic.

    Where the static friction is the kinetic, nothing is left of it.

    Raises
    ------
    TypeError, ValueError
        If the speed is no number > 0.
    """

    name = "stribeck"
    formula = "friction + (static - friction) exp(-|w - v| / speed)"
    falls_from_static = True
    is_entire = True

    speed: float = parameter(
        "speed of the law `stribeck`",
        column="speed of slip over which it falls; null if not Stribeck's",
        example=0.5,
        power=1,
    )

    @property
    def steepness(self) -> float:
        return 1.0 / self.speed

    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        return static, friction

    @staticmethod
    def shape(x: Any) -> Any:
        return np.exp(-x)

    @staticmethod
    def on_lanes(x: Lane) -> tuple[Lane, Lane]:
        from stickslip.sim.numerics.lanes import exponential, less

        value = exponential(-less(x, 700.0))
        return value, -value

    @staticmethod
    def recurrence(k: int, z: Floats, x0: Floats, scale: Floats, series: Floats) -> None:
        """From S' = -x' S: S_k = -(1 / k) sum_{j=1..k} j x_j S_{k-j}."""
        s = series[0]
        s[k] = 0.0
        j = 1
        while j <= k:
            weight = j * (j + 1.0) / k
            for i in range(len(x0)):
                s[k, i] += weight * z[j + 1, i] * s[k - j, i]
            j += 1
        for i in range(len(x0)):
            s[k, i] *= -scale[i]
