"""What stands on a page, and in which order: plain texts and images, which the one template lays out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from stickslip.analysis.findings.finding import Comparison, Form, Level
from stickslip.analysis.findings.numbers import signs, with_interval
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import based_on, difference_in_words, plural

MOST_ROWS = 36  # of a table on a page
MOST_FIRST = 8  # of the table on the first screen

#: How all templates of pages are read.
RULES: dict[str, Any] = {
    "autoescape": True,
    "undefined": StrictUndefined,
    "trim_blocks": True,
    "lstrip_blocks": True,
}


class Panel(NamedTuple):
    """An image, by its address, and its caption."""

    address: str
    caption: str


class Table(NamedTuple):
    """A table of texts; `note` says where the rows are that it leaves out."""

    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    note: str = ""
    caption: str = ""


class Section(NamedTuple):
    """A folded part of a page: its title, a line of what it says, and what is inside; `tables` are of data."""

    key: str
    title: str
    summary: str = ""
    texts: Sequence[str] = ()
    panels: Sequence[Panel] = ()
    table: Table = Table()
    notes: Sequence[str] = ()
    tables: Sequence[Table] = ()


class Page(NamedTuple):
    """A page.

    Attributes
    ----------
    lead : sequence of str
        The answer.
    meta : mapping of str to str
        At the head of the file, by name.
    paragraph : str
        What the answer does not say.
    """

    title: str
    about: str = ""
    lead: Sequence[str] = ()
    panels: Sequence[Panel] = ()
    table: Table = Table()
    alerts: Sequence[str] = ()
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    meta: Mapping[str, str] = MappingProxyType({})
    paragraph: str = ""

    @property
    def html(self) -> str:
        """The page as HTML, with its style and images inside."""
        return _template().render(page=self)


@cache
def _template() -> Template:
    return Environment(loader=PackageLoader(__package__, "."), **RULES).get_template("page.html")


def prepare() -> None:
    """Compile the template in advance, while a process is idle."""
    _template()


def is_row(level: Level) -> bool:
    """Whether a finding has a row in the table of findings: it has a value, or a limit."""
    return level.estimate.value is not None or level.estimate.high is not None


def findings_table(levels: Sequence[Level], where: str = "", most: int = MOST_ROWS) -> Table:
    """The table of some findings; columns that hold nothing are left out, and so is a column of one quantity.

    Parameters
    ----------
    where : str
        Where all of them are: the name of a file, or a section.
    most : int
        Rows that are shown.
    """
    levels = [*filter(is_row, levels)]
    places = [level.where.parts for level in levels[:most]]
    alike = [part for part in places[0] if all(part in parts for parts in places)] if places[1:] else []
    cells = [
        {
            "what": level.quantity.name + f" ({level.quantity.unit})" * bool(level.quantity.unit),
            "where": setting_in_cell(Place(tuple(part for part in level.where.parts if part not in alike))),
            "estimate": _unbroken(with_interval(level.estimate, level.quantity.form)),
            "compared with": _reference(level.comparison, level.quantity.form)
            if level.comparison is not None
            else "",
            "difference": _difference(level.comparison, level.quantity.form) if level.comparison is not None else "",
            "from": _unbroken(based_on(level.basis)),
        }
        for level in levels[:most]
    ]
    head = [name for name in (cells[0] if cells else ()) if any(cell[name] for cell in cells)]
    is_one = len(cells) > 1 and len({cell["what"] for cell in cells}) == 1
    if is_one and "where" in head and not levels[0].quantity.unit:
        head.remove("what")
    n_more = len(levels) - most
    note = f"{plural(n_more, 'more row')} in {where}." if n_more > 0 and where else ""
    caption = f"All {signs(Place(tuple(alike)).phrase)}." if alike else ""
    return Table(head, [[cell[name] for name in head] for cell in cells], note, caption)


def _reference(comparison: Comparison, form: Form) -> str:
    """With what something is compared, and its value."""
    name = setting_in_cell(comparison.other)
    return name if comparison.value is None else f"{name}: {_unbroken(with_interval(comparison.value, form))}"


def _difference(comparison: Comparison, form: Form) -> str:
    if comparison.difference is None:
        return ""
    size, verdict = difference_in_words(comparison.difference, form)
    return f"{_unbroken(size)}, {verdict}" if verdict else _unbroken(size)


def setting_in_cell(name: object) -> str:
    """The name of a setting, which is broken only between its parts."""
    return signs(str(name)).replace(" = ", "\u00a0=\u00a0")


def _unbroken(text: str) -> str:
    """A text that is broken only before a bracket, and after one."""
    return text.replace(" ", "\u00a0").replace("\u00a0(", " (").replace(")\u00a0", ") ")
