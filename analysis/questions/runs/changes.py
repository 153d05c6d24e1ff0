"""What changes, and by how much: along swept keys, under perturbation, and between engines and their settings."""

from __future__ import annotations

from stickslip.analysis.answer import Answer, Picture, Question, Table
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Finding
from stickslip.analysis.grid import axes_of
from stickslip.analysis.pairs import settings
from stickslip.analysis.questions.runs import engines, robustness, sweep
from stickslip.analysis.steps import table_of

MOST_LEADING, MOST_ALERTS = 3, 3


def answer(study: Study) -> Answer | None:
    """The changes that a study has, in the order of the page; None where nothing differs.

    The first kind of change leads with up to three findings, each other with one.
    """
    sources = (sweep.section, robustness.section, engines.section)
    sections = [section for source in sources if (section := source(study)) is not None]
    if not sections:
        return None
    sections.sort(key=lambda section: not section.lead)
    leading = [section for section in sections if section.lead]
    lead: list[Finding] = []
    for k, section in enumerate(leading):
        lead += section.lead[: MOST_LEADING + 1 - len(leading) if k == 0 else 1]
    below = [finding for section in leading for finding in (*section.lead, *section.rest) if finding not in lead]
    lacks = [section.lack for section in sections if not section.lead]
    alerts = sorted((alert for section in sections for alert in section.alerts), key=lambda alert: alert.code.rank)
    tables: dict[str, Table] = {"changes": table_of(step for section in sections for step in section.steps)}
    figures: dict[str, Picture] = {}
    for section in sections:
        figures |= dict([*section.figures.items()][:1])
    for section in sections:
        tables |= section.tables
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
    """Whether the scene is about changes: it sweeps a key, or perturbs its systems."""
    return bool(axes_of(study.groups)) or bool(settings(study.data.table))


QUESTION = Question(
    answer, title="What changes, and by how much?", share=0.4, rank=1, leads=_leads, beside=("sensitivity",)
)
