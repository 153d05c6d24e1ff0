"""Friction within the discontinuity: switching laws, and all points of the box at which they balance a force.

While w_i = v the friction of block i is mu_i s_i(lambda), lambda in [-1, 1]^m, and

    w_i' = f_i(F; lambda) = -F_i - mu_i s_i(lambda),    F_i = R_i w_i + (K z)_i           (eqs 1, 6, 13)

A slipping block has lambda_i = +1 or -1. A switching law is its s. Everything is dimensionless.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.numerics.arguments import Floats, number
from stickslip.sim.systems.friction import hidden_term, over_kinetic, turning_point

Slips = NDArray[np.int8]

#: a point this far outside the box counts as on its face: the rounding of lambda
ON_FACE = 1e-12
#: a point at which s misses its target by more is no zero, but a double root of P beside a face, split by rounding
ROOT_MISS = 1e-9


class SwitchingLaw(ABC):
    """s(lambda), its slope, and the points where s takes a given value."""

    #: number of switches m that the law is written for; None for any
    size: int | None = None

    @abstractmethod
    def resistance(self, lam: Floats) -> Floats:
        """s(lambda), shape (m,): friction over mu."""

    @abstractmethod
    def slope(self, lam: Floats) -> Floats:
        """ds_i / dlambda_j, shape (m, m)."""

    @abstractmethod
    def zeros(self, target: Floats, slip: Slips) -> Floats:
        """All lambda in the closed box with s_i = target_i where slip_i = 0, and lambda_i = slip_i elsewhere.

        Returns
        -------
        float64, shape (k, m)
        """

    def accelerations(self, force: Floats, friction: Floats, lam: Floats) -> Floats:
        """f(F; lambda) = -F - mu s(lambda), shape (m,)."""
        return np.asarray(-force - friction * self.resistance(lam))

    def jacobian(self, friction: Floats, lam: Floats) -> Floats:
        """df_i / dlambda_j, shape (m, m)."""
        return np.asarray(-friction[:, None] * self.slope(lam))


@dataclass(frozen=True)
class Coulomb(SwitchingLaw):
    """s = lambda: eqs (3), (6). One sticking mode, lambda = -F / mu."""

    def resistance(self, lam: Floats) -> Floats:
        return np.array(lam)

    def slope(self, lam: Floats) -> Floats:
        return np.eye(len(lam))

    def zeros(self, target: Floats, slip: Slips) -> Floats:
        return _combine([np.array([a]) for a in target], slip)


@dataclass(frozen=True)
class StaticAboveKinetic(SwitchingLaw):
    """s = lambda + c lambda (1 - lambda^2), each block by itself: static friction `ratio` times the kinetic.

    s(+-1) = +-1. For c <= 1/2 s is monotone on [-1, 1] and the motion is Coulomb's; for c > 1/2 it turns at
    lambda_* = sqrt((1 + c) / (3 c)) < 1, where it is largest, s = 2 c lambda_*^3. This is the ratio r if
    4 (1 + c)^3 = 27 r^2 c, whose root with c > 1/2 is 1 + c = 3 r cos(arccos(-1 / r) / 3). r = 1 is Coulomb, c = 0.

    For 1 < |F| / mu < r a stable sticking mode and the slip in the direction of -F both exist, with a saddle between
    them: the state no longer determines an exit (see ``blowup.continuations``).

    Raises
    ------
    ValueError
        If the ratio is below one.
    """

    ratio: float

    def __post_init__(self) -> None:
        if not number("ratio", self.ratio) >= 1.0:
            raise ValueError(f"ratio: expected static over kinetic friction >= 1, got {self.ratio!r}")

    @property
    def c(self) -> float:
        """Strength of the hidden term."""
        return float(hidden_term(self.ratio))

    @property
    def turning_point(self) -> float:
        """lambda_*: s grows below it and falls above; 1 for the ratio 1."""
        return float(turning_point(self.c))

    def resistance(self, lam: Floats) -> Floats:
        return over_kinetic(lam, self.c)

    def slope(self, lam: Floats) -> Floats:
        return np.diag(1 + self.c - 3 * self.c * lam**2)

    def zeros(self, target: Floats, slip: Slips) -> Floats:
        return _combine([self._cubic(a) for a in target], slip)

    def _cubic(self, target: float) -> Floats:
        """Real roots of s = target: all three are real just when |target| <= ratio, else none is in the box."""
        if self.ratio == 1.0:
            return np.array([target])
        if abs(target) > self.ratio:
            return np.empty(0)
        angle = np.arccos(-target / self.ratio)
        roots = 2 * self.turning_point * np.cos((angle - 2 * np.pi * np.arange(3)) / 3)
        return roots[:2] if target == -self.ratio else roots[1:] if target == self.ratio else roots


@dataclass(frozen=True)
class Modified(SwitchingLaw):
    """s_1 = lambda_1 - lambda_2 (1 - lambda_1^2), s_2 = lambda_2 - lambda_1 (1 - lambda_2^2): section 5, figure 6(b).

    It is Coulomb's law where a block slips (lambda_i = +-1). Of a sticking block beside a slipping one,
    lambda_2 = L, s_1 = lambda_1 - L (1 - lambda_1^2) reaches -5 L / 4: friction is larger on one side.
    """

    size = 2

    def resistance(self, lam: Floats) -> Floats:
        return np.asarray(lam - lam[::-1] * (1 - lam**2))

    def slope(self, lam: Floats) -> Floats:
        x, y = lam
        return np.array([[1 + 2 * x * y, x**2 - 1], [y**2 - 1, 1 + 2 * x * y]])

    def zeros(self, target: Floats, slip: Slips) -> Floats:
        """See `SwitchingLaw.zeros`. Both blocks free: from the real roots of

            P(x) = -x^5 - b x^4 + 2 x^3 + (2 b - a) x^2 + a^2 x - (a + b),    (a, b) = target

        P is s_2 = b with y = (x - a) / (1 - x^2) from s_1 = a inserted; it loses only x = +-1, which needs a = +-1
        and is then a quadratic in y. At a saddle-node its double root may be missed.
        """
        if slip.all():
            return slip.astype(np.float64)[None]
        if slip.any():
            free = int(np.flatnonzero(slip == 0)[0])
            points = np.tile(slip.astype(np.float64), (2, 1))
            points[:, free] = _beside_slip(target[free], float(slip[1 - free]))
            return _in_box(points[np.isfinite(points[:, free])])
        # the component further from +-1 is eliminated: y is then well conditioned
        order = [0, 1] if abs(abs(target[0]) - 1) >= abs(abs(target[1]) - 1) else [1, 0]
        a, b = (float(target[k]) for k in order)
        x = np.roots([-1.0, -b, 2.0, 2.0 * b - a, a**2, -a - b])
        x = x[np.isreal(x)].real
        x = x[np.abs(x) < 1]
        pairs = [np.column_stack([x, (x - a) / (1 - x**2)])]
        if abs(a) == 1:
            y = _beside_slip(b, a)
            pairs.append(np.column_stack([np.full(2, a), y])[np.isfinite(y)])
        points = np.concatenate(pairs)[:, order]
        points = _in_box(np.array([self._polish(lam, target) for lam in points]).reshape(-1, 2))
        misses = np.array([np.abs(self.resistance(lam) - target).max() for lam in points])
        return np.unique(points[misses < ROOT_MISS], axis=0)

    def _polish(self, lam: Floats, target: Floats) -> Floats:
        """One Newton step, where the root is simple enough that it can only improve."""
        slope = self.slope(lam)
        if abs(np.linalg.det(slope)) < 1e-5:
            return lam
        step = np.linalg.solve(slope, self.resistance(lam) - target)
        return lam - step if np.abs(step).max() < 1e-8 else lam


def _combine(roots: list[Floats], slip: Slips) -> Floats:
    """Zeros of a law without coupling: all combinations of the zeros of the components."""
    sides = [_in_box(r[:, None])[:, 0] if not s else np.array([float(s)]) for r, s in zip(roots, slip, strict=True)]
    return np.array(list(product(*sides)), dtype=np.float64).reshape(-1, len(slip))


def _in_box(points: Floats) -> Floats:
    return np.clip(points[(np.abs(points) <= 1 + ON_FACE).all(axis=1)], -1.0, 1.0)


def _beside_slip(target: float, side: float) -> Floats:
    """Both roots x of x - side (1 - x^2) = target, side = +-1; infinite where they are not real."""
    square = 5 + 4 * side * target
    if square < 0:
        return np.array([np.inf, np.inf])
    roots = side * (np.array([-1.0, 1.0]) * np.sqrt(square) - 1) / 2
    return roots if square > 0 else np.array([roots[0], np.inf])
