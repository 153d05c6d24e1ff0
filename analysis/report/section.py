"""What a section of the report is: statements, tables, figures, a method and the state of its assumptions.

A room that answers one question (the law of cascades, chance, sensitivity ...) returns a `Section`; the page, the
Parquet files and the terminal are made from it in one place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from stickslip.analysis.report import words

Row = Mapping[str, Any]
Rows = list[dict[str, Any]]
#: Change points of n_stick of a run: t, shape (m,), and n_stick, shape (m,), n_stick[k] on [t[k], t[k+1]).
ChangePoints = tuple[np.ndarray, np.ndarray]
#: Events of a run: t float64, block int32, mode int8 (-1, 0, +1 after the event), each (m,); and initial_mode (n,).
Events = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
#: Distance of a run's state from its unperturbed twin's: times, shape (m,), and distance, shape (m,).
Separation = tuple[np.ndarray, np.ndarray]


Series = Mapping[str, ChangePoints]


@dataclass(frozen=True)
class Data:
    """An ensemble as the statistics see it. All mappings are by member_id, and may load lazily.

    Attributes
    ----------
    members : DataFrame
        One row a member; the columns in `stickslip.analysis.groups.REQUIRED`, null where a setting does not apply.
    series : mapping to ChangePoints
        Of every member that did not fail.
    events : mapping to Events
        Empty if the scene does not record them.
    separations : mapping to Separation
        Of members that are a changed copy of another; empty if the scene does not record them.
    thresholds : mapping of (member_id, threshold) to ChangePoints
        n_stick of a sigmoid run under further definitions |w - v| < threshold r_i eps.
    """

    members: pd.DataFrame
    series: Series
    events: Mapping[str, Events] = field(default_factory=dict)
    separations: Mapping[str, Separation] = field(default_factory=dict)
    thresholds: Mapping[tuple[str, float], ChangePoints] = field(default_factory=dict)


#: Columns of what a scene declares: shown as they were written.
DECLARED = ("dt", "tau", "threshold", "size")
#: Columns whose rows belong together: shown as a line above them.
LABELS = ("group", "setting")


@dataclass(frozen=True)
class Column:
    """A column of a table as the page shows it.

    `key` names the frame's column; a pair of keys is shown as "low to high". Numbers get `digits` significant
    digits; `show` overrides that.
    """

    heading: str
    key: str | tuple[str, str]
    digits: int = 3
    show: Callable[[Any], str] | None = None

    def text(self, row: Row) -> str:
        """What stands in the cell; a dash for null."""
        if isinstance(self.key, tuple):
            low, high = (row[key] for key in self.key)
            return "–" if low is None or high is None else words.interval(low, high)
        value = row[self.key]
        if value is None:
            return "–"
        if self.show is not None:
            return self.show(value)
        if self.key in DECLARED:
            return f"{value:g}"
        if isinstance(value, bool):
            return "yes" if value else "no"
        return words.number(value, self.digits) if isinstance(value, float) else str(value)

    def is_number(self, rows: Sequence[Row]) -> bool:
        """Whether the column is set flush right."""
        if isinstance(self.key, tuple):
            return True
        known = [row[self.key] for row in rows if row[self.key] is not None]
        return all(isinstance(value, int | float) and not isinstance(value, bool) for value in known)


@dataclass(frozen=True)
class Table:
    """A table: kept whole as `name`.parquet, shown by `columns`; `frame` has nullable types, null and never NaN.

    A table without columns is kept but not shown; a long one is folded unless it `is_open`.
    """

    name: str
    caption: str
    frame: pd.DataFrame
    columns: tuple[Column, ...] = ()
    max_rows: int = 40
    is_open: bool = False


#: Draws a figure when it is called: a `functools.partial` of a room's function on plain data, to be sent elsewhere.
Recipe = Callable[[], Figure]


@dataclass(frozen=True)
class Picture:
    """A figure with its caption; `recipe` draws it, `alt` is what it shows, for who cannot see it."""

    recipe: Recipe
    caption: str
    alt: str


@dataclass(frozen=True)
class Section:
    """One question answered.

    Attributes
    ----------
    title, question : str
    statements : tuple of str
        Sentences made from the numbers, the most important first.
    lead : tuple of str
        The answer in as few sentences as it takes, for the head of the page and the terminal.
    method : str
        How, in two or three sentences.
    alarms : tuple of str
        What makes the data themselves doubtful: said before anything else on the page and the terminal.
    of_changes : bool
        Whether it is about changed copies of runs.
    assumptions : tuple of str
        What is assumed, and how a check of it came out on these data.
    """

    title: str
    question: str
    statements: tuple[str, ...]
    lead: tuple[str, ...]
    method: str
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    assumptions: tuple[str, ...] = ()
    of_changes: bool = False
    alarms: tuple[str, ...] = ()
