"""Kernels that are run as Python, as a debugger and coverage see them, find what compiled ones find."""

import json
import os
import pickle
import subprocess
import sys
from unittest.mock import patch

import numpy as np
import pytest

from stickslip.pipeline.dataset.program import program
from stickslip.sim import Curve, Harmonic, Rational, Table, draw_system, simulate
from stickslip.sim.engines.coulomb import settings as coulomb
from tests.processes import python
from tests.scenes import ensemble

SIGMOID = {"engine": "sigmoid", "eps": 0.03, "rtol": 1e-5, "atol": 1e-7}
DRAWN = draw_system("antisymmetric", n=6, seed=0)
#: What is run: a system, its last time and the settings of an engine; each takes kernels of its own.
RUNS = {
    "series": (DRAWN, 10.0, {"tol": 1e-10}),
    "sparse series": (draw_system("chain", n=40, seed=0), 5.0, {"tol": 1e-5}),
    "waves": (draw_system("antisymmetric", n=66, seed=0), 1.0, {"tol": 1e-5}),
    "weakening": (DRAWN.changed(static=1.4, weakening=Rational(2.0)), 10.0, {"tol": 1e-5}),
    "a table": (DRAWN.changed(weakening=Table([0.0, 0.1, 0.3, 1.0], [1.0, 0.8, 0.7, 0.9])), 10.0, {"tol": 1e-5}),
    "sigmoid": (DRAWN.changed(force=Harmonic(amplitude=0.3, frequency=1.0)), 10.0, SIGMOID),
    "sigmoid and a function": (DRAWN.changed(weakening=Curve(lambda u: 0.7 + 0.3 * np.exp(-3.0 * u))), 5.0, SIGMOID),
    "sigmoid with a peak": (DRAWN.changed(static=1.4), 5.0, SIGMOID),
    "full damping": (DRAWN.changed(damping=0.3 * np.eye(6) + 0.05 * np.eye(6, k=1)), 5.0, SIGMOID),
    "moreau": (DRAWN, 5.0, {"engine": "moreau", "step": 1e-2}),
}


def result(name):
    system, t_end, settings = RUNS[name]
    as_stored = staticmethod(lambda system, _: not isinstance(system.stiffness, np.ndarray))
    with patch.object(coulomb, "SHORT", 0.0), patch.object(coulomb.Coulomb, "is_sparse", as_stored):
        run = simulate(system, -0.7, -0.4, t_end, **settings)
    return run.stats, run.events.block, run.events.mode, run.events.t, run.z, run.w


@pytest.fixture(scope="module")
def as_python():
    """The same by kernels that are not compiled, in a process of their own."""
    code = (
        "import pickle, sys; from tests.sim.test_without_compiler import RUNS, result;"
        "sys.stdout.buffer.write(pickle.dumps({name: result(name) for name in RUNS}))"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return pickle.loads(done.stdout)


@pytest.mark.parametrize("name", RUNS)
def test_a_run_is_the_same_without_a_compiler(name, as_python):
    """Steps and events to the last; times and state but for rounding, as machine code fuses products and sums.

    That of waves is of products in single precision: a hundredth of their tolerance.
    """
    stats, block, mode, *numbers = result(name)
    assert as_python[name][0] == stats
    np.testing.assert_array_equal(as_python[name][1], block)
    np.testing.assert_array_equal(as_python[name][2], mode)
    for found, expected in zip(as_python[name][3:], numbers, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 if name == "waves" else 1e-9)


def test_a_scene_is_run_without_a_compiler(tmp_path):
    """By the command, whose worker inherits the environment; its rows are not mixed with others unsaid."""
    (tmp_path / "small.toml").write_text(ensemble(2, 2.0, 1))
    words = ["-m", "stickslip", "run", "small.toml", "--workers", "1", "--no-report"]
    done = python(*words, cwd=tmp_path, env=os.environ | {"NUMBA_DISABLE_JIT": "1"})
    assert done.returncode == 0, done.stderr
    (manifest,) = tmp_path.rglob("manifest.json")
    assert json.loads(manifest.read_text())["programs"] == [f"{program()}-not-compiled"]
