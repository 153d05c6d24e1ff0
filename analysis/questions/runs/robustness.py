"""Whether changed systems keep their statistics: each system beside its changed copy, replicates and others.

Replicates of a system are its base and the copies that differ in the start only and have parted from it by t_burn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, F, I, Picture, Row, S, frame, named
from stickslip.analysis.contrast import CHANGES, TITLES, Contrast, Sample, contrast, judged, statistics
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Basis, Finding, Form, Lack, Level, Quantity, Reason, Share
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.members import noun
from stickslip.analysis.models.fates import DIVERGED, FAILED, MOVING, SETTLED, median
from stickslip.analysis.models.motion import COLUMNS
from stickslip.analysis.outcomes import Beside, outcomes
from stickslip.analysis.outcomes import Setting as Named
from stickslip.analysis.pairs import START, Comparison, Setting, follow, level, settings
from stickslip.analysis.stats import components, enough
from stickslip.analysis.stats.compare import share_over_matrices
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.style import GREY, SMOOTHED, panel
from stickslip.pipeline.design.design import DEFAULT_READING, Change, Kind

PRIMARY = ("mean", "rate", "gamma")
UNCHANGED = "the unchanged system"
_EFFECTS: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "kind": S, "reading": S, "size": F, "quantity": S,
    "n_matrices": I, "n_replicates": I, "theta": F, "theta_low": F, "theta_high": F,
}  # fmt: skip
_MATRICES: Mapping[str, str] = {
    "setting": S, "quantity": S, "n_matrices": I, "n_replicates": I, "correlation": F, "correlation_low": F,
    "correlation_high": F,
}  # fmt: skip
_ENDS: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "n_pairs": I, "n_otherwise": I, "n_untold": I, "n_matrices": I,
    "shift": F, "shift_low": F, "shift_high": F, "redraw": F,
}  # fmt: skip
_METHOD = (
    "Each system is compared with its changed copy. The effect of a change on single systems is a mean square"
    " difference, as a share of that between two systems, beyond the scatter between starts of one."
)


def answer(study: Study) -> Answer | None:
    """Effect of each change of constants or of stiffness ratios, by itself and beside that of another system."""
    asked = [setting for setting in settings(study.data.table) if _changes(setting)]
    if not asked:
        return None
    every = sorted(
        (_Judged(study, setting) for setting in asked), key=lambda one: (not one.sums, -one.setting.key["n"])
    )
    ends = [row for one in every for row in _ends(study, one.setting)]
    contrasts = [row for one in every for row in one.contrast_rows()]
    tables = {
        "changes": frame(CHANGES, contrasts),
        "robustness": frame(_EFFECTS, [row for one in every for row in one.effects]),
        "robustness_matrices": frame(_MATRICES, [row for one in every for row in one.matrices]),
        "robustness_ends": frame(_ENDS, ends),
    }
    where = {one.setting.label: Place.of(one.setting.label) if len(every) > 1 else EVERYWHERE for one in every}
    unit = noun(study.unit)
    lead = [finding for one in every for finding in one.leading(where[one.setting.label], unit)]
    lead += [finding for row in ends for finding in _ends_in_words(row, where[row["setting"]], unit)]
    rest = [finding for one in every for finding in one.rest(where[one.setting.label], unit)]
    if not lead:
        reason = Reason.FEW_UNITS if every[0].sums else Reason.NO_MOTION
        return Answer(findings=[Lack("the effect of a changed system", reason)], tables=tables)
    points = every[0].points()
    figures = dict[str, Picture]()
    if any(len(means) for _, _, means in points):
        starts = ", beside other starts of the same system (open)" if every[0].replicates else ""
        caption = f"How far changed systems lie from the line of no change{starts}: one mark a system."
        figures["robustness"] = Picture(partial(against_base, points), caption)
    return Answer(tables=tables, figures=figures, findings=[*lead, *rest], n_lead=min(3, len(lead)), method=_METHOD)


def _named(change: Change) -> Named:
    """A change, with its size."""
    if change.kind == Kind.RATIOS:
        return Named("a draw of other stiffness ratios")
    how = "" if change.reading in (None, DEFAULT_READING) else f" ({change.reading})"
    return Named("", f"a change of constants{how}", 100.0 * change.size, "%")


def _ends_in_words(row: Row, where: Place, unit: str) -> Iterator[Finding]:
    """How many copies of runs that ended end differently, and by how much the last event shifts."""
    at = where + Place.words(row["change"])
    if row["counts"]:
        share, low, high, _ = share_over_matrices(row["counts"], row["confidence"])
        yield Share(
            "otherwise", "changed copies", "end differently from their original", Estimate(share, low, high), at,
            basis=Basis(len(row["counts"]), unit),
        )  # fmt: skip
    if row["shift"] is not None:
        shift = Estimate(row["shift"], row["shift_low"], row["shift_high"])
        quantity = Quantity("shift", "median shift of the last event")
        yield Level(quantity, shift, at, None, Basis(row["n_matrices"], unit))


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
        counts: dict[int, list[int]] = {}
        for pair, _ in pairs:
            if fates[pair.changed] != FAILED:
                of_unit = counts.setdefault(pair.matrix, [0, 0])
                of_unit[1] += 1
        for matrix, _, _ in alike:
            counts[matrix][0] += 1
        rows.append({
            "counts": [[n - n_alike, n] for n_alike, n in counts.values()], "confidence": study.settings.confidence,
            "setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"],
            "change": str(change.change), "n_pairs": n_known,
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
    """The values of the runs of one setting, and the effect of each change."""

    def __init__(self, study: Study, setting: Setting) -> None:
        self.study, self.setting, self.level = study, setting, study.settings.confidence
        self.changes = _changes(setting)
        self.replicates = _replicates(study, setting)
        bases = list(setting.bases.values())
        self.members = [*bases, *(pair.changed for one in setting.comparisons for pair in one.pairs)]
        self.sums: dict[int, np.ndarray] = {}
        for member in self.members:
            if study.motion.fates[member] in MOVING and (found := _sums(study.motion.sums[member])) is not None:
                self.sums[member] = found
        self.contrasts: list[tuple[Change, str, Contrast]] = self._contrasts(study) if self.sums else []
        self.effects: list[Row] = self._effects() if self.sums and self.replicates and self._is_judged() else []
        self.matrices: list[Row] = self._matrix_rows()

    def _is_judged(self) -> bool:
        """Whether the runs are in a steady state that suffices."""
        bases = [base for base in self.setting.bases.values() if base in self.sums]
        some = self.study.motion.sums[bases]
        n_cascades, halves = int(some[:, COLUMNS["cascades"]].sum()), ("first_half", "second_half", "variance")
        basis = enough.basis(some[:, [COLUMNS[name] for name in halves]], n_cascades, self.level)
        return basis.code in enough.JUDGED

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

    def _contrasts(self, study: Study) -> list[tuple[Change, str, Contrast]]:
        """Each quantity under each change beside that of the unchanged systems, judged together."""
        found = []
        asked = statistics(study.margins, study.compared & {*PRIMARY})
        names = [name for name in QUANTITIES if name in study.compared & {*PRIMARY}]
        for name, statistic in zip(names, asked, strict=True):
            for comparison in self.changes:
                complete = self._complete(comparison)
                before, after = (
                    Sample({statistic.name: self._of_units(name, [pair[side] for pair in complete])})
                    for side in (0, 1)
                )
                found.append((comparison.change, name, contrast(statistic, before, after, True, self.level)))
        together = judged([one for _, _, one in found], 1 - self.level)
        return [(change, name, one) for (change, name, _), one in zip(found, together, strict=True)]

    def _of_units(self, quantity: str, members: Sequence[Sequence[int]]) -> UnitSums:
        """The sums of a quantity, averaged over the runs of each unit."""
        k = PRIMARY.index(quantity)
        rows = [np.mean([self.sums[member][k] for member in some], axis=0) for some in members]
        return UnitSums(np.arange(len(rows)), np.array(rows).reshape(-1, 2))

    def contrast_rows(self) -> list[Row]:
        return [
            {"kind": "change", "setting": self.setting.label, "reference": self.setting.label,
             "second_value": str(change), **one.row()}
            for change, _, one in self.contrasts
        ]  # fmt: skip

    def leading(self, where: Place, unit: str) -> list[Finding]:
        """How changed systems come out beside unchanged ones, and the effect of the largest change on one system."""
        known = [(change, one) for change, _, one in self.contrasts if one.is_known and not one.reason]
        known.sort(key=lambda pair: (pair[0].kind, pair[0].reading or "", pair[0].size))
        if not known:
            return []
        placed: dict[Named, list[Beside]] = {}
        for change, one in known:
            at = where + Place.words(str(change))
            placed.setdefault(_named(change), []).append(Beside(one, at))
        effects = [row for row in self.effects if row["quantity"] == PRIMARY[0] and row["theta"] is not None]
        return [*outcomes("no change", placed, unit), *(self._effect(row, where, unit) for row in effects[-1:])]

    def rest(self, where: Place, unit: str) -> list[Finding]:
        """Each quantity under each change, and how much of its variance lies between systems."""
        found: list[Finding] = [
            one.level(where + Place.words(str(change)), UNCHANGED, unit)
            for change, _, one in self.contrasts
            if one.is_known
        ]
        found += [self._effect(row, where, unit) for row in self.effects if row["theta"] is not None]
        for row in self.matrices:
            value = Estimate(row["correlation"], row["correlation_low"], row["correlation_high"])
            if value.value is not None:
                name = f"share of the variance of the {TITLES[row['quantity']]} between systems"
                quantity = Quantity("correlation", name, Form.SHARE)
                found.append(Level(quantity, value, where, None, Basis(row["n_matrices"], unit)))
        return found

    def _effect(self, row: Row, where: Place, unit: str) -> Level:
        """The mean square effect of a change on a quantity, as a share of that of another system."""
        name = f"effect of {row['change']} on the {TITLES[row['quantity']]} of one system"
        quantity = Quantity("theta", f"{name}, as a share of another system's", Form.SHARE)
        value = Estimate(row["theta"], row["theta_low"], row["theta_high"])
        return Level(quantity, value, where, None, Basis(row["n_matrices"], unit))

    def _effects(self) -> list[Row]:
        """The effect of each change on each quantity, beside that of another system."""
        rows: list[Row] = []
        for quantity in PRIMARY:
            for comparison in self.changes:
                change, complete = comparison.change, self._complete(comparison)
                if len(complete) < enough.LEAST_MATRICES:
                    continue
                before, after = (self._values(quantity, [pair[side] for pair in complete]) for side in (0, 1))
                found = components.against_redraw(before, after, self.level)
                is_known = found.kind == components.BOUNDED
                rows.append({
                    "setting": self.setting.label, "n": self.setting.key["n"], "engine": self.setting.key["engine"],
                    "change": str(change), "kind": change.kind, "reading": change.reading, "size": change.size,
                    "quantity": quantity, "n_matrices": len(complete), "n_replicates": 1 + len(self.replicates),
                    "theta": found.theta.value if is_known else None, "theta_low": found.theta.low,
                    "theta_high": found.theta.high,
                })  # fmt: skip
        return rows

    def _matrix_rows(self) -> list[Row]:
        """How much of the variance of each quantity is between matrices."""
        own = [one for one, _ in self._complete()]
        if not self.replicates or not self.sums or len(own) < enough.LEAST_MATRICES:
            return []
        rows: list[Row] = []
        for quantity in PRIMARY:
            found = components.intraclass(self._values(quantity, own), self.level)
            rows.append(
                {
                    "setting": self.setting.label, "quantity": quantity,
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
    ax.set(xlim=ends, ylim=ends, aspect="equal", xlabel="mean number of sticking blocks, unchanged")
    ax.set_ylabel("mean number of sticking blocks, changed")
    ax.figure.legend(loc="outside lower center", ncols=2, handletextpad=0.2)
