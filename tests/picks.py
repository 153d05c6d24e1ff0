"""Which method the exact engine picks, and which is the fastest: `python -m tests.picks [SECONDS [N ...]]`.

A cell is a number of blocks, damped as in the paper or lightly, the length of a run, a share of the entries of K,
kinetic friction alone or a static one above it, and a tolerance. Every method runs it in turn; of each the least
processor time counts. A line has the pick for K as a dense and as a sparse array: its time over that of the fastest,
and over that of the fastest that leaves no larger an error of the state, at whichever tolerance; and its error.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from itertools import product
from unittest import mock

import numpy as np
from scipy.sparse import csc_array

from stickslip.sim import Run, System, draw_system, simulate
from stickslip.sim.engines.coulomb.settings import Coulomb
from tests.independent import Floats

TOLS = tuple(10.0**-k for k in range(3, 11))
#: By name: whether K is a sparse array, and whether runs are by waves.
METHODS = {"series": (False, False), "local": (True, False), "waves": (False, True), "rows": (True, True)}
#: A method that took so many times as long as the fastest is not asked for the next tolerance.
HOPELESS = 8.0
#: Seconds of a run that is not repeated.
LONG = 1.0


@dataclass
class Timing:
    seconds: float = np.inf
    error: float = 0.0


@dataclass
class Problem:
    n: int
    t_end: float
    share: float
    static: float
    is_light: bool = False
    table: dict[tuple[str, float], Timing] = field(default_factory=dict)  #: by method and tolerance

    def __post_init__(self) -> None:
        n, rng = self.n, np.random.default_rng([self.n, round(1e4 * self.share), round(10 * self.static)])
        drawn = draw_system("antisymmetric", n, n, kappa=0.2 * np.sqrt(200 / n / self.share))
        upper = np.triu(rng.random((n, n)) < self.share, 1)
        coupling, ground = np.where(upper | upper.T, drawn.stiffness, 0.0), np.diag(rng.uniform(0.0, 0.2, n))
        dense = drawn.changed(stiffness=coupling + ground, static=self.static)
        if self.is_light:
            springs = 3.0 * np.abs(coupling) / np.abs(coupling).sum(axis=1).mean()
            stiffness = np.diag(springs.sum(axis=1)) - springs + ground
            dense = dense.changed(stiffness=stiffness, damping=0.3)
        self.systems = dense, dense.changed(stiffness=csc_array(dense.stiffness))
        z, w = rng.normal(size=(2, n))
        self.start: tuple[Floats, Floats] = z, np.where(rng.random(n) < 0.5, -0.2, w)

    def run(self, method: str, tol: float) -> Run:
        is_sparse, is_by_waves = METHODS[method]
        with (
            mock.patch.object(Coulomb, "is_by_waves", return_value=is_by_waves),
            mock.patch.object(Coulomb, "is_sparse", return_value=is_sparse),
        ):
            return simulate(self.systems[is_sparse], *self.start, self.t_end, tol=tol, stop_early=False)

    def pick(self, system: System, tol: float) -> str:
        engine = Coulomb(tol=tol)
        is_by_waves = engine.is_by_waves(system, self.t_end)
        how = engine.is_sparse(system, is_by_waves), is_by_waves
        return next(name for name, method in METHODS.items() if method == how)

    def measure(self, seconds: float) -> None:
        exact, names = self.run("series", 1e-13), set(METHODS)
        for tol in TOLS:
            picks = {self.pick(system, tol) for system in self.systems}
            timings = {name: Timing() for name in METHODS if name in names | picks}
            until = time.perf_counter() + seconds
            while True:
                for name, timing in timings.items():
                    if timing.seconds > LONG and timing.seconds < np.inf:
                        continue
                    start = time.thread_time()
                    run = self.run(name, tol)
                    timing.seconds = min(timing.seconds, time.thread_time() - start)
                    timing.error = max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max())
                least = min(timing.seconds for timing in timings.values())
                if time.perf_counter() > until or least > LONG:
                    break
            names = {name for name, timing in timings.items() if timing.seconds < HOPELESS * least}
            self.table |= {(name, tol): timing for name, timing in timings.items()}

    def show(self) -> float:
        """Print the lines; returns the worst of the ratios at the same tolerance."""
        worst = 0.0
        for tol in TOLS:
            rivals = {name: timing for (name, at), timing in self.table.items() if at == tol}
            best = min(rivals, key=lambda name: rivals[name].seconds)
            damped = "light" if self.is_light else ""
            line = f"{self.n:5} {damped:5} {self.t_end:5g} {self.share:6.3f} {self.static:4.1f} {tol:6.0e}"
            line += f"  {best:6} {1e3 * rivals[best].seconds:9.3f} ms"
            for system in self.systems:
                name = self.pick(system, tol)
                pick = rivals[name]
                by_error = min(timing.seconds for timing in self.table.values() if timing.error <= pick.error)
                ratio = pick.seconds / rivals[best].seconds
                worst = max(worst, ratio)
                line += f"  {name:6} {ratio:5.2f} {pick.seconds / by_error:5.2f} {pick.error:7.0e}"
            print(line, flush=True)
        return worst


def main(seconds: float, sizes: list[int]) -> None:
    print("    n  damped     t  share stat    tol  fastest            dense: by tol, by error     sparse")
    first, worst = Problem(64, 0.1, 1.0, 1.0), {}
    for name in METHODS:  # it compiles
        first.run(name, 1e-3)
    for n in sizes:
        shares = sorted({share for share in (3 / n, 8 / n, 0.01, 0.1, 0.3, 1.0) if share >= 3 / n})
        for is_light, t_end, share, static in product((False, True), (1.0, 10.0, 100.0), shares, (1.0, 1.3)):
            if n * t_end <= (20_000 if share == 1.0 else 40_000):
                problem = Problem(n, t_end, share, static, is_light)
                problem.measure(seconds)
                worst[n, is_light, t_end, share, static] = problem.show()
    print("worst", max(worst.values()), max(worst, key=worst.__getitem__))


if __name__ == "__main__":
    numbers = [float(word) for word in sys.argv[1:]]
    main(numbers[0] if numbers else 0.2, [int(n) for n in numbers[1:]] or [20, 50, 64, 100, 200, 400, 1000, 2000])
