"""What changes, and by how much: along swept keys, under perturbation, and between engines and their settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain

import pandas as pd

from stickslip.analysis.answer import Answer, Picture, Question, Table
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding, Lack
from stickslip.analysis.grid import axes_of
from stickslip.analysis.pairs import settings
from stickslip.analysis.questions.runs import engines, robustness, sweep

MOST_LEADING, MOST_ALERTS = 3, 3


def answer(study: Study) -> Answer | None:
    """The changes that a study has, in the order of the page; None where nothing differs."""
    parts = [part for section in (sweep, robustness, engines) if (part := section.answer(study)) is not None]
    if not parts:
        return None
    parts.sort(key=lambda part: isinstance(part.findings[0], Lack))
    told = [part for part in parts if not isinstance(part.findings[0], Lack)] or parts[:1]
    n_more = MOST_LEADING - len(told)  # beside the first of each
    lead: list[Finding] = [
        *told[0].findings[: min(told[0].n_lead, 1 + n_more)],
        *(one.findings[0] for one in told[1:]),
    ]
    rest = [finding for part in parts for finding in part.findings if all(finding is not one for one in lead)]
    alerts = sorted((alert for part in parts for alert in part.alerts), key=lambda alert: alert.code.rank)
    return Answer(
        tables=_tables(parts),
        figures=_figures(parts),
        findings=[*lead, *rest],
        n_lead=len(lead),
        alerts=alerts[:MOST_ALERTS],
        method=" ".join(part.method for part in parts if part.method),
    )


def _tables(parts: Sequence[Answer]) -> dict[str, Table]:
    """The tables of all, with one of all contrasts."""
    contrasts = [part.tables["changes"] for part in parts]
    frames = [table for table in contrasts if isinstance(table, pd.DataFrame)]
    named: dict[str, Table] = {name: table for part in parts for name, table in part.tables.items()}
    return named | {"changes": pd.concat(frames, ignore_index=True)}


def _figures(parts: Sequence[Answer]) -> Mapping[str, Picture]:
    """The first figure of each, and then the others."""
    firsts = chain.from_iterable([*part.figures.items()][:1] for part in parts)
    return dict([*firsts, *(item for part in parts for item in part.figures.items())])


def _leads(study: Study) -> bool:
    """Whether the scene is about changes: it sweeps a key, or perturbs its systems."""
    return bool(axes_of(study.groups)) or bool(settings(study.data.table))


QUESTION = Question(
    answer, title="What changes, and by how much?", share=0.4, rank=1, leads=_leads, beside=("sensitivity",)
)
