"""How runs end, and how long stick-slip lasts.

Survival is by Kaplan and Meier. Certified runs, and those whose motion grew without limit, ended: see
`models.fates.ends_at`. Runs that slide without a certificate count as ended at their last events, and the
upper ends of intervals take them as going on; of shares see `Runs.may_be`. All others are censored at t_end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from stickslip.analysis import burn_in
from stickslip.analysis.answer import Answer, Picture, Question, places
from stickslip.analysis.by_key import by_key
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code, drift, uncertified
from stickslip.analysis.findings.finding import (
    Alike,
    Basis,
    Comparison,
    Difference,
    Finding,
    Lack,
    Level,
    Lifetime,
    Quantity,
    Reason,
    Regime,
    Scale,
    Share,
)
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.findings.words import based_on, listed
from stickslip.analysis.groups import Group
from stickslip.analysis.members import noun
from stickslip.analysis.models.attractors import ESCAPING, PERIODIC, SLIDING, UNDECIDED
from stickslip.analysis.models.fates import ENDS, FAILED, LULL, QUIET, is_unstable, survival
from stickslip.analysis.questions.runs import bifurcations, coexistence, fate_figures, portraits
from stickslip.analysis.questions.runs.settled import (
    MOST_LEADING,
    PREDICATES,
    Grid,
    Outcome,
    Portion,
    Setting,
    grid_of,
    portions,
    predicates,
    regimes,
    share_of,
    stretches,
    things,
    together,
    unit,
)
from stickslip.analysis.rows import frame_of
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.stats.survival import Curve, median_of_known
from stickslip.pipeline.design.labels import engine_noun

MOST_LINES = 12  # along a key, and settings with shares of their own
MOST_OPEN = 0.1  # of runs that may be undecided without an alert
LIFETIME = Quantity("lifetime", "median lifetime", more="longer", less="shorter", dimension="time")
TO_GROWTH = replace(LIFETIME, name="median time to unbounded growth")
TO_SLIDING = replace(LIFETIME, name="median time to sliding")
DELAY = Quantity("last_event", "median of the delays of the last event, {0} by {0}", dimension="time")
MEAN = Quantity("mean", "mean number of sticking blocks in runs still going")
PERIOD = Quantity("period", "period of the cycle", dimension="time")
METHOD = (
    "A run ends in steady sliding if it is proved that no block sticks again; without a proof it may, and intervals"
    " count such runs either way. A run is over at its last event if it slides at its end (unless it will stick"
    " again), or when its motion has grown without limit; survival and medians are Kaplan-Meier estimates."
)
METHOD_OF_ATTRACTORS = (
    "Each run is followed on from its end: a cycle repeats its events and comes back to its state, steady sliding and"
    " rest are proved, and small deviations grow at a steady rate in irregular motion. Shares have Wilson"
    " intervals with the effective number of independent runs."
)

METHOD_OF_ENDS = (
    "Steady sliding ends where an eigenvalue of the all-slip system crosses. A cycle is followed by Newton's method"
    " until its multiplier comes to 1 (instability), or a block just fails to stick (grazing), or it is not found."
    " Such ends do not depend on the length of runs; other stick-slip is followed from run to run. The last digit of"
    " an end is about as wide as the interval to which it is bisected (refine in the scene)."
)

#: What runs of a setting do, or when they end.
Ending: TypeAlias = Regime | Share | Alike | Lifetime


class Ends(NamedTuple):
    """The runs of a setting until they end: their survival, and when half of them have ended."""

    setting: Setting
    curve: Curve
    lifetime: Estimate

    @property
    def quantity(self) -> Quantity:
        """The median time to the end that its runs come to, or may have."""
        slides, grows = (np.isin(self.setting.runs.kinds, ends).any() for ends in ((SLIDING, QUIET), ESCAPING))
        return LIFETIME if slides and grows else TO_GROWTH if grows else TO_SLIDING


def answer(study: Study) -> Answer | None:
    """How the unchanged runs end and when, what they settle on, and whether what lasts is steady.

    None under adiabatic loading, which no run outlasts.
    """
    if study.data.is_loaded:
        return None
    grid = grid_of(study)
    ends = [_ends(study, setting) for setting in grid.settings if not setting.is_recorded]
    leading, further, secondary = _findings(study, grid, ends)
    several, each = coexistence.attracting(study, grid)
    boundaries = coexistence.boundaries(study, grid)
    first = [*several, *each] if each else several[:1]
    n_first = MOST_LEADING if each else len(first)
    leads = [*first[:n_first], *([] if each else leading)][:MOST_LEADING]
    behind = [finding for finding in (*leading, *further) if finding not in leads]
    lifetimes = [finding for finding in behind if isinstance(finding, Lifetime)]
    order = {str(setting.where): k for k, setting in enumerate(grid.settings)}
    ways = [finding for finding in behind if not isinstance(finding, Lifetime)]
    ways.sort(key=lambda finding: order.get(str(finding.where), -1))
    findings = [*leads, *first[n_first:], *([] if each else several[1:]), *ways, *lifetimes, *secondary]
    shares = [
        portion
        for setting in grid.settings
        for portion in portions(study, setting.runs, str(setting.where), study.settings.published)
    ]
    groups = [group for group in study.groups if len(burn_in.averaged(study, group))]
    groups.sort(key=lambda group: -int(group.key["n"]))
    tested = burn_in.geweke(study, groups)
    recorded = {group.label for setting in grid.settings if setting.is_recorded for group in setting.groups}
    is_short = {row.group for row in tested if row.is_short} - recorded
    short = [group for group in groups if group.label in is_short]
    by_t_burn = [row for group in short[:1] for row in burn_in.estimates(study, group)]
    of_fates = fate_figures.pictures(study, grid, {row.setting.where: row.curve for row in ends})
    diagrams, typical = bifurcations.pictures(study, grid, boundaries), portraits.pictures(study, grid)
    figures = {**of_fates, **diagrams, **typical}
    if each:  # of what attracts along a key the diagram first, then shares, if any setting has several
        is_mixed = any(len(setting.kinds) > 1 for setting in grid.settings)
        figures = {**diagrams, **of_fates, **typical} if is_mixed else {**diagrams, **typical, **of_fates}
    figures |= _along_t_burn(study, by_t_burn)
    return Answer(
        findings=findings or [Lack("what became of the runs", Reason.ALL_FAILED)],
        n_lead=len(leads),
        alerts=_alerts(study, grid, ends, short),
        method=" ".join(
            [METHOD_OF_ATTRACTORS] * bool(recorded) + [METHOD_OF_ENDS] * bool(boundaries) + [METHOD] * bool(ends)
        ),
        tables={
            "fates": frame_of(Portion, shares),
            "stability": frame_of(coexistence.Stability, coexistence.stability(study, grid)),
            "boundaries": frame_of(coexistence.Boundary, boundaries),
            "burn_in": frame_of(burn_in.Tested, tested),
            "by_t_burn": frame_of(burn_in.AtBurn, by_t_burn),
        },
        figures=figures,
    )


# ------------------------------------------------------------------------------------------------- findings


def _findings(study: Study, grid: Grid, ends: Sequence[Ends]) -> tuple[list[Ending], list[Ending], list[Finding]]:
    """What leads, the other outcomes and lifetimes, and what else there is to say.

    The outcomes of a method lead where they differ from those of the first, and so does the latest lifetime with an
    interval, unless all runs there end alike.
    """
    leading: list[Ending] = []
    further: list[Ending] = []
    methods = grid.methods
    outcomes = [{setting.label: setting.kinds for setting in settings} for settings in methods.values()]
    is_alike = len(methods) > 1 and all(places == outcomes[0] for places in outcomes)
    is_alike &= all(len(setting.kinds) < 2 for setting in grid.settings)  # shares differ between methods
    is_one = len({setting.kinds for setting in grid.settings}) == 1 and len(grid.settings[0].kinds) == 1
    reference = outcomes[0] if outcomes else {}
    for k, (method, settings) in enumerate(methods.items()):
        if k == 0 or not is_alike:
            where = Place.words("with every engine") if is_alike else Place.of(method)
            spoken = settings
            if is_alike and is_one:
                spoken, where = grid.settings, EVERYWHERE
            statements, details = _outcomes(study, grid, spoken, where)
            for finding, places in statements:
                is_new = k == 0 or any(reference.get(setting.label) != setting.kinds for setting in places)
                (leading if is_new else further).append(finding)
            further += details
        lifetimes = [row for row in ends if row.setting in settings and row.lifetime.value is not None]
        lifetimes.sort(key=lambda row: -(row.lifetime.value or 0.0))
        mixed = (row for row in lifetimes if len(settings) == 1 or len(row.setting.kinds) > 1)
        lead = next((row for row in mixed if row.lifetime.low is not None), None)
        leading += [_lifetime(study, row) for row in lifetimes if row is lead]
        further += [_lifetime(study, row) for row in lifetimes if row is not lead]
    with_ends = [row.setting for row in ends]
    secondary: list[Finding] = [*_delays(study), *_stability(study, with_ends)]
    return leading, further, [*secondary, *_means(study, with_ends)]


def _outcomes(
    study: Study, grid: Grid, settings: Sequence[Setting], method: Place
) -> tuple[Sequence[tuple[Regime | Share | Alike, Sequence[Setting]]], Sequence[Regime | Share | Alike]]:
    """What the runs of a method do, with the settings: shares where all do the same, else settings by outcome."""
    alike = {setting.kinds for setting in settings}
    if len(settings) == 1 or not grid.axes or (len(alike) == 1 and len(settings[0].kinds) < 2):
        shares = _shares(study, settings, method, MOST_LEADING)
        shares.sort(key=lambda finding: not isinstance(finding, Share))
        n_shares = sum(isinstance(finding, Share) for finding in shares)
        n_lead = min(n_shares, MOST_LEADING) if n_shares > 2 else 1  # of two, one says both
        return [(share, settings) for share in shares[:n_lead]], shares[n_lead:]
    top, *lines = grid.lines(settings)[:MOST_LINES]
    statements: list[tuple[Regime, Sequence[Setting]]] = []
    for line in [top, *lines[-1:], *lines[:-1]]:
        statements += regimes(study, grid, line, [setting.kinds for setting in line], method)
    kinds, exits = [setting.kinds for setting in top], [setting.exits for setting in top]
    if not lines and stretches(kinds) != stretches(exits):
        findings = [finding for finding, _ in statements]
        statements += [pair for pair in regimes(study, grid, top, exits, method) if pair[0] not in findings]
    mixed = [setting for setting in settings if len(setting.kinds) > 1][:MOST_LINES]
    said = {(places[0], finding.key) for finding, places in statements if len(places) == 1}
    details = [
        finding
        for setting in mixed
        for finding in _shares(study, [setting], setting.where)
        if isinstance(finding, Alike) or (setting, finding.key) not in said
    ]
    return statements, details


def _shares(study: Study, settings: Sequence[Setting], where: Place, most: int | None = None) -> list[Share | Alike]:
    """The share of each outcome at some settings, those with a published share and of most runs known first.

    Of more than so many outcomes, what the first ones leave is said together before the last of these.
    """
    published, runs = study.settings.published, together(settings)
    rows = portions(study, runs, besides=published)
    rows.sort(key=lambda row: (row.outcome not in published, row.outcome in (QUIET, UNDECIDED), -row.n_runs))
    n_cycles = sum(row.outcome == PERIODIC for row in rows)
    basis = Basis(len(np.unique(runs.units)), unit(study, settings))
    name = things(basis)
    findings: list[Share | Alike] = []
    is_other = np.full(len(runs.rows), True)
    for k, row in enumerate(rows, 1):
        if k == most and len(rows) > most:
            share = share_of(is_other, np.zeros(len(is_other)), runs.units, study.settings.confidence)
            kinds = dict.fromkeys(Outcome(other.outcome) for other in rows[k - 1 :])
            predicate = listed(predicates(study, [*kinds], settings), "or")
            findings.append(Share("others", name, predicate, share, where, None, basis, len(is_other)))
        (predicate,) = predicates(study, [Outcome(row.outcome)], settings)
        comparison = _beside(row, published.get(row.outcome))
        if row.outcome == PERIODIC and n_cycles > 1:
            cycle = "other cycles" if row.cycle is None else f"the cycle of period {row.period:.4g}"
            predicate, comparison = f"end on {cycle}", None
        findings.append(Share(row.outcome, name, predicate, row.share, where, comparison, basis, row.of))
        if row.cycle and n_cycles == 1 and row.period is not None and row.n_runs > 1:
            among = Basis(row.n_runs, name[:-1])
            findings.append(Alike(PERIOD, row.period, f"from all {based_on(among)}", where, among))
        is_other &= ~runs.in_outcome(row.outcome, row.cycle)
    return findings


def _beside(row: Portion, published: float | None) -> Comparison | None:
    """A share beside the one that the scene names as published."""
    if published is None or row.share.low is None or row.share.high is None:
        return None
    difference = row.share.under(lambda share: share - published)
    return Comparison(f"the published {100 * published:g}%", Difference(difference, Scale.ABSOLUTE))


def _lifetime(study: Study, row: Ends) -> Lifetime:
    basis = Basis(row.setting.n_units, unit(study, [row.setting]))
    return Lifetime(row.quantity, row.lifetime, row.setting.where, basis=basis)


def _delays(study: Study) -> Iterator[Level]:
    """How much later the last event of a system comes by another method than by the finest: medians over systems.

    Whether a certificate came in time makes no difference to an event, and systems are compared with themselves.
    """
    where = places(study)
    for reference, *methods in by_key(sorted(study.groups, key=fineness), lambda group: group.system).values():
        reference_times = _last_events(reference)
        for method in methods:
            delays = (_last_events(method) - reference_times).dropna().to_numpy()
            if len(delays):
                delay = median_of_known(delays, study.settings.confidence)
                beside, basis = Comparison(engine_noun(reference.key["engine"])), Basis(len(delays), noun(study.unit))
                quantity = replace(DELAY, name=DELAY.name.format(basis.unit))
                yield Level(quantity, delay, where[method.label], beside, basis)


def _last_events(group: Group) -> pd.Series:
    """The mean time of the last events of each unit's runs; NaN if one of them goes on, or failed."""
    times = np.where(np.isin(group.fates, (*ENDS, QUIET)), group.last[:, 0], np.nan)
    units, places = np.unique(group.column("unit").to_numpy(), return_inverse=True)
    return pd.Series(np.bincount(places, times) / np.bincount(places), units)


def _stability(study: Study, settings: Sequence[Setting]) -> Iterator[Share]:
    """What runs do whose state in which all blocks slip is linearly stable, and those of which it is unstable."""
    growth_rates = study.data.table.own["growth_rate"].to_numpy(np.float64)
    occurring = {kind for setting in settings for kind in setting.runs.kinds}
    for setting in settings:
        rates = growth_rates[setting.runs.rows]
        unstable = np.asarray(is_unstable(rates))
        for state, chosen, kind in (
            ("stable", ~np.isnan(rates) & ~unstable, SLIDING),
            ("unstable", unstable, ESCAPING),
        ):
            if chosen.any() and kind in occurring:
                name, key = f"runs with a linearly {state} all-slip state", f"{state}_{kind}"
                runs = setting.runs.at(chosen)
                share = share_of(runs.kinds == kind, runs.may_be(kind), runs.units, study.settings.confidence)
                basis = Basis(len(np.unique(runs.units)), noun(study.unit))
                yield Share(key, name, PREDICATES[kind], share, setting.where, None, basis, len(runs.rows))


def _means(study: Study, settings: Sequence[Setting]) -> list[Level]:
    """Mean n_stick of the runs still going, which include those that slide but will stick again."""
    groups = [group for setting in settings for group in setting.groups if study.unit != "start"]
    groups.sort(key=lambda group: -int(group.key["n"]))
    where, levels = places(study), list[Level]()
    for group in groups:
        mean, n_lull = group.mean(study.settings.confidence), int(np.sum(group.fates == LULL))
        if mean.value is not None:
            in_lull = Place.words(f"{n_lull} of {group.n_moving} runs slide but will stick again" * bool(n_lull))
            basis = Basis(len(group.units), noun(study.unit))
            levels.append(Level(MEAN, mean, where[group.label] + in_lull, None, basis))
    return levels


def _alerts(study: Study, grid: Grid, ends: Sequence[Ends], short: Sequence[Group]) -> list[Alert]:
    groups = [group for row in ends for group in row.setting.groups]
    n_failed = sum(int(np.sum(group.fates == FAILED)) for group in study.groups)
    n_runs = sum(len(row.setting.runs.rows) for row in ends)
    n_quiet, n_lull = (sum(row.setting.runs.n_of(kind) for row in ends) for kind in (QUIET, LULL))
    recorded = [setting.runs for setting in grid.settings if setting.is_recorded]
    n_open, n_recorded = sum(runs.n_of(UNDECIDED) for runs in recorded), sum(len(runs.rows) for runs in recorded)
    level = study.settings.confidence
    n_units = [
        group.moving["unit"].nunique()
        for group in groups
        if group.basis(level).code == enough.FEW_MATRICES and group.n_moving > 1
    ]
    drifting = drift("The number of sticking blocks", [group.label for group in short], study.settings.t_burn)
    raised = (
        (n_failed, Alert.of(Code.FAILED, n=n_failed, of=len(study.data.table.unchanged))),
        (short, drifting),
        (n_open > MOST_OPEN * n_recorded, Alert.of(Code.UNDECIDED, n=n_open, of=n_recorded)),
        (n_quiet, uncertified(n_quiet, n_runs, study.proofs)),
        (n_lull, Alert.of(Code.TEMPORARY, n=n_lull, of=n_runs)),
    )
    alerts = [alert for is_raised, alert in raised if is_raised]
    if n_units and n_units[0] > 1:
        alerts.append(Alert.of(Code.FEW, n=n_units[0], units=f"{noun(study.unit)}s"))
    return alerts[:3]


# ------------------------------------------------------------------------------------------------- runs


def _ends(study: Study, setting: Setting) -> Ends:
    """Until when the runs of a setting go on."""
    fates = np.concatenate([group.fates for group in setting.groups])
    t_last = np.concatenate([group.last for group in setting.groups])
    ran = fates != FAILED
    t_stop = study.data.table.own["t_stop"].to_numpy(np.float64, na_value=np.nan)[setting.runs.rows]
    t_end = np.full(len(t_stop), setting.t_end)
    runs = fates[ran], t_last[ran, 0], t_stop, t_end, study.settings.confidence, setting.runs.units
    return Ends(setting, *survival(*runs))


def _along_t_burn(study: Study, rows: Sequence[burn_in.AtBurn]) -> dict[str, Picture]:
    """Estimates of a group with other values of t_burn, if that with the chosen one has an interval."""
    if not any(row.is_chosen and row.value.low is not None for row in rows):
        return {}
    t_burn, level = study.settings.t_burn, 100 * study.settings.confidence
    caption = (
        f"The mean still changes after t_burn = {study.settings.at(t_burn)}: it is too short. Estimates with other"
        f" values, with {level:g}% intervals ({rows[0].group})."
    )
    return {"by_t_burn": Picture(partial(burn_in.by_t_burn, rows, t_burn), caption)}


def _leads(study: Study) -> bool:
    """Whether it is recorded what runs settle on, or most have ended."""
    members = study.data.table.own
    return "attractor" in members or bool(members["outcome"].isin(ENDS).mean() > 0.5)


QUESTION = Question(
    answer,
    title="How do runs end?",
    share=0.01,
    rank=2,
    leads=_leads,
    beside=lambda study: () if coexistence.is_asked(study) else ("changes",),
)
