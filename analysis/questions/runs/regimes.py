"""Settings grouped by what their runs do: neighbouring values of one key, or else how many of all settings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

from stickslip.analysis.findings.finding import Basis, Regime
from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.labels import Label

MOST = 3  # stretches of values that a sentence names
_LEAST_UNITS = 4  # for a bound on a share that is 1


class Tally(NamedTuple):
    """What the runs at a setting do.

    Attributes
    ----------
    outcomes : tuple of str
        Verb phrases in the plural, each once; empty if nothing is known.
    n, of, n_units : int
        Runs of which it is known, all runs, and independent units.
    """

    outcomes: tuple[str, ...]
    n: int
    of: int
    n_units: int


class Stretch(NamedTuple):
    """Neighbouring values of a key, by the places of the first and the last."""

    first: int
    last: int


def key_of(labels: Sequence[Label]) -> tuple[str, list[str]]:
    """The one key that tells some settings apart, and its value at each; an empty name if there is no such key."""
    names = {name for label in labels for name, _ in label.parts}
    if len(names) == 1 and all(len(label.parts) == 1 for label in labels):
        return names.pop(), [label.parts[0][1] for label in labels]
    return "", [*map(str, labels)]


def regimes(
    key: str, values: Sequence[str], places: Sequence[Tally], confidence: float, unit: str
) -> tuple[Regime, ...]:
    """Settings by what their runs do; of many stretches of values only those whose runs all do the same.

    Parameters
    ----------
    key : str
        What alone tells the settings apart; empty if several keys do.
    values : sequence of str
        The value at each, in order.
    places : sequence of Tally
    confidence : float
    unit : str
        What is independent: "system".
    """
    stretches = stretches_of(places) if key else []
    if len(stretches) > MOST:  # those between have several outcomes
        stretches = [part for part in stretches if len(places[part.first].outcomes) == 1]
    if 0 < len(stretches) <= MOST:
        parts = [(_where(key, values, part), places[part.first : part.last + 1]) for part in stretches]
    else:
        alike: dict[tuple[str, ...], list[Tally]] = {}
        for place in places:
            if place.outcomes:
                alike.setdefault(place.outcomes, []).append(place)
        settings = f"values of {key}" if key else "settings"
        by_number = sorted(alike.values(), key=len, reverse=True)
        parts = [(f"at {len(group):,} of {len(places):,} {settings}", group) for group in by_number]
    return tuple(_regime(where, group, confidence, unit) for where, group in parts)


def stretches_of(places: Sequence[Tally]) -> list[Stretch]:
    """Neighbouring places of the same outcomes; what is not known is in one only if it goes on beyond."""
    known = [(k, place.outcomes) for k, place in enumerate(places) if place.outcomes]
    numbers = [[k for k, _ in group] for _, group in groupby(known, lambda pair: pair[1])]
    return [Stretch(group[0], group[-1]) for group in numbers]


def least_share(places: Sequence[Tally], confidence: float) -> float | None:
    """Of one outcome at all of some places: the least share of units that have it; None for few or some undecided.

    All places share their draws, which count once.
    """
    n_units = max(place.n_units for place in places)
    is_whole = all(len(place.outcomes) == 1 and place.n == place.of for place in places)
    return wilson(n_units, n_units, confidence)[0] if is_whole and n_units >= _LEAST_UNITS else None


def _regime(where: str, group: Sequence[Tally], confidence: float, unit: str) -> Regime:
    outcomes = next(place.outcomes for place in group if place.outcomes)
    numbers = {(place.n, place.of) for place in group}
    is_each = len(group) > 1 and len(numbers) == 1 and group[0].of > 1  # as many at each
    n, of = numbers.pop() if is_each else (sum(place.n for place in group), sum(place.of for place in group))
    low = least_share(group, confidence)
    share = Estimate() if len(outcomes) > 1 else Estimate(1.0, low, None if low is None else 1.0)
    return Regime(where, outcomes, n, of, share, Basis(max(place.n_units for place in group), unit), is_each)


def _where(key: str, values: Sequence[str], part: Stretch) -> str:
    """Where a stretch of values lies: "up to belt_speed = 7"."""
    first, last = values[part.first], values[part.last]
    begins, ends = part.first == 0, part.last == len(values) - 1
    if part.first == part.last:
        return f"at {key} = {first}"
    if part.last == part.first + 1:
        return f"at {key} = {first} and {last}"
    if begins and ends:
        return f"at all {len(values)} values of {key}"
    if begins:
        return f"up to {key} = {last}"
    return f"from {key} = {first} on" if ends else f"from {key} = {first} to {last}"
