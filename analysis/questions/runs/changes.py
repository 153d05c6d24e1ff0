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
    sources = (sweep.part, robustness.part, engines.part)
    parts = [part for source in sources if (part := source(study)) is not None]
    if not parts:
        return None
    parts.sort(key=lambda part: not part.lead)
    leading = [part for part in parts if part.lead]
    lead: list[Finding] = []
    for k, part in enumerate(leading):
        lead += part.lead[: MOST_LEADING + 1 - len(leading) if k == 0 else 1]
    rest = [finding for part in leading for finding in (*part.lead, *part.rest) if finding not in lead]
    lacks = [part.lack for part in parts if not part.lead]
    alerts = sorted((alert for part in parts for alert in part.alerts), key=lambda alert: alert.code.rank)
    tables: dict[str, Table] = {"changes": table_of(step for part in parts for step in part.steps)}
    figures: dict[str, Picture] = {}
    for part in parts:
        figures |= dict([*part.figures.items()][:1])
    for part in parts:
        tables |= part.tables
        figures |= {name: picture for name, picture in part.figures.items() if name not in figures}
    return Answer(
        [*lead, *rest, *lacks],
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
