"""An attractor: what a run settles on, and whether two runs settle on the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from stickslip.sim.attractors.rounds import symbols_of
from stickslip.sim.numerics.arguments import Floats
from stickslip.sim.runs.run import Samples
from stickslip.sim.runs.series import EventSeries

Kind = Literal["rest", "sliding", "periodic", "torus", "irregular", "escaping", "undecided"]

#: Kinds of motion that never come back to one state.
_NO_SECTION = ("torus", "irregular")


@dataclass(frozen=True, eq=False)
class Attractor:
    """What a run settles on (dimensionless).

    Attributes
    ----------
    kind : str
        "rest": all blocks stick for ever; "sliding": all slip for ever, and their velocities go to zero; "periodic";
        "torus": it follows forces that have no common period, so that all starts nearby come to one motion;
        "irregular": chaotic, perhaps for a time; "escaping": the run diverged, or what follows on it does;
        "undecided": the run is too short to tell, or has several frequencies of its own.
    reason : str
        How it is known, or why it is not.
    period : float or None
        Of a periodic run.
    multiplier : float or None
        Of a periodic run: the largest modulus of its Floquet multipliers, but for those of a shift in time and of
        shifts of z at which no spring pulls; 0 if it is below
        100 `tol`, at most 1e-4. Below one the cycle attracts; above, only
        symmetry or chance keeps the run on it. None if it would take too long, or a block with static friction above
        the kinetic leaves at the instant of another's event that damping couples to it.
    growth_rate : float or None
        Of an irregular run: the rate at which small deviations grow, but for shifts in time. Of an undecided one that
        has many events, and on a torus, where it is negative: the same.
    drift : float64, shape (n,), or None
        Of a periodic run: by what z changes in a period, where springs do not hold the blocks to the ground; else 0.
    events : EventSeries or None
        Of one period, from t = 0 on; of an irregular run, or on a torus, those that follow on its end.
    states : Samples or None
        The state at each of these events; of a period without events, the state at a whole number of periods; on a
        torus without events, that at the end of the run; of rest and sliding, the one state at which the run is, or
        to which it comes.
    size : float or None
        Of a periodic run: how large its motion is.
    free : array or sparse array, shape (n, k), or None
        Of a periodic run: displacements at which no spring pulls, orthonormal.
    """

    kind: Kind
    reason: str = ""
    period: float | None = None
    multiplier: float | None = None
    growth_rate: float | None = None
    drift: Floats | None = None
    events: EventSeries | None = None
    states: Samples | None = None
    size: float | None = None
    free: Any = None

    @property
    def n_events(self) -> int | None:
        """Events a period; None if not periodic."""
        return len(self.events) if self.kind == "periodic" and self.events is not None else None

    @property
    def n_exits(self) -> int | None:
        """Exits a period; None if not periodic."""
        return self.events.counts()["n_exits"] if self.kind == "periodic" and self.events is not None else None

    @property
    def section(self) -> tuple[Floats, Floats] | None:
        """z and w, shape (n,) each, at one event of the cycle, the same whatever the start; None if there is none.

        The events of a cycle begin where their (block, mode), in order, are lowest; where several places are alike,
        where z of the event's block is lowest.
        """
        return None if self.states is None or self.kind in _NO_SECTION else (self.states.z[0], self.states.w[0])

    @property
    def busiest(self) -> int | None:
        """The block with most exits in `events`, the lowest of several; None if there are no exits."""
        if self.events is None or not (leaves := self.events.is_exit).any():
            return None
        return int(np.bincount(self.events.block[leaves]).argmax())

    def at_exits(self, block: int | None = None) -> Floats:
        """z of a block at each of its exits in `events`, shape (m,); default: the `busiest`."""
        block = self.busiest if block is None else block
        if block is None or self.events is None or self.states is None:
            return np.empty(0)
        return np.asarray(self.states.z[self.events.is_exit & (self.events.block == block), block])

    def __repr__(self) -> str:
        if self.kind == "periodic":
            multiplier = "" if self.multiplier is None else f", multiplier {self.multiplier:.4g}"
            return f"Attractor(periodic, period {self.period:.9g}, {self.n_events} events{multiplier})"
        return f"Attractor({self.kind}{'' if self.growth_rate is None else f', growth rate {self.growth_rate:.3g}'})"


def same_cycle(one: Attractor, other: Attractor, tolerance: float = 1e-5) -> bool:
    """Whether two attractors are one: the same cycle, or rest or sliding at the same state.

    Cycles are one if they have the same events, in order from some event on, and periods and the states at that event
    agree, but for a shift of z at which no spring pulls.

    Parameters
    ----------
    one, other : Attractor
    tolerance : float
        Of the period, relative, and of the states, over the size of the motion, or at rest over the largest number.
    """
    if one.kind != other.kind or one.states is None or other.states is None or one.kind in _NO_SECTION:
        return False
    if one.states.z.shape != other.states.z.shape:
        return False
    if one.period is not None and abs(one.period - (other.period or 0.0)) > tolerance * one.period:
        return False
    z, other_z = one.states.z, other.states.z
    if one.free is not None:
        z, other_z = (displacement - displacement @ one.free @ one.free.T for displacement in (z, other_z))
    dz, dw = other_z - z[0], other.states.w - one.states.w[0]
    sizes = (one.size or _largest(one.states), other.size or _largest(other.states))
    allowed = tolerance * max(sizes)
    agrees = (np.abs(dz) <= allowed).all(axis=1) & (np.abs(dw) <= allowed).all(axis=1)
    if one.events is None or other.events is None:
        return bool(agrees[0])
    mine, its = symbols_of(one.events), symbols_of(other.events)
    return any((np.roll(its, -k) == mine).all() for k in np.flatnonzero(agrees))


def _largest(states: Samples) -> float:
    return float(max(np.abs(states.z).max(), np.abs(states.w).max()))
