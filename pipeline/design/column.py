"""Columns of a dataset as plain data: Arrow's schema, SQL, NetCDF, the guide and the names that are taken follow."""

from __future__ import annotations

from typing import Literal, NamedTuple

#: A number; a whole one of 32 or 64 bits; a truth; text; and lists of a run: numbers, perhaps with nulls, numbers of
#: blocks, of other things, modes. The last is a list of thresholds, each with its t and n_stick.
Kind = Literal[
    "number",
    "whole",
    "count",
    "yes or no",
    "text",
    "numbers",
    "numbers or null",
    "wholes",
    "counts",
    "modes",
    "n_stick by",
]


class Until(NamedTuple):
    """What is known of a time until something happens."""

    since: float | Literal["t_burn"] = 0.0  #: the time of the run from which on it counts

    def start(self, t_burn: float) -> float:
        """The time of the run from which on it counts."""
        return t_burn if self.since == "t_burn" else self.since


class Column(NamedTuple):
    """A column: a value a member, or a list of values."""

    kind: Kind
    name: str
    words: str  #: what it is
    nullable: bool = True  #: whether a member may be without
    #: Of a list: what it has a value for, its dimension in NetCDF. Lists along the same are equally long in each run,
    #: or null. Empty: it is not written there.
    along: str = ""
    #: Whether values repeat. Those that do not, as times, are stored without a dictionary and split into bytes.
    repeats: bool = True
    #: Whether means of a number are taken: not if it says which, as that of a block, or when something came to be
    #: known.
    is_averaged: bool = True
    least: float | None = None  #: what a number is never below, by what it is: 0 for an amplitude
    #: What a number that is never below 0 is never above, by what it is: 1 for a share of blocks or of time.
    most: float | None = None
    #: Why a run has no such number, in words, where that is what it is, as a steady slide has no period; empty if a
    #: run without one lacks it.
    absent: str = ""
    title: str = ""  #: what a number is called in a sentence; empty: its name, with spaces
    #: If it is a time until something happens, which the end of a run may cut off: a run without one was followed to
    #: its end.
    until: Until | None = None
    #: If it is of the times between exits of the same block that lie between t_burn and the end of a run: the long
    #: ones are cut off, so that it is too small unless the run is much longer.
    of_gaps: Literal["", "mean", "scatter"] = ""
    is_time: bool = False  #: whether it is times of a run, from 0 to t_end; of a list, in order
    is_index: bool = False  #: whether it says which block, counted from 0
    is_later: bool = False  #: whether data of an earlier version may lack it: they are read without, as null
    note: str = ""  #: what else is to be known of it: where it is null, or what its sign says
    #: Of `stickslip.pipeline.design.units.DIMENSIONS`; empty: none, or one that a user's function chose.
    dimension: str = ""
    #: Whether it is as the scene has it, in its units; what runs give is dimensionless, and has a scale.
    is_written: bool = False

    @property
    def description(self) -> str:
        """What it is, and what else is to be known of it."""
        return f"{self.words}; {self.note}" if self.note else self.words

    @property
    def called(self) -> str:
        """What it is called in a sentence."""
        return self.title or self.name.replace("_", " ")

    @property
    def is_list(self) -> bool:
        """Whether it holds a list a member."""
        return self.kind not in ("number", "whole", "count", "yes or no", "text")

    @property
    def is_number(self) -> bool:
        """Whether it holds one number a member, of which means can be taken: of truths, their share."""
        return self.kind in ("number", "whole", "count", "yes or no") and self.is_averaged
