"""What sweeps and comparisons measure of runs: one registry, `SOURCES`, of what an ensemble may hold.

What the scene records comes first: the episodes, then every numeric column of a record, without a line here for any
of them. Mean n_stick and gamma are measured where nothing else is recorded, or where the scene asks for cascades.

A measure gives every unit two sums, and its value on some units is a statistic of the total of these sums: intervals
and differences are those of `analysis.contrast`. A run without a value is in no sum; `Values.missing` says why.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stickslip.analysis.catalogues import Catalogues, read
from stickslip.analysis.contrast import Bounded, MeanShare, Median, PerEvent, Share, Statistic
from stickslip.analysis.ensemble import Recorded, Study
from stickslip.analysis.findings.finding import Reason
from stickslip.analysis.findings.numbers import signs
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.episodes import QUANTITIES, RATE, SIZE
from stickslip.analysis.models.fates import DIVERGED, FAILED, SUSTAINED, UNMOVED, is_all_slip
from stickslip.analysis.models.magnitudes import b_rows, common_range
from stickslip.analysis.models.times import Times
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Undefined, UnitSums, per_event, ratio
from stickslip.analysis.stats.quantities import QUANTITIES as OF_N_STICK

MEAN, GAMMA = OF_N_STICK["mean"].label, OF_N_STICK["gamma"].label
MEAN_SLIPPING = "mean n_slip"  # which is compared where most blocks stick
MOST = 0.75  # of the blocks: of those that slip a difference is then three times as much, at least
MEAN_SIZE, B = "mean size of episodes", "b of episodes"
#: Names under which margins are declared.
KEYS = {MEAN: "mean", MEAN_SLIPPING: "mean", GAMMA: "gamma"}
#: Reasons, beside the outcomes of runs.
NO_VALUE, NO_EPISODE, STILL = "its record gives none", "no episode", "not in motion"
NOT_REACHED = "fewer than half of the runs have it"
SHORT_WINDOW = "short window"
OF_ONSETS = ("rate", "gamma")  # what counts slip onsets
LEAST_GAPS = 50  # per block: the scatter of random times that lie in a window of as many is 2% too small
CONTACTS = "n_contacts"  # the column of the number of blocks with friction


@dataclass(frozen=True)
class Values:
    """A measure's values on a group.

    Attributes
    ----------
    missing : dict of str to str
        Why a run has no value, by member_id: its outcome, or a reason.
    n_censored : int
        Of a time, runs that ended without it; they are no missing ones.
    withheld : str
        Why the group has no value although its runs have; empty if it has one.
    """

    sums: UnitSums = field(default_factory=UnitSums)
    missing: dict[str, str] = field(default_factory=dict)
    withheld: str = ""
    n_censored: int = 0


@dataclass(frozen=True)
class Measure:
    """A thing that is measured of runs.

    Attributes
    ----------
    key : str
        In names of figures.
    of : callable
        Maps a group to its `Values`.
    absent : str
        The reason in `Values.missing` of runs that have none by what they are; empty if all should have one.
    is_recorded : bool
        Whether it is what the scene records for its own sake; if nothing is, n_stick and gamma are all that is
        measured, and otherwise they are left out, unless the scene asks for cascades.
    """

    statistic: Statistic
    key: str
    of: Callable[[Group], Values]
    absent: str = ""
    is_recorded: bool = True

    @property
    def name(self) -> str:
        return self.statistic.name


def measures(study: Study, beside: Study | None = None) -> list[Measure]:
    """What is measured of a study, the first of which leads; `beside` is the study that it is compared with."""
    candidates = [measure for source in SOURCES for measure in source(study, beside)]
    is_of_cascades = "cascades" in study.settings.question  # then gamma leads what is not recorded
    if not any(measure.is_recorded for measure in candidates):
        chosen = [measure for measure in candidates if measure.name in KEYS]
    else:
        left_out = () if is_of_cascades else KEYS
        chosen = [measure for measure in candidates if measure.name not in left_out]
    return sorted(chosen, key=lambda measure: (not measure.is_recorded, measure.name != GAMMA * is_of_cascades))


# ------------------------------------------------------------------------------------------------- episodes


def _of_episodes(study: Study, beside: Study | None) -> Iterator[Measure]:
    """b, rate and mean size of episodes; b leads if most groups have it, those whose magnitudes have a power law."""
    if study.data.episodes is None or (beside is not None and beside.data.episodes is None):
        return
    by_label = {group.label: group for group in study.once(read)}
    studies = (study,) if beside is None else (study, beside)
    limits = common_range(group.law for data in studies for group in data.once(read))
    within = f" (M = {signs(f'{limits[0]:.1f} to {limits[1]:.1f}')})" if limits else ""
    shared = "the part of its range that all have" if limits else "a range of its own"
    definition = f"slope of a power law, on {shared}"
    statistic = Statistic(B, ratio, title=f"b-value of the episodes{within}", definition=definition)
    b = Measure(statistic, "episode_b", partial(_b, by_label, limits))
    is_led_by_b = 2 * sum(group.law.has_b for group in by_label.values()) > len(by_label)
    if is_led_by_b:
        yield b
    for name, key, things, definition in (
        (RATE, "episode_rate", "episodes", "" if study.settings.units else "per unit of time"),
        (SIZE, "episode_size", "", "in blocks that slip"),
    ):
        label, dimension = (MEAN_SIZE, "") if name == SIZE else (name, "frequency")
        statistic = Statistic(label, QUANTITIES[name].of, None, 0.0, "", definition, things, dimension)
        yield Measure(statistic, key, partial(_episodes, by_label, name))
    if not is_led_by_b:
        yield b


def _episodes(by_label: Mapping[str, Catalogues], name: str, group: Group) -> Values:
    """The sums of a quantity of episodes over the runs of a group that reached t_end."""
    missing = _unfinished(group)
    catalogues = by_label.get(group.label)
    if catalogues is None:
        return Values(missing=missing)
    units, rows, finished = list[int](), list[tuple[float, float]](), group.finished
    of_unit = {unit: iter(runs) for unit, runs in catalogues.runs.items()}  # in the order of the members
    for unit, member_id in zip(finished["unit"], finished["member_id"], strict=True):
        row = QUANTITIES[name].sums(next(of_unit[int(unit)]))
        if row[1] > 0:
            units.append(int(unit))
            rows.append(row)
        else:
            missing[str(member_id)] = NO_EPISODE
    return Values(UnitSums.of(units, rows), missing)


def _b(by_label: Mapping[str, Catalogues], limits: tuple[float, float] | None, group: Group) -> Values:
    """Sums of systems whose ratio is b, on limits that all groups have, or on the group's own."""
    missing = _unfinished(group)
    catalogues = by_label.get(group.label)
    if catalogues is None:
        return Values(missing=missing)
    if catalogues.basis.code == enough.DRIFTS:
        return Values(missing=missing, withheld="the rate of episodes drifts")
    if not catalogues.law.has_b:
        return Values(missing=missing, withheld=f"no power law is shown: {catalogues.law.why}")
    try:
        rows = b_rows(catalogues.law, [catalogues.magnitudes_of(unit) for unit in catalogues.runs], limits)
    except Undefined as problem:
        return Values(missing=missing, withheld=str(problem))
    return Values(UnitSums.of([*catalogues.runs], rows), missing)


def _unmeasured(group: Group, lacks: np.ndarray, problems: Mapping[str, str], reason: str) -> dict[str, str]:
    """Why some runs of a group have no value: they failed, or had a problem, or for a reason that all others have."""
    names, outcomes = (group.column(name)[lacks] for name in ("member_id", "outcome"))
    return {
        str(name): FAILED if outcome == FAILED else problems.get(name, reason)
        for name, outcome in zip(names, outcomes, strict=True)
    }


def _unfinished(group: Group) -> dict[str, str]:
    """The outcomes of the runs of a group that did not reach t_end."""
    names, outcomes = (group.column(name)[~group.is_finished] for name in ("member_id", "outcome"))
    return dict(zip(map(str, names), map(str, outcomes), strict=True))


# ---------------------------------------------------------------------------------------- columns of records


def _of_columns(study: Study, beside: Study | None) -> Iterator[Measure]:
    """Of every column of a record that holds numbers, the mean over runs, or what has to stand in its place.

    Of truths that is their share, of a time that the end of a run may cut off its median and its mean up to a limit,
    and of times between exits of a block their mean from the number of exits.

    A column that the analysis takes for itself, the growth rate, is measured too, but not as what the scene is about,
    and of the exact law alone, which it is of.
    """
    table = study.data.table
    is_smoothed = np.array([setting["eps"] is not None for setting in table.settings])
    for name, column in study.data.recorded.items():
        is_read = name in READ
        numbers = study.number(name)
        if is_read:
            numbers = np.where(is_smoothed[table.own["setting"]], np.nan, numbers)
        if (beside is not None and name not in beside.data.recorded) or (is_read and np.isnan(numbers).all()):
            continue
        if column.since is not None:
            yield from _of_times(study, beside, name, column)
        else:
            measure = _of_column(name, column, numbers, study.settings.t_burn)
            yield replace(measure, is_recorded=not is_read)


def _of_column(name: str, column: Recorded, numbers: np.ndarray, t_burn: float) -> Measure:
    called, definition = column.called or name, "" if column.says_it else column.words
    title = called if called.startswith("mean ") else f"mean {called}"
    values = partial(_column, numbers, column.problems, column.absent or NO_VALUE)
    if column.is_share:
        share = Share(f"share {name}", title=f"share of runs with {called}", definition=definition)
        return Measure(share, name, partial(_share, numbers, values), column.absent)
    if column.of_gaps == "mean":
        definition = "the time of all blocks with friction over the number of their slip onsets"
        per_exit = PerEvent(
            f"mean {name}", per_event, title="time per slip onset of a block", definition=definition, dimension="time"
        )
        return Measure(per_exit, name, _per_exit, STILL)
    mean = Statistic(f"mean {name}", ratio, least=column.least, title=title, definition=definition)
    mean = replace(mean, dimension=column.dimension)
    if column.most is not None:
        mean = MeanShare(f"mean {name}", ratio, most=column.most, title=title, definition=definition)
    return Measure(mean, name, partial(_of_gaps, values, t_burn) if column.of_gaps else values, column.absent)


def _column(numbers: np.ndarray, problems: Mapping[str, str], reason: str, group: Group) -> Values:
    return Values(group.sums_of(numbers), _unmeasured(group, ~np.isfinite(numbers[group.rows]), problems, reason))


def _share(numbers: np.ndarray, values: Callable[[Group], Values], group: Group) -> Values:
    has = numbers[group.rows]
    return replace(values(group), sums=_runs_with(group, has, np.isfinite(has)))


def _per_exit(group: Group) -> Values:
    """Exits per block with friction and unit of time of a unit's runs that may go on to exit, and 1.

    The mean time between exits of a block is one over it, however short the windows are. The mean of the times that
    lie in a window whole is too small, as long ones are cut off. A run that has not moved yet has no exit so far.
    """
    not_moved = np.asarray(group.fates == UNMOVED)
    goes_on = group.is_moving | not_moved
    none = UnitSums.of(group.members["unit"][not_moved], np.repeat([[0.0, 1.0]], not_moved.sum(), axis=0))
    exits = UnitSums.together([UnitSums(group.units, group.of("rate", "runs")), none])
    members = group.members[goes_on]
    n = float(group.key["n"])
    n_contacts = members[CONTACTS].fillna(n) if CONTACTS in members else np.full(len(members), n)
    contacts = UnitSums.of(members["unit"], np.column_stack([n_contacts, np.ones(len(members))]))
    rates = ratio(exits.rows) / ratio(contacts.rows)
    missing = _unmeasured(group, ~goes_on, {}, STILL)
    return Values(UnitSums(exits.units, np.column_stack([rates, np.ones(len(rates))])), missing)


def _of_gaps(column: Callable[[Group], Values], t_burn: float, group: Group) -> Values:
    """As a column, but withheld in short windows: the scatter of the times that lie in them whole is too small."""
    values, rates = column(group), _per_exit(group).sums.rows[:, 0]
    n_exits = (float(group.key["t_end"]) - t_burn) * float(rates.mean()) if len(rates) else 0.0
    if not len(values.sums) or n_exits >= LEAST_GAPS:
        return values
    return Values(missing=values.missing, withheld=f"fewer than {LEAST_GAPS} exits per block: long times are cut off")


def _of_times(study: Study, beside: Study | None, name: str, column: Recorded) -> Iterator[Measure]:
    """The median of a time that the end of a run may cut off, and its mean up to the longest time that all follow.

    The median leads if it is known wherever the time is, with its interval.
    """
    limit = study.limit(name) if beside is None else min(study.limit(name), beside.limit(name))
    called, words = column.called or name, column.words
    median = Median(f"median {name}", ratio, title=f"median {called}", definition=f"{words}, by Kaplan and Meier")
    median = replace(median, dimension="time")
    mean = Bounded(
        f"restricted mean {name}",
        ratio,
        most=limit,
        title=f"restricted mean of {'the ' * column.says_it}{called} up to {study.settings.at(limit)}",
        definition=f"{words}; the area up to {study.settings.at(limit)} under the curve of Kaplan and Meier",
        dimension="time",
    )
    median_and_mean = [
        Measure(median, f"{name}_median", partial(_median, study, name)),
        Measure(mean, name, partial(_restricted, study, name, limit)),
    ]
    medians = [study.median(group, name) for group in study.groups]
    is_known = all(None not in (median.value, median.low, median.high) for median in medians)
    yield from median_and_mean if is_known else median_and_mean[::-1]


def _median(study: Study, name: str, group: Group) -> Values:
    times, missing = _times(study, name, group)
    is_reached = times.median(study.settings.confidence).value is not None
    return Values(times, missing, "" if is_reached or not len(times) else NOT_REACHED, times.n_censored)


def _restricted(study: Study, name: str, limit: float, group: Group) -> Values:
    times, missing = _times(study, name, group)
    if not len(times):
        return Values(missing=missing)
    if not times.reaches(limit):
        return Values(missing=missing, withheld=f"no run was followed to {limit:g}", n_censored=times.n_censored)
    return Values(times.restricted(limit), missing, n_censored=times.n_censored)


def _times(study: Study, name: str, group: Group) -> tuple[Times, dict[str, str]]:
    """A time of the runs of a group, and why others have none: that it did not happen is no reason."""
    times, is_known = study.times(group, name)
    return times, _unmeasured(group, ~is_known, study.data.recorded[name].problems, NO_VALUE)


# ------------------------------------------------------------------------------------------------- n_stick


def _of_n_stick(study: Study, _: Study | None) -> Iterator[Measure]:
    """Mean n_stick and gamma of what is in motion; without gamma where episodes are recorded."""
    for measure in of_windows(study, ("mean", "gamma")):
        yield replace(measure, of=_mean if measure.key == "mean" else measure.of, is_recorded=False)


def _mean(group: Group) -> Values:
    return Values(UnitSums(group.units, group.by_unit("mean", "runs")))


def of_windows(study: Study, keys: Collection[str] = tuple(OF_N_STICK)) -> list[Measure]:
    """The quantities of n_stick, with the margins that the scene declares, over all runs in motion."""
    measured = []
    for key, quantity in OF_N_STICK.items():
        if key in keys and key in study.compared:
            statistic = Statistic(quantity.label, quantity.of, study.settings.margins.get(key), least=0.0)
            statistic = replace(statistic, title=quantity.title, things=quantity.things, dimension=quantity.dimension)
            if key == "mean" and statistic.margin is None and (n := _mostly_stuck(study)):
                title, things = "mean number of slipping blocks", "slipping blocks"
                statistic = replace(statistic, name=MEAN_SLIPPING, of=partial(_rest, n), title=title, things=things)
            measured.append(Measure(statistic, key, partial(_window_sums, key, study.settings.confidence)))
    return measured


def _mostly_stuck(study: Study) -> int:
    """The number of blocks if most of them stick at each setting, so that those that slip tell more; else 0."""
    n = {int(group.key["n"]) for group in study.groups}
    sums = [group.sums("mean").rows.sum(axis=0) for group in study.groups if group.n_runs]
    is_so = len(n) == 1 and bool(sums) and all(MOST < total / (min(n) * runs) <= 1 for total, runs in sums)
    return min(n) if is_so else 0


def _rest(n: int, rows: np.ndarray) -> np.ndarray:
    return n - ratio(rows)


def _window_sums(key: str, confidence: float, group: Group) -> Values:
    """The sums of a quantity; gamma is withheld where runs do not allow a statistic of a steady state."""
    if key in OF_ONSETS and not group.has_onsets:
        return Values(withheld=Reason.MERGED.value)
    if key == "gamma" and (basis := group.basis(confidence).code) not in enough.JUDGED:
        return Values(withheld=basis)
    is_short = key == "correlation_time" and 2 * group.n_short > group.n_runs
    return Values(group.sums(key), withheld=SHORT_WINDOW * is_short)


# --------------------------------------------------------------------------------------------- ends of runs


def _runs_with(group: Group, has: np.ndarray, known: np.ndarray) -> UnitSums:
    """Runs of each unit that have a property, and those of which that is known."""
    return UnitSums.of(group.column("unit").to_numpy()[known], np.column_stack([has, known])[known])


def _with_fate(fates: Collection[str], group: Group) -> Values:
    return Values(_runs_with(group, np.isin(group.fates, [*fates]), group.fates != FAILED))


def _without_late_stick(group: Group) -> Values:
    """Engines certify a collapse more or less often: what is seen in all is whether a block sticks late."""
    t_last, n_last = group.last.T
    has = (group.fates != DIVERGED) & is_all_slip(t_last, n_last, float(group.key["t_end"]))
    return Values(_runs_with(group, has, group.fates != FAILED))


#: Shares of runs by how they ended, by which engines and datasets are compared.
ALL_SLIP = Share("share of runs with no late stick", title="share of runs without a late stick")
RUN_AWAY = Share("share of runs that run away", title="share of runs that grow without limit")
ENDS = (
    Measure(ALL_SLIP, "all_slip", _without_late_stick),
    Measure(RUN_AWAY, "run_away", partial(_with_fate, (DIVERGED,))),
)
STICKING = "share of runs that stick late"
#: Whether runs still stick and slip, which is known of each that did not fail.
MOTION = Measure(
    Share(STICKING, title="share of runs still in stick-slip"), "motion", partial(_with_fate, (SUSTAINED,))
)

#: What an ensemble may hold that can be measured, in the order in which measures lead.
SOURCES: tuple[Callable[[Study, Study | None], Iterator[Measure]], ...] = (_of_episodes, _of_columns, _of_n_stick)
