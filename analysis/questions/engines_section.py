"""The report's section on engines: how law, smoothing, threshold and tolerance move each statistic.

All settings run on the same random systems, so every bias is paired by matrix. The exact law at its tightest
tolerance is the reference of other laws, the tightest tolerance that of looser ones, and the members' own definition
of sticking that of further thresholds, read off the same runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stickslip.analysis.groups import ENGINE_KEYS, SYSTEM_KEYS, TOLERANCES, Group
from stickslip.analysis.questions.contrast import (
    CERTIFIED,
    SHARES_ADJUSTED,
    Sample,
    Statistic,
    contrast,
    in_words,
    judged,
    margin_in_words,
    sample,
    size_in_words,
    statistics,
)
from stickslip.analysis.report import change_figures, words
from stickslip.analysis.report.section import Column, Data, Rows, Section, Table
from stickslip.analysis.report.tables import F, I, S, typed
from stickslip.analysis.stats.compare import DIFFERENT, EQUIVALENT, OPEN

LAW, TOLERANCE, THRESHOLD = "engines", "tolerances", "thresholds"
#: A difference of the laws beyond this many margins is none that smoothing explains, for eps up to _SMOOTH: the
#: sigmoid differs from the exact law by O(eps), by 3% in mean n_stick at eps = 0.03. Above, more is allowed, as eps.
_EXPLAINED, _SMOOTH = 2.0, 0.03
_SCHEMA = {
    "group": S, "setting": S, "reference": S, "threshold": F, "quantity": S, "n_matrices": I, "of_reference": F,
    "of_reference_low": F, "of_reference_high": F, "value": F, "difference": F, "difference_low": F,
    "difference_high": F, "relative": F, "relative_low": F, "relative_high": F, "margin": F, "sampling_error": F,
    "in_errors": F, "is_within_error": "boolean", "p_equivalent": F, "p_different": F, "p_equivalent_holm": F,
    "p_different_holm": F, "verdict": S, "statement": S,
}  # fmt: skip


@dataclass(frozen=True)
class _Pair:
    """A setting and what it is set against; `threshold` is a further definition of sticking, read off its runs."""

    kind: str
    reference: Group
    other: Group
    threshold: float | None = None

    @property
    def label(self) -> str:
        own = self.other.label
        return own if self.threshold is None else f"{own}, |w - v| < {self.threshold:g} r eps"


def engines_section(
    data: Data, found: Sequence[Group], *, t_burn: float, margins: Mapping[str, float], confidence: float
) -> Section | None:  # fmt: skip
    """How the choice of engine and of its settings moves each statistic; None with one setting, or without margins.

    Parameters
    ----------
    data : Data
        `thresholds` are compared where there are any.
    found : sequence of Group
        Of unchanged members.
    t_burn : float
    margins : mapping of str to float
        As of `robustness_section`.
    confidence : float
    """
    pairs = list(_pairs(data, found))
    if not pairs or not margins:
        return None
    samples: dict[tuple[str, float | None], Sample] = {}

    def of(group: Group, threshold: float | None) -> Sample:
        key = (group.label, threshold)
        if key not in samples:
            series = None
            if threshold is not None:
                series = {name: points for (name, c), points in data.thresholds.items() if c == threshold}
            samples[key] = sample(group.label, group.members, data, t_burn, series)
        return samples[key]

    rows: dict[str, Rows] = {LAW: [], TOLERANCE: [], THRESHOLD: []}
    for kind, reference in dict.fromkeys((pair.kind, pair.reference.label) for pair in pairs):
        some = [pair for pair in pairs if (pair.kind, pair.reference.label) == (kind, reference)]
        listed = [
            (pair, contrast(one, of(pair.reference, None), of(pair.other, pair.threshold), True, confidence))
            for pair in some
            for one in statistics(margins)
            if _applies(one, pair)
        ]
        made = judged([one for _, one in listed], 1 - confidence)
        rows[kind] += [_completed(row, pair) for row, (pair, _) in zip(made, listed, strict=True)]
    lead, notes = _statements(rows)
    alarms = tuple(_alarms(rows[LAW]))
    panels = [
        (setting, [row for row in some if row["setting"] == setting and row["p_equivalent"] is not None])
        for some in (rows[LAW], rows[TOLERANCE])
        for setting in dict.fromkeys(row["setting"] for row in some)
    ]
    panels = [panel for panel in panels if panel[1]]
    return Section(
        title="Engines on the same matrices",
        question="How far do the friction law, its smoothing, the threshold of sticking and the tolerance move each "
        "statistic?",
        statements=tuple(f"{text}." for text in (*lead, *notes)),
        lead=tuple(f"{text}." for text in lead),
        alarms=alarms,
        method=(
            "Every bias is that of a setting minus its reference, paired by matrix, on the matrices where both "
            "reached t_end. It is judged by two one-sided t tests against the declared margins: equivalent where a "
            "bias beyond the margin is excluded, different where no bias at all is, and open otherwise; p-values are "
            "adjusted by Holm's rule over all settings of one reference. Sampling "
            f"error: half the width of the reference's own {words.percent(confidence)} interval on these matrices. A "
            "tolerance is sufficient if for every statistic the whole interval of its bias lies within that."
        ),
        tables=tuple(_table(kind, rows[kind]) for kind in rows if rows[kind]),
        pictures=(
            change_figures.contrasts(
                panels,
                "Bias against the reference in units of the declared margin (band), with the interval of the "
                f"equivalence test. {change_figures.HOW_TO_READ}",
            ),
        )
        if panels
        else (),
        assumptions=(
            "An interval that contains zero does not show that two settings agree; it bounds how much they differ.",
        ),
    )


def _pairs(data: Data, found: Sequence[Group]) -> Iterator[_Pair]:
    """By kind; a looser tolerance is compared with the tightest of its own engine only."""
    systems: dict[tuple[Any, ...], list[Group]] = {}
    for group in found:
        systems.setdefault(tuple(group.key[name] for name in SYSTEM_KEYS), []).append(group)
    thresholds: dict[str, set[float]] = {}
    for member_id, threshold in data.thresholds:
        thresholds.setdefault(member_id, set()).add(threshold)
    for some in systems.values():
        families: dict[tuple[Any, ...], list[Group]] = {}
        for group in sorted(some, key=_tightness):
            kept = tuple(group.key[name] for name in ENGINE_KEYS if name not in TOLERANCES)
            families.setdefault(kept, []).append(group)
        tightest = sorted((family[0] for family in families.values()), key=_exactness)
        yield from (_Pair(LAW, tightest[0], group) for group in tightest[1:])
        for family in families.values():
            yield from (_Pair(TOLERANCE, family[0], group) for group in family[1:])
            of_members = (thresholds.get(member_id, set()) for member_id in family[0].members["member_id"])
            yield from (_Pair(THRESHOLD, family[0], family[0], c) for c in sorted(set().union(*of_members)))


def _applies(one: Statistic, pair: _Pair) -> bool:
    """Further thresholds end no run, and only one law certifies a collapse."""
    return not one.is_share or (pair.threshold is None and (pair.kind != LAW or one.name != CERTIFIED))


def _tightness(group: Group) -> float:
    return next((float(group.key[name]) for name in TOLERANCES if group.key[name] is not None), 0.0)


def _exactness(group: Group) -> tuple[bool, float]:
    """The exact law first, then the least smoothing."""
    return group.key["engine"] != "coulomb", float(group.key["eps"] or 0.0)


def _completed(row: dict[str, Any], pair: _Pair) -> dict[str, Any]:
    row |= {
        "group": pair.other.label, "setting": pair.label, "reference": pair.reference.label,
        "threshold": pair.threshold, "n_matrices": row["n_first"], "of_reference": row["first"],
        "of_reference_low": row["first_low"], "of_reference_high": row["first_high"], "value": row["second"],
        "statement": in_words(row), "is_suspect": pair.kind == LAW and _is_suspect(row, pair),
    }  # fmt: skip
    low, high = row["first_low"], row["first_high"]
    error = None if low is None or high is None else 0.5 * (high - low)
    if error and row["difference_low"] is not None:
        row |= {
            "sampling_error": error, "in_errors": row["difference"] / error,
            "is_within_error": bool(max(-row["difference_low"], row["difference_high"]) <= error),
        }  # fmt: skip
    return row


def _statements(rows: Mapping[str, Rows]) -> tuple[list[str], list[str]]:
    lead, notes = [], []
    for setting in _settings(rows[LAW]):
        lead.append(_law_words([row for row in rows[LAW] if row["setting"] == setting]))
    for reference in dict.fromkeys(row["reference"] for row in rows[TOLERANCE]):
        lead.append(_tolerance_words([row for row in rows[TOLERANCE] if row["reference"] == reference]))
    for group in dict.fromkeys(row["group"] for row in rows[THRESHOLD]):
        notes.append(_threshold_words([row for row in rows[THRESHOLD] if row["group"] == group]))
    return lead, notes


def _is_suspect(row: Mapping[str, Any], pair: _Pair) -> bool:
    """Whether a statistic differs between the exact law and the sigmoid by more than smoothing explains.

    The rule, which is here alone: the difference is significant after adjustment, and its whole interval lies beyond
    `_EXPLAINED` margins times max(1, eps / _SMOOTH). Where one law has none of it, there is no relative difference:
    it is suspect if the other's interval excludes zero. Two exact or two smoothed settings are not judged.
    """
    if {pair.reference.key["engine"], pair.other.key["engine"]} != {"coulomb", "sigmoid"}:
        return False
    if not row["is_share"] and (row["first"] == 0.0) != (row["second"] == 0.0):
        low = row["second_low"] if row["first"] == 0.0 else row["first_low"]
        return low is not None and low > 0.0
    if row["verdict"] != DIFFERENT:
        return False
    allowed = _EXPLAINED * row["margin"] * max(1.0, float(pair.other.key["eps"]) / _SMOOTH)
    return bool(row["relative_low"] > allowed or row["relative_high"] < -allowed)


def _alarms(rows: Rows) -> Iterator[str]:
    """One sentence for each setting of the sigmoid in which something is suspect."""
    for setting in _settings(rows):
        some = [row for row in rows if row["setting"] == setting and row["is_suspect"]]
        if some:
            first = some[0]
            value, other = (words.number(first[name], 3) for name in ("of_reference", "value"))
            more = f", and {words.count(len(some) - 1, 'further statistic')}" if len(some) > 1 else ""
            yield (
                f"The numerics are suspect, not the physics: {first['quantity']} is {value} under "
                f"{first['reference']} and {other} under {setting}{more}; smoothing does not explain that. Check "
                "both engines on one matrix, with tighter tolerances and less smoothing, before you use any number."
            )


def _settings(rows: Rows) -> list[str]:
    return list(dict.fromkeys(row["setting"] for row in rows))


def _law_words(rows: Rows) -> str:
    tested = [row for row in rows if row["p_equivalent"] is not None]
    setting, reference = rows[0]["setting"], rows[0]["reference"].split(", ", 1)[-1]
    if not tested:
        return f"{setting}: Against {reference}: not enough data: {rows[0]['reason']}"
    by = {verdict: [row for row in tested if row["verdict"] == verdict] for verdict in (EQUIVALENT, DIFFERENT, OPEN)}
    text = f"{setting}: Against {reference} on the same {words.count(tested[0]['n_matrices'], 'matrix')}, "
    text += f"{len(by[EQUIVALENT])} of {words.count(len(tested), 'statistic')} are equivalent within the margins"
    if by[DIFFERENT]:
        worst = max(by[DIFFERENT], key=lambda row: abs(row["relative"]) / row["margin"])
        found = f"{worst['quantity']}, {size_in_words(worst)} against a margin of {margin_in_words(worst)}"
        text += (
            f"; 1 differs: {found}"
            if len(by[DIFFERENT]) == 1
            else f"; {len(by[DIFFERENT])} differ, most of all {found}"
        )
    if by[OPEN]:
        named = ", ".join(row["quantity"] for row in by[OPEN][:3])
        others = f" and {len(by[OPEN]) - 3} more" if len(by[OPEN]) > 3 else ""
        text += f"; the matrices are too few to tell for {named}{others}"
    return text


def _tolerance_words(rows: Rows) -> str:
    """The loosest tolerance that is sufficient, as are all tighter ones."""
    settings = _settings(rows)  # from the tightest to the loosest
    reference, sufficient = rows[0]["reference"], None
    for setting in settings:
        some = [row for row in rows if row["setting"] == setting and not row["is_share"]]
        if not all(row.get("is_within_error") for row in some):
            break
        sufficient = setting
    if sufficient is None:
        known = [row for row in rows if row["setting"] == settings[0] and row.get("in_errors") is not None]
        why = "no statistic can be compared"
        if known:
            worst = max(known, key=_reach)
            why = f"the bias of {worst['quantity']} in {settings[0]} may exceed its sampling error"
        return f"{reference}: No looser tolerance is shown to be sufficient: {why}"
    text = (
        f"{reference}: The loosest tolerance at which no statistic moves by more than its sampling error is that of "
    )
    text += f"{sufficient}, the setting this scene should use"
    left = len(settings) - settings.index(sufficient) - 1
    return f"{text}; {words.count(left, 'looser one')} not shown to be sufficient" if left else text


def _reach(row: Mapping[str, Any]) -> float:
    """How far the bias may go, in sampling errors."""
    return float(max(-row["difference_low"], row["difference_high"]) / row["sampling_error"])


def _threshold_words(rows: Rows) -> str:
    known = [row for row in rows if row.get("relative") is not None]
    least, most = (pick(row["threshold"] for row in rows) for pick in (min, max))
    head = f"{rows[0]['group']}: Thresholds c r eps of sticking, c = {least:g} to {most:g} on the same runs"
    if not known:
        return f"{head}: not enough data: {rows[0]['reason']}"
    parts = []
    for quantity in ("mean n_stick", "exit rate", "gamma (events)"):
        some = [row["relative"] for row in known if row["quantity"] == quantity]
        if some:
            parts.append(f"{quantity} by {words.signed_percent(min(some))} to {words.signed_percent(max(some))}")
    return f"{head}, move {', '.join(parts)}"


def _table(kind: str, rows: Rows) -> Table:
    captions = {
        LAW: "Bias against the exact law (else the least smoothing) at its tightest tolerance, paired by matrix.",
        TOLERANCE: "Bias of looser tolerances against the tightest, paired by matrix.",
        THRESHOLD: "What further thresholds of sticking give on the same runs, against the members' own definition.",
    }
    units = (
        " Bias and interval are value minus reference; the verdict is on that difference relative to the reference, "
        "which has an interval of its own: narrower where matrices differ in scale more than in the ratio."
    )
    if any(row["is_share"] for row in rows):
        units += (
            " Shares are of one run a matrix, gone quiet if collapsed or silent; their bias, which the verdict "
            f"is on, is estimated {SHARES_ADJUSTED}."
        )
    return Table(
        kind,
        captions[kind] + units,
        typed(_SCHEMA, rows),
        (
            Column("setting", "setting"), Column("statistic", "quantity"), Column("matrices", "n_matrices"),
            Column("reference", "of_reference"), Column("value", "value"), Column("bias", "difference", 2),
            Column("interval", ("difference_low", "difference_high")),
            Column("in sampling errors", "in_errors", 2),
            Column("p equivalent, adjusted", "p_equivalent_holm", show=words.p_text),
            Column("p different, adjusted", "p_different_holm", show=words.p_text), Column("verdict", "statement"),
        ),
        max_rows=100,
        is_open=kind == LAW,
    )  # fmt: skip
