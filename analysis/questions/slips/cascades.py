"""The law of cascade sizes: its decay rate beside those of three nulls, and whether it is geometric.

The nulls are the geometric distribution with p = 1/2, whose rate is ln 2, independent two-state blocks
(`models.pool`) and the runs' own blocks, shifted in time (`series.nulls`). The variance of the sizes says how near to
geometric they are (`stats.dispersion`), and the likelihood whether they are nearer to that than to a power law.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stickslip.analysis.answer import Answer, Picture, Question, Recipe, lack, places
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code, drift, uncertified
from stickslip.analysis.findings.finding import (
    Basis,
    Comparison,
    Difference,
    Family,
    Finding,
    Fit,
    Form,
    Lack,
    Law,
    Level,
    Parts,
    Quantity,
    Reason,
)
from stickslip.analysis.findings.numbers import signs, with_interval
from stickslip.analysis.findings.place import Place
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, noun
from stickslip.analysis.models import fates, pool
from stickslip.analysis.questions.runs.engines import between_engines
from stickslip.analysis.questions.slips import cascade_definitions, cascade_figures
from stickslip.analysis.questions.slips.cascade_figures import Size
from stickslip.analysis.rows import Columns, frame_by, frame_of
from stickslip.analysis.series import nulls
from stickslip.analysis.series.cascades import spans
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats import enough, estimates, student
from stickslip.analysis.stats.compare import Compared, against
from stickslip.analysis.stats.components import between
from stickslip.analysis.stats.dispersion import excess, moments
from stickslip.analysis.stats.estimates import LN2, Estimate, Statistic, Undefined, over_matrices, ratio, within
from stickslip.analysis.stats.families import EXPONENTIAL, POWER_LAW, log_shares, maximise
from stickslip.analysis.stats.multiplicity import together
from stickslip.analysis.stats.shares import mean_within
from stickslip.analysis.style import forest
from stickslip.pipeline.design.labels import Label, apart, engine_noun

SHIFTS = 30  # most draws of a run's blocks shifted in time, whose rate is then known better than the run's
PARTS = 10  # of a run, whose scatter gives the interval of its system
MOST_DRAWN = 2  # groups in a figure
COIN, TWO_STATE, SHIFTED = "ln 2", "independent two-state blocks", "time-shifted blocks"
GEOMETRIC = "a geometric distribution"
RATE = Quantity(
    "gamma", "decay rate of cascade sizes", definition="γ of f ∝ exp(−γ s), the share of cascades of s blocks"
)
BESIDE = replace(RATE, clause="the decay rate is {}")  # said after the law, which has its value
EXCESS = Quantity("excess", "excess of the decay rate over ln 2", Form.SHARE)
EFFECTS = (
    Quantity("finite_size", "finite size", Form.SHARE),
    Quantity("own_dynamics", "each block's own dynamics", Form.SHARE),
    Quantity("coupling", "coupling", Form.SHARE),
)
VARIANCE = Quantity("variance", "variance of cascade sizes")


@dataclass(frozen=True)
class Sums:
    """What the runs of a group add up to, one row a system that has cascades.

    Attributes
    ----------
    smallest : int
        The least size that counts, as 1.
    rows : ndarray, shape (G, 8)
        `dispersion.moments` of the sizes, in the runs and with their blocks shifted in time (0 if that is not known);
        integral of n_stick, and time.
    parts : ndarray, shape (G or 0, PARTS, 2)
        Total size and number of cascades in each part of the runs; none if that was not asked.
    counts : ndarray, shape (G, K)
        Number of cascades of each size from the smallest on.
    """

    group: Group
    smallest: int
    rows: np.ndarray
    parts: np.ndarray
    counts: np.ndarray

    @property
    def n(self) -> int:
        """Number of blocks."""
        return int(self.group.key["n"])

    @property
    def is_shifted(self) -> bool:
        """Whether it is known which block slips when, so that blocks can be shifted in time."""
        return bool(self.rows[:, 3].all()) and len(self.rows) > 0

    @property
    def pool_mean(self) -> float | None:
        """Mean n_stick of two-state blocks to compare with; None if there are no such blocks."""
        mean = self.group.pool_mean
        return mean if self.smallest == 1 and pool.is_one(self.n, mean) else None

    def estimate(self, of: Statistic, confidence: float) -> Estimate:
        """A statistic of the rows, with its interval over systems."""
        return over_matrices(of, self.rows, confidence)


# ---------------------------------------------------------------------------------- statistics of rows of `Sums`


def gamma(rows: np.ndarray) -> np.ndarray:
    """Decay rate of sizes, from their moments in the first three columns."""
    return estimates.gamma(rows[:, [1, 0]])


def gamma_shifted(rows: np.ndarray) -> np.ndarray:
    """Decay rate of blocks shifted in time."""
    return gamma(rows[:, 3:6])


def over_coin(rate: Statistic, rows: np.ndarray) -> np.ndarray:
    """A decay rate relative to ln 2, less 1."""
    return rate(rows) / LN2 - 1


def over_shifted(rows: np.ndarray) -> np.ndarray:
    """Decay rate relative to that of blocks shifted in time, less 1."""
    return gamma(rows) / gamma_shifted(rows) - 1


def mean_n_stick(rows: np.ndarray) -> np.ndarray:
    """The mean n_stick."""
    return ratio(rows[:, 6:8])


def of_pool(n: int, rows: np.ndarray, number: Callable[[int, float], float] = pool.gamma) -> np.ndarray:
    """A number of n independent two-state blocks of which as many stick; undefined if all or none always stick."""
    means = mean_n_stick(rows)
    if not all(pool.is_one(n, mean) for mean in means):
        raise Undefined("all blocks always stick, or always slip")
    return np.array([number(n, mean) for mean in means])


def variance(rows: np.ndarray) -> np.ndarray:
    """Variance of the sizes, from their moments in the first three columns."""
    n, total, squares = rows[:, :3].T
    return (squares / n - (total / n) ** 2) * (n + 1) / (n - 1)


def over_geometric(rows: np.ndarray) -> np.ndarray:
    """Variance of the sizes relative to a geometric distribution's with their mean, less 1."""
    return excess(rows[:, :3])


def gain(sums: Sums, confidence: float) -> Estimate:
    """By how much a geometric law up to n blocks is likelier than a power law, in nats per cascade (Vuong 1989)."""
    sizes = np.arange(sums.smallest, max(sums.n, sums.smallest + 1) + 1, dtype=np.float64)
    pooled = np.zeros(len(sizes))
    n_seen = min(sums.counts.shape[1], len(sizes))
    pooled[:n_seen] = sums.counts.sum(axis=0)[:n_seen]
    try:
        fits = [maximise(family, sizes, pooled) for family in (EXPONENTIAL, POWER_LAW)]
    except Undefined as undefined:
        return Estimate(reason=str(undefined))
    exponential, power = (log_shares(fit.family, sizes, fit.theta)[:n_seen] for fit in fits)
    total = sums.counts[:, :n_seen] @ (exponential - power)
    return over_matrices(ratio, np.column_stack([total, sums.counts.sum(axis=1)]), confidence)


# ------------------------------------------------------------------------------------------------- the question


def answer(study: Study) -> Answer:
    """How cascade sizes fall off, beside what three nulls would give."""
    level = study.settings.confidence
    sums: dict[str, Sums] = {group.label: _sums(study, group) for group in study.groups if group.has_onsets}
    judged = [group for group in study.judged() if group.label in sums]
    if not judged and study.judged():
        return Answer(findings=[Lack("the decay rate of cascade sizes", Reason.MERGED)])
    with_rate = [entry for group in judged if (entry := sums[group.label]).estimate(gamma, level).low is not None]
    with_rate.sort(key=lambda entry: not entry.group.is_exact)
    # blocks are shifted where it is said what that gives
    alike = [_in_parts(study, entry) for entry in with_rate if _engine(entry) == _engine(with_rate[0])]
    sums |= {entry.group.label: entry for entry in alike}
    sizes: dict[str, list[Size]] = {label: _sizes(entry, level) for label, entry in sums.items()}
    tables = {
        "law": frame_by(_law(level), sums.values()),
        "sizes": frame_of(Size, [size for of_group in sizes.values() for size in of_group]),
    }
    drifting = _drifting(study, judged, sums)
    if not judged:
        missing: Finding = drifting or lack(study, "the decay rate of cascade sizes")
        alerts = [] if drifting is None else [_drift(study)]
        return Answer(findings=[missing], alerts=alerts, tables=tables, method=_method(study))
    if not alike:
        return Answer(findings=[Lack("the decay rate of cascade sizes", Reason.ONE_VALUE)], tables=tables)
    lead, where = alike[0], places(study)
    rates, *of_others = _rates(study, alike, where)
    leading = _findings(study, lead, where[lead.group.label], rates)
    findings = [rate for of_setting in of_others for rate in of_setting]
    findings.sort(key=lambda rate: rate.quantity is not RATE)  # beside ln 2 first
    definitions = cascade_definitions.compared(study, lead.group)
    return Answer(
        findings=[*([] if drifting is None else [drifting]), *leading, *findings],
        n_lead=min(3, len(leading) + (drifting is not None)),
        alerts=_alerts(study, lead),
        tables={**tables, **definitions.tables},
        figures={**_figures(study, lead, with_rate, sizes), **definitions.figures},
        method=_method(study, lead),
    )


def _method(study: Study, lead: Sums | None = None) -> str:
    smallest = study.settings.smallest
    is_forced = lead is not None and lead.group.shift_unit != 0
    by = "random number of periods of the force" if is_forced else "random time"
    shifted = f"each shifted by a {by}, {min(study.settings.resamples, SHIFTS)} draws per run"
    if lead is not None and is_forced and not lead.is_shifted:
        shifted = Reason.NO_SHIFT.value
    return (
        "A cascade is a run of slip onsets with no arrest in between, and s is their number. The geometric "
        f"distribution f ∝ exp(−γ s){f' from {smallest} on' * (smallest > 1)} is fitted by maximum likelihood, with "
        f"intervals over {noun(study.unit)}s; with p = 1/2, γ is ln 2. Three effects shift γ from there and may "
        "cancel: finite size, alone in independent two-state blocks (as many, without memory, the same mean number "
        "sticking); each block's own dynamics, also in time-shifted blocks "
        f"({shifted}); coupling, in the runs alone."
    )


def _drifting(study: Study, judged: Sequence[Group], sums: Mapping[str, Sums]) -> Level | None:
    """The decay rate of what leads although n_stick drifts: exact runs, where no other exact runs have one."""
    if any(group.is_exact for group in judged):
        return None
    level = study.settings.confidence
    groups = (entry.group for entry in sums.values() if entry.group.is_exact or not judged)
    drifts = [group for group in groups if group.basis(level).code == enough.DRIFTS]
    lead = min(drifts, key=lambda group: (not group.is_exact, -int(group.key["n"])), default=None)
    if lead is None or (rate := sums[lead.label].estimate(gamma, level)).low is None:
        return None
    return Level(RATE, rate, places(study)[lead.label], basis=Basis(len(sums[lead.label].rows), noun(study.unit)))


def _drift(study: Study) -> Alert:
    """That n_stick drifts in some groups."""
    level = study.settings.confidence
    drifting = [group.label for group in study.groups if group.basis(level).code == enough.DRIFTS]
    return drift("The number of sticking blocks", drifting, study.settings.t_burn)


def _engine(sums: Sums) -> list[object]:
    return [sums.group.key[name] for name in ENGINE_KEYS]


def _sums(study: Study, group: Group) -> Sums:
    """What the counts of a group say."""
    smallest = study.settings.smallest
    counts = group.counts[:, smallest - 1 :]
    rows = np.hstack([moments(counts), np.zeros((len(counts), 3)), group.stuck])
    has_data = counts.sum(axis=1) > 0
    return Sums(group, smallest, rows[has_data], np.zeros((0, PARTS, 2)), counts[has_data])


def _in_parts(study: Study, sums: Sums) -> Sums:
    """With what runs say by parts, and with their blocks shifted in time."""
    n_columns, draws = 3 + 2 * PARTS, min(study.settings.resamples, SHIFTS) * study.can_shift(sums.group)
    totals = study.sums(sums.group, partial(_of_run, sums.smallest, draws), n_columns)
    totals = totals[sums.group.counts[:, sums.smallest - 1 :].sum(axis=1) > 0]
    rows = np.hstack([sums.rows[:, :3], totals[:, :3], sums.rows[:, 6:]])
    return replace(sums, rows=rows, parts=totals[:, 3:n_columns].reshape(-1, PARTS, 2))


def _of_run(least: int, draws: int, run: Run) -> np.ndarray:
    """`cascades.moments` of a run's blocks shifted in time, and total size and number of cascades in parts of it."""
    shifted = np.zeros(3)
    if run.shiftable is not None:
        shifted = nulls.moments(run.shiftable, draws, run.generator(), least)
    cascades = spans(run.win)
    size = cascades.size - (least - 1)
    places = (PARTS * (cascades.start - run.win.t_start) / (run.win.t_stop - run.win.t_start)).astype(np.int64)
    columns = [np.bincount(places[size > 0], weights[size > 0], PARTS) for weights in (size, np.ones(len(size)))]
    return np.concatenate([shifted, np.column_stack(columns).ravel()])


# ------------------------------------------------------------------------------------------------- findings


def _rates(study: Study, alike: Sequence[Sums], where: Mapping[str, Place]) -> list[list[Level]]:
    """The decay rates beside ln 2 and, as far as known, those of shifted and of two-state blocks.

    Differences of several settings from one of these are judged together.
    """
    level, margin = study.settings.confidence, study.settings.margins.get("gamma")
    rates = [list[Level]() for _ in alike]
    for null in (COIN, SHIFTED, TWO_STATE):
        tests = [_test(null, sums) for sums in alike]
        p_values = together(test if test is None else test.p_different for test in tests)
        n_tests = sum(p is not None for p in p_values)
        for sums, test, p, of_setting in zip(alike, tests, p_values, rates, strict=True):
            if test is None or p is None:
                continue
            size = Estimate(test.difference, *test.interval(level))
            difference = Difference(size, margin=margin, family=Family(n_tests, p, 1 - level))
            rate, place = sums.estimate(gamma, level), where[sums.group.label]
            basis = Basis(len(sums.rows), noun(study.unit))
            quantity = RATE if null == COIN else BESIDE
            of_setting.append(Level(quantity, rate, place, Comparison(null, difference), basis))
    return rates


def _test(null: str, sums: Sums) -> Compared | None:
    """How far the decay rate lies from that of a null, relative to it; None where there is no such null."""
    statistics: dict[str, Statistic] = {COIN: partial(over_coin, gamma)}
    if sums.is_shifted:
        statistics[SHIFTED] = over_shifted
    if sums.pool_mean is not None:
        statistics[TWO_STATE] = lambda rows: gamma(rows) / of_pool(sums.n, rows) - 1
    try:
        return against(statistics[null], sums.rows) if null in statistics else None
    except Undefined:
        return None


def _findings(study: Study, sums: Sums, where: Place, rates: Sequence[Level]) -> list[Finding]:
    """The law of a group, its decay rate beside other blocks', and how far it is from geometric."""
    level = study.settings.confidence
    rate, *further = rates
    beside_geometric = within(sums.estimate(over_geometric, level), -1.0)
    geometric = Comparison(GEOMETRIC, Difference(beside_geometric))
    departure = Level(VARIANCE, within(sums.estimate(variance, level), 0.0), where, geometric, rate.basis)
    fit = fit_of(gain(sums, level), beside_geometric)
    law = Law("cascade sizes", "fall off geometrically", rate, fit, departure, "fall off nearly geometrically",
              called="decay rate")  # fmt: skip
    methods = _beside_others(study, sums)
    split = []
    if len(further) == len(EFFECTS) - 1:
        split.append(
            sum_of({name: sums.estimate(of, level) for name, of in effects(sums.n).items()}, where, rate.basis)
        )
    return [law, *split, *methods[:1], *further, departure, *methods[1:]]


def effects(n: int) -> dict[str, Statistic]:
    """`EXCESS` and `EFFECTS` of n blocks by their keys, as `_method` says."""
    rates = gamma, gamma_shifted, partial(of_pool, n)
    excess, own, finite_size = (partial(over_coin, rate) for rate in rates)
    return {
        "excess": excess,
        "finite_size": finite_size,
        "own_dynamics": lambda rows: own(rows) - finite_size(rows),
        "coupling": lambda rows: excess(rows) - own(rows),
    }


def sum_of(estimates: Mapping[str, Estimate], where: Place, basis: Basis | None) -> Parts:
    """The excess of the decay rate as the sum of its parts."""
    excess, *parts = (Level(quantity, estimates[quantity.key], where, basis=basis) for quantity in (EXCESS, *EFFECTS))
    return Parts(excess, tuple(parts), "decay rate")


def _beside_others(study: Study, sums: Sums) -> list[Level]:
    """The decay rate by other engines or their settings beside that of a group, the largest difference first."""
    label, where, unit = sums.group.label, places(study), noun(study.unit)
    steps = [step for step in between_engines(study, "gamma") if step.reference == label and sums.smallest == 1]
    steps.sort(key=lambda step: step.contrast.weight, reverse=True)
    name = engine_noun(sums.group.key["engine"])
    levels = (step.contrast.level(where[step.setting], name, unit) for step in steps)
    return [replace(level, quantity=BESIDE) for level in levels]


def fit_of(gain: Estimate, departure: Estimate) -> Fit:
    """Whether sizes are nearer to a geometric law than to a power law, by their likelihood.

    Where that cannot be told, the law fails if it is shown that they do not vary as it says.
    """
    if gain.low is not None and gain.low > 0.0:
        return Fit.CLOSE
    is_power_law = gain.high is not None and gain.high < 0.0
    departs = departure.low is not None and departure.high is not None and departure.low * departure.high > 0.0
    return Fit.FAILS if is_power_law or departs else Fit.OPEN


def of_systems(parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decay rate of each system and its standard error from leaving out one part of its run at a time, shape (G,).

    NaN where there is none.
    """

    def rate(sums: np.ndarray) -> np.ndarray:
        total, n = np.moveaxis(sums, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            rates = -np.log1p(-n / total)
        return np.where(np.isfinite(rates), rates, np.nan)

    over_parts = parts.sum(axis=1, keepdims=True)
    left_out = rate(over_parts - parts)
    off = left_out - left_out.mean(axis=1, keepdims=True)
    return rate(over_parts)[:, 0], np.sqrt((PARTS - 1) / PARTS * np.sum(off**2, axis=1))


def _alerts(study: Study, lead: Sums) -> list[Alert]:
    """How runs of the lead ended that have no cascades, where motion grew without limit, where n_stick drifts."""
    level, ends, n_runs = study.settings.confidence, lead.group.fates, len(lead.group)
    n = {fate: int(np.count_nonzero(ends == fate)) for fate in (fates.COLLAPSED, fates.QUIET)}
    grown = [group for group in study.groups if fates.DIVERGED in group.fates]
    n_grown = sum(int(np.count_nonzero(group.fates == fates.DIVERGED)) for group in grown)
    which = grown[0].label if len(grown) == 1 else f"{len(grown)} settings"
    where = f" at {which}" * (len(study.groups) > 1)
    alerts = [
        Alert.of(Code.SETTLED, n=n[fates.COLLAPSED], of=n_runs, what="the law of cascade sizes"),
        Alert.of(Code.DIVERGED, n=n_grown, of=sum(map(len, grown)), where=where),
        uncertified(n[fates.QUIET], n_runs, study.proofs),
    ]
    raised = [alert for alert in alerts if dict(alert.numbers)["n"]]
    if any(group.basis(level).code == enough.DRIFTS for group in study.groups):
        raised.insert(0, _drift(study))
    return raised[:3]


# ------------------------------------------------------------------------------------------------- tables and figures


def _law(level: float) -> Columns[Sums]:
    """Of the table `law`: variances are over a geometric distribution's, the least size counts as 1."""
    return {
        "group": (str, lambda sums: sums.group.label),
        "n": (int, lambda sums: sums.n),
        "n_matrices": (int, lambda sums: len(sums.rows)),
        "n_cascades": (int, lambda sums: sums.rows[:, 0].sum()),
        "smallest": (int, lambda sums: sums.smallest),
        "gamma": (Estimate, lambda sums: sums.estimate(gamma, level)),
        "gamma_pool": (float, lambda sums: sums.pool_mean and pool.gamma(sums.n, sums.pool_mean)),
        "gamma_shifted": (float, lambda sums: sums.estimate(gamma_shifted, level).value if sums.is_shifted else None),
        "over_shifted": (
            Estimate,
            lambda sums: sums.estimate(over_shifted, level) if sums.is_shifted else Estimate(),
        ),
        "variance": (Estimate, lambda sums: sums.estimate(lambda rows: 1 + over_geometric(rows), level)),
        "basis": (str, lambda sums: sums.group.basis(level).code),
    }


def _sizes(sums: Sums, confidence: float) -> list[Size]:
    """Share of each size with its interval over systems, fitted, and of two-state blocks."""
    totals, rate, mean = sums.counts.sum(axis=1), sums.estimate(gamma, confidence).value, sums.pool_mean
    two_state = None if mean is None else pool.law(sums.n, mean, sums.counts.shape[1])
    return [
        Size(
            sums.group.label,
            k + sums.smallest,
            int(column.sum()),
            mean_within(np.column_stack([column, totals]).astype(float), 1.0, confidence),
            None if rate is None else float(-np.expm1(-rate) * np.exp(-rate * k)),
            None if two_state is None else float(two_state[k]),
        )
        for k, column in enumerate(sums.counts.T if len(totals) else [])
    ]


def _figures(
    study: Study, lead: Sums, with_rate: Sequence[Sums], sizes: Mapping[str, list[Size]]
) -> dict[str, Picture]:
    level, burn = study.settings.confidence, f"t = {study.settings.at(study.settings.t_burn)}"
    rate, system = lead.estimate(gamma, level), noun(study.unit)
    values, errors = of_systems(lead.parts)
    values, errors = values[np.isfinite(errors)], errors[np.isfinite(errors)]
    half = student.half_width(level, PARTS - 1) * errors
    of_each = [Estimate(*ends) for ends in np.column_stack([values, values - half, values + half])]
    curves = [entry for entry in with_rate if entry.n == lead.n][:MOST_DRAWN]
    labels: Sequence[Label] = apart([sums.group.label for sums in curves])
    of_which = f" ({labels[0]})" if labels[0] else ""
    lasting, scatter = between(values, errors, PARTS - 1, level), ""
    if lasting.value is not None:
        share = with_interval(lasting if lasting.low else Estimate(high=lasting.high), Form.SHARE)
        differ = "differ" if lasting.low else "are not shown to differ"
        scatter = f" The {system}s {differ} beyond sampling error ({share} of the variance)."
    laws = {
        str(label or lead.group.label): sizes[curve.group.label] for label, curve in zip(labels, curves, strict=True)
    }
    example, largest, draw_run = _first_run(study, lead.group)
    where = signs(places(study)[lead.group.label].tail)
    below = " Below: the same relative to p = 1/2." * cascade_figures.is_split(laws)
    count = f" {len(curves)} of {len(with_rate)} settings are drawn." * (len(curves) < len(with_rate))
    dotted = " dotted: independent two-state blocks;" * (lead.pool_mean is not None)
    see = cascade_figures.departure(next(iter(cascade_figures.shown(laws).values())), of_which)
    enlarged = f" slip onsets with no arrest in between: the largest cascade of this run after {burn}, enlarged. "
    cascade = f"{largest.size}{enlarged}" if largest else ""
    return {
        "size_law": Picture(
            partial(cascade_figures.size_law, laws, rate),
            f"{see}Share of cascades of each size. Line and band: the fitted geometric distribution with its"
            f" {level:.0%} interval;{dotted} bars: intervals of the shares.{below}{count}",
        ),
        "decay_rates": Picture(
            partial(forest, of_each, rate, "decay rate", (LN2, COIN)),
            f"{np.sum(values > LN2)} of {len(of_each)} estimates{of_which} lie above {COIN} (dashed), the decay rate"
            f" if slip onset and arrest were equally likely at each event. Decay rate of each {system}, its interval"
            f" from {PARTS} parts of its run, and of all together (diamond, band).{scatter}",
        ),
        "one_run": Picture(draw_run, f"{cascade}Line: the run of {system} {example}{where}. Grey: before t_burn."),
    }


def _first_run(study: Study, group: Group) -> tuple[str, cascade_figures.Largest | None, Recipe]:
    """Unit of the first run of a group, its largest cascade, and what draws it."""
    _, member_id, win = next(iter(study.windows(group)))
    cascades = spans(win)
    largest = None
    if len(cascades.size):
        k = int(np.argmax(cascades.size))
        largest = cascade_figures.Largest(int(cascades.size[k]), float(cascades.start[k]), float(cascades.stop[k]))
    t, n_stick = study.runs.points(member_id)
    of_run = t, n_stick, win.t_stop, study.settings.t_burn, largest, study.settings.units
    return study.data.table.unit_of(member_id), largest, partial(cascade_figures.one_run, *of_run)


QUESTION = Question(
    answer,
    "How do cascade sizes fall off?",
    share=0.2,
    of_cascades=True,
    rank=5,
    beside=lambda _: ("collective", "fates"),
)
