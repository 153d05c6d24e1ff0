"""Where a finding holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stickslip.pipeline.design.labels import Label, Part, apart
from stickslip.pipeline.design.units import Units


@dataclass(frozen=True)
class Place:
    """What tells a setting from the others: "n = 100, exact, averaged over 3 of 5 values".

    Attributes
    ----------
    parts : tuple of (str, str)
        Keys with their values, as texts; what is no key's value, as a method or words, has an empty key.
    """

    parts: tuple[Part, ...] = ()

    @classmethod
    def of(cls, label: Label) -> Place:
        """The place that a label names."""
        return cls(label.parts)

    @classmethod
    def key(cls, name: str, value: str) -> Place:
        """Where a key has a value."""
        return cls(((name, value),))

    @classmethod
    def words(cls, text: str) -> Place:
        """A place that has no key, as a method or "with every engine"; everywhere, if the text is empty."""
        return cls((("", text),)) if text else cls()

    def measured(self, units: Units) -> Place:
        """The same in the units of data."""
        return Place(tuple((key, units.amount(key, value)) for key, value in self.parts))

    def __add__(self, other: Place) -> Place:
        return Place(self.parts + other.parts)

    def __bool__(self) -> bool:
        return bool(self.parts)

    def __str__(self) -> str:
        return Label.of(self.parts)

    @property
    def has_key(self) -> bool:
        """Whether it begins with the value of a key."""
        return bool(self.parts and self.parts[0][0])

    @property
    def phrase(self) -> str:
        """After a word: "at n = 100, exact", and "for exact"."""
        return f"{'at' if self.has_key else 'for'} {self}"

    @property
    def tail(self) -> str:
        """At the end of a clause: " at n = 100, exact", and ", exact"."""
        return f" at {self}" if self.has_key else f", {self}" if self else ""

    @property
    def head(self) -> str:
        """At the beginning of a clause: "at n = 100, exact, ", and "exact: "."""
        return f"at {self}, " if self.has_key else f"{self}: " if self else ""


EVERYWHERE = Place()


def told_apart(labels: Sequence[Label], n_always: int = 0) -> dict[str, Place]:
    """What tells each label from the others, with its first parts in any case."""
    return dict(zip(labels, map(Place.of, apart(labels, n_always)), strict=True))
