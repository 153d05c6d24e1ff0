"""What follows from a system alone, and is kept as long as that lives."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, TypeVar
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

T = TypeVar("T")


def once_a_system(function: Callable[[System], T]) -> Callable[[System], T]:
    """A function of a system that is called once for each: runs from many starts, and by many engines, share it."""
    values: WeakKeyDictionary[System, T] = WeakKeyDictionary()

    @wraps(function)
    def value(system: System) -> T:
        if system not in values:
            values[system] = function(system)
        return values[system]

    return value
