"""Steps: a statistic of some runs beside that of others, and the table of all of them.

The two are the same systems at another value of a swept key, under another engine, with changed constants, or in
another dataset. What is compared with one reference is judged together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, TypeVar

import pandas as pd

from stickslip.analysis.by_key import by_key
from stickslip.analysis.contrast import Contrast, judged
from stickslip.analysis.findings.finding import Change, KeyChange, Lack, Level, Reason, Turn
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.groups import Group
from stickslip.analysis.rows import Columns, frame_by
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.values import text


class Kind(StrEnum):
    """In what the two differ."""

    KEY = "key"
    LAW = "law"
    TOLERANCE = "tolerance"
    THRESHOLD = "threshold"  #: of sticking
    COPY = "change"
    DATASET = "dataset"


class Variant(NamedTuple):
    """What is set beside a reference.

    Attributes
    ----------
    name : str
        A noun phrase; empty if the symbol is one.
    symbol : str
        What tells it from others of that name by its value; empty if there are none.
    value : float, optional
    suffix : str
        What follows the value, as a unit.
    """

    name: str
    symbol: str = ""
    value: float | None = None
    suffix: str = ""

    @property
    def text(self) -> str:
        """The value."""
        return "" if self.value is None else f"{text(self.value)}{self.suffix}"


_NO_NAME = Variant("")


@dataclass(frozen=True)
class Step:
    """A statistic of some runs beside that of others.

    Attributes
    ----------
    setting, reference : str
        Labels of both; along a key, of what all its values share, and empty.
    keys : tuple of KeyChange
        What both differ in, as far as the settings do not say it.
    where : Place
        What tells the second from others.
    name : Variant
        What is set beside the reference, in a list of outcomes.
    turns : tuple of Turn
        Along a key, where the statistic is shown to turn before.
    """

    kind: Kind
    setting: str
    reference: str
    contrast: Contrast
    keys: tuple[KeyChange, ...] = ()
    where: Place = EVERYWHERE
    name: Variant = _NO_NAME
    turns: tuple[Turn, ...] = ()

    @property
    def statistic(self) -> str:
        """The name of its statistic."""
        return self.contrast.statistic.name

    @property
    def key_names(self) -> tuple[str, ...]:
        """The keys along which it is."""
        return tuple(change.key for change in self.keys)

    def change(self, unit: str) -> Change:
        """As a change along its keys."""
        return replace(self.contrast.change(self.keys, self.where, unit), turns=self.turns)

    def level(self, other: str, unit: str) -> Level:
        """As the second, compared with the first, which is called `other`."""
        return self.contrast.level(self.where, other, unit, is_alone=self.kind is Kind.DATASET)


AnyStep = TypeVar("AnyStep", bound=Step)


def judged_together(steps: Sequence[AnyStep], alpha: float) -> list[AnyStep]:
    """Steps in their order, those of one kind with one reference judged together; all of two datasets."""

    def family(k: int) -> tuple[Kind, str]:
        return steps[k].kind, "" if steps[k].kind is Kind.DATASET else steps[k].reference

    families = by_key(range(len(steps)), family)
    contrasts = [step.contrast for step in steps]
    for places in families.values():
        for k, contrast in zip(places, judged([contrasts[k] for k in places], alpha), strict=True):
            contrasts[k] = contrast
    return [replace(step, contrast=contrast) for step, contrast in zip(steps, contrasts, strict=True)]


def few(what: str, groups: Iterable[Group]) -> Lack:
    """Why something, a noun phrase, cannot be told of the runs of some groups in motion."""
    return Lack(what, Reason.FEW_UNITS if any(group.n_moving for group in groups) else Reason.NO_MOTION)


_COLUMNS: Columns[Step] = {
    "kind": (str, lambda step: step.kind.value),
    "setting": (str, lambda step: step.setting),
    "reference": (str, lambda step: step.reference),
    "key": (str, lambda step: " with ".join(step.key_names)),
    "first_value": (str, lambda step: " with ".join(change.first for change in step.keys)),
    "second_value": (str, lambda step: " with ".join(change.second for change in step.keys)),
    "quantity": (str, lambda step: step.statistic),
    "n_first": (int, lambda step: step.contrast.n_first),
    "n_second": (int, lambda step: step.contrast.n_second),
    "first": (Estimate, lambda step: step.contrast.first),
    "second": (Estimate, lambda step: step.contrast.second),
    "difference": (Estimate, lambda step: step.contrast.absolute),
    "relative": (Estimate, lambda step: step.contrast.relative),
    "margin": (float, lambda step: step.contrast.difference.margin),
    "p_different": (float, lambda step: step.contrast.p_different),
    "p_different_holm": (float, lambda step: step.contrast.family and step.contrast.family.p_different),
    "verdict": (str, lambda step: step.contrast.verdict.value),
    "reason": (str, lambda step: step.contrast.reason),
}


def table_of(steps: Iterable[Step]) -> pd.DataFrame:
    """The table of changes: a row a step, with both values, their difference, its test and the verdict."""
    return frame_by(_COLUMNS, steps)
