"""What the numbers of a dataset mean, in words that travel with them: equation, symbols, coupling, units, seed."""

from __future__ import annotations

import json

from stickslip.pipeline.scene.system_table import OF_FILE, OF_GRAPH, SystemTable
from stickslip.sim.systems.couplings import COUPLINGS
from stickslip.sim.systems.graphs import GRAPHS
from stickslip.sim.systems.weakening import LAWS

EQUATION = (
    "m_i z_i'' + R_i z_i' + sum_j N_ij z_j' + sum_j K_ij z_j + mu_i lambda_i = f_i(t), lambda_i in Sign(z_i' - v_i):"
    " lambda_i = +1 where z_i' > v_i, -1 where z_i' < v_i, and in [-1, 1] while block i sticks, z_i' = v_i; it sticks"
    " while |R_i v_i + sum_j (N_ij z_j' + K_ij z_j) - f_i| <= static_i"
)
SYMBOLS = {
    "z": "displacement of a block",
    "w": "its velocity, z'",
    "t": "time",
    "K": "stiffness: block j displaced by one pushes block i with the force -K_ij",
    "R": "damping of a block",
    "N": "damping between blocks, the entries of a full damping matrix off its diagonal; zero unless given",
    "m": "mass of a block; one unless given",
    "mu": "kinetic friction of a block",
    "static": "static friction of a block; the kinetic unless given",
    "v": "speed of the belt under a block",
    "f": "external force on a block; zero unless given",
    "lambda": "share of the kinetic friction that acts on a block",
    "n_stick": "number of blocks that stick",
    "mode": "0: the block sticks; +1, -1: it slips with w above, below the speed of its belt",
}


def meaning(system: SystemTable, seed: object, load: str | None) -> tuple[tuple[str, str], ...]:
    """What determines the data, in words, by key."""
    words = {
        "equation": EQUATION,
        "symbols": json.dumps(SYMBOLS),
        "coupling": _coupling(system),
        "units": "dimensionless, but for columns that name a unit: times their scale they are in it",
        "seed": f"{seed}: root of all random draws, by numpy.random.SeedSequence and PCG64",
    }
    if system.weakening is not None:
        law, by_table = system.weakening.law, (system.weakening.speeds, system.weakening.coefficients)
        formula = "friction times {1} at the speeds {0}, joined by cubics without overshoot".format(*by_table)
        formula = formula if law is None else LAWS[law].formula
        words["friction"] = f"kinetic friction depends on the speed of slip w - v: {formula}"
    if not system.back_slip:
        words["back_slip"] = "barred: no block gets ahead of its belt"
    if load is not None:
        words["load"] = (
            "adiabatic: the belt waits while a block slips and, once all stick, goes at once to where the next gives"
            " way; t is its travel over |v|"
        )
    return tuple(words.items())


def _coupling(system: SystemTable) -> str:
    """How K follows from the keys of a scene."""
    name = system.coupling
    graph = (
        "K = kappa L + leaf I with the Laplacian L of a graph: springs of stiffness kappa, and leaf to the ground; "
    )
    if name in COUPLINGS:
        return f"{name}: {COUPLINGS[name].words}, of U with entries uniform in [-kappa, kappa]"
    if name in GRAPHS:
        return f"{name}: {graph}{GRAPHS[name].words}"
    if name == OF_GRAPH:
        return f"{name}: {graph}that of the file, times its weights"
    return f"{name}: K as in the file" if name == OF_FILE else f"{name}: a function of its author's makes the system"
