"""The stiff engine against an independent method, and its limit eps -> 0."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stickslip.sim import System, draw_system, simulate
from stickslip.sim.engines.certificates import Collapse, Smoothed

START = (-0.7, -0.4)


def by_dop853(system, eps, ratio, t_end, tol):
    """An explicit method of order 8: stable only at steps far below delta, and accurate there."""
    n = system.n

    def f(_, y):
        z, w = y[:n], y[n:]
        pull = system.friction * np.tanh((w - system.belt_speed) / (ratio * eps))
        return np.concatenate((w, -system.damping * w - system.stiffness @ z - pull))

    y0 = np.concatenate((np.full(n, START[0]), np.full(n, START[1])))
    y = solve_ivp(f, (0, t_end), y0, method="DOP853", rtol=tol, atol=tol).y[:, -1]
    return y[:n], y[n:]


@pytest.mark.long
@pytest.mark.parametrize("stiffness", ["equal", "uniform"])
def test_error_against_an_explicit_method(stiffness):
    """n = 200, T = 12, eps = 0.03: at rtol = atol = 1e-6 the state is right to 1e-4 (and to 1e-5)."""
    system = draw_system("antisymmetric", 200, seed=1)
    ratio = np.ones(200) if stiffness == "equal" else np.random.default_rng(5).uniform(0, 1, 200)
    z, w = by_dop853(system, 0.03, ratio, 12.0, 1e-10)
    run = simulate(system, *START, 12.0, engine="sigmoid", eps=0.03, ratio=ratio, rtol=1e-6, atol=1e-6)
    assert np.abs(run.z - z).max() < 1e-5
    assert np.abs(run.w - w).max() < 1e-5


def test_rtol_counts_where_values_are_large_and_atol_where_they_are_small():
    """The same free oscillation, z = size cos t, from far out and from close by."""
    system = System([[1.0]], 0.0, 0.0, 0.0)

    def steps(size, rtol, atol):
        run = simulate(system, size, 0.0, 20.0, engine="sigmoid", rtol=rtol, atol=atol)
        assert abs(run.z[0] - size * np.cos(20.0)) < 100 * (atol + rtol * size)
        return run.stats.n_steps

    of_rtol, of_atol = {"rtol": 1e-5, "atol": 1e-9}, {"rtol": 1e-9, "atol": 1e-5}
    assert 2 * steps(1e3, **of_rtol) < steps(1e3, **of_atol)
    assert 2 * steps(1e-3, **of_atol) < steps(1e-3, **of_rtol)


def test_the_error_of_z_is_kept_too():
    """A slow oscillation, z = 100 sin(t / 100), w = cos(t / 100): what w errs by, z errs by a hundredfold."""
    run = simulate(System([[1e-4]], 0.0, 0.0, 0.0), 0.0, 1.0, 500.0, engine="sigmoid", rtol=1e-12, atol=1e-6)
    assert abs(run.z[0] - 100 * np.sin(5.0)) < 3e-5


@pytest.mark.parametrize("share", [0.93, 1.01])
@pytest.mark.parametrize("delta", [0.02, 0.1])
def test_collapse_under_the_smoothed_law_is_certain_where_the_bound_says(share, delta):
    """One block off its rest, K = 1, R = 3, mu = 0.8, v = -0.2.

    With the damping d = R + mu sech^2(v / delta) / delta its eigenvalues are (-d +- q) / 2, q^2 = d^2 - 4; from
    z = rest + dz, w = 0 both modes of w have the size |dz| / q. A force of at most rho moves w by at most 2 rho / q,
    rho(r) = mu (tanh(v / delta) - tanh((v - r) / delta) - r sech^2(v / delta) / delta). So it is certain while
    2 |dz| / q < max r - 2 rho(r) / q; r is tried in steps of 6%.
    """
    speed, mu = 0.2, 0.8
    system = System([[1.0]], 3.0, mu, -speed)
    slope = 1 / np.cosh(speed / delta) ** 2 / delta
    q = np.sqrt((3.0 + mu * slope) ** 2 - 4.0)
    r = np.linspace(0.0, speed, 100_001)
    limit = (r - 2 / q * mu * (np.tanh(speed / delta) - np.tanh((speed - r) / delta) - r * slope)).max()
    z = -mu * np.tanh(speed / delta) + share * limit * q / 2
    certificate = Collapse(system, 0.0, Smoothed(speed, np.array([delta]))).certify(np.array([z]), np.zeros(1))
    assert certificate.is_certain == (share < 1)
    assert certificate.flow is None  # that strays from the tangent by more than nothing


def errors_against_coulomb(system, eps, t_end):
    """Largest error of the state, and of the times of exits and entries, over blocks with the same events."""
    exact = simulate(system, *START, t_end, tol=1e-13, stop_early=False)
    run = simulate(system, *START, t_end, engine="sigmoid", eps=eps, rtol=1e-9, atol=1e-9, stop_early=False)
    state = max(np.abs(run.z - exact.z).max(), np.abs(run.w - exact.w).max())
    late: dict[str, list[float]] = {"entries": [], "exits": []}
    n_other = 0
    for block in range(system.n):
        a, b = (events.block == block for events in (exact.events, run.events))
        if exact.events.mode[a].tolist() != run.events.mode[b].tolist():
            n_other += 1
            continue
        gap = np.abs(exact.events.t[a] - run.events.t[b])
        kind = exact.events.mode[a] == 0
        late["entries"] += gap[kind].tolist()
        late["exits"] += gap[~kind].tolist()
    return state, max(late["exits"]), max(late["entries"]), n_other


def test_converges_to_coulomb():
    """The error of state and exits is O(eps); entries see the band eps ln(1/eps), over the speed of approach."""
    table = []
    for eps in (0.03, 0.01, 0.003, 0.001, 0.0003):
        table.append((eps, *errors_against_coulomb(draw_system("antisymmetric", 20, seed=3), eps, 25.0)))
        print("eps {:7.4f}  state {:.2e}  exits {:.2e}  entries {:.2e}  other {}".format(*table[-1]))
    eps, state, exits, entries, n_other = (np.array(column) for column in zip(*table, strict=True))
    assert (n_other == 0).all()
    assert (np.diff(entries) < 0).all()
    for error in (state, exits):
        order = np.polyfit(np.log(eps[1:]), np.log(error[1:]), 1)[0]
        assert 0.85 < order < 1.15


def test_the_plain_threshold_does_not_converge():
    """|w - v| < c delta means |lambda| < tanh c: with c = 1 exits stay early by (1 - tanh 1) / |lambda'|."""
    system = System([[1.0]], damping=0.1)  # |lambda'| = kappa |v| = 0.2; sticks from the start at z = 0
    exact = simulate(system, 0.0, -0.2, 8.0, tol=1e-13).events
    assert exact.mode.tolist() == [1]
    for eps in (1e-3, 1e-4):
        run = simulate(system, 0.0, -0.2, 8.0, engine="sigmoid", eps=eps, stick="threshold", rtol=1e-9, atol=1e-9)
        assert run.events.mode.tolist() == [1]
        assert exact.t[0] - run.events.t[0] == pytest.approx((1 - np.tanh(1)) / 0.2, rel=0.02)
