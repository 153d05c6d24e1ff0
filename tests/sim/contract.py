"""The rules of `stickslip.sim.engines.contract`, held against an engine by its name, whoever wrote it."""

from __future__ import annotations

from functools import partial

import numpy as np

from stickslip import sim
from stickslip.sim import IntegrationError, Run, System, draw_system


def changes(run: Run, t_start: float = 0.0, order: list[int] | None = None) -> list[tuple[float, int, int]]:
    """The events in order, of blocks renumbered; times from the start, to what rounding and tolerances leave."""
    events = run.events
    block = events.block if order is None else np.asarray(order)[events.block]
    times = np.round(events.t - t_start, 6)
    return sorted(zip(times.tolist(), block.tolist(), events.mode.tolist(), strict=True))


def require_rules(name: str, rng: np.random.Generator, **settings: float) -> None:
    """AssertionError if runs of the engine break a rule."""
    simulate = partial(sim.simulate, engine=name, stop_early=False, **settings)
    n, t_end = 6, 6.0
    system = draw_system("antisymmetric", n, int(rng.integers(1000)), kappa=1.0, rho=0.5)
    z0, w0 = rng.normal(size=(2, n))
    w0[0] = system.belt_speed
    start = z0.copy(), w0.copy()
    run = simulate(system, z0, w0, t_end)
    events, again = run.events, simulate(system, z0, w0, t_end)
    assert np.array_equal([z0, w0], start)
    assert run.z.dtype == run.w.dtype == np.float64
    assert [run.z.tobytes(), run.w.tobytes()] == [again.z.tobytes(), again.w.tobytes()]
    assert changes(run) == changes(again)
    assert len(events) > 0
    assert (np.lexsort((events.block, events.t)) == np.arange(len(events))).all()
    assert ((events.t >= 0.0) & (events.t <= t_end)).all()
    mode = events.initial_mode.copy()
    for block, new in zip(events.block, events.mode, strict=True):
        assert mode[block] != new
        mode[block] = new

    times = np.linspace(0.0, t_end, 7)
    sampled = simulate(system, z0, w0, t_end, t_eval=times)
    assert changes(sampled) == changes(run)
    assert [sampled.z.tobytes(), sampled.w.tobytes()] == [run.z.tobytes(), run.w.tobytes()]
    np.testing.assert_allclose(sampled.samples.z[[0, -1]], [z0, run.z], atol=1e-12)

    order = rng.permutation(n)
    other = System(system.stiffness[np.ix_(order, order)], system.damping[order], 1.0, system.belt_speed)
    renumbered = simulate(other, z0[order], w0[order], t_end)
    np.testing.assert_allclose(renumbered.z, run.z[order], atol=1e-7)
    assert changes(renumbered, order=order.tolist()) == changes(run)
    later = simulate(system, z0, w0, 40.0 + t_end, t_start=40.0)
    np.testing.assert_allclose(later.z, run.z, atol=1e-7)
    assert later.t_end == 40.0 + t_end

    try:
        escaped = simulate(System([[-400.0]], 0.0, 1.0, -0.2), 1.0, 0.0, 100.0, stop_early=True)
    except IntegrationError:
        return
    assert escaped.outcome == "diverged"
