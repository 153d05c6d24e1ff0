"""Of how many blocks the records of contacts are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record


class Contacts(Record):
    """The number of blocks with friction, kept with each record that is of these alone."""

    name = "contacts"
    words = ""
    takes_load = True
    needs = frozenset({"system"})
    beside: ClassVar[tuple[str, ...]]

    @classmethod
    def keep_beside(cls, records: Iterable[type[Record]]) -> None:
        """Have it kept with those of some records that are of contacts, and name these in its words."""
        cls.beside = tuple(record.name for record in records if record.is_of_contacts)
        names = ", ".join(f"`{name}`" for name in cls.beside)
        cls.asked_by = f"any of {names}"
        cls.columns = (
            Column(
                "whole",
                "n_contacts",
                "number of blocks with friction: means over blocks, waiting times and events of"
                f" {names} are of these",
                is_averaged=False,
                is_later=True,
            ),
        )

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        return cls() if any(keys[name] for name in cls.beside) else None

    def of(self, result: Made) -> dict[str, Any]:
        return {"n_contacts": int(np.count_nonzero(result.system.has_friction))}
