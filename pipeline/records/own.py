"""What functions of a user's own measure of a run: beside the scene, read when it is, and called by workers."""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, cast

import numpy as np

from stickslip.pipeline.design.column import Column, Kind, Until
from stickslip.pipeline.errors import SceneError, foreign
from stickslip.pipeline.own.declared import SAMPLES, declared
from stickslip.pipeline.own.function import PATTERN, LateError, OwnFunction, resolve, use
from stickslip.pipeline.own.trial import Trial, tried_once
from stickslip.pipeline.records.record import Facts, Made, Member, Memory, NotKeptError, WindowRecord, sampling, steps
from stickslip.sim.numerics.arguments import Floats, apart
from stickslip.sim.numerics.sparse import is_sparse
from stickslip.sim.runs.run import Samples

if TYPE_CHECKING:
    from pathlib import Path

_T = TypeVar("_T")

#: What errors begin with.
KEY = "record.own"

FEW_WORDS = 9  # of a field that stand in a sentence in place of its name
#: The types of fields, and the columns that they make.
_KINDS: dict[str, Kind] = {"float": "number", "int": "count", "bool": "yes or no", "str": "text"}


class Own(NamedTuple):
    """A function, and what it measures."""

    function: OwnFunction
    columns: tuple[Column, ...]
    optional: tuple[str, ...]  #: those of the columns that it may leave without a value, by returning None
    is_sampled: bool  #: whether it asks for states

    def __repr__(self) -> str:
        return self.function.name


class Measured(NamedTuple):
    """What a function gave of a run: values by column, and why others have none although they should.

    `is_wrong`: it raised, or returned what it does not declare; else a number is not finite.
    """

    values: dict[str, Any]
    problems: dict[str, str]
    is_wrong: bool = False

    @classmethod
    def none(cls, measure: Own, problem: str, is_wrong: bool = True) -> Measured:
        """No value at all, for one reason."""
        return cls({}, dict.fromkeys((column.name for column in measure.columns), problem), is_wrong)

    @property
    def problem(self) -> str:
        """All of them, each once."""
        return ", ".join(dict.fromkeys(self.problems.values()))


@dataclass(frozen=True)
class OwnRecord(WindowRecord):
    """The columns of functions of the user's own."""

    functions: tuple[Own, ...]
    dt: float | None

    name = "own"
    words = "functions of your own that measure a run, as module:function, the module beside the scene"
    example = ("mine:quiet_share",)
    asked_by = "`own` under [record], and a column for each field that its functions return"
    columns = (
        Column("text", "own_problem", "why a function of `own` gave no value, or not all; null if it gave all"),
        Column("text", "own_lost", "the columns that have no value for that, with commas between", is_later=True),
    )
    is_named = True
    takes_load = True
    needs = frozenset({"events", "end", "system"})  # all that it may read

    @classmethod
    def asked(cls, keys: Mapping[str, Any], settings: Mapping[str, Any]) -> Self | None:
        if not keys[cls.name]:
            return None
        tables, folder = keys["functions"], str(keys["folder"].resolve())
        functions = tuple(_own(name, folder, tables[name]) for name in keys[cls.name])
        return cls(
            keys["t_burn"], functions, keys["dt"] if any(measure.is_sampled for measure in functions) else None
        )

    @property
    def kept(self) -> tuple[Column, ...]:
        return (*(column for measure in self.functions for column in measure.columns), *self.columns)

    @property
    def is_sampled(self) -> bool:
        """Whether some function asks for states."""
        return any(measure.is_sampled for measure in self.functions)

    def times(self, member: Member) -> Floats:
        if not self.is_sampled:
            return super().times(member)
        assert self.dt is not None  # see `RecordTable`
        return steps(self.t_burn, member.t_end, self.dt)

    def memory(self, facts: Facts) -> Memory | None:
        return sampling(facts, self.t_burn, self.dt) if self.is_sampled and self.dt is not None else None

    def of(self, result: Made) -> dict[str, Any]:
        measurements = [self.measured(measure, result) for measure in self.functions]
        values = {name: value for measured in measurements for name, value in measured.values.items()}
        problems = [
            f"{measure.function.name}: {measured.problem}"
            for measure, measured in zip(self.functions, measurements, strict=True)
            if measured.problems
        ]
        if not problems:
            return values
        # words of an exception may hold what Parquet's text cannot
        why = "; ".join(problems).encode(errors="replace").decode()
        return values | {
            "own_problem": why,
            "own_lost": ",".join(name for measured in measurements for name in measured.problems),
        }

    def measured(self, measure: Own, result: Made) -> Measured:
        """What one of its functions measures of a run.

        Raises `SceneError` if its module is gone, or has changed.
        """
        run, window = result.run, (self.t_burn, result.run.t_end)
        if window[1] <= window[0]:
            return Measured.none(measure, f"the run ends before t_burn = {window[0]:g}", False)
        # whatever else is recorded, it is given the same; nor does it change what others are given
        samples = (
            result.samples(self.times(result.member))
            if measure.is_sampled
            else Samples.blank(np.empty(0), run.events.n)
        )
        run = read_only(replace(run, events=replace(run.events), samples=samples))
        system, options = read_only(result.system), {SAMPLES: run.samples} if measure.is_sampled else {}
        try:
            return _checked(
                measure, use(measure.function, lambda target: target(run, system, window, **options)), window
            )
        except LateError as error:
            return Measured.none(measure, str(error))
        except (SceneError, NotKeptError):
            raise
        except Exception as error:  # of code that is not ours: the run has its other columns
            if not result.is_whole:  # it may have read what is not there
                raise NotKeptError from error
            # where an object lies in memory is another place each time
            return Measured.none(measure, re.sub(r"\b0x[0-9a-fA-F]{6,}", "0x...", foreign(error)))


def read_only(value: _T) -> _T:
    """A run, a system or what else it is, with the same arrays, which cannot be written to: those of sparse ones too.

    Objects are copied, not their arrays; the value itself stays as it is.
    """
    if isinstance(value, np.ndarray):
        view: Any = value.view()
        view.flags.writeable = False
    elif isinstance(value, tuple | list) and type(value) in (tuple, list):
        view = type(value)(map(read_only, value))
    elif isinstance(value, Mapping):
        view = {key: read_only(entry) for key, entry in value.items()}
    elif is_dataclass(value) or is_sparse(value):
        view = copy(value)
        for name in vars(value):
            object.__setattr__(view, name, read_only(getattr(value, name)))
    else:
        view = value
    return cast("_T", view)


# ---------------------------------------------------------------------------------------------- what it returned


def _checked(measure: Own, returned: object, window: tuple[float, float]) -> Measured:
    """The values that a function returned of a run, as its columns hold them."""
    names = tuple(column.name for column in measure.columns)
    fields = getattr(returned, "_fields", names)
    if not isinstance(returned, tuple) or len(returned) != len(names) or fields != names:
        got = type(returned).__name__ + (f" of {len(returned)}" if isinstance(returned, tuple) else "")
        return Measured.none(measure, f"expected ({', '.join(names)}), got {got}")
    values: dict[str, Any] = {}
    problems: dict[str, str] = {}
    t_burn, t_end = window
    is_wrong = False
    for column, value in zip(measure.columns, returned, strict=True):
        if value is None and column.name in measure.optional:
            continue
        plain = _plain(column.kind, value)
        if isinstance(plain, float) and not math.isfinite(plain):
            problems[column.name] = f"expected a finite number for {column.name}, got {plain}"
        elif column.least is not None and plain is not None and plain < column.least:
            bound, got = apart(column.least, plain)
            problems[column.name] = f"expected at least {bound} for {column.name}, got {got}"
        elif column.most is not None and plain is not None and plain > column.most:
            bound, got = apart(column.most, plain)
            problems[column.name] = f"expected at most {bound} for {column.name}, got {got}"
        elif plain is not None and column.until is not None and plain > t_end - column.until.start(t_burn):
            start = column.until.start(t_burn)
            bound, got = apart(t_end - start, plain)
            problems[column.name] = (
                f"expected at most {bound} for {column.name}, a time since t = {start:g}, got {got}; subtract "
                f"{start:g}"
            )
        elif plain is None:
            is_wrong = True
            problems[column.name] = f"expected {_EXPECTED[column.kind]} for {column.name}, got {type(value).__name__}"
        else:
            values[column.name] = plain
    return Measured(values, problems, is_wrong)


_EXPECTED = {
    "number": "a number",
    "count": "a whole number below 2^63",
    "yes or no": "True or False",
    "text": "a text",
}


def _plain(kind: Kind, value: object) -> Any:
    """A value as a column of a kind holds it; None if it cannot."""
    is_bool = isinstance(value, bool | np.bool_)
    if kind == "yes or no":
        return bool(value) if is_bool else None
    if kind == "text":
        return str(value).encode(errors="replace").decode() if isinstance(value, str) else None
    if is_bool:
        return None
    if kind == "count":
        return int(value) if isinstance(value, numbers.Integral) and -(2**63) <= int(value) < 2**63 else None
    return _float(value) if isinstance(value, numbers.Real) else None


def _float(number: numbers.Real) -> float:
    try:
        return float(number)
    except OverflowError:  # of a whole number
        return math.inf


# ---------------------------------------------------------------------------------------------- what it declares


def _own(name: str, folder: str, facts: Mapping[str, Any]) -> Own:
    """A function from what a scene keeps of it."""
    columns = tuple(
        Column(
            _KINDS[column["type"]],
            key,
            column["words"],
            title=column["words"] if len(column["words"].split()) <= FEW_WORDS else "",
            until=None if column["since"] is None else Until(column["since"]),
            **{name: column[name] for name in ("least", "most", "absent", "dimension")},
        )
        for key, column in facts["columns"].items()
    )
    optional = tuple(key for key, column in facts["columns"].items() if column["is_optional"])
    function = OwnFunction(KEY, name, facts["sha256"], folder, tuple(sorted(facts["beside"].items())))
    return Own(function, columns, optional, facts["is_sampled"])


def named_functions(value: object) -> list[str]:
    """The functions that a scene names by the value of its key, before it is checked; none if one is no name."""
    names = value if isinstance(value, list | tuple) else [value]
    are_names = all(isinstance(name, str) and re.match(PATTERN, name) for name in names)
    return [*dict.fromkeys(names)] if are_names else []


def look_at_functions(names: Iterable[str], folder: Path) -> dict[str, dict[str, Any]]:
    """What a scene keeps of functions beside it, by name, as plain values. Their modules are loaded in children.

    Raises `SceneError` if there is none of that name, it cannot be loaded, or does not declare what it returns.
    """
    functions = [resolve(name, folder, KEY) for name in names]
    facts_of: dict[str, dict[str, Any]] = {}
    for module in dict.fromkeys(function.module for function in functions):
        of_module = [function for function in functions if function.module == module]
        attempt = partial(_declared, of_module)
        facts = tried_once(Trial(KEY, of_module[0].at, attempt, module, "a module that can be loaded"))
        facts_of |= {
            function.name: {"sha256": function.sha256, **facts[function.name], "beside": facts["beside"]}
            for function in of_module
        }
    return {function.name: facts_of[function.name] for function in functions}


def _declared(functions: list[OwnFunction]) -> tuple[bytes, dict[str, Any]]:
    """In a child: what functions of a module declare, by their names."""
    return b"", {function.name: use(function, partial(declared, function), is_trial=True) for function in functions}
