"""How far a changed run is from the unchanged one, in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Facts, Made, Member, Memory, Record, Sharing, steps
from stickslip.sim.numerics.arguments import Floats


@dataclass(frozen=True)
class Separation(Record):
    """The distance of a changed run from the unchanged one, every `step` units of time."""

    step: float

    name = "separation"
    is_step = True
    words = "time step at which the distance of a changed run from the unchanged one is kept"
    example = 5.0
    asked_by = "`separation = 5.0` under [record]"
    columns = (
        Column(
            "numbers",
            "separation",
            "distance from the unchanged run at k times the step that the scene gives, as far as both go: the root of"
            " the mean over blocks of dz^2 + dw^2; null for an unchanged run",
            along="separation_step",
            repeats=False,
        ),
    )
    is_of_paths = True
    is_shared = True

    def applies(self, member: Member) -> bool:
        return member.base is not None

    def problem(self, facts: Facts) -> str:
        if facts.has_changes:
            return ""
        return (
            "expected a scene with changed runs, got none; add [perturbation] or [twins], or a sigmoid with ratio ="
            ' "uniform"'
        )

    def memory(self, facts: Facts) -> Memory:
        # z and w of a run and of the one that it is compared with
        return Memory(4.0 * 8 * facts.n * facts.t_end / self.step, "comparing two runs", "lengthen the step")

    def times(self, member: Member) -> Floats:
        """0, step, 2 step ... to t_end, which rounding does not lose; none of an unchanged run."""
        if member.base is None:
            return np.empty(0)
        return steps(0.0, member.t_end, self.step)

    def cost(self, member: Member, sharing: Sharing) -> float:
        """The unchanged run is run again, once for its changed copies."""
        base = member.base
        if base is None:
            return 0.0
        return base.cost / (sharing.copies if base.ratio_draw == member.ratio_draw else sharing.draws)

    def of(self, result: Made) -> dict[str, Any]:
        base = result.member.base
        if base is None:
            return {}
        times = self.times(result.member)
        mine, base_samples = result.samples(times), result.again(base, tuple(times))
        m = min(len(mine), len(base_samples))  # both reached these
        squares = (mine.z[:m] - base_samples.z[:m]) ** 2 + (mine.w[:m] - base_samples.w[:m]) ** 2
        return {"separation": np.sqrt(squares.mean(axis=1))}
