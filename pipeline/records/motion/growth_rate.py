"""The growth rate of the state in which all blocks slip."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Memory, Record, Sharing
from stickslip.sim.systems.drive import Piecewise
from stickslip.sim.systems.system import System

_KNOWN: WeakKeyDictionary[System, float] = WeakKeyDictionary()


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
        system = result.system
        if system.weakening is not None and isinstance(system.belt_speed, Piecewise):
            return {}
        if system not in _KNOWN:
            drag = system.kinetic_slope(system.belt_speed_at(0.0))
            _KNOWN[system] = float(np.linalg.eigvals(system.slip_matrix(drag)).real.max())
        return {"growth_rate": _KNOWN[system]}
