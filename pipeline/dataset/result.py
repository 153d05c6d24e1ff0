"""What a worker returns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """A computed batch: the shard's bytes, and facts about their computation that are no data."""

    name: str
    shard: bytes
    member_ids: tuple[str, ...]
    outcomes: dict[str, int]
    program: str
    seconds: float
    host: str
    pid: int
