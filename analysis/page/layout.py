"""What stands on a page, and in which order: plain texts and images, which the one template lays out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from stickslip.analysis.findings.finding import Comparison, Difference, Record, Scale, Verdict
from stickslip.analysis.findings.numbers import alike, signs, with_interval
from stickslip.analysis.findings.words import difference_in_words, plural
from stickslip.analysis.stats.estimates import Estimate

MOST_ROWS = 24  # of a table on a page
MOST_FIRST = 8  # of the table on the first screen


class Panel(NamedTuple):
    """An image, by its address, and its caption."""

    address: str
    caption: str


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes
    ----------
    head : sequence of str
    rows : sequence of sequence of str
    note : str
        Where the rows are that it leaves out.
    caption : str
    """

    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    note: str = ""
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A folded part of a page: its title, a line of what it says, and what is inside.

    Attributes
    ----------
    tables : sequence of Table
        Of data.
    """

    key: str
    title: str
    summary: str = ""
    texts: Sequence[str] = ()
    panels: Sequence[Panel] = ()
    table: Table = field(default_factory=Table)
    notes: Sequence[str] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True)
class Page:
    """A page.

    Attributes
    ----------
    title, about : str
    lead : sequence of str
        The answer.
    stops : sequence of str
        Why no number of the page must be used.
    panels : sequence of Panel
    table : Table
    alerts, notes : sequence of str
    sections : sequence of Section
    meta : mapping of str to str
        At the head of the file, by name.
    paragraph : str
        What the answer does not say.
    """

    title: str
    about: str = ""
    lead: Sequence[str] = ()
    stops: Sequence[str] = ()
    panels: Sequence[Panel] = ()
    table: Table = field(default_factory=Table)
    alerts: Sequence[str] = ()
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    meta: Mapping[str, str] = field(default_factory=dict)
    paragraph: str = ""

    @property
    def html(self) -> str:
        """The page as HTML, with its style and images inside."""
        return _template().render(page=self)


@cache
def _template() -> Template:
    filled = Environment(
        loader=PackageLoader(__package__, "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return filled.get_template("page.html")


def prepare() -> None:
    """Compile the template in advance, while a process is idle."""
    _template()


def findings_table(records: Sequence[Record], where: str = "", most: int = MOST_ROWS) -> Table:
    """The table of some findings; columns that hold nothing are left out, and so is a column of one quantity.

    Parameters
    ----------
    records : sequence of Record
    where : str
        The name of the file with all of them; empty if the others are shown elsewhere.
    most : int
        Rows that are shown.
    """
    shown = [record for record in records if record.estimate is not None or record.high is not None]
    places = {name: alike(map(_estimate, rows), rows[0].form) for name, rows in _by_quantity(shown).items()}
    cells = [
        {
            "what": record.quantity,
            "where": signs(record.setting),
            "estimate": _level(record, places[record.quantity]),
            "compared with": signs(record.compared_with),
            "difference": _difference(record),
            "from": "" if record.n is None else _unbroken(plural(record.n, record.unit)),
        }
        for record in shown[:most]
    ]
    head = [name for name in (cells[0] if cells else ()) if any(cell[name] for cell in cells)]
    if len(cells) > 1 and len({cell["what"] for cell in cells}) == 1 and "where" in head:
        head.remove("what")
    n_more = len(shown) - most
    note = f"{plural(n_more, 'more row')} in {where}." if n_more > 0 and where else ""
    return Table(head, [[cell[name] for name in head] for cell in cells], note)


def _by_quantity(records: Sequence[Record]) -> dict[str, list[Record]]:
    in_order = sorted(records, key=lambda record: record.quantity)
    return {name: [*rows] for name, rows in groupby(in_order, key=lambda record: record.quantity)}


def _estimate(record: Record) -> Estimate:
    return Estimate(record.estimate, record.low, record.high)


def _level(record: Record, digits: int) -> str:
    return _unbroken(with_interval(_estimate(record), record.form, digits))


def _unbroken(text: str) -> str:
    """A text that is broken only before a bracket."""
    return text.replace(" ", "\u00a0").replace("\u00a0(", " (")


def _difference(record: Record) -> str:
    if not record.compared_with:
        return ""
    value = Estimate(record.difference, record.difference_low, record.difference_high)
    difference = Difference(value, Scale(record.scale), record.margin)
    said = difference_in_words(Comparison(record.compared_with, difference), Verdict(record.verdict), record.form)
    return ", ".join([_unbroken(said.size), *filter(None, [said.verdict])])
