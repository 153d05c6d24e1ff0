"""Relations between runs that need no reference: what the equations leave unchanged, engines leave unchanged.

A family gives, of a setup, others whose runs tell the same motion, and how to read them back. Runs of the setup with
start and constants changed a little measure how far the tolerance moves the motion; where they disagree on a series,
or a stretch is a touch, `tests.fuzz.series.compare` says so, and it is counted. Some relations hold to the byte.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.sparse import csc_array

from stickslip.sim import Harmonic, IntegrationError, Piecewise, Run, System, simulate
from stickslip.sim.engines.coulomb import settings as coulomb
from stickslip.sim.systems.weakening import Weakening
from tests.fuzz.draw import TERMS_OF_WAVES, by_waves, draw
from tests.fuzz.judge import Endless, Verdict, both_ways, patience
from tests.fuzz.series import Stretches, agreeing, by_block, compare
from tests.independent import Floats
from tests.systems import TERMS, Rng, made

#: Difference over tol times sensitivity beyond which a relation is broken, by method: two runs may err each way. By
#: waveform relaxation phases err by a tenth of the tolerance a step, which adds up where nothing is damped.
LIMIT = {"coulomb": 200.0, "waves": 100.0, "sigmoid": 2000.0}
_LOST = 1e-3  # of the size of the state: where the tolerance moves it by more, nothing is compared
_PATIENCE = 20.0  # seconds of this process for all runs of one setup
EVENTS = ("t", "block", "mode", "initial")
EVERYTHING = (*EVENTS, "z", "w")
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Setup:
    """What `simulate` is called with."""

    system: System
    z: Floats
    w: Floats
    t_start: float
    t_end: float
    engine: str
    settings: dict[str, Any] = field(default_factory=dict)
    times: Floats = field(default_factory=lambda: np.empty(0))
    modes: NDArray[np.int8] | None = None
    is_by_waves: bool = False  #: as far as waveform relaxation takes it; what it does not is run by series

    @property
    def method(self) -> str:
        return "waves" if self.is_by_waves else self.engine

    def run(self) -> Run:
        return simulate(
            self.system, self.z, self.w, self.t_end, t_start=self.t_start, t_eval=self.times, engine=self.engine,
            modes=self.modes, stop_early="always", **self.settings,
        )  # fmt: skip

    def changed(self, **arguments: Any) -> Setup:
        return replace(self, system=self.system.changed(**arguments))

    @property
    def tol(self) -> float:
        return float(self.settings["tol" if self.engine == "coulomb" else "rtol"])


@dataclass(frozen=True)
class Told:
    """A run's events, z and w (m, n) at the samples and, unless it diverged, at the end, and the modes there."""

    t: Floats
    block: NDArray[np.int32]
    mode: NDArray[np.int8]
    initial: NDArray[np.int8]
    z: Floats
    w: Floats
    last: NDArray[np.int8]
    t_end: float
    outcome: str

    @classmethod
    def of(cls, run: Run) -> Told:
        e, s = run.events, run.samples
        z, w = s.z, s.w
        if run.outcome != "diverged":
            z, w = np.vstack([z, run.z]), np.vstack([w, run.w])
        return cls(e.t, e.block, e.mode, e.initial_mode, z, w, e.mode_at(e.t_end), run.t_end, run.outcome)

    def is_same(self, other: Told, names: tuple[str, ...]) -> bool:
        """To the byte, as far as both go (the size at which a run has diverged is fixed); minus zero is zero."""
        one, two = self, other
        if "diverged" in (self.outcome, other.outcome):
            t_end, m = min(self.t_end, other.t_end), min(len(self.z), len(other.z))
            one, two = one.until(t_end, m), two.until(t_end, m)
        return all(np.array_equal(getattr(one, name), getattr(two, name)) for name in names)

    def until(self, t_end: float, m: int) -> Told:
        """Events before a time, and the first m samples."""
        k = np.searchsorted(self.t, t_end)
        return replace(self, t=self.t[:k], block=self.block[:k], mode=self.mode[:k], z=self.z[:m], w=self.w[:m])


@dataclass(frozen=True)
class Image:
    """A setup that moves alike, how its run is read back, and up to when (None: the end)."""

    setup: Setup
    back: Callable[[Told], Told] = lambda told: told
    until: float | None = None
    is_event: bool = False  # ends at an event, which rounding may put behind the end
    to_the_byte: tuple[str, ...] = ()
    how: str = ""
    late: float = 0.0  # the largest time of it: what rounding leaves of a time
    speed: float = 0.0  # what it adds to all speeds, which the tolerance is relative to


def _relabelled(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """The blocks in another order."""
    order = rng.permutation(setup.system.n)
    there = np.argsort(order)
    s = setup.system
    damping = s.damping[order] if s.cross_damping is None else _full(s)[np.ix_(order, order)]
    k = s.stiffness[order][:, order]
    system = s.changed(
        stiffness=k, damping=damping, mass=s.mass[order], belt_speed=_of_belt(s, lambda v: v[..., order]),
        force=_of_force(s, lambda f: f[..., order], lambda x: x[..., order]), **_frictions(s, lambda mu: mu[order]),
    )  # fmt: skip
    object.__setattr__(system, "closed", s.closed[order])
    settings = dict(setup.settings)
    if np.ndim(settings.get("ratio", 1.0)):
        settings["ratio"] = np.asarray(settings["ratio"])[order]

    def back(told: Told) -> Told:
        return replace(
            told, block=order[told.block].astype(np.int32), initial=told.initial[there], last=told.last[there],
            z=told.z[:, there], w=told.w[:, there],
        )  # fmt: skip

    yield Image(replace(setup, system=system, z=setup.z[order], w=setup.w[order], settings=settings), back)


def _mirrored(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """Left for right, to the byte."""
    s = setup.system
    other = s.changed(belt_speed=_of_belt(s, np.negative), force=_of_force(s, np.negative))
    object.__setattr__(other, "closed", -s.closed)

    def back(told: Told) -> Told:
        return replace(told, mode=-told.mode, initial=-told.initial, last=-told.last, z=-told.z, w=-told.w)

    yield Image(replace(setup, system=other, z=-setup.z, w=-setup.w), back, to_the_byte=EVERYTHING)


def _moved(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """Another origin of z, by a force K c; in quarters, so that whole numbers stay exact."""
    c = rng.integers(-8, 9, setup.system.n) / 4
    force = [*setup.system.force, setup.system.stiffness @ c]
    yield Image(replace(setup.changed(force=force), z=setup.z + c), lambda told: replace(told, z=told.z - c))


def _of_speeds(law: Weakening, a: float) -> Weakening:
    """A law whose speeds are multiplied by a number."""
    numbers = {key.name: getattr(law, key.name) for key in fields(law)}
    return replace(law, **{name: value * (1 / a if name == "rate" else a) for name, value in numbers.items()})


def _scaled(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """All lengths, speeds and forces times a power of two."""
    s, a = setup.system, float(2.0 ** rng.integers(-3, 4))
    weakening = s.weakening and _of_speeds(s.weakening, a)
    settings = {name: value * a if name in ("eps", "atol") else value for name, value in setup.settings.items()}
    if setup.settings.get("eps", 0.0) * a > 0.3:
        return
    system = s.changed(
        belt_speed=_of_belt(s, lambda v: v * a), force=_of_force(s, lambda f: f * a), weakening=weakening,
        **_frictions(s, lambda mu: mu * a),
    )  # fmt: skip
    back = _lengths(1 / a, 1 / a)
    is_exact = setup.engine == "coulomb"
    if is_exact or setup.settings.get("stick") == "threshold":  # ln(1 / delta) knows of a unit
        other = replace(setup, system=system, z=setup.z * a, w=setup.w * a, settings=settings)
        size = max(s.fastest_belt, float(np.abs((setup.z, setup.w)).max()))
        is_large = size * min(1.0, a) >= 1.0  # a state below 1 is asked for its escape at other instants
        yield Image(other, back, to_the_byte=EVERYTHING if is_exact and is_large else ())


def _sped(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """All rates times a power of two: of the masses, its square less."""
    s, a = setup.system, float(2.0 ** rng.choice([-2, -1, 1, 2]))
    if setup.engine == "sigmoid" and (setup.settings.get("stick") != "threshold" or setup.settings["eps"] * a > 0.3):
        return
    weakening = s.weakening and _of_speeds(s.weakening, a)
    belt = s.belt_speed
    belt = Piecewise(belt.times / a, belt.values * a) if isinstance(belt, Piecewise) else belt * a
    system = s.changed(
        mass=s.mass / a**2, damping=_full(s) / a if s.cross_damping is not None else s.damping / a, belt_speed=belt,
        weakening=weakening,
        force=[
            Harmonic(f.amplitude, f.frequency * a, f.phase)
            if isinstance(f, Harmonic)
            else Piecewise(f.times / a, f.values)
            for f in s.force
        ],
    )  # fmt: skip
    settings = {name: value * a if name == "eps" else value for name, value in setup.settings.items()}
    ends = dict(t_start=setup.t_start / a, t_end=setup.t_end / a, times=setup.times / a)

    def back(told: Told) -> Told:
        return replace(told, t=told.t * a, w=told.w / a, t_end=told.t_end * a)

    yield Image(replace(setup, system=system, w=setup.w * a, settings=settings, **ends), back)


def _framed(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """Seen from a frame of constant speed u: y = z - u (t - t0); f - C u - K u (t - t0) is the force there."""
    s = setup.system
    u = rng.integers(1, 5) / 4 * rng.choice([-1.0, 1.0])
    t0, t1 = setup.t_start, setup.t_end
    ones = np.full(s.n, u)
    pull = s.stiffness @ ones
    steady = s.damping * ones if s.cross_damping is None else _full(s) @ ones
    other = s.changed(
        belt_speed=_of_belt(s, lambda v: v - u),
        force=[*s.force, -steady, *([Piecewise([t0, t1], [0 * pull, -pull * (t1 - t0)])] if t1 > t0 else [])],
    )
    since = np.append(setup.times, t1)[:, None] - t0

    def back(told: Told) -> Told:
        return replace(told, z=told.z + u * since[: len(told.z)], w=told.w + u)

    yield Image(replace(setup, system=other, w=setup.w - u), back, speed=abs(u))


def _later(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """The same at another hour: knots and phases go along."""
    s, d = setup.system, float(2.0 ** rng.integers(0, 21)) * rng.choice([-1, 1])

    def moved(x: Piecewise) -> Piecewise:
        return Piecewise(x.times + d, x.values)

    if any((np.diff(x.times + d) <= 0).any() for x in (*s.force, s.belt_speed) if isinstance(x, Piecewise)):
        return
    force = [
        Harmonic(f.amplitude, f.frequency, f.phase - f.frequency * d) if isinstance(f, Harmonic) else moved(f)
        for f in s.force
    ]
    belt = moved(s.belt_speed) if isinstance(s.belt_speed, Piecewise) else s.belt_speed
    other = replace(
        setup.changed(force=force, belt_speed=belt), t_start=setup.t_start + d, t_end=setup.t_end + d,
        times=setup.times + d,
    )  # fmt: skip
    yield Image(other, lambda told: replace(told, t=told.t - d, t_end=told.t_end - d), late=abs(d) + setup.t_end)


def _cut(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """Runs that end at an event, a sample, a knot or anywhere, and those that go on from there."""
    knots = [x.times for x in (*setup.system.force, setup.system.belt_speed) if isinstance(x, Piecewise)]
    kinds = {
        "an event": run.events.t,
        "a sample": setup.times,
        "a knot": np.concatenate([[], *knots]),
        "any time": rng.uniform(setup.t_start, setup.t_end, 1),
    }
    for kind, times in kinds.items():
        inside = times[(times > setup.t_start) & (times < setup.t_end)]
        if not len(inside):
            continue
        s = float(rng.choice(inside))
        first = replace(setup, t_end=s, times=setup.times[setup.times <= s])
        how = f"at {kind}, t = {s!r}: "
        yield Image(first, until=s, is_event=kind == "an event" and s not in kinds["a knot"], how=f"end {how}")
        stop = first.run()
        if stop.outcome == "diverged" or run.outcome == "diverged":
            continue
        rest = replace(setup, z=stop.z, w=stop.w, t_start=s, times=setup.times[setup.times > s])
        choices = [stop.events.mode_at(s)] if setup.engine == "coulomb" else [None]
        choices += [None] if setup.engine == "coulomb" and not setup.system.is_static_above else []
        for modes in choices:
            words = how if modes is None else f"with modes {how}"
            yield Image(replace(rest, modes=modes), _after(Told.of(stop), s), how=words)


def _after(first: Told, s: float) -> Callable[[Told], Told]:
    """A run from s on behind one that ends there."""

    def back(told: Told) -> Told:
        changed = np.flatnonzero(told.initial != first.last)
        return replace(
            told, t=np.concatenate([first.t, np.full(len(changed), s), told.t]),
            block=np.concatenate([first.block, changed, told.block]).astype(np.int32),
            mode=np.concatenate([first.mode, told.initial[changed], told.mode]), initial=first.initial,
            z=np.vstack([first.z[:-1], told.z]), w=np.vstack([first.w[:-1], told.w]),
        )  # fmt: skip

    return back


def _stored(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """K in another order of memory, to the byte; K sparse or dense."""
    k = setup.system.stiffness
    if not isinstance(k, np.ndarray):
        yield Image(setup.changed(stiffness=k.toarray()))
        return
    wide = np.zeros((2 * len(k), 3 * len(k)))
    wide[::2, ::3] = k
    for other in (np.asfortranarray(k), wide[::2, ::3], np.ascontiguousarray(k[:, ::-1])[:, ::-1]):
        yield Image(setup.changed(stiffness=other), to_the_byte=EVERYTHING)
    yield Image(setup.changed(stiffness=csc_array(k)))


def _watched(rng: Rng, setup: Setup, run: Run) -> Iterator[Image]:
    """More samples, at events too: events stay to the byte; after a collapse a sample follows from the one before."""
    more = np.concatenate([setup.times, rng.uniform(setup.t_start, setup.t_end, 7), run.events.t[:3]])
    order = np.argsort(more, kind="stable")
    kept = np.append(np.flatnonzero(order < len(setup.times)), len(more))

    def back(told: Told) -> Told:
        reached = kept[kept < len(told.z)]
        return replace(told, z=told.z[reached], w=told.w[reached])

    yield Image(replace(setup, times=more[order]), back, to_the_byte=EVENTS)


#: Every relation, by name: (rng, setup, its run) to the setups that tell the same.
RELATIONS: dict[str, Callable[[Rng, Setup, Run], Iterator[Image]]] = {
    "permutation": _relabelled,
    "mirror": _mirrored,
    "shift": _moved,
    "amplitude": _scaled,
    "time scale": _sped,
    "frame": _framed,
    "start time": _later,
    "restart": _cut,
    "storage": _stored,
    "samples": _watched,
}


def _lengths(of_z: float, of_w: float) -> Callable[[Told], Told]:
    return lambda told: replace(told, z=told.z * of_z, w=told.w * of_w)


def _full(system: System) -> Floats:
    """The damping matrix C."""
    return np.asarray(system.cross_damping + np.diag(system.damping))


def _of_belt(system: System, change: Callable[[Any], Any]) -> Any:
    v = system.belt_speed
    if isinstance(v, Piecewise):
        return Piecewise(v.times, change(v.values))
    return change(np.broadcast_to(v, system.n))


def _of_force(system: System, change: Callable[[Any], Any], order: Callable[[Any], Any] = lambda x: x) -> list[Any]:
    return [
        Harmonic(change(f.amplitude), order(f.frequency), order(f.phase))
        if isinstance(f, Harmonic)
        else Piecewise(f.times, change(f.values))
        for f in system.force
    ]


def _frictions(system: System, change: Callable[[Any], Any]) -> dict[str, Any]:
    static = None if system.static is system.friction else change(system.static)
    return {"friction": change(system.friction), "static": static}


def _grazing(rng: Rng) -> Setup:
    """One block, or two, the first of which touches its belt at the edge of friction and slips on, followed back."""
    while True:
        n, at = int(rng.integers(1, 3)), rng.uniform(0.3, 2)
        a = rng.normal(size=(n, n))
        k, r, v = a @ a.T + 0.3 * np.eye(n), rng.uniform(0, 0.3, n), float(rng.normal())
        z, w, side = rng.normal(size=n), v + rng.normal(size=n), np.ones(n)
        side[1:], w[0] = np.sign(w - v)[1:], v
        z[0] -= (r[0] * v + k[0] @ z + 1.0) / k[0, 0]  # w' = 0
        system = System(k, r, 1.0, v)
        path = [np.concatenate([z, w])]
        rest = np.concatenate([np.linalg.solve(k, -side), np.zeros(n)])
        back = expm(-system.slip_matrix() * at / 64)
        for _ in range(64):
            path.append(rest + back @ (path[-1] - rest))
        if ((np.array(path)[1:, n:] - v) * side > 0).all():
            x = path[-1] + 10 ** rng.uniform(-14, -10) * rng.normal(size=2 * n)
            return Setup(system, x[:n], x[n:], 0.0, at + 0.5, "coulomb", times=np.array([at / 2, at + 0.25]))


def setup_of(seed: int, number: int, terms: Any = TERMS) -> Setup:
    """A drawn case, also with cross damping, a sparse K, another definition of stick, late starts, more blocks."""
    rng = np.random.default_rng([seed, number, 3])
    trial = draw(seed, number, terms)
    case, settings = trial.case, dict(trial.settings)
    settings.pop("thresholds", None)
    if trial.engine == "coulomb":
        settings["tol"] = max(settings["tol"], 1e-12)
    elif rng.random() < 0.5:
        settings |= {"stick": "threshold", "threshold": float(rng.choice([1.0, 3.0]))}
    system = made(case, sparse=bool(rng.random() < 0.2))
    z, w, n = case.z0, case.w0, case.n
    if case.n > 1 and rng.random() < 0.15:  # many, coupled weakly: drawn ones again and again
        copies = int(rng.integers(2, 1 + max(2, 60 // n)))
        k = np.kron(np.eye(copies), case.stiffness)
        k += 0.01 / len(k) * rng.normal(size=k.shape)
        many = replace(
            case.renumbered(np.tile(np.arange(n), copies)), stiffness=k, cross=np.kron(np.eye(copies), case.cross),
            z0=np.tile(z, copies), w0=np.tile(w, copies),
        )  # fmt: skip
        if np.ndim(settings.get("ratio", 1.0)):
            settings["ratio"] = np.tile(settings["ratio"], copies)
        system, z, w = made(many), many.z0, many.w0
    if trial.engine == "sigmoid" and system.n > 1 and rng.random() < 0.4:
        cross = rng.normal(size=(system.n, system.n)) * rng.choice([0.1, 0.5])
        np.fill_diagonal(cross, 0.0)
        system = system.changed(damping=np.diag(system.damping) + cross)
    t_end = min(trial.t_end, 30.0)
    if trial.engine == "coulomb" and rng.random() < 0.15:
        grazing = _grazing(rng)
        return replace(grazing, settings=settings)
    if rng.random() < 0.15 and t_end > 1 and system.back_slip:  # a steep ramp, of a force or of belts
        at, size = float(rng.integers(0, int(t_end))), rng.integers(-2, 3, system.n) / 2
        times = [at, at + 2.0 ** -rng.integers(4, 17)]
        if rng.random() < 0.5:
            system = system.changed(force=[*system.force, Piecewise(times, [0 * size, size])])
        elif system.has_one_belt:
            system = system.changed(belt_speed=Piecewise(times, system.belt_speed + np.array([0 * size, size])))
    if rng.random() < 0.3:  # an end in whole numbers, where knots are
        t_end = max(1.0, np.floor(t_end))
    times = np.unique(np.append(np.round(np.sort(rng.uniform(0, t_end, 12)) * 1024) / 1024, t_end))
    times = times[times <= t_end]
    return Setup(system, np.array(z), np.array(w), 0.0, float(t_end), trial.engine, settings, times)


def _perturbed(rng: Rng, setup: Setup, by: float) -> Setup:
    """Start and constants changed, relative to the largest; by waves K too, whose steps err in phase as it does."""

    def near(x: Floats) -> Floats:
        return x * (1 + by * rng.uniform(-1, 1, x.shape))

    s = setup.system
    size = max(1e-3, np.abs(setup.z).max(), np.abs(setup.w).max())
    held = setup.w == s.belt_speed_at(setup.t_start)  # who starts on its belt stays on it
    w = np.where(held, setup.w, setup.w + by * size * rng.uniform(-1, 1, s.n))
    mu = near(s.friction)
    ratio = np.divide(mu, s.friction, out=np.ones(s.n), where=s.friction > 0)
    system = s.changed(friction=mu, static=None if s.static is s.friction else s.static * ratio)
    if setup.is_by_waves:
        system = system.changed(stiffness=near(s.stiffness))
    return replace(setup, system=system, z=setup.z + by * size * rng.uniform(-1, 1, s.n), w=w)


def _on_the_edge(setup: Setup, share: float) -> NDArray[np.bool_]:
    """Blocks that begin on their belts with |F| at static friction, to a share of it: who slips is then a choice."""
    s, t, z = setup.system, setup.t_start, setup.z
    v = s.belt_speed_at(t)
    damping = np.diag(s.damping) if s.cross_damping is None else _full(s)
    size = s.row_sums * np.abs(z).max() + np.abs(damping) @ np.abs(v) + s.most_force + s.static
    excess = np.abs(s.holding_force(z, setup.w, t)) - s.static
    return (np.abs(setup.w - v) <= share * max(s.fastest_belt, 1.0)) & (np.abs(excess) <= share * size)


class _Measure:
    """A setup's run, and how far the tolerance moves it."""

    def __init__(self, rng: Rng, setup: Setup) -> None:
        self.setup, self.limit = setup, LIMIT[setup.method]
        self.run = setup.run()
        self.told = Told.of(self.run)
        x = self._state(self.told)
        tol = setup.tol
        by = min(max(self.limit / 10 * tol, 1e-10), 1e-2)  # `compare` allows ten times what these move an event
        self.changed = [Told.of(_perturbed(own, setup, way).run()) for own, way in both_ways(rng, by)]
        moved = np.zeros(len(x))
        for other in self.changed:
            y = self._state(other)
            m = min(len(x), len(y))
            moved[:m] = np.maximum(moved[:m], np.abs(x[:m] - y[:m]).max(axis=1, initial=0.0) / by)
            moved[m:] = np.inf
        v = setup.system.fastest_belt
        largest = np.maximum.accumulate(np.abs(x).max(axis=1))
        atol = setup.settings.get("atol", tol) / tol
        self.unit = np.maximum.accumulate(np.maximum(moved, np.maximum(largest, max(v, atol)))) * tol
        size = max(v, float(largest.max(initial=0.0)), atol)
        s = setup.system
        forces = np.asarray(abs(s.stiffness).sum(axis=1)).reshape(-1) * size + s.static + s.most_force
        forces += np.abs(s.damping) * size + (
            0 if s.cross_damping is None else np.abs(s.cross_damping).sum(axis=1) * size
        )
        self.rate = float((forces / s.mass).max()) + size
        known = self.unit * self.limit < _LOST * size
        self.n_known = int(len(x) if known.all() else np.argmin(known))
        times = np.append(setup.times, setup.t_end)
        self.until = float(times[self.n_known - 1]) if self.n_known else setup.t_start

    @staticmethod
    def _state(told: Told) -> Floats:
        return np.hstack([told.z, told.w])

    def hold(self, image: Image) -> tuple[str, float, str]:
        """("same" | "graze" | "undecided" | "differs", ratio, words) of one relation."""
        run = image.setup.run()
        begun, asked = run.events.initial_mode, image.setup.modes
        if asked is not None and ((begun != asked) & ~_on_the_edge(image.setup, 100 * self.setup.tol)).any():
            return "differs", 0.0, "it does not begin with the modes given"
        told = image.back(Told.of(run))
        ratio, words = self._ratio(told, image)
        if not told.is_same(self.told, image.to_the_byte):
            return "differs", ratio, f"not the same bytes{self._where(told)}"
        if ratio > self.limit:
            return "differs", ratio, words
        return self._series(told, image, ratio)

    def _where(self, told: Told) -> str:
        a, b = self.told, told
        m = min(len(a.t), len(b.t))
        off = (a.t[:m] != b.t[:m]) | (a.block[:m] != b.block[:m]) | (a.mode[:m] != b.mode[:m])
        if off.any() or len(a.t) != len(b.t):
            k = int(np.argmax(off)) if off.any() else m
            return f": {len(a.t)} events and {len(b.t)}, event {k} first"
        x, y = self._state(a), self._state(b)
        rows = min(len(x), len(y))
        return f": z, w by {np.abs(x[:rows] - y[:rows]).max(initial=0.0):.3g}"

    def _ratio(self, told: Told, image: Image) -> tuple[float, str]:
        x, y, unit = self._state(self.told), self._state(told), self.unit
        if image.until is not None:
            x = x[: np.searchsorted(self.setup.times, image.until, side="right")]
            if len(x) and self.setup.times[len(x) - 1] == image.until and told.outcome != "diverged":
                y = np.vstack([y[: len(x) - 1], y[-1:]])  # the end of the run is the sample there
            y = y[: len(x)]
        m = min(len(x), len(y), self.n_known)
        if len(x) != len(y) and m < self.n_known and "diverged" not in (told.outcome, self.told.outcome):
            return np.inf, f"{told.outcome} with {len(y)} samples of {len(x)}"
        rounding = 16 * _EPS * image.late * self.rate * (1 + len(self.told.t)) * unit[:m] / self.unit[:1]
        apart = np.abs(x[:m] - y[:m]).max(axis=1, initial=0.0) / (unit[:m] + rounding / self.limit)
        ratio = float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))
        return ratio, f"apart by {ratio:.3g} tol times sensitivity"

    def _keeps_a_touch(self, i: int, mine: Stretches, its: Stretches, image: Image) -> bool:
        """Whether one of the two has a stretch that rounding cannot tell from a touch."""
        s = self.setup.system
        if self.setup.is_by_waves and image.setup.t_start > self.setup.t_start:
            return False  # |F| at an event is static friction to the tolerance: series may begin with what it was
        if self.setup.engine != "coulomb" or s.rates[i] == 0 or s.static[i] != s.slip_friction[0][i]:
            return False
        shortest = np.sqrt(_EPS) / s.rates[i]  # a run tells a touch by its own error, which is rounding at least
        return any(0 < np.diff([t for t, *_ in one[1:]]).min(initial=np.inf) < shortest for one in (mine, its))

    @cached_property
    def _moves(self) -> list[list[float]]:
        """By how much an error of w moves each of the run's events, by block, the start first; the least is 1.

        A block that slips comes to its belt's speed with what friction there leaves of F; where that is next to
        nothing, as at the end of a slow swing, the time is hardly known.
        """
        s, e = self.setup.system, self.run.events
        seen = replace(self.setup, times=np.unique(e.t)).run().samples
        mode, moves = e.initial_mode.copy(), [[1.0] for _ in range(s.n)]
        for t, i, after in zip(e.t, e.block, e.mode, strict=True):
            k = int(np.searchsorted(seen.t, t))
            pull = np.inf
            if mode[i] and k < len(seen.t):
                pull = abs(s.holding_force(seen.z[k], seen.w[k], float(t))[i] + mode[i] * s.slip_friction[0][i])
            moves[i].append(max(1.0, s.mass[i] / max(pull, 1e-300)))
            mode[i] = after
        return moves

    def _rests_on_the_edge(self, i: int, mine: Stretches, its: Stretches, until: float, error: float) -> bool:
        """Whether a block keeps to its belt, and |F| to a friction there, from where the two part, within an error.

        It comes to rest there without end: who says that it sticks, or how it swings, is as right as who does not.
        """
        k = agreeing(mine, its)
        start = min((one[k][0] for one in (mine, its) if k < len(one)), default=until)
        seen = replace(self.setup, times=self.setup.t_start + np.linspace(start, until, 25)).run().samples
        s = self.setup.system
        of_force = error * (s.row_sums + s.cross_sums)[i]  # F has no w of its own block
        edges = np.array([s.static[i], s.slip_friction[0][i]])
        return all(
            abs(w[i] - s.belt_speed_at(t)[i]) <= error
            and np.abs(np.abs(s.holding_force(z, w, float(t))[i]) - edges).min() <= of_force
            for t, z, w in zip(seen.t, seen.z, seen.w, strict=True)
        )

    def _series(self, told: Told, image: Image, ratio: float) -> tuple[str, float, str]:
        ends = [run.t_end for run in (self.told, *self.changed) if run.outcome == "diverged"]
        if told.outcome == "diverged":  # when that is certain, is known at steps only
            ends.append(told.t_end)
        until = min([self.until, *ends] if image.until is None else [self.until, image.until, *ends])
        unit = float(self.unit[: max(1, self.n_known)].max(initial=self.setup.tol))
        error = self.limit * unit + 16 * _EPS * image.late
        if image.speed > 0.0:  # as the tolerance is, once the motion is slow
            m = max(1, int(np.searchsorted(self.setup.times, until)))
            least = np.abs(self.told.w[:m]).max(axis=1).min() if len(self.told.w) else 0.0
            error *= 1 + image.speed / max(least, self.setup.system.fastest_belt, self.setup.tol)
        mine, its, *others = (
            by_block(x.t - self.setup.t_start, x.block, x.mode, x.initial) for x in (told, self.told, *self.changed)
        )
        shortest, length = 10 * np.sqrt(error), until - self.setup.t_start
        worst, words = "same", ""
        settings = self.setup.settings
        layer = settings.get("eps", 0.0) * float(np.min(settings.get("ratio", 1.0)))
        moves = 1.0
        if settings.get("stick") == "threshold":  # a place in the layer, where w hardly moves
            if error > layer:
                return "undecided", ratio, ""
            moves = max(1.0, 1.0 / layer)
        rounded, frictionless = _on_the_edge(self.setup, 64 * _EPS), self.setup.system.static == 0
        for i in range(self.setup.system.n):
            if rounded[i] or (frictionless[i] and any(mode == 0 for one in (mine, its) for _, mode, _ in one[i])):
                worst = "undecided"  # rounding alone holds a block without friction
                continue
            cut = [[stretch for stretch in one[i] if stretch[0] <= length] for one in (mine, its, *others)]
            its_moves = [(t, mode, moves) for t, mode, _ in cut[1]]
            kind, said = compare(cut[0], its_moves, cut[2:], error, shortest, length)
            if kind == "differs":
                its_moves = [(t, m, max(moves, x)) for (t, m, _), x in zip(cut[1], self._moves[i], strict=False)]
                kind, said = compare(cut[0], its_moves, cut[2:], error, shortest, length)
            if kind == "graze" and image.until == until and not image.is_event:
                ends = [one[-1][1] for one in cut[1:]]
                if len(set(ends)) == 1 and cut[0][-1][1] != ends[0]:  # what is robust is no touch
                    kind, said = "differs", f"mode {cut[0][-1][1]} at its end t = {until!r}, expected {ends[0]}"
            if kind == "graze" and self._keeps_a_touch(i, cut[0], cut[1], image):
                kind, said = "differs", "a touch, which is no event, is told as two"
            if kind == "differs" and self._rests_on_the_edge(i, cut[0], cut[1], length, error):
                kind = "undecided"
            if kind == "differs":
                return "differs", ratio, f"series of block {i}: {said}"
            worst = max(worst, kind, key=("same", "graze", "undecided").index)
        return worst, ratio, words


def judge_relations_by_waves(seed: int, number: int, terms: Any = TERMS) -> Verdict:
    """All relations of one drawn setup that waveform relaxation takes."""
    tol = float(10.0 ** -np.random.default_rng([seed, number, 6]).uniform(5, 7))
    setup = setup_of(seed, number, [term for term in terms if term in TERMS_OF_WAVES])
    with by_waves():
        if setup.engine != "coulomb" or not coulomb.Coulomb(tol=tol).is_by_waves(setup.system):
            return Verdict(notes=Counter(skipped=1))
        return _judged(seed, number, replace(setup, settings={"tol": tol}, is_by_waves=True))


def judge_relations(seed: int, number: int, terms: Any = TERMS, only: str | None = None) -> Verdict:
    """All relations of one drawn setup, or one by name."""
    return _judged(seed, number, setup_of(seed, number, terms), only)


def _judged(seed: int, number: int, setup: Setup, only: str | None = None) -> Verdict:
    verdict = Verdict()
    rng = np.random.default_rng([seed, number, 4])
    how = ""
    try:
        with patience(_PATIENCE):
            measure = _Measure(rng, setup)
    except (Endless, IntegrationError, MemoryError):  # what the reference judges
        verdict.notes["skipped"] += 1
        return verdict
    for (name, family), own in zip(RELATIONS.items(), rng.spawn(len(RELATIONS)), strict=True):
        if only not in (None, name):
            continue
        try:
            with patience(_PATIENCE):
                for image in family(own, setup, measure.run):
                    how = image.how
                    kind, ratio, words = measure.hold(image)
                    verdict.relations.append((name, kind, ratio))
                    if kind == "differs":
                        verdict.fail(name, how + words)
        except Endless:
            verdict.relations.append((name, "slow", 0.0))
        except (IntegrationError, ArithmeticError, ValueError, IndexError) as error:
            verdict.relations.append((name, "differs", 0.0))
            verdict.fail(name, f"{how}{type(error).__name__}: {error}")
    return verdict
