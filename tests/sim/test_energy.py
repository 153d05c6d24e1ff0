"""Energy and its balance, and episodes."""

import numpy as np
import pytest
from scipy.integrate import quad_vec

from stickslip.sim import (
    EventSeries,
    Harmonic,
    Piecewise,
    Rational,
    Run,
    Stats,
    Stribeck,
    System,
    draw_system,
    simulate,
)
from stickslip.sim.energy import TooLongError, energy
from stickslip.sim.episodes import episodes
from stickslip.sim.runs.run import Stills


def run_with_energy(system, z, w, t_end, **settings):
    run = simulate(system, z, w, t_end, **settings)
    return run, energy(system, run, z, w, **settings)


def test_a_block_that_slides_to_rest_turns_its_energy_into_heat():
    """K = 0, R = 0, mu = 0.5, v = 0: from w = 2 it slides 4 far in a time of 4, and stays."""
    run, balance = run_with_energy(System([[0.0]], 0.0, 0.5, 0.0), 0.0, 2.0, 10.0)
    assert run.events.t == pytest.approx([4.0])
    assert balance.kinetic == pytest.approx([2.0, 0.0, 0.0])
    assert balance.heat == pytest.approx([0.0, 2.0, 2.0])
    assert np.abs(balance.imbalance).max() < 1e-14


def test_a_block_that_rides_the_belt_takes_its_work():
    """K = 1, R = 0.5, mu = 1, v = -0.2, from z = 0: stuck up to z = -0.9, the belt does z^2 / 2 and R v^2 t."""
    _, balance = run_with_energy(System([[1.0]], 0.5), 0.0, -0.2, 4.0)
    np.testing.assert_allclose(balance.elastic, 0.02 * balance.t**2, atol=1e-14)
    np.testing.assert_allclose(balance.belt, 0.02 * balance.t**2 + 0.02 * balance.t, atol=1e-14)
    np.testing.assert_allclose(balance.damping, 0.02 * balance.t, atol=1e-14)
    assert balance.heat[-1] == 0.0


def test_a_belt_that_speeds_up_gives_a_heavy_block_its_kinetic_energy():
    """K = 0, R = 0, m = 3, mu = 1: it rides a belt that goes from -0.1 to -0.5 in a time of 4, by a force of 0.3."""
    system = System([[0.0]], 0.0, 1.0, Piecewise([0.0, 4.0], [-0.1, -0.5]), mass=3.0)
    run, balance = run_with_energy(system, 0.0, -0.1, 4.0)
    assert len(run.events) == 0
    assert balance.belt[-1] == pytest.approx(1.5 * (0.25 - 0.01), rel=1e-12)
    assert np.abs(balance.imbalance).max() < 1e-14


@pytest.mark.parametrize("coupling", ["antisymmetric", "chain"])
def test_the_balance_closes_over_thousands_of_events(coupling, rng):
    seed = int(rng.integers(2**32))
    if coupling == "chain":
        system, t_end = draw_system("chain", 30, seed, kappa=2.0, leaf=1.0, rho=0.0, static=1.5), 100.0
        start = rng.normal(size=30), np.full(30, -0.2)
    else:
        system, t_end, start = draw_system("antisymmetric", 60, seed, kappa=0.4), 200.0, (-0.7, -0.4)
    _, balance = run_with_energy(system, *start, t_end, tol=1e-14, stop_early=False)
    turnover = np.abs(balance.belt).max() + balance.damping[-1] + balance.heat[-1] + np.abs(balance.coupling).max()
    assert np.abs(balance.imbalance).max() < 1e-12 * turnover
    assert (np.diff(balance.heat) >= 0).all()


@pytest.mark.parametrize("terms", ["dry", "driven", "weakening", "massive"])
def test_parts_of_a_chaotic_run_give_what_the_whole_does(terms, rng, monkeypatch):
    """Runs of which one begins 1e-12 beside the other part before they end, and are taken in some hundred parts."""
    n = 12
    more = {
        "dry": {},
        "driven": {
            "belt_speed": Piecewise([20.0, 70.0], rng.uniform(-0.1, -0.05, (2, n))),
            "force": [Harmonic(0.3, 0.7), Piecewise([0.0, 30.0, 31.0], [0.0, 0.2, 0.1])],
        },
        "weakening": {"weakening": Rational(2.0), "back_slip": False},
        "massive": {"mass": rng.uniform(0.5, 2.0, n)},
    }[terms]
    seed = int(rng.integers(2**32))
    system = draw_system("chain", n, seed, kappa=10.0, leaf=1.0, rho=0.0, static=1.3, belt_speed=-0.05).changed(
        **more
    )
    start = rng.normal(0.0, 0.3, n), system.belt_speed_at(0.0)
    run, whole = run_with_energy(system, *start, 120.0, tol=1e-12)
    monkeypatch.setattr("stickslip.sim.energy._ROOM", 9 * n * (len(whole.t) // 100))
    monkeypatch.setattr("stickslip.sim.energy._AT_A_TIME", 9 * n * 7)
    balance = energy(system, run, *start, tol=1e-12)
    turnover = np.abs(whole.belt).max() + np.abs(whole.outside).max() + whole.damping[-1] + whole.heat[-1]
    assert np.abs(balance.imbalance).max() < 1e-10 * turnover
    for name in ("t", "kinetic", "elastic", "belt", "outside", "damping", "heat", "coupling"):
        assert np.abs(getattr(balance, name) - getattr(whole, name)).max() < 1e-12 * turnover, name


@pytest.mark.parametrize("law", [Rational(1.0), Stribeck(0.05)])
def test_the_balance_closes_where_springs_pull_by_far_more_than_friction(law, rng):
    """Friction falls in less time than static friction would take to bring a block to that speed."""
    n = int(rng.integers(1, 4))
    system = System(np.diag(rng.uniform(0.5, 2.0, n)), 0.0, 1.0, -0.1, static=1.2, weakening=law)
    start = rng.choice([-1.0, 1.0], n) * rng.uniform(30.0, 200.0, n), -0.1
    _, balance = run_with_energy(system, *start, 3.0, tol=1e-13)
    came_in = balance.elastic[0] + np.abs(balance.belt).max()
    assert np.abs(balance.imbalance).max() < 1e-12 * came_in


@pytest.mark.parametrize("damping", [5.0, 1e3, 1e8])
def test_a_heavily_damped_block_loses_what_its_two_modes_do(damping, rng):
    """It slips for ever, R |v| being above friction: w = a exp(p t) + b exp(q t), p from R and q from K / R."""
    v, z, t_end, pull = -1.0, rng.uniform(-1.0, 1.0), rng.uniform(20.0, 50.0), rng.uniform(0.2, 1.0)
    system = System([[pull]], damping, 1.0, v)
    run, balance = run_with_energy(system, z, v, t_end, tol=1e-13)
    assert len(run.events) <= 1  # the start is one
    p = -(damping + np.sqrt(damping**2 - 4.0 * pull)) / 2
    q = pull / p
    off = z + 1.0 / pull  # from where it comes to rest, which is at K z = -mu
    a = (v - q * off) / (1.0 - q / p)
    b = v - a
    lost = sum(
        damping * one * other * np.expm1((x + y) * t_end) / (x + y)
        for one, x in ((a, p), (b, q))
        for other, y in ((a, p), (b, q))
    )
    slip = a / p * np.expm1(p * t_end) + b / q * np.expm1(q * t_end) - v * t_end
    assert balance.damping[-1] == pytest.approx(lost, rel=1e-11)
    assert balance.heat[-1] == pytest.approx(slip, rel=1e-11)
    assert np.abs(balance.imbalance).max() < 1e-12 * (lost + slip)


def test_a_run_of_too_many_segments_is_refused():
    """It collapses, and goes on without steps: 5e7 units of time take it a millisecond."""
    system = draw_system("antisymmetric", 5, 0)
    run = simulate(system, -0.7, -0.4, 5e7)
    assert run.outcome == "collapsed"
    with pytest.raises(TooLongError, match=r"run: expected one of at most 4,194,304 segments, got .* earlier t_end"):
        energy(system, run, -0.7, -0.4)


BLOCK = System([[1.0]], 0.5)
AWAY = System([[-1.0]], 0.0)


@pytest.mark.parametrize(("system", "z", "w", "t_end", "given", "words"), [
    (BLOCK, 0.0, -0.2, 40.0, (0.1, {}), "run: expected that of this start and these settings"),
    (BLOCK, 0.0, -0.2, 1.0, (0.1, {}), "run: expected that of this start and these settings"),  # without events
    (BLOCK, 0.0, -0.2, 40.0, (0.0, {"engine": "moreau"}), "engine: expected one of the exact law, got 'moreau'"),
    (BLOCK, 0.0, -0.2, 40.0, (0.0, {"engine": "exact"}), "engine: expected one of the exact law, got 'exact'"),
    (AWAY, 9.0, 0.0, 40.0, (9.0, {}), "run: expected one that does not diverge"),
])  # fmt: skip
def test_what_has_no_exact_energy_is_refused(system, z, w, t_end, given, words):
    with pytest.raises(ValueError, match=words):
        energy(system, simulate(system, z, w, t_end), given[0], w, **given[1])


# episodes


def planted(v=-0.5):
    """Three blocks. Episodes [1, 2] of blocks 0, 1 and [4, 7] of blocks 0 (twice), 2; what is open at both ends."""
    changes = [
        (0.5, 1, 0),
        (1.0, 0, 1), (1.5, 1, 1), (1.75, 0, 0), (2.0, 1, 0),
        (4.0, 2, -1), (5.0, 0, 1), (5.5, 0, 0), (5.5, 2, 0), (5.5, 0, 1), (7.0, 0, 0),
        (9.0, 1, 1),
    ]  # fmt: skip
    t, block, mode = (np.array(column) for column in zip(*changes, strict=True))
    series = EventSeries(
        t.astype(float), block.astype(np.int32), mode.astype(np.int8), np.array([0, 1, 0], np.int8), 0.0, 10.0
    )
    slipped = np.array([[0.0, 0.0, 0.0], [0.3, 0.2, 0.0], [0.9, 0.2, -0.1]])
    at = np.array([0.75, 3.0, 8.0])
    stills = Stills(at, (slipped + v * at[:, None]).sum(axis=1))
    end = np.zeros(3)
    return Run(end, end, 10.0, series, "finished", "", Stats(0, 0, 0, len(t)), stills=stills)


def test_planted_episodes():
    run = planted()
    slides = episodes(run, -0.5)
    np.testing.assert_array_equal([slides.start, slides.end], [[1.0, 4.0], [2.0, 7.0]])
    np.testing.assert_array_equal(slides.first_block, [0, 2])
    assert len(slides) == 2
    np.testing.assert_array_equal(slides.size, [2, 2])
    np.testing.assert_allclose(slides.moment, [0.5, 0.5])
    np.testing.assert_allclose(episodes(planted(0.5), 0.5).moment, [-0.5, -0.5])
    np.testing.assert_array_equal(slides.duration, [1.0, 3.0])
    assert repr(slides) == "Episodes(2 of up to 2 blocks)"


def test_one_block_with_static_friction_has_an_episode_a_period():
    """It goes once round its circle of radius (d^2 + v^2)^(1/2), from z = 1 + d to 1 - d: 2 d, and the belt's way."""
    system, drop = System([[1.0]], 0.0, static=1.3), 0.3
    slides = episodes(simulate(system, 0.0, -0.2, 42.0), -0.2)
    slips = 2 * (np.pi - np.arctan(drop / 0.2))
    assert len(slides) == 5
    np.testing.assert_allclose(slides.duration, slips, rtol=1e-9)
    np.testing.assert_allclose(slides.moment, 2 * drop + 0.2 * slips, rtol=1e-9)


@pytest.mark.parametrize("belts", ["one", "several", "changing"])
@pytest.mark.parametrize(("engine", "settings"), [("coulomb", {}), ("sigmoid", {"eps": 1e-2})])
def test_moments_are_those_of_the_states_at_both_ends(engine, settings, belts, rng):
    n_found = 0
    for _ in range(2):  # one in some hundreds comes to slide, with few episodes or none
        side = float(rng.choice([-1.0, 1.0]))
        speeds = side * rng.uniform(0.04, 0.06, (4, 6))
        belt = {
            "one": speeds[0, 0],
            "several": speeds[0],
            "changing": Piecewise(np.sort(rng.uniform(-10.0, 100.0, 4)), speeds),
        }[belts]
        chain = draw_system(
            "chain", 6, int(rng.integers(2**32)), kappa=3.0, leaf=1.0, rho=0.2, static=1.4, belt_speed=belt
        )
        start = rng.uniform(-0.2, 0.2, 6), chain.belt_speed_at(0.0), 90.0
        slides = episodes(simulate(chain, *start, engine=engine, **settings), belt)
        ends = np.column_stack([slides.start, slides.end]).ravel()
        again = simulate(chain, *start, engine=engine, **settings, t_eval=ends)
        way = np.array([quad_vec(chain.belt_speed_at, 0.0, t, points=getattr(belt, "times", None))[0] for t in ends])
        on_belt = (again.samples.z - way.reshape(-1, 6)).sum(axis=1).reshape(-1, 2)
        np.testing.assert_allclose(slides.moment, -side * np.diff(on_belt)[:, 0], atol=1e-9)
        for first, block in zip(slides.start[:1], slides.first_block, strict=False):
            assert not again.events.mode_at(first - 1e-9).any()
            assert again.events.mode_at(first)[block] != 0
        n_found += len(slides)
    assert n_found > 0
