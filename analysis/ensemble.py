"""An ensemble as the statistics see it, and the study of it that every question is given."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from stickslip.analysis import arguments
from stickslip.analysis.groups import Group, fill, groups
from stickslip.analysis.members import Members, Proofs, known_outcomes, may_be_proved
from stickslip.analysis.models.fates import DIVERGED, FAILED
from stickslip.analysis.models.motion import Motion, joined, motion
from stickslip.analysis.models.times import Times
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.series.nulls import LEAST_PERIODS
from stickslip.analysis.series.runs import Ended, Events, Put, Run, Runs, Series, generator, no_series
from stickslip.analysis.series.windows import ChangePoints, NoSeries, Stack, Windows, windows
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums, over_matrices, ratio, within
from stickslip.analysis.stats.quantities import QUANTITIES
from stickslip.analysis.stats.shares import mean_share, mean_within, share_over_matrices
from stickslip.sim.numerics.arguments import apart, did_you_mean
from stickslip.sim.runs.run import Samples
from stickslip.sim.runs.series import EventSeries

T = TypeVar("T")
_TOGETHER = 100_000  # members that are asked about at once
#: Columns of `Members.own` that tell how a run ended, and of which setting and unit it is.
_ENDS = ("member_id", "unit", "setting", "outcome", "t_stop", "growth_rate", "attractor")
#: Distance of a run's state from its unperturbed twin's: times, shape (m,), and distance, shape (m,).
Separation = tuple[np.ndarray, np.ndarray]


class Numbers(Mapping[str, float | None]):
    """A number of each member, by member_id; None where there is none.

    Attributes
    ----------
    column : ndarray, shape (R,)
        By the rows of the table of members; NaN where there is none.
    """

    def __init__(self, table: Members, column: np.ndarray) -> None:
        self._table, self.column = table, column

    @classmethod
    def of(cls, table: Members, known: Mapping[str, float | None]) -> Numbers:
        """From a mapping, which may lack members."""
        return cls(table, np.array([_as_number(known.get(name)) for name in table.own["member_id"]]))

    def __getitem__(self, member_id: str) -> float | None:
        number = float(self.column[self._table.row_of[member_id]])
        return None if np.isnan(number) else number

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.own["member_id"])

    def __len__(self) -> int:
        return len(self.column)


def _as_number(value: float | None) -> float:
    """A number that may be missing, for which NaN stands."""
    return np.nan if value is None or pd.isna(value) else float(value)


class Recorded(NamedTuple):
    """A number that a record keeps of every run.

    Attributes
    ----------
    words : str
        What it is.
    values : Numbers, or dict of str to float
        By member_id; None where a run has none.
    least : float, optional
        What it is never below, by what it is: 0 for an amplitude.
    most : float, optional
        What a number that is never below 0 is never above: 1 for a share of blocks or of time.
    dimension : str
        As of `Quantity`.
    absent : str
        Why a run may have none, by what it is: a steady slide has no period. Empty if all should have one.
    problems : mapping of str to str
        By member_id: why a run has none although it should.
    called : str
        What it is called in a sentence; empty: by its column.
    says_it : bool
        Whether that says what it is, without `words`.
    is_share : bool
        Whether it is a yes or a no, of which shares are taken.
    since : float, optional
        If it is a time until something happens, which the end of a run may cut off: from when on it counts.
    of_gaps : "mean" or "scatter", optional
        If it is of the times between exits of the same block that lie within a window, which cuts off the long ones.
    """

    words: str
    values: Mapping[str, float | None]
    least: float | None = None
    absent: str = ""
    problems: Mapping[str, str] = {}
    called: str = ""
    says_it: bool = False
    is_share: bool = False
    since: float | None = None
    of_gaps: str = ""
    most: float | None = None
    dimension: str = ""


@dataclass(frozen=True)
class Data:
    """An ensemble as the statistics see it. Mappings are by member_id and may load lazily.

    Attributes
    ----------
    table : Members
    series : Series
        Series of n_stick of every member that did not fail.
    events : mapping to Events
        Empty if the scene does not record them.
    separations : mapping to Separation
        For members that are changed copies of another; empty if the scene does not record them.
    thresholds : mapping to mapping of float to ChangePoints
        n_stick of a sigmoid run under further definitions of sticking, |w - v| < threshold r_i eps, by threshold.
    episodes : DataFrame, optional
        One row an episode: member_id, start, end, size, moment. None if the scene does not record them.
    recorded : mapping of str to Recorded
        Every number that a record keeps of a run, by the name of its column.
    lists : mapping of str to mapping of str to ndarray
        Every list of numbers that a record keeps of a run for its own sake, by the name of its column; a member
        without one is left out.
    is_loaded : bool
        Whether loading is adiabatic: time stands still while blocks slip.
    again : callable, optional
        Runs a member again: of its id, a time and a number, its events, and as many states from then to its end, in
        the units of the data; None where that takes code or files that are no part of the data.
    """

    table: Members
    series: Series
    events: Mapping[str, Events] = field(default_factory=dict)
    separations: Mapping[str, Separation] = field(default_factory=dict)
    thresholds: Mapping[str, Mapping[float, ChangePoints]] = field(default_factory=dict)
    episodes: pd.DataFrame | None = None
    recorded: Mapping[str, Recorded] = field(default_factory=dict)
    lists: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    is_loaded: bool = False
    again: Callable[[str, float, int], tuple[EventSeries, Samples] | None] | None = None

    def __post_init__(self) -> None:
        arguments.instance("table", self.table, Members)

    @property
    def members(self) -> pd.DataFrame:
        """The members as one table with all columns, made anew."""
        return self.table.together


@dataclass
class Study:
    """What every question is given: the data, the settings declared beforehand, and the groups.

    Attributes
    ----------
    data : Data
    settings : AnalysisSettings
    put : Put, optional
        Puts functions to runs; by default here, one run after the other.
    """

    data: Data
    settings: AnalysisSettings
    put: Put | None = None
    _made: dict[tuple[object, str], Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check(self.data.table, self.settings)

    def once(self, of: Callable[..., T], group: Group | None = None) -> T:
        """What a function gives of the study, or of it and a group, made when it is first asked for."""
        key = of, "" if group is None else group.label
        if key not in self._made:
            self._made[key] = of(self) if group is None else of(self, group)
        made: T = self._made[key]
        return made

    @cached_property
    def groups(self) -> list[Group]:
        """Groups of the unchanged members, filled, by n and engine."""
        members = self.data.table
        filled = groups(members, members.unchanged)
        fill(filled, self._motion(motion, members.unchanged))
        return filled

    def _motion(self, of: Callable[..., Motion], rows: np.ndarray) -> Iterator[tuple[np.ndarray, Motion]]:
        for k in range(0, len(rows), _TOGETHER):
            batch = rows[k : k + _TOGETHER]
            for places, motions in self._put(of, self.ended(batch)):
                yield batch[np.asarray(places)], motions

    @cached_property
    def runs(self) -> Runs:
        """What the runs recorded."""
        settings = self.settings
        return Runs(self.data.series, self.data.events, settings.t_burn, settings.seed, settings.time)

    def _put(
        self, of: Callable[..., T], some: Ended, beside: Ended | None = None
    ) -> Sequence[tuple[Sequence[int], T]]:
        if self.put is not None:
            return self.put(of, some, beside)
        return [(range(len(some)), of(self.runs, some) if beside is None else of(self.runs, some, beside))]

    def ended(self, rows: np.ndarray) -> Ended:
        """How the runs of some members ended, by their rows and in their order."""
        table = self.data.table
        columns = table.own[[name for name in _ENDS if name in table.own]].iloc[rows]
        settings = columns["setting"].to_numpy()
        n, t_end, period = (column[settings] for column in table.windows)
        t_stop, rates = (columns[name].to_numpy(np.float64, na_value=np.nan) for name in ("t_stop", "growth_rate"))
        names, outcomes = (column.to_numpy(object) for column in (columns["member_id"], known_outcomes(columns)))
        return Ended(rows, names, columns["unit"].to_numpy(), outcomes, t_end, t_stop, rates, n, period)

    @cached_property
    def motion(self) -> Motion:
        """What the runs of all members give, changed copies too, in brief.

        Raises
        ------
        ValueError
            If a member that did not fail has no change points, or they are not a series; the error names the member.
        """
        batches = self._motion(partial(motion, is_brief=True), np.arange(len(self.data.table)))
        return joined([batch.in_order(np.argsort(rows)) for rows, batch in batches])

    def each(self, of: Callable[..., np.ndarray], rows: np.ndarray, beside: np.ndarray | None = None) -> np.ndarray:
        """What a function gives of some runs, by their rows and in their order: a row of an array each.

        Parameters
        ----------
        of : callable
            Of `Runs` and `Ended`, and of another `Ended` with `beside`; of a module, or a `functools.partial` of one,
            for it may be put to the runs in other processes.
        rows : ndarray of int
        beside : ndarray of int, optional
            One run more for each of them.
        """
        arrays: list[np.ndarray] = []
        places: list[int] = []
        for numbers, values in self._put(of, self.ended(rows), None if beside is None else self.ended(beside)):
            places += numbers
            arrays.append(values)
        return np.concatenate(arrays)[np.argsort(places, kind="stable")] if arrays else np.zeros((0, 0))

    def total(self, of: Callable[..., np.ndarray], rows: np.ndarray) -> np.ndarray:
        """The sum of arrays that a function gives of some runs together, by their rows, at least one; as `each`."""
        return np.sum([totals for _, totals in self._put(of, self.ended(rows))], axis=0)

    def sums(self, group: Group, of: Callable[[Run], np.ndarray | None], n_columns: int) -> np.ndarray:
        """The sums over runs of what a function gives of each run in motion of a group.

        Parameters
        ----------
        group : Group
        of : callable
            Gives an array of `n_columns` numbers, or None. It is of a module, or a `functools.partial` of one, for it
            may be put to the runs in other processes.
        n_columns : int

        Returns
        -------
        ndarray, shape (G, n_columns + 1)
            One row a unit; at its end how many of its runs gave something.

        Raises
        ------
        ValueError
            If the change points of a member are not a series; the error names the member.
        """
        row_of = {unit: row for row, unit in enumerate(group.units)}
        totals = np.zeros((len(group.units), n_columns + 1))
        moving = self.ended(np.sort(group.rows[group.is_moving]))
        for _, by_unit in self._put(partial(Runs.sums, of=of), moving):
            for unit, row in by_unit.items():
                totals[row_of[unit]] += row
        return totals

    @property
    def compared(self) -> set[str]:
        """The `QUANTITIES` of n_stick that are compared: without gamma where episodes are recorded."""
        return {*QUANTITIES} - ({"gamma"} if self.data.episodes is not None else set())

    @property
    def proofs(self) -> Proofs:
        """What stands against a proof of runs that slide."""
        if not any(map(may_be_proved, self.data.table.settings)):
            return Proofs.NONE_EXISTS
        is_sought = "t_collapse" in self.data.table.own  # in each run whose blocks all slip
        return Proofs.SOUGHT if is_sought else Proofs.SOUGHT_WHERE_IT_SAVES_TIME

    @property
    def unit(self) -> str:
        """The kind of unit that most groups have."""
        return Counter(group.unit for group in self.groups).most_common(1)[0][0]

    def by_threshold(self, member_id: str, t_end: float) -> tuple[list[float], Windows] | None:
        """The further thresholds of a member and its windows of n_stick under each, if any; raises as `windows`."""
        series = self.data.thresholds.get(member_id)
        if not series:
            return None
        try:
            return [*series], windows(Stack.of([*series.values()]), self.settings.t_burn, [t_end] * len(series))
        except NoSeries as error:
            raise no_series(member_id, error) from error

    def judged(self) -> list[Group]:
        """Groups whose runs allow a statistic of a steady state.

        Groups all of whose runs stay in motion come first, since the others hold survivors only; then the largest n.
        """
        able = [group for group in self.groups if group.basis(self.settings.confidence).code in enough.JUDGED]
        return sorted(able, key=lambda group: (group.n_moving < len(group), -int(group.key["n"])))

    def can_shift(self, group: Group) -> bool:
        """Whether blocks may be shifted in time one by one: nothing changes in time, or it repeats often."""
        window = float(group.key["t_end"]) - self.settings.t_burn
        return window >= LEAST_PERIODS * group.shift_unit  # which may be NaN

    def windows(self, group: Group) -> Iterator[tuple[int, str, Window]]:
        """Row of the unit, member_id and n_stick on [t_burn, t_end] of each run in motion of a filled group.

        Raises
        ------
        ValueError
            If the change points of a member are not a series; the error names the member.
        """
        row_of = {unit: row for row, unit in enumerate(group.units)}
        moving = group.moving
        columns = (moving[name] for name in ("unit", "member_id", "t_end"))
        for unit, member_id, t_end in zip(*columns, strict=True):
            yield row_of[int(unit)], str(member_id), self.runs.window(str(member_id), float(t_end))

    def mean(
        self,
        group: Group,
        numbers: str | Mapping[str, float | None],
        least: float | None = None,
        most: float | None = None,
    ) -> Estimate:
        """The mean over a group of a number of each run, every unit with the same weight; its interval is over units.

        Parameters
        ----------
        group : Group
        numbers : str or mapping of str to float
            A column of ``data.recorded``; or numbers by member_id, where a run that is missing, None or not finite is
            left out.
        least : float, optional
            What numbers given by member_id are never below: nor is the interval then. Of a column it is known.
        most : float, optional
            What numbers from 0 on are never above, 1 for a share of time: see `stats.shares.mean_share`. Of a
            column too.

        Returns
        -------
        Estimate
            By `stats.estimates.over_matrices`, or `stats.shares.mean_share`; without an interval, and with the
            reason, for fewer than two units; without a value for none. Of a column of truths it is their share, as
            `share`.

        Raises
        ------
        ValueError
            If no record keeps such a number, or it is a time that the ends of runs may cut off.
        """
        if isinstance(numbers, str):
            recorded = self._recorded("numbers", numbers)
            if recorded.since is not None:
                raise ValueError(
                    f"numbers: expected a number of which means are taken, got {numbers}, a time that the end of a"
                    f" run may cut off; ask for study.median(group, {numbers!r}) or study.restricted_mean(group,"
                    f" {numbers!r})"
                )
            if recorded.is_share:
                return self.share(group, recorded.values)
            least, most = recorded.least, recorded.most
            column = self.number(numbers)
        else:
            column = Numbers.of(self.data.table, numbers).column
        rows = group.sums_of(column).rows
        if most is not None:
            return mean_share(rows, most, self.settings.confidence)
        return within(over_matrices(ratio, rows, self.settings.confidence), least)

    def _recorded(self, argument: str, name: str) -> Recorded:
        recorded = self.data.recorded
        if name in recorded:
            return recorded[name]
        remedy = f"{did_you_mean(name, recorded)}; ask for its record under [record]"
        if name in self.data.members:
            remedy = (
                ", a column of data.members; give its numbers by member_id,"
                f' study.data.members.set_index("member_id")[{name!r}]'
            )
        raise ValueError(
            f"{argument}: expected a number that a record keeps ({', '.join(recorded) or 'there is none'}), got"
            f" {name!r}{remedy}"
        )

    def times(self, group: Group, name: str) -> tuple[Times, np.ndarray]:
        """A time that the end of a run may cut off: of the runs of a group that were measured; and which these are.

        Returns
        -------
        times : Times
        is_known : ndarray of bool, shape (R,)

        Raises
        ------
        ValueError
            If no record keeps such a time.
        """
        recorded = self._recorded("name", name)
        if recorded.since is None:
            raise ValueError(
                f"name: expected a time that the end of a run may cut off, got {name!r}; ask for study.mean, or"
                ' declare it with {"since": 0} if it is one'
            )
        times, outcomes = self.number(name)[group.rows], group.column("outcome").to_numpy(object)
        has_ended = np.isfinite(times)
        t_stop = group.column("t_stop").to_numpy(np.float64, na_value=np.nan)
        # a run that is certain never to stick again is known to its end
        followed = np.where(outcomes == DIVERGED, t_stop, float(group.key["t_end"])) - recorded.since
        is_lost = (outcomes == FAILED) | group.column("member_id").isin([*recorded.problems]).to_numpy()
        is_known = has_ended | (~is_lost & (followed > 0.0))
        units = group.column("unit").to_numpy()
        return Times.of_runs(
            units[is_known], np.where(has_ended, times, followed)[is_known], has_ended[is_known]
        ), is_known

    def limit(self, name: str) -> float:
        """The longest time that all groups are followed to, for means of a time up to it: see `restricted_mean`."""
        return min(float(group.key["t_end"]) for group in self.groups) - (self.data.recorded[name].since or 0.0)

    def median(self, group: Group, name: str) -> Estimate:
        """The median of a time that the end of a run may cut off, by Kaplan and Meier, with its interval over units.

        Parameters
        ----------
        group : Group
        name : str
            A column of ``data.recorded`` that is such a time.

        Returns
        -------
        Estimate
            Without a value, and with the reason, if fewer than half of the runs have it.

        Raises
        ------
        ValueError
            If no record keeps such a time.
        """
        return self.times(group, name)[0].median(self.settings.confidence)

    def restricted_mean(self, group: Group, name: str, limit: float | None = None) -> Estimate:
        """The mean of such a time up to a limit, the area under the curve of Kaplan and Meier; raises as `median`.

        Parameters
        ----------
        group, name
            As in `median`.
        limit : float, optional
            Longer times count as this; by default the longest time that all groups are followed to.
        """
        times, _ = self.times(group, name)
        if not len(times):
            return Estimate(reason="no matrix has data")
        horizon = self.limit(name) if limit is None else limit
        return mean_within(times.restricted(horizon).rows, horizon, self.settings.confidence)

    def number(self, name: str) -> np.ndarray:
        """A number that a record keeps, of each member by its row, shape (R,); NaN where a run has none."""
        values = self.data.recorded[name].values  # noqa: PD011  no data frame
        assert isinstance(values, Numbers)
        return values.column

    def share(self, group: Group, has: Mapping[str, bool | float | None]) -> Estimate:
        """The share of a group's runs that have a property, with Wilson's interval for as many effective runs.

        Parameters
        ----------
        group : Group
        has : mapping of str to bool
            By member_id; a run that is missing or None is left out.

        Returns
        -------
        Estimate
            By `stats.shares.share_over_matrices`; without a value, and with the reason, if no run is known.
        """
        values = [has.get(name) for name in group.column("member_id")]
        is_told = np.array([not pd.isna(value) for value in values])
        if not is_told.any():
            return Estimate(reason="no run has data")
        ones = np.array([bool(value) for value, is_known in zip(values, is_told, strict=True) if is_known])
        counts = UnitSums.of(
            group.column("unit").to_numpy()[is_told], np.column_stack([ones, np.ones(len(ones))])
        ).rows
        share, low, high, _ = share_over_matrices(counts, self.settings.confidence)
        return Estimate(share, low, high)

    def generator(self, member_id: str) -> np.random.Generator:
        """Random numbers of a member, which depend on its name and the seed but not on its place in the table."""
        return generator(self.settings.seed, member_id)


def check(members: Members, settings: AnalysisSettings) -> None:
    """Refuse input that contradicts itself.

    Raises
    ------
    ValueError
        Names the column, member or setting, and says what was expected and what was given.
    """
    names = members.own["member_id"]
    if not names.is_unique:
        raise ValueError(f"members: member_id {names[names.duplicated()].iloc[0]!r} occurs more than once")
    t_end = min(setting["t_end"] for setting in members.settings)
    if settings.t_burn >= t_end:
        end, burn = apart(t_end, settings.t_burn)
        raise ValueError(f"t_burn: expected less than t_end = {end}, got {burn}; no time is left for statistics")
