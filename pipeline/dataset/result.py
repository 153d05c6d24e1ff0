"""What a worker returns."""

from __future__ import annotations

from typing import NamedTuple


class Result(NamedTuple):
    """A computed batch: the shard's bytes, what the manifest says of it, and facts of its computation."""

    name: str
    shard: bytes
    rows: int
    first: str  #: ids of the first member and of the last
    last: str
    outcomes: dict[str, int]
    program: str
    seconds: float
    host: str
    pid: int
