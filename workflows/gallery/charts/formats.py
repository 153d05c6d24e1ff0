"""Numbers and tables as a chart's page shows them: the filters and functions that its template calls."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from stickslip.analysis.findings.numbers import MINUS, signs
from stickslip.analysis.findings.words import listed, plural
from stickslip.analysis.page.layout import Table

DASH = "\u2013"
#: How a column is shown: a format such as "%.1e", a key of `_SHOWN`, or a function; None for words.
How = str | Callable[[Any], str] | None
#: A column of a table: its heading; its key in the rows, or two, of "low to high"; and how its values are shown.
Column = tuple[str, str | tuple[str, str], How]


def number(value: float, digits: int = 3) -> str:
    """A number with a number of significant digits."""
    text = f"{value:,.0f}" if round(abs(value)) >= 10**digits else f"{value:#.{digits}g}".rstrip(".")
    return text.replace("-", MINUS)


def fixed(value: float, decimals: int) -> str:
    """A number with a fixed number of decimals."""
    return f"{value:,.{decimals}f}".replace("-", MINUS)


def percent(value: float, digits: int = 2) -> str:
    """A share in percent, with a number of significant digits."""
    return f"{number(100 * value, digits)}%" if value else "0%"


def signed_percent(value: float, digits: int = 2) -> str:
    """A relative difference in percent with its sign."""
    return "+" * (value >= 0) + percent(value, digits)


def minus(text: str) -> str:
    """A text with hyphens before numbers as minus signs, and without sign before zero; markup stays markup."""
    return type(text)(signs(re.sub(r"(?<![\w])-(?=0(\.0*)?(?![\d.]))", "", text)))


def count(value: float, digits: int = 2) -> str:
    """To so many digits, thousands marked; a small number to two."""
    return f"{float(f'{value:.{digits}g}'):,.0f}" if value >= 10 ** (digits - 1) else f"{value:.2g}"


def power(value: float, digits: int | None = None) -> str:
    """As 3e-4; `digits` after the point at most."""
    return np.format_float_scientific(value, precision=digits, trim="-", exp_digits=1)


def seconds(value: float) -> str:
    for unit, name in ((1.0, "s"), (1e-3, "ms")):
        if value >= unit:
            return f"{value / unit:.3g} {name}"
    return f"{value / 1e-6:.3g} µs"


def span(values: Iterable[float], form: str = "%.3g") -> str:
    """The least and the most of some numbers, once if they look alike."""
    in_order = sorted(values)
    if not in_order:
        return "none"
    low, high = form % in_order[0], form % in_order[-1]
    return low if low == high else f"{low} to {high}"


_SHOWN: Mapping[str, Callable[[Any], str]] = {"n": "{:,}".format, "%": percent, "+%": signed_percent}


def cells(
    rows: Sequence[Any], columns: Sequence[Column], caption: str = "", most: int = 40, where: str = ""
) -> Table:
    """The texts of the first `most` rows of a table, mappings or objects; columns without any value are left out.

    A note says how many more rows there are, `where` the name of the Parquet file that has all.
    """
    head = rows[:most]
    filled = [column for column in columns if any(_values(row, column)[0] is not None for row in head)]
    n_more = len(rows) - most
    note = f"{plural(n_more, 'more row')}{f' in report/{where}.parquet' if where else ''}." if n_more > 0 else ""
    texts = [[_text(_values(row, column), column[2]) for column in filled] for row in head]
    return Table([heading for heading, *_ in filled], texts, note, caption)


def _values(row: Any, column: Column) -> list[Any]:
    keys = [column[1]] if isinstance(column[1], str) else column[1]
    return [row[key] if isinstance(row, Mapping) else getattr(row, key) for key in keys]


def _text(values: Sequence[Any], how: How) -> str:
    """A value as it is shown; words may be markup."""
    if None in values:
        return "" if how is None else DASH
    if how is None:
        return values[0] if isinstance(values[0], str) else str(values[0])
    show = how if callable(how) else _SHOWN.get(how, lambda value: how % value)
    return " to ".join(map(show, values))


#: What templates have, as filters and as functions.
FORMS: dict[str, Callable[..., Any]] = {
    form.__name__: form
    for form in (cells, count, fixed, listed, minus, number, percent, power, seconds, signed_percent, span)
} | {"count3": partial(count, digits=3)}
