"""What a worker hands over: a shard, and the version of the program that its numbers come from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stickslip.sim.kernels.digest import source_digest
from stickslip.version import __version__


@dataclass(frozen=True)
class Result:
    """A computed batch: the shard's bytes, and beside them what is not data."""

    name: str
    shard: bytes
    member_ids: tuple[str, ...]
    outcomes: dict[str, int]
    program: str
    seconds: float
    host: str
    pid: int


#: What determines numbers beside `sim`: which draws and settings a member has, and what of its run is kept.
_ROOMS = ("dataset/schema.py", "ensemble", "records", "running/ends.py", "running/worker.py", "scene")


def _determining() -> tuple[Path, ...]:
    at = Path(__file__).parents[1]
    return tuple(file for room in _ROOMS for file in (sorted((at / room).glob("*.py")) or [at / room]))


def program() -> str:
    """What the numbers come from: the version of stickslip, and a digest of the sources that determine them."""
    return f"{__version__}-{source_digest(*_determining())}"
