"""How much blocks act together: slow common motion, and exits that trigger others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, Picture, Question, Row, frame, lack, systems
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Basis, Finding, Lack, Level, Quantity, Reason, Share
from stickslip.analysis.findings.numbers import number
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.models.clustering import Kind
from stickslip.analysis.models.common_motion import NONE, SURROGATES
from stickslip.analysis.questions.slips import slow_motion, triggering
from stickslip.analysis.questions.slips.slow_motion import CYCLES, Slow
from stickslip.analysis.questions.slips.triggering import Exits, exits_of, triggered
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel

WHAT = "collective motion"
MOST_DRAWN = 3  # groups in the figure
OF_ALL_BLOCKS = (Kind.POWER, Kind.VARIANCE)  # what is compared on the page besides exits; tables have all
Q = Quantity(
    "quality",
    "Q of slow common motion",
    definition="pi times the time in which the motion decays to 1 / e, in natural periods",
)
PERIOD = Quantity("period", "natural period of slow common motion")
DEVIANCE = Quantity("deviance", "deviance of the slow spectrum from the fit")
_METHOD = (
    "Time-shifted blocks are each block's own history, shifted by a random time; slow common motion, with"
    f" periods over {CYCLES:g} of a block's own cycles, is shown if its power is more concentrated than in 95% of"
    f" {SURROGATES} such surrogates, and is fitted as a damped oscillator beside a share of the blocks' own power."
    " Up to Q = 1/2 it is overdamped, and Q = 1 is a broad hump of the spectrum and no oscillation; comparisons"
    " behind the first are adjusted for their number."
)


def answer(study: Study) -> Answer:
    """How much of the variance slow common motion accounts for, and how many exits trigger others."""
    if not study.data.events:
        return Answer(findings=[Lack(WHAT, Reason.NOT_RECORDED, "set events = true under [record]")])
    judged = study.judged()
    if not judged:
        return Answer(findings=[lack(study, WHAT)])
    slow = [motion for group in judged if (motion := slow_motion.slow_motion(study, group)) is not None]
    exits = [found for group in judged if (found := exits_of(study, group)) is not None]
    if not exits:
        return Answer(findings=[Lack(WHAT, Reason.FEW_EVENTS)])
    level, t_burn = study.settings.confidence, study.settings.t_burn
    bands = {one.group.label: one.bands(level) for one in slow}
    tables = {
        "rhythm": frame(slow_motion.TABLE, (one.row(t_burn) for one in slow)),
        "rhythm_spectrum": frame(slow_motion.SPECTRUM, (row for rows in bands.values() for row in rows)),
        "clustering": frame(
            triggering.TABLE, (one.row(found.group.label) for found in exits for one in found.compared)
        ),
        "spectrum": frame(triggering.SPECTRUM, (row for found in exits for row in found.spectrum())),
    }
    of_group = {one.group.label: one for one in slow}
    exits.sort(key=lambda found: not _is_shown(of_group.get(found.group.label)))  # of like ones the first leads
    lead, *others = exits
    leading, compared = _leading(study, lead, of_group.get(lead.group.label))
    shares = [
        _share(motion, Place.of(found.group.name), systems(study))
        for found in others
        if (motion := of_group.get(found.group.label)) is not None and motion.is_shown
    ]
    drawn = {found.group.label: (found.spectrum(), bands.get(found.group.label, [])) for found in exits[:MOST_DRAWN]}
    picture = _picture(drawn, of_group.get(lead.group.label))
    alerts = _alerts(lead, of_group.get(lead.group.label), 1 - level)
    findings = [*leading, *shares, *compared]
    figures = {"collective": picture}
    return Answer(findings=findings, n_lead=3, alerts=alerts, method=_METHOD, tables=tables, figures=figures)


def _is_shown(motion: Slow | None) -> bool:
    return motion is not None and motion.is_shown


def _alerts(exits: Exits, motion: Slow | None, alpha: float) -> list[Alert]:
    """That runs are left out, and that the fit is no more than a summary."""
    group, alerts = exits.group, []
    if group.n_moving < len(group):
        alerts.append(Alert.of(Code.NOT_MOVING, n=len(group) - group.n_moving, of=len(group), what=WHAT))
    if motion is not None and motion.is_shown and motion.goodness.p_value < alpha:
        alerts.append(Alert.of(Code.MISFIT, deviance=round(motion.goodness.deviance), dof=motion.goodness.dof))
    return alerts


def _leading(study: Study, exits: Exits, motion: Slow | None) -> tuple[list[Finding], list[Finding]]:
    """What one group shows: first the share of slow common motion or, if none is shown, why.

    Returns
    -------
    leading, compared : list of Finding
    """
    unit, where = systems(study), Place.of(exits.group.name) if len(study.groups) > 1 else EVERYWHERE
    share, shown = triggered(exits, where, unit)
    kept = [exits.compared[0], *(one for one in exits.compared[1:] if one is shown or one.part.kind in OF_ALL_BLOCKS)]
    basis = Basis(exits.n_units, unit)
    compared: list[Finding] = [one.level(where, basis) for one in kept if one.observed.low is not None]
    if motion is None or not motion.is_shown:
        return [*_lacking(study, motion, where), *compared[:1], *share], compared[1:]
    return [_share(motion, where, unit), *share, *_fit(motion, where, unit)], compared


def _share(motion: Slow, where: Place, unit: str) -> Share:
    predicate = "is due to slow common motion"
    basis = Basis(len(motion.units), unit)
    return Share("share", "the variance of n_stick", predicate, motion.estimate("share"), where, basis=basis)


def _fit(motion: Slow, where: Place, unit: str) -> list[Finding]:
    """Q of slow common motion, its natural period, and the goodness of their fit."""
    basis = Basis(len(motion.units), unit)
    fit = motion.goodness
    return [
        Level(Q, motion.estimate("quality"), where, basis=basis),
        Level(PERIOD, motion.estimate("period"), where, basis=basis),
        Level(DEVIANCE, Estimate(fit.deviance), where + Place.words(f"{fit.dof} degrees of freedom")),
    ]


def _lacking(study: Study, motion: Slow | None, where: Place) -> list[Finding]:
    """Why no slow common motion is shown."""
    what = f"slow common motion{where.tail}"
    if motion is None:
        return []
    if motion.verdict == NONE and motion.motion is not None:
        return [Lack(what, Reason.NOT_SHOWN, f"p = {motion.motion.p:.2g}")]
    needed = motion.needed(study.settings.t_burn)
    return [Lack(what, Reason.SHORT_WINDOW, f"runs to t = {needed:,.0f} may suffice")]


# ---------------------------------------------------------------------------------------------- the figure


def _picture(drawn: Mapping[str, tuple[list[Row], list[Row]]], motion: Slow | None) -> Picture:
    """Power at all periods, with the fit of slow common motion and, of the group that leads, its goodness."""
    power = "the power of n_stick, the number of sticking blocks,"
    if motion is None or not motion.is_shown:
        caption = f"How far {power} is from that of time-shifted blocks (dashed). Bars and bands: intervals."
        if motion is None:
            return Picture(partial(spectrum, drawn), caption)
        caption += f" Shaded: periods over {CYCLES:g} of a block's own cycles, "
        caption += (
            "where no slow common motion is shown."
            if motion.verdict == NONE
            else "which take longer runs to tell slow common motion."
        )
        return Picture(partial(spectrum, drawn, CYCLES * motion.cycle), caption)
    fit = motion.goodness
    quality = number(motion.estimate("quality").value or 0.0, digits=2)
    where = motion.group.label
    caption = (
        f"At long periods slow common motion lifts {power} above that of time-shifted blocks (dashed). Bars and"
        f" bands: intervals; lines through marks: a damped oscillator, which at {where} has Q = {quality} and a"
        f" deviance of {fit.deviance:.0f} on {fit.dof} degrees of freedom (p = {fit.p_value:.2g})."
    )
    return Picture(partial(spectrum, drawn), caption)


@panel(3.4)
def spectrum(ax: Axes, groups: Mapping[str, tuple[list[Row], list[Row]]], slow_from: float | None = None) -> None:
    """Power of n_stick over that of time-shifted blocks against the period, fast and slow, with the fit.

    Periods from `slow_from` on are shaded.
    """
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    for k, (label, (fast, slow)) in enumerate(groups.items()):
        colour, mark, face = (EXACT, SMOOTHED, GREEN)[k], "os^"[k], ((EXACT, "white", "white")[k])
        period, ratio, low, high = _points(fast)
        ax.fill_between(period, low, high, color=colour, alpha=0.18, linewidth=0)
        ax.plot(period, ratio, color=colour, linewidth=0.9)
        period, ratio, low, high = _points(slow)
        ax.errorbar(period, ratio, yerr=[ratio - low, high - ratio], color=colour, fmt=mark, markersize=3,
                    linewidth=0.9, label=label, markerfacecolor=face)  # fmt: skip
        if slow and all(row["model"] is not None for row in slow):
            ax.plot([_middle(row) for row in slow], [row["model"] for row in slow], color=colour)
    if slow_from is not None:
        longest = max(3 * slow_from, ax.get_xlim()[1])
        ax.axvspan(slow_from, longest, color=GREY, alpha=0.18, linewidth=0)
        ax.text(slow_from * 1.05, 0.96, "slow", color=GREY, va="top", transform=ax.get_xaxis_transform())
    ax.set(xscale="log", yscale="log", xlabel="period", ylabel="power / time-shifted blocks")
    for axis in (ax.xaxis, ax.yaxis):
        ends = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 3.0) if ends[1] > 20 * ends[0] else (1.0, 2.0, 3.0, 5.0)))
        axis.set_major_formatter(lambda x, _: f"{x:g}")
        axis.set_minor_locator(NullLocator())
    ax.figure.legend(loc="outside upper center", ncols=2 if max(map(len, groups)) < 24 else 1)


def _middle(row: Row) -> float:
    return float(np.sqrt(row["above"] * row["upto"]))


def _points(rows: Sequence[Row]) -> np.ndarray:
    """Period, ratio and the ends of its interval, shape (4, m), of the bands that have one."""
    known = [(_middle(row), row["ratio"], row["low"], row["high"]) for row in rows if row["low"] is not None]
    return np.array(known, dtype=np.float64).reshape(-1, 4).T


QUESTION = Question(answer, title="How much do blocks act together?", share=0.31, of_cascades=True)
