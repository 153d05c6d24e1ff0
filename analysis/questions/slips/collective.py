"""How much blocks act together: slow common motion, and exits that trigger others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, Picture, Question, lack, systems
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Basis, Finding, Form, Lack, Level, Quantity, Reason, Share
from stickslip.analysis.findings.numbers import number
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.models.clustering import Kind
from stickslip.analysis.models.common_motion import SURROGATES, Number, Shown
from stickslip.analysis.questions.slips.slow_motion import CYCLES, Band, Slow, slow_motion
from stickslip.analysis.questions.slips.triggering import CLUSTERING, Exits, exits_of, triggered
from stickslip.analysis.rows import frame_by, frame_of
from stickslip.analysis.stats.estimates import Estimate
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel

WHAT = "collective motion"
N_STICK = "the number of sticking blocks"
MOST_GROUPS = 3  # whose exits are compared with time-shifted blocks, and which are drawn
OF_ALL_BLOCKS = (Kind.POWER, Kind.VARIANCE)  # what is compared on the page besides exits; the table has all
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
    " Up to Q = 1/2 it is overdamped; with Q near 1 the spectrum has a broad peak, and the motion loses phase within"
    " a period. Comparisons behind the first are adjusted for their number."
)


def answer(study: Study) -> Answer:
    """How much of the variance slow common motion accounts for, and how many exits trigger others."""
    if not study.data.events:
        return Answer(findings=[Lack(WHAT, Reason.NOT_RECORDED, "set events = true under [record]")])
    judged = study.judged()
    if not judged:
        return Answer(findings=[lack(study, WHAT)])
    motions = [motion for group in judged if (motion := slow_motion(study, group)) is not None]
    motions.sort(key=lambda motion: not motion.is_shown)  # of like ones the first leads
    exits = [found for motion in motions[:MOST_GROUPS] if (found := exits_of(study, motion.group)) is not None]
    if not exits:
        return Answer(findings=[Lack(WHAT, Reason.FEW_EVENTS)])
    level, lead, others = study.settings.confidence, motions[0], motions[1:]
    leading, compared = _leading(study, exits[0], lead)
    shares = [_share(motion, Place.of(motion.group.name), systems(study)) for motion in others if motion.is_shown]
    bands = [(group.bands, motion.bands(level)) for group, motion in zip(exits, motions, strict=False)]
    drawn = {group.group.label: pair for group, pair in zip(exits, bands, strict=True)}
    return Answer(
        findings=[*leading, *shares, *compared],
        n_lead=1 if lead.is_shown else 3,
        alerts=_alerts(lead, 1 - level),
        method=_METHOD,
        tables={
            "clustering": frame_by(CLUSTERING, (each for group in exits for each in group.compared)),
            "spectrum": frame_of(Band, (band for fast, slow in bands for band in (*fast, *slow))),
        },
        figures={"collective": _picture(drawn, lead)},
    )


def _alerts(motion: Slow, alpha: float) -> list[Alert]:
    """That runs are left out, and that the fit is no more than a summary."""
    group, alerts = motion.group, []
    if group.n_moving < len(group):
        alerts.append(Alert.of(Code.NOT_MOVING, n=len(group) - group.n_moving, of=len(group), what=WHAT))
    if motion.is_shown and motion.goodness.p_value < alpha:
        alerts.append(Alert.of(Code.MISFIT, deviance=round(motion.goodness.deviance), dof=motion.goodness.dof))
    return alerts


def _leading(study: Study, exits: Exits, motion: Slow) -> tuple[list[Finding], list[Finding]]:
    """What one group shows: first the share of slow common motion or, if none is shown, why; and comparisons."""
    unit, where = systems(study), Place.of(exits.group.name) if len(study.groups) > 1 else EVERYWHERE
    share, shown = triggered(exits, where, unit)
    first, *others = exits.compared
    told = [first, *(each for each in others if each is shown or each.part.kind in OF_ALL_BLOCKS)]
    levels: list[Finding] = [
        each.level(where, Basis(exits.n_units, unit)) for each in told if each.observed.low is not None
    ]
    if not motion.is_shown:
        return [_lacking(motion, where, study.settings.t_burn), *levels[:1], *share], levels[1:]
    period, *fit = _fit(motion, where, unit)
    return [period, *share, _share(motion, where, unit), *fit], levels


def _share(motion: Slow, where: Place, unit: str) -> Share:
    share, basis = motion.fit.estimates[Number.SHARE], Basis(len(motion.units), unit)
    return Share("share", f"the variance of {N_STICK}", "is due to slow common motion", share, where, basis=basis)


def _fit(motion: Slow, where: Place, unit: str) -> list[Finding]:
    """The natural period of slow common motion, with its share of the variance, Q, and the goodness of their fit."""
    basis, estimates, goodness = Basis(len(motion.units), unit), motion.fit.estimates, motion.goodness
    share = number(estimates[Number.SHARE].value or 0.0, Form.SHARE, 0)
    clause = f"slow common motion with a natural period of {{}} accounts for {share} of the variance of {N_STICK}"
    return [
        Level(replace(PERIOD, clause=clause), estimates[Number.PERIOD], where, basis=basis),
        Level(Q, estimates[Number.QUALITY], where, basis=basis),
        Level(DEVIANCE, Estimate(goodness.deviance), where + Place.words(f"{goodness.dof} degrees of freedom")),
    ]


def _lacking(motion: Slow, where: Place, t_burn: float) -> Lack:
    """Why no slow common motion is shown."""
    what = f"slow common motion{where.tail}"
    if motion.shown is Shown.NONE:
        return Lack(what, Reason.NOT_SHOWN, f"p = {motion.fit.p:.2g}")
    return Lack(what, Reason.SHORT_WINDOW, f"runs to t = {motion.needed(t_burn):,.0f} may suffice")


# ---------------------------------------------------------------------------------------------- the figure


def _picture(drawn: Mapping[str, tuple[list[Band], list[Band]]], motion: Slow) -> Picture:
    """Power at all periods, with the fit of slow common motion and, of the group that leads, its goodness."""
    power = f"the power spectrum of {N_STICK}"
    if not motion.is_shown:
        shaded = (
            "where no slow common motion is shown"
            if motion.shown is Shown.NONE
            else "which take longer runs to tell slow common motion"
        )
        return Picture(
            partial(spectrum, drawn, CYCLES * motion.cycle),
            f"How far {power} is from that of time-shifted blocks (dashed). Bars and bands: intervals."
            f" Shaded: periods over {CYCLES:g} of a block's own cycles, {shaded}.",
        )
    quality, fit = number(motion.fit.values[Number.QUALITY][0], digits=2), motion.goodness
    fast, slow = drawn[motion.group.label]
    bands = sorted((*fast, *slow), key=lambda band: band.middle)
    ratios = [band.ratio.value or 1.0 for band in bands]
    most, least = max(ratios), min(ratios)
    peak = ratios.index(most)
    crossed = max((band.middle for band in bands[:peak] if (band.ratio.value or 1.0) <= 1.0), default=bands[0].above)
    edge = float(f"{crossed:.1g}")
    below = f", and down to {number(least)} times at shorter ones" if min(ratios[:peak], default=1.0) < 1 else ""
    return Picture(
        partial(spectrum, drawn),
        f"At periods over about {edge:g} {power} is up to {number(most)} times as large as for time-shifted"
        f" blocks (dashed){below}. Bars and bands: intervals; lines through marks: a damped oscillator, which at"
        f" {motion.group.label} has Q = {quality} and a deviance of {fit.deviance:.0f} on {fit.dof} degrees of"
        f" freedom (p = {fit.p_value:.2g}).",
    )


@panel(3.4)
def spectrum(ax: Axes, groups: Mapping[str, tuple[list[Band], list[Band]]], slow_from: float | None = None) -> None:
    """Power of n_stick over that of time-shifted blocks against the period, fast and slow, with the fit.

    Periods from `slow_from` on are shaded.
    """
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    for k, (label, (fast, slow)) in enumerate(groups.items()):
        colour = (EXACT, SMOOTHED, GREEN)[k]
        period, ratio, low, high = _points(fast)
        ax.fill_between(period, low, high, color=colour, alpha=0.18, linewidth=0)
        ax.plot(period, ratio, color=colour, linewidth=0.9)
        period, ratio, low, high = _points(slow)
        face, ends = (EXACT, "white", "white")[k], [ratio - low, high - ratio]
        ax.errorbar(
            period,
            ratio,
            ends,
            fmt="os^"[k],
            color=colour,
            markerfacecolor=face,
            markersize=3,
            linewidth=0.9,
            label=label,
        )
        models = [band.model for band in slow if band.model is not None]
        if models:
            ax.plot([band.middle for band in slow], models, color=colour)
    if slow_from is not None:
        longest = max(3 * slow_from, ax.get_xlim()[1])
        ax.axvspan(slow_from, longest, color=GREY, alpha=0.18, linewidth=0)
        ax.text(slow_from * 1.05, 0.96, "slow", color=GREY, va="top", transform=ax.get_xaxis_transform())
    ax.set(xscale="log", yscale="log", xlabel="period", ylabel="power / time-shifted blocks")
    for axis in (ax.xaxis, ax.yaxis):
        ends_of_axis = axis.get_view_interval()
        steps = (1.0, 3.0) if ends_of_axis[1] > 20 * ends_of_axis[0] else (1.0, 2.0, 3.0, 5.0)
        axis.set_major_locator(LogLocator(subs=steps))
        axis.set_major_formatter(lambda x, _: f"{x:g}")
        axis.set_minor_locator(NullLocator())
    ax.figure.legend(loc="outside upper center", ncols=2 if max(map(len, groups)) < 24 else 1)


def _points(bands: Sequence[Band]) -> np.ndarray:
    """Period, ratio and the ends of its interval, shape (4, m), of the bands that have one."""
    known = [
        (band.middle, band.ratio.value, band.ratio.low, band.ratio.high)
        for band in bands
        if band.ratio.low is not None
    ]
    return np.array(known, dtype=np.float64).reshape(-1, 4).T


QUESTION = Question(answer, title="How much do blocks act together?", share=0.31, of_cascades=True)
