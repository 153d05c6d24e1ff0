"""The episodes of a run, from all blocks stuck to all stuck again."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record
from stickslip.sim.episodes import episodes

_of_each = partial(Column, along="episode")


class EpisodesRecord(Record):
    """The episodes of a run: see `stickslip.sim.episodes`."""

    name = "episodes"
    words = "whether to keep the episodes: from all blocks stuck to all stuck again"
    columns = (
        _of_each(
            "numbers",
            "episode_start",
            "when the first block leaves, after a time when all stick",
            repeats=False,
            is_time=True,
        ),
        _of_each(
            "numbers",
            "episode_end",
            "when all stick again; what is cut off by an end is no episode",
            repeats=False,
            is_time=True,
        ),
        _of_each("wholes", "episode_size", "number of blocks that slipped in each episode"),
        _of_each(
            "numbers", "episode_moment", "sum of their slips on the belt, against the belt's motion", repeats=False
        ),
        _of_each("wholes", "episode_first_block", "the block that left first", is_index=True),
        _of_each(
            "numbers",
            "episode_z_sum",
            "sum of z over the blocks when each episode begins",
            repeats=False,
            is_later=True,
        ),
    )
    needs_stills = True

    def of(self, result: Made) -> dict[str, Any]:
        series = episodes(result.run, result.system.belt_speed)
        return {f"episode_{field.name}": getattr(series, field.name) for field in fields(series)}
