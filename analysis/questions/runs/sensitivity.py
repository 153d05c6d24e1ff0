"""How fast changed copies leave their base: growth rates of small displacements, and when runs have parted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, B, F, I, Picture, Question, S, frame, named
from stickslip.analysis.ensemble import Separation, Study
from stickslip.analysis.findings.finding import Basis, Finding, Lack, Level, Lifetime, Quantity, Reason
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.members import RELATIVE
from stickslip.analysis.models.fates import median
from stickslip.analysis.models.growth import Growth, growth
from stickslip.analysis.pairs import CONSTANTS, RATIOS, START, Comparison, Followed, Setting, follow, level, settings
from stickslip.analysis.series import parting
from stickslip.analysis.stats.compare import UNKNOWN
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import CYCLE, GREY, panel
from stickslip.pipeline.design.design import Change
from stickslip.pipeline.design.values import shown
from stickslip.sim.engines import ENGINES

GROWS, SHRINKS = "grow", "shrink"
T_FROM, LEAST = 100.0, 100.0  # where the range of a growth rate begins, and the shortest that counts
CEILING = 3e-2  # of distances that still grow in proportion
SMALL = 0.1  # largest displacement of a start for a growth rate, as a share of the ceiling
FLOOR, TOLERANCES = 1e-13, 10.0  # floor of exact engines; that of others is so many times their relative tolerance
RATE = Quantity("rate", "growth rate of small differences, per unit of time")
PARTED = Quantity("parted", "median time until copies part from their base")
_GROWTH: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "size": F, "rate": F, "rate_low": F, "rate_high": F, "e_fold": F,
    "e_fold_low": F, "e_fold_high": F, "t_from": F, "t_to": F, "n_pairs": I, "n_used": I, "n_floor": I,
    "n_ceiling": I, "is_selected": B, "verdict": S,
}  # fmt: skip
_PARTING: Mapping[str, str] = {
    "setting": S, "n": I, "engine": S, "change": S, "kind": S, "reading": S, "size": F, "level": F, "n_pairs": I,
    "n_parted": I, "median": F, "median_low": F, "median_high": F,
}  # fmt: skip
_CURVES: Mapping[str, str] = {"setting": S, "change": S, "t": F, "n_pairs": I, "gap": F}


_METHOD = (
    f"The growth rate is the slope of log distance over time from t = {T_FROM:g} on, while all pairs lie between a"
    f" floor ({FLOOR:g}, or {TOLERANCES:g} rtol under a smoothed law) and {CEILING:g}; none is given where more than"
    " a tenth of the pairs leave that range. Copies have parted when |difference of n_stick|, averaged over"
    f" {parting.SPAN:g} units of time, first reaches {100 * parting.SHARE:g}% of what two systems show after t_burn."
)


def _identity(setting: Setting) -> dict[str, object]:
    return {"setting": setting.label, "n": setting.key["n"], "engine": setting.key["engine"]}


class _Rate(NamedTuple):
    """The growth rate of starts displaced by one size."""

    setting: Setting
    size: float
    n_pairs: int
    law: Growth

    @property
    def is_told(self) -> bool:
        """Whether enough pairs stay in their linear range."""
        return self.law.rate.low is not None and not self.law.is_selected

    @property
    def verdict(self) -> str:
        """Whether small differences grow or shrink, by the interval of their rate."""
        if not self.is_told or self.e_fold.value is None:
            return UNKNOWN
        return GROWS if (self.law.rate.low or 0.0) > 0 else SHRINKS

    @property
    def n_used(self) -> int:
        """How many pairs stay in their linear range."""
        return self.law.n_pairs - self.law.n_floor - self.law.n_ceiling

    @property
    def e_fold(self) -> Estimate:
        """The time in which differences change by a factor e; nothing if the rate may be zero."""
        rate = self.law.rate
        if not rate.value or rate.low is None or rate.high is None or rate.low <= 0 <= rate.high:
            return Estimate()
        low, high = sorted((abs(1 / rate.low), abs(1 / rate.high)))
        return Estimate(abs(1 / rate.value), low, high)

    @property
    def precedence(self) -> tuple[bool, bool, float]:
        """The rate depends on the range that it is taken in: the longest stands for a setting."""
        return self.is_told, self.verdict != UNKNOWN, self.law.t_to - self.law.t_from

    @property
    def finding(self) -> Finding:
        where, basis = Place.of(self.setting.label), Basis(self.n_used, "pair")
        differences = f"start differences of {shown(self.size)}"
        if not self.law.n_pairs:
            return Lack(
                f"growth rate of {differences}, {where}", Reason.NOT_RECORDED, "add separation under [record]"
            )
        if not self.is_told:
            return Lack(
                f"growth rate of {differences}, {where}", Reason.OUT_OF_RANGE, f"{self.n_used} of {self.n_pairs}"
            )
        if self.verdict == UNKNOWN:
            name = f"growth rate of {differences}, per unit of time"
            return Level(Quantity(RATE.key, name), self.law.rate, where, basis=basis)
        changes = f"{differences} {self.verdict} e-fold in"
        name = f"time in which {differences} {self.verdict} e-fold"
        return Level(Quantity("e_fold", name, clause=f"{changes} {{}} time units"), self.e_fold, where, basis=basis)

    def row(self) -> Mapping[str, object]:
        """Row of the table `growth`."""
        law = self.law
        return _identity(self.setting) | named("rate", law.rate) | named("e_fold", self.e_fold) | {
            "size": self.size, "n_pairs": self.n_pairs, "n_used": self.n_used, "verdict": self.verdict,
            "t_from": law.t_from, "t_to": law.t_to, "n_floor": law.n_floor, "n_ceiling": law.n_ceiling,
            "is_selected": law.is_selected,
        }  # fmt: skip


class _Parting(NamedTuple):
    """When the copies with one change have parted from their base."""

    setting: Setting
    change: Change
    level: float
    pairs: Followed
    half: Estimate

    def row(self) -> Mapping[str, object]:
        """Row of the table `parting`."""
        change = self.change
        return _identity(self.setting) | named("median", self.half) | {
            "change": str(change), "kind": change.kind, "reading": change.reading, "size": change.size,
            "level": self.level, "n_pairs": len(self.pairs), "n_parted": int(self.pairs.has_parted.sum()),
        }  # fmt: skip

    def curve(self) -> Iterator[tuple[float, int, float]]:
        """Times, pairs that are still followed, and their mean gap, in units of the level."""
        for t, means in zip(self.pairs.times.tolist(), self.pairs.means.T, strict=True):
            known = means[~np.isnan(means)]
            if 2 * len(known) < len(self.pairs):
                break
            yield t, len(known), float(np.mean(known)) / self.level


def _alike(partings: Sequence[_Parting]) -> list[list[_Parting]]:
    """Partings, where those of displaced starts of a setting of which none has parted are together."""
    groups: dict[object, list[_Parting]] = {}
    for k, parted in enumerate(partings):
        is_open = parted.change.kind == START and not parted.pairs.has_parted.any()
        groups.setdefault(parted.setting.label if is_open else k, []).append(parted)
    return [*groups.values()]


def _lifetime(alike: Sequence[_Parting]) -> Lifetime:
    """The median time until copies part, of one change or of several that have the same outcome."""
    first, sizes = alike[0], listed([shown(parted.change.size) for parted in alike], "or")
    change = {
        CONSTANTS: f"constants changed by up to {100 * first.change.size:g}%",
        START: f"starts moved by {sizes}",
        RATIOS: "other stiffness ratios",
    }[first.change.kind]
    share_left = 1 - float(np.mean(np.concatenate([parted.pairs.has_parted for parted in alike])))
    where, horizon = Place.of(first.setting.label) + Place.words(f"with {change}"), float(first.setting.key["t_end"])
    basis = Basis(len(np.unique(first.pairs.matrix)))
    return Lifetime(PARTED, "copies", "are still together", first.half, horizon, share_left, where, basis=basis)


def answer(study: Study) -> Answer | None:
    """Growth rates of displaced starts, and when the copies with each change have parted from their base."""
    compared = [setting for setting in settings(study.data.table) if setting.comparisons]
    if not compared:
        return None
    rates = [
        _rate(study, setting, comparison)
        for setting in compared
        for comparison in setting.comparisons
        if comparison.change.kind == START and comparison.change.size <= SMALL * CEILING
    ]
    partings = [parted for setting in compared for parted in _partings(study, setting)]
    tables = {
        "growth": frame(_GROWTH, (rate.row() for rate in rates)),
        "parting": frame(_PARTING, (parted.row() for parted in partings)),
        "parting_curves": frame(_CURVES, (
            {"setting": parted.setting.label, "change": str(parted.change), "t": t, "n_pairs": n, "gap": gap}
            for parted in partings for t, n, gap in parted.curve()
        )),
    }  # fmt: skip
    by_setting = {setting.label: [rate for rate in rates if rate.setting is setting] for setting in compared}
    best = [max(alike, key=lambda rate: rate.precedence) for alike in by_setting.values() if alike]
    best.sort(key=lambda rate: (not rate.is_told, -_size(rate.setting)))
    has_lead = bool(best) and best[0].is_told
    leading = best[0].setting if has_lead else max((one.setting for one in partings), key=_size, default=None)
    partings.sort(key=lambda parted: (parted.setting is not leading, parted.change.kind == START))
    of_rates: list[Finding] = [rate.finding for rate in best] or [Lack(RATE.name, Reason.NOT_RUN, "add [twins]")]
    of_partings: list[Finding] = [_lifetime(alike) for alike in _alike(partings)] or [
        Lack(PARTED.name, Reason.NO_REFERENCE, "no lasting difference of two systems")
    ]
    first, second = (of_rates, of_partings) if has_lead or not partings else (of_partings, of_rates)
    findings = [first[0], *second, *first[1:]]
    told, drawn = [rate for rate in best if rate.is_told], [one for one in partings if one.setting is leading]
    figures = _figures(study, compared, told, drawn)
    return Answer(findings=findings, n_lead=2, tables=tables, figures=figures, method=_METHOD)


def _size(setting: Setting) -> int:
    return int(setting.key["n"])


def _rate(study: Study, setting: Setting, comparison: Comparison) -> _Rate:
    """Growth rate of starts displaced by one size."""
    size, separations = comparison.change.size, _separations(study, comparison)
    pairs = [pair for pair in comparison.pairs if len(separations.get(pair.changed, ((),))[0])]
    if not pairs:
        return _Rate(setting, size, len(comparison.pairs), Growth(Estimate(), T_FROM, T_FROM, 0, 0, 0))
    known = [separations[pair.changed] for pair in pairs]
    times = max((t for t, _ in known), key=len)
    law = growth(
        times, [distance for _, distance in known], [pair.matrix for pair in pairs],
        T_FROM, LEAST, (_floor(setting.key), CEILING), study.settings.confidence,
    )  # fmt: skip
    return _Rate(setting, size, len(comparison.pairs), law)


def _partings(study: Study, setting: Setting) -> Iterator[_Parting]:
    """When half of the systems' copies have parted, for each change."""
    apart = level(study, setting)
    if apart is None:
        return
    every = follow(study, setting.comparisons, apart, float(setting.key["t_end"]))
    for comparison, pairs in zip(setting.comparisons, every, strict=True):
        if not len(pairs):
            continue
        _, first = np.unique(pairs.matrix, return_index=True)  # of several draws: systems are the independent units
        has_parted = pairs.has_parted[first]
        times = np.where(has_parted, pairs.t[first], pairs.t_stop[first])
        yield _Parting(setting, comparison.change, apart, pairs, median(times, has_parted, study.settings.confidence))


def _floor(key: Mapping[str, Any]) -> float:
    """The distance of two runs below which the errors of an engine and its settings hide it."""
    tolerances = [] if ENGINES[key["engine"]].is_exact else [key[name] or 0.0 for name in RELATIVE]
    return max([FLOOR, *(TOLERANCES * tolerance for tolerance in tolerances)])


def _separations(study: Study, comparison: Comparison) -> dict[int, Separation]:
    """What was recorded of the changed members, by their rows."""
    names = study.data.table.own["member_id"].iloc[comparison.changed]
    known = study.data.separations
    return {row: known[name] for row, name in zip(names.index.tolist(), names, strict=True) if name in known}


Line = tuple[str, np.ndarray, np.ndarray]  # name, times, values


class Stretch(NamedTuple):
    """Distances of the pairs of a setting, over what they were at the start, and the fit of their growth."""

    name: str
    pairs: Sequence[tuple[np.ndarray, np.ndarray]]  # times and distances, while these grow in proportion
    law: Growth

    @property
    def fit(self) -> tuple[np.ndarray, np.ndarray]:
        """Times at the ends of the range that the rate is taken in, and the fitted distance there."""
        ends = np.array([self.law.t_from, self.law.t_to])
        logs = [
            np.mean(np.log(distance[some])) for t, distance in self.pairs
            if (some := (t >= ends[0]) & (t <= ends[1])).any()
        ]  # fmt: skip
        return ends, np.exp(np.mean(logs) + (self.law.rate.value or 0.0) * (ends - ends.mean()))


def _figures(
    study: Study, compared: Sequence[Setting], told: Sequence[_Rate], partings: Sequence[_Parting]
) -> dict[str, Picture]:
    """Distances in all settings, and gaps in the one that leads."""
    figures = {}
    if lines := _distance_lines(study, compared, told):
        figures["growth"] = Picture(
            partial(distances, lines),
            "How differences of starts grow or shrink: distance of each system's copy from its base, over the"
            " difference at the start, while they are proportional. Heavy: the fitted rate, over its range.",
        )
    points = {str(parted.change): np.array([*parted.curve()]) for parted in partings}
    if curves := [(name, curve[:, 0], curve[:, 2]) for name, curve in points.items() if len(curve)]:
        figures["parting"] = Picture(
            partial(parting_curves, curves),
            f"When copies part from their base at {partings[0].setting.label}: mean gap in n_stick, in units of what"
            " two systems show after t_burn.",
        )
    return figures


def _distance_lines(study: Study, compared: Sequence[Setting], told: Sequence[_Rate]) -> list[Stretch]:
    """Distances of pairs and the fit of their growth, at the size that stands for each setting."""
    lines: list[Stretch] = []
    for setting in compared:
        rate = next((rate for rate in told if rate.setting is setting), None)
        for comparison in setting.comparisons:
            if rate is None or comparison.change != Change(START, size=rate.size):
                continue
            known = [*_separations(study, comparison).values()]
            pairs = [_in_proportion(t, distance, rate.size, _floor(setting.key)) for t, distance in known]
            lines.append(Stretch(f"{setting.label}: {shown(rate.size)}", pairs, rate.law))
    return lines


def _in_proportion(t: np.ndarray, distance: np.ndarray, size: float, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and distances over that at the start, until they leave the range in which they are proportional."""
    is_out = (distance <= floor) | (distance >= CEILING)
    n = int(np.argmax(is_out)) if is_out.any() else len(distance)
    return t[:n], distance[:n] / size


@panel(3.4)
def parting_curves(ax: Axes, lines: Sequence[Line]) -> None:
    """Gap of n_stick between copy and base, over that between two systems, against time."""
    colours = ("#08306b", "#2171b5", "#6baed6", "#f0a860", "#c4561a", "#8c2d04")
    for k, (name, t, gaps) in enumerate(lines):
        ax.plot(t, gaps, color=colours[k % len(colours)], linestyle="-" if k < len(colours) else ":", label=name)
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=0.9)
    ax.text(0.02, 1.03, "two systems", color=GREY, fontsize=8, transform=ax.get_yaxis_transform())
    ax.axhline(parting.SHARE, linestyle=":", color=GREY, linewidth=0.9)
    ax.text(0.02, parting.SHARE + 0.03, "apart", color=GREY, fontsize=8, transform=ax.get_yaxis_transform())
    ax.set(xscale="log", ylim=(0, None), xlabel="time t", ylabel="gap in $n_{stick}$ (two systems: 1)")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.figure.legend(loc="outside lower center", ncols=2)


@panel(3.4)
def distances(ax: Axes, lines: Sequence[Stretch]) -> None:
    """Distances of displaced runs from their base, over that at the start, on a logarithmic axis, with the fits."""
    for k, line in enumerate(lines):
        colour, form = CYCLE[k % len(CYCLE)], ("-", "--", ":")[k // len(CYCLE) % 3]
        for t, distance in line.pairs:
            ax.plot(t, distance, form, color=colour, linewidth=0.5, alpha=0.5)
        ax.plot(*line.fit, form, color=colour, linewidth=2.2, label=line.name)
    ax.set(yscale="log", xlabel="time t", ylabel="distance / at the start")
    ax.figure.legend(loc="outside lower center", ncols=1)


QUESTION = Question(answer, title="How fast do nearby runs part?", share=0.3)
