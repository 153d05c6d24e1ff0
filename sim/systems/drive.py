"""The drive of the blocks, beyond a belt of one constant speed: external forces, belts whose speeds change.

A force or a speed is one number for all blocks or one for each, constant, harmonic or piecewise linear in time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip.sim.numerics.arguments import Floats, floats, per_block


@dataclass(frozen=True, eq=False, init=False)
class Harmonic:
    """amplitude cos(frequency t + phase), frequency in radians a unit of time.

    Parameters
    ----------
    amplitude, frequency, phase : float or array_like, shape (n,)
        One for all blocks, or one for each.

    Raises
    ------
    TypeError, ValueError
        If one is not finite, or no number or row of numbers.
    """

    amplitude: Floats
    frequency: Floats
    phase: Floats

    def __init__(self, amplitude: ArrayLike, frequency: ArrayLike, phase: ArrayLike = 0.0) -> None:
        for name, value in (("amplitude", amplitude), ("frequency", frequency), ("phase", phase)):
            array = _finite(name, value, "a number, or one a block")
            if array.ndim > 1:
                raise ValueError(f"{name}: expected a number, or one a block, got shape {array.shape}")
            object.__setattr__(self, name, array)

    def at(self, times: ArrayLike) -> Floats:
        """Its value at times of any shape: that shape, followed by (n,) where blocks differ."""
        t = np.asarray(times, dtype=np.float64)
        differ = max(self.amplitude.ndim, self.frequency.ndim, self.phase.ndim)
        t = t.reshape(t.shape + (1,) * differ)
        return np.asarray(self.amplitude * np.cos(self.phase_at(t)))

    def phase_at(self, t: ArrayLike) -> Floats:
        """frequency t + phase less whole turns of the former, to rounding at any time, in the shape of the three."""
        (share, power), (of_t, power_of_t) = np.frexp(self.frequency), np.frexp(t)
        high, high_of_t = np.float64(np.float32(share)), np.float64(np.float32(of_t))
        low, low_of_t = share - high, of_t - high_of_t
        product = share * of_t
        rest = ((high * high_of_t - product) + high * low_of_t + low * high_of_t) + low * low_of_t
        turned, left = (np.ldexp(x, power + power_of_t) for x in (product, rest))
        return np.asarray(np.arctan2(np.sin(turned), np.cos(turned)) + (left + self.phase))

    def scaled(self, factor: Floats) -> Harmonic:
        """The same, times a factor for each block."""
        return Harmonic(self.amplitude * factor, self.frequency, self.phase)

    @property
    def is_constant(self) -> bool:
        """Whether it does not depend on time."""
        return not (self.amplitude * self.frequency).any()

    def __repr__(self) -> str:
        parts = (f"{name}={_words(getattr(self, name))}" for name in ("amplitude", "frequency", "phase"))
        return f"Harmonic({', '.join(parts)})"


@dataclass(frozen=True, eq=False, init=False)
class Piecewise:
    """Linear between values at given times, constant before the first and after the last.

    Parameters
    ----------
    times : array_like, shape (k,)
        Increasing.
    values : array_like, shape (k,) or (k, n)
        One for all blocks, or one for each.

    Raises
    ------
    TypeError, ValueError
        If a number, or the slope between two, is not finite, the times do not increase, or there is not one value a
        time.
    """

    times: Floats
    values: Floats

    def __init__(self, times: ArrayLike, values: ArrayLike) -> None:
        t, x = _finite("times", times, "increasing times"), _finite("values", values, "a value at each time")
        if t.ndim != 1 or len(t) == 0 or not (np.diff(t) > 0).all():
            raise ValueError(f"times: expected at least one, and each after the one before, got {_words(t)}")
        if x.ndim not in (1, 2) or len(x) != len(t):
            raise ValueError(f"values: expected shape ({len(t)},) or ({len(t)}, n), as of the times, got {x.shape}")
        object.__setattr__(self, "times", t)
        object.__setattr__(self, "values", x)
        with np.errstate(over="ignore"):
            steep = ~np.isfinite(self._slopes).reshape(len(t) + 1, -1).all(axis=1)
        if steep.any():
            k = int(np.argmax(steep))
            raise ValueError(
                f"times: expected as much time between values as makes a finite slope, got {t[k] - t[k - 1]:g} after"
                f" {t[k - 1]:g}; take them further apart"
            )

    def at(self, times: ArrayLike) -> Floats:
        """Its value at times of any shape: that shape, followed by (n,) where blocks differ."""
        t = np.maximum(np.asarray(times, dtype=np.float64), self.times[0])
        k = np.searchsorted(self.times, t, side="right") - 1
        since = (t - self.times[k]).reshape(t.shape + (1,) * (self.values.ndim - 1))
        return np.asarray(self.values[k] + self._slopes[k + 1] * since)

    def slope_at(self, times: ArrayLike) -> Floats:
        """Its derivative from given times on, of the shape of `at`."""
        return np.asarray(self._slopes[np.searchsorted(self.times, times, side="right")])

    @cached_property
    def _slopes(self) -> Floats:
        """Slopes before the first of its times, from each to the next, and after the last."""
        lengths = np.diff(self.times).reshape((-1,) + (1,) * (self.values.ndim - 1))
        none = np.zeros_like(self.values[:1])
        return np.concatenate([none, np.diff(self.values, axis=0) / lengths, none])

    def integral(self, times: ArrayLike) -> Floats:
        """Its integral from the first of its times to given ones, of the shape of `at`."""
        t, x, knots = np.asarray(times, dtype=np.float64), self.values, self.times
        columns = (-1,) + (1,) * (x.ndim - 1)
        known = np.zeros_like(x)
        np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(knots).reshape(columns), axis=0, out=known[1:])
        before = np.maximum(np.searchsorted(knots, t, side="right") - 1, 0)
        s = (t - knots[before]).reshape(t.shape + (1,) * (x.ndim - 1))
        return np.asarray(known[before] + s * (x[before] + 0.5 * s * self.slope_at(t)))

    def scaled(self, factor: Floats) -> Piecewise:
        """The same, times a factor for each block."""
        return Piecewise(self.times, self.values * factor)

    @property
    def is_constant(self) -> bool:
        """Whether it does not depend on time."""
        return bool((self.values == self.values[0]).all())

    def __repr__(self) -> str:
        return f"Piecewise(times={_words(self.times)}, values={_words(self.values)})"


#: An external force as users give it; a list of such is a sum.
Term: TypeAlias = Harmonic | Piecewise
AnyTerm = TypeVar("AnyTerm", Harmonic, Piecewise)
Force: TypeAlias = ArrayLike | Term | Iterable[ArrayLike | Term] | None


def constant(value: Floats) -> Piecewise:
    """A value, shape (n,), that holds at all times."""
    return Piecewise([0.0], value[np.newaxis])


def forces(force: Force, n: int) -> tuple[Term, ...]:
    """The terms of a force on n blocks, by block: first the constant one, if there is one, then those that change."""
    if force is None or (isinstance(force, list | tuple) and len(force) == 0):
        return ()
    is_sum = isinstance(force, list | tuple) and any(
        isinstance(term, Harmonic | Piecewise) or np.ndim(term) > 0 for term in force
    )
    fixed, changing = np.zeros(n), list[Term]()
    for given in cast("Iterable[ArrayLike | Term]", force) if is_sum else (force,):
        if not isinstance(given, Harmonic | Piecewise):
            fixed += per_block("force", cast("ArrayLike", given), n)
            continue
        term: Term = by_block("force", given, n)  # type: ignore[type-var]
        if term.is_constant:
            fixed += term.at(0.0)
        else:
            changing.append(term)
    return (*((constant(fixed),) if fixed.any() else ()), *changing)


def by_block(name: str, term: AnyTerm, n: int) -> AnyTerm:
    """The same for each of n blocks, rows of shape (n,); TypeError for a subclass, whose formula is not known."""
    if type(term) not in (Harmonic, Piecewise):
        raise TypeError(f"{name}: expected Harmonic or Piecewise itself, got its subclass {type(term).__name__}")
    if isinstance(term, Harmonic):
        return Harmonic(
            *(per_block(f"{name}: {part}", getattr(term, part), n) for part in ("amplitude", "frequency", "phase"))
        )
    values = term.values
    if values.ndim == 1:
        values = np.repeat(values[:, np.newaxis], n, axis=1)
    if values.shape[1] != n:
        raise ValueError(f"{name}: values: expected shape (k,) or (k, {n}), got shape {term.values.shape}")
    return Piecewise(term.times, values)


def belt(belt_speed: ArrayLike | Piecewise, n: int) -> float | Floats | Piecewise:
    """Speeds of n belts: a number for one constant speed, (n,) if they differ, else a `Piecewise` by block."""
    if isinstance(belt_speed, Piecewise):
        moving = by_block("belt_speed", belt_speed, n)
        if not moving.is_constant:
            return moving
        speed = moving.values[0]
    elif isinstance(belt_speed, Harmonic):
        raise TypeError(
            f"belt_speed: expected a number, {n} numbers or a Piecewise, got {belt_speed!r}; a harmonic force moves"
            " the blocks instead"
        )
    elif isinstance(belt_speed, float):
        return float(per_block("belt_speed", belt_speed, 1)[0])
    else:
        speed = per_block("belt_speed", belt_speed, n)
    if (speed == speed[0]).all():
        return float(speed[0])
    return per_block("belt_speed", speed, n)


def direction(speeds: Floats) -> NDArray[np.int8]:
    """Direction of belts, from their speeds in time, shape (m,) or (m, n): -1 or +1; 0 if one rests or turns."""
    sides = np.sign(speeds)
    goes = np.sign(sides.sum(axis=0))
    return np.asarray(np.where((sides * goes < 0).any(axis=0), 0, goes), dtype=np.int8)


def _finite(name: str, value: ArrayLike, expected: str) -> Floats:
    array = floats(name, value, expected)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)].flat[0]}")
    array.flags.writeable = False
    return array


def _words(array: Floats) -> str:
    """An array in a few numbers."""
    if array.ndim == 0:
        return f"{float(array):g}"
    return np.array2string(array, separator=", ", threshold=6, edgeitems=2, precision=6).replace("\n", "")
