"""Run a case in several ways and hold each against the reference."""

from __future__ import annotations

import signal
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import NDArray
from scipy.integrate import ODEintWarning, odeint
from scipy.linalg import eig

from stickslip.sim import IntegrationError, Run, simulate
from stickslip.sim.engines.coulomb import control
from stickslip.sim.engines.coulomb import settings as coulomb
from stickslip.sim.numerics import products
from tests.fuzz.draw import Trial, by_waves, draw, longest
from tests.fuzz.series import Stretches, by_block, compare
from tests.independent import Case, Floats, Path, Ramp, Undecided, follow
from tests.systems import made

#: Error over tol times sensitivity beyond which a run is wrong, by method. The sigmoid engine's errors add up where
#: nothing damps them: `docs/guide/engines.md` states its bound.
LIMIT = {"coulomb": 100.0, "waves": 20.0, "sigmoid": 1000.0}
_FADED = 1e-8  # of the size of the state
_PATIENCE = 10.0  # seconds of this process for one run, or all of the reference's
_FINEST = 1e-12  # what float64 and the references leave of a finer tolerance
_ELSEWHERE = 1_000_000_000  # numbers of the cases that are put beside others
CHANGED = 4  # runs with changed start and constants

Simulate = Callable[..., Run]


class Endless(RuntimeError):
    """A run took longer than any should."""


@dataclass
class Verdict:
    """What came of a case: the worst error over what is allowed, what failed, what could not be judged.

    Of relations between runs: (family, what came of it, ratio) each.
    """

    worst: float = 0.0
    failures: list[str] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    relations: list[tuple[str, str, float]] = field(default_factory=list)

    def fail(self, how: str, what: str) -> None:
        self.failures.append(f"{how}: {what}")


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise `Endless` after so much time of this process, counted anew if a kernel was being compiled by then.

    That may take longer than a run, and what is raised in a callback of LLVM is lost, with the machine code.
    """

    def stop(*_: object) -> None:
        if not global_compiler_lock.is_locked():
            raise Endless
        signal.setitimer(signal.ITIMER_PROF, seconds)

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True)
class Truth:
    """z, w (m, 2n) of a case at times, and how much an error of one unit of tol may move them there (m,).

    Under the exact law `modes` by block, of the run and of the `changed` ones; under the smoothed one its widths.
    """

    case: Case
    times: Floats
    state: Floats
    unit: Floats
    modes: Sequence[Any] = ()
    changed: Sequence[Any] = ()
    delta: Floats | None = None

    def renumbered(self, order: NDArray[np.int64]) -> Truth:
        """With the blocks in this order."""
        return replace(
            self,
            case=self.case.renumbered(order),
            state=self.state[:, np.concatenate((order, self.case.n + order))],
            modes=[self.modes[i] for i in order] if self.modes else (),
            changed=[[other[i] for i in order] for other in self.changed],
            delta=None if self.delta is None else self.delta[order],
        )

    def beside(self, other: Truth) -> Truth:
        """Of two systems as one; under the exact law."""
        a, b = self.case, other.case
        return Truth(
            a.beside(b),
            self.times,
            np.hstack([self.state[:, : a.n], other.state[:, : b.n], self.state[:, a.n :], other.state[:, b.n :]]),
            np.maximum(self.unit, other.unit),
            [*self.modes, *other.modes],
            [[*one, *two] for one, two in zip(self.changed, other.changed, strict=True)],
        )

    def later(self, m: int) -> Truth:
        """From sample m on, without its series."""
        return replace(self, times=self.times[m:], state=self.state[m:], unit=self.unit[m:], modes=())


def both_ways(rng: np.random.Generator, size: float) -> Iterator[tuple[np.random.Generator, float]]:
    """Random numbers and sizes of changes, each and its opposite: what is on an edge falls to both sides."""
    for seed in rng.integers(2**63, size=CHANGED // 2):
        for way in (size, -size):
            yield np.random.default_rng(seed), way


def _so_far(path: Path, times: Floats) -> Floats:
    """The largest |z|, |w| and |v| of the run until each time."""
    n = path.case.n
    x = np.abs([piece[1][: 2 * n] for piece in path.pieces])
    speeds = path.case.fastest_belt + path.case.rate * x[:, n:].max(axis=1)
    largest = np.maximum.accumulate(np.maximum(x[:, :n].max(axis=1), speeds))
    before = np.searchsorted([piece[0] for piece in path.pieces], times, side="right") - 1
    return np.maximum.accumulate(np.maximum(largest[before], np.abs(np.hstack(path.at(times))).max(axis=1)))


def _modes(path: Path, least: float = 0.0, scale: float = 1.0) -> list[Stretches]:
    """With the time by which an error relative to `scale` moves each event, at least `least`.

    Where a block meets its belt that is over the slope of w - v: of a faded motion, hardly any.
    """
    case, moves, mode = path.case, [], list(path.initial_mode)
    z, w = path.at(path.t) if path.t else ((), ())
    for t, *state, i, new in zip(path.t, z, w, path.block, path.mode, strict=True):
        at, speed = (part[None] for part in state)
        pull = case.holding(np.array([t]), at, speed)[0, i] + case.near[i] * mode[i]
        moves.append(max(least, scale * case.mass[i] / max(abs(pull), 1e-300)) if mode[i] else least)
        mode[i] = new
    return by_block(path.t, path.block, path.mode, path.initial_mode, moves)


def exact_truth(case: Case, times: Floats, t_end: float, size: float, rng: np.random.Generator) -> Truth:
    """By the independent engine; its runs are changed by `size`."""
    path = follow(case, t_end)
    others = [follow(case.perturbed(*way), t_end) for way in both_ways(rng, size)]
    state = np.hstack(path.at(times))
    moved = np.max([np.abs(np.hstack(other.at(times)) - state).max(axis=1) for other in others], axis=0) / size
    unit = np.maximum(_so_far(path, times), np.maximum.accumulate(moved)) + np.finfo(float).tiny  # all may rest
    modes = _modes(path, max(1.0, 1 / case.rate, t_end), unit[0])
    return Truth(case, times, state, unit, modes, [_modes(other) for other in others])


def _hidden(static: float, kinetic: float) -> float:
    """c > 1/2 with which the largest l + c l (1 - l^2) is static over kinetic; 0 if they are one."""
    if static == kinetic:
        return 0.0
    return float(np.roots([4.0, 12.0, 12.0 - 27.0 * (static / kinetic) ** 2, 4.0]).real.max())


def smooth_truth(case: Case, times: Floats, delta: Floats, rng: np.random.Generator, size: float = 1e-6) -> Truth:
    """By LSODA of ODEPACK, from knot to knot of the drive, at tolerances that two runs agree upon."""

    def state(case: Case, tol: float) -> Floats:
        n, k, r, m = case.n, case.stiffness, case.damping, case.mass
        cross = case.cross
        c = np.array([_hidden(*pair) for pair in zip(case.static, case.near, strict=True)])

        def friction(u: Floats) -> tuple[Floats, Floats]:
            """And its slope; on a closed side the tangent at u = 0."""
            lam, rise = np.tanh(u / delta), 1 / np.cosh(np.clip(u / delta, -300, 300)) ** 2
            fallen, falls = case.fallen(np.abs(u))
            sign, most = lam * (1 + c * rise), case.near - fallen
            slope = most * rise * (1 + c * (3 * rise - 2)) / delta - np.abs(sign) * falls
            steepest = case.near * (1 + c) / delta
            is_closed = u * case.closed > 0
            return np.where(is_closed, steepest * u, sign * most), np.where(is_closed, steepest, slope)

        def f(x: Floats, t: float) -> Floats:
            w = x[n:]
            held = friction(w - case.belt.line(t)[0])[0]
            return np.concatenate((w, (case.force(t) - r * w - cross @ w - k @ x[:n] - held) / m))

        def jacobian(x: Floats, t: float) -> Floats:
            slope = friction(x[n:] - case.belt.line(t)[0])[1]
            return np.block(
                [[np.zeros((n, n)), np.eye(n)], [-k / m[:, None], -(np.diag(r + slope) + cross) / m[:, None]]]
            )

        now, found = np.concatenate((case.z0, case.w0)), [np.empty((0, 2 * n))]
        inner = case.knots[(case.knots > 0) & (case.knots < times[-1])] if case.is_driven else []
        for low, high in pairwise([0.0, *inner, times[-1]]):
            at = np.concatenate(([low], times[(low < times) & (times <= high)], [high]))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ODEintWarning)  # it is in `told`
                x, told = odeint(
                    f, now, at, Dfun=jacobian, rtol=tol, atol=tol, mxstep=200_000, full_output=True, tcrit=[high]
                )
            if told["message"] != "Integration successful." or not np.isfinite(x).all():
                raise Undecided(told["message"])
            found.append(x[1:-1])
            now = x[-1]
        return np.concatenate(found)

    best = state(case, 1e-13)
    doubt = np.abs(state(case, 1e-11) - best).max(axis=1)
    others = [state(case.perturbed(*way), 1e-11) for way in both_ways(rng, size)]
    moved = np.max([np.abs(other - best).max(axis=1) for other in others], axis=0) / size
    scale = 1 + np.maximum.accumulate(np.abs(best).max(axis=1))
    unit = np.maximum(scale, np.maximum.accumulate(moved))
    if (doubt > 1e-9 * unit).any():
        raise Undecided(f"two references differ by {doubt.max():.1e}")
    return Truth(case, times, best, unit, delta=delta)


def _faded(block: int, truth: Truth, mine: Stretches, its: Stretches) -> bool:
    """Whether two series part where a block on a belt at rest has all but come to rest, as it does for ever after.

    It slips, or swings, ever more slowly; below its rounding the reference lets it rest.
    """
    if truth.case.belt.values[:, block].any():
        return False
    same = next(
        (k for k, (a, b) in enumerate(zip(mine, its, strict=False)) if a[1] != b[1]), min(len(mine), len(its))
    )
    t = min((other[same][0] for other in (mine, its) if same < len(other)), default=np.inf)
    late = max(0, int(np.searchsorted(truth.times, t)) - 1)
    return bool(np.abs(truth.state[late:, truth.case.n + block]).max() <= _FADED * truth.unit[0])


def _errors(run: Run, truth: Truth, tol: float) -> Floats:
    """At the sample times that the run reached, and at its end if that is a sample time."""
    m = len(run.samples)
    errors = np.abs(np.hstack([run.samples.z, run.samples.w]) - truth.state[:m]).max(axis=1) / (tol * truth.unit[:m])
    if run.t_end == truth.times[-1]:
        end = np.abs(np.concatenate((run.z, run.w)) - truth.state[-1]).max() / (tol * truth.unit[-1])
        errors = np.append(errors, end)
    return np.where(np.isfinite(errors), errors, np.inf)


def _has_grown(truth: Truth, before: Floats) -> bool:
    """Whether the true end is further out than a state before it along an unstable mode of the all-slip system.

    By left eigenvectors, which do not swing: |z| and |w| do, and a mode that grows may still be the smaller one.
    """
    case = truth.case
    n, m = case.n, case.mass
    drag = np.diag(case.damping) + case.cross
    matrix = np.block([[np.zeros((n, n)), np.eye(n)], [-case.stiffness / m[:, None], -drag / m[:, None]]])
    rates, left = eig(matrix, left=True, right=False)
    unstable = left[:, rates.real > 0].conj().T
    return bool((np.abs(unstable @ truth.state[-1]) >= 0.99 * np.abs(unstable @ before)).any())


class _Judge:
    def __init__(self, trial: Trial, run: Simulate) -> None:
        self.trial, self._run, self.verdict = trial, run, Verdict()
        self.rng = trial.rng()
        self.is_exact, self.limit = trial.engine == "coulomb", LIMIT[trial.method]
        tol: Any = trial.settings["tol" if self.is_exact else "rtol"]
        self.tol = max(tol, _FINEST)
        self.times = np.append(np.sort(self.rng.uniform(0, trial.t_end, 12)), trial.t_end)

    def truth(self, case: Case) -> Truth:
        try:
            with patience(_PATIENCE):
                return self._truth(case)
        except Endless:
            raise Undecided(f"the reference takes more than {_PATIENCE:.0f} s") from None

    def _truth(self, case: Case) -> Truth:
        if self.is_exact:
            return exact_truth(case, self.times, self.trial.t_end, self.limit * self.tol, self.rng)
        settings: Any = self.trial.settings
        delta = np.broadcast_to(settings.get("ratio", 1.0), case.n) * settings["eps"]
        return smooth_truth(case, self.times, delta, self.rng)

    def run(self, how: str, truth: Truth, *, sparse: bool = False, t_end: float = 0.0, **settings: Any) -> Run | None:
        """None, and a failure, if the run does not end or gives up."""
        case = truth.case
        system = made(case, sparse)
        settings = {"stop_early": "always"} | self.trial.settings | settings
        if truth.delta is not None:
            settings["ratio"] = truth.delta / self.trial.settings["eps"]
        bare = {name: value for name, value in settings.items() if name != "t_eval"}
        try:  # first what compiles, or the run would be charged with it
            simulate(system, case.z0, case.w0, bare.get("t_start", 0.0), engine=self.trial.engine, **bare)
            with patience(_PATIENCE):
                return self._run(
                    system, case.z0, case.w0, t_end or self.trial.t_end, engine=self.trial.engine, **settings
                )
        except Endless:
            self.verdict.fail(how, f"did not end in {_PATIENCE:.0f} s")
        except MemoryError:
            self.verdict.fail(how, "ran out of memory")
        except (IntegrationError, ArithmeticError, ValueError, IndexError) as error:
            self.verdict.fail(how, f"{type(error).__name__}: {error}")
        return None

    def hold(self, how: str, run: Run | None, truth: Truth, parts: int = 1) -> None:
        """A run with samples at all times against the truth."""
        if run is None:
            return
        verdict, n_expected = self.verdict, len(truth.times)
        if run.outcome == "diverged":
            if run.t_end > self.trial.t_end:
                verdict.fail(how, f"diverged at t = {run.t_end!r}, past the end")
            if run.t_end < self.trial.t_end and not _has_grown(truth, np.concatenate((run.z, run.w))):
                verdict.fail(how, f"diverged at t = {run.t_end:.6g}, which it does not: {run.reason}")
        elif run.t_end != self.trial.t_end or len(run.samples) != n_expected:
            verdict.fail(how, f"{run.outcome} at t = {run.t_end!r} with {len(run.samples)} samples of {n_expected}")
        errors = _errors(run, truth, parts * self.tol)
        verdict.worst = max(verdict.worst, float(errors.max(initial=0.0)))
        if (errors > self.limit).any():
            k = int(np.argmax(errors > self.limit))
            at = truth.times[min(k, n_expected - 1)]
            verdict.fail(how, f"error {errors.max():.3g} tol times sensitivity, {errors[k]:.3g} at t = {at:.6g}")
        elif truth.modes:
            self._series(how, run, truth)
        elif not self.is_exact:
            self._layers(how, run, truth)

    def _series(self, how: str, run: Run, truth: Truth) -> None:
        events = run.events
        seen = by_block(events.t, events.block, events.mode, events.initial_mode)
        error = self.limit * self.tol * float((truth.unit / truth.unit[0]).max())
        time = max(1.0, 1 / truth.case.rate)
        for i, (mine, its) in enumerate(zip(seen, truth.modes, strict=True)):
            if any(b[0] <= a[0] for a, b in pairwise(mine[1:])):
                self.verdict.fail(how, f"block {i} has two events at one time")
            others = [other[i] for other in truth.changed]
            kind, words = compare(mine, its, others, error, 10 * np.sqrt(error) * time, events.t_end)
            if kind == "differs" and _faded(i, truth, mine, its):
                kind = "undecided"
            self.verdict.notes[kind] += 1
            if kind == "differs":
                self.verdict.fail(how, f"series of block {i}: {words}")

    def _layers(self, how: str, run: Run, truth: Truth) -> None:
        """Modes at the sample times, where the truth is clear of the edge of the layer."""
        case, delta = truth.case, truth.delta
        z, y = truth.state[:, : case.n], truth.state[:, case.n :] - case.belt.at(truth.times)
        y = np.where(y * case.closed > 0, 0.0, y)  # what is pulled to a side that is barred creeps there, and sticks
        spare = (self.limit * self.tol * truth.unit)[:, None]
        free = case.near == 0
        force = case.holding(truth.times, z, truth.state[:, case.n :])
        force = np.where(case.closed == 0, np.abs(force), case.closed * force)
        doubt = spare * (1 + np.abs(case.stiffness).sum(axis=1) + np.abs(case.cross).sum(axis=1))
        definitions = [(None, run.events, delta * np.log(1 / delta))]
        definitions += [(c, series, c * delta) for c, series in run.by_threshold.items()]
        for name, series, band in definitions:
            known = truth.times <= series.t_end
            modes = np.array([series.mode_at(t) for t in truth.times[known]]).reshape(-1, case.n)
            sticks, slips = (np.abs(y) < band - spare) & ~free, np.abs(y) > np.where(free, 0, band) + spare
            if name is None:
                sticks &= force < case.near - doubt  # between the two frictions the past decides
                slips |= (force > case.static + doubt) & (np.abs(y) > spare)
            wrong = (sticks[known] & (modes != 0)) | (slips[known] & (modes != np.sign(y[known])))
            if wrong.any():
                k, i = np.argwhere(wrong)[0]
                words = f"mode {modes[k, i]} of block {i} at t = {truth.times[k]:.6g}, w - v = {y[k, i]:.3g}"
                self.verdict.fail(how, words if name is None else f"{words}, threshold {name:g}")

    def judge(self) -> Verdict:
        """Every way to run it."""
        rng, verdict = self.rng, self.verdict
        try:
            truth = self.truth(self.trial.case)
        except Undecided:
            verdict.notes["skipped"] += 1
            return verdict
        run = self.run("plain", truth, t_eval=self.times)
        if run is None:
            return verdict
        self.hold("plain", run, truth)
        verdict.notes["by series"] += self.trial.is_by_waves and run.stats.method == "Taylor series"
        if self.is_exact and not self.trial.is_by_waves:
            with patch.object(products, "_SMALL", 1), patch.object(control, "CARRIED", 1):
                self.hold("as a large one", self.run("as a large one", truth, t_eval=self.times), truth)
        self.hold("stop_early=False", self.run("stop_early=False", truth, t_eval=self.times, stop_early=False), truth)
        bare = self.run("without samples", truth)
        if bare and not (np.array_equal(bare.z, run.z) and np.array_equal(bare.events.t, run.events.t)):
            verdict.fail("without samples", "another run")
        if truth.case.n > 1:
            other = truth.renumbered(rng.permutation(truth.case.n))
            run = self.run("relabelled", other, sparse=bool(rng.random() < 0.5), t_eval=self.times)
            self.hold("relabelled", run, other)
        self._split(truth)
        if self.is_exact and truth.case.n <= 5 and rng.random() < 0.2 and not truth.case.closed.any():
            self._two_as_one(truth)
        return verdict

    def _split(self, truth: Truth) -> None:
        """Stop in the middle and go on from there."""
        m = len(self.times) // 2
        middle = float(self.times[m])
        first = self.run("first half", truth, t_end=middle)
        if first is None or first.t_end != middle or middle == 0:
            return
        rest = truth.later(m)
        half = replace(rest, case=replace(truth.case, z0=first.z, w0=first.w))
        self.hold("second half", self.run("second half", half, t_start=middle, t_eval=rest.times), half, parts=2)

    def _two_as_one(self, truth: Truth) -> None:
        case, other = truth.case, draw(self.trial.seed, self.trial.number + _ELSEWHERE, self.trial.terms).case
        if (case.belt.values == case.belt.values[0, 0]).all():
            other = replace(other, belt=Ramp.of(case.belt.values[0, 0], other.n))
        other = replace(other, falls=case.falls, closed=np.zeros(other.n))
        if longest(other, self.trial.t_end) < self.trial.t_end:
            return
        try:
            both = truth.beside(self.truth(other))
        except Undecided:
            return
        if both.unit.max() < 1e6 * truth.unit.max():  # or the larger hides the smaller
            self.hold("two as one", self.run("two as one", both, t_eval=self.times), both)


def judge(trial: Trial, run: Simulate = simulate) -> Verdict:
    """Everything that is checked of one case; `run` stands in for `stickslip.sim.simulate`."""
    as_stored = staticmethod(lambda system, _: not isinstance(system.stiffness, np.ndarray))
    with patch.object(coulomb.Coulomb, "is_sparse", as_stored):  # a sparse K of few blocks, too, has local updates
        return _judged(trial, run)


def _judged(trial: Trial, run: Simulate) -> Verdict:
    if not trial.is_by_waves:
        return _Judge(trial, run).judge()
    with by_waves():
        if not coulomb.Coulomb(**trial.settings).is_by_waves(made(trial.case)):
            return Verdict(notes=Counter(skipped=1))
        return _Judge(trial, run).judge()
