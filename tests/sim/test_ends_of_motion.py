"""Where stick-slip and steady sliding end along a key, against own return maps by SciPy and a closed form."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from stickslip.sim import Stribeck, System, simulate
from stickslip.sim.attractors import attractor
from stickslip.sim.attractors.continuation import Cause, end_of_motion, end_of_stability

#: Two masses, the first on the belt: its friction falls from 1 to 0.5, over speeds of 0.5.
K, C, FALL = np.array([[2.0, -1.0], [-1.0, 2.0]]), 0.08, 0.5
WIDTH, LOW, HIGH = 0.01, 0.8, 2.0


def system(v):
    return System(K, C, [0.5, 0.0], v, static=[1.0, 0.0], weakening=Stribeck(FALL))


def slips(v, t, x):
    z, w = x[:2], x[2:]
    friction = 0.5 + 0.5 * np.exp(-(v - w[0]) / FALL)
    return np.append(w, -K @ z - C * w + [friction, 0.0])


def sticks(v, t, x):
    return np.array([v, x[3], 0.0, -(K @ x[:2])[1] - C * x[3]])


def catches_up(v, t, x):
    return x[2] - v


def leaves(v, t, x):
    return (K @ x[:2])[0] + C * v - 1.0


def returned(v, state):
    """(z, w) of the second mass at the next onset of slip, and w' as the first catches up; None if it does not."""
    z, w = state
    ended = partial(catches_up, v)
    ended.terminal, ended.direction = True, 1.0
    limit = partial(leaves, v)
    limit.terminal, limit.direction = True, 1.0
    precise = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
    start = np.array([(1.0 - C * v - K[0, 1] * z) / K[0, 0], z, v * (1.0 - 1e-12), w])
    slip = solve_ivp(partial(slips, v), (0.0, 60.0), start, events=ended, first_step=1e-3, **precise)
    if slip.status != 1:
        return None
    caught = np.append(slip.y[:2, -1], [v, slip.y[3, -1]])
    stick = solve_ivp(partial(sticks, v), (0.0, 60.0), caught, events=limit, **precise)
    return stick.y[[1, 3], -1], slips(v, 0.0, caught)[2]


def cycle(v, guess):
    """The fixed point of the return map nearby, its multiplier, and the square of w' as the first mass catches up."""

    def missed(state):
        return returned(v, state)[0] - state

    found = root(missed, guess, tol=1e-9)
    assert np.abs(missed(found.x)).max() < 1e-6
    columns = [(missed(found.x + step) - missed(found.x - step)) / 2e-6 for step in 1e-6 * np.eye(2)]
    multiplier = np.abs(np.linalg.eigvals(np.transpose(columns) + np.eye(2))).max()
    return found.x, multiplier, returned(v, found.x)[1] ** 2


def at(share):
    return system(LOW + share * (HIGH - LOW))


def end(system_at, t_end):
    run = simulate(system_at(0.0), [1.0, 0.5], 0.0, t_end, tol=1e-10)
    width = WIDTH / (HIGH - LOW)
    settled = attractor(run, system_at(0.0), 0.5 * t_end, tol=1e-10)
    return settled, end_of_motion(system_at, run, settled, t_end, 0.5 * t_end, width, tol=1e-10)


def test_two_masses_coexistence_ends_where_own_return_maps_and_a_closed_form_have_it():
    """By Routh and Hurwitz steady sliding is stable where 2 C > exp(-v / FALL); the cycle lasts until it grazes."""
    crossing = end_of_stability(at)
    assert LOW + crossing * (HIGH - LOW) == pytest.approx(FALL * np.log(1.0 / (2.0 * C)), abs=1e-6)
    settled, (low, high, cause) = end(at, 400.0)
    state, cycles = np.array([0.507, 0.958]), {}
    for v in (LOW, 1.0, 1.1, 1.2, 1.24, 1.255, 1.265, 1.27):
        state, multiplier, impact = cycle(v, state)
        assert multiplier < 1.0
        cycles[v] = multiplier, impact
    assert settled.multiplier == pytest.approx(cycles[LOW][0], rel=1e-4)
    grazes = np.poly1d(np.polyfit([impact for _, impact in cycles.values()][-3:], [*cycles][-3:], 2))(0.0)
    assert cause is Cause.GRAZING
    assert (high - low) * (HIGH - LOW) <= WIDTH
    assert LOW + low * (HIGH - LOW) <= grazes <= LOW + high * (HIGH - LOW)


def both(share):
    """Two masses that both rub."""
    stiffness, damping = [[1.576, -0.969], [-0.969, 2.309]], [[0.09, -0.015], [-0.015, 0.102]]
    return System(stiffness, damping, 0.5, 0.3 + share, static=0.878, weakening=Stribeck(0.2156))


@pytest.mark.parametrize(("system_at", "cause"), [(at, Cause.GRAZING), (both, Cause.MULTIPLIER)])
def test_an_end_of_a_cycle_does_not_depend_on_the_length_of_runs(system_at, cause):
    short, long = (end(system_at, t_end)[1] for t_end in (200.0, 600.0))
    assert short.cause is long.cause is cause
    assert short[:2] == pytest.approx(long[:2], abs=1e-6)
