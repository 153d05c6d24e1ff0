"""What follows from a system alone, and is kept as long as that lives."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

T = TypeVar("T")
More = ParamSpec("More")


def once_a_system(function: Callable[Concatenate[System, More], T]) -> Callable[Concatenate[System, More], T]:
    """A function of a system that is called once for each: runs from many starts, and by many engines, share it.

    It may have more arguments: the value for the last of them is kept.
    """
    values: WeakKeyDictionary[System, tuple[object, T]] = WeakKeyDictionary()

    @wraps(function)
    def value(system: System, /, *more: More.args, **named: More.kwargs) -> T:
        kept = values.get(system)
        if kept is None or kept[0] != (more, named):
            kept = values[system] = (more, named), function(system, *more, **named)
        return kept[1]

    return value
