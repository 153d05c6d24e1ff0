"""Answers as a page has them: sentences, panels, tables, alerts; and all of it in plain values, as JSON."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from stickslip.analysis.answer import Answer, Question, Recipe, Table
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert
from stickslip.analysis.findings.finding import Finding, Lack, Record
from stickslip.analysis.findings.finding import records as finding_records
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.page import FINDINGS
from stickslip.analysis.page.data import data_table
from stickslip.analysis.page.layout import MOST_FIRST, Panel, Section, findings_table
from stickslip.analysis.page.layout import Table as PageTable
from stickslip.analysis.questions import question
from stickslip.analysis.style import pdf, svg


@dataclass(frozen=True)
class Drawn:
    """A drawn figure: the contents of its files in a report; as PDF if it was asked for."""

    svg: str
    pdf: bytes | None = None

    def address(self) -> str:
        """Data URL of the SVG, for an image inside the page; with inline SVGs, ids of two figures would clash."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg.encode()).decode('ascii')}"


@dataclass(frozen=True)
class Answered:
    """A question's answer with its figures drawn; made of plain values, so that another process may make it.

    Attributes
    ----------
    sources : mapping of str to str
        The files of a user's own question, and the sha256 of each.
    problem : str
        Why a user's own question has no answer: what was expected of the function, and what came.
    missing : tuple of str
        Figures and tables of it that could not be made, and why, a line each.
    """

    key: str
    tables: Mapping[str, Table] = field(default_factory=dict)
    figures: Mapping[str, Drawn] = field(default_factory=dict)
    findings: Sequence[Finding] = ()
    n_lead: int = 1
    alerts: Sequence[Alert] = ()
    method: str = ""
    paragraph: str = ""
    captions: Mapping[str, str] = field(default_factory=dict)
    title: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""
    missing: tuple[str, ...] = ()


def ask(study: Study, key: str, with_pdf: bool = False) -> Answered | None:
    """Answer to a question of this package; None if such data do not raise it, as one block has no cascades."""
    entry = question(key)
    answer = entry.answer(study) if entry.is_asked_of(study) else None
    if answer is None:
        return None
    figures = {name: draw(picture.recipe, with_pdf) for name, picture in answer.figures.items()}
    return answered(key, entry, answer, figures)


def answered(key: str, entry: Question, answer: Answer, figures: Mapping[str, Drawn]) -> Answered:
    """An answer to a question, with its figures drawn."""
    captions = {name: picture.caption for name, picture in answer.figures.items()}
    return Answered(
        key, answer.tables, figures, answer.findings, answer.n_lead, answer.alerts,
        answer.method or entry.method, answer.paragraph, captions, entry.title,
    )  # fmt: skip


def draw(recipe: Recipe | Figure, with_pdf: bool) -> Drawn:
    """A figure drawn as SVG, and as PDF."""
    figure = recipe() if callable(recipe) else recipe
    return Drawn(svg(figure), pdf(figure) if with_pdf else None)


@dataclass(frozen=True)
class Part:
    """An answer as a page has it.

    Attributes
    ----------
    lead : sequence of str
        Its sentences, the first of which is the answer, or why there is none.
    is_lack : bool
        Whether there is none.
    head, table : Table
        Of the first findings, for the first screen, and of all.
    tables : sequence of Table
        Data that are for readers.
    """

    key: str
    title: str
    lead: Sequence[str]
    is_lack: bool
    findings: Sequence[Finding]
    alerts: Sequence[Alert]
    panels: Sequence[Panel]
    head: PageTable
    table: PageTable
    tables: Sequence[PageTable]
    texts: Sequence[str]
    notes: Sequence[str]
    paragraph: str = ""

    def section(self, on_first: Sequence[Panel], is_said: bool, is_shown: bool) -> Section:
        """Folded, without what the first screen says and shows."""
        return Section(
            self.key,
            self.title,
            "" if is_said else self.lead[0],
            self.texts if is_shown else [self.paragraph, *self.texts],
            [panel for panel in self.panels if panel not in on_first],
            PageTable() if is_shown and len(self.head.rows) == len(self.table.rows) else self.table,
            self.notes,
            self.tables,
        )


def part(answer: Answered) -> Part:
    """An answer as a page has it."""
    files = [f"report/{name}.parquet" for name in answer.tables]
    rows = [*dict.fromkeys(row for finding in answer.findings for row in finding_records(finding))]
    return Part(
        answer.key,
        answer.title,
        [sentence(finding) for finding in answer.findings[: max(answer.n_lead, 1)]],
        all(isinstance(finding, Lack) for finding in answer.findings),
        answer.findings,
        answer.alerts,
        [Panel(drawn.address(), answer.captions[name]) for name, drawn in answer.figures.items()],
        findings_table(rows, most=MOST_FIRST),
        findings_table(rows, FINDINGS),
        [data_table(*table) for table in _data(answer)],
        [answer.method],
        [f"Tables: {', '.join(files)}."] if files else [],
        answer.paragraph,
    )


def _data(answer: Answered) -> Iterator[tuple[str, pd.DataFrame]]:
    """The tables of a question beside a scene, which are for readers."""
    for name, table in answer.tables.items():
        if ":" in answer.key and isinstance(table, pd.DataFrame):
            yield name, table


def findings_json(title: str, lead: Sequence[str], parts: Sequence[Part]) -> dict[str, Any]:
    """What the page says, all of it; `lead` are the sentences of the first screen."""
    rows = [
        {"question": part.key, "leads": k < len(part.lead) and part.lead[k] in lead, "kind": type(finding).__name__,
         "sentence": sentence(finding), "rows": [_row(row) for row in finding_records(finding)]}
        for part in parts
        for k, finding in enumerate(part.findings)
    ]  # fmt: skip
    alerts = [
        {"question": part.key, "code": alert.code.name, "words": str(alert), **dict(alert.numbers)}
        for part in parts
        for alert in part.alerts
    ]
    return {"title": title, "findings": rows, "alerts": alerts}


def _row(record: Record) -> dict[str, Any]:
    return record._asdict() | {"form": record.form.value}
