"""What the page of the chart `paper` says: captions, counts in words, claims. All of it changes with the numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from stickslip.analysis.report.words import PAPER_GAMMA, capital
from stickslip.workflows.paper import figures as paper_figures
from stickslip.workflows.paper.blocks import KAPPA_1, KAPPA_2, KAPPA_12, MU, ONE, RHO, V
from stickslip.workflows.paper.hidden import FORCE, SlowRun, Undetermined
from stickslip.workflows.paper.measure import Measured
from stickslip.workflows.paper.runs import EARLY, Cascades, Change, Draw
from stickslip.workflows.paper.scene import LAWS, PaperScene

#: The level of the intervals.
CONFIDENCE = 0.95
#: What a share or a range of numbers is given of.
_RULE = (
    "K is (U − Uᵀ)/2 off the diagonal and |U_ii| on it, U uniform in [−0.2, 0.2], R uniform in [3.5, 7]: the reading"
    " of the text that gives all of figure 3; the paper's own matrices are not published"
)
_DEFINITION = (
    "a block of the sigmoid sticks when |F_i| < μ and |w_i − v| < ε ln(1/ε), which tends to the exact law; the paper"
    " states no threshold"
)
_SAMPLING = "drawn is n_stick at its exact times of change, where the paper samples"


@dataclass(frozen=True)
class Drawing:
    """One figure on the page: what is as in the paper, what is not and why; pictures beside it, with their words."""

    number: int
    title: str
    figure: Figure
    same: str
    differs: list[str]
    beside: tuple[tuple[Figure, str], ...] = ()


# ---------------------------------------------------------------------------------------------- numbers in words


def share(found: int, tried: int) -> tuple[float, float, float]:
    """found / tried with its Wilson interval; tried > 0."""
    interval = binomtest(found, tried).proportion_ci(CONFIDENCE, method="wilson")
    return found / tried, float(interval.low), float(interval.high)


def counted(found: int, tried: int) -> str:
    _, low, high = share(found, tried)
    return f"{found} of {tried} ({100 * low:.0f} to {100 * high:.0f}%)"


def _span(values: Iterable[float], form: str = "%.3g") -> str:
    some = sorted(values)
    if not some:
        return "none"
    low, high = form % some[0], form % some[-1]
    return low if low == high else f"{low} to {high}"


def minus(text: str) -> str:
    """Hyphens before numbers as minus signs."""
    return re.sub(r"(?<![\w])-(?=[\d.])", "−", text)


def number(count: int) -> str:
    return str(count) if count else "none"


# ---------------------------------------------------------------------------------------------- figures 1, 2, 6


def figure1(measured: Measured) -> Drawing:
    rho, kappa, mu, _ = ONE
    portraits, words = [], []
    for one in measured.portraits:
        low, high = one.stick
        portraits.append(paper_figures.Portrait(minus(f"v = {one.v:g}"), one.v, (low, high), one.exit, one.paths))
        from_exit = next(w for _, w, is_exit in one.paths if is_exit)
        side = "right" if from_exit[-1] > one.v else "left"
        words.append(
            f"v = {one.v:g}: sticks for z in [{low:.4g}, {high:.4g}], leaves to the {side} at z = {one.exit:.4g}"
        )
    return Drawing(
        1, "one block", paper_figures.phase_portraits(portraits),
        f"the stick interval between the two folds, and one exit point E; {'; '.join(words)}.",
        [
            f"The paper names no constants: here ρ = {rho:g}, κ = {kappa:g}, μ = {mu:g}, and the paths are computed.",
            "What the text calls curvature, −κ v at both folds, is the third derivative of z.",
        ],
    )  # fmt: skip


#: Kind of a corner by how many of its two folds are visible.
_CORNERS = {2: "double exit", 1: "mixed", 0: "double entry"}


def _signs(lambda_1: int, lambda_2: int) -> str:
    return f"{'+' if lambda_1 > 0 else '-'}{'+' if lambda_2 > 0 else '-'}"


def printed_corner(lambda_1: int, lambda_2: int) -> np.ndarray:
    """Eq. (8) as the paper prints it, shape (2,)."""
    p, q = RHO * V + lambda_1 * MU, RHO * V + lambda_2 * MU
    k1, k2, k12 = KAPPA_1, KAPPA_2, KAPPA_12
    k = k1 * k2 - k12 * (k1 + k2)
    return -p / k * np.array([k12 - k1, k12]) - q / k * np.array([k12, k12 - k2])


def figure2(measured: Measured) -> Drawing:
    drawn, off, exits, orders, mixed = [], [], [], [], []
    for one in measured.parallelograms:
        corners = []
        for a, b, x, y, *folds in one.corners:
            kind = _CORNERS[folds.count("visible")]
            corners.append((_signs(a, b), x, y, kind))
            off.append(float(np.abs(printed_corner(a, b) - (x, y)).max()))
            if kind == "double exit":
                exits.append(f"{{{', '.join(_signs(a, b))}}} at ({x:.4f}, {y:.4f}) for s = {one.sign:+d}")
        name = minus(f"s = {one.sign:+d}")
        reading = "eq. (6) as printed" if one.sign > 0 else "what section 3 goes on with"
        paths = [paper_figures.Path(p.case, p.t, p.z, p.w, p.events) for p in one.paths]
        drawn.append(paper_figures.Parallelogram(f"{name}, {reading}", V, corners, paths))
        first, last = (next(path for path in one.paths if path.case == case) for case in "ac")
        order = [f"block {block + 1} at t = {t:.4f}" for t, block, mode in first.events if mode]
        leaves = [f"block {k + 1} {'leaves' if w[1] > w[0] else 'stays'}" for k, w in enumerate(last.w)]
        mixed.append(f"{' and '.join(leaves)} ({name})")
        orders.append(f"{', '.join(order)} ({name})" if order else f"none ({name})")
    return Drawing(
        2, "two blocks", paper_figures.parallelograms(drawn),
        f"constants of the caption: ρ = {RHO:g}, κ₁ = {KAPPA_1:g}, κ₂ = {KAPPA_2:g},"
        f" κ₁₂ = {KAPPA_12:g}, μ = {MU:g}, v = {V:g}; (a) one block and then the other exits from"
        f" the middle: {'; '.join(orders)}.",
        [
            "Two signs of the coupling: eq. (6), s = +1, and the formulas of section 3, s = −1, do not agree: both"
            f" are drawn. Eq. (8) as printed fits neither: it is off by {_span(off)} in the larger coordinate.",
            f"(b) is the double exit {' and '.join(exits)}, one for each sign; (c) starts at a mixed corner,"
            f" {{+, −}}: {', '.join(mixed)}. The text names {{+, −}} and {{−, +}} for (b) and (c).",
            "Drawn are computed paths in the plane of displacements and relative velocities in time (dotted: exits),"
            " not a sketch of four dimensions.",
        ],
    )  # fmt: skip


def figure6(measured: Measured) -> Drawing:
    panels, words = [], []
    for letter, one in zip("ab", measured.blow_ups, strict=False):
        panels.append((f"({letter}) {one.law} law", one.axis, np.array(one.rate), one.modes))
        stable = [f"({x:.4g}, {y:.4g})" for x, y, is_stable in one.modes if is_stable]
        other = [f"({x:.6f}, {y:.6f})" for x, y, is_stable in one.modes if not is_stable]
        words.append(
            f"{one.law} law: {len(one.modes)} sticking mode{'s' if len(one.modes) != 1 else ''}, stable"
            f" {' and '.join(stable) or 'none'}{', unstable ' + ' and '.join(other) if other else ''}"
        )
    (found,), (branches,) = measured.undetermined, measured.branches
    slow = paper_figures.slow_modes(
        branches.points, [(f"from λ = {_corner_of(run)}", run.t, run.lam) for run in measured.slow_runs]
    )
    open_future = paper_figures.futures(
        (found.axis, found.resistance, found.target, found.modes),
        found.v, [(one.begins, one.t, one.w) for one in found.futures],
    )  # fmt: skip
    return Drawing(
        6, "hidden dynamics", paper_figures.blow_ups(panels), f"{'; '.join(words)}.",
        [
            f"The paper does not say where in the parallelogram its panels are: here F₁ = −F₂ = {FORCE:g} in both, so"
            " that they differ by the law alone.",
            "The positive factors φ'/ε that (13) leaves out are kept, with φ = tanh: modes and stability are the same"
            " without them, basins need not be.",
        ],
        ((slow, slow_words(measured.slow_runs)), (open_future, future_words(found))),
    )  # fmt: skip


def _corner_of(run: SlowRun) -> str:
    return "(1, 1)" if run.side > 0 else "(−1, −1)"


def slow_words(runs: Sequence[SlowRun]) -> str:
    """What becomes of two blocks that reach one state of figure 6 (b) from slip to either side."""
    words = []
    for run in runs:
        steps = []
        for t, kind, cause, block, _, lam in run.events:
            to = f"λ = ({lam[0]:.4f}, {lam[1]:.4f})"
            if kind == "entry":
                steps.append(f"block {block + 1} sticks" if block == 0 else f"block {block + 1} too, in {to}")
            elif kind == "jump":
                how = "meets the saddle" if cause == "fold" else "loses its stability"
                steps.append(f"at t = {t:.7f} the mode {how} and is gone: a jump to {to}, without an exit")
            else:
                steps.append(f"block {block + 1}: {kind} at t = {t:.4f}")
        words.append(f"from slip to the {'right' if run.side > 0 else 'left'}, {', '.join(steps)}")
    jumps = any(event[1] == "jump" for run in runs for event in run.events)
    also = " Section 5 has sticking modes end by exits alone; this one ends by a jump." if jumps else ""
    return (
        "The modified law from entry to exit: two runs that reach the state of (b) at one instant, t = 0; the fast"
        f" system chooses the mode by where they come from. {capital('; '.join(words))}.{also}"
    )


def future_words(found: Undetermined) -> str:
    """How many forward solutions a state has when static friction is above kinetic, and what each does."""
    spans = " and ".join(f"({low:.4g}, {high:.4g})" for low, high in found.open)
    how_many = len(found.futures)
    parts = []
    for one in found.futures:
        exits = [t for t, kind in one.events if kind == "exit"]
        again = sum(kind == "entry" for _, kind in one.events)
        words = f"it {one.begins}"
        if exits and one.begins == "sticks on":
            words += f" until t = {exits[0]:.4g}"
        words += (
            f", and sticks again {again} time{'s' if again != 1 else ''}" if again else ", and never sticks again"
        )
        parts.append(f"{words} up to t = {one.t[-1]:g}")
    more = how_many > 1
    return (
        f"Static friction {found.ratio:g} times the kinetic, one block, constants of figure 1, v = {found.v:g}. From"
        f" z = {found.z:.4g}, z' = v there {'are' if more else 'is'} {how_many} forward"
        f" solution{'s' if more else ''}: {'; or '.join(parts)}."
        + (
            " Both solve the same equations from the same state; which one a block takes depends on λ, which the"
            " state does not hold, so none is picked here: both are drawn."
            if more else ""
        )
        + f" Such are all z in {spans} on the belt. Under Coulomb's law the same state has {found.n_coulomb};"
        " exits lose determinacy by a law that is not monotone in λ."
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------- figures 3 to 5


def _panels(measured: Measured, figure: int) -> list[tuple[str, list[paper_figures.Curve]]]:
    found: dict[str, list[paper_figures.Curve]] = {}
    for trace in measured.traces:
        if trace.figure == figure:
            found.setdefault(trace.panel, []).append((curve_name(trace.label), trace.t, trace.n_stick, trace.t_stop))
    return list(found.items())


def curve_name(label: str) -> str:
    return {"coulomb": "exact law", "sigmoid": "sigmoid, r = 1"}.get(label, label)


def figure3_words(draws: Sequence[Draw], n: int, law: str = "coulomb") -> str:
    """What the draws at one n did: who sticks first, when the last event is, what share ends with none stuck."""
    some = [row for row in draws if (row.n, row.law) == (n, law)]
    quiet = [row for row in some if row.fate in ("certified", "silent")]
    certified = sum(row.fate == "certified" for row in some)
    diverged = sum(row.fate == "diverged" for row in some)
    means = [row.mean for row in some if row.mean is not None and row.fate == "sustained"]
    last = [row.t_last for row in quiet if row.t_last is not None]
    words = f"{_span((row.n_first for row in some), '%d')} blocks stick at first (the most up to t ="
    words += f" {EARLY:g}, reached at t = {_span((row.t_first for row in some), '%.2g')})"
    words += f"; {counted(len(quiet), len(some))} end with n_stick = 0"
    if quiet:
        words += f", {number(certified)} of them by certificate"
    if last:
        words += f", their last event at t = {_span(last)} (median {median(last):.3g})"
    if means:
        words += f"; {len(means)} keep on, with {_span(means)} blocks stuck in the mean of the second half"
    if diverged:
        words += f"; {diverged} diverged"
    return capital(f"{words}.")


def figure3(scene: PaperScene, measured: Measured) -> Drawing:
    panels = _panels(measured, 3)
    numerals = ("i", "ii", "iii", "iv", "v", "vi")
    titled = [(f"({numeral}) {title}", curves) for numeral, (title, curves) in zip(numerals, panels, strict=False)]
    return Drawing(
        3, "n_stick of one draw", paper_figures.n_stick_panels(titled),
        "v = −0.2, μ = 1, z = −0.7, z' = −0.4, ρ = 3.5, κ = 0.2; the sigmoid is tanh"
        f" with ε = {scene.eps:g} and r = 1.",
        [
            f"{_RULE}: matrix 0 of seed {scene.seed} here.",
            f"Beside the sigmoid, the exact law; {_DEFINITION}.",
            f"{capital(_SAMPLING)}; drawn to t = {scene.t_shown:g} of {scene.t_end:g}.",
        ],
    )  # fmt: skip


def change_words(changes: Sequence[Change]) -> list[str]:
    """Short-term and long-term difference of each panel of figure 4 from the unperturbed run."""
    found = []
    for panel in dict.fromkeys(row.panel for row in changes):
        some = [row for row in changes if row.panel == panel]
        apart = [row.t_apart for row in some if row.t_apart is not None]
        words = f"{panel}: {len(apart)} of {len(some)} come apart from the unperturbed run"
        if apart:
            words += f", at t = {_span(apart)}"
        means = [row.mean for row in some if row.mean is not None]
        base = some[0].mean_unperturbed
        if means and base is not None:
            words += f"; mean n_stick of the second half {_span(means)} beside {base:.3g}"
        quiet = [row.label for row in some if row.fate in ("certified", "silent")]
        gone = [row.label for row in some if row.fate == "diverged"]
        if quiet:
            words += f"; none sticks at the end: {', '.join(quiet)}"
        if gone:
            words += f"; diverged: {', '.join(gone)}"
        found.append(f"{words}.")
    return found


def figure4(scene: PaperScene, measured: Measured) -> Drawing:
    moved = [row for row in measured.figure4 if row.size is not None]
    ended = sum(row.fate in ("certified", "silent") for row in moved)
    return Drawing(
        4, "sensitivity", paper_figures.n_stick_panels(_panels(measured, 4), columns=2),
        f"sigmoid with ε = {scene.eps:g}; (i), (ii) r_i uniform between 0 and 1, {scene.sets} draws; (iii), (iv)"
        " every constant of K and R moved at random by up to so much of κ and ρ, r = 1.",
        [
            f"{_RULE}; K keeps its structure when it is moved.",
            "In (iv) one random direction, scaled; the paper does not say whether its sets are. It sees large"
            f" oscillations at 5% and collapse at 10%; of the {len(moved)} runs of (iii) and (iv) here"
            f" {number(ended)} end{'s' if ended == 1 else ''} with n_stick = 0.",
            f"{capital(_SAMPLING)}; {_DEFINITION}.",
        ],
    )  # fmt: skip


def law_words(rows: Sequence[Cascades]) -> list[str]:
    """What the cascades' law is by each friction law and definition, and beside chance."""
    found = []
    for law in dict.fromkeys(row.law for row in rows):
        some = [row for row in rows if row.law == law and row.gamma is not None]
        name = curve_name(law)
        if not some:
            found.append(f"{capital(name)}: no cascades to fit.")
            continue
        gammas = [row.gamma for row in some if row.gamma is not None]
        words = f"{capital(name)}: γ = {_span(gammas)} over {len(some)} definitions of size"
        hits = [row for row in some if row.low is not None and row.high is not None]
        inside = sum((row.low or 0.0) <= PAPER_GAMMA <= (row.high or 0.0) for row in hits)
        words += f"; the paper's {PAPER_GAMMA} lies in the interval of {number(inside)}"
        own = [row for row in some if row.definition == "length"]
        if own:
            steps = ", ".join(f"{row.gamma:.3f} at dt = {row.dt:g}" for row in own)
            words += f"; by the paper's own words, the number of successive decreases, {steps}"
        events = next((row for row in some if row.definition == "events"), None)
        if events is not None:
            words += f"; by events, without sampling, {_gamma(events)}"
            if events.gamma0 is not None:
                words += f", where random order gives {events.gamma0:.3f}"
                if events.low is not None and events.high is not None:
                    is_inside = events.low <= events.gamma0 <= events.high
                    words += ", within the interval" if is_inside else ", outside the interval"
        found.append(f"{words}.")
    return found


def _law_name(row: Cascades) -> str:
    return row.definition if row.dt is None else f"{row.definition}, dt = {row.dt:g}"


def _gamma(row: Cascades) -> str:
    if row.gamma is None:
        return "none"
    return f"{row.gamma:.3f}" + (f" ({row.low:.3f} to {row.high:.3f})" if row.low is not None else "")


def figure5(scene: PaperScene, measured: Measured) -> Drawing:
    runs = [(title, curves[0]) for title, curves in _panels(measured, 5)]
    fitted = {_law_name(row): row.gamma for row in measured.cascades if row.law == LAWS[0]}
    by_law: dict[str, list[tuple[str, list[int]]]] = {}
    for one in measured.sizes:
        if any(one.counts):
            by_law.setdefault(one.definition, []).append((one.label, one.counts))
    laws = [(f"(ii) {name}", series, fitted.get(name)) for name, series in by_law.items()]
    return Drawing(
        5, "long runs and the law of cascades", paper_figures.long_runs(runs, laws),
        f"n = {scene.long_n}, {scene.sets} different random systems, cascades by size on a logarithmic axis.",
        [
            f"{_RULE}. Drawn is the exact law, the fit to all {scene.long_matrices} matrices; the sigmoid is in the"
            " table.",
            f"The paper does not say its step of time: the law is given by several definitions of size and steps,"
            f" cascades counted from t = {scene.t_burn:g} to {scene.long_t_end:g}.",
            "What the caption calls a logarithmic pattern is an exponential law of the size, as in the text:"
            f" f ∝ exp(−γ Δn_stick), γ ≈ {PAPER_GAMMA}.",
        ],
    )  # fmt: skip
