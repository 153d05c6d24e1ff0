"""The estimate of ten scenes against the time that they took: ``python -m tests.pipeline.estimates [WORKERS]``.

A few minutes; not part of the tests, as no test asserts on time. The estimate should hold the truth nine times.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from pathlib import Path

from stickslip.pipeline import Progress, Scene, parse_scene, run_ensemble, status
from stickslip.pipeline.estimate import estimate
from stickslip.pipeline.writer import Store
from tests.scenes import COULOMB, SIGMOID, ensemble

#: The scene that is run half before its estimate is asked for.
RESUMED = "large, exact"

#: Name, n, t_end, matrices, engines, what else.
SCENES = [
    ("many small", 20, 200.0, 1500, (COULOMB,), ""),
    ("both engines", 100, 400.0, 100, (COULOMB, SIGMOID), ""),
    ("large, exact", 200, 1000.0, 40, (COULOMB,), ""),
    ("stiff", 200, 500.0, 20, (f'{SIGMOID}\nratio = "uniform"\nratio_draws = 2',), ""),
    ("thin layer, three n", [10, 50, 150], 300.0, 60, (f"{SIGMOID}\neps = 0.003",), ""),
    ("paths", 60, 600.0, 120, (COULOMB, SIGMOID), "[record]\nevents = true\n"),
    (
        "twins and moved constants",
        100,
        300.0,
        20,
        (COULOMB, SIGMOID),
        "[perturbation]\nsizes = [0.01, 0.1]\ndraws = 2\n[twins]\nsizes = [1e-6]\n"
        "[record]\nseparation = 5.0\ngrowth_rate = true\n",
    ),
    ("thresholds", 200, 300.0, 40, (f"{SIGMOID}\nthresholds = [0.5, 1.0, 2.0]",), ""),
    ("short and large", 400, 60.0, 40, (COULOMB,), ""),
    ("springs", 50, 500.0, 100, (COULOMB, f"{SIGMOID}\neps = 0.1"), ""),
]


def measure(workers: int) -> int:
    """Print a row a scene; returns how many intervals held the truth."""
    n_held = 0
    print(f"{'scene':26} to go pilot s busy  {'estimate s':22} took s in  wide  {'estimate MB':22} MB    in")
    for name, n, t_end, matrices, engines, rest in SCENES:
        text = ensemble(n, t_end, matrices, *engines, rest=rest, analysis="t_burn = 0.0\ndt = 1.0")
        source = (text.replace("antisymmetric", "springs") if name == "springs" else text).encode()
        scene = parse_scene(source)
        with tempfile.TemporaryDirectory() as directory:
            out = Path(directory) / "out"
            if name == RESUMED:
                _begin(scene, source, out, workers)
            to_go = [batch for batch, _ in Store(out, scene, source).look()[1]]
            before = status(out).n_bytes if name == RESUMED else 0
            found = estimate(scene, to_go, workers)
            if found.amounts is None:
                raise RuntimeError(f"{name}: members failed: {found.failures}")
            start = time.perf_counter()
            size = (run_ensemble(scene, out, workers=workers).n_bytes - before) / 1e6
            took = time.perf_counter() - start
        low, middle, high = found.amounts.seconds
        least, mean, most = (value / 1e6 for value in found.amounts.n_bytes)
        n_held += low <= took <= high
        print(
            f"{name:26} {sum(len(batch.members) for batch in to_go):5} {found.pilot_seconds:7.1f} {found.busy:4.1f}  "
            f"{f'{middle:.1f} ({low:.1f} to {high:.1f})':22} {took:6.1f} {_mark(low, took, high)} {high / low:5.1f}  "
            f"{f'{mean:.2f} ({least:.2f} to {most:.2f})':22} {size:5.2f} {_mark(least, size, most)}",
            flush=True,
        )
    print(f"{n_held} of {len(SCENES)} within the interval of time")
    return n_held


def _mark(low: float, value: float, high: float) -> str:
    return "yes" if low <= value <= high else "NO "


def _begin(scene: Scene, source: bytes, out: Path, workers: int) -> None:
    """Run about half of a scene."""

    def stop(progress: Progress) -> None:
        if progress.n_done > progress.n_members / 2:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        run_ensemble(scene, out, workers=workers, on_progress=stop)


if __name__ == "__main__":
    measure(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
