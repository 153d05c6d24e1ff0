"""[units]: in which a scene is measured, and the scales by which its numbers become dimensionless."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stickslip.pipeline.design.units import ANGLES, INERTIAS, LENGTHS, MASSES, TIMES, Units
from stickslip.pipeline.scene.toml import Positive, StrictTable, optional
from stickslip.sim.systems.scales import Scales
from stickslip.sim.systems.system import System

#: Scales of a scene that is looked at to find its own.
UNSCALED = {"length": 1.0, "time": 1.0, "force": 1.0}


class ScalesTable(StrictTable):
    """[units.scales]: what one dimensionless unit is, in the units of the scene."""

    length: Positive = Field(description="a dimensionless unit of length, or of angle", examples=[0.001])
    time: Positive = Field(description="a dimensionless unit of time", examples=[0.01])
    force: Positive = Field(description="a dimensionless unit of force, or of torque", examples=[100.0])


class UnitsTable(StrictTable):
    """[units]: the units that all numbers of a scene are in, but for settings of engines and sizes of changes."""

    time: Literal[*TIMES] = Field(description="unit of time", examples=["s"])  # type: ignore[valid-type]
    length: Literal[*LENGTHS] | None = optional("unit of length", "m")  # type: ignore[valid-type]
    angle: Literal[*ANGLES] | None = optional("unit of angle, of blocks that turn, in the place of `length`")  # type: ignore[valid-type]
    mass: Literal[*MASSES] | None = optional("unit of mass", "kg")  # type: ignore[valid-type]
    inertia: Literal[*INERTIAS] | None = optional("unit of inertia, beside `angle`")  # type: ignore[valid-type]
    scales: ScalesTable | None = optional(
        "what one dimensionless unit of length, time and force is; written by stickslip if left out"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        for linear, angular in (("length", "angle"), ("mass", "inertia")):
            if (getattr(self, linear) is None) == (getattr(self, angular) is None):
                got = "neither" if getattr(self, linear) is None else "both"
                raise ValueError(f"{linear}: expected either `{linear}` or `{angular}`, got {got}; write one of them")
        if (self.length is None) != (self.mass is None):
            raise ValueError("mass: expected `length` with `mass`, or `angle` with `inertia`, got a mixture")
        if self.scales is None:
            raise ValueError(
                "scales: expected what `load_scene` and the command write here, found nothing; use these"
            )
        try:
            self.sizes  # noqa: B018  refuses scales that are out of range
        except ValueError as error:
            raise ValueError(f"scales.{error}") from None
        return self

    @property
    def units(self) -> Units:
        """Their names."""
        return Units(self.time, self.length or self.angle or "", self.mass or self.inertia or "")

    @property
    def sizes(self) -> Scales:
        """What one dimensionless unit is, in these units."""
        assert self.scales is not None  # see above
        return Scales(self.scales.length, self.scales.time, self.scales.force)


def scales_of(system: System, table: Mapping[str, Any]) -> dict[str, float]:
    """The scales of `Scales.of` of a system in the units of a table, each the nearest power of two in SI units.

    To divide by a power of two and multiply again loses nothing: numbers come back as they were written.

    Raises `ValueError` if there is nothing by which to scale.
    """
    time, length = TIMES[table["time"]], (LENGTHS | ANGLES)[table.get("length") or table["angle"]]
    mass = (MASSES | INERTIAS)[table.get("mass") or table["inertia"]]
    in_si, scales = {"length": length, "time": time, "force": mass * length / time**2}, Scales.of(system)
    return {
        name: float(np.exp2(round(math.log2(getattr(scales, name) * unit)))) / unit for name, unit in in_si.items()
    }
