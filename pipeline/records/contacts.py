"""Of how many blocks the records of contacts are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.attractor import AttractorRecord
from stickslip.pipeline.records.motion.slip_speed import SlipSpeed
from stickslip.pipeline.records.record import Made, Record
from stickslip.pipeline.records.slips.stick_share import StickShare
from stickslip.pipeline.records.slips.waiting import Waiting

#: Records that leave out blocks without friction.
OF_CONTACTS: tuple[type[Record], ...] = (SlipSpeed, StickShare, Waiting, AttractorRecord)
_NAMES = ", ".join(f"`{record.name}`" for record in OF_CONTACTS)


class Contacts(Record):
    """The number of blocks with friction, kept with each record that is of these alone."""

    name = "contacts"
    words = ""
    asked_by = f"any of {_NAMES}"
    columns = (
        Column(
            "whole",
            "n_contacts",
            f"number of blocks with friction: means over blocks, waiting times and events of {_NAMES} are of these",
            is_averaged=False,
            is_later=True,
        ),
    )
    needs = frozenset({"system"})

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        return cls() if any(keys[record.name] for record in OF_CONTACTS) else None

    def of(self, made: Made) -> dict[str, Any]:
        return {"n_contacts": int(np.count_nonzero(made.system.has_friction))}
