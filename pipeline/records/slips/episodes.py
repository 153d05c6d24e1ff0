"""The episodes of a run, from all blocks stuck to all stuck again."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record
from stickslip.sim.episodes import episodes

_of_each = partial(Column, along="episode")
_numbers = partial(_of_each, "numbers", repeats=False)


@dataclass(frozen=True)
class EpisodesRecord(Record):
    """The episodes of a run: see `stickslip.sim.episodes`; `load` is how the belt loads, if it does not move."""

    load: str | None = None

    name = "episodes"
    words = "whether to keep the episodes: from all blocks stuck to all stuck again"
    columns = (
        _numbers(
            "episode_start",
            "when the first block leaves, after a time when all stick",
            is_time=True,
            dimension="time",
        ),
        _numbers(
            "episode_end",
            "when all stick again; what is cut off by an end is no episode",
            is_time=True,
            dimension="time",
        ),
        _of_each("wholes", "episode_size", "number of blocks that slipped in each episode"),
        _numbers("episode_moment", "sum of their slips on the belt, against the belt's motion", dimension="length"),
        _of_each("wholes", "episode_first_block", "the block that left first", is_index=True),
        _numbers(
            "episode_z_sum", "sum of z over the blocks when each episode begins", is_later=True, dimension="length"
        ),
        _numbers(
            "episode_elapsed",
            'how long the motion takes with load = "adiabatic", where start and end are one time of the belt',
            is_later=True,
            dimension="time",
        ),
    )
    needs_stills = True
    takes_load = True

    @property
    def kept(self) -> tuple[Column, ...]:
        return tuple(column for column in self.columns if self.load or column.name != "episode_elapsed")

    def of(self, result: Made) -> dict[str, Any]:
        series = episodes(result.run, result.system.belt_speed)
        return {f"episode_{field.name}": getattr(series, field.name) for field in fields(series)}
