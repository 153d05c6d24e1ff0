"""Questions of a user's own: what a function beside the scene returned, checked, cleaned and drawn.

Only for a process in which the user's code may run: drawing calls it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from functools import partial
from numbers import Integral, Real
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from stickslip.analysis.answer import Answer, Picture
from stickslip.analysis.findings.alerts import Alert
from stickslip.analysis.findings.finding import Finding, Regime
from stickslip.analysis.findings.place import Place
from stickslip.analysis.page.build import MOST_SAID
from stickslip.analysis.page.parts import Answered, Drawn, draw
from stickslip.analysis.questions import of_function
from stickslip.analysis.stats.estimates import Estimate

T = TypeVar("T")
_LONGEST_NAME = 40  # of a figure or a table: it is part of a file's
#: Characters that no XML may hold, for `str.translate`.
_NO_XML = dict.fromkeys({*range(0x20), *range(0xD800, 0xE000), 0xFFFE, 0xFFFF} - {*b"\t\n\r"})
_EXAMPLE = 'return Answer(findings=[Level(Quantity("length", "mean length"), estimate)])'
_LACKING = 'Answer(findings=[Lack("the mean length", Reason.NOT_RECORDED)])'


class OwnError(ValueError):
    """What a function of the user's returned cannot be shown: expected, got, what to do."""


def own_answer(
    key: str,
    function: Callable[..., Any],
    returned: object,
    told: Callable[[BaseException, str], str],
    with_pdf: bool = False,
) -> Answered:
    """The answer of a question of the user's own, its figures drawn; figures and tables that fail are left out.

    Parameters
    ----------
    key : str
        Its name, `module:function`.
    function : callable
        Its docstring has the title and the method.
    returned : object
        What it returned.
    told : callable
        Puts an error, and what was expected in its place, into a line.
    with_pdf : bool
        Whether to draw figures as PDF too.

    Raises
    ------
    OwnError
        If it returned no answer, or one that cannot be shown.
    """
    answer = _checked(returned)
    prefix, missing = key.replace(":", "-").replace(".", "-"), list[str]()  # a prefix that no question of ours has

    def each(part: str, make: Callable[[Any], T], expected: str) -> dict[str, T]:
        """What can be made of each figure or table."""
        drawn_figures = {}
        for name, value in getattr(answer, part).items():
            try:
                drawn_figures[f"{prefix}-{name}"] = make(value)
            except BaseException as error:  # noqa: BLE001  whatever it is, it is told in a line
                missing.append(f"{part}[{name!r}]: {told(error, expected)}")
        return drawn_figures

    figures = each("figures", partial(_drawn, with_pdf=with_pdf), "a Picture(recipe, caption)")
    tables = each("tables", _plain, "a pandas.DataFrame")
    question = of_function(function)
    answer = replace(answer, method=answer.method or _line(question.method), tables=tables, figures={})
    return Answered(key, _line(question.title), answer, figures, missing=tuple(missing))


def _line(text: str) -> str:
    """A text in one line, without what a terminal obeys, or no file may hold."""
    return "".join(" " if c.isspace() else c for c in text if c.isspace() or c.isprintable())


def _kind(value: object) -> str:
    if value is None:
        return "None"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


# ------------------------------------------------------------------------------------------------ what it says


def _checked(returned: object) -> Answer:
    """An answer whose parts are of their types, and its texts clean."""
    if not isinstance(returned, Answer):
        hint = f"; if the data have none, return {_LACKING}" if returned is None else f"; {_EXAMPLE}"
        raise OwnError(f"expected a stickslip.analysis.Answer, got {_kind(returned)}{hint}")
    findings = _valid(returned.findings, Sequence[Finding], "findings")
    if not findings:
        raise OwnError(f"findings: expected the answer first, got none; {_EXAMPLE}, or {_LACKING}")
    if returned.n_lead not in range(1, MOST_SAID + 1):
        raise OwnError(f"n_lead: expected 1 to {MOST_SAID}, got {returned.n_lead!r:.100}; correct it")
    for name in ("tables", "figures"):
        _check_names(name, getattr(returned, name))
    return replace(
        returned,
        findings=findings,
        alerts=[_alert(alert, f"alerts[{k}]") for k, alert in enumerate(_listed(returned.alerts, "alerts"))],
        method=_valid(returned.method, str, "method"),
        paragraph=_valid(returned.paragraph, str, "paragraph"),
    )


def _listed(values: Any, name: str) -> Sequence[Any]:
    if not isinstance(values, list | tuple):
        raise OwnError(f"{name}: expected a list, got {_kind(values)}; write [...]")
    return values


def _check_names(name: str, given: object) -> None:
    """The names of what an answer holds, which become names of files."""
    if not isinstance(given, Mapping):
        raise OwnError(f"{name}: expected a dictionary, got {_kind(given)}")
    for key in given:
        if not isinstance(key, str) or not f"_{key}".isidentifier():
            raise OwnError(f"{name}: expected names of letters, digits and underscores, got {key!r:.100}; rename it")
        if len(key) > _LONGEST_NAME:
            raise OwnError(f"{name}: expected names of at most {_LONGEST_NAME} letters, got {key:.100}; shorten it")


def _alert(alert: object, name: str) -> Alert:
    if not isinstance(alert, Alert):
        raise OwnError(f"{name}: expected an Alert, got {_kind(alert)}; write Alert.of(Code.FEW, n=3, units='runs')")
    try:
        str(alert)
    except (LookupError, TypeError, ValueError) as error:
        raise OwnError(f"{name}: expected the numbers of {alert.code.words!r}, got {error}; add them") from None
    cleaned = ((key, _line(value) if isinstance(value, str) else value) for key, value in alert.numbers)
    return replace(alert, numbers=tuple(cleaned))


def _valid(value: Any, hint: Any, name: str) -> Any:
    """A value of a type, or of a dataclass of such, with clean texts and finite numbers."""
    if hint is Place and isinstance(value, str):
        return Place.words(_line(value))
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not NoneType]
    if get_origin(hint) in (tuple, Sequence):
        return tuple(_valid(item, kinds[0], f"{name}[{k}]") for k, item in enumerate(_listed(value, name)))
    if value is None and len(kinds) < len(get_args(hint)):
        return None
    kind = next((kind for kind in kinds if isinstance(value, _ACCEPTED.get(kind, kind))), None)
    if kind is None or (kind is not bool and isinstance(value, bool | np.bool_)):
        names = " or ".join(dict.fromkeys(_WORDS.get(kind, kind.__name__) for kind in kinds))
        raise OwnError(f"{name}: expected {names}, got {_kind(value)}")
    if kind is str:
        return _line(value)
    if kind in _ACCEPTED:
        if not math.isfinite(value):
            raise OwnError(f"{name}: expected a finite number, got {value}; leave it out")
        return kind(value)
    if issubclass(kind, Enum):
        return value
    hints = get_type_hints(kind)
    members = {field: _valid(getattr(value, field), hints[field], f"{name}.{field}") for field in hints}
    for field, item in members.items():
        if isinstance(item, Estimate) and item.value is item.high is None and kind is not Regime:
            raise OwnError(f"{name}.{field}: expected a value, got {getattr(value, field)}; return a Lack")
    return kind(**members)


#: Numbers, of Python or NumPy.
_ACCEPTED: Mapping[type, Any] = {bool: bool | np.bool_, int: Integral, float: Real}
_WORDS: Mapping[type, str] = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


# ------------------------------------------------------------------------------------------- figures and tables


def _drawn(picture: object, with_pdf: bool) -> Drawn:
    """A figure, of a recipe or as it is."""
    if not isinstance(picture, Picture) or not isinstance(picture.caption, str):
        raise OwnError(f"expected a Picture(recipe, caption), got {_kind(picture)}; the caption says what to see")
    recipe = picture.recipe

    def figure() -> Figure:
        got = recipe() if callable(recipe) else recipe
        if not isinstance(got, Figure):
            raise OwnError(
                f"expected a matplotlib Figure, or a function without arguments that returns one, got {_kind(got)}"
            )
        return got

    graph = draw(figure, with_pdf)
    return replace(graph, svg=graph.svg.translate(_NO_XML), caption=picture.caption)


def _plain(table: object) -> pd.DataFrame:
    """A table with nullable types: a missing value is null, never NaN. A named index becomes columns."""
    if not isinstance(table, pd.DataFrame):
        raise OwnError(f"expected a pandas.DataFrame, got {_kind(table)}")
    plain = table.reset_index() if any(name is not None for name in table.index.names) else table
    plain = plain.rename(columns=lambda name: _line(name) if isinstance(name, str) else name)
    if not (plain.columns.is_unique and all(isinstance(name, str) and name for name in plain.columns)):
        raise OwnError(f"expected columns with different names, got {list(plain.columns)}")
    columns = {column: _column(str(column), plain[column]) for column in plain}
    return pd.DataFrame(columns, index=range(len(plain)))


def _column(name: str, given: pd.Series) -> Any:
    """A column as numbers, truths or texts."""
    values = given.astype(object).where(given.notna(), None).tolist()
    present = [value.item() if isinstance(value, np.generic) else value for value in values if value is not None]
    kinds = {*map(type, present)}
    dtype = next((dtype for allowed, dtype in _DTYPES if kinds <= allowed), None)
    if dtype is None:
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise OwnError(f"column {name!r}: expected numbers, true and false, or texts, got {names}")
    if dtype == "Float64" and (odd := next((value for value in present if math.isinf(value)), None)):
        raise OwnError(f"column {name!r}: expected finite numbers, got {odd}; write None where there is none")
    if dtype == "string":
        values = [None if value is None else _line(value) for value in values]
    return pd.array(values, dtype=dtype)


#: Nullable types by the types of the values that they hold; a column without any value counts as text.
_DTYPES: tuple[tuple[set[type], Any], ...] = (
    ({str}, "string"),
    ({bool}, "boolean"),
    ({int}, "Int64"),
    ({int, float}, "Float64"),
)
