"""The exact engine against fifty digits: ``pip install python-flint``, then ``python docs/digits.py 200 25``.

The same law, z'' = -R z' - K z - mu sgn(z' - v), by Taylor series in ball arithmetic, event by event. It shares no
code with the package: of a system only its numbers are read, taken as exact. An event is a root of a polynomial,
isolated by halving until a ball shows that there is none, or that the function falls throughout; where a ball cannot
decide, as at a touch, it raises `Undecided`: rounding decides nothing. 200 blocks to t = 1000 take half an hour.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat, arb_poly, ctx

from stickslip import System, draw_system, simulate

DIGITS, ORDER = 50, 120
#: The last terms of a series, over the scale of the velocities; the interval below which a root is not sought.
LEAST, TINY = arb(10) ** -DIGITS, arb(10) ** (-2 * DIGITS // 3)
ctx.prec = int(3.33 * DIGITS) + 40
Balls = list[arb]


class Undecided(RuntimeError):
    """Two futures that this many digits cannot tell apart."""


class Followed(NamedTuple):
    """Events as (t, block, mode), and z at the end."""

    events: list[tuple[float, int, int]]
    z: np.ndarray


def is_positive(x: arb) -> bool:
    if x > 0:
        return True
    if x < 0:
        return False
    raise Undecided(f"the sign of {x}")


def first_root(p: arb_poly, low: arb, high: arb) -> arb | None:
    """The first root in (low, high) of a polynomial that is positive at `low`."""
    middle, half = ((low + high) / 2).mid(), ((high - low) / 2).mid()
    c = p(arb_poly([middle, half])).coeffs()
    size = [abs(x) for x in c]
    if size[0] > sum(size[1:], arb(0)):
        return None
    if len(c) > 1 and size[1] > sum((k * x for k, x in enumerate(size[2:], 2)), arb(0)):
        return by_newton(p, low, high) if c[1] < 0 and p(high) < 0 else None
    if half < TINY:
        raise Undecided(f"a touch at {middle}")
    found = first_root(p, low, middle)
    return first_root(p, middle, high) if found is None else found


def by_newton(p: arb_poly, low: arb, high: arb) -> arb:
    """The root of a polynomial that falls from positive to negative; halved where Newton's method leaves that."""
    slope, x = p.derivative(), ((low + high) / 2).mid()
    for _ in range(400):
        value = p(x)
        if value > 0:
            low = x
        elif value < 0:
            high = x
        else:
            return x
        x = (x - value / slope(x)).mid()
        if not low < x < high:
            x = ((low + high) / 2).mid()
            if not low < x < high:
                return x
    return x


class Exact:
    """A system of constant belts, one friction or static friction above it, without forces."""

    def __init__(self, system: System) -> None:
        self.n, self.k = system.n, arb_mat([[arb(float(x)) for x in row] for row in system.stiffness])
        each = (system.damping, system.friction, system.static, np.broadcast_to(system.belt_speed_at(0.0), system.n))
        self.r, self.mu, self.static, self.v = ([arb(float(x)) for x in one] for one in each)
        self.rate = float(system.damping.max()) + float(system.row_sums.max()) ** 0.5

    def force(self, z: Balls) -> Balls:
        """F = K z + R v, that friction has to hold."""
        return [x + r * v for x, r, v in zip((self.k * arb_mat(self.n, 1, z)).entries(), self.r, self.v, strict=True)]

    def mode_of(self, i: int, force: arb) -> int:
        """The mode of a block at its belt's speed."""
        side = -1 if is_positive(force) else 1
        return 0 if is_positive(self.static[i] - abs(force)) else side

    def series(
        self, z: Balls, w: Balls, mode: list[int], left: int, h: float
    ) -> tuple[list[Balls], list[Balls], float]:
        """Coefficients of z and of F, by orders, and how far they hold, at most h; block `left` has |F| = m."""
        c, forces, scale, n_small = [list(z), list(w)], [], max(float(abs(x)) for x in (*w, *self.v)), 0
        for k in range(ORDER):
            product = (self.k * arb_mat(self.n, 1, c[k])).entries()
            forces.append([x + r * v for x, r, v in zip(product, self.r, self.v, strict=True)] if k == 0 else product)
            new = []
            for i, side in enumerate(mode):
                if side == 0:
                    new.append(arb(0))
                elif k == 0 and i == left:
                    new.append(side * (self.static[i] - self.mu[i]) / 2)
                else:
                    push = side * self.mu[i] if k == 0 else arb(0)
                    new.append(-(product[i] + self.r[i] * (k + 1) * c[k + 1][i] + push) / ((k + 2) * (k + 1)))
            c.append(new)
            size = max(float(abs(x).upper()) for x in new)
            n_small = n_small + 1 if k > 2 and arb(size) * arb(h) ** (k + 2) < LEAST * scale else 0
            if n_small == 3:
                return c, forces, h
        last = max(float(abs(x).upper()) for x in c[-1])
        return c, forces, min(h, float(((LEAST * scale / last).log() / (ORDER + 1)).exp()))

    def follow(self, z0: float, w0: float, t_end: float) -> Followed:
        """From one state of all blocks on."""
        z, w, t, events = [arb(z0)] * self.n, [arb(w0)] * self.n, arb(0), list[tuple[float, int, int]]()
        start = self.force(z)
        mode = [
            self.mode_of(i, start[i]) if w[i].overlaps(v) else (1 if w[i] > v else -1) for i, v in enumerate(self.v)
        ]
        left, h = -1, 0.5
        while t < arb(t_end):
            rest = arb(t_end) - t
            c, forces, reach = self.series(z, w, mode, left, min(float(rest) * (1 + 1e-12), 1.3 * h, 5.0 / self.rate))
            step, block = (rest if rest <= arb(reach) else arb(reach)).mid(), -1
            for i, side in enumerate(mode):
                for p in self.until(i, side, c, forces):
                    # the block that an event has left at the belt's speed begins with a root at zero
                    p = p[1 + (self.static[i] == self.mu[i] and i == left) :] if side and p[0].contains(arb(0)) else p
                    first, powers = float(p[0].mid()), float(step) ** np.arange(1, len(p))
                    if first > float(np.abs([float(x.mid()) for x in p[1:]]) @ powers) * (1 + 1e-9):
                        continue
                    if not is_positive(p[0]):
                        raise Undecided(f"block {i} is past its event")
                    root = first_root(arb_poly(p), arb(0), step)
                    if root is not None:
                        step, block = root, i
            t, h = (t + step).mid(), 0.9 * h + 0.15 * float(step) if block >= 0 else 1.3 * h
            powers = [step**k for k in range(len(c))]
            z = [sum((a[i] * x for a, x in zip(c, powers, strict=True)), arb(0)).mid() for i in range(self.n)]
            w = [sum((k * a[i] * powers[k - 1] for k, a in enumerate(c) if k), arb(0)).mid() for i in range(self.n)]
            left = -1
            if block >= 0:
                w[block], force = self.v[block], self.force(z)[block]
                if mode[block] == 0:
                    mode[block], left = -1 if is_positive(force) else 1, block
                else:
                    mode[block] = self.mode_of(block, force)
                events.append((float(t), block, mode[block]))
        return Followed(events, np.array([float(x) for x in z]))

    def until(self, i: int, side: int, c: list[Balls], forces: list[Balls]) -> list[Balls]:
        """What is positive until block i has an event."""
        if side:
            slip = [side * (k + 1) * a[i] for k, a in enumerate(c[1:])]
            return [[slip[0] - side * self.v[i], *slip[1:]]]
        load = [a[i] for a in forces]
        return [[self.static[i] + sign * load[0], *(sign * x for x in load[1:])] for sign in (1, -1)]


def main(n: int, t_end: float) -> None:
    """Compare runs of the engine at some tolerances."""
    system = draw_system("antisymmetric", n, seed=0)
    true = Exact(system).follow(-0.7, -0.4, t_end)
    print(f"{len(true.events)} events")
    in_order = sorted(true.events, key=lambda event: (event[1], event[0]))
    for tol in (1e-5, 1e-6, 1e-8, 1e-10, 1e-12):
        run = simulate(system, -0.7, -0.4, t_end, tol=tol, stop_early=False)
        order = run.events.by_block
        same = [(b, m) for _, b, m in in_order] == list(
            zip(run.events.block[order].tolist(), run.events.mode[order].tolist(), strict=True)
        )
        late = max(
            (abs(a - b) for (a, _, _), b in zip(in_order, run.events.t[order].tolist(), strict=False)), default=0
        )
        print(f"{tol:g} {run.stats.method}: error of z {np.abs(run.z - true.z).max():.1e}", end=", ")
        print(f"of event times {late:.1e}" if same else f"{len(run.events)} events, not the same")


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
