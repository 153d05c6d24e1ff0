"""The report: one self-contained HTML page, its tables as Parquet and JSON, its figures as SVG and PDF."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from stickslip.analysis.answer import LONG, F, I, Long, S, Table, frame
from stickslip.analysis.ensemble import Data, Study
from stickslip.analysis.findings.alerts import STOP, Alert, Code
from stickslip.analysis.findings.words import plural
from stickslip.analysis.members import ENGINE_KEYS, OPTIONAL, START
from stickslip.analysis.page import AS_TEXT, FINDINGS, FORMULA, PAGE
from stickslip.analysis.page.data import data_table
from stickslip.analysis.page.layout import Page, Section
from stickslip.analysis.page.layout import Table as PageTable
from stickslip.analysis.page.parts import Answered, Drawn, Part, ask, findings_json, part
from stickslip.analysis.questions import is_own, package_questions, question, refuse_unknown
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.tables import records
from stickslip.pipeline.design.design import Unit
from stickslip.pipeline.design.values import text
from stickslip.sim.engines import SETTINGS
from stickslip.sim.engines.contract import Number

OF_DATA = 2  # the largest rank of alerts that are shown although their question does not lead
UNITS: Mapping[str, str] = {Unit.MATRIX: "systems", Unit.START: "starts of one system", Unit.FILE: "files"}
MOST_SAID = 3  # answers on the first screen
_ROWS = 10_000  # of a table that is in the JSON of all; a longer one is read from a file of its own
MOST_ALERTS = 3  # in order of rank
COUNTS = ("matrices", "starts", "members", "finished", "quiet")  # of a group
#: What columns of the table of groups are called on a page.
CALLED = {"group": "setting", "matrices": "systems", "members": "runs", "quiet": "sliding, not certified"}
_GROUPS: Mapping[str, str] = {
    "group": S, **dict.fromkeys(("n", *COUNTS), I), "coupling": S,
    "file": S, "parameters": S,
    **dict.fromkeys(("belt_speed", "kappa", "rho", "t_end", "perturbation_size"), F),
    **dict.fromkeys((key for key in OPTIONAL if key not in ("file", "parameters")), F), "back_slip": S, "drawn": S,
    **{name: F if isinstance(SETTINGS.get(name), Number) else S for name in ENGINE_KEYS},
}  # fmt: skip


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
    for rows_of in table if isinstance(table, Long) else [table]:
        rows = pa.Table.from_pandas(rows_of, preserve_index=False)
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
    own = {answer.key: answer for answer in made if answer is not None and is_own(answer.key)}
    problems = {key: answer.problem for key, answer in own.items() if answer.problem}
    missing = {key: "; ".join(answer.missing) for key, answer in own.items() if answer.missing}
    not_run = [key for key in settings.question if is_own(key) and key not in own]
    found = [answer for answer in made if answer is not None and answer.key not in problems]
    groups = groups_table(study)
    parts = [part(answer) for answer in found]
    leading, others = _in_order(study, [part for part in parts if not part.is_lack])
    if leading and leading[0].key in own:  # the page is the user's
        title, about = leading[0].title, _joined(title, about)
    lead = _lead(leading)
    stops = [str(alert) for part in (*leading, *others) for alert in part.alerts if alert.code.rank == STOP]
    on_first = [panel for part in leading[:2] for panel in part.panels[: 2 if len(leading) == 1 else 1]]
    raised = {each.key for each in parts}
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
        part.section(on_first, k < len(lead) and part in leading, k == 0 and part in leading)
        for k, part in enumerate((*leading, *others))
    ]
    sources = {file: digest for answer in own.values() for file, digest in answer.sources.items()}
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
        meta={"made-from": made_from} | ({"own-questions": "run"} if sources else {}),
        paragraph=leading[0].paragraph if leading else "",
    )
    tables = {"groups": groups} | {name: table for answer in found for name, table in answer.tables.items()}
    figures = {name: drawn for answer in found for name, drawn in answer.figures.items()}
    headline = [*stops, title, *lead]
    told = findings_json(title, lead, [*leading, *others, *lacking])
    return Report(page.html, tables, headline, figures, problems | missing, not_run, told)


def _lead(leading: Sequence[Part]) -> list[str]:
    """The answer: the first finding of each question and, as far as there is room, what else leads them."""
    said = leading[:MOST_SAID]
    chosen: list[list[str]] = [[each.lead[0]] for each in said]
    for k in range(1, MOST_SAID):
        for each, texts in zip(said, chosen, strict=True):
            if k < len(each.lead) and sum(map(len, chosen)) < MOST_SAID:
                texts.append(each.lead[k])
    return [text for texts in chosen for text in texts]


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
    rows, present = records(groups), groups.dropna(axis="columns", how="all")
    alike = {
        name: rows[0][name]
        for name in map(str, present)
        if name not in COUNTS and len({row[name] for row in rows}) == 1
    }
    if len(rows) > 1 and alike:
        notes.insert(
            0, f"All settings share {', '.join(f'{name} = {text(value)}' for name, value in alike.items())}."
        )
        present = present.drop(columns=[*alike])
    table = data_table("groups", present.rename(columns=CALLED))
    return Section(
        "made", "How was it made?", f"{plural(len(study.data.table), 'run')}.", texts, table=table, notes=notes
    )


def _joined(title: str, about: str) -> str:
    """A scene's title, before what it is about."""
    return f"{title}{' ' if title.endswith('?') else ': '}{about}" if title and about else title or about


def _in_order(study: Study, answered: list[Part]) -> tuple[list[Part], list[Part]]:
    """The answers that lead the page, in their order, and the others in the order of the page."""
    known = {part.key for part in answered}
    primary = [key for key in study.settings.question if key in known] or _primary(study, answered)
    leading = [part for key in primary for part in answered if part.key == key] or answered[:1]
    return leading, [part for part in answered if part not in leading]


def _alerts(study: Study, leading: Sequence[Part], others: Sequence[Part]) -> list[str]:
    """The most important alerts: all of the answers that lead, and of the others those that are about the data."""
    warned = [Alert.of(Code.ONE_SYSTEM)] if study.unit == START else []
    warned += [alert for part in leading for alert in part.alerts if alert.code.rank != STOP]
    warned += [alert for part in others for alert in part.alerts if STOP < alert.code.rank <= OF_DATA]
    once = dict[object, str]()
    for alert in sorted(warned, key=lambda alert: alert.code.rank):
        once.setdefault(alert.subject, str(alert))
    return [*once.values()][:MOST_ALERTS]


def _primary(study: Study, answered: Sequence[Part]) -> tuple[str, ...]:
    """Questions that lead where the scene names none: that of the lowest rank that may, and those beside it."""
    ours = {part.key: question(part.key) for part in answered if not is_own(part.key)}
    ranked = [(entry.rank, key) for key, entry in ours.items() if entry.rank is not None and entry.leads(study)]
    if not ranked:
        return ()
    first = min(ranked)[1]
    return (first, *ours[first].beside)


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
