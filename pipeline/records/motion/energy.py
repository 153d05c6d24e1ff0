"""Where the energy of a run went, and what each episode took of it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Member, Record, Sharing
from stickslip.sim.energy import Energy, TooLongError, energy
from stickslip.sim.engines import ENGINES

_of_run = partial(Column, "number", dimension="energy")


class EnergyRecord(Record):
    """The energy at both ends of a run by the exact law, and what came in and went out between."""

    name = "energy"
    words = (
        "whether to keep the energy at both ends of a run by the exact law, and what came in and went out between; it"
        " costs some ten runs"
    )
    columns = (
        _of_run(
            "kinetic_energy_start",
            "sum of m w^2 / 2 at t = 0",
            least=0.0,
            note="null, as all below, if diverged, not the exact law, or too long to sum",
        ),
        _of_run("kinetic_energy_end", "sum of m w^2 / 2 at t_end", least=0.0),
        _of_run("elastic_energy_start", "z K z / 2 at t = 0"),
        _of_run("elastic_energy_end", "z K z / 2 at t_end"),
        _of_run("belt_work", "what the belt gave, by friction"),
        _of_run("force_work", "what the force from outside gave"),
        _of_run("coupling_work", "what couplings gave that are not reciprocal, the skew part of K"),
        _of_run("damping_loss", "what damping took"),
        _of_run("friction_loss", "what slip on the belt took, as heat"),
    )

    is_of_exact = True
    needs = frozenset({"events", "end", "system"})

    def cost(self, member: Member, sharing: Sharing) -> float:
        return 10.0 * member.cost if self.applies(member) else 0.0

    def of(self, result: Made) -> dict[str, Any]:
        balance = _balance(result)
        if balance is None:
            return {}
        ends = {"kinetic_energy": balance.kinetic, "elastic_energy": balance.elastic}
        sums = {"belt_work": balance.belt, "force_work": balance.outside, "coupling_work": balance.coupling}
        sums |= {"damping_loss": balance.damping, "friction_loss": balance.heat}
        return (
            {f"{name}_start": values[0] for name, values in ends.items()}
            | {f"{name}_end": values[-1] for name, values in ends.items()}
            | {name: values[-1] for name, values in sums.items()}
        )


class EpisodeEnergy(Record):
    """What damping and friction took in each episode."""

    name = "episode_energy"
    words = ""
    asked_by = "both, `episodes` and `energy`"
    columns = (
        Column(
            "numbers or null",
            "episode_energy",
            "what damping and friction took in each episode; null if diverged, not the exact law, or too long to sum",
            along="episode",
            repeats=False,
            dimension="energy",
        ),
    )
    needs = EnergyRecord.needs | {"episodes"}

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        return cls() if keys["episodes"] and keys["energy"] else None

    def of(self, result: Made) -> dict[str, Any]:
        start, end = result.found["episode_start"], result.found["episode_end"]
        balance = _balance(result)
        if balance is None:
            return {"episode_energy": [None] * len(start)}
        lost = balance.damping + balance.heat
        return {"episode_energy": lost[np.searchsorted(balance.t, end)] - lost[np.searchsorted(balance.t, start)]}


@lru_cache(maxsize=1)  # for both records
def _balance(result: Made) -> Energy | None:
    """The energy balance of a run; None if it has none."""
    member, run = result.member, result.run
    if run.outcome == "diverged" or not ENGINES[member.engine].is_exact:
        return None
    try:
        return energy(
            result.system,
            run,
            *result.start,
            engine=member.engine,
            stop_early=result.stop_early,
            **dict(member.settings),
        )
    except TooLongError:  # the run itself is right
        return None
