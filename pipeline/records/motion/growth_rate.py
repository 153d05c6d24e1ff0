"""The growth rate of the state in which all blocks slip."""

from __future__ import annotations

from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Memory, Record, Sharing
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.sliding import steady_matrix
from stickslip.sim.systems.system import System


@once_a_system
def _growth_rate(system: System) -> float | None:
    matrix = steady_matrix(system)
    return None if matrix is None else float(np.linalg.eigvals(matrix).real.max())


class GrowthRate(Record):
    """The largest real part of the eigenvalues of the system with all blocks slipping."""

    name = "growth_rate"
    words = "whether to keep the growth rate of the all-slip state; its eigenvalues cost as much as a run"
    example = None
    columns = (
        Column(
            "number",
            "growth_rate",
            "largest real part of the eigenvalues of the system with all blocks slipping at "
            "the speeds of their belts, with the slope of friction there",
            absent="friction depends on the speed of a belt that changes",
            note="below 0 small deviations from that decay",
            dimension="frequency",
        ),
    )
    is_shared = True
    needs = frozenset({"system"})

    def memory(self, facts: Facts) -> Memory:
        # the matrix of 2n rows, its complex eigenvectors and what LAPACK keeps
        return Memory(160.0 * facts.n**2, "finding eigenvalues", "set it to false")

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 1e-8 * member.n**3 / (sharing.engines * sharing.draws)

    def of(self, result: Made) -> dict[str, Any]:
        rate = _growth_rate(result.system)
        return {} if rate is None else {"growth_rate": rate}
