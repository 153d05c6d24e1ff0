"""What changes, and by how much: along swept keys, under perturbation, and between engines and their settings."""

from __future__ import annotations

import pandas as pd

from stickslip.analysis.answer import Answer, Picture, Question, Table
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding
from stickslip.analysis.grid import axes_of
from stickslip.analysis.pairs import settings
from stickslip.analysis.questions.runs import engines, robustness, sweep
from stickslip.analysis.questions.runs.coexistence import is_asked

MOST_LEADING, MOST_ALERTS = 3, 3


def answer(study: Study) -> Answer | None:
    """The changes that a study has, in the order of the page; None where nothing differs.

    The first kind of change leads with up to three findings, each other with one.
    """
    sources = (sweep.answer, robustness.answer, engines.answer)
    answers = [section for source in sources if (section := source(study)) is not None]
    if not answers:
        return None
    answers.sort(key=lambda section: section.is_lack)
    leading = [section for section in answers if not section.is_lack]
    lead: list[Finding] = []
    for k, section in enumerate(leading):
        n_most = MOST_LEADING + 1 - len(leading) if k == 0 else 1
        lead += section.findings[: min(section.n_lead, n_most)]
    below = [finding for section in leading for finding in section.findings if finding not in lead]
    lacks = [finding for section in answers if section.is_lack for finding in section.findings]
    alerts = sorted((alert for section in answers for alert in section.alerts), key=lambda alert: alert.code.rank)
    tables: dict[str, Table] = {
        "changes": pd.concat([section.tables["changes"] for section in answers], ignore_index=True)
    }
    figures: dict[str, Picture] = {}
    for section in answers:
        figures |= dict([*section.figures.items()][:1])
    for section in answers:
        tables = {**section.tables, **tables}
        figures |= {name: picture for name, picture in section.figures.items() if name not in figures}
    return Answer(
        [*lead, *below, *lacks],
        max(len(lead), 1),
        alerts[:MOST_ALERTS],
        " ".join(section.method for section in leading if section.method),
        tables=tables,
        figures=figures,
    )


def _leads(study: Study) -> bool:
    """Whether the scene is about changes: it sweeps a key, and not to see what attracts, or perturbs its systems."""
    return not is_asked(study) and (bool(axes_of(study.groups)) or bool(settings(study.data.table)))


QUESTION = Question(
    answer, title="What changes, and by how much?", share=0.4, rank=1, leads=_leads, beside=lambda _: ("sensitivity",)
)
