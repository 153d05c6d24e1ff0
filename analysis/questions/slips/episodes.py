"""Episodes: how often, how large, how regular; the law of their moments; how much all this depends on the method.

An episode lasts from all blocks stuck to all stuck again. Those that begin within [t_burn, t_end] count. Every method
is compared with exact events on the same systems by whole laws, since a mean may be right where the law is not.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from stickslip.analysis.answer import Answer, B, F, I, Question, Recipe, Row, S, frame, named
from stickslip.analysis.catalogues import (
    MARGIN,
    Catalogues,
    b_of_law,
    classes,
    fineness,
    fits_of,
    read,
    summarise,
    systems,
    values_of_b,
)
from stickslip.analysis.contrast import SCHEMA, Statistic, contrast, judge
from stickslip.analysis.ensemble import Study
from stickslip.analysis.grid import axes_of, settings
from stickslip.analysis.members import DRAWN
from stickslip.analysis.methods import against_reference, by_laws, comparison, names
from stickslip.analysis.models.episodes import (
    BY_WAY,
    CLASS,
    FITTED,
    OCCUPANCY,
    QUANTITIES,
    REST,
    SIZE,
    SLOW_DRIVE,
    WINDOWS,
    BValue,
    follows,
)
from stickslip.analysis.questions.runs.sweep import FALLS, RISES
from stickslip.analysis.stats.compare import UNKNOWN, WITHIN, Words, mean_within, relative_difference
from stickslip.analysis.stats.enough import DRIFTS
from stickslip.analysis.stats.estimates import Estimate, Undefined, over_matrices, ratio
from stickslip.analysis.stats.families import parameter
from stickslip.analysis.stats.goodness import NOT_REJECTED, REJECTED, goodness
from stickslip.analysis.stats.student import half_width
from stickslip.analysis.style import EXACT, GREY, of_engine, panel

POWER, CUT_OFF, EXPONENTIAL, NONE = "power law", "cut-off power law", "exponential", "none of these"
SLOW = 0.05  # largest share of time in episodes if the drive is slow for the chain
#: Share of time in episodes up to which the page says how much slower the belt has to be. Shares of 20%
#: (`burridge_knopoff`), 68% and 78% (Carlson and Langer's chain, 100 blocks, rates of weakening 5 and 2, belt 0.01)
#: become 2.3%, 3.6% and 8.7% on belts 10, 50 and 50 times slower, where `_slower` expects 2.4%, 4.1% and 6.8%. Shares
#: of 90% and 99% (a grid of 12 x 12) become 9.3% and 34% on a belt 50 times slower, and 15% and 66% were expected.
TELLING = 0.8
LEFT_OUT = 0.01  # share of a group's episodes that are too small to be drawn
FEWEST = 30  # episodes from a magnitude on, for their rate to be drawn
MOST_STEMS = 300  # episodes of one run that are drawn
_STEP = 2  # classes between points of the figures
MOST_OVER = 2.5  # largest rate in a figure, over the reference's
_GROUPS: Mapping[str, str] = {
    "group": S, "method": S, "n_systems": I, "n_episodes": I, "least": F, "largest": F, "whole": F,
    **{f"{name}{end}": F for name in (*QUANTITIES, *REST, *SLOW_DRIVE) for end in ("", "_low", "_high")},
    "drift": F, "drift_low": F, "drift_high": F, "stuck_below": F, "has_b": B, "b": F, "b_low": F, "b_high": F,
    "atom": F, "b_reason": S, "basis": S,
}  # fmt: skip
_CONTRASTS: Mapping[str, str] = {"setting": S, "reference": S, **SCHEMA}
_METHODS: Mapping[str, str] = {
    "setting": S, "reference": S, "law": S, "size": F, "size_low": F, "size_high": F, "at": F, "below": F,
    "margin": F, "p_equivalent": F,
    "p_different": F, "p_floor": F, "p_equivalent_holm": F, "p_different_holm": F, "verdict": S, "reason": S,
}  # fmt: skip
_B_VALUES: Mapping[str, str] = {
    "group": S, "magnitude": F, "n_episodes": I, "b": F, "b_low": F, "b_high": F,
    "predicted": F,
}  # fmt: skip
_SIZES: Mapping[str, str] = {
    "group": S, "size": I, "n_episodes": I, "share": F, "share_low": F, "share_high": F,
}  # fmt: skip
_LAWS: Mapping[str, str] = {
    "group": S, "law": S, "least": F, "n_episodes": I, "b": F, "b_low": F, "b_high": F, "parameters": S, "gain": F,
    "gap": F, "p_value": F, "p_floor": F, "fit": S, "reason": S,
}  # fmt: skip
_RATES: Mapping[str, str] = {
    "group": S, "magnitude": F, "n_episodes": I, "rate": F, "rate_low": F, "rate_high": F, "over": F, "over_low": F,
    "over_high": F,
}  # fmt: skip


def answer(study: Study) -> Answer | None:
    """What the episodes of an ensemble are like; None where none were recorded."""
    if study.data.episodes is None:
        return None
    found, level = read(study, study.data.episodes), study.settings.confidence
    if not any(len(one.magnitudes()) for one in found):
        return Answer({"n_systems": max((len(one.runs) for one in found), default=0)}, lack="no episode")
    by_system = systems(found)
    for one, method in zip(found, names(found), strict=True):
        summarise(one, level)
        one.row["method"] = method
    judged = [one for one in found if one.is_judged]
    b = {one.label: values_of_b(one, level) for one in judged}
    for one in found:
        one.row["has_b"] = one.is_judged and follows(b[one.label], len(one.runs), level)
        one.row |= named("b", b_of_law(one, level) if one.is_judged else Estimate())
    tables = {"episodes": frame(_GROUPS, [one.row for one in found])}
    warned = _warned(found, [first for first, *_ in by_system], study)
    if not judged:
        best = max(found, key=lambda one: one.row["n_episodes"]).row
        return Answer(warned | {"best": best}, lack=best["basis"], tables=tables)
    lead = _lead(judged)
    leaders = [first for first, *_ in by_system if first.is_judged] or [lead]
    contrasts, along = against_reference(by_system, level), [one.group for one in leaders]
    is_line = (len(settings(along)) > 1) + len(axes_of(along)) < 2  # the ends of several keys would be two corners
    changes = _changes(leaders, level) if is_line else []
    compared = by_laws(study, by_system)
    rates = _rates(by_system, lead, _drawn_from(lead, leaders), level)
    told = [lead, *(one for one in leaders if one is not lead)]
    laws, moments = zip(*(_laws(study, one, b[one.label]) for one in told), strict=True)
    sizes = [row for one in leaders for row in _sizes(one, level)]
    tables |= {
        "episode_contrasts": frame(_CONTRASTS, [row for rows in (*contrasts, changes) for row in rows]),
        "episode_methods": frame(_METHODS, compared),
        "episode_laws": frame(_LAWS, [row for rows in laws for row in rows]),
        "episode_rates": frame(_RATES, rates),
        "episode_sizes": frame(_SIZES, sizes),
        "b_values": frame(_B_VALUES, _b_rows(b)),
    }
    figures = _figures(found, leaders, lead, rates, sizes, b, bool(contrasts))
    references = [one.row for one in leaders]
    facts = warned | {
        "lead": lead.row, "laws": [row for rows in laws for row in rows],
        "moments": moments[0], "others": moments[1:], "least": lead.least,
        "fitted": FITTED, "windows": WINDOWS, "margin": MARGIN,
        "window": (float(lead.group.key["t_end"]) - study.settings.t_burn) * (1 - lead.row[OCCUPANCY]) / WINDOWS,
        "n_blocks": lead.group.key["n"],
        "without_law": [first.row["method"] for first, *_ in by_system
                        if first.row["n_episodes"] and not first.is_judged],
        "ends": (references[0], references[-1]), "changes": changes, "b": b[lead.label],
        "b_rows": _b_rows({lead.label: b[lead.label]}),
        "most_over": MOST_OVER if any((row["over"] or 0.0) > MOST_OVER for row in rates) else None,
        "has_sizes": "episode_sizes" in figures, "most_stems": MOST_STEMS,
        **comparison(contrasts, compared, {one.label: str(one.row["method"]) for one in found}),
    }  # fmt: skip
    return Answer(facts, tables=tables, figures=figures)


def _warned(found: Sequence[Catalogues], references: Sequence[Catalogues], study: Study) -> Row:
    """What pages have to say of these episodes, whichever question leads: the drive is fast, or their rate drifts."""
    fast = sorted(
        (one.row for one in references if (one.row[OCCUPANCY] or 0.0) > SLOW), key=lambda row: -row[OCCUPANCY]
    )
    return {
        "fast": fast, "slow": SLOW, "slower": _slower(fast[0]) if fast else None, "is_sweep": len(references) > 1,
        "drifting": [one.row for one in found if _drifts(one.row)], "t_burn": study.settings.t_burn,
        "rows": [one.row for one in found],
    }  # fmt: skip


def _drifts(row: Row) -> bool:
    """Whether a drift of the rate of episodes is shown, beyond what is judged or beyond the margin of statistics."""
    is_shown = row["drift_low"] is not None and (row["drift_low"] > 0 or row["drift_high"] < 0)
    return bool(row["basis"] == DRIFTS or (is_shown and abs(row["drift"]) > MARGIN))


def _lead(judged: Sequence[Catalogues]) -> Catalogues:
    """The group that leads: the finest setting, and the largest n, where the ends of a chain matter least."""
    first = fineness(judged[0].group)
    return max((one for one in judged if fineness(one.group) == first), key=lambda one: int(one.group.key["n"]))


def _drawn_from(lead: Catalogues, leaders: Sequence[Catalogues]) -> float:
    """The edge of a class from which rates are drawn: no law is asked of a rate, so nearly all episodes count."""
    first = min(float(np.quantile(one.magnitudes(), LEFT_OUT)) for one in leaders)
    return lead.least - CLASS * max(int(np.ceil((lead.least - first) / CLASS)), 0)


def _figures(
    found: Sequence[Catalogues],
    leaders: Sequence[Catalogues],
    lead: Catalogues,
    rates: Sequence[Row],
    sizes: Sequence[Row],
    b: Mapping[str, Sequence[BValue]],
    has_pairs: bool,
) -> dict[str, Recipe]:
    """Rates by magnitude; beside them those over the reference's, or sizes along a sweep, or one run."""
    labels = {one.label: (str(one.group.key["engine"]), str(one.row["method"])) for one in found}
    figures: dict[str, Recipe] = {"episode_rates": partial(frequencies, rates, labels)}
    if rows := _b_rows(b):
        shown = {label: labels[label] for label, some in b.items() if some}
        figures["b_values"] = partial(b_by_least, rows, shown, lead.label)
    if has_pairs:
        figures["episode_rates_over"] = partial(over_reference, rates, labels)
    elif len(leaders) > 1:
        figures["episode_sizes"] = partial(shares_of_sizes, sizes, {one.label: labels[one.label] for one in leaders})
    else:
        run = next(one for one in lead.each() if len(one.start))
        figures["one_catalogue"] = partial(one_catalogue, run.start[:MOST_STEMS], run.magnitude[:MOST_STEMS])
    return figures


def _changes(leaders: Sequence[Catalogues], level: float) -> list[Row]:
    """Contrasts of the last of some systems with the first: mean size, and episodes by the belt's travel.

    Paired if both share their random draws.
    """
    first, last = leaders[0], leaders[-1]
    if first is last:
        return []
    asked = [Statistic(SIZE, QUANTITIES[SIZE].of, MARGIN), Statistic(BY_WAY, SLOW_DRIVE[BY_WAY].of, MARGIN)]
    a, b = ([one.group.unit, *(one.group.key[name] for name in DRAWN)] for one in (first, last))
    rows: list[Row] = [
        {"setting": last.label, "reference": first.label}
        | contrast(one, first.sample, last.sample, a == b, level).row()
        | {"is_share": False}
        for one in asked
    ]
    judge(rows, 1 - level, Words(WITHIN, RISES, FALLS))
    return rows


def _slower(row: Row) -> float | None:
    """How many times slower a belt has to be for a share of time in episodes of `SLOW`, to one digit; None: unknown.

    On a slow belt the time in episodes grows with the belt's travel, and the quiet time with the time itself: the
    ratio of the two is proportional to the belt's speed.
    """
    share = row[OCCUPANCY]
    if share > TELLING or not row[BY_WAY]:
        return None
    factor = share / (1 - share) * (1 - SLOW) / SLOW
    digit = 10.0 ** np.floor(np.log10(factor))
    return float(np.ceil(factor / digit) * digit)


def _b_rows(b: Mapping[str, Sequence[BValue]]) -> list[Row]:
    """Rows of the table `b_values`, from the values by group."""
    return [
        {"group": label, "magnitude": one.least, "n_episodes": one.n_episodes, **named("b", one.b),
         "predicted": one.predicted}
        for label, some in b.items() for one in some
    ]  # fmt: skip


def _sizes(one: Catalogues, level: float) -> list[Row]:
    """Shares of the episodes that take at least a number of blocks, for numbers that grow by a factor of 1.5."""
    rows: list[Row] = []
    runs = [np.concatenate([run.size for run in some]) for some in one.runs.values()]
    most = max(int(some.max(initial=0)) for some in runs)
    for size in np.unique((1.5 ** np.arange(np.log(most) / np.log(1.5))).astype(int)):
        sums = np.array([[np.count_nonzero(some >= size), len(some)] for some in runs], dtype=np.float64)
        if sums[:, 0].sum() >= FEWEST:
            share = named("share", mean_within(sums, 1.0, level))
            rows.append({"group": one.label, "size": int(size), "n_episodes": int(sums[:, 0].sum()), **share})
    return rows


def _laws(study: Study, one: Catalogues, b: Sequence[BValue]) -> tuple[list[Row], Row]:
    """Rows of the table `episode_laws`, and facts: the law that the moments of a group follow, with its exponents."""
    level, counts = study.settings.confidence, classes(one)
    own = {"group": one.label, "method": one.row["method"], "least": one.least, "n_episodes": int(counts.sum()),
           "n_matrices": len(counts)}  # fmt: skip
    has_b = one.row["has_b"]  # "open": too few episodes to tell
    of_b = {"has_b": has_b, "single": "one" if has_b else "none" if len(b) > 1 else "open"}
    fits = fits_of(one)
    if not fits:
        unknown = {"law": UNKNOWN, "says": UNKNOWN, "untested": one.row["b_reason"]}
        return [], own | of_b | unknown | {"exponent": Estimate(), "b": Estimate()}
    base, with_cut_off, _ = fits
    exponent, cut_off = (parameter(with_cut_off, which, counts, level) for which in (0, 1))
    bounded = parameter(base, 0, counts, level)
    rows: list[Row] = []
    for fit, b_of in zip(fits, (bounded, exponent, Estimate()), strict=True):
        name, others = fit.family.name, {key: value for key, value in fit.parameters.items() if key != "b"}
        good = goodness(fit.sizes, counts, level, study.generator(f"moment {name}"), fit.family)
        rows.append(own | {
            "law": name, **named("b", b_of),
            "parameters": ", ".join(f"{key} = {value:.3g}" for key, value in others.items()) or None,
            "gain": None if fit is base else (fit.log_likelihood - base.log_likelihood) / counts.sum(),
            "gap": good.gap, "p_value": good.p_value, "p_floor": good.p_floor,
            "fit": good.verdict(1 - level), "reason": good.reason or None,
        })  # fmt: skip
    law = _verdict(rows[1]["fit"], exponent, cut_off)
    says = f"{law} {of_b['single']}" if law in (POWER, CUT_OFF) or has_b else law
    untested = rows[1]["reason"] if law == UNKNOWN else None
    return rows, own | of_b | {"exponent": exponent, "b": bounded, "law": law, "says": says, "untested": untested}


def _verdict(fit: str, exponent: Estimate, cut_off: Estimate) -> str:
    """The law that moments follow, from the power law with a cut-off; unknown if its fit is not tested, or undecided.

    It contains the two others: the power law has no cut-off, and the exponential has the exponent -1. Without a
    positive b there is no power law, whatever fits.
    """
    if fit == REJECTED:
        return NONE
    if fit != NOT_REJECTED or exponent.low is None or exponent.high is None:
        return UNKNOWN
    has_cut_off = cut_off.low is not None and cut_off.low > 0  # without an interval it is 0, its bound
    if has_cut_off and exponent.low <= -1.0 <= exponent.high:
        return EXPONENTIAL
    if exponent.low <= 0:
        return UNKNOWN
    return CUT_OFF if has_cut_off else POWER


def _rates(systems: Iterable[Sequence[Catalogues]], lead: Catalogues, first_edge: float, level: float) -> list[Row]:
    """Episodes per unit time from each magnitude on, and their ratio to those of the reference."""
    rows: list[Row] = []
    edges = first_edge + CLASS * np.arange(0, int((lead.magnitudes().max() - first_edge) / CLASS) + _STEP, _STEP)
    for first, *others in systems:
        reference = {edge: first.at_least(edge) for edge in edges}
        for one, edge in itertools.product((first, *others), edges):
            before = reference[edge]
            sums = before if one is first else one.at_least(edge)
            n_episodes = int(sum(row[0] for row in sums.values()))
            if n_episodes < FEWEST:
                continue
            rate = over_matrices(ratio, np.array([*sums.values()]), level)
            over = Estimate()
            both = sorted(sums.keys() & before.keys())
            if one is not first and len(both) > 1 and sum(row[0] for row in before.values()) >= FEWEST:
                known, found = (np.array([of[unit] for unit in both]) for of in (before, sums))
                over = _over(known, found, level)
            rows.append({
                "group": one.label, "magnitude": float(edge), "n_episodes": n_episodes, "rate": rate.value,
                "rate_low": None if rate.low is None else max(rate.low, 0.0), "rate_high": rate.high,
                **named("over", over),
            })  # fmt: skip
    return rows


def _over(first: np.ndarray, second: np.ndarray, level: float) -> Estimate:
    try:
        value, error, dof = relative_difference(ratio, first, second, True)
    except Undefined as why:
        return Estimate(reason=str(why))
    half = half_width(level, dof) * error
    return Estimate(1 + value, 1 + value - half, 1 + value + half)


def _look(labels: Mapping[str, tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """Style of each group's line: one colour for each engine, one line for each of its settings."""
    seen: dict[str, int] = {}
    looks = {}
    for label, (engine, _) in labels.items():
        k = seen[engine] = seen.get(engine, -1) + 1
        colour, face = of_engine(engine)
        looks[label] = {
            "color": colour, "linestyle": ("-", "--", "-.", ":")[k % 4], "marker": "osDv"[k % 4], "markersize": 3,
            "markerfacecolor": face, "linewidth": 0.9,
        }  # fmt: skip
    return looks


def _lines(
    ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]], key: str, by: str = "magnitude"
) -> None:
    for (label, (_, method)), look in zip(labels.items(), _look(labels).values(), strict=True):
        some = [row for row in rows if row["group"] == label and row[key] is not None]
        if not some:
            continue
        x, y = (np.array([row[name] for row in some]) for name in (by, key))
        ax.plot(x, y, label=method, **look)
        known = [row for row in some if row[f"{key}_low"] is not None]
        low, high = (np.array([row[f"{key}{end}"] for row in known]) for end in ("_low", "_high"))
        ax.fill_between([row[by] for row in known], low, high, color=look["color"], alpha=0.12, linewidth=0)
    ax.set_xlabel("magnitude, M = $\\log_{10}$ moment")
    if len(labels) > 1:
        widest = max(len(method) for _, method in labels.values())
        ax.figure.legend(
            loc="outside upper center",
            ncols=3 if widest < 24 else 2 if widest < 38 else 1,
            fontsize=6.5,
            handlelength=2.2,
        )


@panel()
def frequencies(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """Episodes per unit time from each magnitude on, one line a group, with bands of their intervals.

    Rows are those of the table `episode_rates`; labels are (engine, method) by group.
    """
    _lines(ax, rows, labels, "rate")
    ax.set_yscale("log")
    lows = [row["rate"] for row in rows if row["rate"]]
    ax.set(ylabel="rate of episodes, $\\geq$ M", ylim=(0.5 * min(lows), 2 * max(lows)))


@panel()
def over_reference(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """Rate over the reference's on the same systems, up to `MOST_OVER`; parameters as in `frequencies`."""
    ax.axhspan(1 - MARGIN, 1 + MARGIN, color=GREY, alpha=0.13, linewidth=0)
    ax.axhline(1.0, color=EXACT, linewidth=1)
    _lines(ax, rows, labels, "over")
    seen = [row["over"] for row in rows if row["over"] is not None]
    ax.set(ylabel="rate / exact rate", ylim=(0, min(MOST_OVER, max([1.4, *(1.15 * x for x in seen)]))))


@panel()
def b_by_least(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]], lead: str) -> None:
    """b against the magnitude from which it is estimated, and the prediction for the group `lead`.

    Rows are those of the table `b_values`; labels as in `frequencies`.
    """
    some = [row for row in rows if row["group"] == lead]
    ax.plot([row["magnitude"] for row in some], [row["predicted"] for row in some], "--", color=GREY, linewidth=1)
    _lines(ax, rows, labels, "b")
    ax.set(xlabel="least magnitude, $M_c$", ylabel="b by Aki", ylim=(0, None))


@panel()
def shares_of_sizes(ax: Axes, rows: Sequence[Row], labels: Mapping[str, tuple[str, str]]) -> None:
    """Shares of episodes by least size; rows of the table `episode_sizes`, labels as in `frequencies`."""
    _lines(ax, rows, labels, "share", "size")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set(xlabel="size, blocks that slip", ylabel="share of episodes, $\\geq$ size")


@panel()
def one_catalogue(ax: Axes, t: np.ndarray, magnitude: np.ndarray) -> None:
    """Magnitude of the episodes of one run against time, each (m,)."""
    floor = float(magnitude.min()) - 0.1
    ax.vlines(t, floor, magnitude, color=EXACT, linewidth=0.6)
    ax.plot(t, magnitude, "o", color=EXACT, markersize=2)
    ax.set(xlabel="time t", ylabel="magnitude, M", ylim=(floor, None))


QUESTION = Question(answer, share=0.8, rank=2)
