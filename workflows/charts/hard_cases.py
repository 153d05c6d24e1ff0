"""Hard cases: starts and systems at which methods are known to slip, each with an answer known beforehand.

The answer is the series of events under the exact law, in closed form, and z between them by the exponential of the
linear motion; two cases, which have no closed form, take it from another method. The smoothed law is off by O(eps),
so its methods are held to `_LAYERS` widths. Dimensionless.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from stickslip import sim
from stickslip.sim.arguments import per_block
from stickslip.workflows.charts import Say, peers
from stickslip.workflows.charts.peers import Floats, GivenUp, MethodError, Problem, random_problem, reached

Answer = Literal["right", "refused", "too slow", "wrong"]
#: (time, block, mode from then on)
Event = tuple[float, int, int]

#: The width of the layers, and the tolerance of each law's methods.
EPS, TOLERANCE, EXACT_TOLERANCE = 1e-4, 1e-9, 1e-12
#: Errors of z that are right: of the exact law; of the smoothed one in widths, and over the tolerance.
_ALLOWED, _LAYERS, _TOLERANCES = 1e-8, 20.0, 100.0
#: Errors of the exact law's event times that are right: a root that is nearly double is known to less.
_ALLOWED_TIME = 1e-6
PEERS = ("SciPy DOP853", "SciPy LSODA", "SciPy Radau")


@dataclass(frozen=True)
class Verdict:
    """One method on one hard case: a row of the table `cases`.

    `outcome` is the engine's own; `error` is max |z - z_known| where the run ended, over `scale`; `error_t` that of
    the event times, null if the run has not the known events; `n_events` is null for a peer, which finds none.
    """

    case: str
    hard: str
    known: str
    method: str
    answer: Answer
    outcome: str | None = None
    error: float | None = None
    error_t: float | None = None
    n_events: int | None = None
    n_known: int | None = None
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class HardCase:
    """A start that is hard, and what is known of the run from it.

    Attributes
    ----------
    name, hard, known : str
        What it is, what is hard about it, and where the answer comes from.
    system : sim.System
    z0, w0 : ndarray, shape (n,)
    t_end : float
    z_at : function of time to ndarray, shape (n,)
    events : tuple of (time, block, mode), or None
        None where any number of events of no duration is right.
    outcome : "finished", "collapsed" or "diverged"
    delta : ndarray, shape (n,)
        Widths of the layers.
    scale : float
        Of z, w, v and mu.
    methods : tuple of str
    """

    name: str
    hard: str
    known: str
    system: sim.System
    z0: Floats
    w0: Floats
    t_end: float
    z_at: Callable[[float], Floats]
    events: tuple[Event, ...] | None
    delta: Floats
    outcome: str = "finished"
    scale: float = 1.0
    methods: tuple[str, ...] = ("coulomb engine", "sigmoid engine", *PEERS)


# ---------------------------------------------------------------------------------------------- known motions


def motion(
    system: sim.System, z0: Floats, w0: Floats, modes: tuple[int, ...], events: tuple[Event, ...]
) -> Callable[[float], Floats]:
    """z(t) of the exact law, given the modes at the start and every change of them.

    Between events x' = A x + c: a slipping block has w' = -R w - K z - mu mode, a sticking one w' = 0 with w = v.
    """

    def z_at(t: float) -> Floats:
        x, now, mode = np.concatenate((z0, w0, [1.0])), 0.0, np.array(modes)
        for when, block, new in (*(event for event in events if event[0] <= t), (t, 0, None)):
            x = expm((when - now) * _generator(system, mode)) @ x
            now = when
            if new is not None:
                mode[block] = new
                x[system.n + block] = system.belt_speed
        return x[: system.n]

    return z_at


def _generator(system: sim.System, mode: NDArray[np.int64]) -> Floats:
    n = system.n
    generator = np.zeros((2 * n + 1, 2 * n + 1))
    generator[:-1, :-1] = system.slip_matrix()
    generator[n:-1, -1] = -system.friction * mode
    generator[n:-1][mode == 0] = 0.0
    return generator


def _case(
    name: str,
    hard: str,
    known: str,
    system: sim.System,
    z0: ArrayLike,
    w0: ArrayLike,
    t_end: float,
    modes: tuple[int, ...],
    events: tuple[Event, ...],
    scale: float = 1.0,
    **more: Any,
) -> HardCase:
    """A case of the exact law; `more` are fields of `HardCase` that are not as usual."""
    z, w = per_block("z0", z0, system.n), per_block("w0", w0, system.n)
    z_at = motion(system, z, w, modes, events)
    case = HardCase(name, hard, known, system, z, w, t_end, z_at, events, np.full(system.n, EPS * scale), scale=scale)
    return replace(case, **more)


def _grazing() -> Iterator[HardCase]:
    """z = -1 + cos t slips right, w = -sin t; |F| = mu at the touch. Once held, z falls until F = -mu again."""
    hard = "reaches the belt's speed tangentially, at the end of the stick interval"
    for gap, word in ((-1e-8, "just missing, by 1e-8"), (0.0, "touching"), (1e-8, "crossing, by 1e-8")):
        speed = 1.0 - gap
        events: tuple[Event, ...] = ()
        if gap > 0:
            entry = 0.5 * math.pi - 2.0 * math.asin(math.sqrt(0.5 * gap))
            events = ((entry, 0, 0), (entry + math.cos(entry) / speed, 0, 1))
        system = sim.System([[1.0]], 0.0, 1.0, -speed)
        case = _case(f"graze: {word}", hard, "closed form", system, 0.0, 0.0, 5.0, (1,), events)
        yield case if gap else replace(case, events=None)


def _free() -> Iterator[HardCase]:
    """z = cos t crosses w = v at sin t = -v."""
    first = math.asin(0.5)
    for hard, gap in (("mu = 0: no stick, crossings only", 0.5), ("mu = 0: two crossings 3e-4 apart", 1e-8)):
        half = math.pi / 2 - first if gap == 0.5 else 2.0 * math.asin(math.sqrt(0.5 * gap))
        middles = [math.pi / 2 + 2 * math.pi * k for k in range(2)]
        events = tuple(event for t in middles for event in ((t - half, 0, -1), (t + half, 0, 1)))
        name = "no friction" if gap == 0.5 else "no friction, graze"
        yield _case(name, hard, "closed form", sim.System([[1.0]], 0.0, 0.0, gap - 1.0), 1.0, 0.0, 10.0, (1,), events)


def _edges() -> Iterator[HardCase]:
    """F_1 = side mu, F_1' = 0 at the start; F_1" = -w_2' / 2 decides, and where that is 0 its derivative."""
    for side, acceleration in ((1, 0.5), (1, -0.5), (1, 0.0), (-1, 0.0)):
        z2, c = 0.5, 0.25
        z1 = side + 0.25 + 0.5 * z2
        d = (1.25 - c * z1 - acceleration) / z2
        turn = side * (-acceleration if acceleration else -(c + 2.0 * d))
        word, order = ("fold, F' = 0", "F''") if acceleration else ("cusp, F' = F'' = 0", "F'''")
        name, hard = f"{word}: {'leaves' if turn > 0 else 'holds'}", f"|F| = mu at the start and {order} decides"
        known = "sign of the first derivative, then the exponential"
        system = sim.System([[1.0, -0.5], [c, d]], [0.25, 0.125], 1.0, -1.0)
        modes = (-side if turn > 0 else 0, -1)
        yield _case(name, hard, known, system, [z1, z2], [-1.0, -2.0], 0.25, modes, ())


#: R = 0.1, K = 1, v = -0.2 from z = 3, w = 1: the damped oscillator's own times, to 40 digits.
ONE_BLOCK: tuple[Event, ...] = ((0.29075098367384344, 0, -1), (3.231881443452085, 0, 0), (4.104721534065557, 0, 1))


def _several() -> Iterator[HardCase]:
    five = tuple((t, block, mode) for t, _, mode in ONE_BLOCK for block in range(5))
    copies = sim.System(0.5 * np.eye(5) + 0.1, 0.1, 1.0, -0.2)
    known = "one block's closed form"
    yield _case("five identical blocks", "every event is five at once", known, copies, 3.0, 1.0, 20.0, (1,) * 5, five)
    swing = tuple(
        (math.pi * k, block, (0 if k == 2 else 1) * sign) for k in (1, 2) for block, sign in enumerate((1, -1))
    )
    mirror = sim.System([[1.5, 0.5], [0.5, 1.5]], 0.0, 1.0, 0.0)
    hard, known = "two events at once, in opposite directions", "closed form: a half swing loses 2 mu / K"
    yield _case("mirror images, v = 0", hard, known, mirror, [4.5, -4.5], 0.0, 20.0, (-1, 1), swing)
    hard, known = "crosses the belt's speed 2e-13 after the start", "closed form to 1e-11"
    slow, events = sim.System([[1.0]], 0.0, 1.0, -1e-12), ((1e-12 / 5.5, 0, -1), (math.pi, 0, 1), (2 * math.pi, 0, 0))
    yield _case("hardly a belt, v = -1e-12", hard, known, slow, 4.5, 0.0, 20.0, (1,), events)
    hard, known = "one block is 1000 times as fast as the other", "closed forms of each"
    apart = sim.System(np.diag([1.0, 1e6]), [0.1, 0.0], [1.0, 0.0], -0.2)
    every: tuple[Event, ...] = tuple(sorted((*ONE_BLOCK, *_crossings(1000.0, 2e-4, 5.0))))
    yield _case("K of 1 and 1e6", hard, known, apart, [3.0, 1.0], [1.0, 0.0], 5.0, (1, 1), every)


def _crossings(omega: float, ratio: float, t_end: float) -> Iterator[Event]:
    """Events of block 1, z = cos(omega t): w passes v = -ratio omega down at omega t = a + 2 pi k, up at pi - a."""
    a = math.asin(ratio)
    for k in range(math.ceil(t_end * omega / (2.0 * math.pi))):
        for phase, mode in ((a, -1), (math.pi - a, 1)):
            t = (phase + 2.0 * math.pi * k) / omega
            if t <= t_end:
                yield t, 1, mode


def _extremes() -> Iterator[HardCase]:
    known, engines = "one block's closed form", HardCase.methods[:2]
    for scale in (1e8, 1e-8):
        hard, system = "z, w, v, mu and the layer scaled together", sim.System([[1.0]], 0.1, scale, -0.2 * scale)
        start = 3.0 * scale, scale
        yield _case(f"scale {scale:g}", hard, known, system, *start, 20.0, (1,), ONE_BLOCK, scale, methods=engines)
    # w' = -R w + mu - K z with z at its start: w reaches v after log((w0 - c) / (v - c)) / R, c = (mu - K z) / R
    rate, z0 = 1e6, -0.7
    c = (1.0 - z0) / rate
    hard, passes = "the exact engine is explicit in R", ((math.log((-0.4 - c) / (-0.2 - c)) / rate, 0, 1),)
    damped = sim.System([[1.0]], rate, 1.0, -0.2)
    yield _case("overdamped, R = 1e6", hard, "closed form to 1e-12", damped, z0, -0.4, 0.1, (-1,), passes)
    hard, unit = "after three events nothing happens for ever", sim.System([[1.0]], 0.1, 1.0, -0.2)
    yield _case("t_end = 1e6", hard, known, unit, 3.0, 1.0, 1e6, (1,), ONE_BLOCK, outcome="collapsed")
    hard, known = "z passes the largest float64 before t_end", "eigenvalues: growth like exp(0.99 t)"
    runaway = sim.System([[1.0, -3.0], [3.0, 1.0]], 0.1, 1.0, -0.2)
    case = _case("growth without bound", hard, known, runaway, [1.0, 0.0], 0.0, 1000.0, (1, 1), ())
    yield replace(case, events=None, outcome="diverged")


def _without_closed_form() -> Iterator[HardCase]:
    """The answers come from another method: Radau on the same layers, and the exact engine where they are thin."""
    problem = random_problem(0, 7, 10.0, 1e-2, "one")
    spread = replace(problem, delta=10.0 ** -np.linspace(2, 8, 7))
    z = reached("SciPy Radau", 1e-10, spread)
    yield _of_problem(
        "delta from 1e-2 to 1e-8",
        "a stiffness ratio of 1e6 in one system of seven",
        "SciPy Radau at 1e-10",
        spread,
        z,
        None,
        methods=("sigmoid engine", *PEERS[:2]),
    )
    twenty = random_problem(0, 20, 10.0, 1e-8, "one")
    run = sim.simulate(twenty.system, twenty.z0, twenty.w0, twenty.t_end, tol=1e-14, stop_early=False)
    series = zip(run.events.t.tolist(), run.events.block.tolist(), run.events.mode.tolist(), strict=True)
    yield _of_problem(
        "eps = 1e-8 is Coulomb",
        "20 blocks; the laws differ by O(eps)",
        "the exact engine at 1e-14",
        twenty,
        run.z,
        tuple(series),
        methods=("sigmoid engine", *PEERS),
    )


def _of_problem(
    name: str,
    hard: str,
    known: str,
    problem: Problem,
    z: Floats,
    events: tuple[Event, ...] | None,
    methods: tuple[str, ...],
) -> HardCase:
    z0, w0 = np.split(problem.start, 2)
    system, t_end, delta = problem.system, problem.t_end, problem.delta
    return HardCase(name, hard, known, system, z0, w0, t_end, lambda t: z, events, delta, methods=methods)


def hard_cases() -> Iterator[HardCase]:
    """Every hard case, in the order of the page."""
    for some in (_grazing, _free, _edges, _several, _extremes, _without_closed_form):
        yield from some()


# ---------------------------------------------------------------------------------------------- judging


def judged(patience: float, say: Say) -> list[Verdict]:
    """What every method makes of every hard case; peers are given up after `patience` seconds."""
    verdicts: list[Verdict] = []
    for case in hard_cases():
        verdicts += [judge(case, method, patience) for method in case.methods]
        answers = ", ".join(f"{verdict.method} {verdict.answer}" for verdict in verdicts[-len(case.methods) :])
        say(f"hard case: {case.name}: {answers}")
    return verdicts


def judge(case: HardCase, method: str, patience: float) -> Verdict:
    """Run one method and hold it against what is known.

    Right: the outcome, z and, for the exact law, the events are the known ones. Refused: an error with a message.
    Wrong: anything else.
    """
    blank = Verdict(
        case.name, case.hard, case.known, method, "wrong", n_known=None if case.events is None else len(case.events)
    )
    try:
        return _peer(case, method, patience, blank) if method in PEERS else _engine(case, method, blank)
    except GivenUp as error:
        return replace(blank, answer="too slow", reason=str(error))
    except (MethodError, sim.IntegrationError, ValueError) as error:
        return replace(blank, answer="refused", reason=str(error))


def _smooth_allowance(case: HardCase) -> float:
    return _LAYERS * float(case.delta.max()) / case.scale + _TOLERANCES * TOLERANCE


def _peer(case: HardCase, method: str, patience: float, blank: Verdict) -> Verdict:
    problem = Problem(case.system, case.delta, case.z0, case.w0, case.t_end, patience)
    z = peers.method(method).prepare(problem)(TOLERANCE).z
    if not np.isfinite(z).all():
        return replace(blank, reason="z at t_end is not finite, returned as a success")
    if case.outcome == "diverged":
        return replace(blank, reason=f"returned |z| up to {np.abs(z).max():.1e} as a success")
    error = float(np.abs(z - case.z_at(case.t_end)).max()) / case.scale
    return replace(blank, error=error, answer="right" if error <= _smooth_allowance(case) else "wrong")


def _apart(found: sim.EventSeries, known: tuple[Event, ...]) -> float | None:
    """The largest distance of event times, block by block; None if a block's modes are not the known ones."""
    order = np.argsort(found.block, kind="stable")  # events of one instant have no order between blocks
    expected = sorted(known, key=lambda event: event[1])
    modes = zip(found.block[order].tolist(), found.mode[order].tolist(), strict=True)
    if list(modes) != [(block, mode) for _, block, mode in expected]:
        return None
    return float(np.abs(found.t[order] - [t for t, *_ in expected]).max(initial=0.0))


def _engine(case: HardCase, method: str, blank: Verdict) -> Verdict:
    is_exact = method == "coulomb engine"
    stop_early = case.outcome != "finished"
    if is_exact:
        run = sim.simulate(case.system, case.z0, case.w0, case.t_end, tol=EXACT_TOLERANCE, stop_early=stop_early)
    else:
        smooth: dict[str, Any] = {"engine": "sigmoid", "eps": 1.0, "ratio": case.delta}
        smooth |= {"rtol": TOLERANCE, "atol": TOLERANCE * case.scale}
        run = sim.simulate(case.system, case.z0, case.w0, case.t_end, stop_early=stop_early, **smooth)
    row = replace(blank, outcome=run.outcome, n_events=len(run.events), reason=run.reason or None)
    if run.outcome != case.outcome or run.outcome == "diverged":
        return replace(row, answer="right" if run.outcome == case.outcome else "wrong")
    row = replace(row, error=float(np.abs(run.z - case.z_at(run.t_end)).max()) / case.scale)
    assert row.error is not None
    allowed = _ALLOWED if is_exact else _smooth_allowance(case)
    is_right = row.error <= allowed
    if case.events is not None:
        row = replace(row, error_t=_apart(run.events, case.events))
        # the smoothed law may cross its layer where the exact one sticks: only z is asked of it
        is_right = is_right and (not is_exact or (row.error_t is not None and row.error_t <= _ALLOWED_TIME))
    return replace(row, answer="right" if is_right else "wrong")
