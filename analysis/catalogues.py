"""The catalogues of episodes of an ensemble, by group, and their statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.by_key import by_key
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.groups import Group
from stickslip.analysis.members import STEPS, TOLERANCES, WIDTHS
from stickslip.analysis.models.episodes import QUANTITIES, REST, SLOW_DRIVE, Catalogue, rise_of_rate
from stickslip.analysis.models.magnitudes import (
    WIDTH,
    Magnitudes,
    b_positive,
    bends,
    by_least,
    magnitudes_of,
    shares_between,
)
from stickslip.analysis.models.recurrence import Recurrence, recurrence
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, UnitSums, over_matrices, ratio, within
from stickslip.pipeline.design.labels import Label, engine_noun
from stickslip.sim.engines import place

LARGE = 0.1  # share of episodes that count as large where there is no peak
_QUANTITIES = {**QUANTITIES, **REST, **SLOW_DRIVE}
_READ = ["start", "end", "size", "moment", "z_sum", "elapsed"]


@dataclass
class Catalogues:
    """A group with the catalogues of its runs that reached t_end, by unit, and their statistics.

    Attributes
    ----------
    runs : dict of int to list of Catalogue
        By unit.
    confidence : float
        Of intervals.
    declared : tuple of float, optional
        The range of magnitudes that b is of.
    method : Label
        What tells it from the other groups.
    misfit : Estimate
        How far the magnitudes lie from their law, of `models.magnitudes.misfit`.
    """

    group: Group
    runs: dict[int, list[Catalogue]]
    confidence: float
    declared: tuple[float, float] | None = None
    method: Label = field(default_factory=Label)
    misfit: Estimate = field(default_factory=Estimate)

    @property
    def label(self) -> str:
        return self.group.label

    @property
    def noun(self) -> str:
        """Its method as what others are compared with."""
        return engine_noun(self.group.key["engine"], self.method)

    @property
    def is_judged(self) -> bool:
        return self.basis.code in enough.JUDGED

    @property
    def n_episodes(self) -> int:
        return sum(len(run.start) for run in self.each())

    @cached_property
    def sums(self) -> dict[str, UnitSums]:
        """Sums of each quantity by unit, of runs in which it is known."""
        units = np.array([unit for unit, runs in self.runs.items() for _ in runs])
        of_runs = {
            name: np.array([quantity.sums(run) for run in self.each()], dtype=np.float64)
            for name, quantity in _QUANTITIES.items()
        }
        known = {name: np.isfinite(rows).all(axis=1) for name, rows in of_runs.items()}
        return {name: UnitSums.of(units[known[name]], rows[known[name]]) for name, rows in of_runs.items()}

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Each quantity, with its interval over units."""
        return {
            name: over_matrices(_QUANTITIES[name].of, sums.counted.rows, self.confidence)
            for name, sums in self.sums.items()
        }

    @cached_property
    def whole(self) -> Estimate:
        """The share of episodes in which all blocks slip."""
        n = self.group.key["n"]
        return within(self.ratio(lambda run: (float(np.sum(run.size == n)), len(run.size))), 0.0, 1.0)

    def ratio(self, sums: Callable[[Catalogue], tuple[float, float]]) -> Estimate:
        """One sum over runs divided by another, with its interval over units."""
        rows = [np.sum([sums(run) for run in runs], axis=0) for runs in self.runs.values()]
        return over_matrices(ratio, np.array(rows, dtype=np.float64), self.confidence)

    @cached_property
    def law(self) -> Magnitudes:
        """What the magnitudes of the systems are like."""
        return magnitudes_of(self.by_system, self.confidence, self.declared)

    @cached_property
    def in_peak(self) -> tuple[Estimate, Estimate]:
        """The shares of episodes and of their moment that are in the peak; no values without one."""
        if self.law.begins is None:
            return Estimate(), Estimate()
        return shares_between((self.law.begins, np.inf), self.by_system, self.confidence)

    @cached_property
    def in_range(self) -> Estimate:
        """The share of episodes that the law is of; without a value where there is none."""
        return self._share(self.law.least, self.law.most) if self.law.has_b else Estimate()

    @cached_property
    def below_range(self) -> Estimate:
        """The share of episodes that are smaller than those that the law is of."""
        return self._share(-np.inf, self.law.least) if self.law.has_b else Estimate()

    @cached_property
    def in_atom(self) -> Estimate:
        """The share of episodes of the least moment, where that is an atom; else without a value."""
        return self._share(-np.inf, float(self.magnitudes().min()) + WIDTH / 2) if self.law.atom else Estimate()

    def _share(self, least: float, most: float) -> Estimate:
        """The share of episodes between two magnitudes."""
        return shares_between((least, most), self.by_system, self.confidence)[0]

    @cached_property
    def recurrence(self) -> Recurrence:
        """Times between the events of the peak; without one, between the largest tenth of events."""
        magnitudes = self.magnitudes()
        least = self.law.begins if self.law.begins is not None else float(np.quantile(magnitudes, 1 - LARGE))
        return recurrence([*self.runs.values()], least, self.confidence)

    @cached_property
    def b_positive(self) -> Estimate:
        """The check on b of `models.magnitudes.b_positive`."""
        return b_positive(self.law, [[run.magnitude for run in runs] for runs in self.runs.values()], self.confidence)

    @cached_property
    def by_least(self) -> list[tuple[float, int, Estimate]]:
        """b on upper parts of the range, of `models.magnitudes.by_least`."""
        return by_least(self.law, self.confidence) if self.law.has_b else []

    @cached_property
    def bend(self) -> tuple[float, float] | None:
        """b on the range and on the least upper part of it, where the law is shown to bend; else None."""
        if not bends(self.law, self.confidence):
            return None
        values = [b.value for _, _, b in self.by_least if b.value is not None]
        return values[0], values[-1]

    @property
    def stuck_below(self) -> float | None:
        """Speed on the belt, over the belt's, below which a smoothed block may count as stuck; None: none may."""
        key = self.group.key
        if key["stick"] != "manifold" or key["ratio"] != "one" or not key["belt_speed"]:
            return None
        return float(-key["eps"] * np.log(key["eps"]) / abs(key["belt_speed"]))

    def each(self) -> Iterator[Catalogue]:
        """The catalogues of all runs."""
        for runs in self.runs.values():
            yield from runs

    def magnitudes(self) -> np.ndarray:
        """Magnitudes of all episodes, run by run."""
        return np.concatenate([run.magnitude for run in self.each()] or [np.zeros(0)])

    @property
    def by_system(self) -> list[np.ndarray]:
        """Magnitudes of the episodes of each unit."""
        return [self.magnitudes_of(unit) for unit in self.runs]

    def magnitudes_of(self, unit: int) -> np.ndarray:
        """Magnitudes of the episodes of a unit."""
        return np.concatenate([run.magnitude for run in self.runs[unit]])

    @cached_property
    def basis(self) -> enough.Basis:
        """Whether the law of these episodes may be judged: there are enough, and their rate does not drift."""
        halves = np.array([sum(run.halves() for run in runs) for runs in self.runs.values()])
        return enough.basis(halves, int(halves.sum()), self.confidence, rise_of_rate)


def read(study: Study) -> list[Catalogues]:
    """The catalogues of each group with a run that reached t_end, in the order of `fineness`; none if unrecorded."""
    episodes = study.data.episodes
    if episodes is None:
        return []
    of_member = {str(name): table for name, table in episodes.groupby("member_id", sort=False)}
    groups = sorted(study.groups, key=fineness)
    settings = study.settings.confidence, study.settings.magnitude_range
    filled = [Catalogues(group, _by_unit(study, group, of_member), *settings) for group in groups]
    return [entry for entry in filled if entry.runs]


def fineness(group: Group) -> tuple[Any, ...]:
    """Sorts groups: exact events first, then by engine, from the finest setting to the coarsest."""
    return (place(group.key["engine"]), *(float(group.key[name] or 0.0) for name in (*WIDTHS, *STEPS, *TOLERANCES)))


def _by_unit(study: Study, group: Group, of_member: Mapping[str, pd.DataFrame]) -> dict[int, list[Catalogue]]:
    """The catalogues of a group's finished runs by unit; that of a run without episodes is empty."""
    by_unit: dict[int, list[Catalogue]] = {}
    t_start = study.settings.t_burn
    n, v = int(group.key["n"]), group.key["belt_speed"]
    finished = group.finished
    table = (finished[name] for name in ("unit", "member_id", "t_end"))
    for unit, member_id, t_end in zip(*table, strict=True):
        columns = np.zeros((len(_READ), 0))
        if member_id in of_member:
            columns = of_member[member_id].reindex(columns=_READ).to_numpy(np.float64, na_value=np.nan).T
            columns = columns[:, (columns[0] >= t_start) & (columns[3] != 0)]
        start, end, size, moment, z_sum, elapsed = columns
        slip = np.nan if not v else n * abs(float(v)) * (float(t_end) - t_start)
        moving = _moving(*study.runs.points(member_id), n, t_start, float(t_end))
        carried = np.sign(float(v)) * z_sum if v else None
        sizes = size.astype(np.int64)
        is_loaded = study.data.is_loaded
        duration = elapsed if is_loaded else end - start
        run = Catalogue(t_start, float(t_end), start, duration, sizes, moment, slip, moving, carried, is_loaded)
        by_unit.setdefault(int(unit), []).append(run)
    return by_unit


def _moving(t: np.ndarray, n_stick: np.ndarray, n: int, t_start: float, t_end: float) -> float:
    """The time from t_start to t_end in which fewer than n blocks stick."""
    lasted = np.diff(np.clip(np.append(t, t_end), t_start, t_end))
    return float(lasted[n_stick < n].sum())


def systems(catalogues: Sequence[Catalogues]) -> list[list[Catalogues]]:
    """Groups of the same systems together, in their order: the others are compared with the first."""
    return [*by_key(catalogues, lambda entry: entry.group.system).values()]


def bent(groups: Iterable[Catalogues]) -> list[Alert]:
    """That b depends on its range, of the group in which it changes most along it; empty if no law bends."""
    ends = [(*group.bend, group.label) for group in groups if group.is_judged and group.bend is not None]
    if not ends:
        return []
    first, last, where = max(ends, key=lambda end: abs(end[1] - end[0]))
    return [Alert.of(Code.BENDS, where=f" ({where})", first=f"{first:.2f}", last=f"{last:.2f}")]
