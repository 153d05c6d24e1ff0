"""Friction laws given by coefficients of friction: a table of them, or any function of the speed of slip."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from stickslip.sim.numerics.arguments import Floats, floats, number
from stickslip.sim.systems.weakening.law import Weakening
from stickslip.sim.systems.weakening.pieces import FASTEST, Pieces, of_cubics, sampled

#: The fewest values of a table; the most.
_FEWEST, _MOST = 4, 255
#: The least step between its speeds, over the last.
_CLOSEST = 1e-12


class Coefficients(Weakening):
    """A law mu(u) by coefficients of |u|, from rest on: kinetic friction is the `friction` of a `System` times these.

    So `friction` is the normal load, and a block begins to slip with the first coefficient times it.
    """

    @cached_property
    @abstractmethod
    def curve(self) -> Pieces:
        """The coefficient by |u|."""

    @cached_property
    def steepness(self) -> float:
        return (self.curve.steepest / self._first) or 1.0

    @cached_property
    def pieces(self) -> Pieces:
        return self.curve.scaled(self.steepness, 1.0 / self._first)

    @property
    @abstractmethod
    def _first(self) -> float:
        """The coefficient of a block at rest."""

    def ends(self, friction: Floats, static: Floats) -> tuple[Floats, Floats]:
        return friction * self._first, np.zeros_like(friction)

    def shape(self, x: Any) -> Any:  # type: ignore[override]
        return self.pieces.at(x)

    def _require_friction(self, name: str) -> None:
        """ValueError if a coefficient is negative, or that of a block at rest is zero."""
        least, _, speed = self.curve.range
        if self._first <= 0.0:
            raise ValueError(
                f"{name}: expected a coefficient above 0 at rest, got {self._first:g}; what vanishes with the speed"
                " is a `damping`"
            )
        if least < -1e-12 * self._first:
            raise ValueError(f"{name}: expected coefficients of at least 0, got {least:g} at the speed {speed:g}")


@dataclass(frozen=True, init=False)
class Table(Coefficients):
    """Coefficients of friction at some speeds of slip, joined by cubics without overshoot; constant beyond the last.

    Slopes at the speeds are those of the cubic spline, limited as by Hyman (SIAM J. Sci. Stat. Comput. 4 (1983) 645):
    the law rises and falls where the table does, and is C2, or C1 where a slope was limited. Its engines step from
    speed to speed.

    Parameters
    ----------
    speeds : array_like, shape (m,)
        From 0, rising; 4 to 255 of them.
    coefficients : array_like, shape (m,)
        At least 0; that at rest above 0.

    Raises
    ------
    TypeError, ValueError
        If these are no such numbers.
    """

    speeds: tuple[float, ...]
    coefficients: tuple[float, ...]

    def __init__(self, speeds: ArrayLike, coefficients: ArrayLike) -> None:
        x, y = (
            floats(name, values, "a list of numbers")
            for name, values in (("speeds", speeds), ("coefficients", coefficients))
        )
        if x.ndim != 1 or not _FEWEST <= len(x) <= _MOST:
            raise ValueError(f"speeds: expected {_FEWEST} to {_MOST} numbers, got shape {x.shape}")
        if y.shape != x.shape:
            raise ValueError(f"coefficients: expected one for each of {len(x)} speeds, got shape {y.shape}")
        for name, values in (("speeds", x), ("coefficients", y)):
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: expected finite numbers, got {values[~np.isfinite(values)][0]}")
        is_close = np.diff(x) <= _CLOSEST * x[-1]
        if x[0] != 0.0 or is_close.any():
            at = 0 if x[0] != 0.0 else int(np.argmax(is_close)) + 1
            before = f" after {x[at - 1]:g}" if at else ""
            raise ValueError(f"speeds: expected numbers that rise from 0, got {x[at]:g}{before} in place {at}")
        object.__setattr__(self, "speeds", tuple(x.tolist()))
        object.__setattr__(self, "coefficients", tuple(y.tolist()))
        if (y < 0.0).any():
            at = int(np.argmax(y < 0.0))
            raise ValueError(f"coefficients: expected at least 0, got {y[at]:g} at the speed {x[at]:g}")
        self._require_friction("coefficients")

    @cached_property
    def curve(self) -> Pieces:
        x, y = np.array(self.speeds), np.array(self.coefficients)
        try:
            with np.errstate(all="ignore"):  # what float64 does not hold is told in our own words
                curve = _through(x, y)
        except ValueError:  # SciPy's, of slopes
            curve = None
        if curve is None or not np.isfinite(curve.terms).all():
            raise ValueError(
                f"coefficients: expected values that cubics in float64 can join, got up to {y.max():g} at speeds to"
                f" {x[-1]:g}; choose other units"
            )
        return curve

    @property
    def _first(self) -> float:
        return self.coefficients[0]

    @cached_property
    def error(self) -> float:
        """How far the law through every second value is from the others: an estimate, no bound, of the error between.

        At evenly spaced values of a smooth law the one through all is some ten times closer; where speeds are uneven
        it may be as far off; where values are measured, it is their scatter.
        """
        x, y = np.array(self.speeds), np.array(self.coefficients)
        half = np.unique(np.append(np.arange(0, len(x), 2), len(x) - 1))
        return float(np.abs(_through(x[half], y[half]).at(x) - y).max())

    def in_units(self, speed: float) -> Self:
        return type(self)(np.array(self.speeds) / speed, self.coefficients)

    def __str__(self) -> str:
        y = self.coefficients
        return f"Table({len(y)} coefficients from {min(y):g} to {max(y):g}, speeds to {self.speeds[-1]:g})"


@dataclass(frozen=True, repr=False)
class Curve(Coefficients):
    """The coefficient of friction as any function of the speed of slip, followed by polynomials of order 11.

    Their error is 2e-14 of its size if the function is smooth between a few kinks, else that of ``curve.error``.

    Parameters
    ----------
    function : callable
        Of a speed, a number >= 0, to a number >= 0.
    fastest : float
        The speed up to which it is asked; beyond, friction is constant.
    unit : float
        The unit of speeds, in that of the function.

    Raises
    ------
    TypeError, ValueError
        If it is no function, gives no number or a negative one, jumps, or bends too often.
    """

    function: Callable[[float], float]
    fastest: float = FASTEST
    unit: float = 1.0

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise TypeError(f"function: expected a function of the speed of slip, got {self.function!r}")
        for name in ("fastest", "unit"):
            object.__setattr__(self, name, number(name, getattr(self, name), above=0))
        self._require_friction("function")

    @cached_property
    def curve(self) -> Pieces:
        return sampled(self._values, self.fastest / self.unit, "function")

    @cached_property
    def _first(self) -> float:
        return self._value(0.0)

    def _values(self, speeds: Floats) -> Floats:
        return np.array([self._value(speed) for speed in (speeds * self.unit).tolist()])

    def _value(self, speed: float) -> float:
        try:
            return float(self.function(speed))
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise ValueError(
                f"function: expected a number at the speed {speed:g}, got {type(error).__name__}: {error}; correct"
                " it, or lower `fastest`"
            ) from error

    def in_units(self, speed: float) -> Self:
        return type(self)(self.function, self.fastest, self.unit * speed)

    def __repr__(self) -> str:
        digest = hashlib.sha256(self.curve.places.tobytes() + self.curve.terms.tobytes()).hexdigest()[:16]
        return f"Curve({getattr(self.function, '__name__', 'function')}, {digest})"

    def __str__(self) -> str:
        name, curve = getattr(self.function, "__name__", "function"), self.curve
        return f"Curve({name}, {len(curve.start)} polynomials, error {curve.error:.0e})"


def _through(x: Floats, y: Floats) -> Pieces:
    """The cubics through these values."""
    from scipy.interpolate import CubicSpline

    length, rise = np.diff(x), np.diff(y) / np.diff(x)
    slope = CubicSpline(x, y).derivative()(x)
    before, after = np.append(rise[0], rise), np.append(rise, rise[-1])
    limit = 3.0 * np.minimum(np.abs(before), np.abs(after))
    is_turn = before * after <= 0.0
    # at a least value no more than keeps the cubics on both sides above 0
    limit[is_turn] = np.minimum(limit, 3.0 * y / np.maximum(np.append(0.0, length), np.append(length, 0.0)))[is_turn]
    least, most = np.where(is_turn, -limit, 0.0), np.where(is_turn, limit, limit)
    sign = np.where(is_turn, 1.0, np.sign(after))
    slope = sign * np.clip(sign * slope, least, most)
    bend = (3.0 * rise - 2.0 * slope[:-1] - slope[1:]) / length
    twist = (slope[:-1] + slope[1:] - 2.0 * rise) / length**2
    return of_cubics(x, np.column_stack([y[:-1], slope[:-1], bend, twist]), y[-1])
