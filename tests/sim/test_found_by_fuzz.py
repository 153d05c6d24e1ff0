"""Systems that `python -m tests.fuzz` found to fail, mended since; each is judged in every way again."""

import numpy as np
import pytest

from tests.fuzz.draw import Trial
from tests.fuzz.judge import judge
from tests.independent import Case, Ramp

TOL, SMOOTH = {"tol": 1e-10}, {"eps": 0.01, "rtol": 1e-8, "atol": 1e-8}
PULLED = Case.of([[0.3]], 0, 1.5, Ramp(np.array([1.0, 1.5]), np.array([[0.1], [1.1]])), 0, 0.1)
FOUND = {
    "garbage without damping": (Case.of([[3.0]], 0, 1, 1, 2, -1), 32.0, TOL),
    "garbage without damping, from the belt": (Case.of([[1.0]], 0, 1, 1, -1, 1), 33.0, TOL),
    "one block of two undamped": (Case.of([[0, 0], [0, 3]], [1, 0], 1, -0.5, 2, -0.5), 21.0, TOL),
    "two events at one time": (Case.of([[2.0]], 0.5, 1, 0.5, 2, 0.5), 40.0, TOL),
    "no end": (Case.of([[0.2]], 3.5, 1, -0.2, -3, -0.2), 50.0, TOL),
    # terms of exp(-|u| / speed) are small from the first, and yet grow: the step went where they were not known
    "weakening at once": (Case.of([[3.73]], 0, 1.8, 0, -3.9, 0, 1.84, falls=("exponential", 0.01)), 8.0, TOL),
    # started where it would rest without the force: drawn back to the belt, or to a rest elsewhere
    "a force draws back": (Case.of([[1.0]], 1, 1, -0.2, -1, -0.1, push=-1.5), 40.0, TOL),
    "a force moves the rest": (Case.of([[1.0]], 1, 1, -0.2, -1, -0.1, push=0.3), 40.0, TOL),
    "a smoothed rest": (Case.of([[1.0]], 1, 1, -0.2, -1, -0.1, push=0.3), 40.0, SMOOTH),
    "a threshold beyond the collapse": (Case.of([[1.0]], 3, 1, -0.2, 3, 1), 40.0,
        {"eps": 0.01, "rtol": 1e-6, "atol": 1e-6, "thresholds": [0.5, 1.9]}),
    # F jumps beyond friction: a step as long as the last from stick, carried through the layer, did not see it
    "a belt that pulls away": (PULLED, 2.0, {"eps": 3e-4, "rtol": 1e-6, "atol": 1e-6}),
    "a belt that pulls away, looser": (PULLED, 2.0, {"eps": 1e-3, "rtol": 1e-5, "atol": 1e-5}),
}  # fmt: skip


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_stays_mended(name):
    case, t_end, settings = FOUND[name]
    verdict = judge(Trial(0, 0, name, "coulomb" if "tol" in settings else "sigmoid", case, t_end, settings))
    assert verdict.failures == []
    assert verdict.worst < 20
