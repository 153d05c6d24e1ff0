"""Friction laws of the sigmoid engine: phi(x) and its derivative, x = (w - v) / delta.

A law is written once, for numbers of `lanes`, and friction is mu phi; phi is odd, and smooth on the scale of 1. A
kernel is compiled for one law, which the type of its argument names: `Peaked`,
`SetValued`, `Steady`, `Polynomials`, or the kind of a law of `stickslip.sim.systems.weakening`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from stickslip.sim.engines.polynomials import Polynomials
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.lanes import Lane, absolute, copysign, exponential, less, on_number, where
from stickslip.sim.systems.weakening import LAW_OF


class Peaked(NamedTuple):
    """s(tanh x), s(l) = l + c l (1 - l^2): static friction above the kinetic, or equal to it, c = 0."""


class SetValued(NamedTuple):
    """Sign x: any friction up to the static at x = 0. No formula evaluates it; see `pieces.py`."""


class Steady(NamedTuple):
    """As `Peaked`, with a side that may be closed: `open_sign` without weakening."""


#: A friction law: one of these; or, for `open_sign`, the kind of one that depends on speed, or its `Polynomials`.
Law: TypeAlias = type[tuple[Any, ...]] | Polynomials


def shape_of(law: Law) -> Callable[[Lane], tuple[Lane, Lane]] | None:
    """S and its derivative; None if friction does not depend on speed."""
    if isinstance(law, Polynomials):
        return law.on_lanes
    return LAW_OF[law].on_lanes if law in LAW_OF else None


def smooth_sign(x: Lane) -> tuple[Lane, Lane]:
    """tanh x, to 2 units in the last place of 1, and its derivative."""
    e = exponential(less(absolute(x), 20.0) * -2.0)
    size = (1.0 - e) / (1.0 + e)
    return copysign(size, x), 1.0 - size * size


def peaked_sign(x: Lane, c: Lane) -> tuple[Lane, Lane]:
    """s(tanh x), and its derivative, which is negative beyond the peak."""
    lam, rise = smooth_sign(x)
    return lam + c * (lam * rise), rise * (c * (rise * 3.0 - 2.0) + 1.0)


def open_sign(law: Law, x: Lane, c: Lane, far: Lane, weakening: Lane, closed: Lane) -> tuple[Lane, Lane]:
    """s(tanh x) (f + (1 - f) S(b |x|)), and its derivative; on a side that is closed, its tangent at x = 0.

    f is `far`, b is `weakening`, and `closed` is the sign of x on the closed side, or 0. There |x| grows with the
    force, and w - v = delta x tends to 0 with delta: no block slips to that side.
    """
    value, slope = peaked_sign(x, c)
    if (shape_at := shape_of(law)) is not None:
        shape, slope_of_shape = shape_at(absolute(x) * weakening)
        rest = 1.0 - far
        slope = slope * (far + rest * shape) + absolute(value) * (rest * weakening * slope_of_shape)
        value = value * (far + rest * shape)
    is_closed = x * closed > 0.0
    return where(is_closed, (c + 1.0) * x, value), where(is_closed, c + 1.0, slope)


_smooth_sign_of_number = on_number(smooth_sign)


@inner
def sign_of_number(x: float, c: float) -> float:
    """s(tanh x); with c = 0 that is tanh x to the last bit."""
    lam, rise = _smooth_sign_of_number(x)
    return lam + c * (lam * rise)
