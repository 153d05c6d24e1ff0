"""The estimate of ten scenes against the time that they took: ``python -m tests.pipeline.estimates [WORKERS]``.

A few minutes; not part of the tests, as no test asserts on time. The estimate should hold the truth nine times.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from pipeline import batches, expand, parse_scene, run_scene
from pipeline.estimate import estimate

_SCENE = """
[system]
coupling = "{coupling}"
n = {n}
[start]
z = -0.7
w = -0.4
[run]
t_end = {t_end}
matrices = {matrices}
{engines}
{rest}
[analysis]
t_burn = 0.0
dt = 1.0
"""
_EXACT = '[[engine]]\nname = "coulomb"\n'
_SMOOTH = '[[engine]]\nname = "sigmoid"\n'

#: Name, coupling, n, t_end, matrices, engines, what else.
SCENES = [
    ("many small", "antisymmetric", 20, 200.0, 1500, _EXACT, ""),
    ("both engines", "antisymmetric", 100, 400.0, 100, _EXACT + _SMOOTH, ""),
    ("large, exact", "antisymmetric", 200, 1000.0, 40, _EXACT, ""),
    ("stiff", "antisymmetric", 200, 500.0, 20, _SMOOTH + 'ratio = "uniform"\nratio_draws = 2\n', ""),
    ("thin layer, three n", "antisymmetric", [10, 50, 150], 300.0, 60, _SMOOTH + "eps = 0.003\n", ""),
    ("paths", "antisymmetric", 60, 600.0, 120, _EXACT + _SMOOTH, "[record]\nevents = true\n"),
    (
        "twins and moved constants",
        "antisymmetric",
        100,
        300.0,
        20,
        _EXACT + _SMOOTH,
        "[perturbation]\nsizes = [0.01, 0.1]\ndraws = 2\n[twins]\nsizes = [1e-6]\n"
        "[record]\nseparation = 5.0\ngrowth_rate = true\n",
    ),
    ("thresholds", "antisymmetric", 200, 300.0, 40, _SMOOTH + "thresholds = [0.5, 1.0, 2.0]\n", ""),
    ("short and large", "antisymmetric", 400, 60.0, 40, _EXACT, ""),
    ("springs", "springs", 50, 500.0, 100, _EXACT + _SMOOTH + "eps = 0.1\n", ""),
]


def measure(workers: int) -> int:
    """Print a row a scene; returns how many intervals held the truth."""
    n_held = 0
    print(f"{'scene':26} members pilot s  {'estimate s':22} took s   {'estimate MB':22}  took")
    for name, coupling, n, t_end, matrices, engines, rest in SCENES:
        text = _SCENE.format(coupling=coupling, n=n, t_end=t_end, matrices=matrices, engines=engines, rest=rest)
        scene = parse_scene(text.encode())
        found = estimate(scene, batches(expand(scene), scene.hash), workers)
        with tempfile.TemporaryDirectory() as directory:
            start = time.perf_counter()
            status = run_scene(scene, text.encode(), Path(directory) / "out", workers=workers)
            took = time.perf_counter() - start
        low, middle, high = found.seconds
        least, mean, most = (value / 1e6 for value in found.n_bytes)
        is_held = low <= took <= high
        n_held += is_held
        print(
            f"{name:26} {found.n_members:7} {found.pilot_seconds:7.1f}  "
            f"{f'{middle:.1f} ({low:.1f} to {high:.1f})':22} {took:6.1f} {'.' if is_held else '!'} "
            f"{f'{mean:.2f} ({least:.2f} to {most:.2f})':22} {status.n_bytes / 1e6:5.2f} "
            f"{'.' if least <= status.n_bytes / 1e6 <= most else '!'}",
            flush=True,
        )
    print(f"{n_held} of {len(SCENES)} within the interval of time")
    return n_held


if __name__ == "__main__":
    measure(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
