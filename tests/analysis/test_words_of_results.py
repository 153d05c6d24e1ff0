"""What a notebook shows of an estimate and a window: one short line with the numbers."""

import numpy as np

from stickslip.analysis import Estimate, window


def test_estimate():
    assert repr(Estimate(0.69781234, 0.69, 0.71)) == "Estimate(0.697812 (0.69 to 0.71))"
    assert repr(Estimate(2.0, reason="one matrix only")) == "Estimate(2: one matrix only)"
    assert repr(Estimate(reason="no complete cascade")) == "Estimate(no value: no complete cascade)"


def test_window():
    t = np.array([0.0, 1.0, 2.0, 3.0])
    win = window(t, np.array([5, 6, 5, 7]), 0.5, 3.5)
    assert repr(win) == "Window([0.5, 3.5], 3 changes from n_stick = 5)"
