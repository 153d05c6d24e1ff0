"""Slip onsets that follow others: pairs close in time, beside those of time-shifted blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Basis, Comparison, Difference, Family, Level, Quantity, Share, Verdict
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.models.clustering import measure
from stickslip.analysis.rows import Columns
from stickslip.analysis.series.nulls import whole_periods
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import over_null
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio
from stickslip.analysis.stats.multiplicity import together
from stickslip.pipeline.design.units import DIMENSIONLESS, Units
from stickslip.pipeline.design.values import shown

SOON = 0.2  # in mean gaps between exits: an exit that another one triggers comes sooner


class Pairs(NamedTuple):
    """Pairs of exits closer than tau in a group: per exit, and over those of time-shifted blocks."""

    group: str
    tau: float
    observed: Estimate
    independent: float
    ratio: Estimate
    difference: Difference


#: The table `clustering`.
CLUSTERING: Columns[Pairs] = {
    "group": (str, lambda pairs: pairs.group),
    "tau": (float, lambda pairs: pairs.tau),
    "observed": (float, lambda pairs: pairs.observed.value),
    "by_rotation": (float, lambda pairs: pairs.independent),
    "ratio": (Estimate, lambda pairs: pairs.ratio),
    "verdict": (str, lambda pairs: pairs.difference.verdict.value),
}


class Exits(NamedTuple):
    """The exits of a group: pairs by tau, ascending, judged together; and the mean time between exits, the gap."""

    pairs: list[Pairs]
    n_units: int
    gap: float
    units: Units = DIMENSIONLESS  #: of tau and the gap

    def within(self, pairs: Pairs) -> str:
        """Within which time they are, in words."""
        return f"within {shown(float(f'{pairs.tau:.3g}'))} {self.units.time}".rstrip()

    def levels(self, where: Place, unit: str) -> Iterator[Level]:
        """The findings that have an interval."""
        for pairs in self.pairs:
            if pairs.observed.low is not None:
                quantity = Quantity("pairs", f"mean number of slip onsets {self.within(pairs)} after one")
                beside = Comparison("time-shifted blocks", pairs.difference)
                yield Level(quantity, pairs.observed, where, beside, Basis(self.n_units, unit))


def triggered(exits: Exits, where: Place, unit: str) -> list[Share]:
    """The share of exits that trigger another one within a time, or an upper limit.

    An exit that another one triggers adds a pair to those of time-shifted blocks. If more pairs are shown, the share
    is that within the least time at which they are; a rate that all blocks share makes such pairs too, so that it is
    not said to be of triggers. Else it has a limit, within the least time that is long enough
    for triggering: the end of the interval, but no less than if there were as many pairs as of time-shifted blocks,
    since data with few pairs by luck would exclude too much (Cowan, Cranmer, Gross and Vitells 2011,
    arXiv:1105.3166). There is none if no time is long enough.
    """
    judged = [pairs for pairs in exits.pairs if pairs.ratio.low is not None]
    larger = next((pairs for pairs in judged if pairs.difference.verdict is Verdict.MORE), None)
    chosen = larger or next((pairs for pairs in judged if pairs.tau >= SOON * exits.gap), None)
    if chosen is None:
        return []
    per_exit = chosen.independent
    value, low, high = chosen.ratio.value, chosen.ratio.low, chosen.ratio.high
    assert value is not None
    assert low is not None
    assert high is not None
    if larger is not None:
        share = Estimate((value - 1) * per_exit, (low - 1) * per_exit, (high - 1) * per_exit)
        predicate = f"follow another {exits.within(chosen)} in excess of time-shifted blocks"
    else:
        share = Estimate(high=(max(high, (high / low) ** 0.5) - 1) * per_exit)
        predicate = f"trigger another {exits.within(chosen)}"
    return [Share("triggered", "slip onsets", predicate, share, where, basis=Basis(exits.n_units, unit))]


def exits_of(study: Study, group: Group) -> Exits | None:
    """Exits of a group beside time-shifted blocks; None if fewer than two units have them."""
    t_end, confidence = float(group.key["t_end"]), study.settings.confidence
    span = t_end - whole_periods(study.settings.t_burn, t_end, group.shift_unit)[0]
    taus = sorted(tau for tau in study.settings.tau if 2 * tau <= span)
    if not taus:
        return None
    n_columns = 2 * len(taus)
    sums = study.sums(group, partial(_of_run, taus), n_columns + 1)
    n_exits, n_runs = sums[:, n_columns:].sum(axis=0)
    sums = sums[sums[:, -1] > 0]
    if len(sums) < 2:
        return None
    pairs = compare(group.label, sums[:, :n_columns].reshape(-1, len(taus), 2), sums[:, n_columns], taus, confidence)
    return Exits(pairs, len(sums), n_runs * span / n_exits, study.settings.units)


def compare(label: str, rows: np.ndarray, exits: np.ndarray, taus: Sequence[float], confidence: float) -> list[Pairs]:
    """Pairs beside those of time-shifted blocks, from `measure` of units, shape (G, K, 2), and their exits, (G,)."""
    by_tau = (rows[:, k] for k in range(len(taus)))
    effects = [over_null(lambda sums: sums[:, 0], columns[:, :1], columns[:, 1:], confidence) for columns in by_tau]
    pairs = []
    for k, (effect, p_adjusted) in enumerate(zip(effects, together(effect.p for effect in effects), strict=True)):
        observed = over_matrices(ratio, np.column_stack([rows[:, k, 0], exits]), confidence)
        family = None if p_adjusted is None else Family(len(taus), p_adjusted, alpha=1 - confidence)
        difference = Difference(effect.ratio.under(lambda ratio: ratio - 1), family=family)
        independent = float(rows[:, k, 1].sum() / exits.sum())
        pairs.append(Pairs(label, taus[k], observed, independent, effect.ratio, difference))
    return pairs


def _of_run(taus: Sequence[float], run: Run) -> np.ndarray | None:
    """`measure` of a run and its number of exits; None without events, or with fewer than two exits."""
    if run.shiftable is None:
        return None
    try:
        return np.append(measure(run.shiftable, taus), len(run.shiftable.exits[0]))
    except Undefined:
        return None
