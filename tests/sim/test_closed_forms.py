"""One and two blocks: event times known in closed form or to 40 digits (mu = 1 unless said).

Entries and exits of one block follow from the damped oscillator's closed form; the exit lies where the stick
interval ends, z = (sgn(v) mu - rho v) / kappa. The two-block values come from an exact event-driven computation
in 40-digit arithmetic with the couplings of eq. (6): s = +1 as printed, s = -1 with kappa12 -> -kappa12.
"""

import numpy as np
import pytest
from scipy.optimize import brentq

from stickslip.sim import System, simulate
from tests.systems import draw_run

TOL = 1e-15


def two_blocks(s):
    k1, k2, k12 = 1.1, 1.6, 0.5 * s
    return System([[k1 + k12, -k12], [-k12, k2 + k12]], damping=0.1, belt_speed=-1.0)


@pytest.mark.parametrize(
    ("rho", "kappa", "v", "z0", "w0", "times", "modes"),
    [
        (3.5, 0.2, -0.2, -0.7, -0.4, [0.09197880284020456, 3.9564549379897342], [0, 1]),
        (3.5, 0.2, +0.2, -0.7, -0.4, [0.49802862992843305, 11.540118914788621], [0, -1]),
        (0.1, 1.0, -0.2, 3.0, 1.0, [0.29075098367384344, 3.231881443452085, 4.104721534065557], [-1, 0, 1]),
    ],
)
def test_one_block(rho, kappa, v, z0, w0, times, modes):
    """AUDIT, table of one block: crossing, stick and exit; by time stepping each within a few steps."""
    system = System([[kappa]], rho, belt_speed=v)
    laws = [({"tol": TOL}, 1e-12), *(({"engine": "moreau", "step": step}, 3 * step) for step in (1e-2, 1e-4))]
    for law, atol in laws:
        run = simulate(system, z0, w0, 20.0, **law)
        assert run.events.initial_mode.tolist() == [np.sign(w0 - v)]
        assert run.events.mode.tolist() == modes
        np.testing.assert_allclose(run.events.t, times, rtol=0, atol=atol)
    # where it sticks it moves with the belt, and it leaves at the end of the stick interval
    stick, leave = times[-2:]
    at_stick = simulate(system, z0, w0, stick, tol=TOL).z[0]
    assert at_stick + v * (leave - stick) == pytest.approx((np.sign(v) - rho * v) / kappa, abs=1e-11)


def test_one_block_never_sticks_again():
    """AUDIT, one block: after the exit |w| < |v| for ever, z -> sgn(v) mu / kappa: there is no stick-slip cycle."""
    run = simulate(System([[0.2]], 3.5), -0.7, -0.4, 600.0, tol=TOL, stop_early=False)
    assert len(run.events) == 2
    assert run.z[0] == pytest.approx(-1 / 0.2, abs=1e-10)


@pytest.mark.parametrize(("r", "v"), [(-0.1, -0.2), (-0.5, 0.3)])
def test_a_block_that_a_negative_damping_drives_sticks_again(r, v):
    """kappa = 1, from rest on the belt: exit at the end of the stick interval, entry where w is v again.

    With y = z - sgn(v), slip is y'' + r y' + y = 0 from y = -r v, y' = v; so y' = v at a root of one equation.
    """
    system = System([[1.0]], r, belt_speed=v)
    leave = (np.sign(v) - r * v) / v
    k, omega = -r / 2, np.sqrt(1 - r**2 / 4)
    a, b = -r * v, (v - k * -r * v) / omega

    def gap(t):
        c, s = np.cos(omega * t), np.sin(omega * t)
        return np.exp(k * t) * (k * (a * c + b * s) + omega * (b * c - a * s)) - v

    at = np.linspace(0.05, 2 * np.pi, 400)
    first = at[np.flatnonzero(gap(at)[1:] * gap(at)[:-1] < 0)[0]]
    enter = brentq(gap, first - 0.02, first + 0.02, xtol=1e-15)
    run = simulate(system, 0.0, "belt", leave + 6.0, tol=TOL)
    np.testing.assert_allclose(run.events.t[:2], [leave, leave + enter], rtol=0, atol=1e-11)
    assert run.events.mode[:2].tolist() == [-np.sign(v), 0]


def test_two_blocks_from_rest_on_the_belt():
    """AUDIT, two blocks: from (0, 0, -1, -1), s = +1."""
    run = simulate(two_blocks(+1), 0.0, -1.0, 30.0, tol=TOL, stop_early=False)
    np.testing.assert_allclose(
        run.events.t, [0.5625, 0.8162276148517664, 6.168800188684988, 6.287311406713242], rtol=0, atol=1e-12
    )
    assert run.events.block.tolist() == [1, 0, 0, 0]
    assert run.events.mode.tolist() == [1, 1, 0, 1]
    np.testing.assert_allclose(run.z, [-1.0401911196217937, -0.8589369248824921], rtol=0, atol=1e-12)


def test_two_blocks_with_the_other_sign_of_coupling():
    """AUDIT, two blocks: from (0, 0, -1, -1), s = -1."""
    run = simulate(two_blocks(-1), 0.0, -1.0, 1.0, tol=TOL)
    np.testing.assert_allclose(run.events.t, [0.5625, 0.8202362716222801], rtol=0, atol=1e-12)


def test_two_blocks_one_beyond_its_stick_region():
    """AUDIT, two blocks: from (0.1, 1.2, -1, -1), s = +1."""
    run = simulate(two_blocks(+1), [0.1, 1.2], -1.0, 2.0, tol=TOL)
    assert run.events.initial_mode.tolist() == [0, -1]  # block 2 cannot be held at z2 = 1.2
    np.testing.assert_allclose(
        run.events.t, [0.4714459626579806, 1.2127647222056555, 1.5900572611602661], rtol=0, atol=1e-12
    )
    assert run.events.block.tolist() == [0, 1, 1]
    assert run.events.mode.tolist() == [1, 0, 1]


@pytest.mark.parametrize(("tol", "damping"), [(1e-4, 0.0), (1e-7, 1e-8), (1e-10, 0.0), (1e-13, 1e-8)])
def test_a_block_without_damping_swings_for_ever(tol, damping):
    """On the belt to z = -1 at t = 5, then z = -1 - 0.2 sin(t - 5), which touches the belt's speed once a period."""
    times = np.linspace(5.0, 1000.0, 997)
    run = simulate(System([[1.0]], damping, 1.0, -0.2), 0.0, -0.2, 1000.0, t_eval=times, tol=tol)
    swing = -0.2 * np.exp(-0.5 * damping * (times - 5.0)) * np.sin(times - 5.0)
    np.testing.assert_allclose(run.samples.z[:, 0], -1.0 + swing, rtol=0, atol=max(100 * tol, 1e-9, 2 * damping))
    assert [(k, m) for k, m in zip(run.events.t, run.events.mode, strict=True)] == [(pytest.approx(5.0), 1)]


def test_a_block_leaves_at_a_force_that_only_high_orders_of_its_series_reach():
    """F is that of two blocks without friction that swing; a bound by the first orders alone finds the exit late."""
    rate, share, phase, friction = np.array([1.07, 3.59]), np.array([0.58, 0.11]), np.array([1.4, 3.5]), 0.35
    stiffness = np.diag([1.0, *rate**2])
    stiffness[0, 1:] = share
    system = System(stiffness, 0.0, friction=[friction, 0.0, 0.0], belt_speed=[0.0, 50.0, 50.0])
    run = simulate(system, [0.0, *np.cos(phase)], [0.0, *-rate * np.sin(phase)], 1.0, tol=1e-9)
    at = brentq(lambda t: share @ np.cos(rate * t + phase) + friction, 0.9, 1.0, xtol=1e-14)
    np.testing.assert_allclose(run.events.t, [at], rtol=0, atol=1e-9)
    assert run.events.mode.tolist() == [1]


@pytest.mark.parametrize("engine", ["coulomb", "sigmoid"])
@pytest.mark.parametrize("z0", [-3.0, -2.0, 2.0, 6.0])
def test_a_block_that_leaves_the_belt_at_once(engine, z0, rng):
    """Whether it collapsed is asked where |w| is all that is allowed: asked again at the same time, it never ends."""
    for kappa, rho in [(0.2, 3.5), *rng.uniform(0.1, 4.0, (3, 2))]:
        run = simulate(System([[kappa]], rho), z0, -0.2, 50.0, engine=engine)
        full = simulate(System([[kappa]], rho), z0, -0.2, 50.0, engine=engine, stop_early=False)
        np.testing.assert_allclose(run.z, full.z, rtol=0, atol=1e-10 if engine == "coulomb" else 1e-3)


def test_a_run_ends_at_the_time_asked_for(rng):
    """Not an ulp later, in any of its times; seen once as 3.0000000000000004."""
    for _ in range(40):
        t_start, (system, z, _) = float(rng.choice([0.0, 0.1, -3.3])), draw_run(rng, (1, 3), "integers")
        t_end = t_start + float(rng.choice([0.3, 1.0, 3.0, np.pi]))
        for engine in ("coulomb", "sigmoid"):
            run = simulate(system, np.round(2 * z), -0.2, t_end, t_start=t_start, engine=engine)
            assert run.t_end <= t_end
            assert run.outcome == "diverged" or run.t_end == t_end
            assert (run.events.t <= run.t_end).all()
            assert run.events.t_end == run.t_end
