"""The questions that a report can answer: one file each."""

import inspect
import pkgutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

from stickslip.sim.numerics.arguments import did_you_mean

if TYPE_CHECKING:
    from stickslip.analysis.answer import Answer, Question
    from stickslip.analysis.ensemble import Study

#: In the order of the page, with the room of each.
QUESTIONS: Mapping[str, str] = {
    "changes": "runs",
    "episodes": "slips",
    "cascades": "slips",
    "collective": "slips",
    "fates": "runs",
    "sensitivity": "runs",
    "one_run": "runs",
}


#: Names that scenes of earlier versions give, and what they ask for now.
RENAMED: Mapping[str, str] = {
    "sweep": "changes",
    "engines": "changes",
    "robustness": "changes",
    "exponential": "cascades",
    "definitions": "cascades",
    "counting": "stickslip.workflows.scenes.counting:question",
    "clustering": "collective",
    "rhythm": "collective",
    "attractors": "fates",
}

#: Modules of this package, beside the scenes that ship, with questions that only scenes which name them ask:
#: ``stickslip.workflows.scenes.module:function``. They are as a user's own are, but are always run.
BESIDE_SCENES = "stickslip.workflows.scenes."


def question(name: str) -> "Question":
    """The question of a name in `QUESTIONS`, or of one beside a scene that ships; its module is loaded only now."""
    if ":" in name:
        return of_function(pkgutil.resolve_name(name))
    ours: Question = import_module(f"{__name__}.{QUESTIONS[name]}.{name}").QUESTION
    return ours


def of_function(function: Callable[["Study"], "Answer | None"]) -> "Question":
    """A question that is a function: its title is the first paragraph of the docstring, its method the rest."""
    from stickslip.analysis.answer import Question

    lines = inspect.cleandoc(function.__doc__ or "").splitlines()
    end = lines.index("") if "" in lines else len(lines)
    title, method = (textwrap.shorten(" ".join(paragraphs), sys.maxsize) for paragraphs in (lines[:end], lines[end:]))
    return Question(function, title=title or function.__name__, method=method)


def package_questions(named: Iterable[str]) -> tuple[str, ...]:
    """`QUESTIONS`, and those named that lie beside scenes that ship."""
    return (*QUESTIONS, *dict.fromkeys(name for name in named if name.startswith(BESIDE_SCENES)))


def renamed(named: Iterable[str]) -> tuple[str, ...]:
    """Names as they are now, each once."""
    return tuple(dict.fromkeys(RENAMED.get(name, name) for name in named))


def is_own(name: str) -> bool:
    """Whether a name is that of a question of the user's own, `module:function`."""
    return ":" in name and not name.startswith(BESIDE_SCENES)


def refuse_unknown(names: Iterable[str]) -> None:
    """Raise a ValueError if a name is neither that of a question of this package nor of the form of a user's own."""
    for name in renamed(names):
        if name not in QUESTIONS and not is_own(name) and not _is_beside_scenes(name):
            remedy = did_you_mean(name, [*QUESTIONS]) or "; choose one of these"
            raise ValueError(
                f"question: expected one of {', '.join(QUESTIONS)}, or module:function, got {name!r}{remedy}"
            )


def _is_beside_scenes(name: str) -> bool:
    try:
        return callable(pkgutil.resolve_name(name))
    except (ImportError, AttributeError, ValueError):
        return False
