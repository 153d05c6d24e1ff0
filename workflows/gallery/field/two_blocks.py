"""The chart `two_blocks`: two equal blocks with static and dynamic friction on a slow belt.

The earthquake model of J. Nussbaum and A. Ruina, Pure Appl. Geophys. 125 (1987) 629-656: leaf springs of stiffness
one, a coupling spring k between the blocks, the exact law. While both blocks stick the belt loads both alike, so
that from one episode to the next the state is one number, the difference of stretch D = z_1 - z_2. Dimensionless.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from pydantic import Field

from stickslip import sim
from stickslip.analysis.stats.estimates import over_matrices, ratio
from stickslip.analysis.style import CYCLE, GREY, WIDTH, legend, panel
from stickslip.pipeline.scene.toml import Count, Positive, PositiveNumbers
from stickslip.sim.episodes import spans
from stickslip.workflows.gallery.charts import ChartScene, Say, Shown
from stickslip.workflows.gallery.charts.claims import CONFIDENCE, Claim, every, judged, share, table, told
from stickslip.workflows.gallery.charts.runner import frames
from stickslip.workflows.gallery.field import cycles

TOL = 1e-12
#: Longer than any episode, from a unit of time before it.
_EPISODE = 100.0
#: Points of an orbit that are one; the longest cycle looked for; the width of differences. Of D, over the drop.
_SAME, _LONGEST, _WIDTH = 1e-7, 12, 1e-6
#: |D| over the drop below which blocks go together, as one.
_ALIKE = 1e-3
#: What "almost always" and "in general" say of a share.
ALMOST_ALWAYS, IN_GENERAL = 0.95, 0.5
#: Episodes that an orbit is first given to settle, and that its exponent is taken over.
_SETTLE, _EXPONENT = 100, 160

Kind = Literal["alone in turns", "mirrored", "the same", "together", "longer", "none found"]


class Quake(NamedTuple):
    """One episode: D before and after, how many blocks slipped, and how long until the next one begins."""

    before: float
    after: float
    size: int
    wait: float


@dataclass(frozen=True)
class Pair:
    """Two blocks; the frictions of the second are `unequal` times those of the first."""

    coupling: float
    drop: float
    speed: float
    unequal: float = 1.0

    @cached_property
    def system(self) -> sim.System:
        k, friction = self.coupling, np.array([1.0, self.unequal])
        stiffness = [[1 + k, -k], [-k, 1 + k]]
        return sim.System(stiffness, 0.0, friction, -self.speed, static=(1 + self.drop) * friction)

    @property
    def widest(self) -> float:
        """The largest |D| at which both blocks can stick."""
        return 2 * (1 + self.drop) / (1 + 2 * self.coupling)

    def next(self, difference: float) -> Quake:
        """The episode that follows on a difference D."""
        system = self.system
        z = 0.5 * difference * np.array([1.0, -1.0])
        z += self.speed - (system.static + system.stiffness @ z).min()  # one leaves after a unit of time
        run = partial(sim.simulate, system, z, -self.speed, tol=TOL, stop_early=False)
        run_on = run(_EPISODE)
        (start, end), *later = spans(run_on.events)
        if later or run_on.n_stick(_EPISODE) < 2:  # the next one has begun
            run_on = run(end)
        wait = (system.static + system.stiffness @ run_on.z).min() / self.speed - (end - run_on.t_end)
        size = len(np.unique(run_on.events.block))
        return Quake(difference, float(run_on.z[0] - run_on.z[1]), size, float(end - start + wait))

    def orbit(self, difference: float) -> Iterator[Quake]:
        while True:
            yield (quake := self.next(difference))
            difference = quake.after

    def slope(self, difference: float) -> float:
        """dD'/dD."""
        return cycles.slope(lambda x: self.next(x).after, difference, _WIDTH * self.drop)


@dataclass(frozen=True)
class Together:
    """The homogeneous cycle of a pair: dD'/dD at D = 0, and that of the closed form (`multiplier`)."""

    coupling: float
    multiplier: float
    closed: float


@dataclass(frozen=True)
class End:
    """The cycle that a start ends in: a row of the table `ends`.

    `share` is |D| at the start, over the largest at which both stick; `difference` the largest |D| of the cycle, over
    the drop. `n_cycle` episodes in `period`, the
    blocks that slip in each `sizes`. `multiplier` is that of the map of D over the cycle. `survives`: whether the
    cycle of as many episodes and blocks is there when the friction of one block is a little larger; null where that
    was not tried.
    """

    coupling: float
    share: float
    kind: Kind
    n_cycle: int | None = None
    difference: float | None = None
    sizes: str | None = None
    period: float | None = None
    multiplier: float | None = None
    survives: bool | None = None


@dataclass(frozen=True)
class Unequal:
    """Blocks of unequal friction: the cycle found, or the mean of log |dD'/dD| with its interval."""

    coupling: float
    n_cycle: int | None
    exponent: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Measured:
    """All that the chart is made of."""

    homogeneous: list[Together]
    ends: list[End]
    unequal: list[Unequal]


class TwoBlocksScene(ChartScene):
    """A scene with ``chart = "two_blocks"``; dimensionless, leaf springs and kinetic friction are one."""

    chart: Literal["two_blocks"] = Field(description="kind of the chart", examples=["two_blocks"])
    title: str = Field(default="Two blocks, static and dynamic friction", description="one line for the head")
    pairs: Count = Field(default=300, description="number of random pairs, each from a random start")
    coupling: PositiveNumbers = Field(
        min_length=2,
        max_length=2,
        default=(0.1, 10.0),
        description="least and largest coupling spring, uniform in its logarithm",
    )
    drop: Positive = Field(default=0.3, description="static less kinetic friction")
    belt_speed: Positive = Field(default=1e-4, description="speed of the belt")
    episodes: Annotated[int, Field(ge=10)] = Field(
        default=150, description="episodes after which a cycle has to be found"
    )
    asymmetry: Positive = Field(default=0.01, description="share by which one friction is raised")
    tried: Count = Field(default=100, description="number of cycles tried with that asymmetry")
    unequal: Annotated[float, Field(gt=1)] = Field(
        default=2.25, description="ratio of the frictions of unequal blocks"
    )
    unequal_pairs: Count = Field(default=30, description="number of unequal pairs")

    def extent(self) -> str:
        return f"{self.pairs} random pairs of blocks, {self.unequal_pairs} of unequal blocks"

    def measure(self, say: Say) -> Measured:
        rng = np.random.default_rng(self.seed)
        low, high = np.log(self.coupling)
        pairs = [self.pair(float(np.exp(rng.uniform(low, high)))) for _ in range(self.pairs)]
        starts = [float(pair.widest * rng.uniform(-1, 1)) for pair in pairs]
        together = [homogeneous(pair) for pair in pairs]
        say(f"{len(together)} homogeneous cycles")
        ends: list[End] = []
        for k, (pair, start) in enumerate(zip(pairs, starts, strict=True), start=1):
            ends.append(end(pair, start, self.episodes, self.asymmetry if k <= self.tried else None))
            if k % 50 == 0 or k == len(pairs):
                say(f"{k} of {len(pairs)} starts")
        unequal = [
            chaos(self.pair(float(np.exp(rng.uniform(low, high))), self.unequal), float(rng.uniform(-1, 1)))
            for _ in range(self.unequal_pairs)
        ]
        return Measured(together, ends, unequal)

    def pair(self, coupling: float, unequal: float = 1.0) -> Pair:
        return Pair(coupling, self.drop, self.belt_speed, unequal)

    def show(self, measured: Measured) -> Shown:
        """Tables: `claims`, `ends`, `homogeneous`, `unequal`."""
        claims = judged(_CLAIMS, measured)
        tables = {"claims": table(claims)} | frames(measured, "ends", "homogeneous", "unequal")
        figures = {"two_blocks": partial(draw, self, measured)}
        return Shown({"claims": claims, "kinds": kinds(measured)}, tables, figures)


# ---------------------------------------------------------------------------------------------- measuring


def multiplier(coupling: float, drop: float, speed: float) -> float:
    """dD'/dD of two blocks that go together, for a slow belt: (drop / speed) omega |sin(pi omega)|.

    With omega = sqrt(1 + 2 k), the frequency of their difference. A block that is ahead by D slips for a time of
    (1 + 2 k) D / speed before the belt has the other slip too. By then it has drop times that as its velocity, and
    the difference swings on at omega for a time of pi. It is 0 at k = (m^2 - 1) / 2, m = 2, 3, ...
    """
    omega = np.sqrt(1 + 2 * coupling)
    return float(drop / speed * omega * abs(np.sin(np.pi * omega)))


def homogeneous(pair: Pair) -> Together:
    """Where the belt, not the block that leaves first, takes the other one along: there D' is linear in D."""
    small = 0.01 * pair.speed**2 / (pair.coupling * pair.drop * (1 + 2 * pair.coupling))
    closed = multiplier(pair.coupling, pair.drop, pair.speed)
    return Together(pair.coupling, abs(pair.next(small).after) / small, closed)


def end(pair: Pair, start: float, episodes: int, asymmetry: float | None = None) -> End:
    """The cycle in which a start ends, its stability, and whether it survives an asymmetry."""
    cycle = _cycle(pair, start, episodes)
    share = abs(start) / pair.widest
    if cycle is None:
        return End(pair.coupling, share, "none found")
    n = len(cycle)
    differences, sizes = [quake.before for quake in cycle], sorted(quake.size for quake in cycle)
    slopes = [pair.slope(difference) for difference in differences]
    survives = None
    if asymmetry is not None:
        perturbed = _cycle(replace(pair, unequal=1 + asymmetry), differences[0], 4 * _LONGEST)
        survives = perturbed is not None and sorted(quake.size for quake in perturbed) == sizes
    return End(
        pair.coupling, share, _kind(differences, sizes, pair.drop), n, max(map(abs, differences)) / pair.drop,
        ", ".join(map(str, sizes)), sum(quake.wait for quake in cycle), abs(float(np.prod(slopes))), survives,
    )  # fmt: skip


def _cycle(pair: Pair, start: float, episodes: int) -> list[Quake] | None:
    """The episodes of the cycle in which a start ends; None if it has reached none by then."""
    orbit: list[Quake] = []
    for quake in islice(pair.orbit(start), episodes):
        orbit.append(quake)
        points = [[episode.before, episode.size * pair.drop] for episode in orbit]
        n = cycles.period(points, _SAME * pair.drop, _LONGEST)
        if n is not None:
            return orbit[-n:]
    return None


def _kind(differences: list[float], sizes: list[int], drop: float) -> Kind:
    if max(map(abs, differences)) < _ALIKE * drop:
        return "together"
    if len(differences) == 1:
        return "the same"
    if sizes == [1, 1]:
        return "alone in turns"
    return "mirrored" if sizes == [2, 2] else "longer"


def chaos(pair: Pair, start: float) -> Unequal:
    """The exponent of an orbit over its steps after it settled, if it is in no cycle."""
    orbit = list(islice(pair.orbit(start * pair.widest / pair.unequal), _SETTLE + _EXPONENT))
    n = cycles.period([quake.before for quake in orbit], _SAME * pair.drop, _LONGEST)
    if n is not None:
        return Unequal(pair.coupling, n)
    sums = np.array([[np.log(max(abs(pair.slope(quake.before)), 1e-12)), 1.0] for quake in orbit[_SETTLE:]])
    mean = over_matrices(ratio, sums.reshape(-1, 8, 2).sum(axis=1), CONFIDENCE)
    return Unequal(pair.coupling, None, mean.value, mean.low, mean.high)


# ---------------------------------------------------------------------------------------------- claims


def unstable(measured: Measured) -> Claim:
    rows = measured.homogeneous
    claim = share(sum(row.multiplier > 1 for row in rows), len(rows))
    return claim | {
        "verdict": told(claim["low"], claim["high"], ALMOST_ALWAYS),
        "off": float(np.median([abs(row.multiplier / row.closed - 1) for row in rows])),
        "least": min(row.multiplier for row in rows),
    }


def no_smoothing(measured: Measured) -> Claim:
    claim = share(sum(end.kind not in ("together", "none found") for end in measured.ends), len(measured.ends))
    return claim | {"verdict": told(claim["low"], claim["high"], IN_GENERAL)}


def two_cycles(measured: Measured) -> Claim:
    """One episode again and again, or two in turns, and both are there."""
    counted = Counter(end.n_cycle for end in measured.ends if end.kind != "together")
    claim = share(counted[1] + counted[2], len(measured.ends))
    shares = [share(counted[n], len(measured.ends)) for n in (2, 1)]
    verdicts = [told(claim["low"], claim["high"], ALMOST_ALWAYS)]
    verdicts += [told(part["low"], part["high"], np.nextafter(0, 1)) for part in shares]
    return claim | {"verdict": every(verdicts), "each": shares}


def structurally_unstable(measured: Measured) -> Claim:
    """One kind of cycle is gone with the symmetry; the others mostly stay."""
    tried = [end for end in measured.ends if end.survives is not None]
    turns = [end for end in tried if end.kind == "alone in turns"]
    rests = [end for end in tried if end.kind != "alone in turns"]
    gone = share(sum(not end.survives for end in turns), len(turns))
    stay = share(sum(bool(end.survives) for end in rests), len(rests))
    distances = [abs(end.multiplier - 1) for end in measured.ends if end.kind == "alone in turns" and end.multiplier]
    return gone | {
        "verdict": every([told(gone["low"], gone["high"], IN_GENERAL), told(stay["low"], stay["high"], IN_GENERAL)]),
        "stay": stay,
        "apart": max(distances, default=None),
    }


def only_cycles(measured: Measured) -> Claim:
    claim = share(sum(end.n_cycle is not None for end in measured.ends), len(measured.ends))
    return claim | {"verdict": told(claim["low"], claim["high"], ALMOST_ALWAYS)}


def chaos_if_unequal(measured: Measured) -> Claim:
    """For some couplings a positive exponent, for others a cycle."""
    chaotic = [pair for pair in measured.unequal if pair.low is not None and pair.low > 0]
    claim = share(len(chaotic), len(measured.unequal))
    periodic = share(sum(pair.n_cycle is not None for pair in measured.unequal), len(measured.unequal))
    positive = np.nextafter(0, 1)
    return claim | {
        "verdict": every([told(part["low"], part["high"], positive) for part in (claim, periodic)]),
        "periodic": periodic,
        "exponents": [pair.exponent for pair in chaotic],
    }


_CLAIMS = (unstable, no_smoothing, two_cycles, structurally_unstable, only_cycles, chaos_if_unequal)


def kinds(measured: Measured) -> list[dict[str, Any]]:
    """For each kind of cycle: the number of starts that end in it, their multipliers and couplings."""
    rows = []
    for kind, _ in Counter(end.kind for end in measured.ends).most_common():
        ends = [end for end in measured.ends if end.kind == kind]
        slopes = [end.multiplier for end in ends if end.multiplier is not None]
        rows.append(
            {
                "kind": kind,
                **share(len(ends), len(measured.ends)),
                "least": min(slopes, default=None),
                "most": max(slopes, default=None),
                "first": min(end.coupling for end in ends),
                "last": max(end.coupling for end in ends),
            }
        )
    return rows


@panel(3.2, WIDTH, ncols=2)
def draw(axes: Sequence[Axes], scene: TwoBlocksScene, measured: Measured) -> None:
    """The multiplier of the homogeneous cycle over the coupling, and where each start ends."""
    ax_cycle, ax_ends = axes
    k = np.geomspace(scene.coupling[0], scene.coupling[1], 2000)
    closed = [multiplier(coupling, scene.drop, scene.belt_speed) for coupling in k]
    ax_cycle.loglog(k, closed, color=GREY, linewidth=0.8, label="closed form")
    points = np.array([(cycle.coupling, cycle.multiplier) for cycle in measured.homogeneous])
    ax_cycle.loglog(*points.T, ".", color=CYCLE[0], markersize=3, label="exact engine")
    ax_cycle.axhline(1.0, color="black", linewidth=0.8, linestyle="--", label="stable below")
    ax_cycle.set(title="(a) both blocks together: |dD′/dD|", xlabel="coupling k", ylim=(0.3, None))
    ax_cycle.legend(loc="lower left", fontsize=7)
    for colour, row in zip(CYCLE, kinds(measured), strict=False):
        points = np.array([(end.coupling, end.share) for end in measured.ends if end.kind == row["kind"]])
        ax_ends.semilogx(*points.T, "o", color=colour, markersize=3, label=row["kind"])
    ax_ends.set(title="(b) where each start ends", xlabel="coupling k", ylabel="|D| at the start, over the largest")
    legend([ax_ends], 4)
