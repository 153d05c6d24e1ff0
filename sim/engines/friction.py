"""Friction laws, as the smoothed engine takes them: phi(x) and its derivative, x = (w - v) / delta.

A law is written once, for numbers of `lanes`, and friction is mu phi. What the steps ask of phi: it is odd, and
smooth on the scale of 1. Which law a kernel is compiled for, the type of what it is given says: `Plain` or `Peaked`.
"""

from __future__ import annotations

from typing import NamedTuple

from stickslip.sim.engines.compile import inner
from stickslip.sim.engines.lanes import Lane, absolute, exponential, less, on_number


class Plain(NamedTuple):
    """tanh x."""


class Peaked(NamedTuple):
    """s(tanh x), s(l) = l + c l (1 - l^2): static friction above the kinetic; see `StaticAboveKinetic`."""


def smooth_sign(x: Lane) -> tuple[Lane, Lane]:
    """tanh x, to 2 units in the last place of 1, and its derivative."""
    e = exponential(less(absolute(x), 20.0) * -2.0)
    size = (1.0 - e) / (1.0 + e)
    return size.call("copysign", x), 1.0 - size * size


def peaked_sign(x: Lane, c: Lane) -> tuple[Lane, Lane]:
    """s(tanh x), and its derivative, which is negative beyond the peak."""
    lam, rise = smooth_sign(x)
    return lam + c * (lam * rise), rise * (c * (rise * 3.0 - 2.0) + 1.0)


_smooth_sign_of_number = on_number(smooth_sign)


@inner
def sign_of_number(x, c):  # type: ignore[no-untyped-def]
    """s(tanh x); with c = 0 that is tanh x to the last bit."""
    lam, rise = _smooth_sign_of_number(x)
    return lam + c * (lam * rise)
