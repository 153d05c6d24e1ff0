"""Exits and n_stick beside time-shifted blocks: pairs of exits, counts in windows, variance and power."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

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
from stickslip.analysis.questions.slips.slow_motion import Band
from stickslip.analysis.rows import Columns
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import Effect, over_null, together
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio

SLOW = 100.0  # longer periods belong to slow common motion
BELOW_SLOW = (50.0, SLOW)  # the adjacent band, where blocks hold each other back
PRIMARY = 40.0  # the window of the primary comparison, about a block's own cycle
WINDOWS = (0.5, 1.0, 5.0, 20.0, PRIMARY, 80.0)  # of the Fano factors
LEAST_WINDOWS = 20  # of one length in a run
CURVE = 20  # bands of the figure
SOON = 0.2  # in mean gaps between exits: an exit that another one triggers comes sooner


class Compared(NamedTuple):
    """A quantity of a group beside that of time-shifted blocks: means over units, and their ratio."""

    group: str
    part: Part
    observed: Estimate
    independent: float
    ratio: Estimate
    difference: Difference

    @property
    def quantity(self) -> Quantity:
        """What is compared."""
        kind, upto = self.part.kind, f"{self.part.upto:g}"
        match kind:
            case Kind.POWER:
                return Quantity(
                    kind, f"power of the number of sticking blocks at periods from {self.part.above:g} to {upto}"
                )
            case Kind.VARIANCE:
                return Quantity(kind, "variance of the number of sticking blocks")
            case Kind.FANO:
                return Quantity(
                    kind,
                    f"Fano factor in windows of {upto}",
                    definition="the variance of the number of slip onsets in a window, over its mean",
                    clause=f"counts of slip onsets in windows of {upto} vary {{}}",
                )
            case Kind.PAIRS:
                return Quantity(kind, f"number of pairs of slip onsets within {upto}")

    def level(self, where: Place, basis: Basis) -> Level:
        """The finding, where it has an interval."""
        return Level(self.quantity, self.observed, where, Comparison("time-shifted blocks", self.difference), basis)


#: The table `clustering`.
CLUSTERING: Columns[Compared] = {
    "group": (str, lambda compared: compared.group),
    "kind": (str, lambda compared: compared.part.kind.value),
    "above": (float, lambda compared: compared.part.above or None),
    "upto": (float, lambda compared: compared.part.upto or None),
    "observed": (float, lambda compared: compared.observed.value),
    "by_rotation": (float, lambda compared: compared.independent),
    "ratio": (Estimate, lambda compared: compared.ratio),
    "verdict": (str, lambda compared: compared.difference.verdict.value),
}


class Exits(NamedTuple):
    """What was compared with time-shifted blocks in a group.

    Attributes
    ----------
    group : Group
    compared : list of Compared
        The primary one first; the others are judged together.
    bands : list of Band
    n_units : int
    n_exits, gap : float
        Mean number of exits of a unit, and mean time between exits.
    """

    group: Group
    compared: list[Compared]
    bands: list[Band]
    n_units: int
    n_exits: float
    gap: float


def triggered(exits: Exits, where: Place, unit: str) -> tuple[list[Share], Compared | None]:
    """The share of exits that trigger another one within a time, or an upper limit, and the pairs that show it.

    An exit that another one triggers adds a pair to those of time-shifted blocks. If more pairs are shown, the share
    is that within the least time at which they are; a rate that all blocks share makes such pairs too, so that it is
    not said to be of triggers. Else it has a limit, within the least time that is long enough
    for triggering: the end of the interval, but no less than if there were as many pairs as of time-shifted blocks,
    since data with few pairs by luck would exclude too much (Cowan, Cranmer, Gross and Vitells 2011,
    arXiv:1105.3166). There is none if no time is long enough.
    """
    pairs = [each for each in exits.compared if each.part.kind is Kind.PAIRS and each.ratio.low is not None]
    pairs.sort(key=lambda each: each.part.upto)
    more = next((each for each in pairs if each.difference.verdict is Verdict.MORE), None)
    shown = more or next((each for each in pairs if each.part.upto >= SOON * exits.gap), None)
    if shown is None:
        return [], None
    per_exit = shown.independent / exits.n_exits
    basis = Basis(exits.n_units, unit)
    value, low, high = shown.ratio.value, shown.ratio.low, shown.ratio.high
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
    curve = [Part(Kind.POWER, upto, above) for above, upto in pairwise([*edges[:-1], longest])]
    n_columns = 2 * len([*parts, *curve])
    sums = study.sums(group, partial(_of_run, (*parts, *curve)), n_columns + 1)
    rows = sums[:, :n_columns].reshape(len(sums), -1, 2)
    n_exits, n_runs = sums[:, n_columns:].sum(axis=0)
    rows = rows[rows[:, :, 1].any(axis=1)]
    if len(rows) < 2:
        return None
    compared = compare(group.label, rows[:, : len(parts)], parts, confidence)
    bands = [
        Band(group.label, part.above, part.upto, _over_blocks(rows[:, k], confidence).ratio)
        for k, part in enumerate(curve, len(parts))
    ]
    return Exits(group, compared, bands, len(rows), n_exits / len(rows), n_runs * span / n_exits)


def compare(label: str, rows: np.ndarray, parts: Sequence[Part], confidence: float) -> list[Compared]:
    """Parts beside time-shifted blocks, from `measure` of units, shape (G, p, 2); the first is the primary one."""
    compared = []
    for k, effect in enumerate(together([_over_blocks(rows[:, k], confidence) for k in range(len(parts))], 1)):
        observed = over_matrices(ratio, np.column_stack([rows[:, k, 0], np.ones(len(rows))]), confidence)
        ends = (effect.ratio.value, effect.ratio.low, effect.ratio.high)
        value, low, high = (None if end is None else end - 1 for end in ends)
        p = effect.p_adjusted
        family = None if p is None or k == 0 else Family(len(parts) - 1, p, alpha=1 - confidence)
        difference = Difference(Estimate(value, low, high), family=family)
        compared.append(Compared(label, parts[k], observed, float(rows[:, k, 1].mean()), effect.ratio, difference))
    return compared


def _parts(span: float, taus: Sequence[float]) -> list[Part]:
    """What is compared; first exits in windows of the length closest to `PRIMARY`."""
    shortest, longest = periods(span)
    above, upto = BELOW_SLOW
    beside = [Part(Kind.POWER, upto, above)] if shortest <= above and longest >= SLOW else []
    lengths = sorted((length for length in WINDOWS if length * LEAST_WINDOWS <= span), key=_from_primary)
    counts = [Part(Kind.FANO, length) for length in lengths]
    return [*counts, *beside, Part(Kind.VARIANCE), *(Part(Kind.PAIRS, tau) for tau in taus if 2 * tau <= span)]


def _from_primary(length: float) -> float:
    return abs(length - PRIMARY)


def _of_run(parts: Sequence[Part], run: Run) -> np.ndarray | None:
    """`measure` of a run and its number of exits; None without events, or with fewer than two exits."""
    if run.steps is None:
        return None
    try:
        return np.append(measure(run.steps, parts), len(run.steps.exits[0]))
    except Undefined:
        return None


def _over_blocks(rows: np.ndarray, confidence: float) -> Effect:
    return over_null(lambda sums: sums[:, 0], rows[:, :1], rows[:, 1:], confidence)
