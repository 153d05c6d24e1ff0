"""Exits and n_stick beside time-shifted blocks: pairs of exits, counts in windows, variance and power."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stickslip.analysis.answer import F, Row, S
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Basis,
    Comparison,
    Difference,
    Family,
    Level,
    Quantity,
    Share,
    Verdict,
)
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.models.clustering import Kind, Part, measure, periods
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import Effect, over_null, together
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio

SLOW = 100.0  # longer periods belong to slow common motion
BELOW_SLOW = (50.0, SLOW)  # the adjacent band, where blocks hold each other back
PRIMARY = 40.0  # the window of the primary comparison, about a block's own cycle
WINDOWS = (0.5, 1.0, 5.0, 20.0, PRIMARY, 80.0)  # of the Fano factors
LEAST_WINDOWS = 20  # of one length in a run
CURVE = 20  # bands of the figure
DEFINITIONS = {Kind.FANO: "the variance of the number of slip onsets in a window, over its mean"}
SOON = 0.2  # in mean gaps between exits: an exit that another one triggers comes sooner
TABLE: Mapping[str, str] = {
    "group": S, "kind": S, "above": F, "upto": F, "observed": F, "by_rotation": F, "ratio": F, "low": F, "high": F,
    "p_value": F, "p_adjusted": F, "verdict": S, "reason": S,
}  # fmt: skip
SPECTRUM: Mapping[str, str] = {"group": S, "above": F, "upto": F, "ratio": F, "low": F, "high": F}


class Compared(NamedTuple):
    """A quantity of a group beside that of time-shifted blocks: means over units, and their ratio."""

    part: Part
    observed: Estimate
    independent: float
    effect: Effect
    difference: Difference

    @property
    def quantity(self) -> Quantity:
        """What is compared."""
        clause = ""
        match self.part.kind:
            case Kind.POWER:
                name = f"power of n_stick at periods from {self.part.above:g} to {self.part.upto:g}"
            case Kind.VARIANCE:
                name = "variance of n_stick"
            case Kind.FANO:
                name = f"Fano factor in windows of {self.part.upto:g}"
                clause = f"counts of slip onsets in windows of {self.part.upto:g} vary {{}}"
            case Kind.PAIRS:
                name = f"number of pairs of slip onsets within {self.part.upto:g}"
        return Quantity(self.part.kind, name, definition=DEFINITIONS.get(self.part.kind, ""), clause=clause)

    def level(self, where: Place, basis: Basis) -> Level:
        """The finding, where it has an interval."""
        return Level(self.quantity, self.observed, where, Comparison("time-shifted blocks", self.difference), basis)

    def row(self, group: str) -> Row:
        """Row of the table `clustering`."""
        part, effect = self.part, self.effect
        return {
            "group": group, "kind": part.kind, "above": part.above or None, "upto": part.upto or None,
            "observed": self.observed.value, "by_rotation": self.independent, "ratio": effect.ratio.value,
            **_ends(effect.ratio), "p_value": effect.p, "p_adjusted": effect.p_adjusted,
            "verdict": self.difference.verdict.value, "reason": effect.ratio.reason or None,
        }  # fmt: skip


@dataclass(frozen=True)
class Exits:
    """What was compared with time-shifted blocks in a group.

    Attributes
    ----------
    group : Group
    compared : list of Compared
        The primary one first; the others are judged together.
    bands : list of (Part, Estimate)
        Power in bands of periods, relative to that of time-shifted blocks.
    n_units : int
    n_exits, gap : float
        Mean number of exits of a unit, and mean time between exits.
    """

    group: Group
    compared: list[Compared]
    bands: list[tuple[Part, Estimate]]
    n_units: int
    n_exits: float
    gap: float

    def spectrum(self) -> list[Row]:
        """Rows of the table `spectrum`."""
        return [
            {"group": self.group.label, "above": band.above, "upto": band.upto, "ratio": power.value, **_ends(power)}
            for band, power in self.bands
        ]


def _ends(estimate: Estimate) -> Row:
    return {"low": estimate.low, "high": estimate.high}


def triggered(exits: Exits, where: Place, unit: str) -> tuple[list[Share], Compared | None]:
    """The share of exits that trigger another one within a time, or an upper limit, and the pairs that show it.

    An exit that another one triggers adds a pair to those of time-shifted blocks. If more pairs are shown, the share
    is that within the least time at which they are; a rate that all blocks share makes such pairs too, so that it is
    not said to be of triggers. Else it has a limit, within the least time that is long enough
    for triggering: the end of the interval, but no less than if there were as many pairs as of time-shifted blocks,
    since data with few pairs by luck would exclude too much (Cowan, Cranmer, Gross and Vitells 2011,
    arXiv:1105.3166). There is none if no time is long enough.
    """
    pairs = sorted((one for one in exits.compared if one.part.kind == Kind.PAIRS), key=lambda one: one.part.upto)
    known = [one for one in pairs if one.effect.ratio.low is not None]
    more = next((one for one in known if one.difference.verdict is Verdict.MORE), None)
    shown = more or next((one for one in known if one.part.upto >= SOON * exits.gap), None)
    if shown is None:
        return [], None
    per_exit = shown.independent / exits.n_exits
    basis = Basis(exits.n_units, unit)
    value, low, high = (shown.effect.ratio.value, shown.effect.ratio.low, shown.effect.ratio.high)
    assert value is not None
    assert low is not None
    assert high is not None
    if more is not None:
        share = Estimate((value - 1) * per_exit, (low - 1) * per_exit, (high - 1) * per_exit)
        predicate = f"follow another within {shown.part.upto:g} in excess of time-shifted blocks"
        return [Share("triggered", "slip onsets", predicate, share, where, basis=basis)], shown
    most = max(high, (high / low) ** 0.5) - 1
    predicate = f"trigger another within {shown.part.upto:g}"
    limit = Estimate(high=most * per_exit)
    return [Share("triggered", "slip onsets", predicate, limit, where, basis=basis)], shown


def exits_of(study: Study, group: Group) -> Exits | None:
    """Exits of a group beside time-shifted blocks; None if fewer than two units have them."""
    span, confidence = float(group.key["t_end"]) - study.settings.t_burn, study.settings.confidence
    parts = _parts(span, study.settings.tau)
    shortest, longest = periods(span)
    longest = min(longest, SLOW)
    edges = np.geomspace(max(shortest, min(1.0, longest / 2)), longest, CURVE + 1).tolist()
    bands = [Part(Kind.POWER, high, low) for low, high in pairwise([*edges[:-1], longest])]
    n_columns = 2 * len([*parts, *bands])
    sums = study.sums(group, partial(_of_run, (*parts, *bands)), n_columns + 1)
    runs = sums[:, :n_columns].reshape(len(sums), -1, 2)
    n_exits, n_runs = sums[:, n_columns:].sum(axis=0)
    runs = runs[runs[:, :, 1].any(axis=1)]
    if len(runs) < 2:
        return None
    compared = compare(runs[:, : len(parts)], parts, confidence)
    ratios = [_over_blocks(runs[:, k], confidence).ratio for k in range(len(parts), runs.shape[1])]
    powers = list(zip(bands, ratios, strict=True))
    return Exits(group, compared, powers, len(runs), n_exits / len(runs), n_runs * span / n_exits)


def compare(rows: np.ndarray, parts: Sequence[Part], confidence: float) -> list[Compared]:
    """Parts beside time-shifted blocks, from `measure` of units, shape (G, p, 2); the first is the primary one."""
    compared = []
    for k, effect in enumerate(together([_over_blocks(rows[:, k], confidence) for k in range(len(parts))], 1)):
        observed = over_matrices(ratio, np.column_stack([rows[:, k, 0], np.ones(len(rows))]), confidence)
        value, low, high = (
            None if end is None else end - 1 for end in (effect.ratio.value, effect.ratio.low, effect.ratio.high)
        )
        p = effect.p_adjusted
        family = None if p is None or k == 0 else Family(len(parts) - 1, p, alpha=1 - confidence)
        difference = Difference(Estimate(value, low, high), family=family)
        compared.append(Compared(parts[k], observed, float(rows[:, k, 1].mean()), effect, difference))
    return compared


def _parts(span: float, taus: Sequence[float]) -> list[Part]:
    """What is compared; first exits in windows of the length closest to `PRIMARY`."""
    shortest, longest = periods(span)
    beside = [Part(Kind.POWER, BELOW_SLOW[1], BELOW_SLOW[0])] if shortest <= BELOW_SLOW[0] and longest >= SLOW else []
    lengths = sorted((one for one in WINDOWS if one * LEAST_WINDOWS <= span), key=lambda one: abs(one - PRIMARY))
    counts = [Part(Kind.FANO, length) for length in lengths]
    return [*counts, *beside, Part(Kind.VARIANCE), *(Part(Kind.PAIRS, tau) for tau in taus if 2 * tau <= span)]


def _of_run(parts: Sequence[Part], run: Run) -> np.ndarray | None:
    """`measure` of a run and its number of exits; None without events, or with fewer than two exits."""
    if run.steps is None:
        return None
    try:
        return np.append(measure(run.steps, parts), np.sum(run.steps.step < 0))
    except Undefined:
        return None


def _over_blocks(rows: np.ndarray, confidence: float) -> Effect:
    return over_null(lambda sums: sums[:, 0], rows[:, :1], rows[:, 1:], confidence)
