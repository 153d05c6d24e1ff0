"""What each piece of `sim` buys that is there for speed alone: `python -m tests.pieces [SECONDS [WORD ...]]`.

A piece is taken out of a copy, which runs in turn with the whole, each in a process of its own; of each case the
least processor time counts. A line has the case, the time, how many times as long a run takes without the piece, and
the error of z with it and without. Words choose pieces.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from stickslip.sim import Harmonic, System, draw_system, simulate

STEP, PRODUCTS, LANES = "engines/waveform/step.py", "numerics/products.py", "numerics/lanes.py"
#: By name: its kinds of cases, and by file what is put for which text.
PIECES: dict[str, tuple[str, list[tuple[str, str, str]]]] = {
    "products of changed blocks alone": ("waves", [(STEP, "if iteration == 0 else 0", "if iteration < 0 else 0")]),
    "the expected contraction": ("waves smooth", [(STEP, "= iteration > 0 and", "= iteration < 0 and")]),
    "faster contraction": ("waves", [(STEP, "else limits.FASTER", "else 1.0")]),
    "single precision": ("waves smooth", [(STEP, "may_add = len(", "may_add = control.safety < 0.0 and len(")]),
    "sums in groups": ("waves", [("numerics/panels.py", "SUMMED = 128", "SUMMED = 2**40")]),
    "lanes": ("waves smooth", [(LANES, "NARROW = 4", "NARROW = 1"), (LANES, "WIDTH = 8 if", "WIDTH = 1 if")]),
    "wide lanes": ("waves smooth", [(LANES, "WIDTH = 8 if", "WIDTH = 4 if")]),
    "repeated substeps": ("smooth", [("engines/waveform/substeps.py", "i, work.begins[i], -1", "i, -1, -1")]),
    "events carried over": ("series", [("engines/coulomb/step.py", "len(z) >= control.CARRIED", "len(z) < 0")]),
    "events passed on": ("series", [("engines/coulomb/taylor.py", "if k != 3 or", "if k != -3 or")]),
    "float32 in series": ("series", [(PRODUCTS, "if _may_be_single(row_sums[0]):", "if False:")]),
    "moving blocks alone": ("series", [(PRODUCTS, "if x[j] != 0.0 or u[j] != 0.0:", "if True:")]),
    "eight columns at once": ("series", [(PRODUCTS, "eights = m - m % 8", "eights = 0")]),
}  # fmt: skip
#: Their kinds, systems, numbers of blocks and tolerances.
CASES = [
    ("series", "dense", 20, 1e-5), ("waves", "dense", 200, 1e-5), ("series", "dense", 200, 1e-10),
    ("series", "dense", 400, 1e-12), ("waves", "dense", 1000, 1e-5), ("waves", "dense", 1000, 1e-10),
    ("waves", "rows", 1000, 1e-5), ("series", "forced", 200, 1e-5), ("series", "damped", 100, 1e-10),
    ("series", "slow", 200, 1e-10), ("smooth", "one", 200, 1e-4), ("smooth", "one", 200, 1e-8),
    ("smooth", "uniform", 200, 1e-6),
]  # fmt: skip


@cache
def run_of(name: str, n: int) -> Callable[[float], Any]:
    """From a tolerance to z at t = 25."""
    rng, start = np.random.default_rng(0), (-0.7, -0.4)
    system = draw_system("antisymmetric", n, seed=0, kappa=0.2 * np.sqrt(200 / max(n, 200)))
    if name == "rows":
        kept = np.triu(rng.random((n, n)) < 10 / n, 1)
        system = system.changed(stiffness=csc_array(system.stiffness * (kept | kept.T) * np.sqrt(n / 10)))
    if name == "slow":
        springs = np.triu(rng.uniform(0.0, 4.0 / n, (n, n)), 1)
        stiffness = np.diag((springs + springs.T).sum(axis=1) + 0.1) - springs - springs.T
        system, start = System(stiffness, 0.5, 1.0, -0.02, static=1.3), rng.normal(size=(2, n))
    if name == "forced":
        system = system.changed(force=Harmonic(0.3, 0.7))
    if name == "damped":
        system = system.changed(damping=np.eye(n) + 0.1 / np.sqrt(n) * rng.normal(size=(n, n)))
    if name in ("one", "uniform"):
        law = {"engine": "sigmoid", "eps": 0.03, "ratio": 1.0 - rng.random(n) if name == "uniform" else 1.0}
        return lambda tol: simulate(system, *start, 25.0, rtol=tol, atol=tol, **law).z
    return lambda tol: simulate(system, *start, 25.0, tol=tol).z


def serve() -> None:
    """Answer each line of the input, a case and for how many seconds to repeat it, by the least time, and z."""
    for line in sys.stdin:
        name, n, tol, seconds = json.loads(line)
        run, least, until = run_of(name, n), np.inf, time.perf_counter() + seconds
        while least == np.inf or time.perf_counter() < until:
            start, z = time.thread_time(), run(tol)
            least = min(least, time.thread_time() - start)
        print(json.dumps([least, z.tolist()]), flush=True)


def begin(root: Path, patches: list[tuple[str, str, str]]) -> Any:
    """A process that serves runs of a copy of `sim` with these patches, until it is left."""
    here = Path(__file__).parent.parent
    shutil.copytree(here / "stickslip", root / "stickslip")
    (root / "tests").symlink_to(here / "tests")
    for name, text, instead in patches:
        content = (root / "stickslip" / "sim" / name).read_text()
        assert text in content, (name, text)
        (root / "stickslip" / "sim" / name).write_text(content.replace(text, instead))
    command = [sys.executable, "-c", "from tests.pieces import serve; serve()"]
    return subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ask(server: Any, *request: object) -> tuple[float, Any]:
    print(json.dumps(request), file=server.stdin, flush=True)
    return json.loads(server.stdout.readline())


def main(seconds: float, words: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder, begin(Path(folder, "whole"), []) as whole:
        exact = cache(lambda kind, *of: np.array(ask(whole, *of, 1e-12 if kind == "smooth" else 1e-13, 0.0)[1]))
        for piece in (piece for piece in PIECES if not words or any(word in piece for word in words)):
            print(piece, flush=True)
            kinds, patches = PIECES[piece]
            with begin(Path(folder, piece), patches) as part:
                for kind, name, n, tol in (case for case in CASES if case[0] in kinds):
                    answers = [[ask(it, name, n, tol, seconds) for it in (whole, part)] for _ in range(6)]
                    took, without = np.min([[least for least, _ in pair] for pair in answers], axis=0)
                    errors = [np.abs(np.array(z) - exact(kind, name, n)).max() for _, z in answers[0]]
                    line = f"{name:8}{n:5}{tol:7.0e}{1e3 * took:9.3f} ms{without / took:6.2f}"
                    print(f"  {line}{errors[0]:9.1e}{errors[1]:9.1e}", flush=True)


if __name__ == "__main__":
    main(float((sys.argv[1:] or ["0.1"])[0]), sys.argv[2:])
