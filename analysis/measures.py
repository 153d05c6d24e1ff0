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
from stickslip.analysis.contrast import Bounded, Median, PerEvent, Share, Statistic
from stickslip.analysis.ensemble import Recorded, Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import READ
from stickslip.analysis.models.episodes import QUANTITIES, RATE, SIZE
from stickslip.analysis.models.fates import DIVERGED, FAILED, SUSTAINED, UNMOVED, is_all_slip
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
SHORT_WINDOW = "short window"
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
    if not any(measure.is_recorded for measure in candidates):
        return [measure for measure in candidates if measure.name in KEYS]
    left_out = () if "cascades" in study.settings.question else KEYS
    chosen = [measure for measure in candidates if measure.name not in left_out]
    return sorted(chosen, key=lambda measure: not measure.is_recorded)


# ------------------------------------------------------------------------------------------------- episodes


def _of_episodes(study: Study, beside: Study | None) -> Iterator[Measure]:
    """Rate, mean size and b of episodes; a group has a b only where its magnitudes have a power law."""
    if study.data.episodes is None or (beside is not None and beside.data.episodes is None):
        return
    by_label = {group.label: group for group in study.once(read)}
    for name, key, things, definition in (
        (RATE, "episode_rate", "episodes", "" if study.settings.units else "per unit of time"),
        (SIZE, "episode_size", "", "in blocks that slip"),
    ):
        label = MEAN_SIZE if name == SIZE else name
        statistic = Statistic(label, QUANTITIES[name].of, least=0.0, definition=definition, things=things)
        statistic = replace(statistic, dimension="frequency" * (name == RATE))
        yield Measure(statistic, key, partial(_episodes, by_label, name))
    b = Statistic(B, ratio, title="b-value of the episodes", definition="of the power law of their moments")
    yield Measure(b, "episode_b", partial(_b, by_label))
    groups = study.once(read)
    rivals = [] if beside is None else beside.once(read)
    full = [group for group in (*groups, *rivals) if group.n_from(group.least) >= enough.LEAST_CASCADES]
    edge = max((group.least for group in full), default=None)
    if edge is not None and any(group.n_from(edge) < enough.LEAST_CASCADES for group in full):
        edge = None
    by_label = {group.label: group for group in groups}
    beyond = "from each point's own least magnitude on" if edge is None else f"from M = {edge:.2f} on"
    for name, quantity, key, title, things, definition in (
        (RATE, RATE, "episode_rate", "", "episodes", "" if study.settings.units else "per unit of time"),
        (MEAN_SIZE, SIZE, "episode_size", "", "", "in blocks that slip"),
        (B, B_VALUE, "episode_b", "b-value of the episodes", "", f"by Aki {beyond}"),
    ):
        measured = partial(_episodes, by_label, quantity, edge, beyond, study.settings.confidence)
        statistic = Statistic(
            name, QUANTITIES[quantity].of, least=0.0, title=title, definition=definition, things=things,
            dimension="frequency" * (quantity == RATE),
        )  # fmt: skip
        yield Measure(statistic, key, measured)
