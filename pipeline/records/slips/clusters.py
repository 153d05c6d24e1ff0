"""The connected parts of the episodes of a run, and the slip of each block in them."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Member, Record, Sharing
from stickslip.sim.episodes import clusters, episodes

_of_each, _of_block = (partial(Column, along=name) for name in ("cluster", "profile"))
_numbers = partial(_of_each, "numbers", repeats=False)


class ClustersRecord(Record):
    """The connected parts of the episodes of a run: see `stickslip.sim.episodes.clusters`."""

    name = "clusters"
    words = "whether to keep the parts of episodes that springs connect, and the slips; it costs a second run"
    columns = (
        _of_each("counts", "cluster_episode", "number of the episode that it is part of", least=0.0),
        _numbers("cluster_start", "when its first block leaves", dimension="time"),
        _numbers("cluster_end", "when its last block sticks again", dimension="time"),
        _of_each("wholes", "cluster_first_block", "its nucleation site: the block that left first", is_index=True),
        _of_each("wholes", "cluster_size", "its extent: number of blocks"),
        _numbers("cluster_moment", "sum of their slips, against the belt's motion", dimension="length"),
        _numbers(
            "cluster_stress_drop",
            "mean fall of the springs' force on its blocks by the slips s, (K s)_i",
            dimension="force",
        ),
        _of_block("counts", "profile_cluster", "number of the cluster that a block is part of", least=0.0),
        _of_block("wholes", "profile_block", "the block", is_index=True),
        _of_block(
            "numbers",
            "profile_slip",
            "its slip on the belt, against the belt's motion",
            repeats=False,
            dimension="length",
        ),
    )
    needs_stills = True

    def cost(self, member: Member, sharing: Sharing) -> float:
        return member.cost

    def of(self, result: Made) -> dict[str, Any]:
        catalogue = episodes(result.run, result.system.belt_speed)
        times = np.unique(np.concatenate([catalogue.start, catalogue.end]))
        z = result.again(result.member, tuple(times)).z if len(times) else np.empty((0, result.system.n))
        before, after = (z[np.searchsorted(times, instants)] for instants in (catalogue.start, catalogue.end))
        columns = clusters(result.run, result.system, before, after)._asdict()
        return {name if name.startswith("profile") else f"cluster_{name}": values for name, values in columns.items()}
