"""Words and small tables that a notebook shows of systems and runs."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np


def table(head: str, rows: Mapping[str, object]) -> str:
    """An HTML table of names and values under a head; all text is escaped."""
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    return f"<table><thead><tr><th colspan=2>{escape(head)}</th></tr></thead><tbody>{''.join(lines)}</tbody></table>"


def span(values: np.ndarray) -> str:
    """The one value that an array holds, or its least and greatest."""
    low, high = float(values.min()), float(values.max())
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
