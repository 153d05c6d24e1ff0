"""Where attraction ends between two values of a swept key: see `stickslip.sim.attractors.continuation`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Sharing, WindowRecord


@dataclass(frozen=True)
class Refine(WindowRecord):
    """Ends of steady sliding and of stick-slip beside the value that a run has of the refined key, by bisection.

    Steady sliding ends where an eigenvalue crosses; the attractor on which a run sticks and slips is followed to the
    values below and above.
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
        Column(
            "number",
            "motion_ends_below",
            "where, down to the value before, the stick-slip that the run settles on ends, followed from run to run",
            absent="it lasts, or there is none",
        ),
        Column(
            "number",
            "motion_ends_above",
            "where, up to the next value, it ends",
            absent="it lasts, or there is none",
        ),
    )
    asked_by = "`refine = 0.01` under [record]"
    is_of_paths = True
    is_of_exact = True
    needs = frozenset({"events", "end", "system"})

    @classmethod
    def asked(cls, keys: Any, settings: Any) -> Self | None:
        return None if keys[cls.name] is None else cls(keys["t_burn"], keys[cls.name])

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
        for neighbour, name in zip(member.neighbours, ("motion_ends_below", "motion_ends_above"), strict=True):
            if neighbour is None:
                continue
            own, other = neighbour.values
            width = self.width / abs(other - own)
            system_at = member.towards(neighbour)
            share = end_of_motion(system_at, run, settled, member.t_end, self.t_burn, width, **settings)
            values[name] = None if share is None else own + share * (other - own)
            if name.endswith("above"):
                crossing = end_of_stability(system_at, width)
                values["stability_changes"] = None if crossing is None else own + crossing * (other - own)
        return values
