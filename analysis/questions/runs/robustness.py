"""Whether changed systems keep their statistics: each matrix compared with its changed copy, replicates and others.

Replicates of a matrix are its base and the copies that differ in the start only and have parted from it by t_burn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, I, Question, Row, S, frame, named
from stickslip.analysis.ensemble import Study
from stickslip.analysis.models.fates import DIVERGED, FAILED, MOVING, SETTLED, median
from stickslip.analysis.models.motion import COLUMNS
from stickslip.analysis.pairs import CONSTANTS, START, Comparison, Setting, follow, level, settings
from stickslip.analysis.stats import components, enough
from stickslip.analysis.stats.compare import UNKNOWN, Words, relative_difference, verdict
from stickslip.analysis.stats.estimates import Undefined
from stickslip.analysis.stats.multiplicity import adjusted
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.stats.student import half_width
from stickslip.analysis.style import GREY, SMOOTHED, panel

PRIMARY = ("mean", "rate", "gamma")  # tested in this order, small changes first
#: A quantity stays if a change has less than this share of a fresh matrix's mean square difference: half in
#: amplitude.
BOUND = 0.25
STAYS, MOVES = "stays", "moves"
NO_REPLICATES, NO_MOTION = "no replicates", "no motion"
_CHANGES: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "kind": S, "reading": S, "size": F, "quantity": S, "label": S,
    "n_matrices": I, "n_replicates": I, "base": F, "changed": F, "shift": F, "shift_low": F, "shift_high": F,
    "theta": F, "theta_low": F, "theta_high": F, "p_stays": F, "p_moves": F, "p_stays_adjusted": F,
    "p_moves_adjusted": F, "verdict": S,
}  # fmt: skip
_MATRICES: Mapping[str, str] = {
    "setting": S, "quantity": S, "label": S, "n_matrices": I, "n_replicates": I, "correlation": F,
    "correlation_low": F, "correlation_high": F,
}  # fmt: skip
_ENDS: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "n_pairs": I, "n_otherwise": I, "n_untold": I, "n_matrices": I,
    "shift": F, "shift_low": F, "shift_high": F, "redraw": F,
}  # fmt: skip


def answer(study: Study) -> Answer | None:
    """Effect of each change of constants or of stiffness ratios relative to that of a fresh matrix."""
    asked = [one for one in settings(study.data.table) if _changes(one)]
    if not asked:
        return None
    judged = sorted((_Judged(study, one) for one in asked), key=lambda one: (bool(one.lack), -one.setting.key["n"]))
    ends = [row for one in judged for row in _ends(study, one.setting)]
    tables = {
        "robustness_ends": frame(_ENDS, ends),
        "robustness": frame(_CHANGES, [row for one in judged for row in one.rows]),
        "robustness_matrices": frame(_MATRICES, [row for one in judged for row in one.matrices]),
    }
    lead = judged[0]
    facts: dict[str, Any] = {
        "setting": lead.setting.label,
        "t_burn": study.settings.t_burn,
        "t_end": lead.setting.key["t_end"],
        "bound": BOUND,
        "rows": lead.rows,
        "matrices": lead.matrices,
        "replicates": [one.change.size for one in lead.replicates],
        "basis": lead.basis,
        "n_runs": len(lead.members),
        "n_moving": len(lead.sums),
        "gone": {
            str(one.change): gone
            for one in lead.setting.comparisons
            if (gone := sum(pair.changed not in lead.sums for pair in one.pairs))
        },
        "others": [(one.setting.label, one.lack, one.rows) for one in judged[1:]],
        "ends": ends,
        "first_ends": [row for row in ends if row["setting"] == lead.setting.label],
    }
    if lead.lack == NO_MOTION and facts["first_ends"]:
        return Answer(facts, tables=tables)
    if lead.lack:
        return Answer(facts, lead.lack, tables)
    of_mean = [row for row in lead.rows if row["quantity"] == PRIMARY[0] and row["shift"] is not None]
    facts["lead"] = ([row for row in of_mean if row["verdict"] != UNKNOWN] or of_mean)[-1]
    facts["beyond"] = of_mean[of_mean.index(facts["lead"]) + 1 :]
    figures = {"robustness": partial(against_base, lead.points())}
    return Answer(facts, tables=tables, figures=figures)


def _ends(study: Study, setting: Setting) -> list[Row]:
    """How many copies of runs that ended end differently, and by how much the last event shifts, for each change.

    A run that left every bound ends at that time. A certificate makes no difference: a run ends alike with or
    without.
    """
    bases = {base: end for base in setting.bases.values() if (end := _end(study, base))}
    fates = study.motion.fates
    if len(bases) < enough.LEAST_MATRICES:
        return []
    times = np.array([t for _, _, t in bases.values()])
    redraw = float(np.median(np.abs(times[:, None] - times)[np.triu_indices(len(times), 1)]))
    rows = []
    for change in _changes(setting):
        pairs = [(pair, bases[pair.base]) for pair in change.pairs if pair.base in bases]
        both = [(pair.matrix, base, end) for pair, base in pairs if (end := _end(study, pair.changed))]
        alike = [(matrix, base, end) for matrix, base, end in both if base[0] == end[0]]
        n_known = sum(fates[pair.changed] != FAILED for pair, _ in pairs)
        by_matrix: dict[int, list[float]] = {}
        for matrix, base, end in alike:
            by_matrix.setdefault(matrix, []).append(abs(end[2] - base[2]))
        shifts = np.array([np.mean(some) for some in by_matrix.values()])
        shift = median(shifts, np.full(len(shifts), True), study.settings.confidence)
        if len(shifts):  # the mean of the two middle ones, as `redraw` has it
            shift = replace(shift, value=float(np.median(shifts)))
        rows.append({
            "setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"],
            "change": str(change.change), "of": change.change, "n_pairs": n_known,
            "n_otherwise": n_known - len(alike), "n_untold": sum(base[1] != end[1] for _, base, end in alike),
            "n_matrices": len(shifts), **named("shift", shift), "redraw": redraw,
        })  # fmt: skip
    return rows


def _end(study: Study, row: int) -> tuple[bool, str, float] | None:
    """Whether a run ran away, its fate, and the time of that or of its last event; None if it goes on or failed."""
    how = str(study.motion.fates[row])
    if how == DIVERGED:
        return True, how, float(study.data.table.own["t_stop"].iloc[row])
    return (False, how, float(study.motion.last[row, 0])) if how in SETTLED else None


def _changes(setting: Setting) -> list[Comparison]:
    return [one for one in setting.comparisons if one.change.kind != START]


class _Judged:
    """The values of the runs of one setting, and the verdict on each change."""

    def __init__(self, study: Study, setting: Setting) -> None:
        self.setting, self.level = setting, study.settings.confidence
        self.changes = _changes(setting)
        self.replicates = _replicates(study, setting)
        bases = list(setting.bases.values())
        self.members = [*bases, *(pair.changed for one in setting.comparisons for pair in one.pairs)]
        self.sums: dict[int, np.ndarray] = {}
        for member in self.members:
            if study.motion.fates[member] in MOVING and (found := _sums(study.motion.sums[member])) is not None:
                self.sums[member] = found
        some = study.motion.sums[[base for base in bases if base in self.sums]]
        n_cascades, halves = int(some[:, COLUMNS["cascades"]].sum()), ("first_half", "second_half", "variance")
        self.basis = enough.basis(some[:, [COLUMNS[name] for name in halves]], n_cascades, self.level)
        self.lack = self._lack()
        self.rows: list[Row] = [] if self.lack == NO_MOTION else self._rows()
        if not self.lack and all(row["shift"] is None for row in self.rows):
            self.lack = enough.FEW_MATRICES
        self.matrices: list[Row] = self._matrix_rows()

    def _lack(self) -> str:
        if not self.sums:
            return NO_MOTION
        if not self.replicates:
            return NO_REPLICATES
        return "" if self.basis.code in enough.JUDGED else self.basis.code

    def _complete(self, change: Comparison | None = None) -> list[tuple[list[int], list[int]]]:
        """Base with replicates, and changed runs, of each matrix whose runs all reached t_end in motion."""
        found = []
        for matrix, base in self.setting.bases.items():
            own = [base, *(member for one in self.replicates for member in _of(one, matrix))]
            changed = [] if change is None else _of(change, matrix)
            if all(member in self.sums for member in (*own, *changed)):
                found.append((own, changed))
        full = max((len(own) for own, _ in found), default=0), max((len(changed) for _, changed in found), default=0)
        return [one for one in found if (len(one[0]), len(one[1])) == full and (change is None or one[1])]

    def _values(self, quantity: str, members: Sequence[Sequence[int]]) -> np.ndarray:
        """Values of a quantity, in the shape of `members`."""
        k, of = PRIMARY.index(quantity), QUANTITIES[quantity].of
        return np.array([of(np.array([self.sums[member][k] for member in some])) for some in members])

    def _rows(self) -> list[Row]:
        rows = []
        for quantity in PRIMARY:
            for comparison in sorted(self.changes, key=lambda one: (one.change.kind == CONSTANTS, one.change)):
                rows.append(self._row(quantity, comparison))
        stays, moves = adjusted(
            [1.0 if row["p_stays"] is None else row["p_stays"] for row in rows],
            [1.0 if row["p_moves"] is None else row["p_moves"] for row in rows],
        )
        for row, p_stays, p_moves in zip(rows, stays, moves, strict=True):
            if row["p_moves"] is not None:
                row |= {"p_stays_adjusted": float(p_stays), "p_moves_adjusted": float(p_moves)}
            if not self.lack:
                moved = math.inf if row["theta"] is None else row["theta"]  # matrices cannot be told apart
                row["verdict"] = verdict(
                    float(p_stays), float(p_moves), 1 - self.level, moved, BOUND, Words(STAYS, MOVES, MOVES)
                )
        return rows

    def _row(self, quantity: str, comparison: Comparison) -> Row:
        """A quantity under a change: the shift of its mean over matrices, and the effect relative to a redraw."""
        change, complete = comparison.change, self._complete(comparison)
        row: Row = dict.fromkeys(_CHANGES) | {
            "setting": self.setting.label, "n": self.setting.key["n"], "engine": self.setting.key["engine"],
            "of": change, "what": f"{QUANTITIES[quantity].label}, {change}",
            "change": str(change), "kind": change.kind, "reading": change.reading, "size": change.size,
            "quantity": quantity, "label": QUANTITIES[quantity].label, "n_matrices": len(complete),
            "n_replicates": 1 + len(self.replicates), "verdict": UNKNOWN,
        }  # fmt: skip
        if len(complete) < enough.LEAST_MATRICES:
            return row
        own, changed = [one for one, _ in complete], [one for _, one in complete]
        row |= self._shift(quantity, own, changed)
        if self.replicates:
            found = components.against_redraw(
                self._values(quantity, own), self._values(quantity, changed), self.level
            )
            known = found.kind == components.BOUNDED
            row |= {
                "theta": found.theta.value if known else None, "theta_low": found.theta.low,
                "theta_high": found.theta.high, "p_stays": found.p_below(BOUND), "p_moves": found.p_above(0.0),
            }  # fmt: skip
        return row

    def _shift(self, quantity: str, own: Sequence[Sequence[int]], changed: Sequence[Sequence[int]]) -> Row:
        k, of = PRIMARY.index(quantity), QUANTITIES[quantity].of
        before, after = (
            np.array([np.mean([self.sums[member][k] for member in some], axis=0) for some in side])
            for side in (own, changed)
        )
        shift, error, dof = relative_difference(of, before, after, True)
        half = half_width(self.level, dof) * error
        return {
            "base": float(of(before.sum(axis=0, keepdims=True))[0]),
            "changed": float(of(after.sum(axis=0, keepdims=True))[0]),
            "shift": shift, "shift_low": shift - half, "shift_high": shift + half,
        }  # fmt: skip

    def _matrix_rows(self) -> list[Row]:
        """How much of the variance of each quantity is between matrices."""
        own = [one for one, _ in self._complete()]
        if not self.replicates or len(own) < enough.LEAST_MATRICES:
            return []
        rows: list[Row] = []
        for quantity in PRIMARY:
            found = components.intraclass(self._values(quantity, own), self.level)
            rows.append(
                {
                    "setting": self.setting.label, "quantity": quantity, "label": QUANTITIES[quantity].label,
                    "n_matrices": len(own), "n_replicates": len(own[0]), **named("correlation", found),
                }
            )  # fmt: skip
        return rows

    def points(self) -> list[tuple[str, bool, np.ndarray]]:
        """Name of each replicate and change, whether it is a change, and the mean n_stick of base and copy."""
        found = []
        for comparison in (*self.replicates, *self.changes):
            pairs = [p for p in comparison.pairs if p.base in self.sums and p.changed in self.sums]
            means = self._values(PRIMARY[0], [[pair.base, pair.changed] for pair in pairs])
            name = str(comparison.change)
            found.append((name, comparison.change.kind != START, means.reshape(-1, 2)))
        return found


def _replicates(study: Study, setting: Setting) -> list[Comparison]:
    """The displaced starts for which every run has parted from its base by t_burn."""
    starts = [one for one in setting.comparisons if one.change.kind == START]
    apart = level(study, setting) if starts else None
    if apart is None:
        return []
    followed = follow(study, starts, apart, study.settings.t_burn)
    return [one for one, pairs in zip(starts, followed, strict=True) if pairs.has_parted.all()]


def _of(comparison: Comparison, matrix: int) -> list[int]:
    """The changed members of a matrix."""
    return [pair.changed for pair in comparison.pairs if pair.matrix == matrix]


def _sums(found: np.ndarray) -> np.ndarray | None:
    """Sums of each of `PRIMARY`, shape (3, 2), from a row of `Motion.sums`; None where one of them has no value."""
    rows = np.array([found[[COLUMNS[part] for part in QUANTITIES[name].parts]] for name in PRIMARY])
    try:
        for name, row in zip(PRIMARY, rows, strict=True):
            QUANTITIES[name].of(row[None])
    except Undefined:
        return None
    return rows


@panel(3.4)
def against_base(ax: Axes, points: Sequence[tuple[str, bool, np.ndarray]]) -> None:
    """Mean n_stick of each copy against that of its base, one point a matrix; replicates open, changes filled.

    Points are (name, whether it is a change, means of shape (G, 2)).
    """
    both = np.concatenate([some.ravel() for _, _, some in points])
    margin = 0.05 * (both.max() - both.min())
    ends = (both.min() - margin, both.max() + margin)
    ax.plot(ends, ends, "--", color=GREY, linewidth=0.9)
    marks = {True: iter("s^Dv"), False: iter("ophP")}
    colours = {True: iter(("#f0a860", SMOOTHED, "#8c2d04")), False: iter(("#2171b5", "#6baed6", "#9ecae1"))}
    for name, is_change, means in points:
        colour = next(colours[is_change], GREY)
        form: Any = {"marker": next(marks[is_change], "x"), "markersize": 4, "color": colour, "linestyle": ""}
        ax.plot(means[:, 0], means[:, 1], markerfacecolor=colour if is_change else "white", label=name, **form)
    ax.set(xlim=ends, ylim=ends, aspect="equal", xlabel="mean $n_{stick}$ of the base")
    ax.set_ylabel("mean $n_{stick}$ of the copy")
    ax.figure.legend(loc="outside lower center", ncols=2, handletextpad=0.2)


QUESTION = Question(answer, share=0.4, rank=4, beside=("sensitivity",))
