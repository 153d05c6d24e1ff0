"""The section that answers whether exits cluster beyond chance, with what triggered exits would have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from stickslip.analysis.groups import Group
from stickslip.analysis.questions.clustering_tables import (
    INDEPENDENT,
    POWER,
    SCHEMAS,
    Gathered,
    control_rows,
    events_rows,
    fano_rows,
    gather,
    pairs_rows,
    spans_rows,
)
from stickslip.analysis.report import chance_figures, words
from stickslip.analysis.report.section import Column, Data, Picture, Row, Section, Table
from stickslip.analysis.report.tables import drift, records, typed
from stickslip.analysis.stats.nulls import draws_each

#: Label, and at each x: the share of lengths above x means, observed, by chance, and of an exponential.
Tail = tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
TAIL = np.linspace(0.0, 7.0, 36)  # where the tails of durations and waiting times are drawn, in means


# --------------------------------------------------------------------------------------------------- words


def best_tau(rows: Sequence[Row]) -> Row | None:
    """The row whose control sees the smallest share: chosen by the instrument, not by the effect."""
    known = [row for row in rows if row["share_seen"] is not None]
    return min(known, key=lambda row: row["share_seen"]) if known else None


def verdict(rows: Sequence[Row], shares: Sequence[float], confidence: float) -> str:
    """Whether exits cluster beyond chance, from the rows of `pairs` of one group against its first null."""
    judged = [row for row in rows if row["is_beyond_chance"] is not None]
    if not judged:
        reason = next((row["reason"] for row in rows if row["reason"]), "no run has two exits after t_burn")
        return f"whether exits cluster: not enough data: {reason}"
    best = best_tau(judged)
    row = best or judged[0]
    within = f"{_percent(row['excess_low'])} to {_percent(row['excess_high'])}, {words.percent(confidence)} interval"
    size = f"pairs of exits within tau = {row['tau']:g} are {words.percent(abs(row['excess']))}"
    if row["share_seen"] is not None:
        bound = f"a share of triggered exits above {words.percent(row['share_seen'])} would have been seen"
    else:
        bound = f"not even {words.percent(max(shares))} of triggered exits would have been seen for sure"
    if not row["is_beyond_chance"]:
        kind = "more" if row["excess"] > 0 else "less"
        return (
            f"clustering of exits is not distinguishable from chance: {size} {kind} frequent than by "
            f"{row['null']} ({within}); {bound}"
        )
    if row["excess"] < 0:
        return f"exits keep apart: {size} less frequent than by {row['null']} ({within}); {bound}"
    alike = row["share_alike"]
    given = f"more than {words.percent(max(shares))}" if alike is None else words.percent(alike)
    text = (
        f"exits cluster beyond chance: {size} more frequent than by {row['null']} ({within}), "
        f"as {given} triggered exits would give"
    )
    widest = judged[-1]
    if widest["is_beyond_chance"] and widest["excess"] > 0.5 * row["excess"]:
        text += (
            f"; but within tau = {widest['tau']:g} they still are by {words.percent(widest['excess'])}, so that a "
            "rate which all blocks share and which changes in time explains most of it, not triggering"
        )
    return text


def _percent(value: float) -> str:
    return ("+" if value >= 0 else "-") + words.percent(abs(value))


def _other_taus(rows: Sequence[Row], confidence: float) -> str:
    judged = [row for row in rows if row["is_beyond_chance"] is not None]
    beyond = [row for row in judged if row["is_beyond_chance"]]
    low, high = (pick(row["excess"] for row in judged) for pick in (min, max))
    text = (
        f"over tau from {judged[0]['tau']:g} to {judged[-1]['tau']:g} the excess of pairs lies between "
        f"{_percent(low)} and {_percent(high)}; {len(beyond)} of {len(judged)} intervals exclude zero, where "
        f"{words.number(len(judged) * (1 - confidence), 2)} would by luck"
    )
    if beyond:
        places = ", ".join(f"{_percent(row['excess'])} within {row['tau']:g}" for row in beyond)
        text += f" ({places})"
    return text


def _fano_sentence(rows: Sequence[Row]) -> str:
    judged = [row for row in rows if row["is_beyond_chance"] is not None]
    if not judged:
        return "Fano factor of exits: not enough data"
    beyond = [row for row in judged if row["is_beyond_chance"]]
    text = (
        f"the Fano factor of exits differs from {judged[0]['null']} at {len(beyond)} of "
        f"{words.count(len(judged), 'length')} of window"
    )
    worst = max(beyond or judged, key=lambda row: abs(row["difference"]))
    gap = f"{words.number(worst['fano'])} against {words.number(worst['fano_null'])}"
    return f"{text}, {'the most' if beyond else 'the largest gap'} in windows of {worst['window']:g}: {gap}"


def _spans_sentence(rows: Sequence[Row]) -> str:
    parts = []
    for row in rows:
        if row["is_beyond_chance"] is None:
            parts.append(f"{row['quantity']}s: not enough data: {row['reason']}")
            continue
        kind = "differs from" if row["is_beyond_chance"] else "not distinguishable from"
        parts.append(
            f"{row['quantity']}s have a mean of {words.number(row['mean'])} "
            f"(chance {words.number(row['mean_null'])}) and vary by {words.number(row['variation'])} of it, "
            f"{kind} chance's {words.number(row['variation_null'])}"
        )
    by_law = "An exponential law varies by 1, but waiting times from start to start do not follow one even by chance"
    return f"{'; '.join(parts)}. {by_law}"


# ------------------------------------------------------------------------------------------- the section


def clustering_section(
    data: Data,
    found: Sequence[Group],
    *,
    t_burn: float,
    taus: Sequence[float],
    lengths: Sequence[float] = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0),
    shares: Sequence[float] = (0.02, 0.05, 0.2),
    delay: float = 0.1,
    resamples: int = 20,
    repeats: int = 10,
    confidence: float = 0.95,
    seed: int = 0,
) -> Section:
    """Whether exits cluster beyond chance, how much, and what share of triggered exits would have been seen.

    Parameters
    ----------
    data : Data
        With `events` the null is rotation of blocks; without, independent exits.
    found : sequence of Group
        Filled groups.
    t_burn : float
    taus : sequence of float
        Within which pairs of exits are counted.
    lengths : sequence of float
        Of windows of the Fano factor; each is made to tile the time after t_burn.
    shares : sequence of float
        Of exits that follow another in the positive controls.
    delay : float
        Mean of their exponential delay, in mean gaps between exits.
    resamples, repeats : int
        Draws of the nulls, and controls, a run; at least 2 and 1. Fewer in large groups (`draws_each`).
    confidence : float
    seed : int
    """
    shown = list(found)
    taus, lengths = sorted(taus), sorted(lengths)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in SCHEMAS}
    statements: list[list[str]] = []
    lead: list[str] = []
    tails: list[Tail] = []
    checks: list[str] = []
    for group in shown:
        one = gather(
            data, group, t_burn=t_burn, taus=taus, lengths=lengths, shares=shares, delay=delay,
            resamples=draws_each(resamples, len(group.taus), least=10),
            repeats=draws_each(repeats, len(group.taus), least=2), seed=seed,
        )  # fmt: skip
        made = {
            "pairs": pairs_rows(one, taus, confidence),
            "fano": fano_rows(one, lengths, confidence),
            "events_by_null": events_rows(one, confidence),
            "spans": spans_rows(one, confidence),
            "control": control_rows(one, taus, lengths, confidence),
        }
        for name, some in made.items():
            rows[name] += some
        first = [row for row in made["pairs"] if row["null"] == one.null]
        moved = drift(group, confidence)
        if moved.low is not None and moved.high is not None and not moved.low <= 0 <= moved.high:
            said = [
                f"whether exits cluster is not judged: n_stick drifts by {words.signed(moved.value or 0.0)} after "
                f"t_burn = {t_burn:g}, and a rate that changes for all blocks shows as pairs too"
            ]
        else:
            said = [verdict(first, shares, confidence)]
        if len(first) and any(row["is_beyond_chance"] is not None for row in first):
            said += [_other_taus(first, confidence), _fano_sentence(made["fano"]), _spans_sentence(made["spans"])]
        said = [f"{group.label}: {words.sentence(text)}" for text in said]
        statements.append(said)
        lead += said[:1] if len(said) > 1 else []
        tails += _tails(group.label, one)
        if one.null == INDEPENDENT:
            checks.append(
                f"{group.label}: without events of single blocks the null is independent exits, which does not keep "
                "that a block must stick before it lets go; record events for the null of no coupling."
            )
    frames = {name: typed(keys, rows[name]) for name, keys in SCHEMAS.items()}
    return Section(
        title="Do exits cluster beyond chance?",
        question="Does one block letting go make others let go, more than blocks that ignore each other would show?",
        # groups that there is more to say of than one sentence first: long lists are folded on the page
        statements=tuple(line for said in sorted(statements, key=lambda said: len(said) == 1) for line in said),
        lead=tuple(lead),
        method=(
            "Pairs of exits within tau of each other and Fano factors of counts, against what is expected (in closed "
            "form) if each block's own series is turned in time by a random amount, so that coupling alone is "
            "broken; intervals over matrices. Positive control: the same estimators on such surrogates with a share "
            f"of the exits moved to follow another by an exponential delay of {delay:g} mean gaps, up to {repeats} "
            f"times each; a share counts as seen if {words.percent(POWER)} of such ensembles would show it at the "
            "stated level. The verdict reads the tau at which the control sees the smallest share."
        ),
        tables=tuple(Table(name, _CAPTIONS[name], frames[name], _COLUMNS[name], max_rows=60) for name in SCHEMAS),
        pictures=tuple(_pictures(shown, {name: records(frame) for name, frame in frames.items()}, tails)),
        assumptions=(
            "A rate that all blocks share and that changes in time (a drift or a common rhythm) shows as an excess "
            "of pairs too, at every tau up to its period: it is coupling, but not triggering, which shows at tau "
            "below the mean gap alone. Runs are taken as stationary after t_burn.",
            *checks,
        ),
    )


_ALIKE = Column("as triggered", "share_alike", show=words.percent)
_SEEN = Column("seen above", "share_seen", show=words.percent)
_CAPTIONS = {
    "pairs": "Pairs of exits less than tau apart: excess over each null (observed / expected - 1); the share of "
    "triggered exits that would give it, and the smallest that would have been seen.",
    "fano": "Fano factor of the number of exits in windows, observed and by chance (Poisson: 1).",
    "events_by_null": "gamma by events against each null model.",
    "spans": "Durations of cascades of two exits and more, waiting times from start to start: mean and variation.",
    "control": "Positive control: what each share of triggered exits shows, and how often it is told from chance.",
}
_COLUMNS: Mapping[str, tuple[Column, ...]] = {
    "pairs": (
        Column("group", "group"), Column("null", "null"), Column("tau", "tau"),
        Column("pairs", "n_pairs", show=lambda n: f"{n:.0f}"),
        Column("by chance", "n_pairs_null", show=lambda n: f"{n:.0f}"), Column("excess", "excess", show=words.signed),
        Column("interval", ("excess_low", "excess_high")), _ALIKE, _SEEN,
    ),
    "fano": (
        Column("group", "group"), Column("window", "window"), Column("Fano", "fano"),
        Column("by chance", "fano_null"), Column("difference", "difference", show=words.signed),
        Column("interval", ("low", "high")), Column("beyond chance", "is_beyond_chance"),
    ),
    "events_by_null": (
        Column("group", "group"), Column("null", "null"), Column("gamma", "gamma", 4),
        Column("by chance", "gamma_null", 4), Column("difference", "difference", show=words.signed),
        Column("interval", ("low", "high")), Column("beyond chance", "is_beyond_chance"),
    ),
    "spans": (
        Column("group", "group"), Column("quantity", "quantity"), Column("number", "n"), Column("mean", "mean"),
        Column("mean by chance", "mean_null"), Column("variation", "variation"),
        Column("interval", ("variation_low", "variation_high")), Column("Poisson", "variation_independent"),
        Column("by chance", "variation_null"), Column("beyond chance", "is_beyond_chance"),
    ),
    "control": (
        Column("group", "group"), Column("share", "share", show=words.percent), Column("statistic", "statistic"),
        Column("tau or window", "scale"), Column("value", "value"), Column("interval", ("low", "high")),
        Column("seen in", "seen", show=words.percent),
    ),
}  # fmt: skip


def _tails(label: str, one: Gathered) -> list[Tail]:
    found = []
    for name, quantity in (("durations", "durations"), ("waits", "waiting times")):
        observed, chance = (
            np.concatenate(one.tails.get(f"{name} {of}", [np.zeros(0)])) for of in ("observed", "chance")
        )
        if len(observed) and len(chance):
            found.append((f"{label}: {quantity}", TAIL, _above(observed), _above(chance), np.exp(-TAIL)))
    return found


def _above(values: np.ndarray) -> np.ndarray:
    """Share of values above each multiple of their mean; NaN, which is not drawn, where there is none."""
    share = 1.0 - np.searchsorted(np.sort(values), TAIL * values.mean(), side="right") / len(values)
    return np.where(share > 0, share, np.nan)


def _pictures(
    shown: Sequence[Group],
    rows: Mapping[str, list[dict[Any, Any]]],
    tails: Sequence[Tail],
) -> list[Picture]:
    panels = []
    for group in shown:
        mine = {name: [row for row in some if row["group"] == group.label] for name, some in rows.items()}
        first = [row for row in mine["pairs"] if row["null"] == mine["pairs"][0]["null"]]
        if any(row["excess"] is not None for row in first):
            panels.append((group.label, first, mine["fano"], mine["control"]))
    found = []
    if panels:
        found.append(
            Picture(
                partial(chance_figures.clustering, panels),
                "Left: excess of pairs of exits over chance, with intervals over matrices, and what shares of "
                "triggered exits would have shown (linear within ±2%, logarithmic beyond). Right: Fano factor of "
                "exits against the length of the windows.",
                "Excess of pairs of exits against tau, and Fano factor against window, beside chance and controls.",
            )
        )
    if tails:
        found.append(
            Picture(
                partial(chance_figures.tails, tails),
                "Durations of cascades of two exits and more, and times between starts of cascades, by events.",
                "Share of durations and waiting times longer than a multiple of their mean.",
            )
        )
    return found
