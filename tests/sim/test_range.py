"""Numbers of any size: the exact engine follows them within float64, or names those that it cannot."""

import numpy as np
import pytest

from stickslip.sim import IntegrationError, System, simulate
from stickslip.sim.engines import several

#: Where blocks may slip throughout, an end far away is warned of.
pytestmark = pytest.mark.filterwarnings("ignore:system. damping up to .* allow steps of:RuntimeWarning")

STIFFNESS, Z, W = np.array([[2.0, -1.0], [-1.0, 1.5]]), np.array([3.0, -1.0]), np.array([0.5, 1.0])


def follow(length=1.0, time=1.0):
    """Two blocks in other units of length and time: the state at t = 20, in the units of the first, and the modes."""
    unit = length / time
    system = System(STIFFNESS / time / time, 0.1 / time, unit / time, -0.2 * unit)
    run = simulate(system, Z * length, W * unit, 20.0 * time, stop_early=False)
    return run.z / length, run.w / unit, run.events.mode.tolist()


@pytest.mark.parametrize(("length", "time"), [(1e-250, 1.0), (1e250, 1.0), (1.0, 1e-60), (1.0, 1e23), (1e100, 1e15)])
def test_a_motion_is_the_same_in_any_units(length, time):
    z, w, modes = follow()
    other_z, other_w, other_modes = follow(length, time)
    assert other_modes == modes
    np.testing.assert_allclose(other_z, z, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other_w, w, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("length", "time", "words"),
    [
        (1.0, 1e60, "system: expected rates of at least 1e-24, got .*; take other units, as System.from_physical"),
        (1e-290, 1.0, "system: expected friction of at least 1e-280, or none, got 1e-290"),
    ],
)
def test_numbers_that_leave_float64_are_named(length, time, words):
    with pytest.raises(ValueError, match=words):
        follow(length, time)


def test_a_start_that_leaves_float64_is_told_in_one_line():
    with pytest.raises(IntegrationError, match="numbers of this size leave float64; scale the system"):
        simulate(System(STIFFNESS, 0.1), 1e308, 0.0, 20.0)


def test_a_spring_too_weak_to_matter_is_none():
    weak, none = (simulate(System([[k]], 0.0, 1.0, -0.2), 3.0, 1.0, 5.0) for k in (1e-100, 0.0))
    assert weak.z == pytest.approx(none.z, rel=1e-14)
    assert weak.events.mode.tolist() == none.events.mode.tolist()


@pytest.mark.parametrize("t_end", [1e6, 1.7e308])
@pytest.mark.parametrize(("belt_speed", "damping"), [(0.0, 0.0), (0.0, 0.1), (-0.2, 0.1)])
def test_what_is_held_or_slides_steadily_ends_at_once_however_far_the_end(belt_speed, damping, t_end):
    """Under a belt at rest friction stops all; under one that moves, damping brings all to slide steadily."""
    system = System(STIFFNESS, damping, 1.0, belt_speed)
    near = simulate(system, Z, W, 1e3)
    run = simulate(system, Z, W, t_end)
    assert (run.outcome, run.t_end) == ("collapsed" if belt_speed else "finished", t_end)
    assert run.stats.n_steps < 1000
    assert run.z == pytest.approx(near.z, abs=1e-8)
    assert run.events.t.tolist() == pytest.approx(near.events.t.tolist(), abs=1e-9)


def test_a_block_that_is_carried_leaves_when_it_should_however_far_the_end():
    """K z = mu - R |v| is reached after a time of ten: F is a straight line until then."""
    system = System([[1.0]], 0.5, 1.0, -0.2)
    start = -0.9 + 2.0
    run = simulate(system, start, -0.2, 1e300)
    assert run.events.t[0] == pytest.approx((start + 0.9) / 0.2, rel=1e-12)
    assert run.events.mode.tolist() == [1]


@pytest.mark.parametrize(
    ("damping", "friction", "v", "t_end", "settings"),
    [
        (0.0, [1.0, 1.0], -0.2, 1e100, {}),
        (0.3, [1.0, 0.0], 0.0, 1e300, {"engine": "sigmoid", "eps": 1e-5}),
        (0.3, [1.0, 1.0], 0.0, 1e300, {"engine": "sigmoid", "eps": 1e-8}),
    ],
)
def test_a_run_that_nothing_ends_is_given_up_in_one_line(damping, friction, v, t_end, settings, monkeypatch):
    """Swinging, creeping or free for ever: after some steps it is certain that the rest takes too many."""
    monkeypatch.setattr(several, "_TRIED", 2e4)
    system = System([[2.0, -1.0], [-1.0, 2.0]], damping, friction, v)
    with pytest.raises(IntegrationError, match=r"t_end: .* steps led to .* shorten the run"):
        simulate(system, [3.0, 1.0], [0.0, 0.3], t_end, **settings)


def test_a_run_that_calms_down_is_not_given_up(rng):
    """Its start takes 2e4 steps to die out, in a time of 500; at that pace 4e13 would follow, where one does."""
    chain = 2.0 * np.eye(20) - np.eye(20, k=1) - np.eye(20, k=-1)
    run = simulate(System(chain, 0.01, 1.0, 0.0), 1e3 * rng.normal(size=20), 0.0, 1e12, tol=1e-6)
    assert run.outcome == "finished"
    assert (run.events.mode_at(run.t_end) == 0).all()
    # an expansion for each event, and for each 5 / rate of the time at most; to the end, one
    assert run.stats.n_steps < 1.5 * len(run.events) + 0.5 * run.events.t[-1] + 10
