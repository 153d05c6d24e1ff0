"""How much blocks act together: slow common motion, and exits that trigger others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from math import pi

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from stickslip.analysis.answer import Answer, Picture, Question, Recipe, places
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.alerts import Alert, Code
from stickslip.analysis.findings.finding import Basis, Finding, Fit, Form, Lack, Law, Level, Quantity, Reason
from stickslip.analysis.findings.numbers import limit, number, signs
from stickslip.analysis.findings.place import Place
from stickslip.analysis.findings.words import listed
from stickslip.analysis.groups import Group
from stickslip.analysis.members import noun
from stickslip.analysis.models.common_motion import SURROGATES, Number, Shown
from stickslip.analysis.questions.slips.slow_motion import CYCLES, Band, Slow, misfits, slow_motions, together
from stickslip.analysis.questions.slips.triggering import CLUSTERING, exits_of, triggered
from stickslip.analysis.rows import frame_by, frame_of
from stickslip.analysis.settings import AnalysisSettings
from stickslip.analysis.stats.estimates import Estimate, with_ends
from stickslip.analysis.style import GREY, bars, hues, panel
from stickslip.pipeline.design.units import Units

WHAT = "collective motion"
N_STICK = "the number of sticking blocks"
MOST_GROUPS = 3  # which are drawn, or named in an alert
Q = Quantity(
    "quality",
    "Q of slow common motion",
    definition="pi times the time in which the motion decays to 1 / e, in natural periods",
)
PERIOD = Quantity("period", "natural period of slow common motion", dimension="time")
SHARE = Quantity("share", f"share of the variance of {N_STICK} that comes from slow common motion", Form.SHARE)
DEVIANCE = Quantity("deviance", "deviance of the slow spectrum from the fit")
_METHOD = (
    "Time-shifted blocks are each block's own history, shifted by a random time, or by a random number of periods of"
    f" the force; slow common motion, with periods longer than {CYCLES:g} cycles of a single block and than the"
    f" force's, is shown if its power is more concentrated than in 95% of {SURROGATES} such surrogates, and is fitted"
    " as a damped oscillator beside a share of the blocks' own power."
    " Up to Q = 1/2 it is overdamped; with Q near 1 the spectrum has a broad peak, and the motion loses phase within"
    " a period. Slip onsets soon after another are compared with those of time-shifted blocks, adjusted for the"
    " number of comparisons."
)


def answer(study: Study) -> Answer:
    """How much of the variance slow common motion accounts for, and how many exits trigger others."""
    motions = slow_motions(study, WHAT)
    if isinstance(motions, Lack):
        return Answer(findings=[motions])
    motions.sort(key=lambda motion: not motion.is_shown)  # of like ones the first leads
    if not motions:
        is_free = any(group.shift_unit == 0 for group in study.judged())
        return Answer(findings=[Lack(WHAT, Reason.FEW_EVENTS if is_free else Reason.NO_SHIFT)])
    level, lead, where_of, unit = study.settings.confidence, motions[0], places(study), noun(study.unit)
    exits, where = exits_of(study, lead.group), where_of[lead.group.label]
    bands = {motion.group.label: motion.bands(level) for motion in motions[:MOST_GROUPS]}
    fitted = [motion for motion in motions if motion.is_shown]
    missed = [motion.group.label for motion in misfits(fitted, level)]
    laws = [_law(motion, where_of[motion.group.label], unit, motion.group.label in missed) for motion in fitted]
    labels = [motion.group.label for motion in motions if bands.get(motion.group.label)]
    q_of = {motion.group.label: f": {_q(motion)}" for motion in fitted if motion.group.label not in missed}
    named = {signs(str(where_of[label]) or label) + q_of.get(label, ""): bands[label] for label in labels}
    recipe = partial(spectrum, named, hues(study, labels), study.settings.units)
    leading: list[Finding] = [_lacking(lead, where, study.settings)]
    if laws:
        leading = [laws[0], _level(Q, Number.QUALITY, lead, where, unit, lead.group.label in missed)]
    shares = [] if exits is None else triggered(exits, where, unit)
    compared = [] if exits is None else exits.levels(where, unit)
    return Answer(
        findings=[*leading, *shares, *laws[1:], *compared],
        n_lead=1 if laws else 1 + bool(shares),
        alerts=_alerts(lead.group, [str(where_of[label]) for label in missed], fitted),
        method=_METHOD,
        tables={
            "clustering": frame_by(CLUSTERING, () if exits is None else exits.pairs),
            "spectrum": frame_of(Band, (band for group in bands.values() for band in group)),
        },
        figures={"collective": _picture(recipe, lead, len(labels), len(motions))} if named else {},
    )


def _alerts(group: Group, missed: Sequence[str], fitted: Sequence[Slow]) -> list[Alert]:
    """That runs are left out, and at which settings the fit is no more than a summary."""
    alerts = []
    if group.n_moving < len(group):
        alerts.append(Alert.of(Code.NOT_MOVING, n=len(group) - group.n_moving, of=len(group), what=WHAT))
    if missed:
        which = listed([*missed]) if len(missed) <= MOST_GROUPS else f"{len(missed)} settings"
        where, among = (f" at {which}", f" of {len(fitted)} settings together") if len(fitted) > 1 else ("", "")
        alerts.append(Alert.of(Code.MISFIT, where=where, p=f"{together(fitted).p_value:.2g}", among=among))
    return alerts


def _law(motion: Slow, where: Place, unit: str, is_missed: bool) -> Law:
    """At what period blocks move together, how much of the variance that is, and how far data are from the fit."""
    goodness, quality = motion.goodness, motion.fit.estimates[Number.QUALITY]
    freedom = Place.words(f"{goodness.dof} degrees of freedom, p-value {goodness.p_value:.2g}")
    deviance = Level(DEVIANCE, Estimate(goodness.deviance), where + freedom)
    period, share = (
        _level(quantity, key, motion, where, unit, is_missed)
        for quantity, key in ((PERIOD, Number.PERIOD), (SHARE, Number.SHARE))
    )
    damped = "move together slowly" + ", in a broad peak" * ((quality.high or pi) < pi)
    fit, called = (Fit.CLOSE, "period of the fit") if is_missed else (Fit.HOLDS, f"{_q(motion)}, natural period")
    nearly = "move together slowly, but not as a damped oscillator"
    return Law("blocks", damped, period, fit, deviance, nearly, called, share, "the variance of the number sticking")


def _level(quantity: Quantity, key: Number, motion: Slow, where: Place, unit: str, is_missed: bool) -> Level:
    """A number of the fit; one that misses the spectrum has no interval."""
    estimate = motion.fit.estimates[key]
    value = Estimate(estimate.value) if is_missed else estimate
    return Level(quantity, value, where, basis=Basis(len(motion.units), unit))


def _q(motion: Slow) -> str:
    return f"Q = {number(motion.fit.values[Number.QUALITY][0], digits=2)}"


def _lacking(motion: Slow, where: Place, settings: AnalysisSettings) -> Lack:
    """Why no slow common motion is shown."""
    what = f"slow common motion{where.tail}"
    if motion.shown is Shown.NONE:
        return Lack(what, Reason.NOT_SHOWN, f"p-value {motion.fit.p:.2g}")
    needed = f"{limit(motion.needed(settings.t_burn))} {settings.units.time}".rstrip()
    return Lack(what, Reason.SHORT_WINDOW, f"runs to t = {needed} may suffice")


# ---------------------------------------------------------------------------------------------- the figure


def _picture(recipe: Recipe, motion: Slow, n_drawn: int, n: int) -> Picture:
    """Power at long periods beside that of time-shifted blocks, in the words of the setting that leads."""
    shows = {Shown.SLOW: "rises above", Shown.NONE: "has no peak relative to"}
    lines = "; lines: fitted damped oscillators, with Q where the fit holds" * motion.is_shown
    count = f" {n_drawn} of {n} settings are drawn." * (n_drawn < n)
    return Picture(
        recipe,
        f"At long periods the power spectrum of {N_STICK} {shows.get(motion.shown, 'takes longer runs to tell from')}"
        f" that of time-shifted blocks. Only periods longer than {CYCLES:g} cycles of a single block are shown."
        f" Dashed: time-shifted blocks; bars: intervals{lines}.{count}",
    )


@panel(3.4)
def spectrum(ax: Axes, groups: Mapping[str, Sequence[Band]], colours: Sequence[str], units: Units) -> None:
    """Power of n_stick over that of time-shifted blocks against the period, with the fit."""
    ax.axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    for k, ((label, bands), colour) in enumerate(zip(groups.items(), colours, strict=True)):
        with_interval = [band for band in bands if band.ratio.low is not None]
        period, ends = [band.middle for band in with_interval], with_ends(band.ratio for band in with_interval)
        look = {"fmt": "os^"[k], "mfc": "white" if k else colour, "color": colour, "label": label}
        bars(ax, period, ends, markersize=3, linewidth=0.9, **look)
        models = [band.model for band in bands if band.model is not None]
        if models:
            ax.plot([band.middle for band in bands], models, color=colour)
    ax.set(xscale="log", yscale="log", xlabel=units.label("period", "time"), ylabel="power / time-shifted blocks")
    for axis in (ax.xaxis, ax.yaxis):
        ends_of_axis = axis.get_view_interval()
        steps = (1.0, 3.0) if ends_of_axis[1] > 20 * ends_of_axis[0] else (1.0, 2.0, 3.0, 5.0)
        axis.set_major_locator(LogLocator(subs=steps))
        axis.set_major_formatter(lambda x, _: f"{x:g}")
        axis.set_minor_locator(NullLocator())
    ax.figure.legend(loc="outside upper center", ncols=2 if max(map(len, groups)) < 24 else 1)


QUESTION = Question(answer, title="How much do blocks act together?", share=0.31, of_cascades=True)
