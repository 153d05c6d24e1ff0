"""The methods that the charts compare: both engines, and what a user would otherwise pick.

A peer solves the exact law (`dormand_prince`, and Moreau and Jean's), or the sigmoid's equations as y' = f(y), y =
(z, w),

    z' = w,    w' = -R w - K z - mu tanh((w - v) / delta),    delta_i = r_i eps,

set up as a careful user of that library would: no work that could be done once, one product with K a right-hand
side, everything analytic that the library takes. Dimensionless.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stickslip import sim
from stickslip.pipeline.ensemble.member import MATRIX, RATIO

Floats = NDArray[np.float64]
Model = Literal["coulomb", "sigmoid"]
Ratio = Literal["one", "uniform"]
Control = Literal["tolerance", "step"]


class Solution(NamedTuple):
    """z at t_end, shape (n,), the number of products with K, and the events; None if the method reports none."""

    z: Floats
    n_products: int | None = None
    events: sim.EventSeries | None = None


#: From a tolerance (relative and absolute alike), or from the longest step, to the end of a run.
Solver = Callable[[float], Solution]


#: The paper's start, the same for every block.
Z0, W0 = -0.7, -0.4


class MethodError(RuntimeError):
    """A method could not carry a run through; the message is the method's own."""


class GivenUp(MethodError):
    """A run took longer than the problem's patience."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A system with dense K, every block's start, an end, and the widths r_i eps > 0 of its sigmoids, shape (n,).

    After `patience` seconds a peer that calls back to Python gives a run up: only there can it be stopped.
    """

    system: sim.System
    delta: Floats
    z0: float
    w0: float
    t_end: float
    patience: float = math.inf

    @property
    def start(self) -> Floats:
        """y at t = 0, shape (2 n,)."""
        return np.concatenate((np.full(self.system.n, self.z0), np.full(self.system.n, self.w0)))


def seed_of(seed: int, *words: int) -> np.random.SeedSequence:
    """The seed of one draw, as an ensemble with this seed has it."""
    return np.random.SeedSequence(seed, spawn_key=words)


def random_system(seed: int, n: int, matrix: int, **scales: float) -> sim.System:
    """The system that an ensemble with this seed has at `n` and `matrix`."""
    return sim.draw_system("antisymmetric", n, seed_of(seed, MATRIX, n, matrix), **scales)


def random_ratios(seed: int, n: int, draw: int) -> Floats:
    """The ratios r_i that it draws for matrix 0, uniform in (0, 1]."""
    return 1.0 - np.random.default_rng(seed_of(seed, RATIO, n, 0, draw)).random(n)


def random_problem(seed: int, n: int, t_end: float, eps: float, ratio: Ratio, patience: float = math.inf) -> Problem:
    """Matrix 0 and its first draw of the ratios, from the paper's start."""
    r = np.ones(n) if ratio == "one" else random_ratios(seed, n, 0)
    return Problem(random_system(seed, n, 0), r * eps, Z0, W0, t_end, patience)


@dataclass(frozen=True)
class Method:
    """One curve of the chart: which law it solves, as the other's reference says nothing about it, and by what.

    `prepare` does all that a user does once: it is not timed. `package` is what it imports beyond the dependencies.
    """

    name: str
    model: Model
    prepare: Callable[[Problem], Solver]
    package: str | None = None
    control: Control = "tolerance"  # what a user chooses

    @property
    def is_ours(self) -> bool:
        return self.prepare in (_coulomb, _sigmoid)

    @property
    def is_installed(self) -> bool:
        return self.package is None or find_spec(self.package) is not None


# ---------------------------------------------------------------------------------------------- the engines


def _coulomb(problem: Problem) -> Solver:
    return lambda tol: _state(problem, "coulomb", tol=tol)


def _sigmoid(problem: Problem) -> Solver:
    return lambda tol: _state(problem, "sigmoid", eps=1.0, ratio=problem.delta, rtol=tol, atol=tol)


def _moreau(problem: Problem) -> Solver:
    return lambda step: _state(problem, "moreau", step=step)


def _state(problem: Problem, engine: str, **settings: Any) -> Solution:
    run = sim.simulate(
        problem.system, problem.z0, problem.w0, problem.t_end, engine=engine, stop_early=False, **settings
    )
    if run.outcome != "finished":
        raise MethodError(f"{run.outcome} at t = {run.t_end:g}: {run.reason}")
    return Solution(run.z, run.stats.n_products, run.events)


# ---------------------------------------------------------------------------------------------- the equations


class Equations:
    """The right-hand side and its derivatives, by numpy."""

    def __init__(self, problem: Problem) -> None:
        system = problem.system
        self.n = n = system.n
        self._stiffness = np.ascontiguousarray(system.stiffness)
        self._damping, self._friction, self._v = system.damping, system.friction, system.belt_speed
        self._delta = problem.delta
        self._jacobian = np.block([[np.zeros((n, n)), np.eye(n)], [-self._stiffness, np.zeros((n, n))]])
        self._diagonal = np.arange(n, 2 * n)
        self._patience, self._deadline = problem.patience, math.inf

    def begin(self) -> None:
        """Start the clock of a run."""
        self._deadline = time.perf_counter() + self._patience

    def __call__(self, t: float, y: Floats) -> Floats:
        """f(y), shape (2 n,); raises GivenUp once the run has taken too long."""
        if time.perf_counter() > self._deadline:
            raise GivenUp(f"given up after {self._patience:g} s")
        z, w = y[: self.n], y[self.n :]
        force = self._stiffness @ z
        force += self._damping * w
        force += self._friction * self._tanh(w)
        return np.concatenate((w, -force))

    def _tanh(self, w: Floats) -> Floats:
        return np.tanh((w - self._v) / self._delta)

    def drag(self, y: Floats) -> Floats:
        """R + mu / delta sech^2((w - v) / delta), shape (n,): -dw'/dw, all of the stiffness."""
        return self._damping + self._friction / self._delta * (1.0 - self._tanh(y[self.n :]) ** 2)

    def jacobian(self, t: float, y: Floats) -> Floats:
        """df/dy, shape (2 n, 2 n); one array, filled anew in each call."""
        self._jacobian[self._diagonal, self._diagonal] = -self.drag(y)
        return self._jacobian

    def along(self, drag: Floats, direction: Floats) -> Floats:
        """df/dy times a direction, both of shape (2 n,), by one product with K."""
        dz, dw = direction[: self.n], direction[self.n :]
        return np.concatenate((dw, -(self._stiffness @ dz + drag * dw)))


# ---------------------------------------------------------------------------------------------- the peers


def _scipy(method: str, with_jacobian: bool) -> Callable[[Problem], Solver]:
    def prepare(problem: Problem) -> Solver:
        from scipy.integrate import solve_ivp

        equations, start, span = Equations(problem), problem.start, (0.0, problem.t_end)
        options: dict[str, Any] = {"method": method, "t_eval": [problem.t_end]}
        options |= {"jac": equations.jacobian} if with_jacobian else {}

        def solve(tolerance: float) -> Solution:
            equations.begin()
            solution = solve_ivp(equations, span, start, rtol=tolerance, atol=tolerance, **options)
            if not solution.success:
                raise MethodError(solution.message)
            return Solution(solution.y[: equations.n, -1], int(solution.nfev))

        return solve

    return prepare


def _cvode(problem: Problem) -> Solver:
    """BDF and GMRES: no Jacobian but its product with a vector; preconditioned by all of it but K."""
    from sksundae.cvode import CVODE, CVODEJacTimes, CVODEPrecond

    equations, span, start = Equations(problem), np.array([0.0, problem.t_end]), problem.start
    n = equations.n
    drag = np.empty(n)

    def rate(t: float, y: Floats, yp: Floats) -> None:
        yp[:] = equations(t, y)

    def product_setup(t: float, y: Floats, yp: Floats) -> None:
        drag[:] = equations.drag(y)  # before each linear solve: so the preconditioner is never stale

    def product(t: float, y: Floats, yp: Floats, v: Floats, jv: Floats) -> None:
        jv[:] = equations.along(drag, v)

    def without_k(t: float, y: Floats, yp: Floats, r: Floats, x: Floats, gamma: float, delta: float, lr: int) -> None:
        np.divide(r[n:], 1.0 + gamma * drag, out=x[n:])
        np.add(r[:n], gamma * x[n:], out=x[:n])

    def solve(tolerance: float) -> Solution:
        equations.begin()
        solver = CVODE(
            rate,
            method="BDF",
            linsolver="gmres",
            krylov_dim=10,
            rtol=tolerance,
            atol=tolerance,
            max_num_steps=10_000_000,
            jactimes=CVODEJacTimes(product_setup, product),
            precond=CVODEPrecond(None, without_k),
        )
        solution = solver.solve(span, start)
        if not solution.success:
            raise MethodError(str(solution.message))
        return Solution(np.asarray(solution.y)[-1, :n])

    return solve


#: Steps after which a compiled run, which nobody can stop, stops itself: some seconds of it.
_MOST_STEPS = 100_000
#: CyRK's status of such a run.
_CYRK_TOO_MANY = -52


def _cyrk(problem: Problem) -> Solver:
    """The right-hand side compiled too; its numbers go in as one array, as the library's C callbacks want."""
    from CyRK import cyjit, nbsolve2_ivp
    from numba import carray

    system = problem.system
    n, v = system.n, system.belt_speed

    def rate(dy_pointer, t, y_pointer, numbers_pointer):  # type: ignore[no-untyped-def]
        dy, y, numbers = carray(dy_pointer, 2 * n), carray(y_pointer, 2 * n), carray(numbers_pointer, n * (n + 3))
        force = dy[n:]
        np.dot(numbers[3 * n :].reshape((n, n)), y[:n], force)
        for i in range(n):
            w = y[n + i]
            dy[i] = w
            force[i] = -(force[i] + numbers[i] * w + numbers[n + i] * np.tanh((w - v) * numbers[2 * n + i]))

    numbers = np.concatenate([system.damping, system.friction, 1.0 / problem.delta, np.ravel(system.stiffness)])
    compiled = cyjit(rate)  # kept alive by the closure: the address is into it
    start, span = problem.start, (0.0, problem.t_end)
    options: dict[str, Any] = {"method": "DOP853", "t_eval": np.array([problem.t_end]), "args": numbers}

    def solve(tolerance: float) -> Solution:
        solution = nbsolve2_ivp(
            compiled.address, span, start, rtol=tolerance, atol=tolerance, max_num_steps=_MOST_STEPS, **options
        )
        try:
            if solution.status == _CYRK_TOO_MANY:
                raise GivenUp(f"given up after {_MOST_STEPS:,} steps")
            if not solution.success:
                raise MethodError(f"DOP853 ended with status {solution.status}")
            return Solution(np.array(solution.y)[:n, -1])
        finally:
            solution.free()

    return solve


#: XLA takes its threads from here, read once, when jax is imported.
_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def _diffrax(problem: Problem) -> Solver:
    """Tsit5, with the right-hand side, the steps and their control compiled into one function."""
    os.environ.setdefault("XLA_FLAGS", _ONE_THREAD)
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    system, n = problem.system, problem.system.n
    stiffness, damping, friction = map(jnp.asarray, (system.stiffness, system.damping, system.friction))
    delta, v = jnp.asarray(problem.delta), system.belt_speed

    def rate(t: Any, y: Any, args: Any) -> Any:
        z, w = y[:n], y[n:]
        return jnp.concatenate([w, -(damping * w + stiffness @ z + friction * jnp.tanh((w - v) / delta))])

    def end(y: Any, tolerance: Any) -> Any:
        return diffrax.diffeqsolve(
            diffrax.ODETerm(rate),
            diffrax.Tsit5(),
            0.0,
            problem.t_end,
            None,
            y,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=_MOST_STEPS,
            throw=False,
        )

    start = jnp.asarray(problem.start)
    compiled = jax.jit(end).lower(start, 1e-3).compile()

    def solve(tolerance: float) -> Solution:
        solution = compiled(start, tolerance)
        z = np.asarray(solution.ys[0, :n])
        if solution.result == diffrax.RESULTS.max_steps_reached:
            raise GivenUp(f"given up after {_MOST_STEPS:,} steps")
        if solution.result != diffrax.RESULTS.successful:
            raise MethodError(str(solution.result))
        return Solution(z, 6 * int(solution.stats["num_steps"]))

    return solve


def _dormand_prince(problem: Problem) -> Solver:
    """The exact law from event to event; it knows constant friction without a static one, and one belt."""
    from stickslip.workflows.gallery.charts import dormand_prince

    system, n = problem.system, problem.system.n
    numbers = (np.array(system.stiffness), np.array(system.damping), np.array(system.friction), system.belt_speed)
    at_start = np.sign(problem.start[n:] - system.belt_speed).astype(np.int64)

    def solve(tolerance: float) -> Solution:
        y, modes = problem.start, at_start.copy()
        n_products, *events = dormand_prince.run(*numbers, y, modes, problem.t_end, tolerance, _MOST_STEPS)
        if n_products < 0:
            raise GivenUp(f"given up after {_MOST_STEPS:,} steps")
        t, block, mode = (np.array(column, kind) for column, kind in zip(events, ("d", "i", "b"), strict=True))
        series = sim.EventSeries(t, block, mode, at_start.astype(np.int8), 0.0, problem.t_end)
        return Solution(y[:n], n_products, series)

    return solve


#: The engines first; in the order of the chart's legend.
METHODS: tuple[Method, ...] = (
    Method("coulomb engine", "coulomb", _coulomb),
    Method("sigmoid engine", "sigmoid", _sigmoid),
    Method("CyRK DOP853", "sigmoid", _cyrk, "CyRK"),
    Method("CVODE BDF-GMRES", "sigmoid", _cvode, "sksundae"),
    Method("diffrax Tsit5", "sigmoid", _diffrax, "diffrax"),
    Method("SciPy DOP853", "sigmoid", _scipy("DOP853", with_jacobian=False)),
    Method("SciPy RK45", "sigmoid", _scipy("RK45", with_jacobian=False)),
    Method("SciPy LSODA", "sigmoid", _scipy("LSODA", with_jacobian=True)),
    Method("SciPy BDF", "sigmoid", _scipy("BDF", with_jacobian=True)),
    Method("SciPy Radau", "sigmoid", _scipy("Radau", with_jacobian=True)),
    Method("DP5 with events", "coulomb", _dormand_prince),
    Method("Moreau-Jean", "coulomb", _moreau, control="step"),
)


def methods_of(
    model: Model, tolerances: tuple[float, ...], steps: tuple[float, ...]
) -> Iterator[tuple[Method, tuple[float, ...]]]:
    """The methods of a law, each with its tolerances or steps. A method without any is left out."""
    for method in METHODS:
        settings = steps if method.control == "step" else tolerances
        if method.model == model and settings:
            yield method, settings


def method(name: str) -> Method:
    """The method of that name."""
    return next(method for method in METHODS if method.name == name)


def solved(name: str, setting: float, problem: Problem) -> Solution:
    """The result of a method at a tolerance or step, however long it takes."""
    return method(name).prepare(replace(problem, patience=math.inf))(setting)


def warm(peer: Method, problem: Problem, setting: float) -> None:
    """Let a method compile and load what its first call needs, untimed; an error here will occur again when timed."""
    with suppress(MethodError, sim.IntegrationError):
        peer.prepare(replace(problem, t_end=1e-3 * problem.t_end))(setting)
