"""The Runge-Kutta method of the stiff engine: ESDIRK4(3)6L[2]SA.

Order 4, embedded order 3, six stages of which the first is explicit, stage order 2, L-stable, stiffly accurate: the
implicit half of ARK4(3)6L[2]SA. C. A. Kennedy and M. H. Carpenter, Applied Numerical Mathematics 44 (2003) 139-181,
doi:10.1016/S0168-9274(02)00138-1. The order conditions are tested in exact arithmetic.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from stickslip.sim.arguments import Floats

_F = Fraction
#: Stage weights a_ij by rows; the last row is b (stiffly accurate). gamma = 1/4 on the diagonal.
TABLEAU = (
    (),
    (_F(1, 4), _F(1, 4)),
    (_F(8611, 62500), _F(-1743, 31250), _F(1, 4)),
    (_F(5012029, 34652500), _F(-654441, 2922500), _F(174375, 388108), _F(1, 4)),
    (
        _F(15267082809, 155376265600),
        _F(-71443401, 120774400),
        _F(730878875, 902184768),
        _F(2285395, 8070912),
        _F(1, 4),
    ),
    (_F(82889, 524892), _F(0), _F(15625, 83664), _F(69875, 102672), _F(-2260, 8211), _F(1, 4)),
)
#: Weights of the embedded method of order 3.
EMBEDDED = (
    _F(4586570599, 29645900160),
    _F(0),
    _F(178811875, 945068544),
    _F(814220225, 1159782912),
    _F(-3700637, 11593932),
    _F(61727, 225920),
)
NODES = tuple(sum(row, _F(0)) for row in TABLEAU)

#: Number of stages; gamma, the common diagonal; a_ij, b - embedded b and the predictor's weights as arrays.
STAGES = len(TABLEAU)
GAMMA = float(TABLEAU[1][1])
WEIGHTS = np.array([[float(a) for a in row] + [0.0] * (STAGES - len(row)) for row in TABLEAU])
ERROR = np.array([float(b - e) for b, e in zip(TABLEAU[-1], EMBEDDED, strict=True)])


def _predictor() -> Floats:
    """p_ij with w(c_i) ~ w_0 + h sum_{j<i} p_ij w'_j: w' extrapolated through the stages before and integrated."""
    nodes = np.array([float(c) for c in NODES])
    weights = np.zeros((STAGES, STAGES))
    for i in range(1, STAGES):
        powers = np.arange(i)
        moments = nodes[i] ** (powers + 1) / (powers + 1)
        weights[i, :i] = np.linalg.solve(np.vander(nodes[:i], increasing=True).T, moments)
    return weights


PREDICT = _predictor()
