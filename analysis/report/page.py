"""The report: one self-contained HTML page, its tables as Parquet and JSON, its figures as SVG and PDF."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from jinja2 import Environment, TemplateNotFound
from jinja2.runtime import Macro
from markupsafe import Markup
from matplotlib.figure import Figure

from stickslip.analysis.answer import LONG, Answer, F, I, Long, Picture, Question, Recipe, S, Table, frame
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Finding, Lack, Record
from stickslip.analysis.findings.finding import records as finding_records
from stickslip.analysis.findings.words import plural, sentence
from stickslip.analysis.members import ENGINE_KEYS, OPTIONAL, START, SYSTEM_KEYS, TOLERANCES
from stickslip.analysis.page import layout
from stickslip.analysis.page.data import data_table
from stickslip.analysis.page.layout import MOST_FIRST, MOST_ROWS, Page, Panel, Section, findings_table
from stickslip.analysis.page.layout import Table as PageTable
from stickslip.analysis.questions import QUESTIONS, is_own, package_questions, question, refuse_unknown
from stickslip.analysis.report import AS_TEXT, FORMULA, PAGE
from stickslip.analysis.report.formats import capital, environment
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.style import pdf, svg
from stickslip.analysis.tables import records
from stickslip.pipeline.design.design import Unit
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number
from stickslip.sim.systems.terms import TERMS

#: What a question's template may lack: macros, and up to which rank its alerts are about the data, so that they are
#: shown whatever question leads; a tick has the last.
OPTIONAL_WORDS = ("lack", "alarm", "alerts", "panels", "panel", "panel_caption", "main", "of_data")
_TICK = 9
STOP, OF_DATA = 0, 2  # ranks of alerts
UNITS: Mapping[str, str] = {Unit.MATRIX: "systems", Unit.START: "starts of one system", Unit.FILE: "files"}
FINDINGS = "report/findings.json"
MOST_SAID = 3  # answers on the first screen
_ROWS = 10_000  # of a table that is in the JSON of all; a longer one is read from a file of its own
MOST_ALERTS = 3  # in order of rank
_GROUPS: Mapping[str, str] = {
    "group": S, **dict.fromkeys(("n", "matrices", "starts", "members", "finished", "quiet"), I), "coupling": S,
    "file": S, "parameters": S,
    **dict.fromkeys(("belt_speed", "kappa", "rho", "t_end", "perturbation_size"), F),
    **dict.fromkeys((key for key in OPTIONAL if key not in ("file", "parameters")), F), "back_slip": S, "drawn": S,
    **{name: F if isinstance(SETTINGS.get(name), Number) else S for name in ENGINE_KEYS},
}  # fmt: skip


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
    facts: Mapping[str, Any]
    lack: str = ""
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

    def figure(self, name: str, alt: str) -> Markup:
        """A figure as an image that is part of the page."""
        return Markup('<img src="{}" alt="{}">').format(self.figures[name].address(), alt)


def prepare() -> None:
    """Compile the templates in advance, while a process is idle."""
    layout.prepare()
    filled = environment()
    for name in QUESTIONS:
        with suppress(TemplateNotFound):
            filled.get_template(f"{name}.html")


def ask(study: Study, key: str, with_pdf: bool = False) -> Answered | None:
    """Answer to a question of this package; None if such data do not raise it, as one block has no cascades."""
    entry = question(key)
    found = entry.answer(study) if entry.is_asked_of(study) else None
    if found is None:
        return None
    recipes = {name: some.recipe if isinstance(some, Picture) else some for name, some in found.figures.items()}
    return answered(key, entry, found, {name: draw(recipe, with_pdf) for name, recipe in recipes.items()})


def answered(key: str, entry: Question, answer: Answer, figures: Mapping[str, Drawn]) -> Answered:
    """An answer to a question, with its figures drawn."""
    captions = {name: some.caption for name, some in answer.figures.items() if isinstance(some, Picture)}
    lack = "lack" if answer.findings and all(isinstance(some, Lack) for some in answer.findings) else answer.lack
    return Answered(
        key, answer.facts, lack, answer.tables, figures, answer.findings, answer.n_lead, answer.alerts,
        answer.method or entry.method, answer.paragraph, captions, entry.title,
    )  # fmt: skip


def draw(recipe: Recipe | Figure, with_pdf: bool) -> Drawn:
    """A figure drawn as SVG, and as PDF."""
    figure = recipe() if callable(recipe) else recipe
    return Drawn(svg(figure), pdf(figure) if with_pdf else None)


@dataclass(frozen=True)
class Report:
    """A finished report.

    Attributes
    ----------
    html : str
        The whole page, with its images inside.
    tables : mapping of str to Table
        All tables, with nulls where a column does not apply or a number could not be computed.
    headline : list of str
        The main statements, for a terminal.
    figures : dict of str to Drawn
    problems : dict of str to str
        Why questions of the user's own have no answer, or not all of it, by name.
    not_run : list of str
        Questions of the user's own that were not run.
    findings : mapping
        What the page says, in plain values.
    """

    html: str
    tables: Mapping[str, Table]
    headline: list[str]
    figures: dict[str, Drawn] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    not_run: list[str] = field(default_factory=list)
    findings: Mapping[str, Any] = field(default_factory=dict)

    def files(self) -> dict[str, Callable[[], bytes]]:
        """What makes the contents of each of the report's files, by path: all at once may be large.

        The page comes last: once it exists, all that it names exists.
        """
        made: dict[str, Callable[[], bytes]] = {}
        for name, table in self.tables.items():
            made[f"report/{name}.parquet"] = partial(_parquet, table)
            if not isinstance(table, Long) and len(table) <= LONG:
                made[f"report/{name}.csv"] = partial(_csv, table)
        made["report/tables.json"] = partial(_json, self.tables)
        if self.findings:
            made[FINDINGS] = partial(_plain_json, self.findings)
        for name, drawn in self.figures.items():
            made[f"report/figures/{name}.svg"] = drawn.svg.encode
            if drawn.pdf is not None:
                made[f"report/figures/{name}.pdf"] = partial(bytes, drawn.pdf)
        return made | {PAGE: self.html.encode}

    def gone(self) -> list[str]:
        """Files that a report which listed none may have, and this one lacks, by path."""
        return [f"report/figures/{name}.pdf" for name, drawn in self.figures.items() if drawn.pdf is None]


def _parquet(table: Table) -> bytes:
    written = pa.BufferOutputStream()
    writer: pq.ParquetWriter | None = None
    for part in table if isinstance(table, Long) else [table]:
        rows = pa.Table.from_pandas(part, preserve_index=False)
        writer = writer or pq.ParquetWriter(written, rows.schema)
        writer.write_table(rows)
    assert writer is not None  # a table that is long has a part
    writer.close()
    return written.getvalue().to_pybytes()


def _csv(table: pd.DataFrame) -> bytes:
    plain = table.astype(dict.fromkeys(table.select_dtypes("category"), object))
    return str(plain.replace(FORMULA, AS_TEXT, regex=True).to_csv(index=False)).encode()


def _json(tables: Mapping[str, Table]) -> bytes:
    """Tables of up to `_ROWS` rows as JSON lists of rows, one row a line."""
    encode = json.JSONEncoder(allow_nan=False).encode
    listed = []
    for name, table in tables.items():
        if not isinstance(table, Long) and len(table) <= _ROWS:
            rows = ",\n".join(map(encode, records(table)))
            listed.append(f"{encode(name)}: [\n{rows}\n]")
    return ("{\n" + ",\n".join(listed) + "\n}\n").encode()


def _plain_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()


def build(
    data: Data,
    settings: AnalysisSettings,
    title: str,
    about: str,
    provenance: Mapping[str, str],
    answers: Callable[[Study], Iterable[Answered | None]] | None = None,
    made_from: str = "",
) -> Report:
    """Report on an ensemble.

    Parameters
    ----------
    data : Data
        The members and their records; `series` of every member that did not fail.
    settings : AnalysisSettings
    title, about : str
        Shown at the head of the page, escaped.
    provenance : mapping of str to str
        Where the data come from, shown as given, escaped.
    answers : callable, optional
        Returns what `ask` returns for each question of this package that is asked, in their order, then
        that of each of the user's own that was run; default: asks the former one after the other.
    made_from : str, optional
        Digest of all this, kept at the head of the page.

    Raises
    ------
    ValueError
        If members, series or settings contradict each other; names the column, member or setting.
    """
    refuse_unknown(settings.question)
    study = Study(data, settings)
    made = [ask(study, key) for key in package_questions(settings.question)] if answers is None else answers(study)
    own = {one.key: one for one in made if one is not None and is_own(one.key)}
    problems = {key: one.problem for key, one in own.items() if one.problem}
    missing = {key: "; ".join(one.missing) for key, one in own.items() if one.missing}
    not_run = [key for key in settings.question if is_own(key) and key not in own]
    found = [one for one in made if one is not None and one.key not in problems]
    groups = groups_table(study)
    filled = environment()
    filled.globals["unit"] = study.unit
    parts = [_part(filled, one) for one in found]
    leading, others = _in_order(study, [part for part in parts if not part.is_lack])
    if leading and leading[0].key in own:  # the page is the user's
        title, about = leading[0].title, _joined(title, about)
    lead = _lead(leading)
    stops = [text for part in (*leading, *others) for rank, text in part.alerts if rank == STOP]
    on_first = [panel for part in leading[:2] for panel in part.panels[: 2 if len(leading) == 1 else 1]]
    raised = {part.key for part in parts}
    lacking = [part for part in parts if part.is_lack]
    asked = [part for part in lacking if part.key in settings.question]
    notes = [
        *(f"Asked but not answered: {part.title} {text}" for part in asked for text in part.lead),
        *(f"Asked but not answered: {name}: {problem}." for name, problem in problems.items()),
        *(f"Left out of the answer: {name}: {lines}." for name, lines in missing.items()),
        *(f"{name} was not run; stickslip report DIR --own runs the code beside the scene." for name in not_run),
        *(f"Asked but not answered: {question(key).title or key}: nothing that it needs was run or recorded."
          for key in settings.question if not is_own(key) and key not in raised),
    ]  # fmt: skip
    sections = [
        _section(part, on_first, k < len(lead) and part in leading, k == 0 and part in leading)
        for k, part in enumerate((*leading, *others))
    ]
    sources = {file: digest for one in own.values() for file, digest in one.sources.items()}
    sections.append(_provenance(study, groups, lacking, sources, provenance))
    page = Page(
        title,
        about or (leading[0].title if leading else ""),
        lead,
        stops,
        on_first,
        leading[0].head if leading else PageTable(),
        _alerts(study, leading, [part for part in parts if part not in leading]),
        notes,
        sections,
        paragraph=leading[0].paragraph if leading else "",
        inside=leading[0].first if leading else Markup(),
        meta={"made-from": made_from} | ({"own-questions": "run"} if sources else {}),
    )
    tables = {"groups": groups} | {name: table for one in found for name, table in one.tables.items()}
    figures = {name: drawn for one in found for name, drawn in one.figures.items()}
    headline = [*map(plain, stops), title, *map(plain, lead)]
    told = findings_json(title, leading, [*others, *lacking])
    return Report(page.html, tables, headline, figures, problems | missing, not_run, told)


def _lead(leading: Sequence[Part]) -> list[str | Markup]:
    """The answer: of one question up to three findings, of several the first of each."""
    if len(leading) == 1:
        return [*leading[0].lead[:MOST_SAID]]
    return [part.lead[0] for part in leading[:MOST_SAID]]


def _section(part: Part, on_first: Sequence[Panel], is_said: bool, is_shown: bool) -> Section:
    """The folded part of an answer, without what the first screen says and shows."""
    return Section(
        part.key,
        part.title,
        "" if is_said else part.lead[0],
        part.texts if is_shown else [part.paragraph, *part.texts],
        [panel for panel in part.panels if panel not in on_first],
        PageTable() if is_shown and len(part.head.rows) == len(part.table.rows) else part.table,
        part.notes,
        part.tables,
        part.inside if is_shown else part.first + part.inside,
    )


def _provenance(
    study: Study,
    groups: pd.DataFrame,
    lacking: Sequence[Part],
    sources: Mapping[str, str],
    origin: Mapping[str, str],
) -> Section:
    """How the page was made: settings, what could not be answered, and where the data come from."""
    settings = study.settings
    texts = [
        f"Statistics use t = {settings.t_burn:g} to the end of each run. Intervals are at "
        f"{100 * settings.confidence:g}%, over {UNITS[study.unit]}, which are independent; of shares they are "
        "Wilson's, of survival Greenwood's, else from leaving out one of these at a time. Quantities are "
        "dimensionless.",
        *(f"Not answered: {part.title} {text}" for part in lacking for text in part.lead),
    ]
    notes = [
        "".join(f"{name}: {value}. " for name, value in origin.items()),
        *(f"Code beside the scene: {file} (sha256 {digest})." for file, digest in sources.items()),
        "Findings: report/findings.json. Tables: report/*.parquet. Figures: report/figures/.",
    ]
    shown = ("group", "members", "finished", "matrices", "starts")
    rows = [[str(row[name] or "") for name in shown] for row in records(groups)[:MOST_ROWS]]
    table = PageTable(("setting", "runs", "finished", "systems", "starts"), rows)
    return Section(
        "made", "How was it made?", f"{plural(len(study.data.table), 'run')}.", texts, table=table, notes=notes
    )


def _joined(title: str, about: str) -> str:
    """A scene's title, before what it is about."""
    return f"{title}{' ' if title.endswith('?') else ': '}{about}" if title and about else title or about


@dataclass(frozen=True)
class Part:
    """An answer as a page has it.

    Attributes
    ----------
    lead : sequence of str
        Its sentences, the first of which is the answer, or why there is none.
    alerts : sequence of (int, str)
        With their ranks.
    head, table : Table
        Of the first findings, for the first screen, and of all.
    first, inside : Markup
        Of a template: what stands on the first screen if the question leads, and what is folded.
    upto : int
        The largest rank of the alerts that are shown although the question does not lead.
    """

    key: str
    title: str
    lead: Sequence[str | Markup]
    is_lack: bool = False
    alerts: Sequence[tuple[int, str | Markup]] = ()
    panels: Sequence[Panel] = ()
    head: PageTable = field(default_factory=PageTable)
    table: PageTable = field(default_factory=PageTable)
    texts: Sequence[str] = ()
    notes: Sequence[str] = ()
    first: Markup = field(default_factory=Markup)
    inside: Markup = field(default_factory=Markup)
    upto: int = OF_DATA
    findings: Sequence[Finding] = ()
    told: Sequence[Alert] = ()
    paragraph: str = ""
    tables: Sequence[PageTable] = ()


def _part(filled: Environment, one: Answered) -> Part:
    return of_findings(one) if one.findings else _of_template(filled, one)


def of_findings(one: Answered) -> Part:
    files = [f"report/{name}.parquet" for name in one.tables]
    rows = [*dict.fromkeys(row for finding in one.findings for row in finding_records(finding))]
    return Part(
        one.key,
        one.title,
        [sentence(finding) for finding in one.findings[: max(one.n_lead, 1)]],
        all(isinstance(finding, Lack) for finding in one.findings),
        [(alert.code.rank, str(alert)) for alert in one.alerts],
        [Panel(drawn.address(), one.captions[name]) for name, drawn in one.figures.items()],
        findings_table(rows, most=MOST_FIRST),
        findings_table(rows, FINDINGS),
        [one.method],
        [f"Tables: {', '.join(files)}."] if files else [],
        findings=one.findings,
        told=one.alerts,
        paragraph=one.paragraph,
        tables=[data_table(*pair) for pair in _data(one)],
    )


def _data(one: Answered) -> Iterator[tuple[str, pd.DataFrame]]:
    """The tables of a question beside a scene, which are for readers."""
    for name, table in one.tables.items():
        if ":" in one.key and isinstance(table, pd.DataFrame):
            yield name, table


def _of_template(filled: Environment, one: Answered) -> Part:
    """The part of an answer that a template puts into words."""
    words = SimpleNamespace(**(dict.fromkeys(OPTIONAL_WORDS) | vars(filled.get_template(f"{one.key}.html").module)))

    def says(name: str, *given: Any) -> Markup:
        macro: Macro | None = getattr(words, name)
        return Markup() if macro is None else Markup(str(macro(one.facts, *given)).strip())

    if one.lack:
        return Part(one.key, words.name, [Markup(capital(says("lack", one.lack)))], is_lack=True)
    alerts = [(_rank(item), Markup(re.sub(r"</?li[^>]*>", "", item))) for item in _items(says("alerts"))]
    stop = says("alarm")
    first = Markup("")
    if words.panels or words.panel:
        first = says("panels", one.figure) or says("panel", one.figure) + says("panel_caption")
    return Part(
        one.key,
        words.name,
        [says("answer")],
        alerts=[*([(STOP, stop)] if stop else []), *(pair for pair in alerts if pair[0] < _TICK)],
        first=first + says("main"),
        inside=says("part", one.figure),
        upto=words.of_data or 0,
    )


def findings_json(title: str, leading: Sequence[Part], others: Sequence[Part]) -> dict[str, Any]:
    """What the page says, all of it."""
    rows = [
        {"question": part.key, "leads": part in leading and k < len(part.lead), "kind": type(finding).__name__,
         "sentence": sentence(finding), "rows": [_row(row) for row in finding_records(finding)]}
        for part in (*leading, *others)
        for k, finding in enumerate(part.findings)
    ]  # fmt: skip
    alerts = [
        {"question": part.key, "code": alert.code.name, "words": str(alert), **dict(alert.numbers)}
        for part in (*leading, *others)
        for alert in part.told
    ]
    return {"title": title, "findings": rows, "alerts": alerts}


def _row(record: Record) -> dict[str, Any]:
    return record._asdict() | {"form": record.form.value}


def _in_order(study: Study, answered: list[Part]) -> tuple[list[Part], list[Part]]:
    """The answers that lead the page, in their order, and the others in the order of the page."""
    known = {one.key for one in answered}
    primary = [key for key in study.settings.question if key in known] or _primary(study, answered)
    leading = [one for key in primary for one in answered if one.key == key] or answered[:1]
    return leading, [one for one in answered if one not in leading]


def _alerts(study: Study, leading: Sequence[Part], others: Sequence[Part]) -> list[str | Markup]:
    """The most important alerts: all of the answers that lead, and of the others those that are about the data."""
    of_units = [Alert.of(Code.ONE_SYSTEM)] if study.unit == START else []
    warned: list[tuple[int, str | Markup]] = [(alert.code.rank, str(alert)) for alert in of_units]
    warned += [alert for part in leading for alert in part.alerts if alert[0] != STOP]
    warned += [alert for part in others for alert in part.alerts if STOP < alert[0] <= part.upto]
    return [text for _, text in sorted(dict.fromkeys(warned), key=lambda alert: alert[0])][:MOST_ALERTS]


def _items(text: str) -> list[str]:
    return re.findall(r"<li.*?</li>", text, re.DOTALL)


def _rank(alert: str) -> int:
    """Rank of an alert, as its template gives it; a tick has none and comes last."""
    given = re.match(r'<li data-rank="(\d)"', alert)
    return int(given[1]) if given else _TICK


def plain(text: str | Markup) -> str:
    """A text for a terminal: without tags, if it is markup."""
    if not isinstance(text, Markup):
        return text
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", text.replace("<sub>", "_")))).strip()


def _primary(study: Study, answered: Sequence[Part]) -> tuple[str, ...]:
    """Questions that lead where the scene names none: that of the lowest rank that may, and those beside it."""
    ours = {one.key: question(one.key) for one in answered if not is_own(one.key)}
    ranked = [(one.rank, key) for key, one in ours.items() if one.rank is not None and one.leads(study)]
    if not ranked:
        return ()
    first = min(ranked)[1]
    return (first, *ours[first].beside)


def group_columns() -> list[tuple[str, str, str | None]]:
    """Columns of the table of groups: heading, key, and how values are shown; the page leaves out empty ones."""
    titles = {term.name: term.title for term in TERMS}
    of_system = [name for name in SYSTEM_KEYS if name in titles]
    return [
        *((name, name, None) for name in ("group", "coupling")),
        *((titles[name], name, "g") for name in of_system),
        ("back slip", "back_slip", None),
        ("drawn", "drawn", None),
        *((name, name, "g") for name in ("t_end", *TOLERANCES)),
        *((name, name, None) for name in ("file", "parameters")),
        *((name, name, "n") for name in ("members", "matrices", "starts")),
    ]


def groups_table(study: Study) -> pd.DataFrame:
    """Table of the groups: system, settings of the engine, and numbers of members and matrices."""
    texts = {column for column, dtype in _GROUPS.items() if dtype == S}
    rows = []
    for group in study.groups:
        key = {name: str(v) if name in texts and v is not None else v for name, v in group.key.items()}
        rows.append(
            key
            | {
                "group": group.label,
                "members": len(group),
                "matrices": group.column("matrix").nunique(),
                "starts": group.column("unit").nunique() if group.unit == START else None,
                "finished": int(group.is_finished.sum()),
                "quiet": group.n_quiet,
            }
        )
    return frame(_GROUPS, rows)
