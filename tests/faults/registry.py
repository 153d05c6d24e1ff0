"""The list of faults: name, and how often."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.faults.world import World


@dataclass(frozen=True)
class Fault:
    """A fault: `make` does it so many times and returns how many were shown."""

    name: str
    make: Callable[[World, int], int]
    quick: int  #: how often in the quick subset; 0: not there
    full: int


FAULTS: dict[str, Fault] = {}


def fault(quick: int, full: int) -> Callable[[Callable[[World, int], int]], Callable[[World, int], int]]:
    """List a function as a fault, under its own name."""

    def listed(make: Callable[[World, int], int]) -> Callable[[World, int], int]:
        FAULTS[make.__name__] = Fault(make.__name__, make, quick, full)
        return make

    return listed
