"""What is kept of every run: its outcome, counts, and n_stick."""

from __future__ import annotations

from functools import partial
from typing import Any

from stickslip.pipeline.design.column import Column
from stickslip.pipeline.records.record import Made, Record

_of_each = partial(Column, along="change")


class OutcomeRecord(Record):
    """Outcome, counts and n_stick, in every dataset; n_stick is taken from the events of many runs at once."""

    name = "outcome"
    words = ""
    columns = (
        Column("text", "outcome", "finished, collapsed, diverged or failed", False),
        Column("text", "reason", "why the outcome is not finished"),
        Column(
            "text",
            "reproduce",
            "command that runs a failed member alone, given in the dataset's directory; null if not failed",
        ),
        Column(
            "number",
            "t_stop",
            "end of a diverged run; from when on it is certain that a collapsed one does not stick again; else t_end;"
            " null if failed",
            is_time=True,
            dimension="time",
        ),
        Column("whole", "n_stick_end", "number of sticking blocks at t_stop; null if failed", least=0.0),
        Column("count", "n_events", "entries, exits and crossings together; null if failed", least=0.0),
        Column("count", "n_entries", "events slip -> stick; null if failed", least=0.0),
        Column("count", "n_exits", "events stick -> slip; null if failed", least=0.0),
        Column("count", "n_crossings", "events from slipping one way to the other; null if failed", least=0.0),
        Column("count", "n_steps", "steps of the engine; null if failed", least=0.0),
        Column("count", "n_rejected", "steps repeated with a smaller size; null if failed", least=0.0),
        Column("count", "n_products", "products of K with a vector; null if failed", least=0.0),
        _of_each(
            "numbers",
            "t",
            "t[0] = 0 and each time at which n_stick changes; null if failed",
            repeats=False,
            is_time=True,
            dimension="time",
        ),
        _of_each(
            "wholes", "n_stick", "number of sticking blocks; n_stick[k] holds on [t[k], t[k+1]); null if failed"
        ),
    )

    def of(self, result: Made) -> dict[str, Any]:
        run = result.run
        return {
            "outcome": run.outcome,
            "reason": run.reason or None,
            "t_stop": run.t_end if run.t_collapse is None else run.t_collapse,
            "n_events": run.stats.n_events,
            "n_steps": run.stats.n_steps,
            "n_rejected": run.stats.n_rejected,
            "n_products": run.stats.n_products,
        }
