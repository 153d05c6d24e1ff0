"""Attractors along a key, up and down: where steady sliding ends is known in closed form."""

import numpy as np
import pytest

from stickslip.sim import Harmonic, Stribeck, System
from stickslip.sim.attractors.continuation import _time_of_phase, continued

OSCILLATOR = System([[1.0]], 0.1, 0.5, 1.5, static=1.0, weakening=Stribeck(0.5))
#: Steady sliding is stable while damping outweighs the fall of friction: R > exp(-v / 0.5).
LEAST = 0.5 * np.log(1 / 0.1)


def along(speeds, **start):
    fates = continued([OSCILLATOR.changed(belt_speed=float(v)) for v in speeds], **start, t_end=1500.0, t_burn=1000.0)
    return [one.kind for one in fates]


def test_steady_sliding_and_the_cycle_both_last_in_between():
    """Down, sliding lasts to the closed-form bound; up, the cycle lasts far beyond it, and then all slide."""
    speeds = np.arange(0.9, 2.05, 0.2)
    assert abs(speeds - LEAST).min() > 0.03
    down = along(speeds[::-1], z0=0.0, w0=0.0)[::-1]
    assert down == ["sliding" if v > LEAST else "periodic" for v in speeds]
    up = along(speeds, z0=1.0, w0=0.0)
    n_cycles = up.count("periodic")
    assert up == ["periodic"] * n_cycles + ["sliding"] * (len(up) - n_cycles)
    assert 1.6 < speeds[n_cycles - 1] < 1.95  # a sweep of random starts has cycles to 1.8, and none at 1.9


def test_a_block_ahead_of_a_slower_belt_that_bars_it_takes_its_speed():
    """An undamped block that swings at 0.9 of its belt's speed and more, on belts that are slower each time."""
    belts = np.linspace(1.0, 0.3, 8)
    systems = [System([[1.0]], 0.0, 0.5, v, back_slip=False) for v in belts]
    for z0 in (0.5, -0.4, 0.2):
        fates = continued(systems, z0, 0.9, t_end=50.3, t_burn=10.0)
        assert len(fates) == len(systems)


def test_a_force_goes_on_from_its_phase():
    """The same system again and again, and with a force whose phase is given in another way, keeps its cycle.

    Of the state at the end of a run, with the force begun anew, a cycle of twice the period is what attracts.
    """
    force = Harmonic(-0.814, 1.6954, 1.792)
    system = System([[1.762]], 0.219, 1.216, -0.07, static=1.634, force=force)
    turned = system.changed(force=Harmonic(0.814, 1.6954, 1.792 - np.pi + 1.0))
    fates = continued([system, system, turned, system, system], 0.103, -0.07, t_end=1000.0, t_burn=500.0)
    assert [one.period for one in fates] == pytest.approx([2 * np.pi / 1.6954] * 5, rel=1e-9)


def test_the_time_at_which_forces_are_like_others(rng):
    """Of one frequency each, whatever they are: the cosines are the same then, and go on from there."""
    one = System([[1.0]], 0.1)
    for _ in range(20):
        (f, phase), (f_before, phase_before) = rng.uniform([-3, -9], [3, 9], (2, 2)).tolist()
        sign, t = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 1e3)
        before = one.changed(force=Harmonic(2.0 * sign, f_before, phase_before))
        new = _time_of_phase(one.changed(force=Harmonic(sign, f, phase)), before, t)
        assert 0.0 <= new < 2 * np.pi / abs(f)
        assert np.cos(f * new + phase) == pytest.approx(np.cos(f_before * t + phase_before), abs=1e-10)
        turns = np.sin(f * new + phase) * f, np.sin(f_before * t + phase_before) * f_before
        assert np.sign(turns[0]) == np.sign(turns[1])


@pytest.mark.parametrize(
    ("systems", "settings", "words"),
    [
        ([OSCILLATOR, System(np.eye(2), 0.1)], {}, "systems: expected 1 blocks in each, as in the first, got 2"),
        ([OSCILLATOR], {"engine": "sigmoid", "eps": 0.03}, "engine"),
    ],
)
def test_what_does_not_fit_is_refused(systems, settings, words):
    with pytest.raises(ValueError, match=words):
        continued(systems, 0.0, 0.0, 10.0, **settings)


def test_after_an_escape_it_starts_afresh():
    stable, unstable = System([[1.0]], 0.1, 0.1, -0.2), System([[1.0]], -0.2, 0.1, 0.0)
    fates = continued([unstable, stable], 3.0, 0.0, 500.0)
    assert [one.kind for one in fates] == ["escaping", "sliding"]
