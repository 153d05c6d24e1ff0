"""Units that a scene measures in: what each is in SI, and what quantities of some dimension are then in."""

from __future__ import annotations

from dataclasses import dataclass

from stickslip.pipeline.design.values import Amount
from stickslip.sim.systems.terms import TERMS

#: Units that a scene may name, by what they are in SI.
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "km": 1e3}
MASSES = {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "t": 1e3}
ANGLES, INERTIAS = {"rad": 1.0}, {"kg m^2": 1.0}

#: Powers of time, length and mass, by the name of the scale in `stickslip.Scales`.
DIMENSIONS = {
    "time": (1, 0, 0), "length": (0, 1, 0), "mass": (0, 0, 1), "speed": (-1, 1, 0), "slowness": (1, -1, 0),
    "frequency": (-1, 0, 0), "angular_frequency": (-1, 0, 0), "stiffness": (-2, 0, 1),
    "damping": (-1, 0, 1), "force": (-2, 1, 1), "energy": (-2, 2, 1), "power": (-3, 2, 1),
}  # fmt: skip

#: Names of coherent units: of blocks that move, and of those that turn.
_NAMED = {
    ("s", "m", "kg"): {"force": "N", "stiffness": "N/m", "damping": "N s/m", "energy": "J", "power": "W"},
    ("s", "rad", "kg m^2"): {
        "force": "N m",
        "stiffness": "N m/rad",
        "damping": "N m s/rad",
        "energy": "J",
        "power": "W",
    },
}


_OF_KEYS = {term.name: term.dimension for term in TERMS} | {"z": "length", "w": "speed"}


@dataclass(frozen=True)
class Units:
    """Names of the units of time, length (or angle) and mass (or inertia); empty where all is dimensionless."""

    time: str = ""
    length: str = ""
    mass: str = ""

    def __bool__(self) -> bool:
        return bool(self.time)

    def of(self, dimension: str) -> str:
        """The unit of quantities of a dimension, one of `DIMENSIONS`; empty if these, or all, have none."""
        if not self or not dimension:
            return ""
        if dimension == "angular_frequency":
            return f"rad/{self.time}"
        names = self.time, self.length, self.mass
        if dimension in _NAMED.get(names, ()):
            return _NAMED[names][dimension]
        powers = [(name, power) for name, power in zip(names[::-1], DIMENSIONS[dimension][::-1], strict=True) if name]
        above, below = ([_power(name, sign * p) for name, p in powers if sign * p > 0] for sign in (1, -1))
        return "/".join([" ".join(above) or "1" * bool(below), *below])

    def label(self, words: str, dimension: str) -> str:
        """Words of an axis or a column with their unit in brackets."""
        unit = self.of(dimension)
        return f"{words} ({unit})" if unit else words

    def of_key(self, key: str) -> str:
        """The unit of a key of a scene; empty if it has none."""
        return self.of(_OF_KEYS.get(key, ""))

    def label_of_key(self, key: str, words: str = "") -> str:
        """A key, or words for it, with its unit in brackets."""
        return self.label(words or key, _OF_KEYS.get(key, ""))

    def amount(self, key: str, value: str) -> str:
        """A value of a key in words, with its unit if it is an `Amount`."""
        unit = self.of_key(key) if isinstance(value, Amount) else ""
        return f"{value} {unit}" if unit else value

    def __str__(self) -> str:
        return ", ".join(name for name in (self.time, self.length, self.mass) if name)


def _power(name: str, power: int) -> str:
    return name if power == 1 else f"({name})^{power}" if " " in name else f"{name}^{power}"


#: Of scenes without units.
DIMENSIONLESS = Units()
