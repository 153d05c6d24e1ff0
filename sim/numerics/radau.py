"""Coefficients of the Radau IIA method of five stages: order 9, stiffly accurate, L-stable.

E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.8. On a step mapped to [0, 1], with
nodes c_k and their Lagrange polynomials l_k, a rate given at the nodes is a polynomial of degree 4, and its integral
one of degree 5, given by its values at 0 and the nodes. The method is tested by its definition.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import legendre
from numpy.polynomial.polynomial import polyfromroots

from stickslip.sim.numerics.arguments import Floats

STAGES = 5


def _nodes() -> Floats:
    """Zeros of P_5 - P_4 on (-1, 1], mapped to (0, 1]."""
    series = [0.0] * (STAGES - 1) + [-1.0, 1.0]
    x = np.sort(legendre.legroots(series).real)
    for _ in range(3):
        x -= legendre.legval(x, series) / legendre.legval(x, legendre.legder(series))
    x[-1] = 1.0
    return (x + 1.0) / 2.0


def _to_powers(nodes: Floats) -> Floats:
    """Values at nodes in [0, 1] to powers: column k holds l_k, multiplied out, where no two terms cancel."""
    other_nodes = [np.delete(nodes, k) for k in range(len(nodes))]
    return np.stack(
        [polyfromroots(rest) / np.prod(x - rest) for x, rest in zip(nodes, other_nodes, strict=True)], axis=1
    )


def powers(x: Floats, count: int) -> Floats:
    """1, x, x^2, ..., shape (len(x), count)."""
    return np.vander(x, count, increasing=True)


def _bernstein(degree: int) -> Floats:
    """Power basis to Bernstein basis on [0, 1]."""
    return np.array([[math.comb(j, k) / math.comb(degree, k) for k in range(degree + 1)] for j in range(degree + 1)])


NODES = _nodes()
#: The coefficients m = 0 ... 4 of Legendre's polynomials on [0, 1], of a polynomial given at the nodes.
TO_LEGENDRE = np.linalg.inv(legendre.legvander(2.0 * NODES - 1.0, STAGES - 1))
#: a_kj, its inverse, and the weights b_k, the last row. By Legendre's polynomials: from powers rounding is 1e-13, and
#: a constant force of 1000 would seem to change by what tight tolerances do not allow.
WEIGHTS = legendre.legval(2.0 * NODES - 1.0, legendre.legint(np.eye(STAGES), lbnd=-1.0, scl=0.5)).T @ TO_LEGENDRE
INVERSE = np.linalg.inv(WEIGHTS)
LAST = WEIGHTS[-1].copy()
#: The coefficients of h y' by Legendre's polynomials, from the changes of y at the nodes.
OF_RATE = TO_LEGENDRE @ INVERSE
#: Values at the nodes to powers. The same for values at 0 and the nodes.
TO_POWERS = _to_powers(NODES)
ALL_NODES = np.append(0.0, NODES)
ALL_TO_POWERS = _to_powers(ALL_NODES)
#: From integrals of x^p z(x) over [0, 1] to the values at the nodes of the L2 projection of z: (1 / b_k) times the
#: integral of l_k z, as the quadrature is exact for l_k l_j.
PROJECT = TO_POWERS.T / LAST[:, None]
#: Values at 0 and the nodes to Bernstein coefficients, whose hull contains the polynomial.
TO_BERNSTEIN = _bernstein(STAGES) @ ALL_TO_POWERS
#: The places off the nodes at which the defect is tested: the start, which is no node, and between the nodes; and the
#: matrices that interpolate there.
PLACES = np.append(0.0, (ALL_NODES[1:] + ALL_NODES[:-1]) / 2.0)
AT_PLACES = powers(PLACES, STAGES) @ TO_POWERS
ALL_AT_PLACES = powers(PLACES, STAGES + 1) @ ALL_TO_POWERS
#: 1 / prod_{m != k} (x_k - x_m) of the start and the nodes.
BARYCENTRIC = 1.0 / np.array([np.prod(x - np.delete(ALL_NODES, k)) for k, x in enumerate(ALL_NODES)])
