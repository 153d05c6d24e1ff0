"""Systems that `python -m tests.fuzz` found to fail, mended since; each is judged in every way again."""

import numpy as np
import pytest

from stickslip.sim import simulate
from tests.fuzz.draw import Trial
from tests.fuzz.judge import judge
from tests.independent import Case, Ramp
from tests.systems import made

SMOOTH = {"eps": 0.01, "rtol": 1e-8, "atol": 1e-8}
FOUND = {
    # K, R, mu, v, z0, w0, t_end
    "garbage without damping": ([[3.0]], 0, 1, 1, 2, -1, 32.0),
    "garbage without damping, from the belt": ([[1.0]], 0, 1, 1, -1, 1, 33.0),
    "one block of two undamped": ([[0, 0], [0, 3]], [1, 0], 1, -0.5, 2, -0.5, 21.0),
    "two events at one time": ([[2.0]], 0.5, 1, 0.5, 2, 0.5, 40.0),
    "no end": ([[0.2]], 3.5, 1, -0.2, -3, -0.2, 50.0),
}


@pytest.mark.parametrize("name", FOUND)
def test_exact_engine(name):
    *system, t_end = FOUND[name]
    assert judge(Trial(0, 0, name, "coulomb", Case.of(*system), t_end, {"tol": 1e-10})).failures == []


def test_threshold_beyond_the_collapse_of_the_smoothed_run():
    case = Case.of([[1.0]], 3, 1, -0.2, 3, 1)
    settings = {"eps": 0.01, "rtol": 1e-6, "atol": 1e-6, "thresholds": [0.5, 1.9]}
    assert judge(Trial(0, 0, "collapse", "sigmoid", case, 40.0, settings)).failures == []


@pytest.mark.parametrize("speed", [0.01, 0.1])
def test_friction_that_falls_within_far_less_than_the_speed_reached(speed):
    """Terms of exp(-|u| / speed) are small from the first, and yet grow: the step went where they were not known."""
    case = Case.of([[3.73]], 0, 1.8, 0, -3.9, 0, 1.84, falls=("exponential", speed))
    assert judge(Trial(0, 0, "weakening", "coulomb", case, 8.0, {"tol": 1e-10})).failures == []


@pytest.mark.parametrize(("engine", "settings"), [("coulomb", {"tol": 1e-10}), ("sigmoid", SMOOTH)])
@pytest.mark.parametrize("push", [-1.5, 0.3])
def test_a_constant_force_moves_the_rest_by_which_a_collapse_is_certain(engine, settings, push):
    """Started where it would rest without: with -1.5 it is drawn back to the belt, with 0.3 it rests elsewhere."""
    case = Case.of([[1.0]], 1, 1, -0.2, -1, -0.1, push=push)
    trial = Trial(0, 0, "collapse", engine, case, 40.0, settings)
    assert judge(trial).failures == []
    run = simulate(made(case), case.z0, case.w0, 40.0, engine=engine, stop_early="always", **settings)
    assert run.outcome == "collapsed"
    assert run.z == pytest.approx([push - 1], abs=1e-4)


@pytest.mark.parametrize(("eps", "tol"), [(3e-4, 1e-6), (1e-3, 1e-5)])
def test_a_belt_that_pulls_away_at_once(eps, tol):
    """F jumps beyond friction: a step as long as the last from stick, carried through the layer, did not see it."""
    belt = Ramp(np.array([1.0, 1.5]), np.array([[0.1], [1.1]]))
    case = Case.of([[0.3]], 0, 1.5, belt, 0, 0.1)
    verdict = judge(Trial(0, 0, "kink", "sigmoid", case, 2.0, {"eps": eps, "rtol": tol, "atol": tol}))
    assert verdict.failures == []
    assert verdict.worst < 20
