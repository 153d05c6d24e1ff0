"""Questions of a user's own: what a function beside the scene returned, checked and put into words.

Only for a process in which the user's code may run: drawing calls it, and a template is code too.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import ChoiceLoader, FileSystemLoader
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from stickslip.analysis.answer import Answer
from stickslip.analysis.ensemble import Study
from stickslip.analysis.report.formats import Column, environment, minus
from stickslip.analysis.report.page import Answered, Drawn, Spoken, draw
from stickslip.analysis.tables import records

#: Words that are made of an answer: each is a macro, of the facts alone or of the facts and `figure`.
_OF_FACTS = ("answer", "alarm", "alerts", "panel_caption", "main")
_OF_FIGURES = ("panels", "panel", "part")
_TITLES = {"name", "question"}
_NAME = re.compile(r"\w+")
_LONGEST_NAME = 40  # of a figure or a table: it is part of a file's
_NO_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_WIDE = 1e4  # ratio of two numbers of a column that are not shown with the same decimals
_NARROW = 4  # columns that a narrow screen can show
_SHORT = 4  # digits of numbers that are shown as they are


class OwnError(ValueError):
    """What a function or a template of the user's gave cannot be shown: expected, got, what to do."""


def spoken(
    study: Study,
    key: str,
    found: object,
    doc: str,
    template: Path | None,
    told: Callable[[BaseException, str], str],
    with_pdf: bool = False,
) -> Spoken:
    """The answer that a question of the user's own returned, in words; what of it fails is left out.

    That is figures and tables, and the template, unless the sentence is its.

    Parameters
    ----------
    study : Study
        What it was asked of.
    key : str
        Its name, `module:function`.
    found : object
        What it returned.
    doc : str
        Its docstring: a heading, and how the answer is found. The name is the heading if there is none.
    template : Path, optional
        The file with its words; what that lacks, or all of it, is laid out from the answer.
    told : callable
        Puts an error, and what was expected in its place, into a line.
    with_pdf : bool
        Whether to draw figures as PDF too.

    Raises
    ------
    OwnError
        If it returned no answer, or one that cannot be shown.
    Exception
        Whatever the template raises, if there is no sentence without it.
    """
    if not isinstance(found, Answer):
        raise OwnError(
            f"expected a stickslip.analysis.Answer, got {_kind(found)}; "
            + ("return Answer(lack='why') if the data have none" if found is None else "return one")
        )
    _check(found)
    prefix, lack = key.replace(":", "-"), _line(found.lack)
    drawn, undrawn = _kept(
        found.figures, partial(_drawn, with_pdf=with_pdf), lambda error: told(error, "a matplotlib Figure")
    )
    tables, unreadable = _kept(found.tables, _plain, lambda error: told(error, "a pandas.DataFrame"))
    missing = [f"figures[{name!r}]: {why}" for name, why in undrawn.items()]
    missing += [f"tables[{name!r}]: {why}" for name, why in unreadable.items()]
    own = _Own(key, found.facts, lack, tables, drawn, undrawn=undrawn)
    heading, *method = map(_line, re.split(r"\n\s*\n", inspect.cleandoc(doc))) if doc.strip() else (key,)
    theirs, said = dict[str, Any](), dict[str, str]()
    if template is not None:
        try:
            theirs, said = _filled(study, own, template)
        except Exception as error:
            if not (lack or isinstance(found.facts.get("sentence"), str)):
                raise
            missing.append(f"{template.name}: {told(error, 'a template')}")
    if not (lack or said.get("answer")):
        said["answer"] = _sentence(found, template)
    ours = {name: macro for name, macro in _macros(study, None).items() if name not in theirs}
    if "panel" in theirs:
        del ours["panels"]
    laid = {
        "tables": [_shown(prefix, name, table) for name, table in tables.items()], "figures": list(drawn),
        "caption": _caption(found), "method": method,
        "files": [*(f"report/{prefix}-{name}.parquet" for name in tables),
                  *(f"report/figures/{prefix}-{name}.svg" for name in drawn)],
    }  # fmt: skip
    said = _said(own, laid, ours) | said
    titles = {"name": heading, "question": heading} | {name: _line(str(theirs[name])) for name in _TITLES & {*theirs}}
    files = _prefixed(prefix, tables), _prefixed(prefix, drawn)
    return Spoken(key, {}, lack, *files, said=titles | said, missing=tuple(missing))


def _kept(
    given: Mapping[str, Any], make: Callable[[Any], Any], told: Callable[[BaseException], str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """What can be made of each figure or table, and why nothing can be made of the others."""
    made, failed = {}, {}
    for name, one in given.items():
        try:
            made[name] = make(one)
        except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
            failed[name] = told(error)
    return made, failed


def _prefixed(prefix: str, by_name: Mapping[str, Any]) -> dict[str, Any]:
    """Names of files, which are no other question's: those of ours have no hyphen."""
    return {f"{prefix}-{name}": one for name, one in by_name.items()}


def _line(text: str) -> str:
    """A text in one line, without what a terminal obeys, or no file may hold."""
    return _clean(" ".join(text.split()))


def _clean(text: str) -> str:
    return "".join(c for c in text if c.isprintable() or c == "\n")


def _kind(found: object) -> str:
    return "None" if found is None else f"a {type(found).__name__}"


def _check(found: Answer) -> None:
    """The types of an answer, and the names of what it holds, which become names of files."""
    for name, expected in (("facts", Mapping), ("lack", str), ("tables", Mapping), ("figures", Mapping)):
        given = getattr(found, name)
        if not isinstance(given, expected):
            words = "text" if expected is str else "a dictionary"
            raise OwnError(f"{name}: expected {words}, got {_kind(given)}")
        odd = next((key for key in given if not isinstance(key, str) or not _NAME.fullmatch(key)), None)
        if expected is Mapping and odd is not None:
            raise OwnError(f"{name}: expected names of letters, digits and underscores, got {odd!r:.100}; rename it")
        if name != "facts" and (long := next((key for key in given if len(key) > _LONGEST_NAME), None)):
            raise OwnError(f"{name}: expected names of at most {_LONGEST_NAME} letters, got {long:.100}; shorten it")


def _drawn(made: object, with_pdf: bool) -> Drawn:
    """A figure, of a recipe or as it is."""

    def figure() -> Figure:
        got = made() if callable(made) else made
        if not isinstance(got, Figure):
            raise OwnError(
                f"expected a matplotlib Figure, or a function without arguments that returns one, got {_kind(got)}"
            )
        return got

    drawn = draw(figure, with_pdf)
    return replace(drawn, svg=_NO_XML.sub("", drawn.svg))


def _plain(table: object) -> pd.DataFrame:
    """A table with nullable types: a missing value is null, never NaN. A named index becomes columns."""
    if not isinstance(table, pd.DataFrame):
        raise OwnError(f"expected a pandas.DataFrame, got {_kind(table)}")
    whole = table.reset_index() if any(one is not None for one in table.index.names) else table
    whole = whole.rename(columns=lambda one: _line(one) if isinstance(one, str) else one)
    if not (whole.columns.is_unique and all(isinstance(one, str) and one for one in whole.columns)):
        raise OwnError(f"expected columns with different names, got {list(whole.columns)}")
    columns = {column: _column(str(column), whole[column]) for column in whole}
    return pd.DataFrame(columns, index=range(len(whole)))


def _column(name: str, given: pd.Series) -> Any:
    """A column as numbers, truths or texts."""
    values = given.astype(object).where(given.notna(), None).tolist()
    kinds = {type(one.item() if isinstance(one, np.generic) else one) for one in values if one is not None}
    dtype = next((dtype for of, dtype in _DTYPES if kinds <= of), None)
    if dtype is None:
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise OwnError(f"column {name!r}: expected numbers, true and false, or texts, got {names}")
    if dtype == "Float64" and (odd := next((one for one in values if one is not None and np.isinf(one)), None)):
        raise OwnError(f"column {name!r}: expected finite numbers, got {odd}; write None where there is none")
    if dtype == "string":
        values = [None if one is None else _clean(one) for one in values]
    return pd.array(values, dtype=dtype)


#: Nullable types by the types of the values that they hold; a column without any value counts as text.
_DTYPES: tuple[tuple[set[type], Any], ...] = (
    ({str}, "string"), ({bool}, "boolean"), ({int}, "Int64"), ({int, float}, "Float64"),
)  # fmt: skip


# ------------------------------------------------------------------------------------------------- words


def _macros(study: Study, template: Path | None) -> dict[str, Any]:
    """Names and macros of a template of the user's, or of ours, by which an answer is laid out."""
    filled = environment()
    filled.globals["unit"] = study.unit
    if template is not None:
        assert filled.loader is not None
        filled.loader = ChoiceLoader([FileSystemLoader(template.parent), filled.loader])
    return vars(filled.get_template("own.html" if template is None else template.name).module)


@dataclass(frozen=True)
class _Own(Answered):
    """An answer, of which some figures could not be drawn: a template may show them all the same."""

    undrawn: Container[str] = ()

    def figure(self, name: str, alt: str) -> Markup:
        if name not in self.undrawn:
            return super().figure(name, alt)
        return Markup('<p class="note">{}: not drawn</p>').format(name)


def _filled(study: Study, own: Answered, template: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Names and macros of a user's template, and the texts of its macros; errors name the line of the template."""
    try:
        macros = _macros(study, template)
        return macros, _said(own, own.facts, macros)
    except Exception as error:  # noqa: BLE001  whatever it is, it is raised again
        error.add_note(f"while filling {template.name}")
        environment().handle_exception()  # raises it, with lines of the template in place of those compiled


def _said(own: Answered, facts: Mapping[str, Any], macros: Mapping[str, Any]) -> dict[str, str]:
    """Texts of those macros that a page may show."""

    def of(names: Sequence[str], *given: Any) -> dict[str, str]:
        return {name: _clean(str(macros[name](*given))).strip() for name in names if name in macros}

    return of(("lack",), facts, own.lack) if own.lack else of(_OF_FACTS, facts) | of(_OF_FIGURES, facts, own.figure)


def _sentence(found: Answer, template: Path | None) -> str:
    sentence = found.facts.get("sentence")
    if not (isinstance(sentence, str) and sentence.strip()):
        got = f"facts of {', '.join(found.facts) or 'nothing'}" if sentence is None else _kind(sentence)
        where = "a template" if template is None else template.name
        raise OwnError(
            f"facts['sentence']: expected a text, the answer in one sentence, got {got}; add it, or say it in the"
            f" macro answer(a) of {where}"
        )
    return str(escape(minus(_line(sentence))))


def _caption(found: Answer) -> str:
    caption = found.facts.get("caption", "")
    if not isinstance(caption, str):
        raise OwnError(f"facts['caption']: expected a text, what the figures show, got {_kind(caption)}")
    return minus(_line(caption))


def _shown(prefix: str, name: str, table: pd.DataFrame) -> dict[str, Any]:
    """What `own.html` shows of a table: on a narrow screen as cards, if it is wide and its rows have names."""
    columns = _columns(table)
    kind = "stack" if len(columns) > _NARROW and columns[0][2] is None else ""
    return {"name": name, "rows": records(table), "columns": columns, "where": f"{prefix}-{name}", "kind": kind}


def _columns(table: pd.DataFrame) -> list[Column]:
    """Columns of a table on the page; `x_low` and `x_high` are the interval of `x`."""
    names = [str(name) for name in table]
    ends = {name: (f"{name}_low", f"{name}_high") for name in names}
    numeric = {str(name) for name in table if str(table[name].dtype) in ("Float64", "Int64")}
    ends = {name: both for name, both in ends.items() if {name, *both} <= numeric}
    hidden = {end for both in ends.values() for end in both}
    found: list[Column] = []
    for name in names:
        if name not in hidden:
            how = _how(table[[name, *ends.get(name, ())]])
            found.append((name.replace("_", " "), name, how))
            found += [("interval", ends[name], how)] if name in ends else []
    return found


def _how(some: pd.DataFrame) -> int | str | None:
    """How the numbers of a column, and of its interval, are shown."""
    kind = str(some.dtypes.iloc[0])
    if kind != "Float64":
        return {"string": None, "boolean": "yes", "Int64": "n" if some.shape[1] == 1 else "#"}[kind]
    sizes = np.abs([size for column in some for size in some[column].dropna() if size])
    if some.shape[1] == 1 and all(float(f"{size:.{_SHORT}g}") == size for size in sizes):
        return "g"  # a setting, say
    return "#" if len(sizes) and sizes.max() > _WIDE * sizes.min() else 3
