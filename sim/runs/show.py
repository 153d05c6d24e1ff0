"""Tables that a notebook shows of systems and runs, and the way from a run to its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from stickslip.analysis.pictures import Axes as Axes
    from stickslip.sim.runs.run import Samples
    from stickslip.sim.runs.series import EventSeries


def table(head: str, rows: Mapping[str, object]) -> str:
    """An HTML table of names and values under a head; all text is escaped."""
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    return f"<table><thead><tr><th colspan=2>{escape(head)}</th></tr></thead><tbody>{''.join(lines)}</tbody></table>"


def span(values: np.ndarray) -> str:
    """The one value that an array holds, or its least and greatest."""
    low, high = float(values.min()), float(values.max())
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def plot(
    events: EventSeries, samples: Samples | None, kind: str, ax: Axes | None, options: Mapping[str, Any]
) -> Axes:
    """A picture of a run: see `stickslip.analysis.pictures.plot`, which is loaded when something is drawn."""
    from stickslip.analysis import pictures

    return pictures.plot(events, samples, kind, ax, options)


def html(events: EventSeries) -> str:
    """The picture of a run in a notebook."""
    from stickslip.analysis import pictures

    return pictures.html(events)
