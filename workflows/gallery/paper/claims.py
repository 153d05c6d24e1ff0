"""The paper's claims, judged by measurements: facts and verdicts, which the template puts into words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from stickslip.analysis.models.fates import COLLAPSED, DIVERGED, FAILED, LULL, MOVING, QUIET, WATCHED
from stickslip.analysis.stats import components
from stickslip.analysis.stats.enough import LEAST_MATRICES
from stickslip.analysis.stats.estimates import LN2, Estimate, over_matrices, ratio
from stickslip.analysis.stats.estimates import gamma as law_gamma
from stickslip.analysis.stats.survival import median
from stickslip.workflows.gallery.charts.claims import (
    CONFIDENCE,
    CONTRADICTED,
    CORRECTED,
    REPRODUCED,
    UNTOLD,
    Claim,
    alike,
    every,
    judged,
    numbers,
    share,
    told,
    verdict_of,
)
from stickslip.workflows.gallery.paper import figures_1_2
from stickslip.workflows.gallery.paper.figures_3_to_5 import PAPER_GAMMA, Cascades, Row, by_definition, escapes
from stickslip.workflows.gallery.paper.runs import OF_TEXT, SCALES

if TYPE_CHECKING:
    from stickslip.workflows.gallery.paper.chart import Measured, PaperScene

#: What the paper says: figure 3 (ii), and figure 4 (iv) at 5%; its strongest change.
BRINK, PERIOD, STRONG, STRONGEST = 150.0, 20.0, 0.05, 0.1
NEAR = 1.25  # a time is near another within this factor
MOST = 0.5  # a share above it is what happens
MARGIN = 0.1  # of mean n_stick: what differs by less is alike
BOUND = 0.25  # of another matrix's mean square difference, half in amplitude: a change of less is small
FORM = 0.1  # of the variance of sizes: what is off an exponential's by less is alike
SAME = 0.05  # of gamma: the paper's, within this share; between laws too
COMMON = 0.05  # of the exits: paths share less than so much beyond chance, if they have nothing in common
CLUSTERED = -0.05  # of gamma over ln 2: what clusters would at least take off
LITTLE = ("r", "constants")  # what is changed a little: the widths of the sigmoid, and the constants by `size`
#: Fates as changed runs are compared in them: a lull is motion.
_KINDS = {name: "moving" if name in MOVING else name for name in (*WATCHED, FAILED)}


def judge(scene: PaperScene, measured: Measured) -> list[Claim]:
    """Each claim of the figures asked for: its name, `figure`, `verdict`, and the facts that its words need."""
    figures = (figure for figure in _CLAIMS if figure in scene.figures)
    return [claim | {"figure": k} for k in figures for claim in judged(_CLAIMS[k], scene, measured)]


def _median(times: Sequence[float]) -> Estimate:
    return median(np.array(times), np.full(len(times), True), CONFIDENCE)


def _share(rows: Sequence[Row], *fates: str) -> Claim:
    """Share of runs with some fates; its interval takes the quiet ones, which cannot be told, either way."""
    n_found, quiet = (sum(row.fate in wanted_fates for row in rows) for wanted_fates in (fates, (QUIET,)))
    return share(n_found, len(rows)) | {"high": share(n_found + quiet, len(rows))["high"], "quiet": quiet}


def _of(measured: Measured, study: str, n: int | None = None) -> list[Row]:
    return [row for row in measured.runs if row.study == study and n in (None, row.n)]


# ---------------------------------------------------------------------------------------------- one block and two


def one_block(scene: PaperScene, measured: Measured) -> Claim:
    leaves = all(portrait.exit in portrait.stick for portrait in measured.portraits)
    return {"verdict": verdict_of(leaves), "portraits": measured.portraits}


def corners(scene: PaperScene, measured: Measured) -> Claim:
    off = [corner.misprint for parallelogram in measured.parallelograms for corner in parallelogram.corners]
    return {"verdict": verdict_of(max(off) < 1e-9, CORRECTED), "low": min(off), "high": max(off)}


def double_exit(scene: PaperScene, measured: Measured) -> Claim:
    corners = [corner for parallelogram in measured.parallelograms for corner in parallelogram.corners]
    exits = {corner.label for corner in corners if corner.kind == "double exit"}
    return {"verdict": verdict_of(exits == {"+-"}, CORRECTED if exits == {"++"} else UNTOLD)}


def determinacy(scene: PaperScene, measured: Measured) -> Claim:
    (measure,) = measured.uniqueness
    growth = max(measure.apart) / figures_1_2.APART
    return {
        "verdict": verdict_of(growth > 10.0 or measure.coulomb > 1),
        "tried": len(measure.apart),
        "value": growth,
        "static": measure.static,
        "static_over": figures_1_2.RATIO,
    }


# ---------------------------------------------------------------------------------------------- figure 3


def few_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    return _rest(_of(measured, "long", scene.n[0]))


def more_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    """Most do, and half of these near the paper's time."""
    claim = _rest(_of(measured, "long", scene.n[-2:][0]))
    half = _median(claim["ends"])
    return claim | {"verdict": every([claim["verdict"], told(half.low, half.high, BRINK / NEAR, BRINK * NEAR)])}


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
    return [
        {"setting": setting, **_against([row for row in rows if row.setting == setting], bases)}
        for setting in settings
    ]


def _against(rows: Sequence[Row], bases: Mapping[int, Row]) -> Claim:
    fates, usual = (
        Counter(_KINDS[row.fate] for row in group) for group in (rows, [bases[row.matrix] for row in rows])
    )
    ends = [{_KINDS[row.fate], _KINDS[bases[row.matrix].fate]} for row in rows]
    changed = share(sum(len(kinds - {QUIET}) > 1 for kinds in ends), len(rows))
    means = [(row.mean, bases[row.matrix].mean) for row in rows]
    pairs = np.array([(mean - base, base) for mean, base in means if mean is not None and base])
    shift = over_matrices(ratio, pairs, CONFIDENCE) if fates["moving"] == len(rows) and len(pairs) else Estimate()
    untold = fates[QUIET] + usual[QUIET]
    is_other = fates != usual and not untold
    # a few runs that end otherwise contradict only if their share is beyond the margin with its whole interval
    is_open = changed["found"] or untold
    verdict = told(changed["low"], 1.0, most=MARGIN) if is_open else alike(shift, MARGIN)
    return {
        "n_runs": len(rows),
        "fates": Counter(row.fate for row in rows),
        "moved": shift.value,
        "low": shift.low,
        "high": shift.high,
        "is_other": is_other,
        "alike": verdict,
    }


def key_parameters(scene: PaperScene, measured: Measured) -> Claim:
    """A constant is key if halving or doubling it changes the fate; a few runs cannot show that it never does."""
    rows = _changed(scene, measured, "keys")
    key = {name: any(row["is_other"] for row in rows if row["setting"].startswith(name)) for name in SCALES}
    is_named = all(key[name] for name in ("belt_speed", "rho", "kappa"))
    verdict = UNTOLD if not is_named else CORRECTED if key["friction"] else REPRODUCED
    return {"verdict": verdict, "rows": rows, "key": key}


def details(scene: PaperScene, measured: Measured) -> Claim:
    """What the paper lists although it may be drawn differently: the start and the friction of each block.

    How K is drawn is not such a detail; the six readings of it are listed too, by n: which end as in figure 3?
    """
    rows = _changed(scene, measured, "details")
    fates = [*((COLLAPSED,) for _ in scene.n[:-1]), MOVING]
    readings: list[Claim] = []
    for coupling in OF_TEXT:
        by_n = [[row for row in _of(measured, "readings", n) if row.setting == coupling] for n in scene.n]
        fits, may_fit = (
            all(
                any(row.fate in (*ends, *open_fates) for row in group)
                for group, ends in zip(by_n, fates, strict=True)
            )
            for open_fates in ((), (QUIET,))
        )
        counts = [Counter(row.fate for row in group) for group in by_n]
        verdict = verdict_of(fits, UNTOLD if may_fit else CONTRADICTED)
        readings.append({"coupling": coupling, "verdict": verdict, "counts": counts})
    return {"verdict": every([row["alike"] for row in rows]), "rows": rows, "readings": readings}


# ---------------------------------------------------------------------------------------------- figure 4


def sensitive(scene: PaperScene, measured: Measured) -> Claim:
    """Whether runs with a small change part from the unchanged ones by `t_shown`: under each change most do."""
    shares = {}
    for change in LITTLE:
        rows = [row for row in _of(measured, "lasting") if row.setting == change]
        times = sorted(row.t_apart for row in rows if row.t_apart is not None and row.t_apart <= scene.t_shown)
        shares[change] = share(len(times), len(rows)) | {"times": times}
    fewest = min(shares.values(), key=lambda part: part["low"] or 0.0)
    return {name: fewest[name] for name in ("found", "tried", "low", "high")} | {
        "verdict": every([told(part["low"], part["high"], MOST) for part in shares.values()]),
        "each": shares,
        "size": scene.size,
        "is_few_at_rest": all(row.fate == COLLAPSED for row in _of(measured, "r", scene.n[0])),
    }


def robust(scene: PaperScene, measured: Measured) -> Claim:
    """Whether a small change moves mean n_stick by less than `BOUND` of what another matrix would, in mean squares.

    Replicates are the unchanged run and one from another start, and only
    matrices all of whose runs are in motion enter. How many runs are, under each change, is counted beside it.
    """
    by_setting: dict[str, dict[int, Row]] = {}
    for row in _of(measured, "lasting"):
        by_setting.setdefault(row.setting, {})[row.matrix] = row
    all_of = [by_setting.get(setting, {}) for setting in ("unchanged", "start", *LITTLE)]
    means = [
        [rows[k].mean for rows in all_of]
        for k in all_of[0]
        if all(k in rows and rows[k].fate in MOVING for rows in all_of)
    ]
    moving = {
        setting: _share(list(by_setting.get(setting, {}).values()), *MOVING) for setting in ("unchanged", *LITTLE)
    }
    facts = {"moving": moving, "bound": BOUND, "tried": len(means), "size": scene.size}
    if len(means) < LEAST_MATRICES:
        return facts | {"verdict": UNTOLD, "rms": None}
    values = np.array(means, dtype=float)
    result = components.against_redraw(values[:, :2], values[:, 2:], CONFIDENCE)
    theta = result.theta  # its interval is unbounded where matrices cannot be told apart
    return facts | {
        "verdict": told(theta.low, theta.high, most=BOUND),
        "value": None if theta.high is None else theta.value,
        "low": theta.low,
        "high": theta.high,
        "rms": {
            name: float(np.sqrt(square) / values[:, :2].mean())
            for name, square in (("change", result.change), ("start", result.replicate), ("matrix", result.redraw))
        },
    }


def oscillations(scene: PaperScene, measured: Measured) -> Claim:
    """Half of the runs have a period near the paper's; beside it the runs without noise and with the least."""
    claim = _dampings(scene, measured, STRONG)
    runs = _of(measured, "base", scene.n[-1]) + _of(measured, "dampings")
    by_size: dict[float, list[tuple[float, float]]] = {}
    for row in sorted(runs, key=lambda row: row.size):
        if row.period is not None and row.swing is not None:
            by_size.setdefault(row.size, []).append((row.period, row.swing))
    if claim["found"] is None or STRONG not in by_size:
        return {"found": None, "verdict": UNTOLD}
    half, bounds = _median([period for period, _ in by_size[STRONG]]), (PERIOD / NEAR, PERIOD * NEAR)
    less = [pair for size, pairs in list(by_size.items())[:2] for pair in pairs if size < STRONG]
    return claim | {
        "verdict": told(half.low, half.high, *bounds),
        "seen": {size: by_size[size] for size in [*list(by_size)[:2], STRONG]},
        "is_old": bool(less) and all(bounds[0] <= period <= bounds[1] for period, _ in less),
        "is_wider": min(swing for _, swing in by_size[STRONG]) > max((swing for _, swing in less), default=0.0),
    }


def collapse_at_strongest(scene: PaperScene, measured: Measured) -> Claim:
    """Most collapse; or, corrected, run away: under both readings of what is moved, as the paper names neither."""
    claim = _dampings(scene, measured, STRONGEST)
    by_size = [row for row in _of(measured, "dampings") if row.size == STRONGEST]
    noisy, scaled = (_share(rows, COLLAPSED) for rows in (by_size, _of(measured, "scaled")))
    if claim["found"] is None or not scaled["tried"]:
        return claim | {"verdict": UNTOLD, "scaled": scaled}
    otherwise = CORRECTED if claim["low"] > MOST else CONTRADICTED
    by_reading = {
        told(noisy["low"], noisy["high"], MOST, otherwise=otherwise),
        told(scaled["low"], scaled["high"], MOST),
    }
    return claim | {"verdict": by_reading.pop() if len(by_reading) == 1 else UNTOLD, "scaled": scaled}


def _dampings(scene: PaperScene, measured: Measured, size: float) -> Claim:
    """Under noise of a size on all dampings how many run away, and when."""
    rows = [row for row in _of(measured, "dampings") if row.size == size]
    if not rows:
        return {"found": None}
    ends = sorted(row.t_stop for row in rows if row.fate == DIVERGED)
    return _share(rows, DIVERGED) | {"ends": ends, "escapes": escapes(measured.runs, scene.t_few)}


def paths_and_laws(scene: PaperScene, measured: Measured) -> Claim:
    """Another model of the switch has no path in common, but the same law: exits that two runs share, and statistics.

    All three are needed: shared exits are those of chance to within `COMMON`, mean n_stick and gamma alike.
    """
    pairings = measured.pairings
    rows = np.array([(pair.shared, pair.by_chance, pair.n_exits) for pair in pairings], dtype=float).reshape(-1, 3)
    means = np.array([(pair.mean_smoothed - pair.mean, pair.mean) for pair in pairings]).reshape(-1, 2)
    sizes = np.array(
        [(pair.size_smoothed, pair.cascades_smoothed, pair.size, pair.cascades) for pair in pairings], dtype=float
    ).reshape(-1, 4)
    shared = over_matrices(lambda s: s[:, 0] / s[:, 2], rows, CONFIDENCE)
    chance = over_matrices(lambda s: s[:, 1] / s[:, 2], rows, CONFIDENCE)
    beyond = over_matrices(lambda s: (s[:, 0] - s[:, 1]) / s[:, 2], rows, CONFIDENCE)
    mean = over_matrices(ratio, means, CONFIDENCE)
    steep = over_matrices(lambda s: law_gamma(s[:, :2]) / law_gamma(s[:, 2:]) - 1, sizes, CONFIDENCE)
    return numbers(shared) | {
        "verdict": every([alike(beyond, COMMON), alike(mean, MARGIN), alike(steep, SAME)]),
        "tried": len(pairings),
        "chance": chance.value,
        "mean": mean,
        "gamma": steep,
        "t_from": scene.t_burn,
    }


def sigmoid(scene: PaperScene, measured: Measured) -> Claim:
    """Other sigmoids against tanh on the same matrices: fates, and the mean n_stick."""
    bases = {row.matrix: row for row in _of(measured, "sigmoids") if row.law == "sigmoid"}
    laws = dict.fromkeys(row.law for row in _of(measured, "sigmoids") if row.law != "sigmoid")
    rows = [{"law": law, **_against([r for r in _of(measured, "sigmoids") if r.law == law], bases)} for law in laws]
    return {"verdict": every([row["alike"] for row in rows]), "rows": rows, "tried": len(bases)}


# ---------------------------------------------------------------------------------------------- figures 5 and 6


#: The paper's size, the number of successive steps of time in which n_stick falls, with a pause between them or not.
READINGS = ("decreases", "length")


def form(scene: PaperScene, measured: Measured) -> Claim:
    """The variance of sizes is an exponential's to within `FORM`: by each reading at each step."""
    rows = [row for row in measured.cascades if row.excess is not None]
    events = by_definition(rows, "events")
    low, high = _ends(rows, "excess_low", "excess_high")
    return {
        "verdict": told(low, high, -FORM, FORM),
        "margin": FORM,
        "value": events and events.excess,
        "low": events and events.excess_low,
        "high": events and events.excess_high,
        "readings": {reading: [row.excess for row in rows if row.definition == reading] for reading in READINGS},
    }


def _ends(rows: Sequence[Cascades], low: str, high: str) -> tuple[float | None, float | None]:
    """The lowest and the highest end of the intervals of all readings."""
    readings = [row for row in rows if row.definition in READINGS]
    lows, highs = ([end for row in readings if (end := getattr(row, name)) is not None] for name in (low, high))
    return min(lows, default=None), max(highs, default=None)


def gamma(scene: PaperScene, measured: Measured) -> Claim:
    """By falls, as the paper counts; it leaves the step and pauses open, so all readings together have to say it."""
    rows = [row for row in measured.cascades if row.definition in ("events", *READINGS) and row.gamma is not None]
    events = by_definition(rows, "events")
    steps = [
        (row.dt, row.gamma)
        for row in rows
        if row.definition == READINGS[0] and row.dt is not None and row.gamma is not None
    ]
    around = [
        (short, long)
        for (short, gamma_short), (long, gamma_long) in pairwise(sorted(steps))
        if min(gamma_short, gamma_long) <= PAPER_GAMMA <= max(gamma_short, gamma_long)
    ]
    ends = PAPER_GAMMA * (1 - SAME), PAPER_GAMMA * (1 + SAME)
    return {
        "verdict": told(*_ends(rows, "low", "high"), *ends),
        "paper": PAPER_GAMMA,
        "around": around,
        "value": events and events.gamma,
        "low": events and events.low,
        "high": events and events.high,
        "readings": {reading: [row.gamma for row in rows if row.definition == reading] for reading in READINGS},
        "rows": [asdict(row) for row in rows],
    }


def clusters(scene: PaperScene, measured: Measured) -> Claim:
    """gamma by events over that of the toss of a coin; clusters would make it shallower, and by much."""
    law = by_definition(measured.cascades, "events")
    if law is None or law.gamma is None or law.low is None or law.high is None:
        return {"verdict": UNTOLD, "value": None}
    over = Estimate(law.gamma, law.low, law.high).under(lambda rate: rate / LN2 - 1.0)
    return numbers(over) | {"verdict": told(over.low, over.high, most=CLUSTERED), "clustered": -CLUSTERED}


def cascade_bound(scene: PaperScene, measured: Measured) -> Claim:
    law = by_definition(measured.cascades, "events")
    largest = law.largest if law else 0
    return {"verdict": verdict_of(largest > scene.n[-1], CORRECTED), "found": largest, "n": scene.n[-1]}


def two_modes(scene: PaperScene, measured: Measured) -> Claim:
    modes = next(flow.modes for flow in measured.blow_ups if flow.law == "modified")
    stable, saddles = ([mode[:2] for mode in modes if mode[2] == is_stable] for is_stable in (True, False))
    return {"verdict": verdict_of(len(stable) == 2), "stable": stable, "saddles": saddles}


def mode_ends(scene: PaperScene, measured: Measured) -> Claim:
    jumps = [event for run in measured.slow_runs for event in run.events if event.kind == "jump"]
    return {"verdict": verdict_of(not jumps, CORRECTED), "jumps": jumps}


_CLAIMS: Mapping[int, tuple[Callable[[PaperScene, Measured], Claim], ...]] = {
    1: (one_block,),
    2: (corners, double_exit, determinacy),
    3: (few_come_to_rest, more_come_to_rest, many_keep_on, some_collapse, key_parameters, details),
    4: (sensitive, robust, paths_and_laws, oscillations, collapse_at_strongest, sigmoid),
    5: (form, gamma, clusters, cascade_bound),
    6: (two_modes, mode_ends),
}
