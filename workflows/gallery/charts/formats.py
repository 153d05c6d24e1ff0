"""Numbers, intervals and tables as a page shows them: the filters and functions that templates call."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from stickslip.pipeline.design.values import shown

MINUS, DASH = "\u2212", "\u2013"
MOST_DIGITS = 8  # of the ends of an interval, to show that they differ; and decimals, for the digits of what is small
Row = Mapping[str, Any]


def number(value: float | None, digits: int = 3) -> str:
    """A number with a number of significant digits; a dash for None."""
    if value is None:
        return DASH
    value += 0.0  # minus zero is zero
    text = f"{value:,.0f}" if round(abs(value)) >= 10**digits else f"{value:#.{digits}g}".rstrip(".")
    return text.replace("-", MINUS)


def fixed(value: float | None, decimals: int) -> str:
    """A number with a fixed number of decimals; a dash for None."""
    return DASH if value is None else f"{value:,.{decimals}f}".replace("-", MINUS)


def percent(value: float, digits: int = 2) -> str:
    """A share in percent; in as many digits as say that it is not all, up to `MOST_DIGITS`."""
    while abs(value) < 1 and float(f"{abs(100 * value):.{digits}g}") == 100.0 and digits < MOST_DIGITS:
        digits += 1
    return f"{number(100 * value, digits)}%" if value else "0%"


def signed_percent(value: float, digits: int = 2) -> str:
    """A relative difference in percent with its sign."""
    return ("+" if value >= 0 else "") + percent(value, digits)


def minus(text: str) -> str:
    """A text with hyphens before numbers as minus signs, and without sign before zero; markup stays markup."""
    text = type(text)(re.sub(r"(?<![\w])-(?=0(\.0*)?(?![\d.]))", "", text))
    return type(text)(re.sub(r"(?<![\w])-(?=[\d.])", MINUS, text))


def count(n: int, noun: str) -> str:
    """A number of things in words: "one run", "20 matrices"."""
    return f"{'one' if n == 1 else format(n, ',')} {noun if n == 1 else plural(noun)}"


def plural(noun: str) -> str:
    """The plural of a noun: "runs", "matrices"."""
    return {"matrix": "matrices"}.get(noun, noun + "s")


def listed(names: Sequence[Any], last: str = "and") -> str:
    """Names in a sentence: "a, b and c"."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {last} {texts[-1]}"


def _apart(pairs: Iterable[Sequence[Any]], digits: int, show: Callable[[float, int], str]) -> int:
    """The least number of digits, from `digits` on, with which all ends that differ look different."""
    known = [(low, high) for low, high in (both for both in pairs if len(both) == 2) if None not in (low, high)]
    ends = [(low, high) for low, high in known if not np.isclose(low, high, rtol=1e-9, atol=0.0)]
    more = range(digits, MOST_DIGITS + 1)
    return next((k for k in more if all(show(low, k) != show(high, k) for low, high in ends)), digits)


def _alike(values: Iterable[float | None], digits: int) -> tuple[Callable[[float | None, int], str], int]:
    """How to show some numbers alike: with the decimals by which their median has a number of significant digits.

    Where these are more than `MOST_DIGITS`, each has that number of digits itself, or all would be zeros.
    """
    sizes = [abs(value) for value in values if value]
    decimals = max(int(digits - 1 - np.floor(np.log10(np.median(sizes)))), 0) if sizes else 0
    return (fixed, decimals) if decimals <= MOST_DIGITS else (number, digits)


Show = Callable[[Any], str]
#: How the values of a column are shown: the number of significant digits of its median, a key of `_SHOWN`, a format
#: such as "%.1e", or a function; None for words, which are aligned to the left.
How = int | str | Show | None
#: A column of a table: its heading; its key in the rows, or two, of "low to high" or of a p-value and its floor; and
#: how its values are shown.
Column = tuple[str, str | tuple[str, str], How]
_SHOWN: Mapping[str, Callable[..., str]] = {
    "%": percent, "+%": signed_percent, "n": lambda value: f"{value:,}",
    "g": lambda value: minus(shown(value)), "g%": lambda value: f"{100 * value:g}%", "#": number,
    "yes": lambda value: "yes" if value else "no", "as it is": lambda value: value,
}  # fmt: skip


def table(
    rows: Sequence[Any],
    columns: Sequence[Column],
    caption: str = "",
    most: int = 40,
    where: str = "",
    aside: Row | None = None,
    kind: str = "",
) -> Markup:
    """HTML table of some rows; columns without any value are left out.

    Parameters
    ----------
    rows : sequence
        Mappings, or objects with attributes.
    columns : sequence of Column
    caption : str
    most : int
        Most rows to show; a note below says how many more there are.
    where : str
        Name of the Parquet file with all rows, for that note.
    aside : mapping, optional
        Texts of a last row in grey, by key.
    kind : str
        "stack" for a table that becomes cards on a narrow screen.
    """
    shown = rows[:most]
    kept = [column for column in columns if any(_known(row, column[1]) for row in shown)]
    cells = [_cells(shown, column, _beside(kept, k)) for k, column in enumerate(kept)]
    out = [f'<div class="wide"><table class="{escape(kind)}">']
    if caption:
        out.append(f"<caption>{escape(caption)}</caption>")
    heads = "".join(f"<th{_left(column)}>{_lowered(column[0])}</th>" for column in kept)
    out.append(f"<thead><tr>{heads}</tr></thead><tbody>")
    for k in range(len(shown)):
        out.append(f"<tr>{''.join(_cell(column, cells[j][k]) for j, column in enumerate(kept))}</tr>")
    if aside is not None:
        texts = [str(aside.get(_name(column[1]), "")) for column in kept]
        marked = "".join(_cell(column, text) for column, text in zip(kept, texts, strict=True))
        out.append(f'<tr class="aside">{marked}</tr>')
    out.append("</tbody></table></div>")
    if len(rows) > most:
        kept_where = f" in report/{escape(where)}.parquet" if where else ""
        more = len(rows) - most
        out.append(f'<p class="note">{more:,} more row{"s" * (more > 1)}{kept_where}.</p>')
    return Markup("".join(out))


def _name(key: str | tuple[str, str]) -> str:
    return key if isinstance(key, str) else key[0]


def _value(row: Any, name: str) -> Any:
    return row[name] if isinstance(row, Mapping) else getattr(row, name)


def _known(row: Any, key: str | tuple[str, str]) -> bool:
    return _value(row, _name(key)) is not None


def _beside(columns: Sequence[Column], k: int) -> tuple[str, ...]:
    """Keys of the interval after the values of column k, or of the values before the interval in it."""
    _, own, how = columns[k]
    is_value = isinstance(own, str)
    other = columns[k + 1 : k + 2] if is_value else columns[max(k - 1, 0) : k]
    for _, key, theirs in other:
        if how is not None and theirs == how and isinstance(key, str) != is_value:
            return (key,) if isinstance(key, str) else key
    return ()


def _cells(rows: Sequence[Any], column: Column, beside: Sequence[str]) -> list[str]:
    """Texts of a column; a value and its interval have the same decimals, so that it lies in it as shown too."""
    _, key, how = column
    keys = (key,) if isinstance(key, str) else key
    values, others = ([[_value(row, name) for name in names] for row in rows] for names in (keys, beside))
    if isinstance(how, int):
        return _aligned(values, others, how, "")
    if isinstance(how, str) and how[0] == "+" and how[1:].isdigit():
        return _aligned(values, others, int(how[1:]), "+")
    if how is None:
        return ["" if some == [None] else _joined(some, lambda value: value) for some in values]
    if isinstance(how, str) and (known := re.fullmatch(r"(%\+?\.)(\d)f", how)):
        how = f"{known[1]}{_apart([*values, *others], int(known[2]), fixed)}f"
    if how in ("%", "+", "+%", "#") and 2 in (len(keys), len(beside)):
        show = _SHOWN[how]
        first = int(signature(show).parameters["digits"].default)
        return [
            _joined(some, partial(show, digits=_apart([some, other], first, show)))
            for some, other in zip(values, others, strict=True)
        ]
    return [_joined(some, _show(how)) for some in values]


def _show(how: str | Show) -> Show:
    if callable(how):
        return how
    return _SHOWN[how] if how in _SHOWN else lambda value: minus(how % value)


def _aligned(
    values: Sequence[Sequence[float | None]], others: Sequence[Sequence[float | None]], digits: int, sign: str
) -> list[str]:
    every = [*values, *others]
    show, first = _alike((value for some in every for value in some), digits)
    enough = _apart(every, first, show)
    return [_joined(some, lambda value: sign * (value >= 0) + show(value, enough)) for some in values]


def _joined(values: Sequence[Any], show: Show) -> str:
    if any(value is None for value in values):
        return DASH
    return " to ".join(map(show, values)) if len(values) > 1 else show(values[0])


def _cell(column: Column, text: str) -> str:
    shown = _lowered(text)
    if shown != escape(text):  # one item beside its header on a narrow screen
        shown = Markup("<span>{}</span>").format(shown)
    return f'<td data-h="{escape(column[0])}"{_left(column)}>{shown}</td>'


def _lowered(text: str) -> Markup:
    return escape(text).replace("n_stick", Markup("n<sub>stick</sub>"))


def _left(column: Column) -> str:
    return ' class="l"' if column[2] is None else ""


def environment(*packages: str) -> Environment:
    """Jinja environment with the templates of some packages and of this one; escapes, and refuses undefined names.

    Every page extends `page.html` of this package, which includes the style.
    """
    found = Environment(
        loader=ChoiceLoader([PackageLoader(name, ".") for name in packages] + [PackageLoader(__package__, ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        extensions=["jinja2.ext.do"],
    )
    found.filters |= {
        "number": number, "fixed": fixed, "percent": percent, "signed_percent": signed_percent, "listed": listed,
        "minus": minus,
    }  # fmt: skip
    found.globals |= {"count": count, "table": table}
    return found
