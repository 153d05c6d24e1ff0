"""The chart of one block: closed forms, the basin by other means, claims judged by what was measured."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip.sim import System, simulate
from stickslip.workflows.gallery import load_chart
from stickslip.workflows.gallery.charts import runner
from stickslip.workflows.gallery.field import one_block
from stickslip.workflows.gallery.field.forced import Forced, State, most_friction, shape, sliding_cycle
from stickslip.workflows.gallery.field.one_block import Basin, Measured, Period, Shifted, Sliding, Stability, Stops

TINY = """
chart = "one_block"
periods = 3
boundary = 3
stability = 3
shifted = 1
stops = 4
slowest = 0.2
starts = 5
"""


# static friction


@pytest.mark.parametrize("damping", [0.0, 0.03, 0.1])
def test_the_period_of_a_run_is_the_closed_form(damping, rng):
    drop = rng.uniform(0.1, 2.0)
    speed = drop * rng.uniform(0.05, 0.5)
    closed = one_block.period(drop, speed, damping)
    events = simulate(System([[1.0]], damping, 1.0, speed, static=1 + drop), 0.0, speed, 8 * closed, tol=1e-13).events
    np.testing.assert_allclose(np.diff(events.t[events.mode != 0]), closed, rtol=1e-12)


def test_little_damping_changes_the_period_little():
    assert one_block.period(0.5, 0.1, 1e-9) == pytest.approx(one_block.period(0.5, 0.1), abs=1e-8)


# a harmonic force


def test_without_friction_the_block_is_a_linear_oscillator(rng):
    """z = V cos(Omega t + phase) + A cos t + B sin t."""
    frequency, phase = rng.uniform(0.1, 0.9), rng.uniform(0, 6)
    start = State(rng.normal(), rng.normal(), phase)
    v, t = 1 / (1 - frequency**2), 2.5 * 2 * np.pi / frequency
    a, b = start.z - v * np.cos(phase), start.w + v * frequency * np.sin(phase)
    found = Forced(frequency, 0.0).after(start, 2.5)
    z = v * np.cos(frequency * t + phase) + a * np.cos(t) + b * np.sin(t)
    assert found.z == pytest.approx(z, abs=1e-10)
    assert found.phase == pytest.approx(phase + frequency * t)


def test_a_force_is_the_pull_of_a_block_that_slips_freely(rng):
    """A second block, z'' = -Omega^2 z without friction, pulls the first and feels nothing of it."""
    frequency, friction, damping = rng.uniform(0.1, 0.9), rng.uniform(0.05, 0.6), rng.uniform(0.0, 0.2)
    start, t_end = State(*rng.normal(size=3)), 60.0
    pair = System([[1.0, -1.0], [0.0, frequency**2]], [damping, 0.0], [friction, 0.0], 0.0)
    z0, w0 = [start.z, np.cos(start.phase)], [start.w, -frequency * np.sin(start.phase)]
    pulled = simulate(pair, z0, w0, t_end, tol=1e-12, stop_early=False)
    block = Forced(frequency, friction, damping)
    forced = block.run(start, t_end / block.cycle)
    is_first = pulled.events.block == 0
    assert np.array_equal(pulled.events.mode[is_first], forced.events.mode)
    np.testing.assert_allclose(pulled.events.t[is_first], forced.events.t, rtol=0, atol=1e-9)
    assert pulled.z[0] == pytest.approx(forced.z[0], abs=1e-9)


def test_a_force_below_the_friction_moves_nothing(rng):
    start = State(0.0, 0.0, rng.uniform(0, 6))
    assert Forced(0.7, 1.001).after(start, 3.0)[:2] == pytest.approx((0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(("frequency", "friction"), [(1 / 2, 1 / 3), (1 / 4, 1 / 15), (1 / 6, 1 / 35)])
def test_where_the_force_is_an_even_fraction_u_is_none(frequency, friction):
    """Then H is 1 / Omega^2, and most friction Omega^2 / (1 - Omega^2)."""
    assert shape(frequency)[1] == pytest.approx(0.0, abs=1e-12)
    assert most_friction(frequency) == pytest.approx(friction, rel=1e-9)


def test_the_sliding_cycle_is_where_random_starts_end(rng):
    frequency = rng.choice([0.3, 0.45, 0.7, 1.3])
    block = Forced(frequency, 0.7 * most_friction(frequency))
    cycle = sliding_cycle(block)
    found = block.after(State(rng.normal(), rng.normal(), cycle.phase), 300)
    assert found.z == pytest.approx(cycle.z, abs=1e-9)
    assert found.w == pytest.approx(0.0, abs=1e-9)
    half = block.after(cycle, 0.5)
    assert half.z == pytest.approx(-cycle.z, abs=1e-11)


def test_it_stops_from_the_boundary_on(rng):
    for frequency in rng.uniform(0.15, 2.0, 5):
        _, u, h = shape(frequency)
        if abs(u) > 100 * h:  # so close to 1, 1/3 or 1/5 that there is no cycle either from where it stops on
            continue
        most = most_friction(frequency)
        if most < 1e-4:  # so close to them that 1e-5 of it, a thousand millionth of z, shows in no event
            continue
        counts = []
        for factor in (1 - 1e-5, 1 + 1e-5):
            block = Forced(frequency, factor * most)
            counts.append(sum(block.stops(sliding_cycle(block), 1, 4)))
        assert counts[0] == 0 < counts[1]


def test_cycles_about_any_shift_up_to_the_boundary_and_none_beyond():
    block = Forced(0.5, 0.2)
    start, most = sliding_cycle(block), 1 / 3 - 0.2
    for share, moves in ((0.5, False), (-0.99, False), (1.05, True), (-1.2, True)):
        shifted = start._replace(z=start.z + share * most)
        assert (abs(block.after(shifted, 20).z - shifted.z) > 1e-6) is moves
    near = Forced(0.51, 0.2)
    shifted = sliding_cycle(near)._replace(z=sliding_cycle(near).z + 0.5 * most)
    assert near.after(shifted, 300).z == pytest.approx(sliding_cycle(near).z, abs=1e-3)


def test_multipliers_of_a_damped_oscillator():
    """Without friction both are exp(-R T / 2) in size."""
    block = Forced(0.7, 0.0, 0.2)
    sizes = np.abs(block.multipliers(State(0.3, 0.2, 0.0)))
    np.testing.assert_allclose(sizes, np.exp(-0.1 * block.cycle), rtol=1e-6)


# steady sliding


@pytest.fixture(scope="module")
def basin():
    return one_block.basin(np.random.default_rng(0), 4)


def test_the_basin_is_that_of_the_converged_grid(basin):
    assert basin.share == pytest.approx(0.3071, abs=5e-5)
    assert max(basin.w) < one_block.BELT  # the cycle does not touch the belt
    assert basin.z[-1] == pytest.approx(basin.z[0], abs=0.01)


@pytest.mark.parametrize(("beside", "slides"), [(1e-3, True), (-1e-3, False)])
def test_its_edge_by_another_integrator(beside, slides, basin):
    """SciPy, while w < v: a start beside the unstable cycle reaches the belt's speed, or never does."""

    def rate(t, y):
        friction = 0.5 + 0.5 * np.exp((y[1] - 1.5) / 0.5)
        return [y[1], -y[0] - 0.1 * y[1] + friction]

    def on_belt(t, y):
        return y[1] - 1.5

    on_belt.terminal = True
    found = solve_ivp(rate, (0.0, 1000.0), [basin.z[0] + beside, 0.0], events=on_belt, rtol=1e-9, atol=1e-9)
    assert (len(found.t_events[0]) == 0) is slides


# claims and page


def plain(**changes):
    found = Measured(
        [Period(0.0, 0.3, 0.2, 7.0, 7.0), Period(0.1, 0.3, 0.2, 7.0, 7.0)],
        [Sliding(0.5, 0.3, 1e-14, 0, 10)] * 3,
        [Stability(0.5, 0.1, 0.1, 0.8)] * 100,
        [Shifted(0.5, 0.1, 0.4, 1e-12, 1.0)] * 3,
        [Stops(0.3, 0.5, n) for n in (0, 2, 4) * 40],
        Basin(0.30713, [0.0], [0.0], [(0.0, 1.0, True), (1.0, 2.0, False)], [(0.0, 1.5)]),
    )
    return replace(found, **changes)


def test_claims_hold_where_they_should():
    assert {claim(plain())["verdict"] for claim in one_block._CLAIMS} == {"reproduced"}


@pytest.mark.parametrize(
    ("claim", "changes", "verdict"),
    [
        ("free_period", {"periods": [Period(0.0, 0.3, 0.2, 7.0, 7.1)]}, "not reproduced"),
        ("amplitude", {"sliding": [Sliding(0.5, 0.3, 1e-6, 0, 10)]}, "not reproduced"),
        ("boundary", {"sliding": [Sliding(0.5, 0.3, 0.0, 0, 10), Sliding(0.5, 0.3, 0.0, 1, 10)]}, "not reproduced"),
        ("stable", {"stability": [Stability(0.5, 0.1, 0.1, 1.1)] * 100}, "not reproduced"),
        ("stable", {"stability": [Stability(0.5, 0.1, 0.1, None)] * 100}, "cannot be told"),
        ("continuum", {"shifted": [Shifted(0.5, 0.1, 0.4, 1e-12, 0.9)]}, "not reproduced"),
        ("continuum", {"shifted": [Shifted(0.5, 0.1, 0.4, 1e-3, 1.0)]}, "not reproduced"),
        ("stops", {"stops": [Stops(0.3, 0.5, 3)] * 100}, "not reproduced"),
        ("stops", {"stops": [Stops(0.3, 0.5, None)] * 100}, "not reproduced"),
        ("steady_sliding", {"basin": replace(plain().basin, share=0.312)}, "not reproduced"),
    ],
)  # fmt: skip
def test_a_claim_is_judged_by_what_was_measured(claim, changes, verdict):
    assert getattr(one_block, claim)(plain(**changes))["verdict"] == verdict


def test_the_page(tmp_path):
    file = tmp_path / "tiny.toml"
    file.write_text(TINY)
    scene = load_chart(file)
    report = runner.report(scene, scene.measure(lambda line: None))
    assert report.html.count('class="verdict ') == len(report.tables["claims"]) == 8
    assert not re.search(r">\s*(nan|inf|None)\s*<", report.html)
    assert set(report.tables) == {"claims", "periods", "sliding", "stability", "shifted", "stops"}
    assert report.headline[1].startswith("Of 8 claims ")
