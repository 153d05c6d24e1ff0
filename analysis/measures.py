"""What sweeps and comparisons measure of runs: one registry, `SOURCES`, of what an ensemble may hold.

What the scene records comes first: the episodes, then every numeric column of a record, without a line here for any
of them. Mean n_stick and gamma are measured where nothing else is recorded, or where the scene asks for cascades.

A measure gives every unit two sums, and its value on some units is a statistic of the total of these sums: intervals
and differences are those of `analysis.contrast`. A run without a value is in no sum; `Values.missing` says why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from stickslip.analysis import contrast
from stickslip.analysis.catalogues import MARGIN, ONE_MOMENT, Catalogues, has_b, read
from stickslip.analysis.contrast import Statistic
from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.episodes import ATOM, B_VALUE, QUANTITIES, RATE, SIZE
from stickslip.analysis.models.fates import FAILED
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import UnitSums, ratio
from stickslip.analysis.stats.quantities import QUANTITIES as OF_N_STICK

MEAN, GAMMA = OF_N_STICK["mean"].label, OF_N_STICK["gamma"].label
MEAN_SIZE, B = "mean size of episodes", "b of episodes"
#: Names under which margins are declared, and of axes.
KEYS = {MEAN: "mean", GAMMA: "gamma"}
AXES = {MEAN: "mean $n_{stick}$", GAMMA: r"$\gamma$"}
NO_VALUE, NO_EPISODE = "its record gives none", "no episode"  # reasons, beside the outcomes of runs


@dataclass(frozen=True)
class Values:
    """A measure's values on a group.

    Attributes
    ----------
    sums : UnitSums
    missing : dict of str to str
        Why a run has no value, by member_id: its outcome, or a reason.
    withheld : str
        Why the group has no value although its runs have; empty if it has one.
    """

    sums: UnitSums = field(default_factory=UnitSums)
    missing: dict[str, str] = field(default_factory=dict)
    withheld: str = ""


@dataclass(frozen=True)
class Measure:
    """A thing that is measured of runs.

    Attributes
    ----------
    statistic : Statistic
        Its name in tables, how it follows from sums, and its margin.
    key : str
        In names of figures.
    subject : str
        What a sentence about it begins with: "the rate of episodes".
    words : str
        What it is; empty if the name says it.
    axis : str
        How an axis of a figure is named.
    of : callable
        Maps a group to its `Values`.
    absent : str
        The reason in `Values.missing` of runs that have none by what they are; empty if all should have one.
    is_recorded : bool
        Whether it is what the scene records for its own sake; if nothing is, n_stick and gamma are all that is
        measured, and otherwise they are left out, unless the scene asks for cascades.
    says_it : bool
        Whether the subject says what it is, without `words`.
    since : float, optional
        If it is of times that have to lie between this one and the end of a run, so that the mean is too small unless
        that is much longer.
    """

    statistic: Statistic
    key: str
    subject: str
    words: str
    axis: str
    of: Callable[[Group], Values]
    absent: str = ""
    is_recorded: bool = True
    says_it: bool = False
    since: float | None = None

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
    for name, quantity, key, subject, words, axis in (
        (RATE, RATE, "episode_rate", f"the {RATE}", "per unit of time", RATE),
        (MEAN_SIZE, SIZE, "episode_size", f"the {MEAN_SIZE}", "in blocks that slip", MEAN_SIZE),
        (B, B_VALUE, "episode_b", "b of the episodes", f"by Aki {beyond}", B),
    ):
        of = partial(_episodes, by_label, quantity, least, beyond, study.settings.confidence)
        yield Measure(Statistic(name, QUANTITIES[quantity].of, MARGIN, least=0.0), key, subject, words, axis, of)


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
    """The mean over runs of every numeric column of a record.

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
        words = column.words.partition(";")[0]
        yield Measure(
            Statistic(f"mean {name}", ratio, MARGIN, least=column.least),
            name, f"mean {column.called or name}", words, name,
            partial(_column, numbers, column.problems, column.absent or NO_VALUE),
            column.absent,
            is_recorded=not is_own,
            says_it=column.says_it,
            since=column.since,
        )  # fmt: skip


def _column(numbers: np.ndarray, problems: Mapping[str, str], reason: str, group: Group) -> Values:
    lacks = ~np.isfinite(numbers[group.rows])
    missing = {
        str(member_id): outcome if outcome == FAILED else problems.get(member_id, reason)
        for member_id, outcome in zip(group.column("member_id")[lacks], group.column("outcome")[lacks], strict=True)
    }
    return Values(group.sums_of(numbers), missing)


# ------------------------------------------------------------------------------------------------- n_stick


def _of_n_stick(study: Study, _: Study | None) -> Iterator[Measure]:
    """Mean n_stick and gamma of what is in motion, where a margin is declared for them."""
    of: dict[str, Callable[[Group], Values]] = {MEAN: of_mean, GAMMA: partial(of_gamma, study.settings.confidence)}
    for one in contrast.statistics(study.margins, KEYS.values()):
        yield Measure(one, KEYS[one.name], one.name, "", AXES[one.name], of[one.name], is_recorded=False)


def of_mean(group: Group) -> Values:
    """Mean n_stick of a filled group's runs in motion, every unit with the same weight."""
    return Values(UnitSums(group.units, group.by_unit("mean", "runs")))


def of_gamma(confidence: float, group: Group) -> Values:
    """Sums of gamma over a filled group's runs in motion, if they allow a statistic of a steady state."""
    is_judged = group.basis(confidence).code in enough.JUDGED
    return Values(group.sums("gamma")) if is_judged else Values()


#: What an ensemble may hold that can be measured, in the order in which measures lead.
SOURCES: tuple[Callable[[Study, Study | None], Iterator[Measure]], ...] = (_of_episodes, _of_columns, _of_n_stick)
