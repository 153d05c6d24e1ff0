"""What sweeps and comparisons measure of runs: one registry, `SOURCES`, of what an ensemble may hold.

What the scene records comes first: the episodes, then every numeric column of a record, without a line here for any
of them. Mean n_stick and gamma are measured where nothing else is recorded, or where the scene asks for cascades.

A measure gives every unit two sums, and its value on some units is a statistic of the total of these sums: intervals
and differences are those of `analysis.contrast`. A run without a value is in no sum; `Values.missing` says why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stickslip.analysis import contrast
from stickslip.analysis.catalogues import ONE_MOMENT, Catalogues, has_b, read
from stickslip.analysis.contrast import Bounded, Median, PerEvent, Share, Statistic
from stickslip.analysis.ensemble import Recorded, Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.episodes import ATOM, B_VALUE, QUANTITIES, RATE, SIZE
from stickslip.analysis.models.fates import FAILED, UNMOVED
from stickslip.analysis.models.times import Times
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import UnitSums, per_event, ratio
from stickslip.analysis.stats.quantities import QUANTITIES as OF_N_STICK

MEAN, GAMMA = OF_N_STICK["mean"].label, OF_N_STICK["gamma"].label
MEAN_SIZE, B = "mean size of episodes", "b of episodes"
#: Names under which margins are declared.
KEYS = {MEAN: "mean", GAMMA: "gamma"}
#: Reasons, beside the outcomes of runs.
NO_VALUE, NO_EPISODE, STILL = "its record gives none", "no episode", "not in motion"
NOT_REACHED = "fewer than half of the runs have it"
LEAST_GAPS = 50  # per block: the scatter of random times that lie in a window of as many is 2% too small
CONTACTS = "n_contacts"  # the column of the number of blocks with friction


@dataclass(frozen=True)
class Values:
    """A measure's values on a group.

    Attributes
    ----------
    sums : UnitSums
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
    statistic : Statistic
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
    found = [one for source in SOURCES for one in source(study, beside)]
    if not any(one.is_recorded for one in found):
        return [one for one in found if one.name in KEYS]
    left_out = () if "cascades" in study.settings.question else KEYS
    return sorted((one for one in found if one.name not in left_out), key=lambda one: not one.is_recorded)


# ------------------------------------------------------------------------------------------------- episodes


def _of_episodes(study: Study, beside: Study | None) -> Iterator[Measure]:
    """Rate, mean size and b of episodes.

    b is taken from the largest of the least magnitudes of the groups that have enough episodes, or, where that leaves
    one of them too few, from each group's own. A group has a b only where its law holds for all its episodes, as on
    the page of episodes.
    """
    if study.data.episodes is None or (beside is not None and beside.data.episodes is None):
        return
    found = read(study, study.data.episodes)
    rivals = [] if beside is None or beside.data.episodes is None else read(beside, beside.data.episodes)
    full = [one for one in (*found, *rivals) if one.n_from(one.least) >= enough.LEAST_CASCADES]
    least = max((one.least for one in full), default=None)
    if least is not None and any(one.n_from(least) < enough.LEAST_CASCADES for one in full):
        least = None
    by_label = {one.label: one for one in found}
    beyond = "from each point's own least magnitude on" if least is None else f"from M = {least:.2f} on"
    for name, quantity, key, title, definition in (
        (RATE, RATE, "episode_rate", "", "per unit of time"),
        (MEAN_SIZE, SIZE, "episode_size", "", "in blocks that slip"),
        (B, B_VALUE, "episode_b", "b-value of the episodes", f"by Aki {beyond}"),
    ):
        of = partial(_episodes, by_label, quantity, least, beyond, study.settings.confidence)
        statistic = Statistic(name, QUANTITIES[quantity].of, least=0.0, title=title, definition=definition)
        if quantity == RATE:
            statistic = replace(statistic, things="episodes")
        yield Measure(statistic, key, of)


def _episodes(
    by_label: dict[str, Catalogues], name: str, common: float | None, beyond: str, level: float, group: Group
) -> Values:
    """The sums of a quantity of episodes over the runs of a group that reached t_end.

    b is from the magnitude `common` on, or from the group's own if it is None; `beyond` says so in words.
    """
    missing = _unfinished(group)
    if group.label not in by_label:
        return Values(missing=missing)
    found = by_label[group.label]
    least = found.least if common is None else common
    if name == B_VALUE and found.n_from(least) < enough.LEAST_CASCADES:
        return Values(missing=missing, withheld=f"fewer than {enough.LEAST_CASCADES} episodes {beyond}")
    if name == B_VALUE and found.atom(least) > ATOM:
        return Values(missing=missing, withheld=ONE_MOMENT)
    if name == B_VALUE and found.basis(level).code == enough.DRIFTS:
        return Values(missing=missing, withheld="the rate of episodes drifts")
    if name == B_VALUE and not has_b(found, level):
        return Values(missing=missing, withheld="no single b is shown to hold")
    units, rows, finished = list[int](), list[tuple[float, float]](), group.finished
    of_unit = {unit: iter(runs) for unit, runs in found.runs.items()}  # in the order of the members
    for unit, member_id in zip(finished["unit"], finished["member_id"], strict=True):
        row = QUANTITIES[name].sums(next(of_unit[int(unit)]), least)
        if row[1] > 0:
            units.append(int(unit))
            rows.append(row)
        else:
            missing[str(member_id)] = NO_EPISODE
    return Values(UnitSums.of(units, rows), missing)


def _unfinished(group: Group) -> dict[str, str]:
    lost = ~group.is_finished
    return dict(zip(group.column("member_id")[lost], group.column("outcome")[lost], strict=True))


# ---------------------------------------------------------------------------------------- columns of records


def _of_columns(study: Study, beside: Study | None) -> Iterator[Measure]:
    """Of every column of a record that holds numbers, the mean over runs, or what has to stand in its place.

    Of truths that is their share, of a time that the end of a run may cut off its median and its mean up to a limit,
    and of times between exits of a block their mean from the number of exits.

    A column that the analysis takes for itself, the growth rate, is measured too, but not as what the scene is about,
    and of the exact law alone, which it is of.
    """
    table = study.data.table
    is_smoothed = np.array([one["eps"] is not None for one in table.settings])
    for name, column in study.data.recorded.items():
        is_own = name in READ
        numbers = study.number(name)
        if is_own:
            numbers = np.where(is_smoothed[table.own["setting"]], np.nan, numbers)
        if (beside is not None and name not in beside.data.recorded) or (is_own and np.isnan(numbers).all()):
            continue
        if column.until is not None:
            yield from _of_times(study, beside, name, column)
            continue
        called, absent = column.called or name, column.absent
        title, definition = f"mean {called}", "" if column.says_it else column.words
        statistic = Statistic(f"mean {name}", ratio, least=column.least)
        if column.most is not None:
            statistic = Bounded(f"mean {name}", ratio, most=column.most)
        of: Callable[[Group], Values] = partial(_column, numbers, column.problems, column.absent or NO_VALUE)
        if column.is_share:
            statistic, title = Share(f"share {name}"), f"share of runs with {called}"
            of = partial(_share, numbers, column.problems, column.absent or NO_VALUE)
        elif column.of_gaps == "mean":
            definition = f"{column.words}, as the time of blocks per exit, which nothing cuts off"
            statistic, of, absent = PerEvent(f"mean {name}", per_event), _per_exit, STILL
        elif column.of_gaps:
            of = partial(_of_gaps, numbers, column.problems, column.absent or NO_VALUE, study.settings.t_burn)
        statistic = replace(statistic, title=title, definition=definition)
        yield Measure(statistic, name, of, absent, is_recorded=not is_own)


def _column(numbers: np.ndarray, problems: Mapping[str, str], reason: str, group: Group) -> Values:
    lacks = ~np.isfinite(numbers[group.rows])
    missing = {
        str(member_id): outcome if outcome == FAILED else problems.get(member_id, reason)
        for member_id, outcome in zip(group.column("member_id")[lacks], group.column("outcome")[lacks], strict=True)
    }
    return Values(group.sums_of(numbers), missing)


def _share(numbers: np.ndarray, problems: Mapping[str, str], reason: str, group: Group) -> Values:
    """Runs of each unit that have a property, and those of which that is known."""
    has = numbers[group.rows]
    known = np.isfinite(has)
    sums = UnitSums.of(group.column("unit").to_numpy()[known], np.column_stack([has, known])[known])
    return replace(_column(numbers, problems, reason, group), sums=sums)


def _per_exit(group: Group) -> Values:
    """Exits per block with friction and unit of time of a unit's runs that may go on to exit, and 1.

    The mean time between exits of a block is one over it, however short the windows are. The mean of the times that
    lie in a window whole is too small, as long ones are cut off. A run that has not moved yet has no exit so far.
    """
    not_moved = np.asarray(group.fates == UNMOVED)
    counted, ended = (group.members[rows] for rows in (group.is_moving | not_moved, ~(group.is_moving | not_moved)))
    exits = UnitSums.together(
        [
            UnitSums(group.units, group.of("rate", "runs")),
            UnitSums.of(group.members["unit"][not_moved], np.repeat([[0.0, 1.0]], not_moved.sum(), axis=0)),
        ]
    )
    n = float(group.key["n"])
    n_contacts = counted[CONTACTS].fillna(n) if CONTACTS in counted else np.full(len(counted), n)
    contacts = UnitSums.of(counted["unit"], np.column_stack([n_contacts, np.ones(len(counted))]))
    rates = ratio(exits.rows) / ratio(contacts.rows)
    missing = {
        str(member_id): outcome if outcome == FAILED else STILL
        for member_id, outcome in zip(ended["member_id"], ended["outcome"], strict=True)
    }
    return Values(UnitSums(exits.units, np.column_stack([rates, np.ones(len(rates))])), missing)


def _of_gaps(numbers: np.ndarray, problems: Mapping[str, str], reason: str, t_burn: float, group: Group) -> Values:
    """As `_column`, but withheld in short windows: the scatter of the times that lie in them whole is too small."""
    values, rates = _column(numbers, problems, reason, group), _per_exit(group).sums.rows[:, 0]
    n_exits = (float(group.key["t_end"]) - t_burn) * float(rates.mean()) if len(rates) else 0.0
    if len(values.sums) and n_exits < LEAST_GAPS:
        return Values(
            missing=values.missing, withheld=f"fewer than {LEAST_GAPS} exits per block: long times are cut off"
        )
    return values


def _of_times(study: Study, beside: Study | None, name: str, column: Recorded) -> Iterator[Measure]:
    """The median of a time that the end of a run may cut off, and its mean up to the longest time that all follow.

    The median leads if it is known wherever the time is, with its interval.
    """
    studies = [study] if beside is None else [study, beside]
    limit = min(some.limit(name) for some in studies)
    called, words = column.called or name, column.words
    by_median = Measure(
        Median(f"median {name}", ratio, title=f"median {called}", definition=f"{words}, by Kaplan and Meier"),
        f"{name}_median",
        partial(_median, study, name),
    )
    by_mean = Measure(
        Bounded(
            f"restricted mean {name}", ratio, most=limit,
            title=f"restricted mean of {'the ' * column.says_it}{called} up to {limit:g}",
            definition=f"{words}; the area up to {limit:g} under the curve of Kaplan and Meier",
        ),
        name,
        partial(_restricted, study, name, limit),
    )  # fmt: skip
    medians = [study.median(group, name) for group in study.groups]
    is_known = all(None not in (median.value, median.low, median.high) for median in medians)
    yield from (by_median, by_mean) if is_known else (by_mean, by_median)


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
    lost, problems = group.members[~is_known], study.data.recorded[name].problems
    missing = {
        str(member_id): outcome if outcome == FAILED else problems.get(str(member_id), NO_VALUE)
        for member_id, outcome in zip(lost["member_id"], lost["outcome"], strict=True)
    }
    return times, missing


# ------------------------------------------------------------------------------------------------- n_stick


def _of_n_stick(study: Study, _: Study | None) -> Iterator[Measure]:
    """Mean n_stick and gamma of what is in motion; without gamma where episodes are recorded."""
    of: dict[str, Callable[[Group], Values]] = {MEAN: of_mean, GAMMA: partial(of_gamma, study.settings.confidence)}
    for statistic in contrast.statistics(study.margins, study.compared & {*KEYS.values()}):
        yield Measure(statistic, KEYS[statistic.name], of[statistic.name], is_recorded=False)


def of_mean(group: Group) -> Values:
    """Mean n_stick of a filled group's runs in motion, every unit with the same weight."""
    return Values(UnitSums(group.units, group.by_unit("mean", "runs")))


def of_gamma(confidence: float, group: Group) -> Values:
    """Sums of gamma over a filled group's runs in motion, if they allow a statistic of a steady state."""
    basis = group.basis(confidence).code
    return Values(group.sums("gamma")) if basis in enough.JUDGED else Values(withheld=basis)


#: What an ensemble may hold that can be measured, in the order in which measures lead.
SOURCES: tuple[Callable[[Study, Study | None], Iterator[Measure]], ...] = (_of_episodes, _of_columns, _of_n_stick)
