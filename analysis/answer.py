"""A question of a report, and its answer: findings, tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd
from matplotlib.figure import Figure

from stickslip.analysis import arguments
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert
from stickslip.analysis.findings.finding import Finding, Lack, Reason
from stickslip.analysis.findings.place import Place, told_apart
from stickslip.analysis.findings.words import plural
from stickslip.analysis.members import noun
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate

#: Draws a figure from plain data when called.
Recipe = Callable[[], Figure]
Table = pd.DataFrame


@dataclass(frozen=True)
class Picture:
    """A figure: its recipe, or itself, and a caption that says what to see, then what is drawn."""

    recipe: Recipe | Figure
    caption: str


@dataclass(frozen=True)
class Answer:
    """What a question found on an ensemble.

    Attributes
    ----------
    findings : sequence of Finding
        The first is the answer. A question that cannot be answered gives a `Lack` alone.
    n_lead : int
        How many of them belong on the first screen if the question leads the page: up to three.
    alerts : sequence of Alert
    method : str
        How the findings come about, in two sentences.
    paragraph : str
        Of a user's own question: what its findings do not say.
    tables : mapping of str to Table
        Kept whole as Parquet, with nullable types: a missing value is null, never NaN.
    figures : mapping of str to Picture
        By name; the first two stand on the first screen if the question leads.
    """

    findings: Sequence[Finding] = ()
    n_lead: int = 1
    alerts: Sequence[Alert] = ()
    method: str = ""
    paragraph: str = ""
    tables: Mapping[str, Table] = field(default_factory=dict)
    figures: Mapping[str, Picture] = field(default_factory=dict)

    @property
    def is_lack(self) -> bool:
        """Whether there is no answer."""
        return all(isinstance(finding, Lack) for finding in self.findings)


@dataclass(frozen=True)
class Question:
    """A question of a report: what answers it, and when it leads the page.

    Attributes
    ----------
    answer : callable
        Maps a `Study` to its answer; to None where such data do not raise the question.
    title : str
        The question as a reader would ask it: "How do cascade sizes fall off?".
    method : str
        That of its answers which give none.
    share : float
        Its share of the time of a report, as measured on the scenes that ship; the longest questions are begun first.
    of_cascades : bool
        Whether it is about cascades. Such questions are not asked where episodes are recorded, since episodes contain
        cascades, nor of one block, which has none.
    rank : int, optional
        Where the scene names no question, the answered question of the lowest rank leads the page, if `leads` allows
        it. A question without a rank leads only if it is named.
    leads : callable
        Maps a `Study` to whether the question may lead.
    beside : callable
        Maps a `Study` to the questions that follow it on the first screen when it leads by rank.
    """

    answer: Callable[[Study], Answer | None]
    title: str = ""
    method: str = ""
    share: float = 0.0
    of_cascades: bool = False
    rank: int | None = None
    leads: Callable[[Study], bool] = lambda _: True
    beside: Callable[[Study], tuple[str, ...]] = lambda _: ()

    def is_asked_of(self, study: Study) -> bool:
        """Whether data of this kind can have an answer."""
        return not self.of_cascades or (
            study.data.episodes is None and any(setting["n"] > 2 for setting in study.data.table.settings)
        )


def places(study: Study) -> dict[str, Place]:
    """What tells each setting from all others, by its label; n and the engine, where there are several engines."""
    n_always = 2 * (len({group.key["engine"] for group in study.groups}) > 1)
    return told_apart([group.label for group in study.groups], n_always)


_REASONS = {
    enough.FEW_MATRICES: Reason.FEW_UNITS,
    enough.FEW_CASCADES: Reason.FEW_CASCADES,
    enough.DRIFTS: Reason.DRIFT,
    enough.FEW_BLOCKS: Reason.FEW_BLOCKS,
}


def lack(study: Study, what: str) -> Lack:
    """Why no group allows a statistic of a steady state, where `Study.judged` gives none."""
    basis = max(
        (group.basis(study.settings.confidence) for group in study.groups), key=lambda basis: basis.n_cascades
    )
    reason = _REASONS[basis.code] if basis.n_matrices else Reason.NO_MOTION
    detail = f"{plural(basis.n_matrices, noun(study.unit))}, {plural(basis.n_cascades, 'cascade')}"
    if reason is Reason.DRIFT:
        detail = f"the number of sticking blocks still drifts after t = {study.settings.at(study.settings.t_burn)}"
    return Lack(what, reason, detail * bool(basis.n_matrices))


def named(name: str, estimate: Estimate) -> dict[str, float | None]:
    """Columns of an estimate: its value and the ends of its interval; raises a ValueError if it is none."""
    estimate = arguments.instance("estimate", estimate, Estimate)
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
