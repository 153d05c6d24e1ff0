"""SI units at the door: closed forms in seconds, metres and newtons, and any scales give the same motion."""

import inspect
import math

import numpy as np
import pytest
import scipy.sparse

from stickslip import Harmonic, Piecewise, Rational, Scales, Stribeck, System, simulate
from stickslip.sim.energy import energy


def test_the_period_of_stick_and_slip_in_seconds_and_its_reach_in_metres(rng):
    """One undamped block, m x'' + k x = -F, belt V, drop D = F_s - F_k (Den Hartog's construction).

    It sticks for 2 D / (k V), slips for 2 (pi - atan(D omega / (k V))) / omega, omega^2 = k / m; about its
    rest, F_k / k, it swings by sqrt((D / k)^2 + (V / omega)^2).
    """
    for _ in range(2):
        m, k, load, belt = 10 ** rng.uniform([-3, 2, 0, -3], [3, 8, 4, 0])
        kinetic, static = 0.3, rng.uniform(0.4, 0.9)
        drop, omega = (static - kinetic) * load, math.sqrt(k / m)
        system, scales = System.from_physical(
            [[k]],
            0.0,
            kinetic,
            -belt,  # to the left: it leaves to the right
            mass=m,
            normal=load,
            static=static,
        )
        stick = 2 * drop / (k * belt)
        slip = 2 / omega * (math.pi - math.atan(drop * omega / (k * belt)))
        t_end = (static * load / (k * belt) + 3.2 * (stick + slip)) / scales.time
        run = simulate(system, 0.0, "belt", t_end, tol=1e-13)
        exits = run.events.t[run.events.mode != 0] * scales.time
        entries = run.events.t[run.events.mode == 0] * scales.time
        np.testing.assert_allclose(exits[0], static * load / (k * belt), rtol=1e-12)
        np.testing.assert_allclose(np.diff(exits), stick + slip, rtol=1e-9)
        np.testing.assert_allclose(entries - exits[: len(entries)], slip, rtol=1e-9)
        t = np.linspace(exits[0], exits[0] + slip, 2001) / scales.time
        reach = simulate(system, 0.0, "belt", t_end, t_eval=t, tol=1e-10).samples.z.max() * scales.length
        amplitude = math.hypot(drop / k, belt / omega)
        assert reach == pytest.approx(amplitude - kinetic * load / k, abs=1e-4 * amplitude)


@pytest.mark.parametrize("law", ["rational", "stribeck"])
def test_any_scales_give_the_same_motion(law, rng):
    """With all that a system is given: events in seconds, states in metres, energies in joules."""
    n = 3
    k = 1e4 * (np.diag(rng.uniform(2.0, 3.0, n)) - rng.uniform(0.0, 0.5, (n, n)))
    given = {
        "damping": rng.uniform(1.0, 5.0, n),
        "friction": rng.uniform(0.3, 0.5, n),
        "belt_speed": Piecewise([0.0, 0.5], [[-0.1] * n, rng.uniform(-0.2, -0.1, n)]),
        "mass": rng.uniform(0.5, 2.0, n),
        "normal": rng.uniform(50.0, 80.0, n),
        "static": 0.6,
        "force": [Harmonic(rng.uniform(1.0, 5.0, n), 60.0, 0.3), Piecewise([0.1, 0.3], [0.0, 4.0]), 0.5],
        "weakening": {"rational": Rational(4.0), "stribeck": Stribeck(0.2)}[law],
        "back_slip": law != "rational",
    }
    all_but = {"stiffness", "names", "normal"}  # what a new argument of `System` is in other units is tested here too
    assert given.keys() - all_but == inspect.signature(System).parameters.keys() - all_but
    found = []
    for scales in (None, Scales(*10 ** rng.uniform(-0.5, 0.5, 3) * [1e-3, 1e-2, 30.0])):
        system, by = System.from_physical(k, scales=scales, **given)
        start = np.full(n, 1e-3) / by.length, "belt"
        run = simulate(system, *start, 0.6 / by.time, tol=1e-13, stop_early=False)
        balance = energy(system, run, start[0], system.belt_speed_at(0.0), tol=1e-13, stop_early=False)
        found.append((run, run.events.t * by.time, run.z * by.length, run.w * by.speed, balance.heat[-1] * by.energy))
    (one, *si), (other, *again) = found
    assert len(one.events) > 0
    assert one.events.block.tolist() == other.events.block.tolist()
    assert one.events.mode.tolist() == other.events.mode.tolist()
    for a, b in zip(si, again, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)


def test_the_scales_of_a_system_and_of_its_parts():
    given = {"mass": [1.0, 3.0], "normal": [10.0, 30.0], "static": 0.6}
    dense, scales = System.from_physical([[300.0, -50.0], [-20.0, 100.0]], [1.0, 2.0], 0.5, 0.1, **given)
    assert (scales.length, scales.time, scales.force) == (10.0 / 200.0, 0.1, 10.0)
    assert (scales.speed, scales.mass, scales.stiffness) == pytest.approx((0.5, 2.0, 200.0))
    assert (scales.damping, scales.energy, scales.frequency) == pytest.approx((20.0, 0.5, 10.0))
    np.testing.assert_allclose(dense.stiffness, [[1.5, -0.25], [-0.1, 0.5]], rtol=1e-15)
    np.testing.assert_allclose(dense.damping, [0.05, 0.1], rtol=1e-15)
    np.testing.assert_allclose(dense.mass, [0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(dense.friction, [0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(dense.static, [0.6, 1.8], rtol=1e-15)
    assert dense.belt_speed == pytest.approx(0.2)
    sparse, same = System.from_physical(
        scipy.sparse.csc_array([[300.0, -50.0], [-20.0, 100.0]]), [[1.0, 4.0], [0.0, 2.0]], 0.5, 0.1, **given
    )
    assert same == scales
    np.testing.assert_allclose(sparse.stiffness.toarray(), dense.stiffness, rtol=1e-15)
    np.testing.assert_allclose(sparse.cross_damping, [[0.0, 0.2], [0.0, 0.0]], rtol=1e-15)
    kinetic, _ = System.from_physical([[1.0]], 0.0, 3.0, 0.1, mass=1.0)  # friction forces in N
    assert kinetic.static is kinetic.friction


@pytest.mark.parametrize(("changes", "words"), [
    ({"friction": 0.0}, "friction: expected a mean friction above 0, by which to scale, got 0; pass scales="),
    ({"stiffness": [[0.0]]}, "stiffness: expected a mean diagonal entry above 0"),
    ({"normal": -1.0}, "normal: expected normal >= 0, got -1 for block 0"),
    ({"mass": 0.0}, "mass: expected m > 0"),
    ({"normal": [1.0, 2.0]}, r"normal: expected a number or an array of shape \(1,\)"),
    ({"static": 0.1}, "static: expected at least the kinetic friction"),
])  # fmt: skip
def test_what_cannot_be_scaled_is_refused(changes, words):
    given = {"stiffness": [[1.0]], "damping": 0.0, "friction": 0.5, "belt_speed": 0.1, "mass": 1.0} | changes
    with pytest.raises(ValueError, match=words):
        System.from_physical(**given)


@pytest.mark.parametrize("given", [(0.0, 1.0, 1.0), (1.0, math.inf, 1.0), (1.0, 1.0, "N"), (1.0, 1e300, 1.0)])
def test_scales_are_numbers_above_zero(given):
    with pytest.raises((TypeError, ValueError), match=r"^(length|time|force): expected"):
        Scales(*given)


@pytest.mark.parametrize(("n", "terms"), [(80, {}), (7, {"static": 1.2}), (7, {"damping": 300.0})])
def test_a_belt_that_rubs_on_no_block_takes_no_accuracy(rng, n, terms):
    """However fast it is: the tolerance is relative to the belts of blocks with friction.

    K is positive definite, so that no block comes to a belt that does not rub. By series all is the same then. Waves,
    by which 80 blocks of one friction go, take other steps: of 475 draws the largest difference was 0.09 of the
    tolerance and the seventh 0.06, so that ten tolerances are no chance.
    """
    rubs = rng.permutation(n) < max(1, n // 2)
    root, z = rng.normal(size=(n, n)), rng.normal(size=n)
    k = root @ root.T / n + np.identity(n)

    def run(far):
        static = {"static": np.where(rubs, terms["static"], 0.0)} if "static" in terms else {}
        damping = np.where(rubs, 0.3, terms.get("damping", 0.3))
        belts = np.where(rubs, -0.2, -far)
        system = System(k, damping, friction=1.0 * rubs, belt_speed=belts, **static)
        return simulate(system, z, 0.0, 20.0, tol=1e-5, stop_early=False)

    near, far = run(50.0), run(1e5)
    assert near.stats.method == far.stats.method
    if near.stats.method == "Taylor series":
        for part in ("t", "block", "mode"):
            assert np.array_equal(getattr(far.events, part), getattr(near.events, part))
        assert np.array_equal(far.z, near.z)
    assert far.z == pytest.approx(near.z, rel=0, abs=1e-4)
