"""The chart `one_block`: periods with static friction, stops under a harmonic force, the basin of steady sliding.

K = 1, unit mass, the exact law. Dimensionless.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from pydantic import Field
from scipy import optimize

from stickslip import sim
from stickslip.analysis.style import CYCLE, GREY, WIDTH, panel
from stickslip.pipeline.scene.toml import Count
from stickslip.workflows.gallery.charts import ChartScene, Say, Shown
from stickslip.workflows.gallery.charts.claims import Claim, every, judged, share, table, told, verdict_of
from stickslip.workflows.gallery.charts.runner import frames
from stickslip.workflows.gallery.field.forced import Forced, State, most_friction, sliding_cycle

EXACT = 1e-12  # relative: the tolerance of the runs
ALMOST_ALWAYS = 0.95
#: Beside the boundary of sliding, of S; and what is the same cycle, or multiplier.
_BESIDE, _SAME = 1e-6, 1e-9
#: Numbers of stops a cycle (Hong and Liu 2000), and how long a block settles before they are counted.
PUBLISHED_STOPS = (0, 1, 2, 4, 6, 8, 10, 12, 14)
_SETTLE, _COUNTED = 60, 4
#: The block of Stender and Hoffmann (2021): damping, friction, static, belt, the speed of the law, and the starts.
DAMPING, FRICTION, STATIC, BELT, FALL = 0.1, 0.5, 1.0, 1.5, 0.5
STARTS = ((-2.0, 2.0), (0.0, 2.0))
PUBLISHED_BASIN, PUBLISHED_SAMPLE, PUBLISHED_ERROR = 0.3071, 0.312, 0.0066
#: A block that has not stuck by then does not; twice, where it is near the edge.
_DECIDED, _AT_EDGE = 150.0, 400.0


@dataclass(frozen=True)
class Period:
    """A row of the table `periods`: of stick and slip, by the closed form and by the mean of a run."""

    damping: float
    drop: float
    belt_speed: float
    closed: float
    found: float


@dataclass(frozen=True)
class Sliding:
    """Cycles at a frequency near the boundary of sliding: the residual of a cycle, and its stops in five cycles."""

    frequency: float
    most_friction: float
    residue: float
    stops_below: int
    stops_above: int


@dataclass(frozen=True)
class Stability:
    """The largest multiplier of a cycle without stops; null where the block stops."""

    frequency: float
    friction: float
    damping: float
    multiplier: float | None


@dataclass(frozen=True)
class Shifted:
    """A cycle centred on `shift` times the bound of z: its change over 100 cycles of the force, its multiplier."""

    frequency: float
    friction: float
    shift: float
    moved: float
    multiplier: float


@dataclass(frozen=True)
class Stops:
    """Stops a cycle of the force; null if not the same in each."""

    frequency: float
    friction: float
    stops: int | None


@dataclass(frozen=True)
class Basin:
    """Where a block comes to slide steadily.

    `share` is the area inside the unstable cycle, over that of the starts; `z`, `w` are of that cycle; `starts`, (z,
    w, whether it comes to slide), are random; `sticking` is the stick-slip cycle.
    """

    share: float
    z: list[float]
    w: list[float]
    starts: list[tuple[float, float, bool]]
    sticking: list[tuple[float, float]]


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    periods: list[Period]
    sliding: list[Sliding]
    stability: list[Stability]
    shifted: list[Shifted]
    stops: list[Stops]
    basin: Basin


class OneBlockScene(ChartScene):
    """A scene with ``chart = "one_block"``; dimensionless."""

    libraries = ("scipy",)

    chart: Literal["one_block"] = Field(description="kind of the chart", examples=["one_block"])
    title: str = Field(default="One block: closed forms", description="one line for the head")
    periods: Count = Field(default=40, description="number of random periods, and as many with damping")
    boundary: Count = Field(default=40, description="number of frequencies of the boundary of sliding")
    stability: Count = Field(default=150, description="number of blocks whose stability is measured")
    shifted: Count = Field(default=10, description="number of shifted cycles for each of three n")
    stops: Count = Field(default=400, description="number of blocks whose stops are counted")
    slowest: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.05, description="the least frequency of the force; the largest is 2"
    )
    starts: Count = Field(default=300, description="number of random starts in the basin")

    def extent(self) -> str:
        n = 2 * self.periods + self.boundary + self.stability + 3 * self.shifted + self.stops + self.starts
        return f"{n} runs of one block"

    def measure(self, say: Say) -> Measured:
        rng = np.random.default_rng(self.seed)
        periods = [_period(rng, is_damped) for is_damped in (False, True) for _ in range(self.periods)]
        say(f"{len(periods)} periods")
        sliding = [_sliding(self._frequency(rng)) for _ in range(self.boundary)]
        stability = [_stability(rng, self._frequency(rng)) for _ in range(self.stability)]
        shifted = [_shifted(rng, 0.5 / n) for n, _ in product((1, 2, 3), range(self.shifted))]
        say(f"{len(sliding) + len(stability) + len(shifted)} cycles under a force")
        stops = [_stops(rng, self._frequency(rng)) for _ in range(self.stops)]
        say(f"{len(stops)} counts of stops")
        return Measured(periods, sliding, stability, shifted, stops, basin(rng, self.starts))

    def _frequency(self, rng: np.random.Generator) -> float:
        return float(np.exp(rng.uniform(np.log(self.slowest), np.log(2.0))))

    def show(self, measured: Measured) -> Shown:
        """Tables: `claims`, `periods`, `sliding`, `stability`, `shifted`, `stops`."""
        claims = judged(_CLAIMS, measured)
        rows = frames(measured, "periods", "sliding", "stability", "shifted", "stops")
        figures = {"one_block": partial(draw, self, measured)}
        return Shown({"claims": claims, "beside": _BESIDE}, {"claims": table(claims)} | rows, figures)


# ---------------------------------------------------------------------------------------------- static friction


def period(drop: float, speed: float, damping: float = 0.0) -> float:
    """Of one block that sticks and slips on a belt, in closed form; with damping up to the root of one equation.

    It leaves the belt with a force of `drop` and the belt's speed, swings at beta = (1 - R^2 / 4)^(1/2), and is back
    when it has that speed again.
    """
    if damping == 0.0:
        return 2 * drop / speed + 2 * (np.pi - np.arctan(drop / speed))
    beta, rate = np.sqrt(1 - damping**2 / 4), damping / 2
    # y from its rest, the belt's motion as the positive direction
    y0 = drop - damping * speed
    b = (speed + rate * y0) / beta

    def displacement(t: float) -> float:
        return float(np.exp(-rate * t) * (y0 * np.cos(beta * t) + b * np.sin(beta * t)))

    def slower(t: float) -> float:
        c, s = np.cos(beta * t), np.sin(beta * t)
        w = np.exp(-rate * t) * (beta * (b * c - y0 * s) - rate * (y0 * c + b * s))
        return float(speed - w)

    times = np.linspace(1e-3, 2 * np.pi / beta, 2000)
    back = next(k for k, t in enumerate(times) if slower(t) < 0)
    slip = optimize.brentq(slower, times[back - 1], times[back], xtol=1e-15, rtol=1e-15)
    return float(slip + (y0 - displacement(slip)) / speed)


def _period(rng: np.random.Generator, is_damped: bool) -> Period:
    drop = float(rng.uniform(0.1, 2.0))
    speed = drop * float(rng.uniform(0.05, 0.5))  # slow enough to come back to the belt
    damping = float(rng.uniform(0.0, 0.1)) if is_damped else 0.0
    closed = period(drop, speed, damping)
    system = sim.System([[1.0]], damping, 1.0, -speed, static=1.0 + drop)
    events = sim.simulate(system, 0.0, -speed, 12 * closed, tol=1e-13).events
    exits = events.t[events.mode != 0]
    return Period(damping, drop, speed, closed, float(np.diff(exits).mean()))


# ---------------------------------------------------------------------------------------------- a harmonic force


def _sliding(frequency: float) -> Sliding:
    friction, residue, stops = most_friction(frequency), 0.0, []
    for factor in (1 - _BESIDE, 1 + _BESIDE):
        block = Forced(frequency, factor * friction)
        start = sliding_cycle(block)
        stops.append(sum(block.stops(start, 1, 5)))
        if factor < 1:
            end = block.after(start)
            residue = max(abs(end.z - start.z), abs(end.w - start.w)) / start.z
    return Sliding(frequency, friction, residue, *stops)


def _anywhere(rng: np.random.Generator) -> State:
    z, w, phase = rng.normal(size=3).tolist()
    return State(z, w, phase)


def _stability(rng: np.random.Generator, frequency: float) -> Stability:
    """Of the cycle that a random start ends in, with positive damping."""
    friction = float(most_friction(frequency) * rng.uniform(0.1, 1.0))
    block = Forced(frequency, friction, float(rng.uniform(0.0, 0.3)))
    start = _anywhere(rng)
    if sum(block.stops(start, 200, 2)):
        return Stability(frequency, friction, block.damping, None)
    multiplier = np.abs(block.multipliers(block.after(start, 200))).max()
    return Stability(frequency, friction, block.damping, float(multiplier))


def _shifted(rng: np.random.Generator, frequency: float) -> Shifted:
    friction = most_friction(frequency)
    block = Forced(frequency, float(friction * rng.uniform(0.2, 0.9)))
    shift, widest = float(rng.uniform(-0.95, 0.95)), friction - block.friction
    start = sliding_cycle(block)
    start = start._replace(z=start.z + shift * widest)
    end = block.after(start, 100)
    change = max(abs(end.z - start.z), abs(end.w - start.w))
    largest = np.abs(block.multipliers(block.after(start, 0.3))).max()
    return Shifted(frequency, block.friction, shift, change, float(largest))


def _stops(rng: np.random.Generator, frequency: float) -> Stops:
    block = Forced(frequency, float(rng.uniform(0.02, 1.0)))
    counts = set(block.stops(_anywhere(rng), _SETTLE, _COUNTED))
    return Stops(frequency, block.friction, counts.pop() if len(counts) == 1 else None)


# ---------------------------------------------------------------------------------------------- steady sliding


def basin(rng: np.random.Generator, starts: int) -> Basin:
    """The basin of steady sliding of a block whose friction falls with speed: all inside an unstable cycle.

    A path in the plane crosses no other, and that cycle does not touch the belt: what starts inside of it never
    sticks. It is found by where it crosses w = 0, and its area, over w >= 0, is the integral of w^2 over time.
    """
    system = sim.System([[1.0]], DAMPING, FRICTION, BELT, static=STATIC, weakening=sim.Stribeck(FALL))

    def run(z: float, w: float, t_end: float, t_eval: Any = ()) -> sim.Run:
        return sim.simulate(system, z, w, t_end, tol=EXACT, t_eval=t_eval, stop_early=False)

    def slides(z: float, w: float, t_end: float) -> bool:
        return len(run(z, w, t_end).events) == 0

    balance = FRICTION + (STATIC - FRICTION) * np.exp(-BELT / FALL)
    inside, outside = balance - 1e-3, STARTS[0][0]
    while abs(inside - outside) > 1e-14:
        middle = (inside + outside) / 2
        if slides(middle, 0.0, _AT_EDGE):
            inside = middle
        else:
            outside = middle
    up = optimize.brentq(lambda t: run(inside, 0.0, t).w[0], 2.0, 4.5, xtol=1e-13)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    w = run(inside, 0.0, up, (nodes + 1) * up / 2).samples.w[:, 0]
    area = float(np.sum(weights * up / 2 * w**2))
    box = np.prod([high - low for low, high in STARTS])
    around = run(inside, 0.0, 2 * up, np.linspace(0.0, 2 * up, 200)).samples
    low, high = np.transpose(STARTS)
    points = rng.uniform(low, high, size=(starts, 2)).tolist()
    sticks = run(2.0, 1.0, _DECIDED, np.linspace(_DECIDED - 8.0, _DECIDED, 300)).samples
    return Basin(
        area / float(box),
        around.z[:, 0].tolist(),
        around.w[:, 0].tolist(),
        [(z, speed, slides(z, speed, _DECIDED)) for z, speed in points],
        list(zip(sticks.z[:, 0].tolist(), sticks.w[:, 0].tolist(), strict=True)),
    )


# ---------------------------------------------------------------------------------------------- claims


def free_period(measured: Measured) -> Claim:
    return _periods([period for period in measured.periods if period.damping == 0])


def damped_period(measured: Measured) -> Claim:
    return _periods([period for period in measured.periods if period.damping > 0])


def _periods(rows: list[Period]) -> Claim:
    off = max(abs(row.found / row.closed - 1) for row in rows)
    return {"verdict": verdict_of(off < EXACT), "tried": len(rows), "value": off}


def amplitude(measured: Measured) -> Claim:
    off = max(cycle.residue for cycle in measured.sliding)
    return {"verdict": verdict_of(off < EXACT), "tried": len(measured.sliding), "value": off}


def boundary(measured: Measured) -> Claim:
    """Just below no stop, just above some, at every frequency."""
    rows = measured.sliding
    claim = share(sum(row.stops_below == 0 and row.stops_above > 0 for row in rows), len(rows))
    return claim | {"verdict": verdict_of(claim["found"] == len(rows))}


def stable(measured: Measured) -> Claim:
    rows = [cycle.multiplier for cycle in measured.stability if cycle.multiplier is not None]
    claim = share(sum(row < 1 for row in rows), len(rows))
    return claim | {"verdict": told(claim["low"], claim["high"], ALMOST_ALWAYS), "most": max(rows, default=None)}


def continuum(measured: Measured) -> Claim:
    rows = measured.shifted
    change, off = max(row.moved for row in rows), max(abs(row.multiplier - 1) for row in rows)
    verdicts = [verdict_of(change < _SAME), verdict_of(off < 10 * _BESIDE)]
    return {"verdict": every(verdicts), "tried": len(rows), "value": change, "apart": off}


def stops(measured: Measured) -> Claim:
    counts = Counter(stop.stops for stop in measured.stops)
    claim = share(sum(counts[n] for n in PUBLISHED_STOPS), len(measured.stops))
    values = sorted(n for n in counts if n is not None)
    return claim | {"verdict": told(claim["low"], claim["high"], ALMOST_ALWAYS), "seen": values}


def steady_sliding(measured: Measured) -> Claim:
    """To the published digits; the published sample within two of its standard errors."""
    basin = measured.basin
    is_near = abs(basin.share - PUBLISHED_BASIN) < 5e-5
    is_sampled = abs(basin.share - PUBLISHED_SAMPLE) < 2 * PUBLISHED_ERROR
    sample = share(sum(slides for _, _, slides in basin.starts), len(basin.starts))
    return sample | {"verdict": every([verdict_of(is_near), verdict_of(is_sampled)]), "value": basin.share}


_CLAIMS = (free_period, damped_period, amplitude, boundary, stable, continuum, stops, steady_sliding)


# ---------------------------------------------------------------------------------------------- figures


@panel(3.4, WIDTH, ncols=2)
def draw(axes: Sequence[Axes], scene: OneBlockScene, measured: Measured) -> None:
    """Stops a cycle over frequency and friction, and the basin of steady sliding."""
    _draw_stops(axes[0], scene, measured)
    _draw_basin(axes[1], measured.basin)


def _draw_stops(ax: Axes, scene: OneBlockScene, measured: Measured) -> None:
    frequencies = np.geomspace(scene.slowest, 2.0, 400)
    bound = [most_friction(float(frequency)) for frequency in frequencies]
    ax.plot(frequencies, bound, color="black", linewidth=0.8)
    counts = sorted({stop.stops for stop in measured.stops if stop.stops is not None})
    for k, n in enumerate(counts):
        points = np.array([(stop.frequency, stop.friction) for stop in measured.stops if stop.stops == n])
        ax.plot(*points.T, "o", markersize=2.5, color=CYCLE[k % len(CYCLE)], label=str(n))
    ax.set(xscale="log", title="(a) stops a cycle of the force", xlabel="frequency Ω", ylabel="friction S")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, handletextpad=0.1)


def _draw_basin(ax: Axes, basin: Basin) -> None:
    for is_sliding, colour, label in ((True, CYCLE[2], "comes to slide"), (False, CYCLE[0], "sticks and slips")):
        points = [(z, w) for z, w, slides in basin.starts if slides == is_sliding]
        ax.plot([z for z, _ in points], [w for _, w in points], ".", markersize=3, color=colour, label=label)
    ax.plot(basin.z, basin.w, color="black", linewidth=0.9, label="unstable cycle")
    ax.plot(*np.transpose(basin.sticking), color=GREY, linewidth=0.9, label="stick-slip cycle")
    ax.set(title="(b) starts", xlabel="displacement z", ylabel="velocity z′")
    ax.legend(loc="lower left", fontsize=6, framealpha=0.9, frameon=True)
