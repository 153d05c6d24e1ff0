"""A table of data on a page: its numbers as texts, by what its columns hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from stickslip.analysis.findings.finding import Form
from stickslip.analysis.findings.numbers import MINUS, alike, number, with_interval
from stickslip.analysis.findings.words import plural
from stickslip.analysis.page.layout import MOST_ROWS, Table, setting_in_cell
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.values import short


def data_table(name: str, data: pd.DataFrame) -> Table:
    """The first rows of a table with nullable types; `x_low` and `x_high` are the interval of `x`."""
    numeric = {column for column in data if str(data[column].dtype) in ("Float64", "Int64")}
    ends = {column: (column, f"{column}_low", f"{column}_high") for column in data}
    ends = {column: three for column, three in ends.items() if numeric.issuperset(three)}
    hidden = {end for three in ends.values() for end in three[1:]}
    rows = data.head(MOST_ROWS).astype(object).where(data.head(MOST_ROWS).notna(), None)
    columns = {
        column: _estimates(rows[[*ends[column]]]) if column in ends else [_text(value) for value in rows[column]]
        for column in data
        if column not in hidden
    }
    n_more = len(data) - MOST_ROWS
    note = f"{plural(n_more, 'more row')} in report/{name}.parquet." if n_more > 0 else ""
    head = [str(column).replace("_", " ") for column in columns]
    return Table(head, [*zip(*columns.values(), strict=True)], note, name)


def _estimates(rows: pd.DataFrame) -> Sequence[str]:
    estimates = [Estimate(*row) for row in rows.itertuples(index=False)]
    digits = alike(estimates, Form.NUMBER)
    return ["" if estimate.value is None else with_interval(estimate, Form.NUMBER, digits) for estimate in estimates]


def _text(value: Any) -> str:
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}".replace("-", MINUS)
        case float():
            plain = f"{value:.4g}"  # a setting, say
            return short(value).replace("-", MINUS) if float(plain) == value else number(value)
    return setting_in_cell(value)
