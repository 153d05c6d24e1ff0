"""The paper's claims, judged by what was measured: facts and verdicts, whose words are in the template."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from stickslip import sim
from stickslip.analysis.questions.cascades import PAPER_GAMMA
from stickslip.analysis.questions.robustness import BOUND
from stickslip.analysis.stats.estimates import LN2, Estimate, over_matrices, ratio
from stickslip.analysis.stats.fates import (
    COLLAPSED,
    DIVERGED,
    FAILED,
    LULL,
    MOVING,
    QUIET,
    WATCHED,
    kaplan_meier,
    median,
)
from stickslip.workflows.charts.claims import (
    CONFIDENCE,
    CONTRADICTED,
    CORRECTED,
    REPRODUCED,
    UNTOLD,
    Claim,
    every,
    share,
    told,
    verdict_of,
)  # fmt: skip
from stickslip.workflows.paper import figures_1_2
from stickslip.workflows.paper.figures_3_to_5 import Row, by_definition, escapes
from stickslip.workflows.paper.runs import SCALES

if TYPE_CHECKING:
    from stickslip.workflows.paper.chart import Measured, PaperScene

#: What the paper says: figure 3 (ii), and figure 4 (iv) at 5% and 10%.
BRINK, PERIOD, STRONG, STRONGEST = 150.0, 20.0, 0.05, 0.1
NEAR = 1.25  # a time is near another within this factor
MOST = 0.5  # a share above it is what happens
MARGIN = 0.1  # of mean n_stick: what differs by less is alike
SAME = 0.05  # of gamma: the paper's, within this share
#: Fates as changed runs are compared in them: a lull is motion.
_KINDS = {name: "moving" if name in MOVING else name for name in (*WATCHED, FAILED)}
CLUSTERED = -0.05  # of gamma over ln 2: what clusters would at least take off


def judge(scene: PaperScene, measured: Measured) -> list[Claim]:
    """Each claim of the figures asked for: its name, `figure`, `verdict`, and the facts that its words need."""
    return [
        {"claim": name.__name__, "figure": figure} | name(scene, measured)
        for figure, names in _CLAIMS.items()
        if figure in scene.figures
        for name in names
    ]


def _median(times: Sequence[float]) -> Estimate:
    return median(*kaplan_meier(np.array(times), np.full(len(times), True), CONFIDENCE)) if len(times) else Estimate()


def _share(rows: Sequence[Row], *of: str) -> Claim:
    """Share of runs with some fates; its interval takes the quiet ones, which cannot be told, either way."""
    found, quiet = (sum(row.fate in some for row in rows) for some in (of, (QUIET,)))
    return share(found, len(rows)) | {"high": share(found + quiet, len(rows))["high"], "quiet": quiet}


def _of(measured: Measured, study: str, n: int | None = None) -> list[Row]:
    return [row for row in measured.runs if row.study == study and n in (None, row.n)]


# ---------------------------------------------------------------------------------------------- one block and two


def one_block(scene: PaperScene, measured: Measured) -> Claim:
    leaves = all(one.exit in one.stick for one in measured.portraits)
    return {"verdict": verdict_of(leaves), "portraits": measured.portraits}


def corners(scene: PaperScene, measured: Measured) -> Claim:
    off = [corner.misprint for one in measured.parallelograms for corner in one.corners]
    return {"verdict": verdict_of(max(off) < 1e-9, CORRECTED), "low": min(off), "high": max(off)}


def double_exit(scene: PaperScene, measured: Measured) -> Claim:
    corners = [corner for one in measured.parallelograms for corner in one.corners]
    exits = {corner.label for corner in corners if corner.kind == "double exit"}
    return {"verdict": verdict_of(exits == {"+-"}, CORRECTED if exits == {"++"} else UNTOLD)}


def determinacy(scene: PaperScene, measured: Measured) -> Claim:
    (one,) = measured.uniqueness
    growth = max(one.apart) / figures_1_2.APART
    return {
        "verdict": verdict_of(growth > 10.0 or one.coulomb > 1), "tried": len(one.apart), "value": growth,
        "static": one.static, "static_over": figures_1_2.RATIO,
    }  # fmt: skip


# ---------------------------------------------------------------------------------------------- figure 3


def few_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    return _rest(_of(measured, "long", scene.n[0]))


def more_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    """Most do, and half of these near the paper's time."""
    found = _rest(_of(measured, "long", scene.n[-2:][0]))
    half = _median(found["ends"])
    return found | {"verdict": every([found["verdict"], told(half.low, half.high, BRINK / NEAR, BRINK * NEAR)])}


def _rest(rows: Sequence[Row]) -> Claim:
    came, ends = _share(rows, COLLAPSED), sorted(row.t_last for row in rows if row.fate == COLLAPSED)
    lulls = sum(row.fate == LULL for row in rows)
    return came | {"verdict": told(came["low"], came["high"], MOST), "ends": ends, "lulls": lulls}


def many_keep_on(scene: PaperScene, measured: Measured) -> Claim:
    going, beyond = _share(_of(measured, "long", scene.n[-1]), *MOVING), _of(measured, "long", scene.beyond)
    return going | {
        "verdict": told(going["low"], going["high"], MOST),
        "n": scene.n[-1],
        "beyond": _share(beyond, DIVERGED),
        "n_beyond": scene.beyond,
    }


def some_collapse(scene: PaperScene, measured: Measured) -> Claim:
    rows = _of(measured, "long", scene.n[-1])
    came, away = _share(rows, COLLAPSED), _share(rows, DIVERGED)["found"]
    verdict = told(came["low"], came["high"], np.nextafter(0, 1), MOST)
    if away and not came["found"]:
        verdict = CORRECTED  # what collapses runs away
    return came | {"verdict": verdict, "away": away}


def _changed(scene: PaperScene, measured: Measured, study: str) -> list[Claim]:
    """By setting of a study its fates, and the mean n_stick less that of the same matrices unchanged."""
    bases = {row.matrix: row for row in _of(measured, "long", scene.n[-1])}
    rows = _of(measured, study)
    settings = dict.fromkeys(row.setting for row in rows)
    return [{"setting": one, **_against([row for row in rows if row.setting == one], bases)} for one in settings]


def _against(rows: Sequence[Row], bases: Mapping[int, Row]) -> Claim:
    fates, usual = (Counter(_KINDS[row.fate] for row in some) for some in (rows, [bases[row.matrix] for row in rows]))
    means = [(row.mean, bases[row.matrix].mean) for row in rows]
    pairs = np.array([(mean - base, base) for mean, base in means if mean is not None and base])
    moved = over_matrices(ratio, pairs, CONFIDENCE) if fates["moving"] == len(rows) and len(pairs) else Estimate()
    untold = fates[QUIET] + usual[QUIET]
    is_other = fates != usual and not untold
    alike = UNTOLD if untold else told(moved.low, moved.high, -MARGIN, MARGIN)
    return {
        "n_runs": len(rows), **{kind: fates[kind] for kind in _KINDS.values()},
        "moved": moved.value, "low": moved.low, "high": moved.high,
        "is_other": is_other, "alike": CONTRADICTED if is_other else alike,
    }  # fmt: skip


def key_parameters(scene: PaperScene, measured: Measured) -> Claim:
    """Key is what changes the fate, halved or doubled; that it never does is not shown by a few runs."""
    rows = _changed(scene, measured, "keys")
    key = {name: any(row["is_other"] for row in rows if row["setting"].startswith(name)) for name in SCALES}
    named = all(key[name] for name in ("belt_speed", "rho", "kappa"))
    verdict = UNTOLD if not named else CORRECTED if key["friction"] else REPRODUCED
    return {"verdict": verdict, "rows": rows, "key": key}


def details(scene: PaperScene, measured: Measured) -> Claim:
    """What is drawn otherwise, and the six readings of how K is drawn, by n: which end as figure 3 has it."""
    rows = _changed(scene, measured, "details")
    wanted = [*((COLLAPSED,) for _ in scene.n[:-1]), MOVING]
    readings: list[Claim] = []
    for coupling in sim.COUPLINGS:
        by_n = [[row for row in _of(measured, "readings", n) if row.setting == coupling] for n in scene.n]
        fits, may_fit = (
            all(any(row.fate in (*ends, *more) for row in some) for some, ends in zip(by_n, wanted, strict=True))
            for more in ((), (QUIET,))
        )
        counts = [Counter(row.fate for row in some) for some in by_n]
        verdict = verdict_of(fits, UNTOLD if may_fit else CONTRADICTED)
        readings.append({"coupling": coupling, "fits": fits, "counts": counts, "verdict": verdict})
    verdicts = [row["alike"] for row in rows] + [one["verdict"] for one in readings]
    return {"verdict": every(verdicts), "rows": rows, "readings": readings}


# ---------------------------------------------------------------------------------------------- figure 4


def sensitive(scene: PaperScene, measured: Measured) -> Claim:
    """Whether changed runs part from the unchanged one within the time that is drawn."""
    rows = _little_changed(scene, measured)
    apart = [(row.study, row.t_apart) for row in rows if row.t_apart is not None and row.t_apart <= scene.t_shown]
    times = {study: sorted(t for one, t in apart if one == study) for study in ("r", "constants")}
    parted = share(len(apart), len(rows))
    return parted | {
        "verdict": told(parted["low"], parted["high"], MOST), "times": times, "size": scene.size,
    }  # fmt: skip


def robust(scene: PaperScene, measured: Measured) -> Claim:
    """Whether small changes do to the mean n_stick less than `BOUND` of what another matrix does, in mean squares."""
    (base,) = _of(measured, "base", scene.n[-1])
    fresh = np.array([row.mean for row in _of(measured, "long", scene.n[-1]) if row.mean is not None])
    means = [row.mean for row in _little_changed(scene, measured)]
    if base.mean is None or None in means or len(fresh) < 3 or not np.ptp(fresh):
        return {"verdict": UNTOLD, "value": None}
    moved = np.array([mean - base.mean for mean in means if mean is not None])
    theta = float(np.mean(moved**2) / (2 * fresh.var(ddof=1)))  # over F where a change does what a matrix does
    dof, tail = (len(moved), len(fresh) - 1), (1 - CONFIDENCE) / 2
    low, high = (theta / float(special.fdtri(*dof, p)) for p in (1 - tail, tail))
    return {"verdict": told(low, high, most=BOUND), "value": theta, "low": low, "high": high, "tried": len(means)}


def _little_changed(scene: PaperScene, measured: Measured) -> list[Row]:
    return _of(measured, "r", scene.n[-1]) + _of(measured, "constants")


def oscillations(scene: PaperScene, measured: Measured) -> Claim:
    """Half of the runs have a period near the paper's."""
    found = _dampings(scene, measured, STRONG)
    half = _median(found.get("periods", ()))
    return found | {"verdict": told(half.low, half.high, PERIOD / NEAR, PERIOD * NEAR)}


def collapse_at_strongest(scene: PaperScene, measured: Measured) -> Claim:
    """Most collapse; or, corrected, run away."""
    found = _dampings(scene, measured, STRONGEST)
    if found["found"] is None:
        return found | {"verdict": UNTOLD}
    came = _share([row for row in _of(measured, "dampings") if row.size == STRONGEST], COLLAPSED)
    otherwise = CORRECTED if found["low"] > MOST else CONTRADICTED
    return found | {"verdict": told(came["low"], came["high"], MOST, otherwise=otherwise)}


def _dampings(scene: PaperScene, measured: Measured, size: float) -> Claim:
    rows = [row for row in _of(measured, "dampings") if row.size == size]
    base = _of(measured, "base", scene.n[-1])
    periods = sorted(row.period for row in rows if row.period is not None)
    if not rows or (size == STRONG and not periods):
        return {"found": None}
    moved, usual = ([row.swing for row in some if row.swing is not None] for some in (rows, base))
    ends = sorted(row.t_stop for row in rows if row.fate == DIVERGED)
    return _share(rows, DIVERGED) | {
        "size": size, "periods": periods, "ends": ends,
        "swing": {"moved": moved, "usual": usual},
        "escapes": escapes(measured.runs, scene.t_few),
    }  # fmt: skip


def sigmoid(scene: PaperScene, measured: Measured) -> Claim:
    """Other sigmoids against tanh on the same matrices: fates, and the mean n_stick."""
    bases = {row.matrix: row for row in _of(measured, "sigmoids") if row.law == "sigmoid"}
    laws = dict.fromkeys(row.law for row in _of(measured, "sigmoids") if row.law != "sigmoid")
    rows = [{"law": law, **_against([r for r in _of(measured, "sigmoids") if r.law == law], bases)} for law in laws]
    return {"verdict": every([row["alike"] for row in rows]), "rows": rows, "tried": len(bases)}


# ---------------------------------------------------------------------------------------------- figures 5 and 6


def gamma(scene: PaperScene, measured: Measured) -> Claim:
    """By falls in a row, as the paper counts; it leaves open the step, so that all steps have to say the same."""
    rows = [row for row in measured.cascades if row.gamma is not None]
    events = by_definition(rows, "events")
    inside = sum(row.low is not None and row.high is not None and row.low <= PAPER_GAMMA <= row.high for row in rows)
    gammas = [row.gamma for row in rows if row.gamma is not None]
    ends = PAPER_GAMMA * (1 - SAME), PAPER_GAMMA * (1 + SAME)
    by_step = {told(row.low, row.high, *ends) for row in rows if row.definition == "length"}
    return {
        "verdict": by_step.pop() if len(by_step) == 1 else UNTOLD,
        "rows": rows, "inside": inside, "paper": PAPER_GAMMA,
        "value": events and events.gamma, "low": events and events.low, "high": events and events.high,
        "least": min(gammas, default=None), "most": max(gammas, default=None),
    }  # fmt: skip


def clusters(scene: PaperScene, measured: Measured) -> Claim:
    """gamma by events over that of the toss of a coin; clusters would make it shallower, and by much."""
    one = by_definition(measured.cascades, "events")
    if one is None or one.gamma is None or one.low is None or one.high is None:
        return {"verdict": UNTOLD, "value": None}
    value, low, high = (of / LN2 - 1.0 for of in (one.gamma, one.low, one.high))
    return {"verdict": told(low, high, most=CLUSTERED), "value": value, "low": low, "high": high,
            "clustered": -CLUSTERED}  # fmt: skip


def cascade_bound(scene: PaperScene, measured: Measured) -> Claim:
    one = by_definition(measured.cascades, "events")
    largest = one.largest if one else 0
    return {"verdict": verdict_of(largest > scene.n[-1], CORRECTED), "found": largest, "n": scene.n[-1]}


def two_modes(scene: PaperScene, measured: Measured) -> Claim:
    modes = next(one.modes for one in measured.blow_ups if one.law == "modified")
    stable, saddles = ([mode[:2] for mode in modes if mode[2] == is_stable] for is_stable in (True, False))
    return {"verdict": verdict_of(len(stable) == 2), "stable": stable, "saddles": saddles}


def mode_ends(scene: PaperScene, measured: Measured) -> Claim:
    jumps = [event for run in measured.slow_runs for event in run.events if event.kind == "jump"]
    return {"verdict": verdict_of(not jumps, CORRECTED), "jumps": jumps}


_CLAIMS: Mapping[int, tuple[Callable[[PaperScene, Measured], Claim], ...]] = {
    1: (one_block,),
    2: (corners, double_exit, determinacy),
    3: (few_come_to_rest, more_come_to_rest, many_keep_on, some_collapse, key_parameters, details),
    4: (sensitive, robust, oscillations, collapse_at_strongest, sigmoid),
    5: (gamma, clusters, cascade_bound),
    6: (two_modes, mode_ends),
}
