"""The estimate of ten scenes against what they took, in this process: ``python -m tests.pipeline.estimates``.

Some minutes; not part of the tests, as no test asserts on time. The interval should hold the truth nine times.
"""

from __future__ import annotations

import os
import tempfile
import time

from stickslip.pipeline.machine.processes import ONE_THREAD

os.environ.update(ONE_THREAD)  # before anything loads numpy

from stickslip.pipeline import parse_scene, run_ensemble
from stickslip.pipeline.ensemble import pack
from stickslip.pipeline.running.estimate import WITHIN, estimate
from tests.scenes import COULOMB, SIGMOID, ensemble

MOVED = """[perturbation]
sizes = [0.01, 0.1]
draws = 2
[twins]
sizes = [1e-6]
[record]
separation = 5.0
growth_rate = true
"""
#: Name, n, t_end, matrices, engines, what else.
SCENES = [
    ("very many tiny", 5, 20.0, 8000, (COULOMB,), ""),
    ("many small", 20, 200.0, 1500, (COULOMB,), ""),
    ("both engines", 100, 400.0, 50, (COULOMB, SIGMOID), ""),
    ("large, exact", 200, 1000.0, 20, (COULOMB,), ""),
    ("stiff", 200, 500.0, 10, (f'{SIGMOID}\nratio = "uniform"\nratio_draws = 2',), ""),
    ("thin layer, three n", [10, 50, 150], 300.0, 30, (f"{SIGMOID}\neps = 0.003",), ""),
    ("paths", 60, 600.0, 60, (COULOMB, SIGMOID), "[record]\nevents = true\n"),
    ("twins and moved constants", 100, 300.0, 10, (COULOMB, SIGMOID), MOVED),
    ("thresholds", 200, 300.0, 20, (f"{SIGMOID}\nthresholds = [0.5, 1.0, 2.0]",), ""),
    ("short and large", 400, 60.0, 20, (COULOMB,), ""),
]


def main() -> None:
    """Print a row a scene, with seconds of a core and megabytes."""
    n_held = 0
    for name, n, t_end, matrices, engines, rest in SCENES:
        scene = parse_scene(
            ensemble(n, t_end, matrices, *engines, rest=rest, analysis="t_burn = 0.0\ndt = 1.0").encode()
        )
        found = estimate(scene, [batch for batch, _ in pack.tasks(scene)], 1)
        with tempfile.TemporaryDirectory() as directory:
            begun = time.process_time()
            size = run_ensemble(scene, f"{directory}/out", workers=0).n_bytes
            took = time.process_time() - begun
        ratios = found.core_seconds / took, found.n_bytes / size
        n_held += all(1 / WITHIN <= ratio <= WITHIN for ratio in ratios)
        print(
            f"{name:26} {took:6.1f} s, estimated {ratios[0]:.2f} of it; {size / 1e6:6.2f} MB, {ratios[1]:.2f}",
            flush=True,
        )
    print(f"{n_held} of {len(SCENES)} within the intervals")


if __name__ == "__main__":
    main()
