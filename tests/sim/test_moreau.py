"""Time stepping of Moreau and Jean: what it records, and that it tends to the exact engine with its step."""

import numpy as np
import pytest
import scipy.sparse

from stickslip import System, simulate
from stickslip.sim.engines.moreau.step import BEYOND, whole_steps
from stickslip.sim.episodes import episodes
from stickslip.workflows.gallery.charts.peers import random_problem


def moreau(system, z0, w0, t_end, step, **kw):
    return simulate(system, z0, w0, t_end, engine="moreau", step=step, **kw)


def test_an_entry_is_at_the_end_of_its_step():
    """w = 3, 1.5, 0 after steps of 0.75; the third would pass the belt's -1, and ends on it."""
    run = moreau(System([[0.0]], 0.0, 2.0, -1.0), 0.0, 3.0, 3.0, 0.75)
    assert (run.events.t.tolist(), run.events.mode.tolist(), run.w.tolist()) == ([2.25], [0], [-1.0])


def test_rounding_of_a_quotient_adds_no_step():
    """1.1 / 0.1 > 11 in floating point; a length that does not divide the time takes one step more."""
    assert [whole_steps(k * 0.1, 0.1) for k in range(1, 200)] == list(range(1, 200))
    assert whole_steps(1.1001, 0.1) == 12
    assert moreau(System([[1.0]], 0.0, 1.0, 0.2), 0.0, 0.0, 1.1, 0.1).stats.n_steps == 11


def test_steps_are_the_scheme(rng):
    """The midpoint rule with w projected on the belt's, by numpy; samples lie on the steps' own path."""
    problem = random_problem(0, 50, 20.0, 0.03, "one")
    system, n_steps = problem.system, whole_steps(20.0, 0.01)
    z, w, h, v = np.full(50, problem.z0), np.full(50, problem.w0), 20.0 / n_steps, system.belt_speed
    a, b = 1 + 0.5 * h * system.damping, h * system.friction
    for _ in range(n_steps):
        free = w - h * (0.5 * system.damping * w + system.stiffness @ (z + 0.5 * h * w)) - a * v
        new = v + np.sign(free) * np.maximum(np.abs(free) - b, 0.0) / a
        z, w = z + 0.5 * h * (w + new), new
    times = np.sort(np.append(rng.uniform(0, 20, 100), [0.0, 20.0]))
    run = moreau(system, problem.z0, problem.w0, 20.0, 0.01, t_eval=times)
    np.testing.assert_allclose(run.z, z, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.w, w, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(run.events.mode_at(20.0) == 0, run.w == v)
    assert (np.diff(run.events.t) >= 0).all()
    assert (run.events.previous_mode != run.events.mode).all()
    np.testing.assert_allclose(run.samples.z[-1], z, rtol=0, atol=1e-10)
    exact = simulate(system, problem.z0, problem.w0, 20.0, t_eval=times)
    assert np.abs(run.samples.z - exact.samples.z)[: len(times) // 2].max() < 0.05


def test_a_record_longer_than_its_buffer_is_kept_whole():
    """Blocks that do not feel each other, each with the two events of the closed form: more than fit at a time."""
    n = 2100
    system = System(scipy.sparse.diags_array(np.full(n, 0.2)), 3.5, belt_speed=-0.2)
    run = moreau(system, -0.7, -0.4, 5.0, 0.05)
    assert run.events.counts() == {"n_entries": n, "n_exits": n, "n_crossings": 0}
    np.testing.assert_array_equal(np.unique(run.events.t, return_counts=True)[1], [n, n])


def test_a_run_that_leaves_every_bound_is_known_up_to_there():
    run = moreau(System([[-4.0]], 0.0), 1.0, 1.0, 100.0, 0.1)  # grows with exp(2 t)
    assert run.outcome == "diverged"
    assert f"{BEYOND:g}" in run.reason
    assert run.t_end == run.events.t_end == pytest.approx(0.5 * np.log(BEYOND), abs=0.5)


def test_static_friction_holds_a_block_and_moments_tend_to_the_exact_ones():
    """A block of R = 0, K = 1 slips 2 d and takes 2 d / |v| + 2 (pi - arctan(d / |v|)), d = static less kinetic."""
    system = System([[1.0]], 0.0, static=1.3, belt_speed=-0.05)
    period = 0.6 / 0.05 + 2 * (np.pi - np.arctan(0.3 / 0.05))
    errors = []
    for step in (0.02, 0.002):
        found = episodes(moreau(system, 0.0, -0.05, 200.0, step), -0.05)
        errors.append([abs(np.diff(found.start).mean() - period), abs(found.moment.mean() - moment(system, 200.0))])
    assert np.max(errors[0]) < 0.1
    assert np.max(errors[1]) < 0.01
    assert found.size.tolist() == [1] * len(found)


def test_static_friction_holds_a_block_that_comes_to_the_belt_with_more_than_kinetic_friction_pulls(rng):
    """K = 1, mu = 1, static 2, a belt at rest: from z = 3.5 it slips to -1.5, and stays, by steps of any length."""
    system = System([[1.0]], 0.0, static=2.0, belt_speed=0.0)
    steps = 10.0 ** rng.uniform(-3.0, -1.0, 20)
    ends = np.array([moreau(system, 3.5, 0.0, 10.0, step).z[0] for step in steps])
    assert np.abs(ends + 1.5).max() < 0.2


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_block_is_held_by_as_much_as_static_friction(side):
    """K = 1 and a belt at rest: at |z| = 2 nothing moves, to the last bit, and beyond it the block slips back."""
    system = System([[1.0]], 0.0, static=2.0, belt_speed=0.0)
    assert moreau(system, 2.0 * side, 0.0, 8.0, 0.5).z[0] == 2.0 * side
    assert abs(moreau(system, np.nextafter(2.0, 3.0) * side, 0.0, 1.0, 0.5).z[0]) < 2.0


def test_a_sample_at_the_end_is_kept_wherever_the_last_step_rounds_to(rng):
    system = System([[1.0]], 0.0, static=1.3)
    for t_end in rng.integers(1, 50, 30) / 10:  # 39 steps of 0.1 end before 3.9
        run = moreau(system, 0.0, -0.2, t_end, 0.1, t_eval=[t_end])
        np.testing.assert_allclose(run.samples.z, [run.z], rtol=0, atol=1e-13)


def moment(system, t_end):
    return episodes(simulate(system, 0.0, -0.05, t_end), -0.05).moment.mean()


def test_a_step_in_which_negative_damping_turns_velocities_round_is_refused():
    """Of w' = -R w a step makes w (1 - R h / 2) / (1 + R h / 2), whose divisor is to be positive."""
    for damping, step in ((-199.0, 0.01), (-250.0, 0.00799)):
        run = moreau(System([[0.0]], damping, friction=0.0), 0.0, 1.0, 2 * step, step)
        assert run.w[0] == pytest.approx(((1 - damping * step / 2) / (1 + damping * step / 2)) ** 2, rel=1e-9)
    with pytest.raises(ValueError, match=r"step: expected less than 0.008, .* got 0.01"):
        moreau(System([[0.0]], -250.0, friction=0.0), 0.0, 1.0, 0.05, 0.01)
