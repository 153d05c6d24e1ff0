"""Long-term robustness in words: verdicts, yardsticks, frequencies and what leads the section."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import Any

from stickslip.analysis.pairs import CONSTANTS, RATIOS, START, Setting
from stickslip.analysis.questions import contrast
from stickslip.analysis.report import words
from stickslip.analysis.report.section import Rows
from stickslip.analysis.stats.compare import DIFFERENT, EQUIVALENT, OPEN
from stickslip.analysis.stats.quantities import LABELS

ENDS = {"collapsed": "total collapse", "silent": "silent, not certified", "diverged": "runaway"}
_SAME_PATH = 0.5  # below so many times the noise of the window, runs have hardly left each other's path


def verdict_words(row: Mapping[str, Any]) -> str:
    """A verdict with what it rests on: difference, interval, margin, and how many matrices more it takes."""
    difference, low, high = (words.signed_percent(row[name]) for name in ("difference", "low", "high"))
    value = f"{difference} ({low} to {high})"
    said = contrast.verdict_words(row, value, row["low"], row["high"], words.percent(row["margin"]))
    needed = row.get("matrices_needed")
    if row["verdict"] != OPEN or row["by_itself"] != OPEN or needed is None:
        return said
    if needed > row["n_matrices"]:
        return f"{said}; about {needed} matrices would be needed"
    return f"{said}; the estimate itself stands near the margin"


def lead_words(setting: Setting, rows: Rows, frequencies: Rows, is_first: bool) -> list[str]:
    """How the verdicts on constants and ratios fell, a sentence each; what a fresh matrix does, once."""
    found: list[str] = []
    for kind in (RATIOS, CONSTANTS):
        some = [row for row in rows if row["kind"] == kind and row["difference"] is not None]
        if not some:
            continue
        by = {verdict: sum(row["verdict"] == verdict for row in some) for verdict in (EQUIVALENT, DIFFERENT, OPEN)}
        parts = [f"{count} {verdict}" for verdict, count in by.items() if count]
        readings = ", ".join(dict.fromkeys(row["reading"] for row in some if row["reading"]))
        name = _kind_words(kind, readings or None)
        sizes = [row["size"] for row in some if row["size"] is not None]
        by_size = f" by {words.percent(min(sizes))} to {words.percent(max(sizes))}" if sizes else ""
        of_all = f"{words.count(len(some), 'comparison')} of a statistic with the unchanged runs"
        text = f"{setting.label}, {name}{by_size}: of {of_all} {', '.join(parts)}"
        away = [row for row in frequencies if row["kind"] == kind and row["event"] == "runaway"]
        away = [row for row in away if row["share"] > (row["share_base"] or 0.0)]
        if away:
            counts = [f"{row['n_events']} of {row['n_runs']} at {words.percent(row['size'])}" for row in away]
            text += f"; {', '.join(counts)} run away and are not compared"
        found.append(text)
        if is_first and len(found) == 1:
            reading = some[0]["reading"]
            found += _yardstick(setting, _kind_words(kind, reading), [r for r in some if r["reading"] == reading])
    return found


def statements_of(setting: Setting, rows: Rows, frequencies: Rows, confidence: float) -> tuple[list[str], list[str]]:
    """Verdicts by kind of change, what they mean beside a redraw, and the paper's two observations as frequencies.

    Of changes of the constants and ratios, which the paper made, these are answers; the rest are notes.
    """
    found: list[str] = []
    notes: list[str] = []
    for (kind, reading), group in groupby(rows, key=lambda row: (row["kind"], row["reading"])):
        some = list(group)
        name = _kind_words(kind, reading)
        if all(row["difference"] is None for row in some):
            notes.append(f"{setting.label}, {name}: {_nothing(some, frequencies)}")
            continue
        said = found if kind != START else notes
        said.append(f"{setting.label}, {name}: {_verdicts(some)}")
        said += _yardstick(setting, name, some)
    found += _runaways(setting, frequencies)
    for event, size in (("period near 20", 0.05), ("total collapse", 0.10)):
        of_event = [row for row in frequencies if row["kind"] == CONSTANTS and row["event"] == event]
        at = [row for row in of_event if row["size"] == size]
        if at:
            said = found if any(row["difference"] is not None for row in rows) else notes
            said.append(f"{setting.label}: {_frequency_words(event, size, at, confidence)}")
    return found, notes


def _runaways(setting: Setting, frequencies: Rows) -> list[str]:
    """Which changes made runs escape to infinity, where that is more than the bases do."""
    found = []
    some = [row for row in frequencies if row["event"] == "runaway" and row["share"] > (row["share_base"] or 0.0)]
    for (kind, reading), group in groupby(some, key=lambda row: (row["kind"], row["reading"])):
        parts = [f"at {words.percent(row['size'])} {row['n_events']} of {row['n_runs']}" for row in group]
        found.append(
            f"{setting.label}, {_kind_words(kind, reading)}: runs escape to infinity, which counts as no collapse:"
            f" {', '.join(parts)}"
        )
    return found


def _kind_words(kind: str, reading: str | None) -> str:
    names = {"start": "start displaced", "ratios": "stiffness ratios redrawn", "constants": "constants changed"}
    return names[kind] + (f" ({reading})" if reading else "")


def _nothing(rows: Rows, frequencies: Rows) -> str:
    same = [row for row in frequencies if row["kind"] == rows[0]["kind"] and row["reading"] == rows[0]["reading"]]
    ends = {event: sum(row["n_events"] for row in same if row["event"] == event) for event in ENDS.values()}
    n_runs = sum(row["n_runs"] for row in same if row["event"] == "runaway")
    text = ", ".join(f"{count} in {event}" for event, count in ends.items() if count)
    return f"nothing to compare after t_burn: of {n_runs} changed runs {text or 'none'} ended early or went quiet"


def _verdicts(rows: Rows) -> str:
    """The quantities by what was found of them, and at which sizes; quantities found alike stand together."""
    alike: dict[str, list[str]] = {}
    for quantity in dict.fromkeys(row["quantity"] for row in rows):
        some = [row for row in rows if row["quantity"] == quantity]
        if len(some) == 1 and some[0]["size"] is None:
            alike.setdefault(some[0]["statement"], []).append(LABELS[quantity])
            continue
        by_verdict = []
        for verdict in (EQUIVALENT, DIFFERENT, OPEN):
            sizes = [row["size"] for row in some if row["verdict"] == verdict]
            if sizes:
                is_share = some[0]["kind"] == CONSTANTS
                listed = ", ".join(words.percent(size) if is_share else f"{size:g}" for size in sizes)
                by_verdict.append(f"{verdict} at {'every size' if len(sizes) == len(some) else listed}")
        alike.setdefault("; ".join(by_verdict), []).append(LABELS[quantity])
    return ". ".join(f"{words.capital(found)}: {', '.join(names)}" for found, names in alike.items())


def _yardstick(setting: Setting, name: str, rows: Rows) -> list[str]:
    """What the change does to mean n_stick, beside a fresh matrix and the length of the window."""
    some = [row for row in rows if row["quantity"] == "mean" and row["against_redraw"] is not None]
    if not some:
        return []
    still = [row for row in some if row["typical"] < _SAME_PATH * row["noise"]]
    gone = [row for row in some if row not in still]
    parts = []
    if still:
        sizes = ", ".join(f"{row['size']:g}" for row in still if row["size"] is not None)
        at = f"at size {sizes} " if sizes else ""
        parts.append(
            f"{at}the runs still follow the path of their base, so sameness there says nothing of robustness"
        )
    if gone:
        first = gone[0]
        at = "" if first["size"] is None else f" at size {first['size']:g}"
        text = (
            f"mean n_stick of one matrix moves{at} by {words.percent(first['typical'])}, "
            f"{words.number(first['against_redraw'], 2)} "
            f"({words.interval(first['against_low'], first['against_high'])}) "
            f"of what a fresh matrix does, where the length of the window alone gives {words.percent(first['noise'])}"
        )
        if first["against_low"] <= 1 <= first["against_high"]:
            text += ": it is not shown that the change does less than a complete redraw would"
        elif first["typical"] <= 1.2 * first["noise"]:
            text += ": no more than two stretches of one run differ"
        parts.append(text)
    return [f"{setting.label}, {name}: " + "; ".join(parts)]


def _frequency_words(event: str, size: float, rows: Rows, confidence: float) -> str:
    by_reading = []
    for row in rows:
        beside = row.get("share_redraw") if event == "period near 20" else row.get("share_base")
        text = f"{row['n_events']} of {row['n_runs']} runs ({row['reading']}; {_shares(row)})"
        if beside is not None:
            who = "two different matrices" if event == "period near 20" else "the bases"
            text += f" where {who} give {words.percent(beside)}"
        by_reading.append(text)
    claim = {"period near 20": "period-20 oscillations", "total collapse": "total collapse"}[event]
    return f"{claim} at {words.percent(size)}, as frequencies ({words.percent(confidence)} intervals): " + "; ".join(
        by_reading
    )


def _shares(row: Mapping[str, Any]) -> str:
    high = words.percent(row["high"])
    return f"{words.percent(row['low'])} to {high}" if row["low"] else f"at most {high}"
