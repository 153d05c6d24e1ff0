"""Sentences made from numbers: they change when the numbers do, and size comes before significance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stickslip.analysis.stats.estimates import LN2, Estimate
from stickslip.sim.engines import ENGINES, SETTINGS

FEW = 5  # matrices: below so many an interval is wide, and hardly an interval
PAPER_GAMMA = 0.74  # figure 5 of the paper, where f is proportional to exp(-gamma dn)

Row = Mapping[str, Any]


def group_label(key: Row, rivals: Sequence[Row]) -> str:
    """Name of a group: n, engine, how it decides what sticks, and whatever sets it apart from the others."""
    parts = [f"n = {key['n']}", str(key["engine"])]
    defaults = ENGINES[key["engine"]].defaults()
    for name in key:
        if name in ("n", "engine", "perturbation_size") or key[name] is None:
            continue
        values = {rival[name] for rival in rivals if rival["engine"] == key["engine"]}
        rule = SETTINGS[name].in_label if name in SETTINGS else "if it differs"
        is_said = rule == "always" or (rule == "unless default" and key[name] != defaults[name])
        if is_said or len(values) > 1:
            parts.append(f"{name} = {_plain(key[name])}")
    if key["perturbation_size"] > 0:
        parts.append(f"perturbed by {_plain(key['perturbation_size'])}")
    return ", ".join(parts)


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table cell; a dash where there is none."""
    if value is None:
        return "–"
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:#.{digits}g}".rstrip(".")


def signed(value: float) -> str:
    return f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.2g}"


def signed_percent(value: float) -> str:
    """A relative difference with its sign."""
    return f"{100 * value:+.2g}%" if abs(value) < 1 else f"{100 * value:+.0f}%"


def percent(value: float) -> str:
    return f"{100 * value:.0f}%" if abs(value) >= 1 else f"{100 * value:.{2 if abs(value) < 0.1 else 3}g}%"


def p_text(p_value: float) -> str:
    """A p-value for a reader: not more digits than it deserves."""
    return "< 0.001" if p_value < 0.001 else f"{p_value:.2g}"


def p_is(*p_values: float) -> str:
    """ "p = 0.2", or several as they range."""
    shown = " to ".join(dict.fromkeys(p_text(p_value) for p_value in p_values))
    return f"p = {shown}".replace("= <", "<")


def interval(low: float | None, high: float | None) -> str:
    return "no interval" if low is None or high is None else f"{number(low)} to {number(high)}"


def interval_at(confidence: float, low: float | None, high: float | None) -> str:
    """An interval with its level; "no interval" where there is none."""
    level = "" if low is None or high is None else f"{percent(confidence)} interval "
    return f"{level}{interval(low, high)}"


def count(n: int, noun: str) -> str:
    plural = {"matrix": "matrices"}.get(noun, noun + "s")
    return f"{n} {noun if n == 1 else plural}"


def verdict(against: Estimate, gamma0: float | None, confidence: float) -> tuple[str, str]:
    """Verdict and statement on gamma - gamma0, paired over matrices."""
    if against.value is None or gamma0 is None:
        return "not enough data", f"not enough data: {against.reason}"
    share = percent(abs(against.value) / gamma0)
    if against.low is None or against.high is None:
        return (
            "not enough data",
            f"not enough data: {signed(against.value)} from chance ({share} of gamma0), but {against.reason}",
        )
    within = f"{signed(against.low)} to {signed(against.high)}"
    if against.low <= 0 <= against.high:
        bound = percent(max(-against.low, against.high) / gamma0)
        return (
            "not distinguishable",
            f"not distinguishable from chance: the difference lies within {within} "
            f"({percent(confidence)} interval), at most {bound} of gamma0",
        )
    kind = "larger" if against.value < 0 else "smaller"
    return (
        "differs",
        f"differs from chance by {signed(against.value)} ({within}), that is {share} of gamma0: "
        f"{kind} cascades than in random order",
    )


def _against_zero(difference: Estimate, unseen: str, seen: str) -> str:
    """A difference in words; `unseen` and `seen` are formats of {within} and {value}."""
    if difference.value is None or difference.low is None or difference.high is None:
        return f"not enough data: {difference.reason}"
    within = f"{signed(difference.low)} to {signed(difference.high)}"
    form = unseen if difference.low <= 0 <= difference.high else seen
    return form.format(value=signed(difference.value), within=within)


def burn_in(drift: Estimate) -> str:
    """Statement on mean n_stick in the second half of the window minus the first."""
    return _against_zero(
        drift,
        unseen="no drift seen, but one within {within} is not excluded",
        seen="drifts by {value} ({within}): t_burn may be too early, or the runs are not stationary",
    )


def is_drifting(row: Row) -> bool:
    """Whether the interval in a row of the table `burn_in` shows that mean n_stick moves within the window."""
    return row["low"] is not None and not row["low"] <= 0 <= row["high"]


def left_out(outcomes: Sequence[Row], n_quiet: int) -> str:
    """How many members of a group reached t_end, what became of the others, and how many went quiet."""
    total = sum(row["n_members"] for row in outcomes)
    parts = []
    for row in outcomes:
        if row["outcome"] == "finished":
            continue
        part = f"{row['n_members']} {row['outcome']}"
        if row["n_before_burn"]:
            part += f" ({row['n_before_burn']} before t_burn)"
        parts.append(part)
    finished = sum(row["n_members"] for row in outcomes if row["outcome"] == "finished")
    if parts:
        text = f"{finished} of {count(total, 'run')} reached t_end; left out: {', '.join(parts)}"
    else:
        text = "the one run reached t_end" if total == 1 else f"all {total} runs reached t_end"
    return f"{text}; after t_burn no block sticks or slips anew in {n_quiet} of them" if n_quiet else text


def mean_n_stick(row: Row) -> str:
    if row["mean"] is None:
        return f"mean n_stick: not enough data: {row['reason']}"
    text = f"mean n_stick {number(row['mean'])} ({interval(row['low'], row['high'])})"
    if not row["effective_samples"]:
        return text
    return (
        f"{text}, from {count(row['n_matrices'], 'matrix')} and about "
        f"{row['effective_samples']:.0f} independent samples in time"
    )


def events_sentence(row: Row, confidence: float) -> str:
    """The law without sampling, in one sentence."""
    if row["gamma"] is None:
        return f"event by event: {row['statement']}"
    return (
        f"event by event, gamma = {number(row['gamma'])} "
        f"({interval_at(confidence, row['gamma_low'], row['gamma_high'])}; "
        f"{count(row['n_cascades'], 'cascade')}, {count(row['n_matrices'], 'matrix')}) where random "
        f"order of exits and entries gives gamma0 = {number(row['gamma0'])}: {row['statement']}"
    )


def law_answer(row: Row) -> str:
    """The law in one sentence with one number and its interval; `row` has a gamma."""
    text = f"cascade sizes fall off as exp(−γ size) with γ = {row['gamma']:.3f}"
    if row["gamma_low"] is None or row["difference_low"] is None:
        return f"{text}, without an interval: {row['statement']}"
    low, value, high = (row[name] / row["gamma0"] for name in ("difference_low", "difference", "difference_high"))
    against = (
        f"not told apart from random order ({signed_percent(low)} to {signed_percent(high)})"
        if low <= 0 <= high
        else f"{percent(abs(value))} {'steeper' if value > 0 else 'shallower'} than in random order"
    )
    few = f", from {count(row['n_matrices'], 'matrix')} only" if row["n_matrices"] < FEW else ""
    return f"{text} ({row['gamma_low']:.3f} to {row['gamma_high']:.3f}), {against}{few}"


def sampled_sentence(rows: Sequence[Row]) -> str:
    """How far the sampled definitions range, and what came of them against chance."""
    known = [row for row in rows if row["dt"] is not None and row["gamma"] is not None]
    if not known:
        return "on samples: not enough data for any definition"
    least, most = (pick(known, key=lambda row: row["gamma"]) for pick in (min, max))
    differ = sum(row["verdict"] == "differs" for row in known)
    judged = sum(row["verdict"] != "not enough data" for row in known)
    if len(known) == 1:
        return f"on samples, {_law(least)} gives gamma = {number(least['gamma'])}: {least['statement']}"
    return (
        f"on samples gamma is a matter of definition and dt, from {number(least['gamma'])} ({_law(least)}) "
        f"to {number(most['gamma'])} ({_law(most)}); {differ} of {judged} pairs of definition and dt "
        f"that can be judged differ from chance sampled the same way"
    )


def _law(row: Row) -> str:
    return row["definition"] if row["dt"] is None else f"{row['definition']}, dt = {row['dt']:g}"


def paper_sentence(rows: Sequence[Row]) -> str:
    """Where the paper's value stands among all definitions of the unperturbed groups."""
    judged = [row for row in rows if row["gamma_low"] is not None]
    inside = [row for row in judged if row["gamma_low"] <= PAPER_GAMMA <= row["gamma_high"]]
    if not judged:
        return f"The paper's gamma of {PAPER_GAMMA} cannot be placed: no estimate here has an interval."
    chance = [row["gamma0"] for row in judged if row["gamma0"] is not None]
    text = (
        f"The paper's gamma of {PAPER_GAMMA} (sampled series; dt and threshold not stated) lies in the "
        f"intervals of {len(inside)} of {len(judged)} estimates here"
    )
    if inside:
        places = "; ".join(dict.fromkeys(_law(row) for row in inside))
        text += f" ({places}): a match found by looking over many definitions is no evidence for one of them"
    if chance:
        text += f". Chance alone gives from {number(min(chance))} to {number(max(chance))} by these definitions"
    return text + "."


def chance_check(rows: Sequence[Row]) -> str:
    """What random order gives for `events`, beside the closed form."""
    known = [row["gamma0"] for row in rows if row["definition"] == "events" and row["gamma0"] is not None]
    closed = f"exits and entries independent and in equal numbers give ln 2 = {number(LN2, 4)}"
    if not known:
        return f"For events {closed}; no run here has events to shuffle."
    values = number(known[0], 4) if len(known) == 1 else f"{number(min(known), 4)} to {number(max(known), 4)}"
    return f"For events {closed}; random order of the observed ones gives {values}."


def fit_sentence(rows: Sequence[Row]) -> str:
    """How far observed shares lie from the fitted exponential, for the sizes that have intervals."""
    judged = [row for row in rows if row["share_low"] is not None and row["share_fit"] is not None]
    if not judged:
        return "not enough data to set observed shares beside the fit"
    outside = [row for row in judged if not row["share_low"] <= row["share_fit"] <= row["share_high"]]
    worst = max(judged, key=lambda row: abs(row["share"] - row["share_fit"]))
    return (
        f"the fit lies outside the interval of {len(outside)} of {count(len(judged), 'size')}; the largest gap "
        f"is {signed(worst['share'] - worst['share_fit'])} in the share of size {worst['size']}"
    )


def many_rows(n_rows: int, confidence: float) -> str:
    """What to expect of many intervals when nothing differs."""
    expected = n_rows * (1 - confidence)
    return (
        f"The table makes {count(n_rows, 'comparison')} with chance, each at {percent(confidence)}: about "
        f"{number(expected, 2)} would differ by luck alone if chance were all there is."
    )


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """Capital letter and full stop."""
    return capital(text) + ("" if text.endswith(".") else ".")
