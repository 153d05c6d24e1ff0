"""What both engines share around their kernels: the loop that Python keeps, in slices, so that signals get through.

A kernel advances a run by a slice and returns ``(status, n_recorded)``; the run's state lives in the arrays it was
given, so the next call goes on where the last one stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.arguments import Floats
from stickslip.sim.engines import certificates
from stickslip.sim.run import IntegrationError, Outcome, Run, Samples, Stats
from stickslip.sim.series import EventSeries, without_returns
from stickslip.sim.system import System

#: Why a kernel came back.
DONE, BUFFER_FULL, PAUSED, ALL_SLIP, DIVERGED, STALLED = range(6)
#: Steps a slice: some hundredths of a second at n = 200.
STEPS_A_SLICE = 5_000

#: Counters that every engine keeps, int64.
N_STEPS, N_REJECTED, N_PRODUCTS, LAST_BLOCK, N_STALLED, N_SAMPLED, N_COUNTERS = range(7)
#: Clocks that every engine keeps, float64: the time, and after when a collapse may be certified next, with all blocks
#: slipping left and (the next clock) right. An engine may keep more behind them. After, not at: a run that was just
#: asked takes a step before it is asked again, or it would be asked for ever.
TIME, CHECK, _CHECK_RIGHT, N_CLOCKS = range(4)

Buffers: TypeAlias = tuple[Floats, NDArray[np.int32], NDArray[np.int8]]


def complete(
    system: System,
    advance: Callable[[Buffers, float], tuple[int, int]],
    certify: Callable[[int], certificates.Certificate],
    stalled: str,
    events_a_step: int,
    t_start: float,
    t_end: float,
    z: Floats,
    w: Floats,
    mode: NDArray[np.int8],
    initial_mode: NDArray[np.int8],
    clock: Floats,
    counters: NDArray[np.int64],
    samples: Samples,
    stop_early: bool,
    thresholds: tuple[float, ...] = (),
    shortest: Floats | None = None,
) -> Run:
    """Call `advance` until the run ends, gather its events, and say how it ended.

    Parameters
    ----------
    advance : callable
        Runs a slice, writing events (t, block, mode) into the buffers it is given, until the state passes a bound.
        Those of one block come in order; all are put in order of time and block here.
    certify : callable
        From the common direction of slip to a certificate of collapse.
    stalled : str
        What to say, after the time and the block, when the engine cannot go on.
    events_a_step : int
        The most events that a step can record.
    z, w, mode, clock, counters, samples
        The state that `advance` works on, and where it puts the samples.
    stop_early : bool
        Whether a run whose escape is certain, or past doubt, ends there; `certify` is asked when the clocks say so.
    initial_mode : int8, shape (1 + m, n)
        The first row by the engine's own definition of sticking, the others by each of `thresholds`. Events by
        definition d carry block + d n.
    shortest : ndarray, shape (n,), optional
        How long a change of each block's mode must last to be an event: see `without_returns`.
    """
    capacity = max(2 * events_a_step, 4096)
    buffers = (np.empty(capacity), np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int8))
    recorded: list[Buffers] = []
    bound, diverged_beyond = certificates.escape_bounds(system, z, w)
    outcome: Outcome = "finished"
    reason, t_collapse = "", None
    while True:
        status, n_recorded = advance(buffers, bound)
        recorded.append(tuple(buffer[:n_recorded].copy() for buffer in buffers))  # type: ignore[arg-type]
        t = float(clock[TIME])
        if status == DONE:
            break
        if status == ALL_SLIP:
            slip = int(mode[0])
            certificate = certify(slip)
            if certificate.is_certain and t_collapse is None:
                outcome, reason, t_collapse = "collapsed", certificate.reason, t
            if certificate.flow is not None:
                _follow(certificate.flow, t, t_end, z, w, samples, int(counters[N_SAMPLED]))
                t, counters[N_SAMPLED] = t_end, len(samples)
                break
            clock[CHECK + (slip > 0)] = t + certificate.ask_again_after
        elif status == DIVERGED:
            speed = float(np.abs(w).max())
            size = max(float(np.abs(z).max()), speed)
            if not np.isfinite(size):
                pass  # said below
            elif stop_early and (reason := certificates.escape(system, z, w)):
                outcome = "diverged"
                break
            elif size > certificates.BEYOND_NUMBERS or (
                stop_early and speed > diverged_beyond and certificates.grows(system)
            ):
                outcome, reason = "diverged", certificates.divergence_reason(z, w, t, min(size, diverged_beyond))
                break
            else:
                bound = 2.0 * size
        elif status == STALLED:
            raise IntegrationError(f"no progress at t = {t!r}, at block {counters[LAST_BLOCK]}: {stalled}")
        if not (np.isfinite(z).all() and np.isfinite(w).all()):
            raise IntegrationError(
                f"the state is not finite after t = {t!r}: numbers of this size leave float64; scale the system"
            )
    event_t, event_block, event_mode = (np.concatenate(parts) for parts in zip(*recorded, strict=True))
    order = np.lexsort((event_block, event_t))  # stable: instants that round to one time keep each block's order
    event_t, event_block, event_mode = event_t[order], event_block[order], event_mode[order]
    definition, event_block = np.divmod(event_block, np.int32(system.n))
    series = [
        EventSeries(event_t[of], event_block[of], event_mode[of], initial_mode[d], t_start, t)
        for d, of in enumerate(definition == d for d in range(1 + len(thresholds)))
    ]
    if shortest is not None:
        series[0] = without_returns(series[0], shortest)
    n_steps, n_rejected, n_products = (int(counters[k]) for k in (N_STEPS, N_REJECTED, N_PRODUCTS))
    return Run(
        z=z,
        w=w,
        t_end=t,
        events=series[0],
        outcome=outcome,
        reason=reason,
        stats=Stats(n_steps, n_rejected, n_products, len(series[0])),
        t_collapse=t_collapse,
        samples=samples.first(int(counters[N_SAMPLED])),
        by_threshold=dict(zip(thresholds, series[1:], strict=True)),
    )


def _follow(
    flow: certificates.Flow, t: float, t_end: float, z: Floats, w: Floats, samples: Samples, n_sampled: int
) -> None:
    """Put the state at t_end, and the samples from number `n_sampled` on, in their places."""
    at_end, sampled = (flow.at(times - t) for times in (np.array([t_end]), samples.t[n_sampled:]))
    z[:], w[:] = at_end[0][0], at_end[1][0]  # apart: a product of other shape rounds otherwise
    samples.z[n_sampled:], samples.w[n_sampled:] = sampled
