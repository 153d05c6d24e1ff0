"""Where attraction ends between two values of a swept key: see `stickslip.sim.attractors.continuation`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Sharing, WindowRecord


def _ends(side: str, words: str) -> tuple[Column, ...]:
    """The columns of an end of stick-slip: the middle of the interval in which it lies, half its width, the cause."""
    return (
        Column("number", f"motion_ends_{side}", words, absent=_LASTS),
        Column(
            "number", f"motion_ends_{side}_error", "half the width of the interval in which it does", absent=_LASTS
        ),
        Column(
            "text",
            f"motion_ends_{side}_cause",
            "multiplier (that of the cycle comes to 1), grazing (a block of the cycle just fails to stick), cycle (it"
            " attracts before, and a run from it settles elsewhere beyond) or runs (to t_end)",
        ),
    )


_LASTS = "it lasts, or there is none"


@dataclass(frozen=True)
class Refine(WindowRecord):
    """Ends of steady sliding and of stick-slip beside the value that a run has of the refined key, by bisection.

    Steady sliding ends where an eigenvalue crosses; the attractor on which a run sticks and slips is followed to the
    values below and above, a cycle by Newton's method.
    """

    width: float

    name = "refine"
    words = "width to which ends of attraction are bisected, along the key with most numbers"
    example = 0.01
    is_step = True
    columns = (
        Column(
            "number",
            "stability_changes",
            "where, up to the next value of the refined key, steady sliding becomes linearly stable or unstable",
            absent="it does not",
        ),
        *_ends("below", "where, down to the value before, the stick-slip that the run settles on ends"),
        *_ends("above", "where, up to the next value, it ends"),
    )
    asked_by = "`refine = 0.01` under [record]"
    is_of_paths = True
    is_of_exact = True
    needs = frozenset({"events", "end", "system"})

    def problem(self, facts: Facts) -> str:
        if facts.axis is None:
            return "expected a list of numbers to refine between, as belt_speed = [1.0, 1.5, 2.0], got none; add it"
        return super().problem(facts)

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 6.0 * member.cost if self.applies(member) else 0.0

    def applies(self, member: Member) -> bool:
        return super().applies(member) and member.base is None

    def of(self, result: Made) -> dict[str, Any]:
        from stickslip.sim.attractors import attractor  # it loads numba, which who reads a dataset does not need
        from stickslip.sim.attractors.continuation import end_of_motion, end_of_stability

        member, run = result.member, result.run
        settings = {"engine": member.engine, **dict(member.settings)}
        settled = attractor(run, result.system, min(self.t_burn, run.t_end), **settings)
        values: dict[str, Any] = {}
        for neighbour, side in zip(member.neighbours, ("below", "above"), strict=True):
            if neighbour is None:
                continue
            own, other = neighbour.values
            system_at = member.towards(neighbour)
            width = self.width / abs(other - own)
            end = end_of_motion(system_at, run, settled, member.t_end, self.t_burn, width, **settings)
            if end is not None:
                values[f"motion_ends_{side}"] = own + 0.5 * (end.low + end.high) * (other - own)
                values[f"motion_ends_{side}_error"] = 0.5 * (end.high - end.low) * abs(other - own)
                values[f"motion_ends_{side}_cause"] = end.cause.value
            if side == "above":
                crossing = end_of_stability(system_at)
                values["stability_changes"] = None if crossing is None else own + crossing * (other - own)
        return values
