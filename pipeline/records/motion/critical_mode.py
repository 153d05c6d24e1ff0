"""The critical mode of steady sliding: see `stickslip.sim.systems.sliding`."""

from __future__ import annotations

from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Memory, Record, Sharing
from stickslip.sim.systems.once import once_a_system
from stickslip.sim.systems.sliding import critical_mode

_mode = once_a_system(critical_mode)
_CHANGES = "friction depends on the speed of a belt that changes"


class CriticalModeRecord(Record):
    """The mode of steady sliding that grows fastest, or decays slowest."""

    name = "critical_mode"
    words = "whether to keep the mode of steady sliding that grows fastest, or decays slowest"
    columns = (
        Column(
            "number",
            "critical_rate",
            "growth rate of the critical mode of steady sliding",
            absent=_CHANGES,
            note="below 0 steady sliding attracts",
            dimension="frequency",
        ),
        Column(
            "number",
            "critical_frequency",
            "its angular frequency",
            least=0.0,
            absent=_CHANGES,
            dimension="angular_frequency",
        ),
        Column(
            "numbers",
            "critical_shape",
            "its amplitude of each block, the largest of them 1",
            along="critical_block",
            repeats=False,
        ),
    )
    is_shared = True
    needs = frozenset({"system"})

    def memory(self, facts: Facts) -> Memory:
        # the matrix of 2n rows, its complex eigenvectors and what LAPACK keeps
        return Memory(256.0 * facts.n**2, "finding eigenvectors", "set it to false")

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 3e-8 * member.n**3 / (sharing.engines * sharing.draws)

    def of(self, result: Made) -> dict[str, Any]:
        mode = _mode(result.system)
        if mode is None:
            return {}
        return dict(zip(("critical_rate", "critical_frequency", "critical_shape"), mode, strict=True))
