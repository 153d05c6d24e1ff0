"""Friction laws, as the smoothed engine takes them: phi(x) and its derivative, x = (w - v) / delta.

A law is written once, for numbers of `lanes`, and friction is mu phi. What the steps ask of phi: it is odd, and
smooth on the scale of 1. The engine integrates with `LAW`; that collapses are certain is proved for tanh, in
`certificates.py`.
"""

from __future__ import annotations

from stickslip.sim.engines.lanes import Lane, absolute, exponential, less, on_number


def smooth_sign(x: Lane) -> tuple[Lane, Lane]:
    """tanh x, to 2 units in the last place of 1, and its derivative."""
    e = exponential(less(absolute(x), 20.0) * -2.0)
    size = (1.0 - e) / (1.0 + e)
    return size.call("copysign", x), 1.0 - size * size


LAW = smooth_sign
#: The same for one number, in kernels.
law_of_number = on_number(LAW)
