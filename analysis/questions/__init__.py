"""The questions that a report can answer: one file each, and one template of the same name in `report/templates`."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stickslip.analysis.answer import Question

#: In the order of the page.
QUESTIONS = (
    "sweep", "episodes", "cascades", "counting", "exponential", "definitions", "rhythm", "clustering", "fates",
    "engines", "sensitivity", "robustness",
)  # fmt: skip


def question(name: str) -> "Question":
    """One of `QUESTIONS`, whose module is loaded when it is asked for."""
    found: Question = import_module(f"{__name__}.{name}")
    return found
