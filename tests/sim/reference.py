"""An event-driven reference for a few blocks, in 34-digit arithmetic: slow, plain, and sharing nothing with `sim`.

Between events the motion is summed as a Taylor series over steps too short to need any control. At an instant all
assignments of modes to the blocks with w = v are tried; the law leaves exactly one of them consistent:

- mode 0 if |F| < mu, or |F| = mu and F first turns inward (or rests there for ever), F = R v + K z;
- mode sigma = +-1 if the first coefficient of w - v that does not vanish has the sign sigma.
"""

from dataclasses import dataclass
from itertools import product

import mpmath
import numpy as np
from mpmath import mpf

from stickslip.sim import System

_DPS = 34
_ORDER = 36
_REACH = 0.4  # step times rate: the first term left out is below 0.4^36 / 36! = 1e-56
_ZERO = mpf("1e-19")  # instants are located to about 1e-28; what is smaller than this vanishes
_NARROW = mpf("1e-29")


@dataclass(frozen=True)
class Reference:
    """Events in order of time and block, the modes right after the start, and the state at the end."""

    t: list[float]
    block: list[int]
    mode: list[int]
    initial_mode: list[int]
    z: np.ndarray
    w: np.ndarray


class _Law:
    def __init__(self, system: System) -> None:
        n = self.n = system.n
        stiffness = system.stiffness if isinstance(system.stiffness, np.ndarray) else system.stiffness.toarray()
        self.k = [[mpf(float(stiffness[i, j])) for j in range(n)] for i in range(n)]
        self.r = [mpf(float(x)) for x in system.damping]
        self.mu = [mpf(float(x)) for x in system.friction]
        self.v = mpf(system.belt_speed)
        largest = max(sum(abs(x) for x in row) for row in self.k)
        self.rate = max(abs(x) for x in self.r) + mpmath.sqrt(largest) + mpf("1e-3")

    def pull(self, z: list[mpf]) -> list[mpf]:
        return [sum(self.k[i][j] * z[j] for j in range(self.n)) for i in range(self.n)]

    def expand(self, z: list[mpf], w: list[mpf], mode: list[int]) -> tuple[list[list[mpf]], list[list[mpf]]]:
        """Coefficients of w - v and of F in s, by block, while the modes hold."""
        n = self.n
        c = [list(z), [self.v if mode[i] == 0 else w[i] for i in range(n)]]
        forces = []
        for k in range(_ORDER):
            kc = self.pull(c[k])
            forces.append([kc[i] + (self.r[i] * self.v if k == 0 else 0) for i in range(n)])
            c.append(
                [
                    mpf(0)
                    if mode[i] == 0
                    else -(self.r[i] * (k + 1) * c[k + 1][i] + kc[i] + (self.mu[i] * mode[i] if k == 0 else 0))
                    / ((k + 1) * (k + 2))
                    for i in range(n)
                ]
            )
        gaps = [[(k + 1) * c[k + 1][i] - (self.v if k == 0 else 0) for k in range(_ORDER)] for i in range(n)]
        return gaps, [[row[i] for row in forces] for i in range(n)]

    def is_consistent(self, z: list[mpf], w: list[mpf], mode: list[int], touching: list[int]) -> bool:
        gaps, forces = self.expand(z, w, mode)
        for i in touching:
            if mode[i] != 0:
                if _leading(gaps[i]) * mode[i] <= 0:
                    return False
            elif abs(abs(forces[i][0]) - self.mu[i]) < _ZERO:
                side = 0 if self.mu[i] == 0 else (1 if forces[i][0] > 0 else -1)
                turn = _leading([mpf(0), *forces[i][1:]])
                if turn * side > 0 or (side == 0 and turn != 0):
                    return False
            elif abs(forces[i][0]) > self.mu[i]:
                return False
        return True

    def decide(self, z: list[mpf], w: list[mpf], mode: list[int], touching: list[int]) -> list[int]:
        chosen = []
        for trial in product((0, 1, -1), repeat=len(touching)):
            candidate = list(mode)
            for i, m in zip(touching, trial, strict=True):
                candidate[i] = m
            if self.is_consistent(z, w, candidate, touching):
                chosen.append(candidate)
        assert len(chosen) == 1, f"{len(chosen)} assignments of modes are consistent: {chosen}"
        return chosen[0]


def _leading(coefficients: list[mpf]) -> int:
    for c in coefficients:
        if abs(c) > _ZERO:
            return 1 if c > 0 else -1
    return 0


def _value(poly: list[mpf], s: mpf) -> mpf:
    value = mpf(0)
    for c in reversed(poly):
        value = value * s + c
    return value


def _derivative(poly: list[mpf]) -> list[mpf]:
    return [k * c for k, c in enumerate(poly) if k > 0]


def _first_root(poly: list[mpf], high: mpf) -> mpf | None:
    """First zero in (0, high] by halving: an interval is dismissed when slope and bend cannot carry it to zero."""
    if all(abs(c) <= _ZERO for c in poly):
        return None  # zero throughout: nothing happens
    slope = _derivative(poly)
    bend = _value([abs(c) for c in _derivative(slope)], high)

    def search(low: mpf, high: mpf) -> mpf | None:
        middle, half = (low + high) / 2, (high - low) / 2
        if abs(_value(poly, middle)) > half * (abs(_value(slope, middle)) + half * bend / 2):
            return None
        if half < _NARROW:
            return middle
        left = search(low, middle)
        return left if left is not None else search(middle, high)

    return search(mpf(0), high + 4 * _NARROW)  # what happens at the end happens


def _without_root_at_start(poly: list[mpf]) -> list[mpf]:
    """poly / s^k with the vanishing coefficients at the start taken off."""
    k = 0
    while k < len(poly) - 1 and abs(poly[k]) <= _ZERO:
        k += 1
    return poly[k:]


def follow(system: System, z0: object, w0: object, t_end: float) -> Reference:
    """The run from t = 0 to `t_end`."""
    with mpmath.workdps(_DPS):
        return _follow(_Law(system), z0, w0, mpf(t_end))


def _follow(law: _Law, z0: object, w0: object, t_end: mpf) -> Reference:
    n, v = law.n, law.v
    z = [mpf(float(x)) for x in np.broadcast_to(z0, n)]  # type: ignore[call-overload]
    w = [mpf(float(x)) for x in np.broadcast_to(w0, n)]  # type: ignore[call-overload]
    t = mpf(0)
    mode = [0 if x == v else (1 if x > v else -1) for x in w]
    mode = law.decide(z, w, mode, [i for i in range(n) if w[i] == v])
    initial = list(mode)
    events: list[tuple[float, int, int]] = []
    while t < t_end:
        gaps, forces = law.expand(z, w, mode)
        h = min(_REACH / law.rate, t_end - t)
        is_event = False
        for i in range(n):
            if mode[i] != 0:
                functions = [gaps[i]]
            elif law.mu[i] == 0:
                functions = []
            else:
                functions = [[law.mu[i] + s * forces[i][0]] + [s * c for c in forces[i][1:]] for s in (1, -1)]
            for poly in functions:
                root = _first_root(_without_root_at_start(poly), h)
                if root is not None:
                    h, is_event = root, True
        z = [
            z[i] + v * h + sum(gaps[i][k] * h ** (k + 1) / (k + 1) for k in range(_ORDER))
            if mode[i] != 0
            else z[i] + v * h
            for i in range(n)
        ]
        w = [v + _value(gaps[i], h) if mode[i] != 0 else v for i in range(n)]
        t += h
        touching = [i for i in range(n) if mode[i] == 0 or abs(w[i] - v) < _ZERO]
        if is_event or len(touching) > mode.count(0):
            new = law.decide(z, [v if i in touching else w[i] for i in range(n)], mode, touching)
            for i in touching:
                w[i] = v
                if new[i] != mode[i]:
                    events.append((float(t), i, new[i]))
            mode = new
    return Reference(
        [e[0] for e in events],
        [e[1] for e in events],
        [e[2] for e in events],
        initial,
        np.array([float(x) for x in z]),
        np.array([float(x) for x in w]),
    )
