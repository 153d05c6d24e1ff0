"""What a run of the exact law settles on.

A run comes to rest, slides steadily, comes round to the same state again and again, or does none of these. Its last
events, if they repeat, say after how long it may have come round; going on with the run for as long again shows
whether the state comes back too, and gives the states at the events.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stickslip.sim.attractors.growth import TOL, Growth, growth
from stickslip.sim.attractors.multipliers import Path, largest
from stickslip.sim.attractors.newton import FAR, Near, Newton
from stickslip.sim.attractors.null_space import NULL, across, null_space
from stickslip.sim.attractors.result import Attractor
from stickslip.sim.attractors.rounds import Round, in_order, rounds_of, symbols_of
from stickslip.sim.engines import DEFAULT, ENGINES
from stickslip.sim.engines.certificates import steady_sliding
from stickslip.sim.numerics.arguments import Floats, apart, number
from stickslip.sim.numerics.session import numpy_arithmetic
from stickslip.sim.runs.run import Run, Samples
from stickslip.sim.runs.series import EventSeries, by_block, part_of
from stickslip.sim.simulation import as_engine, simulate
from stickslip.sim.systems.drive import Harmonic, Piecewise
from stickslip.sim.systems.system import System

#: A state has come back if it differs by less than this many tolerances of the run, of the size of its motion; the
#: same for times, of the period. Within bounds: of rounding, and of what can be told from a return by chance. Events
#: so close in time, of the shortest period that blocks can have, are at one instant.
_BACK, _CLOSEST, _WIDEST = 1e4, 1e-9, 1e-4
#: By so much of the largest z a state may miss itself, however small its motion: some thousand roundings.
_OF_Z = 1e-12
#: Rounds are compared as if events within so many times that were: blocks that synchronise change order from round to
#: round, at times apart that pass through the first bound, but hardly move near this one in a round that comes back.
_TOGETHER = 100.0
#: A cycle is larger than what its states may miss themselves by, and than their distance from it, so many times, of
#: which two are from one side to the other: what dies out is none.
_LARGER = 3.0
#: By so much of its static friction the force on a block that sticks may be above, from rounding.
_ROUNDING = 1e-9
#: States so close in time to an event, of the shortest period that blocks can have, are those at the event: by this
#: share of what a state on a cycle may miss itself by, and at most by the second. Slip is fast, and clocks round.
_OF_CLOSE, _MOST_OFF = 0.1, 1e-8
#: A part of a round that misses the state by less than so many times what is allowed is looked at in the same way.
_ALMOST = 1e3
#: A round comes back by itself, not as a spiral onto a part of it, if it comes back so much nearer than that part.
_APART = 0.02
#: A state that is off by more than so many tolerances after a round moves; within this share of its motion's size
#: from the cycle Newton's method is asked. What dies out under hardly any damping is further off.
_SEEN, _FAR = 100.0, 0.1
#: How often the last event must recur before a run is called irregular, the most rounds over which its growth rate is
#: taken, and the most events of an irregular run that are kept.
_FEW, _MOST_ROUNDS, _FOLLOWED = 30, 200, 512
#: No multiplier of a cycle with more than so many events times (2 n)^3: it would take some seconds.
_WORK = 2e9
#: Nor is a cycle of more than so many sought by Newton's method, which takes several.
_WORK_NEAR = 1e8
#: Forces are incommensurate if they are not at the same phase, but for rounding, after any number of turns of the
#: slowest that the run takes, nor of the first so many; more turns than the most are not looked at.
_SAME_PHASE, _FIRST_TURNS, _MOST_TURNS = 4e-15, 100, 10**6


@numpy_arithmetic()
def attractor(run: Run, system: System, t_burn: float = 0.0, *, engine: str = DEFAULT, **settings: Any) -> Attractor:
    """What a run of the exact engine settles on.

    Rest, sliding and escape are proved. A run is periodic if its last events, their blocks, modes and the times
    between them, repeat those of the period before, and in the period that follows, which is run, the state at an
    event comes back, within 1e4 `tol` of its motion's size. It is irregular if the last event recurs at least
    30 times without that, and runs that begin next to each other on its end part by e^3 and more, and by e in each
    half, and by 1.9 times the standard error of that, over the last two thirds of as much time as these events
    took, 200 rounds at most, or of the time until they have parted by e^30. If they come together by as much, under
    forces that are incommensurate, it is on a torus. This costs two runs of one or two periods, or of that time.

    Parameters
    ----------
    run : Run
        ``simulate(system, z0, w0, t_end, engine=engine, **settings)``
    system : System
    t_burn : float
        Events up to then do not count, nor those before the last bend of a belt's speed or a force.
    engine, **settings
        Those of the run.

    Raises
    ------
    TypeError, ValueError
        If the engine has not the exact law, the run is not one of such a system, or `t_burn` no time of it.
    """
    if engine not in ENGINES or not ENGINES[engine].is_exact:
        raise ValueError(f"engine: expected one of exact events, as {DEFAULT!r}, got {engine!r}; run it with that")
    series = run.events
    if series.n != system.n:
        raise ValueError(f"run: expected one of the system, of {system.n} blocks, got one of {series.n}")
    t_burn = number("t_burn", t_burn)
    if run.outcome == "diverged":
        return Attractor("escaping", run.reason)
    if not series.t_start <= t_burn <= run.t_end:
        low, high, time = apart(series.t_start, run.t_end, t_burn)
        raise ValueError(f"t_burn: expected a time in [{low}, {high}], got {time}")
    bends = [float(x.times[-1]) for x in (*system.force, system.belt_speed) if isinstance(x, Piecewise)]
    if max(bends, default=-math.inf) > run.t_end:
        why = "a force, a belt or a drive changes until after the end of the run"  # without times, which have units
        return Attractor("undecided", f"{why}; end the change, or lengthen the run")
    settings = {name: value for name, value in settings.items() if name != "stop_early"}
    tolerances = as_engine(engine, settings).tolerances
    try:
        return _End(run, system, max([t_burn, *bends]), tolerances, {"engine": engine, **settings}).found()
    except _Diverges as why:
        return Attractor("escaping", str(why))


def persisting(
    cycle: Attractor, run: Run, system: System, *, engine: str = DEFAULT, **settings: Any
) -> Attractor | None:
    """The cycle of a system that has the events of that of a system nearby, by Newton's method, if it attracts.

    Whatever the run's length: it has begun on the other's cycle. Of systems whose drive depends on time it is None.
    """
    tolerances = as_engine(engine, settings).tolerances
    try:
        return _End(run, system, run.events.t_start, tolerances, {"engine": engine, **settings}).persisting(cycle)
    except _Diverges:
        return None


def frequencies_of(system: System) -> list[float]:
    """Of the forces, rising, each once."""
    waves = (x for x in system.force if isinstance(x, Harmonic))
    return sorted({abs(f) for x in waves for f in x.frequency[x.amplitude != 0.0].tolist() if f})


class _Diverges(Exception):
    """What follows on a run does not last as long as was asked for."""


class _End:
    """The end of a run, and what follows on it."""

    def __init__(
        self, run: Run, system: System, since: float, tolerances: dict[str, float], settings: dict[str, Any]
    ) -> None:
        self._run, self._system, self._since, self._settings = run, system, since, settings
        self._tol = tol = max(tolerances.values(), default=0.0)
        #: settings of runs that part, or come together, by more than their errors
        self._finer: dict[str, Any] = {name: min(value, TOL) for name, value in tolerances.items()}
        self._back = min(max(_BACK * tol, _CLOSEST), _WIDEST)
        self._v = system.belt_speed_at(run.t_end)
        self._mode = run.events.mode_at(run.t_end)
        self._w = np.where(self._mode == 0, self._v, run.w)
        self._frequencies = frequencies_of(system)
        #: the shortest period that blocks can have: times are at one instant, or not, in units of it
        self._fastest = 2.0 * math.pi / system.fastest_rate if system.fastest_rate > 0.0 else 1.0
        #: where what follows begins: the time matters only where the drive depends on it
        self._start = run.t_end if system.changes else 0.0

    def found(self) -> Attractor:
        run = self._run
        if run.outcome == "collapsed":
            return self._sliding(run.reason)
        if self._is_at_rest():
            return Attractor("rest", "all blocks stick, and nothing loads them", states=_alone(run.z, self._w))
        if (
            self._mode.all()
            and not self._frequencies
            and (why := steady_sliding(self._now, run.z, run.w, self._mode))
        ):
            return self._sliding(why)
        first = int(np.searchsorted(run.events.t, self._since, side="right"))
        last = in_order(run.events, first, self._at_once)
        if len(last) == 0:
            return self._without_events()
        for cycle in rounds_of(in_order(run.events, first, self._together), self._back):
            if not self._has_phase(cycle.period):
                continue
            result = self._once_more(cycle, last) if cycle.is_back else self._settled(cycle)
            if result is not None:
                return result
        return self._not_periodic(last)

    @property
    def _now(self) -> System:
        """The system with the belts and forces of the end."""
        s = self._system
        return s.changed(belt_speed=self._v, force=s.force_at(self._run.t_end)) if s.changes else s

    @property
    def _close(self) -> float:
        """By how much of its motion's size a state on a cycle may miss itself."""
        return min(self._back, _SEEN * self._tol)

    @property
    def _together(self) -> float:
        return _TOGETHER * self._at_once

    @property
    def _at_once(self) -> float:
        return self._back * self._fastest

    # ---------------------------------------------------------------------------------------------- rest and sliding

    def _sliding(self, why: str) -> Attractor:
        rest = self._now.rest_under(self._now.kinetic(self._v) * np.sign(self._v))
        return Attractor("sliding", why, states=_alone(rest, np.zeros_like(rest)))

    def _is_at_rest(self) -> bool:
        """Whether all blocks stick, and neither belts nor forces ever load one enough to leave."""
        s = self._system
        if self._mode.any() or self._is_loaded_by(self._v):
            return False
        swing, steady = np.zeros(s.n), s.damping_force(self._v) + s.stiffness @ self._run.z
        for term in s.force:
            if isinstance(term, Harmonic):
                swing += np.abs(term.amplitude)
            else:
                steady -= term.at(self._run.t_end)
        outward = np.where(s.closed == 0, np.abs(steady), s.closed * steady)
        rounding = _ROUNDING * s.static + NULL * s.row_sums * np.abs(self._run.z).max()
        return bool((outward + swing <= s.static + rounding).all())

    def _is_loaded_by(self, shift: Floats) -> bool:
        """Whether springs pull at blocks that are moved so, for which they have to be stretched."""
        s = self._system
        return bool((np.abs(s.stiffness @ shift) > NULL * s.row_sums * np.abs(shift).max()).any())

    # ---------------------------------------------------------------------------------------------- cycles

    def _run_from(
        self, z: Floats, w: Floats, modes: NDArray[np.int8] | None, span: tuple[float, float], times: Floats,
        **settings: Any,
    ) -> Run:  # fmt: skip
        """A run of the system as the one that ended: a `Follow`."""
        return simulate(
            self._system, z, w, span[1], t_start=span[0], t_eval=times, modes=modes, stop_early=False,
            **self._settings | settings,
        )  # fmt: skip

    def _follow(self, length: float, times: Floats) -> Run:
        """The run from the end on, with the states at some times."""
        span = self._start, self._start + length
        run = self._run_from(self._run.z, self._w, self._mode, span, times)
        if run.outcome == "diverged":
            within = run.t_end - span[0]
            raise _Diverges(f"after the end of the run |z| or |w| passes every bound, within {within:.3g}")
        return run

    def _path(self, events: EventSeries, edges: Floats) -> Path:
        length = float(edges.max()) - self._start  # those of one instant are in the order of blocks
        return Path.of(self._system, events, edges, lambda times: self._follow(length, times).samples)

    def _has_phase(self, period: float) -> bool:
        """Whether all forces are at the same phase after a period, and have turned."""
        turns = [f * period / (2.0 * math.pi) for f in self._frequencies]
        return all(round(x) >= 1 and abs(x - round(x)) <= self._back * x for x in turns)

    def _whole(self, period: float) -> float:
        """A period that has a phase, in whole turns of the slowest force, if there is one."""
        if not self._frequencies:
            return period
        turn = 2.0 * math.pi / self._frequencies[0]
        return round(period / turn) * turn

    def _without_events(self) -> Attractor:
        """A run without events, which may follow a force and have its period."""
        advice = "; lengthen the run" if self._frequencies else ""
        none = Attractor("undecided", f"no event after t_burn, and no proof of steady sliding{advice}")
        if len(self._frequencies) > 1 and self._are_incommensurate():
            grown = self._growth(self._run.t_end - self._since)
            if grown is not None and grown.decays:
                return self._torus(grown.rate, None, _alone(self._run.z, self._w))
        if len(self._frequencies) != 1:
            return none
        period = 2.0 * np.pi / self._frequencies[0]
        first = math.ceil(self._start / period) * period
        events = self._follow(first + period - self._start, np.empty(0)).events
        path = self._path(events, np.array([first, first + period]))
        if not (len(events) or self._mode.any() or self._is_loaded_by(self._v)):
            return Attractor("rest", "all blocks stick through a period of the force", states=path.states.first(1))
        size = self._size(path)
        drift = self._drift(path, size, larger=0.0)  # it follows the force, however weak that is
        if len(events) or drift is None:
            return none
        matrix = path.monodromy(is_forced=True)
        if self._distance(path, drift, matrix) > self._back * size:
            return replace(none, reason="no event, and the state nearly comes back, but moves on; lengthen the run")
        multiplier = self._multiplier(matrix)
        events = replace(events, t_start=0.0, t_end=period)
        why = "the state comes back after a period of the force"
        facts = path.states.first(1), self._extent(path), null_space(self._system)
        return Attractor("periodic", why, period, multiplier, None, drift, events, *facts)

    def _once_more(self, cycle: Round, last: EventSeries) -> Attractor | None:
        """The cycle, if the run goes round it once more; else None."""
        p, begin = cycle.n_events, self._run.t_end - self._start
        expected = np.append(last.t[-p:], last.t[-p] + cycle.period) + (cycle.period - begin)
        expected = np.maximum.accumulate(np.maximum(expected, self._start))
        length = float(expected[-1]) - self._start + _TOGETHER * self._back * (self._fastest + cycle.period)
        once = np.append(np.arange(-p, 0), -p)
        foreseen = part_of(last, once, t=expected, initial_mode=self._mode, t_start=self._start)
        followed: list[Run] = []

        def follow(times: Floats) -> Samples:
            followed.append(self._follow(length, times))
            return followed[0].samples

        path = Path.of(self._system, foreseen, expected, follow)
        events, symbols = followed[0].events, symbols_of(last)[-p:]
        again = np.flatnonzero(symbols_of(events)[p:] == symbols[0])
        if len(again) == 0:
            return None
        # as in the round before, so that the first event comes first again
        order = np.append(np.empty(p, dtype=np.intp), p + again[0])
        order[by_block(last.block[-p:])] = by_block(events.block[:p])
        events = part_of(events, order)
        if (symbols_of(events)[:p] != symbols).any():
            return None
        if not (np.abs(events.t - expected) <= min(_OF_CLOSE * self._close, _MOST_OFF) * self._fastest).all():
            path = self._path(events, events.t)
        size, period = self._size(path), float(events.t[p] - events.t[0])
        drift = self._drift(path, size)
        if drift is None or not self._has_phase(period):
            return None
        period = self._whole(period)
        if (n_part := self._part(path, events, drift, size)) < p:
            # it settles from side to side, and is still too far off to be back after a part of the round; in so many
            # turns a spiral onto the shorter cycle may come as near as a longer cycle does
            return self._settled(Round(n_part, period * n_part / p, is_back=False))
        has_matrix = p * (2.0 * self._system.n) ** 3 <= _WORK and path.is_differentiable(self._at_once)
        matrix = path.monodromy(bool(self._frequencies)) if has_matrix else None
        multiplier = None if matrix is None else self._multiplier(matrix)
        distance = 0.0 if matrix is None else self._distance(path, drift, matrix)
        if distance > path.extent(drift) / _LARGER:
            return None  # as far from its end as it is large: it dies out
        if matrix is not None and np.abs(path.missed(drift)).max() > _SEEN * self._tol * size:
            # it may still be far from the cycle, by as much as it moves in all rounds to come
            is_neutral = multiplier is not None and abs(multiplier - 1.0) <= self._back  # how far is not known
            if is_neutral or distance > (_FAR if self._has_newton(p) else self._back) * size:
                why = "events come back, and so nearly does the state, which moves on; lengthen the run"
                return Attractor("undecided", why)
            if self._has_newton(p) and multiplier is not None and multiplier < 1.0:
                nearby = self._settled(Round(p, period, is_back=False))
                if nearby is not None:
                    return nearby
            if distance > self._back * size:
                return None
        why = f"{p} events, and the state at each, come back"
        return self._cycle(path, events, period, drift, multiplier, why)

    def _part(self, path: Path, events: EventSeries, drift: Floats, size: float) -> int:
        """Events of the shortest part of a round after which events repeat and the state nearly comes back.

        Not where it comes back so much nearer after the whole: a cycle whose period has doubled is near its half.
        Under a force, where no Newton step can tell, something else may die out as fast.
        """
        p = len(path.block)
        symbols = symbols_of(in_order(events, 0, self._together))[:p]
        off_whole = _off(path, p, drift)
        nearly, exactly = _ALMOST * self._back * size, self._close * size
        for n_part in range(1, p // 2 + 1):
            if p % n_part == 0 and (symbols[n_part:] == symbols[:-n_part]).all():
                off = _off(path, n_part, drift * (n_part / p))
                if off <= exactly or (off <= nearly and (self._system.changes or off_whole > _APART * off)):
                    return n_part
        return p

    def _has_newton(self, p: int) -> bool:
        """Whether Newton's method may be asked for a cycle of so many events: no force may depend on time."""
        return not self._system.changes and p * (2.0 * self._system.n) ** 3 <= _WORK_NEAR

    def _settled(self, cycle: Round) -> Attractor | None:
        """The cycle that the run comes nearer to, if it attracts; else None."""
        p = cycle.n_events
        answer = self._near(cycle)
        if answer is None:
            return None
        approach, drift, multiplier = answer
        size = self._size(approach.path)
        if approach.distance * size > approach.path.extent(drift) / _LARGER:
            return None  # it dies out
        if (n_part := self._part(approach.path, approach.events, drift, size)) < p:
            return self._settled(Round(n_part, cycle.period * n_part / p, is_back=False))
        why = f"it settles on a cycle of {p} events, which attracts and is {approach.distance:.1g} away"
        return self._cycle(approach.path, approach.events, float(approach.events.t[-1]), drift, multiplier, why)

    def persisting(self, cycle: Attractor) -> Attractor | None:
        """The cycle of this system that has the events of another's, which the run came from, if it attracts.

        Blocks without friction may pass the speeds of their belts otherwise.
        """
        assert cycle.events is not None
        assert cycle.period is not None
        counted = self._system.has_friction
        n_events = int(counted[cycle.events.block].sum())
        if n_events == 0 or not self._has_newton(len(cycle.events)):
            return None
        answer = self._near(Round(n_events, cycle.period, is_back=False), counted, math.inf)
        if answer is None:
            return None
        approach, drift, multiplier = answer
        why = f"the cycle of {n_events} events lasts, and attracts"
        return self._cycle(approach.path, approach.events, float(approach.events.t[-1]), drift, multiplier, why)

    def _near(
        self, cycle: Round, counted: NDArray[np.bool_] | None = None, far: float = FAR
    ) -> tuple[Near, Floats, float] | None:
        """The cycle that follows on the run, its drift and multiplier, by Newton's method; None if it is none."""
        s, p = self._system, cycle.n_events
        if not self._has_newton(p):
            return None
        is_counted = np.full(s.n, True) if counted is None else counted
        later = self._follow(2.2 * cycle.period, np.empty(0)).events
        events = in_order(later, 0, self._at_once)
        # from an event at which the block has its belt's speed, whatever the state
        is_at_belt = ((events.mode == 0) | (events.previous_mode != 0)) & is_counted[events.block]
        k = int(np.argmax(is_at_belt)) if is_at_belt.any() else len(events)
        places = k + np.flatnonzero(is_counted[events.block[k:]])
        if len(places) <= p:
            return None
        t = events.t[k]
        state = self._follow(float(t), np.array([t])).samples
        once = slice(k, int(places[p]) + 1)
        round_ = part_of(events, once, t=events.t[once] - t, initial_mode=events.mode_after(k))
        newton = Newton(
            s, self._run_from, partial(in_order, first=0, together=self._at_once), self._size, self._close, far,
            is_counted,
        )  # fmt: skip
        approach = newton.cycle(state.z[0], state.w[0], round_)
        if approach is None or not approach.path.is_differentiable(self._at_once):
            return None
        drift = self._drift(approach.path, self._size(approach.path))
        multiplier = self._multiplier(approach.matrix)
        return None if drift is None or multiplier >= 1.0 - self._back else (approach, drift, multiplier)

    def _cycle(
        self, path: Path, events: EventSeries, period: float, drift: Floats, multiplier: float | None, why: str
    ) -> Attractor:
        of_period, states = _from_lowest(path, events, period, drift)
        size, free = self._extent(path), null_space(self._system)
        return Attractor("periodic", why, period, multiplier, None, drift, of_period, states, size, free)

    def _drift(self, path: Path, size: float, larger: float = _LARGER) -> Floats | None:
        """By what z has moved without a change of the forces, if the last state of a round is otherwise the first.

        None if it is not; and if the motion is not so many times larger than what it may miss itself by: what dies
        out has no period, and a motion so small cannot be told from that.
        """
        dz, dw = (states[-1] - states[0] for states in (path.states.z, path.states.w))
        drift = dz - across(self._system, dz)
        allowed = self._back * size
        if (np.abs(drift) <= allowed).all():
            drift = np.zeros_like(dz)
        has_come_back = (np.abs(dz - drift) <= allowed).all() and (np.abs(dw) <= allowed).all()
        return drift if has_come_back and path.extent(drift) >= larger * allowed else None

    def _extent(self, path: Path) -> float:
        """How large the motion is, but for what no spring holds."""
        t, z, w = path.states.t, path.states.z, path.states.w
        shift = z[-1] - z[0]
        drift = shift - across(self._system, shift)
        return float(max(np.abs(w - drift / (t[-1] - t[0])).max(), path.extent(drift)))

    def _size(self, path: Path) -> float:
        """What tolerances are relative to: how large the motion is.

        Or more, where belts are so fast that errors of the engine, which are relative to them, or z so large that its
        rounding exceeds the smallest of these tolerances.
        """
        of_belts = self._close / self._back * self._system.fastest_belt
        return max(self._extent(path), of_belts, _OF_Z / self._close * float(np.abs(path.states.z).max()))

    def _multiplier(self, matrix: Floats) -> float:
        """The largest multiplier; 0 if it cannot be told from that."""
        modulus = largest(matrix, null_space(self._system))
        return modulus if modulus > self._close else 0.0

    def _distance(self, path: Path, drift: Floats, matrix: Floats) -> float:
        """How far a state is from its cycle: what it misses itself by, over 1 - M."""
        s, n, missed, reduced = self._system, self._system.n, path.missed(drift), matrix.copy()
        missed[:n], reduced[:n] = across(s, missed[:n]), across(s, reduced[:n].T).T
        off = np.linalg.lstsq(np.identity(2 * n) - reduced, missed, rcond=1e-12)[0]
        return float(np.abs(off).max())

    # ---------------------------------------------------------------------------------------------- no cycle

    def _not_periodic(self, last: EventSeries) -> Attractor:
        """Irregular, or too short to tell."""
        symbols = symbols_of(last)
        place = np.flatnonzero(symbols == symbols[-1])
        n_again = len(place) - 1
        if n_again < _FEW:
            why = f"no cycle, and the last event recurs too seldom ({n_again} times, of at least {_FEW})"
            return Attractor("undecided", f"{why}; lengthen the run")
        grown = self._growth(float(last.t[-1] - last.t[place[-1 - min(n_again, _MOST_ROUNDS)]]))
        if grown is None:
            return Attractor("undecided", "no cycle, and the motion is too small to tell what deviations do")
        rate, is_torus = grown.rate, grown.decays and self._are_incommensurate()
        if not (grown.grows or is_torus):
            does = "decay" if grown.decays else "do not grow as in chaos"
            why = f"no cycle, and deviations {does} (at the rate {rate:.3g}); lengthen the run"
            return Attractor("undecided", why, growth_rate=rate)
        length = self._run.t_end - float(last.t[-min(len(last), _FOLLOWED)])
        events = in_order(self._follow(length, np.empty(0)).events, 0, self._at_once)
        if len(events) < _FEW:
            return Attractor("undecided", "few events follow on the end of the run; lengthen it")
        states = self._path(events, events.t).states
        if is_torus:
            return self._torus(rate, events, states)
        why = f"no cycle, while the last event recurs {n_again} times, and deviations grow"
        return Attractor("irregular", why, growth_rate=rate, events=events, states=states)

    def _are_incommensurate(self) -> bool:
        """Whether there are forces of several frequencies, without a common period that the run could show."""
        if len(self._frequencies) < 2:
            return False
        ratios = np.array(self._frequencies) / self._frequencies[0]
        n_taken = (self._run.t_end - self._since) * self._frequencies[0] / (2.0 * math.pi)
        most = int(min(max(n_taken, _FIRST_TURNS), _MOST_TURNS))
        turns = np.multiply.outer(np.arange(1.0, most + 1.0), ratios)
        return not (np.abs(turns - np.round(turns)) <= _SAME_PHASE * turns).all(axis=1).any()

    def _torus(self, rate: float, events: EventSeries | None, states: Samples) -> Attractor:
        """The response to forces that are incommensurate: runs that begin next to each other come together there."""
        frequencies = ", ".join(f"{f:.6g}" for f in self._frequencies)
        why = f"deviations decay, under forces of the frequencies {frequencies}, which have no common period"
        return Attractor("torus", why, growth_rate=rate, events=events, states=states)

    def _growth(self, length: float) -> Growth | None:
        """How fast runs from the end and from next to it part."""
        follow = partial(self._run_from, **self._finer)
        times, is_forced = (self._start, self._start + length), bool(self._frequencies)
        return growth(self._system, self._run.z, self._w, self._mode, times, follow, is_forced)


def _off(path: Path, k: int, drift: Floats) -> float:
    """How far the state at the k-th event of a path is from the first, but for a drift."""
    z, w = path.states.z, path.states.w
    return float(max(np.abs(z[k] - z[0] - drift).max(), np.abs(w[k] - w[0]).max()))


def _from_lowest(path: Path, events: EventSeries, period: float, drift: Floats) -> tuple[EventSeries, Samples]:
    """The events of a cycle and the states there, from the place that `Attractor.section` names."""
    p = len(path.states) - 1
    t, block, symbols = events.t[:p], events.block[:p], symbols_of(events)[:p]
    places = np.flatnonzero(symbols == symbols.min()).tolist()
    twice = [*symbols.tolist(), *symbols.tolist()]
    lowest = min(places, key=lambda k: (twice[k : k + p], path.states.z[k, block[k]]))
    turn = (np.arange(p) + lowest) % p
    is_later = turn < lowest
    since = np.maximum.accumulate(t[turn] - t[lowest] + is_later * period)
    cycle = part_of(events, turn, t=since, initial_mode=path.modes[lowest], t_start=0.0, t_end=period)
    return cycle, Samples(since, path.states.z[turn] + np.outer(is_later, drift), path.states.w[turn])


def _alone(z: Floats, w: Floats) -> Samples:
    return Samples(np.zeros(1), z[np.newaxis], w[np.newaxis])
