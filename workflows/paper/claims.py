"""The paper's claims, judged by what was measured: facts and verdicts, whose words are in the template."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from stickslip import sim
from stickslip.analysis.answer import F, I, S, frame
from stickslip.analysis.questions.cascades import PAPER_GAMMA
from stickslip.analysis.stats.compare import wilson
from stickslip.analysis.stats.estimates import LN2, Estimate, over_matrices, ratio
from stickslip.analysis.stats.fates import COLLAPSED, DIVERGED, SILENT, SUSTAINED
from stickslip.workflows.paper import figures_1_2
from stickslip.workflows.paper.figures_3_to_5 import CONFIDENCE, Row, by_definition, escapes
from stickslip.workflows.paper.runs import SCALES

if TYPE_CHECKING:
    from stickslip.workflows.paper.chart import Measured, PaperScene

REPRODUCED, CORRECTED, CONTRADICTED, UNTOLD = "reproduced", "corrected", "not reproduced", "cannot be told"
#: What the paper says: figure 3 (ii), and figure 4 (iv) at 5% and 10%.
BRINK, PERIOD, STRONG, STRONGEST = 150.0, 20.0, 0.05, 0.1
_TABLE: Mapping[str, str] = {
    "claim": S, "figure": I, "verdict": S, "found": I, "tried": I, "value": F, "low": F, "high": F,
}  # fmt: skip
_QUIET = (COLLAPSED, SILENT)
Claim = dict[str, Any]


def judge(scene: PaperScene, measured: Measured) -> list[Claim]:
    """Each claim of the figures asked for: its name, `figure`, `verdict`, and the facts that its words need."""
    return [
        {"claim": name.__name__, "figure": figure} | name(scene, measured)
        for figure, names in _CLAIMS.items()
        if figure in scene.figures
        for name in names
    ]


def table(judged: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The claims in numbers: `found` of `tried`, or a `value`, each with its interval."""
    return frame(_TABLE, judged)


def _verdict(is_so: bool, otherwise: str = CONTRADICTED) -> str:
    return REPRODUCED if is_so else otherwise


def _share(rows: Sequence[Row], *of: str) -> Claim:
    found = sum(row.fate in of for row in rows)
    low, high = wilson(found, len(rows), CONFIDENCE)
    return {"found": found, "tried": len(rows), "low": low, "high": high}


def _of(measured: Measured, study: str, n: int | None = None) -> list[Row]:
    return [row for row in measured.runs if row.study == study and n in (None, row.n)]


# ---------------------------------------------------------------------------------------------- one block and two


def one_block(scene: PaperScene, measured: Measured) -> Claim:
    leaves = all(one.exit in one.stick for one in measured.portraits)
    return {"verdict": _verdict(leaves), "portraits": measured.portraits}


def corners(scene: PaperScene, measured: Measured) -> Claim:
    off = [corner.misprint for one in measured.parallelograms for corner in one.corners]
    return {"verdict": _verdict(max(off) < 1e-9, CORRECTED), "low": min(off), "high": max(off)}


def double_exit(scene: PaperScene, measured: Measured) -> Claim:
    corners = [corner for one in measured.parallelograms for corner in one.corners]
    exits = {corner.label for corner in corners if corner.kind == "double exit"}
    return {"verdict": _verdict(exits == {"+-"}, CORRECTED if exits == {"++"} else UNTOLD)}


def determinacy(scene: PaperScene, measured: Measured) -> Claim:
    (one,) = measured.uniqueness
    growth = max(one.apart) / figures_1_2.APART
    return {
        "verdict": _verdict(growth > 10.0 or one.coulomb > 1), "tried": len(one.apart), "value": growth,
        "static": one.static, "static_over": figures_1_2.RATIO,
    }  # fmt: skip


# ---------------------------------------------------------------------------------------------- figure 3


def few_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    return _rest(_of(measured, "long", scene.n[0]), lambda share, ends: share["low"] > 0.5)


def more_come_to_rest(scene: PaperScene, measured: Measured) -> Claim:
    return _rest(_of(measured, "long", scene.n[-2:][0]), lambda share, ends: ends and ends[0] <= BRINK <= ends[-1])


def _rest(rows: Sequence[Row], is_so: Callable[[Claim, list[float]], Any]) -> Claim:
    share, ends = _share(rows, *_QUIET), sorted(row.t_last for row in rows if row.fate in _QUIET)
    return share | {"verdict": _verdict(bool(is_so(share, ends)), UNTOLD), "ends": ends}


def many_keep_on(scene: PaperScene, measured: Measured) -> Claim:
    share, beyond = _share(_of(measured, "long", scene.n[-1]), SUSTAINED), _of(measured, "long", scene.beyond)
    verdict = _verdict(share["low"] > 0.5, CONTRADICTED if share["high"] < 0.5 else UNTOLD)
    return share | {
        "verdict": verdict,
        "n": scene.n[-1],
        "beyond": _share(beyond, DIVERGED),
        "n_beyond": scene.beyond,
    }


def some_collapse(scene: PaperScene, measured: Measured) -> Claim:
    rows = _of(measured, "long", scene.n[-1])
    share, away = _share(rows, *_QUIET), _share(rows, DIVERGED)["found"]
    return share | {"verdict": _verdict(share["found"] > 0, CORRECTED if away else UNTOLD), "away": away}


def _changed(scene: PaperScene, measured: Measured, study: str) -> list[Claim]:
    """By setting of a study its fates, and the mean n_stick less that of the same matrices unchanged."""
    bases = {row.matrix: row for row in _of(measured, "long", scene.n[-1])}
    rows = _of(measured, study)
    settings = dict.fromkeys(row.setting for row in rows)
    return [{"setting": one, **_against([row for row in rows if row.setting == one], bases)} for one in settings]


def _against(rows: Sequence[Row], bases: Mapping[int, Row]) -> Claim:
    fates, usual = Counter(row.fate for row in rows), Counter(bases[row.matrix].fate for row in rows)
    means = [(row.mean, bases[row.matrix].mean) for row in rows]
    pairs = np.array([(mean - base, base) for mean, base in means if mean is not None and base])
    moved = over_matrices(ratio, pairs, CONFIDENCE) if fates[SUSTAINED] == len(rows) and len(pairs) else Estimate()
    sure = moved.low is not None and moved.high is not None and not moved.low <= 0 <= moved.high
    return {
        "n_runs": len(rows), "quiet": sum(fates[end] for end in _QUIET), "sustained": fates[SUSTAINED],
        "diverged": fates[DIVERGED], "moved": moved.value, "low": moved.low, "high": moved.high,
        "is_other": fates != usual, "matters": fates != usual or sure,
    }  # fmt: skip


def key_parameters(scene: PaperScene, measured: Measured) -> Claim:
    """Key is what changes the fate, halved or doubled."""
    rows = _changed(scene, measured, "keys")
    key = {name: any(row["is_other"] for row in rows if row["setting"].startswith(name)) for name in SCALES}
    named = all(key[name] for name in ("belt_speed", "rho", "kappa"))
    verdict = CONTRADICTED if not named else CORRECTED if key["friction"] else REPRODUCED
    return {"verdict": verdict, "rows": rows, "key": key}


def details(scene: PaperScene, measured: Measured) -> Claim:
    """What is drawn otherwise, and the six readings of how K is drawn, by n: which end as figure 3 has it."""
    rows = _changed(scene, measured, "details")
    wanted = [(COLLAPSED, SILENT)] * (len(scene.n) - 1) + [(SUSTAINED,)]
    readings: list[Claim] = []
    for coupling in sim.COUPLINGS:
        by_n = [[row for row in _of(measured, "readings", n) if row.setting == coupling] for n in scene.n]
        fits = all(any(row.fate in ends for row in some) for some, ends in zip(by_n, wanted, strict=True))
        counts = [Counter(row.fate for row in some) for some in by_n]
        readings.append({"coupling": coupling, "fits": fits, "counts": counts})
    verdict = _verdict(all(one["fits"] for one in readings), CORRECTED)
    if any(row["is_other"] for row in rows):
        verdict = CONTRADICTED
    return {"verdict": verdict, "rows": rows, "readings": readings}


# ---------------------------------------------------------------------------------------------- figure 4


def sensitive(scene: PaperScene, measured: Measured) -> Claim:
    """Whether all changed runs part from the unchanged one, and within the time that is drawn."""
    rows = _little_changed(scene, measured)
    apart = [(row.study, row.t_apart) for row in rows if row.t_apart is not None]
    times = {study: sorted(t for one, t in apart if one == study) for study in ("r", "constants")}
    in_time = len(apart) == len(rows) and all(t <= scene.t_shown for _, t in apart)
    verdict = _verdict(in_time, CORRECTED if apart else CONTRADICTED)
    return {"verdict": verdict, "found": len(apart), "tried": len(rows), "times": times, "size": scene.sizes[0]}


def robust(scene: PaperScene, measured: Measured) -> Claim:
    """Whether small changes move the mean n_stick by less than another matrix does."""
    (base,) = _of(measured, "base", scene.n[-1])
    fresh = np.array([row.mean for row in _of(measured, "long", scene.n[-1]) if row.mean is not None])
    means = [row.mean for row in _little_changed(scene, measured)]
    if base.mean is None or None in means or len(fresh) < 3:
        return {"verdict": UNTOLD, "value": None}
    moved = max(abs(mean / base.mean - 1.0) for mean in means if mean is not None)
    spread = 2.0 * float(fresh.std(ddof=1)) / base.mean
    return {"verdict": _verdict(moved < spread), "value": moved, "spread": spread, "tried": len(means)}


def _little_changed(scene: PaperScene, measured: Measured) -> list[Row]:
    constants = [row for row in _of(measured, "constants") if row.size == scene.sizes[0]]
    return _of(measured, "r", scene.n[-1]) + constants


def oscillations(scene: PaperScene, measured: Measured) -> Claim:
    return _dampings(scene, measured, STRONG, lambda rows, periods: min(periods) <= PERIOD <= max(periods))


def collapse_at_strongest(scene: PaperScene, measured: Measured) -> Claim:
    found = _dampings(scene, measured, STRONGEST, lambda rows, periods: all(row.fate in _QUIET for row in rows))
    return found | {"verdict": CORRECTED} if found.get("found") and found["verdict"] == CONTRADICTED else found


def _dampings(
    scene: PaperScene, measured: Measured, size: float, is_so: Callable[[list[Row], list[float]], bool]
) -> Claim:
    rows = [row for row in _of(measured, "dampings") if row.size == size]
    base = _of(measured, "base", scene.n[-1])
    periods = sorted(row.period for row in rows if row.period is not None)
    if not rows or (size == STRONG and not periods):
        return {"verdict": UNTOLD, "found": None}
    moved, usual = ([row.swing for row in some if row.swing is not None] for some in (rows, base))
    ends = sorted(row.t_stop for row in rows if row.fate == DIVERGED)
    return _share(rows, DIVERGED) | {
        "verdict": _verdict(is_so(rows, periods)), "size": size, "periods": periods, "ends": ends,
        "swing": {"moved": moved, "usual": usual},
        "escapes": [
            {"size": one.size, "runs": one.curve.n_runs, "left": one.curve.n_ends, "median": one.median.value,
             "low": one.median.low, "high": one.median.high}
            for one in escapes(measured.runs, scene.t_few)
        ],
    }  # fmt: skip


def sigmoid(scene: PaperScene, measured: Measured) -> Claim:
    """Other sigmoids against tanh on the same matrices: fates, and the mean n_stick."""
    bases = {row.matrix: row for row in _of(measured, "sigmoids") if row.law == "sigmoid"}
    laws = dict.fromkeys(row.law for row in _of(measured, "sigmoids") if row.law != "sigmoid")
    rows = [{"law": law, **_against([r for r in _of(measured, "sigmoids") if r.law == law], bases)} for law in laws]
    verdict = _verdict(not any(row["matters"] for row in rows), CORRECTED)
    if any(row["is_other"] for row in rows):
        verdict = CONTRADICTED
    return {"verdict": verdict, "rows": rows, "tried": len(bases)}


# ---------------------------------------------------------------------------------------------- figures 5 and 6


def gamma(scene: PaperScene, measured: Measured) -> Claim:
    """The paper leaves open how sizes are counted: it can be told only where every definition says the same."""
    rows = [row for row in measured.cascades if row.gamma is not None]
    events = by_definition(rows, "events")
    inside = sum(row.low is not None and row.high is not None and row.low <= PAPER_GAMMA <= row.high for row in rows)
    gammas = [row.gamma for row in rows if row.gamma is not None]
    return {
        "verdict": _verdict(0 < len(rows) == inside, UNTOLD), "rows": rows, "inside": inside, "paper": PAPER_GAMMA,
        "value": events and events.gamma, "low": events and events.low, "high": events and events.high,
        "least": min(gammas, default=None), "most": max(gammas, default=None),
    }  # fmt: skip


def clusters(scene: PaperScene, measured: Measured) -> Claim:
    """gamma by events over that of random order; clusters would make it shallower, and by much."""
    one = by_definition(measured.cascades, "events")
    if one is None or one.gamma is None or one.low is None or one.high is None:
        return {"verdict": UNTOLD, "value": None}
    value, low, high = (of / LN2 - 1.0 for of in (one.gamma, one.low, one.high))
    return {"verdict": _verdict(high < -0.05), "value": value, "low": low, "high": high}


def cascade_bound(scene: PaperScene, measured: Measured) -> Claim:
    one = by_definition(measured.cascades, "events")
    largest = one.largest if one else 0
    return {"verdict": _verdict(largest > scene.n[-1], CORRECTED), "found": largest, "n": scene.n[-1]}


def two_modes(scene: PaperScene, measured: Measured) -> Claim:
    modes = next(one.modes for one in measured.blow_ups if one.law == "modified")
    stable, saddles = ([mode[:2] for mode in modes if mode[2] == is_stable] for is_stable in (True, False))
    return {"verdict": _verdict(len(stable) == 2), "stable": stable, "saddles": saddles}


def mode_ends(scene: PaperScene, measured: Measured) -> Claim:
    jumps = [event for run in measured.slow_runs for event in run.events if event.kind == "jump"]
    return {"verdict": _verdict(not jumps, CORRECTED), "jumps": jumps}


_CLAIMS: Mapping[int, tuple[Callable[[PaperScene, Measured], Claim], ...]] = {
    1: (one_block,),
    2: (corners, double_exit, determinacy),
    3: (few_come_to_rest, more_come_to_rest, many_keep_on, some_collapse, key_parameters, details),
    4: (sensitive, robust, oscillations, collapse_at_strongest, sigmoid),
    5: (gamma, clusters, cascade_bound),
    6: (two_modes, mode_ends),
}
