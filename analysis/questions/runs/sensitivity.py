"""How fast changed copies leave their base: growth rates of small displacements, and when runs have parted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, Picture, Question
from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Separation, Study
from stickslip.analysis.findings.finding import Basis, Finding, Lack, Level, Lifetime, Quantity, Reason, Share
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.members import RELATIVE
from stickslip.analysis.models.growth import Growth, growth
from stickslip.analysis.pairs import CONSTANTS, RATIOS, START, Comparison, Followed, PairSet, follow, level, settings
from stickslip.analysis.series import parting
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.shares import wilson
from stickslip.analysis.stats.survival import median
from stickslip.analysis.style import hues, panel
from stickslip.pipeline.design.design import Change
from stickslip.pipeline.design.units import Units
from stickslip.pipeline.design.values import shown
from stickslip.sim.engines import ENGINES

T_FROM, LEAST = 100.0, 100.0  # where the range of a growth rate begins, and the shortest that counts
CEILING = 3e-2  # of distances that still grow in proportion
SMALL = 0.1  # largest displacement of a start for a growth rate, as a share of the ceiling
FLOOR, TOLERANCES = 1e-13, 10.0  # floor of exact engines; that of others is so many times their relative tolerance
RATE = Quantity("rate", "growth rate of small differences, per unit of time", dimension="frequency")
HALF = "from the original half as much as another system"  # see `parting.SHARE`
PARTED = Quantity("parted", f"median time until copies differ {HALF}", dimension="time")


def _method(study: Study) -> str:
    settings, unit = study.settings, study.settings.units.time or "units of time"
    return (
        f"The growth rate is the slope of log distance over time from t = {settings.at(T_FROM * settings.time)} on,"
        f" while all pairs lie between a floor ({FLOOR:g}, or {TOLERANCES:g} rtol under a smoothed law) and"
        f" {CEILING:g}; none is given where more than a tenth of the pairs leave that range."
        f" Copies differ half as much when |difference of n_stick|, averaged over {parting.SPAN * settings.time:g}"
        f" {unit}, first reaches {100 * parting.SHARE:g}% of what two systems show after t_burn while both are"
        " followed. A pair is followed until the motion of one of its runs grows without limit."
    )


class Rate(NamedTuple):
    """The growth rate of starts displaced by one size, and the distances of the pairs that it is of."""

    setting: PairSet
    size: float
    n_pairs: int
    law: Growth
    distances: Sequence[Separation]

    @property
    def is_known(self) -> bool:
        """Whether enough pairs stay in their linear range."""
        return self.law.rate.low is not None and not self.law.is_selected

    @property
    def e_fold(self) -> Estimate:
        """The time in which differences change by a factor e; nothing if the rate may be zero, or is not known."""
        value, low, high = self.law.rate.value, self.law.rate.low, self.law.rate.high
        if not self.is_known or not value or low is None or high is None or low <= 0 <= high:
            return Estimate()
        shortest, longest = sorted((abs(1 / low), abs(1 / high)))
        return Estimate(abs(1 / value), shortest, longest)

    @property
    def finding(self) -> Finding:
        where, basis = Place.of(self.setting.label), Basis(self.law.n_used, "pair")
        differences = f"initial differences of {shown(self.size)}"
        lacking = f"growth rate of {differences}, {where}"
        if not self.law.n_pairs:
            return Lack(lacking, Reason.NOT_RECORDED, "add separation under [record]")
        if not self.is_known:
            return Lack(lacking, Reason.OUT_OF_RANGE, f"{self.law.n_used} of {self.n_pairs}")
        if self.e_fold.value is None:
            name = f"growth rate of {differences}, per unit of time"
            return Level(replace(RATE, name=name), self.law.rate, where, basis=basis)
        verb = "grow" if (self.law.rate.value or 0.0) > 0 else "shrink"
        clause = f"{differences} {verb} e-fold every {{}} time units"
        name = f"time in which {differences} {verb} e-fold"
        quantity = Quantity("e_fold", name, clause=clause, dimension="time")
        return Level(quantity, self.e_fold, where, basis=basis)

    @property
    def fit(self) -> tuple[np.ndarray, np.ndarray]:
        """Times at the ends of the range that the rate is taken in, and the fitted distance there, in proportion."""
        ends = np.array([self.law.t_from, self.law.t_to])
        logs = [
            np.mean(np.log(distance[inside]))
            for t, distance in self.in_proportion
            if (inside := (t >= ends[0]) & (t <= ends[1])).any()
        ]
        return ends, np.exp(np.mean(logs) + (self.law.rate.value or 0.0) * (ends - ends.mean()))

    @property
    def in_proportion(self) -> Iterator[Separation]:
        """Times and distances over that at the start, until they leave the range in which they are proportional."""
        floor = _floor(self.setting.key)
        for t, distance in self.distances:
            n = int(np.cumprod((distance > floor) & (distance < CEILING)).sum())
            yield t[:n], distance[:n] / self.size


class Parting(NamedTuple):
    """When the copies with one change have parted from their base.

    `together` is the share of systems whose copies are together at the `horizon`; in `n_grew` others the motion of
    one of the two grew without limit before they parted.
    """

    setting: PairSet
    change: Change
    pairs: Followed
    half: Estimate
    together: Estimate
    n_systems: int
    n_grew: int
    horizon: str


def answer(study: Study) -> Answer | None:
    """Growth rates of displaced starts, and when the copies with each change have parted from their base."""
    compared = [setting for setting in settings(study.data.table) if setting.comparisons]
    if not compared:
        return None
    rates = [rate for setting in compared if (rate := _rate(study, setting)) is not None]
    rates.sort(key=lambda rate: (not rate.is_known, -_size(rate.setting)))
    partings = [parted for setting in compared for parted in _partings(study, setting)]
    has_lead = bool(rates) and rates[0].is_known
    leading = rates[0].setting if has_lead else max((row.setting for row in partings), key=_size, default=None)
    partings.sort(key=lambda parted: (parted.setting is not leading, parted.change.kind == START))
    of_rates: list[Finding] = [rate.finding for rate in rates] or [Lack(RATE.name, Reason.NOT_RUN, "add [twins]")]
    of_partings: list[Finding] = [_finding(alike) for alike in _alike(partings)] or [
        Lack(PARTED.name, Reason.NO_REFERENCE, "no lasting difference of two systems")
    ]
    lead, support = (of_rates, of_partings) if has_lead or not partings else (of_partings, of_rates)
    return Answer(
        findings=[lead[0], *support, *lead[1:]],
        n_lead=2,
        figures=_figures(study, [rate for rate in rates if rate.is_known]),
        method=_method(study),
    )


def _size(setting: PairSet) -> int:
    return int(setting.key["n"])


def _rate(study: Study, setting: PairSet) -> Rate | None:
    """The growth rate of starts displaced by the size that stands for a setting; None if none is small.

    The rate depends on the range that it is taken in: the longest stands for a setting.
    """
    rates = [
        _of_size(study, setting, comparison)
        for comparison in setting.comparisons
        if comparison.change.kind == START and comparison.change.size <= SMALL * CEILING
    ]
    order = [(rate.is_known, rate.e_fold.value is not None, rate.law.t_to - rate.law.t_from) for rate in rates]
    return rates[order.index(max(order))] if rates else None


def _of_size(study: Study, setting: PairSet, comparison: Comparison) -> Rate:
    """The growth rate of starts displaced by one size."""
    names, separations = study.data.table.own["member_id"].to_numpy(object), study.data.separations
    pairs = [
        (pair, separations[names[pair.changed]]) for pair in comparison.pairs if names[pair.changed] in separations
    ]
    pairs = [(pair, separation) for pair, separation in pairs if len(separation[0])]
    distances = [separation for _, separation in pairs]
    law = growth(
        max((t for t, _ in distances), key=len, default=np.zeros(0)),
        [distance for _, distance in distances],
        [pair.matrix for pair, _ in pairs],
        T_FROM * study.settings.time,
        LEAST * study.settings.time,
        (_floor(setting.key), CEILING),
        study.settings.confidence,
    )
    return Rate(setting, comparison.change.size, len(comparison.pairs), law, distances)


def _floor(key: Mapping[str, Any]) -> float:
    """The distance of two runs below which the errors of an engine and its settings hide it."""
    tolerances = [] if ENGINES[key["engine"]].is_exact else [key[name] or 0.0 for name in RELATIVE]
    return max([FLOOR, *(TOLERANCES * tolerance for tolerance in tolerances)])


def _partings(study: Study, setting: PairSet) -> Iterator[Parting]:
    """When half of the systems' copies have parted, for each change."""
    typical_gap = level(study, setting)
    if typical_gap is None:
        return
    t_end = float(setting.key["t_end"])
    followed, horizon = follow(study, setting.comparisons, typical_gap, t_end), study.settings.at(t_end)
    for comparison, pairs in zip(setting.comparisons, followed, strict=True):
        _, firsts = np.unique(pairs.matrix, return_index=True)  # of several draws: systems are the independent units
        has_parted = pairs.has_parted[firsts]
        times = np.where(has_parted, pairs.t[firsts], pairs.t_stop[firsts])
        n_grew = int(np.sum(~has_parted & (times < t_end)))
        n_systems = len(times)
        if n_grew < n_systems:
            half = median(times, has_parted, study.settings.confidence)
            n_left = n_systems - n_grew - int(has_parted.sum())
            together = Estimate(n_left / n_systems, *wilson(n_left, n_systems, study.settings.confidence))
            yield Parting(setting, comparison.change, pairs, half, together, n_systems, n_grew, horizon)


def _alike(partings: Sequence[Parting]) -> list[list[Parting]]:
    """Partings, where those of displaced starts of a setting of which none has parted are together."""

    def outcome(parted: Parting) -> object:
        is_open = parted.change.kind == START and not parted.pairs.has_parted.any()
        return (parted.setting.label, parted.n_grew) if is_open else id(parted)

    return [*by_key(partings, outcome).values()]


def _finding(alike: Sequence[Parting]) -> Lifetime | Share:
    """The median time until copies part, or the share still together, of changes that have the same outcome."""
    example, sizes = alike[0], listed([shown(parted.change.size) for parted in alike], "or")
    change = {
        CONSTANTS: f"all constants changed by up to {100 * example.change.size:g}%",
        START: f"starts moved by {sizes}",
        RATIOS: "other stiffness ratios",
    }[example.change.kind]
    where = Place.of(example.setting.label) + Place.words(f"with {change}")
    if example.n_grew:
        where += Place.words(f"{example.n_grew} of {example.n_systems} grew without limit first")
    basis = Basis(example.n_systems)
    if example.half.value is not None:
        return Lifetime(PARTED, example.half, where, basis=basis)
    n, predicate = sum(parted.n_systems for parted in alike), f"do not differ {HALF} up to t = {example.horizon}"
    return Share("together", "copies", predicate, example.together, where, basis=basis, n=n)


# ------------------------------------------------------------------------------------------------- figures


def _figures(study: Study, rates: Sequence[Rate]) -> dict[str, Picture]:
    if not rates:
        return {}
    caption = (
        "Lines rise where copies leave the original, and fall where they return: distance over initial distance, a"
        f" line a pair, up to a distance of {CEILING:g}. Heavy: the fitted rate, over its range."
    )
    colours = hues(study, [rate.setting.label for rate in rates])
    return {"growth": Picture(partial(distances, rates, colours, study.settings.units), caption)}


@panel(3.4)
def distances(ax: Axes, rates: Sequence[Rate], colours: Sequence[str], units: Units) -> None:
    """Distances of displaced runs from their base, over that at the start, on a logarithmic axis, with the fits."""
    sizes = sorted({rate.size for rate in rates})
    for rate, colour in zip(rates, colours, strict=True):
        form = ("-", "--", ":")[sizes.index(rate.size) % 3]
        for t, distance in rate.in_proportion:
            ax.plot(t, distance, form, color=colour, linewidth=0.5, alpha=0.5)
        label = f"{rate.setting.label}, initial distance {shown(rate.size)}"
        ax.plot(*rate.fit, form, color=colour, linewidth=2.2, label=label)
    ax.set(yscale="log", xlabel=units.label("time t", "time"), ylabel="distance / initial distance")
    ax.figure.legend(loc="outside lower center", ncols=1)


QUESTION = Question(answer, title="How fast do nearby runs part?", share=0.3)
