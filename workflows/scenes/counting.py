"""Why the decay rate of cascade sizes is not that of a fair coin: finite size, blocks' own dynamics, coupling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, PercentFormatter

from stickslip.analysis.answer import Answer, F, I, Picture, Row, S, frame, lack, named, systems
from stickslip.analysis.ensemble import Study
from stickslip.analysis.findings.finding import (
    Basis,
    Comparison,
    Difference,
    Finding,
    Form,
    Lack,
    Level,
    Parts,
    Quantity,
    Reason,
)
from stickslip.analysis.groups import Group
from stickslip.analysis.members import ENGINE_KEYS, SYSTEM_KEYS
from stickslip.analysis.models import pool
from stickslip.analysis.models.counting import MEAN, N_COLUMNS, OBSERVED, parts, run_sums, without_lulls
from stickslip.analysis.series.runs import Run
from stickslip.analysis.stats import enough
from stickslip.analysis.stats.estimates import LN2, Estimate, over_matrices, ratio
from stickslip.analysis.style import EXACT, GREEN, GREY, SMOOTHED, panel

EXCESS, VARIANCE, SCALED = r"$\gamma/\ln 2-1$", "$np(1-p)$", r"$np(1-p)\,(\gamma/\ln 2-1)$"  # on the axes
#: Largest number of times that a run's blocks are shifted: their rate is known that much better than the run's.
SHIFTS = 30
WHOLE = Quantity("excess", "excess over ln 2", Form.SHARE)
PARTS = (
    Quantity("counting", "finite size", Form.SHARE),
    Quantity("habits", "each block's own dynamics", Form.SHARE),
    Quantity("coupling", "coupling", Form.SHARE),
)
SLOPE = Quantity("slope", "rise of the chance of a slip onset with each sticking block", Form.SHARE)
_ESTIMATES = ("excess", "counting", "habits", "coupling", "independent", "slope", "over_slope")
_TABLE: Mapping[str, str] = {
    "group": S, "n": I, "n_matrices": I, "n_cascades": I, "mean": F, "variance": F, "in_lulls": F,
    **{f"{name}{end}": F for name in _ESTIMATES for end in ("", "_low", "_high")},
    "slope_of_pool": F, "basis": S,
}  # fmt: skip


def question(study: Study) -> Answer | None:
    """Why is the decay rate not ln 2?

    Finite size is the excess of as many independent two-state blocks, as many of which stick, over ln 2;
    own dynamics is that of the runs' own blocks, each shifted by a random time, over two-state blocks; and coupling
    that of the runs over shifted blocks. Stretches of more than 20 in which no block sticks are left out.
    """
    if not study.data.events:
        return Answer(findings=[Lack("the parts of the decay rate", Reason.NOT_RECORDED, "events")])
    rows = [row for group in study.groups if (row := _row(study, group)) is not None]
    table = {"counting": frame(_TABLE, rows)}
    known = [row for row in rows if row["is_judged"] and row["coupling_low"] is not None]
    if not known:
        what = "the parts of the decay rate"
        missing = Lack(what, Reason.NOTHING_COUNTED) if study.judged() else lack(study, what)
        return Answer(findings=[missing], tables=table)
    lead = min(known, key=lambda row: (row["n_runs"] > row["n_moving"], -row["n"]))  # no survivors first
    alike = sorted(
        (row for row in rows if row["of"] == lead["of"] and row["coupling_low"] is not None), key=lambda row: row["n"]
    )
    judged = [lead, *(row for row in reversed(alike) if row is not lead and row in known)]
    findings: list[Finding] = [_parts(study, row, len(judged) > 1) for row in judged]
    slope = Difference(_estimate(lead, "over_slope"))
    where, basis = _where(lead, len(judged) > 1), Basis(lead["n_matrices"], systems(study))
    findings.append(
        Level(SLOPE, _estimate(lead, "slope"), where, Comparison("independent two-state blocks", slope), basis)
    )
    draw = by_number if len(alike) > 1 else at_one_number
    caption = (
        f"Coupling is the distance of the runs from their blocks shifted in time; line and diamonds: independent "
        f"two-state blocks of the same number, of which a share p sticks. {_scaled(alike)}"
        f"{'Faint: not in a steady state. ' * (len(alike) > len(judged))}"
    )
    return Answer(
        findings=findings, tables=table, figures={"counting": Picture(partial(draw, alike), caption.strip())}
    )


def _scaled(rows: Sequence[Row]) -> str:
    return "Below, times n p (1 − p), by which finite size is level. " if len(rows) > 1 else ""


def _where(row: Row, is_swept: bool) -> str:
    return f"n = {row['n']}" if is_swept else ""


def _estimate(row: Row, name: str) -> Estimate:
    return Estimate(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))


def _parts(study: Study, row: Row, is_swept: bool) -> Parts:
    where, basis = _where(row, is_swept), Basis(row["n_matrices"], systems(study))
    whole, *parts = (Level(one, _estimate(row, one.key), where, basis=basis) for one in (WHOLE, *PARTS))
    return Parts(whole, tuple(parts))


def _row(study: Study, group: Group) -> Row | None:
    """Row of the table `counting`: the parts of a group without its lulls; None if it has no events."""
    level, n = study.settings.confidence, int(group.key["n"])
    found = study.sums(group, partial(_of_run, min(study.settings.resamples, SHIFTS)), N_COLUMNS + 6)
    sums, halves, spans = np.hsplit(found[:, :-1], (N_COLUMNS, N_COLUMNS + 4))
    lulls, total = spans.sum(axis=0)
    cascades = sums[:, OBSERVED][:, 1]
    sums, halves, of = sums[cascades > 0], halves[cascades > 0], parts(n)
    if not len(sums):
        return None
    basis = enough.basis(halves[:, :3] / halves[:, 3:], int(cascades.sum()), level)
    estimates = {name: over_matrices(of[name], sums, level) for name in _ESTIMATES}
    mean = float(ratio(sums[:, MEAN].sum(axis=0, keepdims=True))[0])
    row: Row = {
        "group": group.label, "n": n, "n_matrices": len(sums), "n_cascades": basis.n_cascades, "basis": basis.code,
        "is_judged": basis.code in enough.JUDGED,
        "mean": mean, "variance": mean * (1 - mean / n), "in_lulls": float(lulls / total),
        "n_runs": len(group), "n_moving": group.n_moving,
        "slope_of_pool": pool.slope(n, mean) if pool.is_one(n, mean) else None,
        "of": [group.key[name] for name in (*SYSTEM_KEYS, *ENGINE_KEYS) if name != "n"],
    }  # fmt: skip
    for name, one in estimates.items():
        row |= named(name, one)
    return row


def _of_run(draws: int, run: Run) -> np.ndarray | None:
    """`run_sums` of a run without its lulls, `enough.halves` and 1, its time in lulls and all of its time.

    None without events. Of a run of which nothing is left, all but the times are 0.
    """
    if run.steps is None:
        return None
    cut, steps, lull = without_lulls(run.win, run.steps)
    times = [lull, run.win.t_stop - run.win.t_start]
    if not len(cut.t):
        return np.concatenate([np.zeros(N_COLUMNS + 4), times])
    halves = enough.halves(cut.alone)[0]
    return np.concatenate([run_sums(cut, steps, draws, run.generator()), halves, [1.0], times])


def _lines(ax: Axes, rows: Sequence[Row], scaled: bool) -> None:
    """The excess of runs and of three nulls against n p (1 - p); times it if `scaled`, which levels finite size.

    Groups that are not judged are faint.
    """
    x, known = (np.array([row[name] for row in rows]) for name in ("variance", "is_judged"))
    fine = np.geomspace(x.min() / 1.5, x.max() * 1.5, 60)
    scale, of_line = (x, np.ones(len(fine))) if scaled else (np.ones(len(x)), 1 / fine)
    ax.axhline(0.0, linestyle="--", color=GREY, linewidth=1, label="fair coin")
    ax.plot(fine, 0.25 / LN2 * of_line, color=GREEN, linewidth=0.8)
    counted = np.array([row["counting"] for row in rows]) * scale
    ax.plot(x, counted, "D", color=GREEN, markersize=3.5, label="two-state blocks")
    for name, mark, colour, label in (
        ("independent", "s", SMOOTHED, "shifted in time"), ("excess", "o", EXACT, "runs"),
    ):  # fmt: skip
        value, low, high = (np.array([row[f"{name}{end}"] for row in rows]) * scale for end in ("", "_low", "_high"))
        for some, alpha, said in ((known, 1.0, label), (~known, 0.35, "")):
            ax.errorbar(
                x[some], value[some], yerr=[(value - low)[some], (high - value)[some]], fmt=mark,
                color=colour, markersize=3.8, markerfacecolor="white" if mark == "s" else colour, linewidth=0.9,
                label=said, alpha=alpha,
            )  # fmt: skip
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(lambda at, _: f"{at:g}")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set(xlim=(fine[0], fine[-1]))


@panel()
def at_one_number(ax: Axes, rows: Sequence[Row]) -> None:
    """The excess over ln 2 of the runs and of three nulls, at one n; rows of the table `counting`."""
    _lines(ax, rows, scaled=False)
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.set(xlabel=VARIANCE, ylabel=EXCESS)
    ax.legend(loc="upper right")


@panel(nrows=2, height=3.6, sharex=True)
def by_number(axes: Sequence[Axes], rows: Sequence[Row]) -> None:
    """The same for several n; below, times n p (1 - p), so that finite size is level."""
    top, below = axes
    _lines(top, rows, scaled=False)
    _lines(below, rows, scaled=True)
    for k, row in enumerate(rows):
        number = f"n = {row['n']}" if k == 0 else str(row["n"])
        top.annotate(number, (row["variance"], 1.0), xycoords=("data", "axes fraction"), ha="center",
                     va="top", fontsize=6.5, color=GREY)  # fmt: skip
    top.yaxis.set_major_formatter(PercentFormatter(1.0))
    top.set(ylabel=EXCESS)
    below.set(xlabel=VARIANCE, ylabel=SCALED)
    handles, names = below.get_legend_handles_labels()
    below.figure.legend(handles, names, loc="outside upper center", ncols=4, columnspacing=1.0)
