"""Cycles of a map, planted."""

import numpy as np
import pytest

from stickslip.workflows.gallery.field.cycles import period, slope


@pytest.mark.parametrize("length", [1, 2, 7])
def test_a_planted_cycle_is_found_after_its_transient(length, rng):
    orbit = np.concatenate([rng.normal(size=(20, 2)), np.tile(rng.normal(size=(length, 2)), (3, 1))])
    assert period(orbit, 1e-9, 12) == length
    assert period(orbit, 1e-9, length - 1) is None
    assert period(orbit[:-1], 1e-9, 12) is None or length == 1  # it has not come round three times
    drifting = orbit + 1e-6 * np.arange(len(orbit))[:, None]
    assert period(drifting, 1e-9, 12) is None


def test_an_orbit_without_cycle_has_none():
    x = [0.3]
    for _ in range(200):
        x.append(3.9 * x[-1] * (1 - x[-1]))
    assert period(x, 1e-6, 20) is None
    assert period([], 1e-6, 20) is None


def test_the_slope_of_a_parabola():
    assert slope(lambda x: x * x - 3.0, 1.5, 1e-4) == pytest.approx(3.0, abs=1e-10)
