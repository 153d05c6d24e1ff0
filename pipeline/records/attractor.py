"""What a run settles on: see `stickslip.sim.attractors`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Member, Sharing, WindowRecord
from stickslip.sim.systems.system import System

_NO_CYCLE = "on no cycle, or undecided"
_of_period = partial(Column, "count", least=0.0, absent=_NO_CYCLE, note="null if not periodic")
_by_block = partial(Column, "numbers", along="section_block", repeats=False)
if TYPE_CHECKING:  # it loads numba, which who reads a dataset does not need
    from stickslip.sim.attractors.result import Attractor

#: Values of z at exits that are kept, the last.
_MOST = 64


@dataclass(frozen=True)
class AttractorRecord(WindowRecord):
    """What a run of the exact engine settles on, and its cycle."""

    name = "attractor"
    words = (
        "whether to keep what a run of the exact law settles on: rest, sliding, a cycle with its period and"
        " multiplier, a torus, irregular motion"
    )
    columns = (
        Column(
            "text",
            "attractor",
            "rest, sliding, periodic, torus, irregular, escaping or undecided; null, as all below, by other laws",
        ),
        Column("text", "attractor_reason", "how that is known, or why it is undecided"),
        Column(
            "number",
            "period",
            "of the cycle of each periodic run, which may differ",
            least=0.0,
            absent=_NO_CYCLE,
            note="null otherwise",
            dimension="time",
        ),
        _of_period("exits_per_period", "exits in a period"),
        _of_period("events_per_period", "entries, exits and crossings in a period, of blocks with friction"),
        Column(
            "number",
            "multiplier",
            "largest modulus of the Floquet multipliers of a periodic run, but for shifts "
            "in time and of blocks that no spring holds",
            least=0.0,
            absent="on no cycle, undecided, or on one of too many events",
            note="below 1 the cycle attracts",
        ),
        Column(
            "number",
            "deviation_rate",
            "rate at which a small deviation grows, of a run in no cycle",
            absent="on a cycle, or with few events",
            note="above 0 if irregular, below on a torus",
            dimension="frequency",
        ),
        _by_block(
            "section_z",
            "displacement of each block at one event of the cycle, the same for all starts that end in it; at rest or"
            " steady sliding, there",
            dimension="length",
        ),
        _by_block("section_w", "velocity of each block then", dimension="speed"),
        Column(
            "whole",
            "exits_block",
            "the block with most exits in a period, or on a torus or in an irregular run",
            is_averaged=False,
            is_index=True,
        ),
        Column(
            "numbers",
            "exits_z",
            f"its displacement at each of these exits, at most the last {_MOST}, for bifurcation diagrams",
            along="exit",
            repeats=False,
            dimension="length",
        ),
        Column(
            "numbers",
            "start_z",
            "displacement of each block at t = 0, for pictures of basins",
            along="start_block",
            dimension="length",
        ),
        Column("numbers", "start_w", "velocity of each block then", along="start_block", dimension="speed"),
    )
    is_of_paths = True
    is_of_exact = True
    is_of_contacts = True
    needs = frozenset({"events", "end", "system"})

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 0.5 * member.cost if self.applies(member) else 0.0

    def of(self, result: Made) -> dict[str, Any]:
        from stickslip.sim.attractors import attractor  # it loads numba, which who reads a dataset does not need

        # a run that is certain to escape may end before
        t_burn = min(self.t_burn, result.run.t_end)
        settled = attractor(
            result.run, result.system, t_burn, engine=result.member.engine, **dict(result.member.settings)
        )
        values: dict[str, Any] = {
            "attractor": settled.kind,
            "attractor_reason": settled.reason or None,
            "period": settled.period,
            **_per_period(settled, result.system),
            "multiplier": settled.multiplier,
            "deviation_rate": settled.growth_rate,
            **{
                name: np.broadcast_to(np.asarray(state, dtype=np.float64), result.system.n)
                for name, state in zip(("start_z", "start_w"), result.start, strict=True)
            },
        }
        if settled.section is not None:
            values["section_z"], values["section_w"] = settled.section
        if settled.busiest is not None:
            values["exits_block"], values["exits_z"] = settled.busiest, settled.at_exits()[-_MOST:]
        return values


def _per_period(settled: Attractor, system: System) -> dict[str, int]:
    """Exits and events in a period of blocks with friction: others only pass the speeds of their belts."""
    if settled.kind != "periodic" or settled.events is None:
        return {}
    events = settled.events.of_blocks(system.has_friction)
    return {"exits_per_period": events.counts()["n_exits"], "events_per_period": len(events)}
