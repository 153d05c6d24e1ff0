"""What follows from a system alone, and is kept as long as that lives."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

if TYPE_CHECKING:
    from stickslip.sim.systems.system import System

T = TypeVar("T")
More = ParamSpec("More")


def once_a_system(function: Callable[Concatenate[System, More], T]) -> Callable[Concatenate[System, More], T]:
    """A function of a system that is called once for each: runs from many starts, and by many engines, share it.

    It may have more arguments: the value for the last of them is kept.
    """
    name = f"{function.__module__}.{function.__qualname__}"

    @wraps(function)
    def value(system: System, /, *more: More.args, **named: More.kwargs) -> T:
        values = vars(system)  # as those of its cached properties
        kept: tuple[object, T] | None = values.get(name)
        if kept is None or kept[0] != (more, named):
            kept = values[name] = (more, named), function(system, *more, **named)
        return kept[1]

    return value
