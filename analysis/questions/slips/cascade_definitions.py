"""Other definitions of a cascade: the decay rate by each, and over that of the same blocks shifted in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from stickslip.analysis.answer import Answer, Picture
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import Difference, Family, Outcomes, Verdict
from stickslip.analysis.findings.words import listed, sentence
from stickslip.analysis.groups import Group
from stickslip.analysis.rows import frame_of
from stickslip.analysis.series import cascades, nulls
from stickslip.analysis.series.cascades import SAMPLED, Law
from stickslip.analysis.series.nulls import DRAWS
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats.effects import Effect, over_null, together
from stickslip.analysis.stats.estimates import Estimate, gamma, over_matrices
from stickslip.analysis.style import CYCLE, GREY, panel

SHIFTED, EVERY = "time-shifted blocks", "every definition"
_WORDS = (
    "Size by drop: the fall of n_stick over successive samples that fall; by length: the number of these samples; by "
    "descent and decreases: the same where samples may also stay level; by events: slip onsets, without sampling"
)


class Defined(NamedTuple):
    """The decay rate by a definition, and over that of blocks shifted in time: a row of the table `definitions`."""

    group: str
    definition: str
    dt: float | None
    n_cascades: int
    n_matrices: int
    gamma: Estimate
    over: Estimate
    verdict: Verdict | None

    def estimate(self, is_over: bool) -> Estimate:
        """One of the two."""
        return self.over if is_over else self.gamma


def compared(study: Study, group: Group) -> Answer:
    """The decay rate of a group by every definition and sampling step, beside that of blocks shifted in time."""
    rows = _rows(study, group)
    table = {"definitions": frame_of(Defined, rows)}
    if len({row.dt for row in rows if row.dt is not None and row.gamma.low is not None}) < 2:
        return Answer(tables=table)
    verdicts = {Law(row.definition, row.dt): row.verdict for row in rows if row.verdict is not None}
    outcomes = [_outcomes(verdicts)] if verdicts else []
    said = " ".join(sentence(outcome) for outcome in outcomes)
    caption = f"By other definitions of a cascade the decay rate depends on the sampling step. {said} {_WORDS}."
    return Answer(outcomes, tables=table, figures={"definitions": Picture(partial(by_step, rows), caption)})


def _rows(study: Study, group: Group) -> list[Defined]:
    """A row for each law; those that can be compared are judged together."""
    level, margin = study.settings.confidence, study.margins.get("gamma")
    dts = sorted({*study.settings.dt, *study.settings.map_dt})
    laws = cascades.laws(dts)
    flat = study.sums(group, partial(_of_run, dts, min(study.settings.resamples, DRAWS)), 4 * len(laws))
    sums = flat[:, :-1].reshape(-1, 2, len(laws), 2)
    of_law = [sums[sums[:, 0, k, 1] > 0, :, k] for k in range(len(laws))]  # (G, 2, 2): observed, shifted
    effects = together([over_null(gamma, part[:, 0], part[:, 1], level, margin or 0.0) for part in of_law])
    n_tests = sum(effect.p is not None for effect in effects)
    return [
        Defined(
            group.label, law.definition, law.dt, int(part[:, 0, 1].sum()), len(part),
            over_matrices(gamma, part[:, 0], level), effect.ratio,
            None if effect.p is None else _difference(effect, margin, n_tests, 1 - level).verdict,
        )
        for law, part, effect in zip(laws, of_law, effects, strict=True)
    ]  # fmt: skip


def _of_run(dts: Sequence[float], draws: int, run: Run) -> np.ndarray:
    """Sums of every law of a run, and of its blocks shifted in time; these are 0 without events."""
    laws, none = cascades.laws(dts), np.zeros(2)
    observed = cascades.sums(run.win.step)
    for dt in dts:
        observed |= cascades.sums(run.win.sampled(dt), dt)
    shifted = {} if run.steps is None else nulls.sums(run.steps, dts, draws, run.generator())
    return np.concatenate([sums.get(law, none) for sums in (observed, shifted) for law in laws])


def _difference(effect: Effect, margin: float | None, n_tests: int, alpha: float) -> Difference:
    """A ratio of decay rates as their relative difference, one of many."""
    value, low, high = effect.ratio.value, effect.ratio.low, effect.ratio.high
    assert value is not None
    assert low is not None
    assert high is not None
    family = Family(n_tests, effect.p_adjusted or 0.0, effect.p_equivalent_adjusted or 0.0, alpha)
    return Difference(Estimate(value - 1, low - 1, high - 1), margin=margin, family=family)


def _outcomes(verdicts: Mapping[Law, Verdict]) -> Outcomes:
    """The sampling steps by the outcome that all definitions have there; undecided where they have no one outcome."""
    steps = sorted({law.dt for law in verdicts if law.dt is not None})
    of_step = {dt: {_outcome(verdict) for law, verdict in verdicts.items() if law.dt == dt} for dt in steps}
    ranges: dict[str, list[str]] = {"equal": [], "different": [], "undecided": []}
    for outcome, run in groupby(steps, lambda dt: next(iter(of_step[dt])) if len(of_step[dt]) == 1 else "undecided"):
        every = [f"{dt:g}" for dt in run]
        ranges[outcome].append(" to ".join(dict.fromkeys((every[0], every[-1]))))
    equal, different, undecided = (
        (f"{which} at dt = {listed(ranges[name])}",) if ranges[name] else ()
        for name, which in (("equal", EVERY), ("different", EVERY), ("undecided", "some definitions"))
    )
    return Outcomes(SHIFTED, equal, different, undecided)


def _outcome(verdict: Verdict) -> str:
    if verdict in (Verdict.EQUAL, Verdict.SAME):
        return "equal"
    return "different" if verdict in (Verdict.MORE, Verdict.LESS) else "undecided"


def by_step(rows: Sequence[Defined]) -> Figure:
    """The decay rate against the sampling step, one line a definition, and below over that of blocks shifted in time.

    The band is `events`. What is not known is not drawn.
    """
    drawn = [is_over for is_over in (False, True) if any(row.estimate(is_over).low is not None for row in rows)]
    return panel(nrows=len(drawn), sharex=True, squeeze=False)(_by_step)(drawn, rows)


def _by_step(grid: np.ndarray, drawn: Sequence[bool], rows: Sequence[Defined]) -> None:
    axes: Sequence[Axes] = grid.ravel().tolist()
    for ax, is_over in zip(axes, drawn, strict=True):
        known = [(row, row.estimate(is_over)) for row in rows if row.estimate(is_over).low is not None]
        for row, rate in known:
            if row.dt is None and rate.low is not None and rate.high is not None:
                ax.axhspan(rate.low, rate.high, color=GREY, alpha=0.3, linewidth=0, label="events")
        for k, definition in enumerate(SAMPLED):
            line = [(row.dt, rate.value, rate.low, rate.high) for row, rate in known if row.definition == definition]
            if line:
                dt, value, low, high = np.array(line).T
                ax.errorbar(
                    dt, value, yerr=[value - low, high - value], label=definition, color=CYCLE[k],
                    fmt="oDs^"[k], linestyle=("-", "-", "--", "--")[k], markersize=3, linewidth=0.9,
                )  # fmt: skip
        ax.set(xscale="log", ylabel="over time-shifted" if is_over else "decay rate")
    if drawn[-1]:
        axes[-1].axhline(1.0, linestyle="--", color=GREY, linewidth=1)
    steps = sorted({row.dt for row in rows if row.dt is not None})
    axes[-1].set_xticks(steps[:: max(1, -(-len(steps) // 5))])
    axes[-1].xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    axes[-1].xaxis.set_minor_formatter(NullFormatter())
    axes[-1].minorticks_off()
    axes[-1].set_xlabel("sampling step dt")
    axes[0].figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
