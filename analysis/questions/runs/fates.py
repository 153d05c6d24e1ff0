"""How runs end, how long stick-slip lasts, and what runs settle on.

Survival is by Kaplan and Meier. Certified runs, and those whose motion grew without limit, ended: see
`models.fates.ends_at`. Runs that are sliding without a certificate count as ended at their last events, and the
upper ends of intervals take them as not ended. All others are censored at t_end. `attractors` answers of runs of
which it is recorded what they settle on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from stickslip.analysis import burn_in
from stickslip.analysis.answer import (
    Answer,
    F,
    I,
    Picture,
    Question,
    Row,
    S,
    Table,
    columns,
    frame,
    long,
    named,
    systems,
)
from stickslip.analysis.catalogues import fineness
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import (
    Basis,
    Finding,
    Lack,
    Level,
    Lifetime,
    Quantity,
    Reason,
    Regimes,
    Share,
)
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.groups import Group
from stickslip.analysis.members import DRAWN, ENGINE_KEYS, SYSTEM_KEYS
from stickslip.analysis.models.attractors import SLIDING, plane
from stickslip.analysis.models.fates import (
    COLLAPSED,
    DIVERGED,
    ENDS,
    FAILED,
    LULL,
    MOVING,
    QUIET,
    SETTLED,
    SUSTAINED,
    UNMOVED,
    WATCHED,
    Curve,
    bounded_share,
    ends_at,
    half_ended,
    is_held,
    is_unstable,
    median,
    survival,
)
from stickslip.analysis.questions.runs import attractors
from stickslip.analysis.questions.runs import fate_figures as figures
from stickslip.analysis.questions.runs.attractors import PREDICATES
from stickslip.analysis.questions.runs.fate_figures import FATES
from stickslip.analysis.questions.runs.regimes import Tally, key_of, regimes
from stickslip.analysis.series.cascades import Window
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.effective import tau
from stickslip.analysis.stats.estimates import Estimate
from stickslip.pipeline.design.labels import Label, apart

MOST_CURVES = 8  # in one figure
MOST_RUNS = 200  # in one figure; more lines hide each other
MOST_STEPS = 2000  # of one curve: each is then a quarter of a dot wide
MOST_SETTINGS = 12  # with findings of their own; tables have them all
MOST_OPEN = 0.1  # of runs that may be undecided without an alert
BLOCK = 50.0  # units of time that n_stick is averaged over in the figure of all runs
LIFETIME = Quantity("lifetime", "median lifetime", more="longer", less="shorter")
DELAY = Quantity("last_event", "median delay of the last event")
MEAN = Quantity("mean", "mean number of sticking blocks in runs that last")
METHOD = (
    "A run ends at its last event, if it is certified that no block sticks again, or when its motion has left every"
    " bound; survival and medians are by Kaplan and Meier. Runs that are sliding, not certified, count as"
    " ended at their last events, and the upper ends of intervals take them as not ended."
)
#: What runs do, beyond what is certain of their fates: a closed set.
SLIDE, STICK_SLIP, UNSTABLE, GROW, STUCK = KINDS = ("slide", "stick-slip", "unstable", "grow", "stuck")
_LOOKS = (COLLAPSED, SUSTAINED, LULL, DIVERGED, UNMOVED)  # the fates as which they are drawn
_COUNTS = (*(f"n_{name}" for name in (*WATCHED, FAILED)), "n_moving")
_GROUP: Mapping[str, str] = {
    "group": S, "n": I, "kappa_n": F, "engine": S, "n_runs": I, **dict.fromkeys(_COUNTS, I), "n_held": I, "t_end": F,
    **{name + end: F for name in ("moving", "settled", "median", "mean", "drift") for end in ("", "_low", "_high")},
    "median_most": F, "last_end": F, "last_quiet": F, "effective_samples": F, "basis": S,
}  # fmt: skip
_SHIFT: Mapping[str, str] = {
    "setting": S, "reference": S, "n_systems": I, "n_open": I, "shift": F, "shift_low": F, "shift_high": F,
}  # fmt: skip
_CURVE = {"group": S, "t": F, "survival": F, "low": F, "high": F}
_RUN = {
    "group": S, "n": I, "kappa_n": F, "matrix": I, "unit": I, "member_id": S, "fate": S, "t": F, "growth_rate": F,
    "z_start": F, "w_start": F,
}  # fmt: skip


class Shift(NamedTuple):
    """How much later the last event of a system comes by another method: the median over systems."""

    setting: Label
    reference: Label
    n_systems: int
    n_open: int
    shift: Estimate


class Ends(NamedTuple):
    """The runs of a group: how many have each fate, when they ended, and their mean n_stick.

    Attributes
    ----------
    group : Group
    label : Label
        What tells it from the other groups of its method.
    method : Label
        What tells its method from others; empty if there is one.
    n_of : Counter
        Runs by fate.
    n_held : int
        Runs that count as sustained, of which all blocks have stuck for the last quarter.
    last_end, last_quiet : float, optional
        The latest end, and the latest last event of runs that are sliding without a certificate.
    """

    group: Group
    label: Label
    method: Label
    n_of: Counter[str]
    n_held: int
    moving: Estimate
    settled: Estimate
    lifetime: Estimate
    median_most: float | None
    left: float
    last_end: float | None
    last_quiet: float | None
    mean: Estimate
    drift: Estimate
    basis: enough.Basis

    @property
    def n_runs(self) -> int:
        """That did not fail."""
        return sum(self.n_of[name] for name in WATCHED)

    @property
    def n_units(self) -> int:
        return int(self.group.column("unit").nunique())

    @property
    def n_moving(self) -> int:
        return sum(self.n_of[name] for name in MOVING)

    @property
    def kinds(self) -> dict[str, int]:
        """How many runs do what, of `KINDS` those that occur."""
        n_of = self.n_of
        counts = (n_of[COLLAPSED] + n_of[QUIET], n_of[SUSTAINED] - self.n_held, n_of[LULL], n_of[DIVERGED])
        numbers = dict(zip(KINDS, (*counts, n_of[UNMOVED] + self.n_held), strict=True))
        return {kind: n for kind, n in numbers.items() if n}

    @property
    def drawn(self) -> dict[str, int]:
        """How many runs have each look of a fate: as `kinds`, with those that have no certificate apart."""
        n_of, n_held = self.n_of, self.n_held
        held = {SUSTAINED: n_of[SUSTAINED] - n_held, UNMOVED: n_of[UNMOVED] + n_held}
        return {name: held.get(name, n_of[name]) for name in FATES}

    @property
    def ended(self) -> str:
        """What runs have done that ended, or may have: a verb phrase."""
        ends = {name for name in (*ENDS, QUIET) if self.n_of[name]}
        if ends == {COLLAPSED}:
            return "have settled into steady sliding"
        if ends == {DIVERGED}:
            return "have grown without limit"
        return "have ended" if DIVERGED in ends else f"are sliding ({_certified(self)})"

    @property
    def t_end(self) -> float:
        return float(self.group.key["t_end"])

    @property
    def is_drifting(self) -> bool:
        """Whether a drift is shown, and is not harmless: few runs may show one of 1e-7."""
        low, high, size = self.drift.low, self.drift.high, self.basis.drift.value
        if low is None or high is None or low <= 0 <= high:
            return False
        return self.basis.code != enough.ENOUGH and (size is None or not abs(size) <= enough.MARGIN)

    def row(self, t_burn: float) -> Row:
        key, memory = self.group.key, tau(self.group.effective)
        return {
            "group": self.group.label, "n": key["n"], "kappa_n": _kappa_n(key), "engine": key["engine"],
            "n_runs": self.n_runs, **{f"n_{name}": self.n_of[name] for name in (*WATCHED, FAILED)},
            "n_moving": self.n_moving, "n_held": self.n_held, "t_end": self.t_end, **named("moving", self.moving),
            **named("settled", self.settled), **named("median", self.lifetime), "median_most": self.median_most,
            "last_end": self.last_end, "last_quiet": self.last_quiet, **named("mean", self.mean),
            **named("drift", self.drift), "basis": self.basis.code,
            "effective_samples": memory and len(self.group.units) * (self.t_end - t_burn) / (2 * memory),
        }  # fmt: skip


def answer(study: Study) -> Answer:
    """How the unchanged runs end and when, what they settle on, and whether what lasts is steady."""
    level, groups = study.settings.confidence, study.groups
    parts = [_ran(group) for group in groups]
    ends, curves = list[Ends](), dict[str, Curve]()
    for group, part, name in zip(groups, parts, _names(groups), strict=True):
        row, curve = _ends(study, group, *name, part)
        ends.append(row)
        if curve is not None:
            curves[group.label] = curve
    runs = _joined(groups, parts)
    shifts = _shifts(groups, level)
    averaged = [group for group in groups if len(burn_in.averaged(study, group))]
    averaged.sort(key=lambda group: -int(group.key["n"]))
    by_t_burn = burn_in.estimates(study, averaged)
    tested = burn_in.with_enough(burn_in.geweke(study, averaged), by_t_burn, 1 - level)
    tables: dict[str, Table] = {
        "fates": frame(_GROUP, (row.row(study.settings.t_burn) for row in ends)),
        "survival_curves": _curves_table(curves),
        "runs": long(len(runs), partial(_listed, groups, runs)),
        "last_events": frame(_SHIFT, (shift._asdict() | named("shift", shift.shift) for shift in shifts)),
        "burn_in": frame(burn_in.TESTS, tested),
        "by_t_burn": frame(burn_in.ESTIMATES, by_t_burn),
    }
    settled = attractors.settled(study)
    known = _with_attractors(study)
    spoken = [row for row in ends if row.n_runs and row.group.label not in known]
    findings, n_lead = _findings(study, runs, spoken, shifts)
    pictures = _pictures(study, runs, spoken, curves)
    method = METHOD
    if settled is not None:
        findings, n_lead = [*settled.findings, *findings], settled.n_lead
        tables |= settled.tables
        pictures = {**settled.figures, **pictures}
        method = f"{settled.method} {METHOD}" if spoken else settled.method
    if not findings:
        findings = [Lack("what became of the runs", Reason.NOT_RUN, "every run failed")]
    findings += _means(study, spoken)
    short = [row["group"] for row in tested if row["is_short"] and row["group"] not in known]
    drawable = burn_in.drawable(by_t_burn)
    drawn = next((name for name in (*short, *drawable) if name in drawable), "")
    if drawn and (short or len(pictures) > 1):  # the second stands on the first screen
        of_drawn = [row for row in by_t_burn if row["group"] == drawn]
        pictures["by_t_burn"] = _along_t_burn(study, drawn, of_drawn, drawn in short)
    alerts = _alerts(study, ends, spoken, short)
    return Answer(findings=findings, n_lead=n_lead, alerts=alerts, method=method, tables=tables, figures=pictures)


# ------------------------------------------------------------------------------------------------- findings


def _findings(
    study: Study, runs: pd.DataFrame, ends: Sequence[Ends], shifts: Sequence[Shift]
) -> tuple[list[Finding], int]:
    """What the runs of each method do, its lifetimes, and how much later last events come by another method."""
    leading: list[Finding] = []
    others: list[Finding] = []
    methods: dict[Label, list[Ends]] = {}
    for row in ends:
        methods.setdefault(row.method, []).append(row)
    outcomes = [[(row.kinds, row.n_of[QUIET] > 0) for row in rows] for rows in methods.values()]
    is_alike = len(methods) > 1 and all(outcome == outcomes[0] for outcome in outcomes)
    for k, (method, rows) in enumerate(methods.items()):
        lifetimes = _lifetimes(study, rows)
        if k == 0 or not is_alike:
            outcome, details = _outcome(
                study, runs, rows, Place.words("by every method") if is_alike else Place.of(method)
            )
            n_first = int(outcomes[k] not in outcomes[:k])
            leading += outcome[:n_first]
            others += [*outcome[n_first:], *details]
        first = next((lifetime for lifetime, is_new in lifetimes if is_new), None)
        leading += [first] if first is not None else []
        others += [lifetime for lifetime, _ in lifetimes if lifetime is not first]
    delays = [
        Level(
            DELAY,
            shift.shift,
            Place.of(shift.setting) + Place.words(f"after {shift.reference}"),
            None,
            _basis(study, shift.n_systems),
        )
        for shift in shifts
        if shift.shift.value is not None
    ]
    stable = _stability(study, runs, ends)
    return [*leading, *others, *delays[:MOST_SETTINGS], *stable], min(3, len(leading))


def _outcome(
    study: Study, runs: pd.DataFrame, rows: Sequence[Ends], method: Place
) -> tuple[list[Finding], list[Finding]]:
    """What the runs of a method do: shares where all settings are alike, else settings by outcome; and details."""
    alike = {tuple(row.kinds) for row in rows}
    if len(rows) == 1 or (len(alike) == 1 and len(rows[0].kinds) == 1):
        kinds = rows[0].kinds
        return [_share(study, runs, rows, kind, method) for kind in sorted(kinds, key=lambda kind: -kinds[kind])], []
    key, values = key_of([row.label for row in rows])
    words = {kind: _predicate(kind, *rows) for kind in KINDS}
    places = [Tally(tuple(words[kind] for kind in row.kinds), row.n_runs, row.n_runs, row.n_units) for row in rows]
    by_outcome = regimes(key, values, places, study.settings.confidence, systems(study))
    mixed = [row for row in rows if len(row.kinds) > 1][:MOST_SETTINGS]
    shares: list[Finding] = [_share(study, runs, [row], kind, _where(row)) for row in mixed for kind in row.kinds]
    return [Regimes("runs", by_outcome, method, _until(*rows))], shares


def _share(study: Study, runs: pd.DataFrame, rows: Sequence[Ends], kind: str, where: Place) -> Share:
    """The share of runs that do something; whether a run that slides so far sticks again cannot be told."""
    labels = [row.group.label for row in rows]
    part = runs[runs["group"].isin(labels) & (runs["fate"] != FAILED)]
    untold = (part["fate"] == QUIET) & (kind == STICK_SLIP)
    columns = ((part["kind"] == kind).to_numpy(), untold.to_numpy(), part["drawn"].to_numpy())
    estimate = _estimate(*columns, study.settings.confidence)
    things = "starts" if study.unit == "start" else "runs"
    return Share(kind, things, _predicate(kind, *rows), estimate, where, None, _basis(study, part["drawn"].nunique()))


def _estimate(has: np.ndarray, untold: np.ndarray, drawn: np.ndarray, confidence: float) -> Estimate:
    """Share of runs that have something, which is unknown of others; runs of one unit are dependent."""
    units = np.unique(drawn, return_inverse=True)[1]
    return bounded_share(
        np.column_stack([np.bincount(units, has), np.bincount(units, untold), np.bincount(units)]), confidence
    )


def _predicate(kind: str, *rows: Ends) -> str:
    """What runs at some settings do: a verb phrase in the plural."""
    until = _until(*rows)
    words = {
        SLIDE: f"are sliding {until} ({certified})" if (certified := _certified(*rows)) else PREDICATES[SLIDING],
        STICK_SLIP: f"still stick and slip {until}",
        UNSTABLE: f"are in unstable sliding {until}",
        GROW: "grow without limit",
        STUCK: f"are stuck {until}",
    }
    return words[kind]


def _until(*rows: Ends) -> str:
    """When runs at some settings are looked at."""
    ends = {row.t_end for row in rows}
    return f"at t = {ends.pop():g}" if len(ends) == 1 else "at their end"


def _certified(*rows: Ends) -> str:
    """What to say of certificates of runs that slide; empty if all have one."""
    if not any(row.n_of[QUIET] for row in rows):
        return ""
    return "not all certified" if any(row.n_of[COLLAPSED] for row in rows) else "not certified"


def _lifetimes(study: Study, rows: Sequence[Ends]) -> list[tuple[Finding, bool]]:
    """When half of the runs have ended, of the latest first; and whether that adds to what all runs do there."""
    reached = [row for row in rows if row.lifetime.value is not None]
    reached.sort(key=lambda row: -(row.lifetime.value or 0.0))
    lifetimes = (
        Lifetime(
            LIFETIME, "runs", "still stick and slip", row.lifetime, row.t_end, row.left, _where(row), None,
            _basis(study, row.n_units), row.ended,
        )
        for row in reached[:MOST_SETTINGS]
    )  # fmt: skip
    is_new = [row.lifetime.low is not None and (len(rows) == 1 or len(row.kinds) > 1) for row in reached]
    return list(zip(lifetimes, is_new, strict=False))


def _stability(study: Study, runs: pd.DataFrame, ends: Sequence[Ends]) -> list[Finding]:
    """What runs do whose state in which all blocks slip is linearly stable, and those of which it is unstable."""
    part = runs[runs["group"].isin([row.group.label for row in ends]) & (runs["fate"] != FAILED)]
    rates = study.data.table.own["growth_rate"].to_numpy(np.float64)[part["row"]]
    is_known, is_open = ~np.isnan(rates), np.asarray(is_unstable(rates))
    shares: list[Finding] = []
    for state, of, fate, predicate in (
        ("stable", is_known & ~is_open, COLLAPSED, PREDICATES[SLIDING]),
        ("unstable", is_known & is_open, DIVERGED, "grow without limit"),
    ):
        table = part[of]
        if len(table) and (part["fate"] == fate).any():
            has = (table["fate"] == fate).to_numpy()
            estimate = _estimate(has, has & False, table["drawn"].to_numpy(), study.settings.confidence)
            things = f"runs with a linearly {state} all-slip state"
            basis = _basis(study, table["drawn"].nunique())
            shares.append(Share(f"{state}_{fate}", things, predicate, estimate, basis=basis))
    return shares


def _means(study: Study, ends: Sequence[Ends]) -> list[Finding]:
    """Mean n_stick of the runs that stick and slip."""
    if study.unit == "start":
        return []
    moving = sorted((row for row in ends if row.mean.value is not None), key=lambda row: -int(row.group.key["n"]))
    return [
        Level(MEAN, row.mean, Place.of(row.group.name), None, _basis(study, len(row.group.units)))
        for row in moving[:MOST_SETTINGS]
    ]


def _alerts(study: Study, ends: Sequence[Ends], spoken: Sequence[Ends], short: Sequence[str]) -> list[Alert]:
    n_runs, n_failed = sum(row.n_runs for row in ends), sum(row.n_of[FAILED] for row in ends)
    total, n_spoken = sum((row.n_of for row in spoken), Counter[str]()), sum(row.n_runs for row in spoken)
    drifting = list(dict.fromkeys([*(row.group.label for row in spoken if row.is_drifting), *short]))
    n_open, n_settled = attractors.n_undecided(study)
    few = [row.n_units for row in spoken if row.basis.code == enough.FEW_MATRICES and row.n_moving > 1]
    alerts = []
    if n_failed:
        alerts.append(Alert.of(Code.FAILED, n=n_failed, of=n_runs + n_failed))
    if drifting:
        where = f" at {drifting[0]}" if len(drifting) == 1 else f" at {len(drifting)} settings"
        what, t_burn = "The number of sticking blocks", study.settings.t_burn
        alerts.append(Alert.of(Code.DRIFT, what=what, where=where, t_burn=t_burn))
    if n_open > MOST_OPEN * n_settled:
        alerts.append(Alert.of(Code.UNDECIDED, n=n_open, of=n_settled))
    if total[QUIET]:
        alerts.append(Alert.of(Code.UNCERTIFIED, n=total[QUIET], of=n_spoken))
    if total[LULL]:
        alerts.append(Alert.of(Code.TEMPORARY, n=total[LULL], of=n_spoken))
    if few and few[0] > 1:
        alerts.append(Alert.of(Code.FEW, n=few[0], units=f"{systems(study)}s"))
    return alerts[:3]


def _basis(study: Study, n: int) -> Basis:
    return Basis(n, systems(study))


def _where(row: Ends) -> Place:
    return Place.of(row.label) + Place.of(row.method)


# ------------------------------------------------------------------------------------------------- groups and runs


def _names(groups: Sequence[Group]) -> list[tuple[Label, Label]]:
    """What tells the method of each group from the others, and what tells its system."""
    parts = [label.parts for label in apart([group.name for group in groups])]
    of_method = {"", *ENGINE_KEYS}
    return [
        (
            Label.of([part for part in label if part[0] in of_method]),
            Label.of([part for part in label if part[0] not in of_method]),
        )
        for label in parts
    ]


def _with_attractors(study: Study) -> set[str]:
    """Names of groups of which it is recorded what runs settle on."""
    members = study.data.table.own
    if "attractor" not in members:
        return set()
    has = members["attractor"].notna().to_numpy()
    return {group.label for group in study.groups if has[group.rows].any()}


class Ran(NamedTuple):
    """The runs of a group, shape (m,) each.

    `row` among the members, `unit`, time of the last event, until when it moved, fate, and what it does: a place in
    `KINDS`, -1 if it failed.
    """

    row: np.ndarray
    unit: np.ndarray
    t_last: np.ndarray
    t: np.ndarray
    fate: np.ndarray
    kind: np.ndarray


def _ran(group: Group) -> Ran:
    fates, t_end = group.fates, float(group.key["t_end"])
    t_stop = group.column("t_stop").to_numpy(np.float64, na_value=np.nan)
    t_last, n_last = group.last.T
    t, _ = ends_at(fates, t_last, t_stop, np.broadcast_to(t_end, len(group)))
    is_stuck = (fates == UNMOVED) | ((fates == SUSTAINED) & is_held(t_last, n_last, int(group.key["n"]), t_end))
    moves = (fates == SUSTAINED) & ~is_stuck
    is_kind = [np.isin(fates, SETTLED), moves, fates == LULL, fates == DIVERGED, is_stuck]
    t = np.where(fates == FAILED, np.nan, t)
    kinds = np.select(is_kind, range(len(KINDS)), -1)
    return Ran(group.rows.astype(np.int32), group.column("unit").to_numpy(), t_last, t, fates, kinds.astype(np.int8))


def _joined(groups: Sequence[Group], parts: Sequence[Ran]) -> pd.DataFrame:
    """Runs of groups as one table; `drawn` numbers what was drawn: runs of a number are dependent."""
    every = Ran(*map(np.concatenate, zip(*parts, strict=True)))
    values = [tuple(group.key[name] for name in DRAWN) for group in groups]
    number = np.repeat(np.arange(len(groups)), [*map(len, groups)])
    setting = np.array([*map(values.index, values)])[number]
    units = pd.factorize(every.unit)[0]  # they may be any numbers
    return pd.DataFrame({
        "row": every.row,
        "t": every.t,
        "group": pd.Categorical.from_codes(number, pd.Index([group.label for group in groups])),
        "fate": pd.Categorical(every.fate, (*WATCHED, FAILED)),
        "kind": pd.Categorical.from_codes(every.kind, pd.Index(KINDS)),
        "drawn": pd.factorize(setting + len(values) * units)[0],
    }, copy=False)  # fmt: skip


def _listed(groups: Sequence[Group], runs: pd.DataFrame, rows: slice) -> pd.DataFrame:
    """Some rows of the table of runs."""
    part = runs.iloc[rows]
    members, of_group = groups[0].table.own.iloc[part["row"]], part["group"].cat.codes.to_numpy()
    of_members = {name: members[name].array for name in _RUN if name in members}
    more = {
        "n": np.array([group.key["n"] for group in groups])[of_group],
        "kappa_n": np.array([_kappa_n(group.key) for group in groups], dtype=np.float64)[of_group],
    }
    return columns(_RUN, [part.assign(**of_members, **more)])


def _thinned(curve: Curve) -> Curve:
    """A curve of survival with at most `MOST_STEPS` of its steps, the first and the last among them."""
    steps = np.unique(np.linspace(0, len(curve[0]) - 1, MOST_STEPS).astype(np.int64))
    t, share, low, high = (x[steps] for x in curve)
    return t, share, low, high


def _curves_table(curves: Mapping[str, Curve]) -> pd.DataFrame:
    if not curves:
        return frame(_CURVE, [])
    numbers = map(np.concatenate, zip(*curves.values(), strict=True))
    labels = np.repeat(np.array([*curves], dtype=object), [len(curve[0]) for curve in curves.values()])
    return columns(_CURVE, [pd.DataFrame(dict(zip(_CURVE, (labels, *numbers), strict=True)))])


def _kappa_n(key: Mapping[str, Any]) -> float | None:
    """kappa n; None where there is no spring between blocks, or K comes from a file."""
    return None if key["kappa"] is None or key["n"] == 1 else key["n"] * key["kappa"]


def _ends(study: Study, group: Group, method: Label, label: Label, runs: Ran) -> tuple[Ends, Curve | None]:
    """What is known of the runs of a group, and their survival; no curve if all failed."""
    level = study.settings.confidence
    _, units, t_last, t, fates, kinds = (column[runs.fate != FAILED] for column in runs)
    until = np.full(len(t), float(group.key["t_end"]))
    curve, lifetime, most, moving, settled = None, *(Estimate(reason="every run failed") for _ in range(4))
    is_quiet = fates == QUIET
    if len(t):
        curve = _thinned(survival(fates, t_last, t, until, level, units))
        lifetime, most = (
            half_ended(taken, t_last, t, until, level, units)
            for taken in (fates, np.where(is_quiet, SUSTAINED, fates))
        )
        moving = _estimate(np.isin(fates, MOVING), is_quiet, units, level)
        settled = _estimate(np.isin(fates, SETTLED), is_quiet & False, units, level)
    n_held = int(np.sum((kinds == KINDS.index(STUCK)) & (fates == SUSTAINED)))
    ends = Ends(
        group, label, method, Counter(group.fates.tolist()), n_held, moving, settled, lifetime, most.value,
        1.0 if curve is None else float(curve[1][-1]), _latest(t[np.isin(fates, ENDS)]), _latest(t_last[is_quiet]),
        group.mean(level), group.drift(level), group.basis(level),
    )  # fmt: skip
    return ends, curve


def _shifts(groups: Sequence[Group], level: float) -> list[Shift]:
    """How much later the last event of a system comes by another method than by the finest.

    Whether a certificate came in time makes no difference to an event, and systems are compared with themselves.
    """
    of_system: dict[tuple[Any, ...], list[Group]] = {}
    for group in sorted(groups, key=fineness):
        of_system.setdefault(tuple(group.key[name] for name in SYSTEM_KEYS), []).append(group)
    shifts = []
    for reference, *others in (groups for groups in of_system.values() if len(groups) > 1):
        before = _last_events(reference)
        for other in others:
            both = pd.concat([before, _last_events(other)], axis=1, join="inner").to_numpy()
            known = both[~np.isnan(both).any(axis=1)]
            delays = known[:, 1] - known[:, 0]
            shift = median(delays, np.full(len(delays), True), level)
            if len(delays):
                shift = replace(shift, value=float(np.median(delays)))
            shifts.append(Shift(other.name, reference.name, len(known), len(both) - len(known), shift))
    return shifts


def _last_events(group: Group) -> pd.Series:
    """The mean time of the last events of each unit's runs; NaN if one of them goes on, or failed."""
    times = np.where(np.isin(group.fates, (*ENDS, QUIET)), group.last[:, 0], np.nan)
    units, place = np.unique(group.column("unit").to_numpy(), return_inverse=True)
    return pd.Series(np.bincount(place, times) / np.bincount(place), index=units)


def _latest(times: np.ndarray) -> float | None:
    """The latest of some times; None if there is none."""
    return float(times.max()) if len(times) else None


# ------------------------------------------------------------------------------------------------- figures


def _pictures(
    study: Study, runs: pd.DataFrame, ends: Sequence[Ends], curves: Mapping[str, Curve]
) -> dict[str, Picture]:
    """Shares by fate, and survival if some runs ended; else n_stick of all runs of the largest group."""
    if not ends:
        return {}
    level, pictures = f"{100 * study.settings.confidence:g}%", dict[str, Picture]()
    if (starts := _basin(study, runs)) is not None:
        pictures["basin"] = starts
    key, values = key_of([row.label for row in ends]) if len({row.method for row in ends}) == 1 else ("", [])
    values = values or [str(_where(row)) for row in ends]
    if len(ends) > 1 and any(row.n_moving < row.n_runs for row in ends):
        drawn = [row.drawn for row in ends]
        counts = {name: [numbers[name] for numbers in drawn] for name in FATES}
        pictures["fates"] = Picture(
            partial(figures.shares, key, values, counts),
            "One colour: all runs ended alike. Shares of runs by what they do at the end, at each setting.",
        )
    if any(row.n_of[name] for row in ends for name in (*ENDS, QUIET)):
        places = np.unique(np.linspace(0, len(ends) - 1, MOST_CURVES).round().astype(int))
        chosen = _merged(key, [values[k] for k in places], [curves[ends[k].group.label] for k in places])
        more = f" {len(places)} of {len(ends)} settings are drawn." * (len(places) < len(ends))
        pictures["survival"] = Picture(
            partial(figures.survival_curves, chosen, max(row.t_end for row in ends)),
            "Curves fall as runs end, and level off where motion lasts. Share of runs that have not ended"
            f"{f', with {level} intervals where some end and some do not' * figures.has_bands(chosen)}.{more}",
        )
    if not pictures:
        row = max(ends, key=lambda row: int(row.group.key["n"]))
        paths = [_averaged(win) for _, _, win in islice(study.windows(row.group), MOST_RUNS)]
        if paths:
            pictures["runs"] = Picture(
                partial(figures.all_runs, paths),
                f"Each line is a run. Number of sticking blocks, in means over {BLOCK:g} units of time"
                f"{f' ({_where(row)})' if _where(row) else ''}.",
            )
    return pictures


def _merged(key: str, values: Sequence[str], curves: Sequence[Curve]) -> dict[str, Curve]:
    """Curves of survival by their names, those that coincide as one."""
    alike: dict[tuple[bytes, ...], list[int]] = {}
    for k, (t, share, _, _) in enumerate(curves):
        alike.setdefault((t.tobytes(), share.tobytes()), []).append(k)
    names = {f"{key} = " * bool(key) + listed([values[k] for k in group]): group[0] for group in alike.values()}
    return {name: curves[k] for name, k in names.items()}


def _basin(study: Study, runs: pd.DataFrame) -> Picture | None:
    """Starts of one system by what their runs do; None if all do the same, or their two numbers do not both vary.

    Of several systems or methods, the one with most runs.
    """
    members, kinds = study.data.table.own, np.full(len(study.data.table), -1)
    kinds[runs["row"]] = runs["kind"].cat.codes
    group = max(attractors.regardless_of_start(study, kinds >= 0), key=len)
    z, w = (members[name].to_numpy(np.float64, na_value=np.nan)[group.rows] for name in ("z_start", "w_start"))
    is_known, number = ~(np.isnan(z) | np.isnan(w)), kinds[group.rows]
    if not is_known.any() or len(np.unique(group.column("matrix"))) > 1 or (number == number[0]).all():
        return None
    starts = plane(z[is_known, np.newaxis], w[is_known, np.newaxis])
    if starts is None or len(starts.names) < 2:
        return None
    few = f", for the {is_known.sum():,} of {len(group):,} whose starts are stored" if not is_known.all() else ""
    seen, number = np.unique(number, return_inverse=True)
    slide = "sliding (not all certified)" if (runs["fate"] == QUIET).any() else FATES[COLLAPSED].words
    names: list[str] = [_LOOKS[k] for k in seen]
    looks = [(FATES[name], slide if name == COLLAPSED else FATES[name].words) for name in names]
    caption = f"Each colour is a basin. What a run does at the end, by its start{few}."
    return Picture(figures.basin(starts, number[is_known], looks), caption)


def _averaged(win: Window) -> tuple[np.ndarray, np.ndarray]:
    """Middles of blocks of `BLOCK` units of time, and the means of n_stick over them."""
    n_blocks = max(int((win.t_stop - win.t_start) // BLOCK), 1)
    return win.t_start + (np.arange(n_blocks) + 0.5) * (win.t_stop - win.t_start) / n_blocks, win.means(n_blocks)


def _along_t_burn(study: Study, name: str, rows: Sequence[Row], is_short: bool) -> Picture:
    t_burn = study.settings.t_burn
    after = f"after t_burn = {t_burn:g}"
    says = f"Not all curves are level {after}: it is too short." if is_short else f"No drift is shown {after}."
    return Picture(
        partial(burn_in.by_t_burn, rows, t_burn),
        f"{says} Estimates with other values of t_burn over those with {t_burn:g} ({name}).",
    )


def _leads(study: Study) -> bool:
    """Whether it is recorded what runs settle on, or most have ended."""
    members = study.data.table.own
    return "attractor" in members or bool(members["outcome"].isin(["collapsed", "diverged"]).mean() > 0.5)


QUESTION = Question(
    answer,
    title="How do runs end, and what do they settle on?",
    share=0.01,
    rank=2,
    leads=_leads,
    beside=("changes",),
)
