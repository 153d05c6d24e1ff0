"""A curve of the speed of slip as polynomials, piece by piece: a law as data, for which nothing is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from stickslip.sim.numerics.arguments import Floats

#: Coefficients of a polynomial; most pieces; and the speed, in units of x, beyond which a curve is constant.
N_TERMS, MOST, FASTEST = 12, 255, 1e6
#: The errors that are tried, over the size of the curve, until `MOST` pieces do.
_ERRORS = (2e-14, 1e-13, 1e-11, 1e-8, 1e-5)
#: The least length of a piece, over its distance from 0 and the length of the first: at a kink. What changes by more
#: than this share of its size there jumps.
_LEAST, _JUMP = 1e-9, 1e-6
#: The least length of the first.
_SHORTEST = 1e-15
#: The margin of a piece of a table, over its length: a step that comes to its end goes this far beyond.
_MARGIN = 1e-9
_NODES = np.cos(np.pi * (np.arange(N_TERMS) + 0.5) / N_TERMS)
_BETWEEN = np.linspace(-1.0, 1.0, 2 * N_TERMS + 1)
#: From values at the nodes to a Chebyshev series, and from that to powers: in one product rounding would grow.
_TO_SERIES = chebyshev.chebvander(_NODES, N_TERMS - 1).T * (2.0 / N_TERMS)
_TO_SERIES[0] *= 0.5
_TO_POWERS = np.zeros((N_TERMS, N_TERMS))
for _k in range(N_TERMS):
    _TO_POWERS[: _k + 1, _k] = chebyshev.cheb2poly(np.eye(N_TERMS)[_k, : _k + 1])
_AT_BETWEEN = np.vander(_BETWEEN, N_TERMS, increasing=True)


class Pieces(NamedTuple):
    """A curve of x >= 0, by m polynomials of x - centre."""

    #: The x from which a polynomial is the curve, up to the next, of the first 0; those between which it is the curve
    #: to its error, which are beyond its piece where the curve is smooth; and its centre. Shape (4, m).
    places: Floats
    terms: Floats  #: by powers, shape (m, 12)
    error: float  #: of the curve, over its size

    @property
    def start(self) -> Floats:
        """The x from which each polynomial is the curve."""
        return self.places[0]

    def at(self, x: Any) -> Any:
        """The curve at x of any shape; of complex x at the real part, and by its slope."""
        k = np.searchsorted(self.start, np.real(x), side="right") - 1
        k, value = np.maximum(k, 0), 0.0
        step = x - self.places[3, k]
        for power in reversed(range(N_TERMS)):
            value = value * step + self.terms[k, power]
        return value

    def scaled(self, x: float, y: float) -> Pieces:
        """The curve of x times this number, and as many times as high as `y` says."""
        return Pieces(self.places * x, self.terms * x ** -np.arange(N_TERMS) * y, self.error)

    @property
    def steepest(self) -> float:
        """The least a for which |S'| <= a and, but for kinks, |S''| <= a^2."""
        k, share = np.arange(len(self.start) - 1), np.linspace(0.0, 1.0, 9)[:, np.newaxis]
        length = np.diff(self.start)
        step = self.start[k] + share * length - self.places[3, k]
        slope, bend = np.zeros((2, *step.shape))
        for power in reversed(range(1, N_TERMS)):
            slope = slope * step + power * self.terms[k, power]
        for power in reversed(range(2, N_TERMS)):
            bend = bend * step + power * (power - 1) * self.terms[k, power]
        steep = np.abs(slope).max(initial=0.0)
        bends = np.where(length * steep > 1e-3, np.abs(bend), 0.0)
        return float(max(steep, np.sqrt(bends.max(initial=0.0))))

    @property
    def range(self) -> tuple[float, float, float]:
        """The least and the largest value, and the x of the least."""
        k, share = np.arange(len(self.start) - 1), np.linspace(0.0, 1.0, 33)[:, np.newaxis]
        x = np.append((self.start[k] + share * np.diff(self.start)).ravel(), self.start[-1])
        values = self.at(x)
        least = int(np.argmin(values))
        return float(values[least]), float(values.max()), float(x[least])


def of_cubics(x: Floats, terms: Floats, last: float) -> Pieces:
    """The pieces of a curve given by cubics from each x to the next, shape (m, 4), and constant from the last on."""
    rest, margin = np.zeros((len(x), N_TERMS)), _MARGIN * np.diff(x)
    rest[:-1, :4], rest[-1, 0] = terms, last
    low, high = np.append(x[:-1] - margin, x[-1] - margin[-1]), np.append(x[1:] + margin, np.inf)
    low[0] = -np.inf
    return Pieces(np.array([x, low, high, x]), rest, 0.0)


def sampled(curve: Callable[[Floats], Floats], fastest: float, name: str) -> Pieces:
    """The pieces of a curve up to a speed, beyond which it is constant.

    Raises `ValueError` if it is not finite, jumps, or takes more than 255 pieces for an error of 1e-5.
    """

    def values(x: Floats) -> Floats:
        with np.errstate(all="ignore"):
            y = curve(x)
        if not np.isfinite(y).all():
            at = float(x[~np.isfinite(y)][0])
            raise ValueError(f"{name}: expected finite friction, got {y[~np.isfinite(y)][0]} at {at:g}")
        return y

    for allowed in _ERRORS:
        if (pieces := _within(values, fastest, allowed, name)) is not None:
            return pieces
    raise ValueError(
        f"{name}: expected a curve that {MOST} polynomials of order {N_TERMS - 1} follow to {_ERRORS[-1]:g} of its"
        f" size up to a speed of {fastest:g}, got one that bends more often; lower `fastest`, or smooth it"
    )


def _within(values: Callable[[Floats], Floats], fastest: float, allowed: float, name: str) -> Pieces | None:
    """The pieces to an error, each as long as it may be; None if they are too many."""
    rows: list[tuple[float, float, float, float]] = []
    terms: list[Floats] = []
    first = np.abs(values(np.zeros(1)))[0]
    start, length, least = 0.0, min(1.0, fastest), 0.0
    while start < fastest:
        end = min(start + length, fastest)
        low, high = max(0.0, start - 0.5 * length), min(end + 0.5 * length, fastest)
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        term = _TO_POWERS @ (_TO_SERIES @ values(centre + half * _NODES))
        truth = values(centre + half * _BETWEEN)
        error, size = np.abs(_AT_BETWEEN @ term - truth).max(), max(np.abs(truth).max(), first)
        shortest = max(_LEAST * (start + least), _SHORTEST)
        if error > allowed * size and length > shortest:
            length = max(0.5 * length, shortest)
            continue
        if length <= _SHORTEST:
            return None  # its slope has no bound at 0
        if error > max(allowed, _JUMP) * size:
            raise ValueError(
                f"{name}: expected a continuous curve, got one that changes by {error:.3g} at {start:g}; smooth it"
            )
        rows.append((start, low if rows else -np.inf, high, centre))
        terms.append(term / half ** np.arange(N_TERMS))
        if len(rows) == MOST:
            return None
        least = least or length
        start, length = end, 2.0 * length
    last = np.zeros(N_TERMS)
    last[0] = values(np.array([fastest]))[0]
    rows.append((fastest, fastest * (1.0 - _MARGIN), np.inf, fastest))
    return Pieces(np.array(rows).T.copy(), np.array([*terms, last]), allowed)
