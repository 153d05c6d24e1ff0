"""Static friction above the kinetic: the system, and what both engines make of it."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from stickslip.sim import System, simulate
from stickslip.sim.engines.certificates import Collapse, Smoothed
from stickslip.sim.systems.friction import hidden_term, turning_point
from tests.independent import Case, follow

# the system


def test_static_friction_left_out_is_the_kinetic():
    system = System(np.eye(3), 0.1, [0.5, 1.0, 0.0])
    assert system.static is system.friction
    assert not system.is_static_above
    same = System(np.eye(3), 0.1, 1.0, static=1.0)
    assert not same.is_static_above
    assert repr(same) == repr(System(np.eye(3), 0.1))
    assert same._repr_html_() == System(np.eye(3), 0.1)._repr_html_()


def test_static_friction_is_a_number_or_one_a_block():
    assert System(np.eye(2), 0.1, static=1.3).static.tolist() == [1.3, 1.3]
    system = System(np.eye(2), 0.1, [1.0, 0.5], static=[1.0, 0.75])
    assert system.is_static_above
    assert "static 0.75 to 1" in repr(system)
    assert "<th>static friction</th><td>0.75 to 1</td>" in system._repr_html_()
    with pytest.raises(ValueError, match="read-only"):
        system.static[0] = 2.0


# the sigmoid engine

FINE = {"engine": "sigmoid", "rtol": 1e-9, "atol": 1e-9}


def period(drop, speed):
    """Of one block, K = 1, R = 0, static friction `drop` above the kinetic, the belt's speed |v|: stick, then slip.

    It leaves at z = -sgn(v) static, where w = v, and slips on a circle about -sgn(v) kinetic.
    """
    return 2 * drop / speed + 2 * (np.pi - np.arctan(drop / speed))


def test_between_the_two_frictions_the_state_says_which_future():
    """K = 1, |F| = 1.1: at the belt's speed it sticks, far beyond the peak it slips on, with F only."""
    system, eps = System([[1.0]], 0.0, static=1.3, belt_speed=-1e-3), 1e-3
    peak = eps * np.arctanh(turning_point(hidden_term(1.3)))
    modes = {}
    for share in (0.0, 0.5, 3.0, -3.0):
        run = simulate(system, -1.1, -1e-3 + share * peak, 0.5, eps=eps, **FINE)
        modes[share] = (run.events.initial_mode[0], run.events.mode_at(0.5)[0], len(run.events))
    assert modes == {0.0: (0, 0, 0), 0.5: (0, 0, 0), 3.0: (1, 1, 0), -3.0: (0, 0, 0)}


@pytest.mark.parametrize("ratio", [1.05, 1.3, 2.0])
def test_a_block_that_comes_at_speed_sticks_up_to_static_friction(ratio, rng):
    """Between kinetic and static friction a step that passes a thin layer finds nothing wrong behind it.

    Blocks by themselves, springs k, forces f, belts at rest: each swings about (f + mu) / k until it comes to rest
    where F = k z - f lies between -mu and -mu_s; or all of that with the other sign.
    """
    n = 8
    peak = np.arctanh(turning_point(hidden_term(ratio)))
    for _ in range(8):
        k, mu, f, side = 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-0.5, 0.5, n), *rng.normal(size=(2, n))
        force = -mu * (1 + (ratio - 1) * rng.uniform(0.1, 0.9, n))
        rest, reach, phase = (force + f) / k, (force - mu) / k, rng.uniform(0.1, 0.9, n) * np.pi
        z, w = rest + reach * (np.cos(phase) - 1), reach * np.sqrt(k) * np.sin(phase)
        t_end = (phase / np.sqrt(k)).max() + rng.uniform(0.1, 3.0)
        # what F may err by lies well below its distance from static friction
        delta, tol = 10 ** rng.uniform(-6, -3), 10 ** rng.uniform(-6, -3.5) * (ratio - 1)
        sign = np.sign(side)
        system = System(np.diag(k), 0.0, mu, 0.0, ratio * mu, force=sign * f)
        run = simulate(system, sign * z, sign * w, t_end, engine="sigmoid", eps=delta, rtol=tol, atol=tol)
        allowed = 20 * tol * (1 + np.abs([z, w, rest]).max()) + 10 * delta * (1 + t_end)
        off = np.abs(run.z - sign * rest)
        assert (np.abs(run.w) < peak * delta).all()
        assert (off < allowed).all()


def test_a_block_in_a_thin_layer_leaves_in_time(rng):
    """Near its peak u is held by little: F lacks the square of what it errs by, over the peak, when it is let go."""
    for _ in range(15):
        k, v, ratio = 10 ** rng.uniform(-1, 1.5), -(10 ** rng.uniform(-1, 0.5)), 1 + 10 ** rng.uniform(-1, 0.5)
        delta, tol = 10 ** rng.uniform(-9.5, -8), 10 ** rng.uniform(-5.7, -4)  # delta^(2/3) is no matter beside it
        system = System([[k]], 0.0, 1.0, v, ratio)
        z = -(ratio - rng.uniform(0.05, 0.5) * min(1, ratio - 1)) / k
        t_end = (ratio / k + z) / -v + min(0.3 / np.sqrt(k), 0.5)
        exact = simulate(system, z, v, t_end, tol=1e-12)
        run = simulate(system, z, v, t_end, engine="sigmoid", eps=delta, rtol=tol, atol=tol)
        assert len(exact.events) == 1
        # F errs by k tol: the time of leaving by tol / |v|, and w by that times (static - kinetic)
        allowed = tol * (1 + abs(exact.z[0])) * max(1, (ratio - 1) / -v) + 10 * delta ** (2 / 3)
        off = max(abs(run.z - exact.z)[0], abs(run.w - exact.w)[0])
        assert off < 40 * allowed


@pytest.mark.parametrize("law", [{"tol": 1e-9}, {"engine": "sigmoid", "eps": 0.01, "thresholds": (0.5, 2.0)}])
def test_a_run_keeps_more_events_than_there_is_room_for_at_once(law):
    """60 blocks that do not feel each other do what one does."""
    one, many = (simulate(System(np.eye(n), 0.0, static=1.3), 0.0, -0.2, 800.0, **law) for n in (1, 60))
    assert len(many.events) == 60 * len(one.events) > 2 * 4096
    series = ((run.events, *run.by_threshold.values()) for run in (one, many))
    for expected, found in zip(*series, strict=True):
        for block in range(60):
            its = found.block == block
            np.testing.assert_allclose(found.t[its], expected.t, rtol=0, atol=1e-4)
            np.testing.assert_array_equal(found.mode[its], expected.mode)
    np.testing.assert_allclose(many.stills.t, one.stills.t, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("delta", "ratio"), [(0.06, 1.0), (0.4, 1.02), (0.06, 1.5), (0.4, 1.5)])
def test_what_the_law_strays_from_its_tangent_is_bounded(ratio, delta):
    """The limit of a certificate against that by the largest stray on a fine grid of speeds, for one block.

    In a layer wider than the belt's speed the law strays more on the side away from the belt.
    """
    speed, mu, c = 0.2, 0.8, float(hidden_term(ratio))
    system = System([[1.0]], 3.0, mu, -speed)

    def law(u):
        lam = np.tanh(u / delta)
        return lam + c * lam * (1 - lam**2)

    rise = 1 / np.cosh(speed / delta) ** 2
    slope = rise * (1 + c * (3 * rise - 2)) / delta
    q = np.sqrt((3.0 + mu * slope) ** 2 - 4.0)
    r = np.linspace(0.0, speed, 2001)
    moves = np.linspace(-1, 1, 401)[:, None] * r
    strays = np.abs(law(speed - moves) - law(speed) + slope * moves).max(axis=0)
    limit = (r - 2 / q * mu * strays).max()
    collapse = Collapse(system, 0.0, Smoothed(speed, np.array([delta]), np.array([c])))
    z = -mu * law(speed)

    def is_certain(share):
        return collapse.certify(np.array([z + share * limit * q / 2]), np.zeros(1)).is_certain

    assert not is_certain(1.01)
    assert is_certain(0.4)


# the exact engine


@pytest.mark.parametrize(("drop", "v"), [(0.3, -0.2), (2.0, -1.0), (1e-7, 0.5)])
def test_the_period_of_one_block(drop, v):
    """However small the drop, and short the stick: 4e-7 of the last is no touch."""
    events = simulate(System([[1.0]], 0.0, 1.0, v, static=1.0 + drop), 0.0, v, 300.0, tol=1e-13).events
    exits = events.t[events.mode != 0]
    assert np.array_equal(events.mode, np.resize([-np.sign(v), 0], len(events)))
    assert len(exits) > 30
    np.testing.assert_allclose(np.diff(exits), period(drop, abs(v)), rtol=0, atol=1e-12)


def test_a_block_on_the_belt_sticks_up_to_its_static_friction():
    """K = 1, R = 0, v = -0.2: on the belt it sticks while |z| <= 1.3; off the belt only kinetic friction counts."""
    system = System([[1.0]], 0.0, static=1.3)
    for z, mode in (
        (1.2, 0),
        (1.3, 0),
        (1.31, -1),
        (-1.2, 0),
        (-1.3, 1),
        (-1.31, 1),
    ):  # at 1.3 the belt takes it back
        assert simulate(system, z, -0.2, 0.1).events.initial_mode[0] == mode
    slips = simulate(system, -1.2, -0.2 + 1e-9, 0.5).events  # two futures: this one is off the belt
    assert (slips.initial_mode[0], len(slips)) == (1, 0)


@pytest.mark.parametrize("as_sparse", [False, True])
def test_a_start_between_the_two_frictions_slips_if_told_to(as_sparse):
    """z = 1 + (z0 - 1) cos t + v sin t of the block that slips; one beside it is off the belt, one sticks."""
    k = np.diag([1.0, 1.0, 1.0])
    system = System(csr_array(k) if as_sparse else k, 0.0, static=1.5, belt_speed=-0.2)
    z, w, t = np.array([1.3, 0.3, 0.5]), np.array([-0.2, 0.4, -0.2]), 1.5
    run = simulate(system, z, w, t, modes=[-1, 1, 0], tol=1e-12)
    assert run.events.initial_mode.tolist() == [-1, 1, 0]
    assert run.z[0] == pytest.approx(1 + 0.3 * np.cos(t) - 0.2 * np.sin(t), abs=1e-11)
    assert simulate(system, z, w, t).events.initial_mode.tolist() == [0, 1, 0]
    for modes, block in (([0, 1, -1], 2), ([0, -1, 0], 1), ([0, 0, 0], 1), ([1, 1, 0], 0)):
        with pytest.raises(ValueError, match=f"modes: .* for block {block}, which begins with"):
            simulate(system, z, w, t, modes=modes)
    with pytest.raises(ValueError, match="got 0 for block 0, which begins with -1"):
        simulate(system, [1.6, 0.3, 0.5], w, t, modes=[0, 1, 0])


def test_at_static_friction_a_block_slips_against_the_force_alone():
    """|F| = m: it may stick or slip, whichever was asked for, but friction does not push, nor open what is barred."""
    for static in (1.0, 1.5):
        system = System([[1.0]], 0.0, static=static, belt_speed=-0.2)
        for modes in (0, -1):
            simulate(system, static, -0.2, 1.0, modes=[modes])
        with pytest.raises(ValueError, match="got 1 for block 0, which begins with"):
            simulate(system, static, -0.2, 1.0, modes=[1])
        with pytest.raises(ValueError, match="got -1 for block 0, which begins with 0"):
            simulate(system.changed(back_slip=False), static, -0.2, 1.0, modes=[-1])


@pytest.mark.parametrize("push", [-0.1, 0.0, 0.1])
def test_a_block_that_leaves_with_a_jump_takes_along_what_it_holds_at_the_edge(push):
    """Blocks 0 and 1 at F = -static with F' = F'' = 0; a third that slips pushes 0 out or in at the second order.

    If 0 leaves, with w' = 0.5, block 1, which feels it alone, leaves too.
    """
    k = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, push]])
    z, mu, static = np.array([1.5, 0.0, 1.5]), [1.0, 1.0, 0.0], [1.5, 1.5, 0.0]
    run = simulate(System(k, 0.0, mu, 0.0, static), z, 0.0, 0.1)
    other = follow(Case.of(k, 0.0, mu, 0.0, z, 0.0, static), 0.1)
    assert run.events.initial_mode.tolist() == list(other.initial_mode)
    assert run.events.initial_mode.tolist()[:2] == ([1, 1] if push < 0 else [0, 0])
    np.testing.assert_allclose(run.z, other.z, atol=1e-12)


def test_a_block_that_has_just_left_goes_on_where_another_stops_at_once():
    """|F| = m on a belt at rest, and told to leave; 1e-18 later, which rounding cannot tell, the other block stops.

    z = 1 + cos(t) / 2 of the first: F does not rise, and would hold it if it had not left.
    """
    system = System(np.eye(2), 0.0, static=1.5, belt_speed=0.0)
    run = simulate(system, [1.5, 0.0], [0.0, 1e-18], 1.0, modes=[-1, 1])
    assert run.events.block.tolist() == [1]
    assert run.z[0] == pytest.approx(1.0 + 0.5 * np.cos(1.0), abs=1e-10)


@pytest.mark.parametrize("beyond", [0.0, 1e-3])
def test_a_tangency_at_the_static_friction_is_no_exit(beyond):
    """F of a stuck block is a free one's z = -1.5 cos t: from its static friction back, or from a little beyond."""
    k, mu, static = np.array([[0.0, 1.0], [0.0, 1.0]]), [1.0, 0.0], [1.5 - beyond, 0.0]
    z = [0.0, -1.5]
    t_end = 5.0 if beyond else 3.0  # at pi it touches the other side: there rounding decides
    events = simulate(System(k, 0.0, mu, 0.0, static), z, 0.0, t_end, tol=1e-13).events
    t, mode = (x[events.block == 0] for x in (events.t, events.mode))
    assert events.initial_mode[0] == (1 if beyond else 0)
    if beyond:  # it slips to the right, back to rest where the push of F is spent, and then to the left
        other = follow(Case.of(k, 0.0, mu, 0.0, z, 0.0, static), 5.0)
        assert mode.tolist() == [m for m, block in zip(other.mode, other.block, strict=True) if block == 0]
        np.testing.assert_allclose(
            t, [at for at, block in zip(other.t, other.block, strict=True) if block == 0], rtol=0, atol=1e-10
        )
    else:
        assert not len(t)


def test_static_friction_without_kinetic():
    """It slips freely, with damping alone, and comes back to the belt inside its static friction."""
    events = simulate(System([[1.0]], 0.2, 0.0, -0.2, static=0.5), 0.0, -0.2, 40.0, tol=1e-13).events
    other = follow(Case.of([[1.0]], 0.2, 0.0, -0.2, 0.0, -0.2, 0.5), 40.0)
    assert events.mode.tolist() == other.mode == [1, 0] * 5
    np.testing.assert_allclose(events.t, other.t, rtol=0, atol=1e-11)
