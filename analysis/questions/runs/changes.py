"""What changes, and by how much: along swept keys, under perturbation, and between engines and their settings."""

from __future__ import annotations

import pandas as pd

from stickslip.analysis.answer import Answer, Picture, Question, Table
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding
from stickslip.analysis.grid import axes_of
from stickslip.analysis.pairs import settings
from stickslip.analysis.questions.runs import engines, robustness, sweep

MOST_LEADING, MOST_ALERTS = 3, 3


def answer(study: Study) -> Answer | None:
    """The changes that a study has, in the order of the page; None where nothing differs.

    The first kind of change leads with up to three findings, each other with one.
    """
    sources = (sweep.answer, robustness.answer, engines.answer)
    answers = [part for source in sources if (part := source(study)) is not None]
    if not answers:
        return None
    answers.sort(key=lambda part: part.is_lack)
    leading = [part for part in answers if not part.is_lack]
    lead: list[Finding] = []
    for k, part in enumerate(leading):
        most = MOST_LEADING + 1 - len(leading) if k == 0 else 1
        lead += part.findings[: min(part.n_lead, most)]
    below = [finding for part in leading for finding in part.findings if finding not in lead]
    lacks = [finding for part in answers if part.is_lack for finding in part.findings]
    alerts = sorted((alert for part in answers for alert in part.alerts), key=lambda alert: alert.code.rank)
    tables: dict[str, Table] = {"changes": pd.concat([part.tables["changes"] for part in answers], ignore_index=True)}
    figures: dict[str, Picture] = {}
    for part in answers:
        figures |= dict([*part.figures.items()][:1])
    for part in answers:
        tables = {**part.tables, **tables}
        figures |= {name: picture for name, picture in part.figures.items() if name not in figures}
    return Answer(
        [*lead, *below, *lacks],
        max(len(lead), 1),
        alerts[:MOST_ALERTS],
        " ".join(part.method for part in leading if part.method),
        tables=tables,
        figures=figures,
    )


def _leads(study: Study) -> bool:
    """Whether the scene is about changes: it sweeps a key, or perturbs its systems."""
    return bool(axes_of(study.groups)) or bool(settings(study.data.table))


QUESTION = Question(
    answer, title="What changes, and by how much?", share=0.4, rank=1, leads=_leads, beside=("sensitivity",)
)
