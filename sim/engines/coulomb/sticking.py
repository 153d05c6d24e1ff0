"""Which blocks stick: those at the belt's speed, all decided together from |F| and the static friction m.

Where |F| = m, as at every exit, the first coefficient of the series of F that does not vanish decides. A block whose
m is the kinetic friction leaves with w' = 0, as if it stuck; one with m above it leaves with a jump of w', which the
others feel from the second order of F on, or from the first by damping between blocks. If such an exit is found there
or later, all blocks with |F| = m are decided anew with that block slipping: blocks that leave while the others stick
leave together, and the others are decided again without them.
"""

from __future__ import annotations

from stickslip.sim.engines.coulomb.expansion import Expansion
from stickslip.sim.engines.coulomb.model import Cross, Model
from stickslip.sim.engines.forcing import acts
from stickslip.sim.kernels.compile import inner
from stickslip.sim.numerics.arithmetic import ROUNDING

UNDECIDED_BOTH = 2  # a block without friction with w = v and F = 0: either side is open
IDENTICALLY_ZERO = 320  # beyond every order of a series


@inner
def _of_others(cross: Cross | None, k: int, i: int) -> float:
    if cross is None:
        return 0.0
    return cross.noise[k, i]


@inner
def known(model: Model, k: int, i: int) -> float:
    """The sum of the magnitudes of the terms of the k-th coefficient of forces on block i beside K z.

    That is, of the external force, and of damping between blocks.
    """
    external = model.forcing.noise[k, i] if acts(model.forcing) else 0.0
    return external + _of_others(model.cross, k, i)


@inner
def force_rounding(drag: float, pull: float, most: float, forcing: float) -> float:
    """A bound of the rounding of |F| - m of a block, from the magnitudes of its terms."""
    return ROUNDING * (abs(drag) + pull + most + forcing)


@inner
def push(closed: int, force: float) -> float:
    """The force that pushes a sticking block towards an open side: |F| if both sides are open."""
    return abs(force) if closed == 0 else closed * force


@inner
def settle(model: Model, z_max: float, expansion: Expansion) -> int:
    """Decide every block with w = v from |F| and m; returns how many have |F| = m and stay undecided."""
    damping, static, closed, v = model.damping, model.static, model.closed, model.belt_speed
    forces, mode, touching = expansion.forces, expansion.mode, expansion.touching
    zeros, side, leaves = expansion.zeros, expansion.side, expansion.leaves
    n_undecided = 0
    for i in range(len(mode)):
        zeros[i] = 0
        side[i] = 0
        if touching[i] or mode[i] == 0:
            most = static[i]
            force = damping[i] * v[i] + forces[0, i]
            slack = force_rounding(damping[i] * v[i], model.row_sums[i] * z_max, most, known(model, 0, i))
            outward = push(closed[i], force)
            if (leaves[i] != 0 and outward > model.friction[i]) or outward > most + slack:
                mode[i] = -1 if force > 0.0 else 1
                zeros[i] = 1
                side[i] = leaves[i]
            else:
                mode[i] = 0
                if outward >= most - slack:
                    n_undecided += 1
                    zeros[i] = IDENTICALLY_ZERO
                    if closed[i] != 0:
                        side[i] = -closed[i]
                    else:
                        side[i] = UNDECIDED_BOTH if most <= slack else (-1 if force > 0.0 else 1)
    return n_undecided


@inner
def settle_by_order(model: Model, k: int, c_max: float, expansion: Expansion) -> tuple[int, bool]:
    """Decide the blocks with |F| = m whose F has its first coefficient that is not zero at order k.

    Returns how many they are, and whether to begin again since one of them leaves with a jump of w'.
    """
    forces, mode, zeros, side = expansion.forces, expansion.mode, expansion.zeros, expansion.side
    friction, static, leaves = model.friction, model.static, expansion.leaves
    n_decided, is_repeated = 0, False
    for i in range(len(mode)):
        if side[i] != 0 and zeros[i] == IDENTICALLY_ZERO:
            push = -forces[k, i]
            if abs(push) > ROUNDING * (model.row_sums[i] * c_max + known(model, k, i)):
                n_decided += 1
                if side[i] == UNDECIDED_BOTH:
                    side[i] = 1 if push > 0.0 else -1
                if push * side[i] > 0.0:
                    mode[i] = side[i]
                    zeros[i] = k + 1
                    if static[i] > friction[i]:
                        zeros[i] = 1
                        expansion.series[2, i] = 0.5 * (static[i] - friction[i]) * side[i]
                        # others feel it from this order on; if its side was known, rounding at the edge decides
                        is_felt = k > 1 or model.cross is not None
                        if is_felt and leaves[i] == 0:
                            leaves[i] = side[i]
                            is_repeated = True
                else:
                    zeros[i] = k
    if is_repeated:
        for i in range(len(mode)):
            expansion.touching[i] = expansion.touching[i] or side[i] != 0
    return n_decided, is_repeated
