"""The questions that a report can answer: one file each, with a template of the same name in `report/templates`."""

from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING

from stickslip.sim.numerics.arguments import did_you_mean

if TYPE_CHECKING:
    from stickslip.analysis.answer import Question

#: In the order of the page.
QUESTIONS = (
    "sweep", "attractors", "episodes", "cascades", "counting", "exponential", "definitions", "rhythm", "clustering",
    "fates", "engines", "sensitivity", "robustness", "one_run",
)  # fmt: skip


def question(name: str) -> "Question":
    """The question of a name in `QUESTIONS`; its module is loaded only now."""
    found: Question = import_module(f"{__name__}.{name}").QUESTION
    return found


def refuse_unknown(names: Iterable[str]) -> None:
    """Raise a ValueError if a name is not one of `QUESTIONS`."""
    for name in names:
        if name not in QUESTIONS:
            remedy = did_you_mean(name, QUESTIONS) or "; choose one of these"
            raise ValueError(f"question: expected one of {', '.join(QUESTIONS)}, got {name!r}{remedy}")
