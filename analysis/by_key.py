"""Things in lists by what they have in common."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import TypeVar

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)


def by_key(things: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Things by their keys, in their order; keys are in the order in which they come first."""
    lists: dict[K, list[T]] = {}
    for thing in things:
        lists.setdefault(key(thing), []).append(thing)
    return lists
