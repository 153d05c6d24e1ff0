"""The questions that a report can answer: one file each, with a template of the same name in `report/templates`."""

from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

from stickslip.sim.numerics.arguments import did_you_mean

if TYPE_CHECKING:
    from stickslip.analysis.answer import Question

#: In the order of the page, with the room of each.
QUESTIONS: Mapping[str, str] = {
    "sweep": "runs", "attractors": "runs", "episodes": "slips", "cascades": "slips", "counting": "slips",
    "rhythm": "slips", "clustering": "slips", "fates": "runs",
    "engines": "runs", "sensitivity": "runs", "robustness": "runs", "one_run": "runs",
}  # fmt: skip


def question(name: str) -> "Question":
    """The question of a name in `QUESTIONS`; its module is loaded only now."""
    found: Question = import_module(f"{__name__}.{QUESTIONS[name]}.{name}").QUESTION
    return found


def is_own(name: str) -> bool:
    """Whether a name is that of a question of the user's own, `module:function`."""
    return ":" in name


def refuse_unknown(names: Iterable[str]) -> None:
    """Raise a ValueError if a name is neither one of `QUESTIONS` nor of the form of a user's own."""
    for name in names:
        if name not in QUESTIONS and not is_own(name):
            remedy = did_you_mean(name, [*QUESTIONS]) or "; choose one of these"
            raise ValueError(
                f"question: expected one of {', '.join(QUESTIONS)}, or module:function, got {name!r}{remedy}"
            )
