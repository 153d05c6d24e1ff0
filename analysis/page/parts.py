"""Answers as a page has them: sentences, panels, tables, alerts; and all of it in plain values, as JSON."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from matplotlib.figure import Figure

from stickslip.analysis.answer import Answer, Question, Recipe
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Basis, Law, Level, in_units, levels
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.findings.words import sentence
from stickslip.analysis.groups import Group
from stickslip.analysis.page import FINDINGS
from stickslip.analysis.page.data import data_table
from stickslip.analysis.page.layout import MOST_FIRST, MOST_ROWS, Panel, Section, Table, findings_table, is_row
from stickslip.analysis.questions import question
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import pdf, svg
from stickslip.pipeline.design.labels import engines_in_words
from stickslip.pipeline.design.units import DIMENSIONLESS, Units


def engine_laws(groups: Iterable[Group]) -> tuple[str, bool]:
    """What the engines of some groups are, and whether there are several, which pages tell apart by name."""
    engines = {group.key["engine"] for group in groups}
    return signs(engines_in_words(engines)), len(engines) > 1


@dataclass(frozen=True)
class Drawn:
    """A drawn figure: the contents of its files in a report, as PDF if it was asked for, and its caption."""

    svg: str
    pdf: bytes | None = None
    caption: str = ""

    @property
    def panel(self) -> Panel:
        """With the SVG as a data URL, for an image inside the page: of two inline SVGs, ids would clash."""
        image = base64.b64encode(self.svg.encode()).decode("ascii")
        return Panel(f"data:image/svg+xml;base64,{image}", signs(self.caption))


@dataclass(frozen=True)
class Answered:
    """A question's answer with its figures drawn; made of plain values, so that another process may make it.

    Attributes
    ----------
    answer : Answer
        Without figures.
    figures : mapping of str to Drawn
    sources : mapping of str to str
        The files of a user's own question, and the sha256 of each.
    problem : str
        Why a user's own question has no answer: what was expected of the function, and what came.
    missing : tuple of str
        Figures and tables of it that could not be made, and why, a line each.
    """

    key: str
    title: str = ""
    answer: Answer = field(default_factory=Answer)
    figures: Mapping[str, Drawn] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""
    missing: tuple[str, ...] = ()


def ask(study: Study, key: str, with_pdf: bool = False) -> Answered | None:
    """Answer to a question of this package; None if such data do not raise it, as one block has no cascades."""
    entry = question(key)
    answer = entry.answer(study) if entry.is_asked_of(study) else None
    return None if answer is None else answered(key, entry, answer, with_pdf)


def answered(key: str, entry: Question, answer: Answer, with_pdf: bool) -> Answered:
    """An answer to a question, with its figures drawn."""
    figures = {
        name: replace(draw(picture.recipe, with_pdf), caption=picture.caption)
        for name, picture in answer.figures.items()
    }
    return Answered(key, entry.title, replace(answer, method=answer.method or entry.method, figures={}), figures)


def draw(recipe: Recipe | Figure, with_pdf: bool) -> Drawn:
    """A figure drawn as SVG, and as PDF."""
    figure = recipe() if callable(recipe) else recipe
    return Drawn(svg(figure), pdf(figure) if with_pdf else None)


class Part(NamedTuple):
    """An answer as a page has it: its findings as sentences, and as rows of a table."""

    key: str
    title: str
    answer: Answer
    panels: Sequence[Panel]
    sentences: Sequence[str]
    rows: Sequence[Level]

    @property
    def lead(self) -> Sequence[str]:
        """Its first sentences: the answer, or why there is none."""
        return self.sentences[: max(self.answer.n_lead, 1)]

    @property
    def head(self) -> Table:
        """The first rows, for the first screen."""
        in_section = [*filter(is_row, self.rows)][:MOST_ROWS]
        return findings_table(in_section, f"\u201c{self.title}\u201d below", MOST_FIRST)

    def section(self, on_first: Sequence[Panel], is_said: bool, is_shown: bool) -> Section:
        """Folded, without what the first screen says and shows."""
        answer, table, tables = self.answer, findings_table(self.rows, FINDINGS), self.answer.tables
        files = ", ".join(f"report/{name}.parquet" for name, rows in tables.items() if len(rows))
        is_for_readers = ":" in self.key  # a question beside a scene
        later = [*zip(self.sentences, answer.findings, strict=True)][len(self.lead) :]
        # of a law, and of what is lacking, rows do not say all
        in_words = [
            text for text, finding in later if isinstance(finding, Law) or not any(map(is_row, levels(finding)))
        ]
        return Section(
            self.key,
            self.title,
            "" if is_said else self.lead[0],
            [*in_words, answer.method] if is_shown else [*in_words, answer.paragraph, answer.method],
            [panel for panel in self.panels if panel not in on_first],
            Table() if is_shown and len(table.rows) <= MOST_FIRST else table,
            [f"Tables: {files}."] if files else [],
            [data_table(name, table) for name, table in tables.items() if is_for_readers],
        )


def part(question: Answered, units: Units = DIMENSIONLESS) -> Part:
    """An answer as a page has it, in the units of the data."""
    findings = [in_units(finding, units) for finding in question.answer.findings]
    return Part(
        question.key,
        question.title,
        replace(question.answer, findings=findings),
        [figure.panel for figure in question.figures.values()],
        [sentence(finding) for finding in findings],
        [*dict.fromkeys(row for finding in findings for row in levels(finding))],
    )


class Said(NamedTuple):
    """A finding in `report/findings.json`: who asks, whether it stands on the first screen, and its words."""

    question: str
    leads: bool
    sentence: str


class Row(NamedTuple):
    """A value of a finding in `report/findings.json`: what is missing is None, or empty where it is a text.

    By default all is, as of a finding that states no value.
    """

    quantity: str = ""
    setting: str = ""
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    compared_with: str = ""
    compared_value: float | None = None
    compared_low: float | None = None
    compared_high: float | None = None
    difference: float | None = None
    difference_low: float | None = None
    difference_high: float | None = None
    scale: str = ""
    margin: float | None = None
    verdict: str = ""
    n: int | None = None
    unit: str = ""
    form: str = ""
    measured_in: str = ""


def row(level: Level) -> Row:
    """The value of a quantity as a row."""
    comparison, difference, basis = level.comparison, level.difference, level.basis or Basis(0, "")
    return Row(
        level.quantity.name,
        str(level.where),
        *_ends(level.estimate),
        "" if comparison is None else comparison.other,
        *_ends(None if comparison is None else comparison.value),
        *_ends(None if difference is None else difference.estimate),
        "" if difference is None else difference.scale.value,
        None if difference is None else difference.margin,
        "" if difference is None else difference.verdict.value,
        basis.n or None,
        basis.unit,
        level.quantity.form.value,
        level.quantity.unit,
    )


def _ends(estimate: Estimate | None) -> tuple[float | None, float | None, float | None]:
    return (None, None, None) if estimate is None else (estimate.value, estimate.low, estimate.high)


_IF_KNOWN = ("compared_value", "compared_low", "compared_high", "measured_in")


def _row(level: Level) -> dict[str, object]:
    """A row as JSON has it; its unit, and the value of what it is compared with, only if it has one."""
    values = row(level)._asdict()
    return {name: value for name, value in values.items() if name not in _IF_KNOWN or value not in (None, "")}


def findings_json(title: str, lead: Sequence[str], parts: Sequence[Part]) -> dict[str, object]:
    """What the page says, all of it; `lead` are the sentences of the first screen."""
    findings = [
        Said(page.key, k < len(page.lead) and text in lead, text)._asdict()
        | {"kind": type(finding).__name__, "rows": [_row(level) for level in levels(finding)]}
        for page in parts
        for k, (text, finding) in enumerate(zip(page.sentences, page.answer.findings, strict=True))
    ]
    alerts = [
        {"question": page.key, "code": alert.code.name, "words": str(alert), **dict(alert.numbers)}
        for page in parts
        for alert in page.answer.alerts
    ]
    return {"title": title, "findings": findings, "alerts": alerts}
