"""The catalogues of episodes of an ensemble, by group, and their statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from stickslip.analysis.ensemble import Study
from stickslip.analysis.groups import Group
from stickslip.analysis.members import STEPS, SYSTEM_KEYS, TOLERANCES, WIDTHS
from stickslip.analysis.models.episodes import (
    ATOM,
    B_VALUE,
    FITTED,
    QUANTITIES,
    REST,
    SLOW_DRIVE,
    BValue,
    Catalogue,
    atom,
    b_values,
    drift,
    follows,
    in_classes,
    laws_of_moments,
)
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import Estimate, Undefined, UnitSums, over_matrices
from stickslip.analysis.stats.families import Fit, maximise, parameter
from stickslip.pipeline.design.labels import Label
from stickslip.sim.engines import place

ONE_MOMENT = "most episodes have one moment"  # why there is no b
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
    least : float
        Magnitude from which laws are fitted: the least of the first group of the same systems that has episodes, so
        that they compare. A model's catalogue is complete, so none is left out. Filled by `read`.
    sums : dict of str to UnitSums
        Sums of each quantity by unit, for contrasts; filled by `summarise`.
    method : Label
        What tells it from the other groups.
    estimates : dict of str to Estimate
        Of each quantity; filled by `summarise`.
    b : Estimate
        Of the power law up to the largest moment, if the group may be judged; filled by `summarise`.
    """

    group: Group
    runs: dict[int, list[Catalogue]]
    confidence: float
    least: float = 0.0
    sums: dict[str, UnitSums] = field(default_factory=dict)
    method: Label = field(default_factory=Label)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    b: Estimate = field(default_factory=Estimate)
    has_b: bool = False

    @property
    def label(self) -> str:
        return self.group.label

    @property
    def is_judged(self) -> bool:
        return self.basis.code in enough.JUDGED

    @property
    def n_episodes(self) -> int:
        return sum(len(run.start) for run in self.each())

    @property
    def largest(self) -> float | None:
        """The largest magnitude."""
        return float(self.magnitudes().max()) if self.n_episodes else None

    @property
    def whole(self) -> float | None:
        """The share of episodes in which all blocks slip."""
        n = self.group.key["n"]
        is_whole = [size == n for run in self.each() for size in run.size.tolist()]
        return float(np.mean(is_whole)) if is_whole else None

    @property
    def stuck_below(self) -> float | None:
        """Speed on the belt, over the belt's, below which a smoothed block may count as stuck; None: none may."""
        key = self.group.key
        if key["stick"] != "manifold" or key["ratio"] != "one" or not key["belt_speed"]:
            return None
        return float(-key["eps"] * np.log(key["eps"]) / abs(key["belt_speed"]))

    @property
    def b_reason(self) -> str:
        """Why its magnitudes have no b."""
        return ONE_MOMENT if self.atom(self.least) > ATOM else ""

    def each(self) -> Iterator[Catalogue]:
        """The catalogues of all runs."""
        for runs in self.runs.values():
            yield from runs

    def magnitudes(self) -> np.ndarray:
        """Magnitudes of all episodes, run by run."""
        return np.concatenate([run.magnitude for run in self.each()] or [np.zeros(0)])

    def magnitudes_of(self, unit: int) -> np.ndarray:
        """Magnitudes of the episodes of a unit."""
        return np.concatenate([run.magnitude for run in self.runs[unit]])

    def atom(self, magnitude: float) -> float:
        """`models.episodes.atom` of the episodes of at least that magnitude."""
        magnitudes = self.magnitudes()
        return atom(magnitudes[magnitudes >= magnitude])

    def n_from(self, magnitude: float) -> int:
        """Number of episodes of at least that magnitude."""
        return int(np.count_nonzero(self.magnitudes() >= magnitude))

    @cached_property
    def basis(self) -> enough.Basis:
        """Whether the law of these episodes may be judged: there are enough, and their rate does not drift."""
        halves = np.array([sum(run.halves() for run in runs) for runs in self.runs.values()])
        return enough.basis(halves, int(halves.sum()), self.confidence, drift)

    def at_least(self, magnitude: float) -> dict[int, np.ndarray]:
        """Number of episodes of at least that magnitude and the time in which they were counted, by unit."""
        return {
            unit: np.array([
                sum(np.count_nonzero(run.magnitude >= magnitude) for run in runs),
                sum(run.t_stop - run.t_start for run in runs),
            ], dtype=np.float64)
            for unit, runs in self.runs.items()
        }  # fmt: skip


def read(study: Study) -> list[Catalogues]:
    """The catalogues of each group with a run that reached t_end, in the order of `fineness`; none if unrecorded."""
    episodes = study.data.episodes
    if episodes is None:
        return []
    of_member = {str(name): table for name, table in episodes.groupby("member_id", sort=False)}
    groups = sorted(study.groups, key=fineness)
    filled = [Catalogues(group, _by_unit(study, group, of_member), study.settings.confidence) for group in groups]
    filled = [entry for entry in filled if entry.runs]
    for table in systems(filled):
        smallest = next((float(entry.magnitudes().min()) for entry in table if len(entry.magnitudes())), 0.0)
        for entry in table:
            entry.least = smallest
    return filled


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
        is_loaded = bool(len(elapsed) and np.isfinite(elapsed).all())
        duration = elapsed if is_loaded else end - start
        run = Catalogue(t_start, float(t_end), start, duration, sizes, moment, slip, moving, carried, is_loaded)
        by_unit.setdefault(int(unit), []).append(run)
    return by_unit


def _moving(t: np.ndarray, n_stick: np.ndarray, n: int, t_start: float, t_end: float) -> float:
    """The time from t_start to t_end in which fewer than n blocks stick."""
    lasted = np.diff(np.clip(np.append(t, t_end), t_start, t_end))
    return float(lasted[n_stick < n].sum())


def systems(found: Sequence[Catalogues]) -> list[list[Catalogues]]:
    """Groups of the same systems together, in their order: the others are compared with the first."""
    by_key: dict[tuple[Any, ...], list[Catalogues]] = {}
    for entry in found:
        by_key.setdefault(tuple(entry.group.key[name] for name in SYSTEM_KEYS), []).append(entry)
    return list(by_key.values())


def summarise(group: Catalogues) -> None:
    """Fill in the statistics of a group, each with its interval over units."""
    units = np.array([unit for unit, runs in group.runs.items() for _ in runs])
    for name, quantity in {**QUANTITIES, **REST, **SLOW_DRIVE}.items():
        rows = np.array([quantity.sums(run, group.least) for run in group.each()], dtype=np.float64)
        is_known = np.isfinite(rows).all(axis=1) & (name != B_VALUE or not group.b_reason)
        group.sums[name] = UnitSums.of(units[is_known], rows[is_known])
        group.estimates[name] = over_matrices(quantity.of, group.sums[name].counted.rows, group.confidence)
    if group.is_judged:
        group.b, group.has_b = b_of_law(group, group.confidence), has_b(group, group.confidence)


# ------------------------------------------------------------------------------------------- the law of moments


def classes(one: Catalogues) -> np.ndarray:
    """Histogram of magnitudes of each unit, from `least` to the largest, shape (G, K)."""
    by_unit = [one.magnitudes_of(unit) for unit in one.runs]
    n_classes = int(np.floor((one.magnitudes().max() - one.least) / FITTED + 1e-9)) + 1
    return np.array([in_classes(values, one.least, max(n_classes, 0)) for values in by_unit], dtype=np.float64)


def fits_of(one: Catalogues, n_laws: int = 3) -> list[Fit]:
    """The fit of the first of `laws_of_moments` to a group; empty with an `ATOM`, or without a largest likelihood."""
    magnitudes = one.magnitudes()
    above = magnitudes[magnitudes >= one.least]
    if not len(above) or one.atom(one.least) > ATOM:
        return []
    counts = classes(one).sum(axis=0)
    laws = laws_of_moments(one.least, float(np.mean(10.0**above)))[:n_laws]
    try:
        return [maximise(law, np.arange(1.0, len(counts) + 1), counts) for law in laws]
    except Undefined:
        return []


def values_of_b(one: Catalogues, level: float) -> list[BValue]:
    """Aki's b of a group from its least magnitude on, and from higher ones."""
    fits = fits_of(one, 1)
    return b_values([*one.runs.values()], fits[0], one.least, enough.LEAST_CASCADES, level) if fits else []


def b_of_law(one: Catalogues, level: float) -> Estimate:
    """b of the power law up to the largest moment; no value where it cannot be fitted."""
    fits = fits_of(one, 1)
    return parameter(fits[0], 0, classes(one), level) if fits else Estimate()


def has_b(one: Catalogues, level: float) -> bool:
    """Whether a group has one b: no estimate is shown to leave what its law predicts for it."""
    return follows(values_of_b(one, level), len(one.runs), level)
