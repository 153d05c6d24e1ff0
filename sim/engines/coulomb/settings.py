"""The exact engine's settings; its methods are in ``step.py``, where K is sparse ``sparse.py``, and ``waves.py``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip.sim.engines.contract import SMALL, Engine, Task, setting
from stickslip.sim.engines.tolerances import TOL
from stickslip.sim.runs.run import Run
from stickslip.sim.systems.system import System

#: The fewest blocks from which waveform relaxation is faster, by `python -m tests.picks`.
SIZE_OF_WAVES = 64
#: The least tolerance there, the power of n by which that falls, and to what; the same where static friction is above
#: the kinetic, so that each exit is a jump of friction and a kink in the F of others.
OF_WAVES, OF_JUMPS = (6e-7, 4.6, 1e-10), (3.6e-6, 3.0, 5e-9)
#: The factor of that if the least damping is a smaller share of |eigenvalues|, and the least tolerances of either: F
#: then swings, and events become rare, from which series take long steps.
LIGHT, TOL_OF_LIGHT, LEAST_OF_LIGHT, LEAST_OF_LIGHT_JUMPS = 0.25, 60.0, 2e-8, 1e-5
#: With fewer entries a row of K the least tolerance is this, and a lightly damped system is left to series, of which
#: an event is a local update: of such chains, and pairs of blocks, waves took up to 9 times as long.
MANY_ENTRIES, TOL_OF_FEW = 6, 1e-6
#: Waves take longer to begin: below this n^3 times the length of a run, in units of 1 / |eigenvalue|, series are
#: faster. A run of no more than `NO_LENGTH` is made as a long one, and loads its kernels.
SHORT, NO_LENGTH = 5e7, 1e-3
#: The largest share of entries of K of which products by sparse rows are faster in waves, up to so many blocks, and
#: beyond, where a dense K leaves the cache; and with which events are local updates in series, beside one a row.
ROWS, CACHED, ROWS_BEYOND, LOCAL = 0.06, 500, 0.12, 0.02

#: The loosest tolerance of series; a looser one counts as this. 1e-3 took 5 to 40% fewer products, in about the same
#: time, but its errors hide short sticks of blocks that come back to touch the belt. With 1e-5, of systems of up to
#: eight blocks without damping, against matrix exponentials: 300 chains from the belt's speed to t = 50 lost no event
#: of 7,556, 200 dense ones to t = 60 lost 14 of 5,237, in sticks of 0.005 at most, and 60 of weakly coupled blocks to
#: t = 150, which touch the belt all the time, 610 of 3,987, of 0.016 at most; with 1e-8 they lost 0, 6 and 4, with
#: 1e-10 none. Where errors add up it falls, to `LOOSEST_OF_LONG` at least.
LOOSEST, LOOSEST_OF_LONG = 1e-5, 1e-10
#: That of waves, whose cost falls further.
LOOSEST_OF_WAVES = 1e-3
#: Errors of steps add up until damping has made them fade. If that takes longer than this, in units of 1 /
#: |eigenvalue|, a step is allowed less in proportion. Without it, waves to t = 1000 without damping were off by 11 to
#: 150 tolerances at 1e-6 (66 blocks).
MEMORY = 50.0
#: Where it takes so many times longer, series cost no more than waves, and their errors are far below.
MOST_MEMORY = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Coulomb(Engine):
    """The set-valued law, exact: every event where a series has it.

    Parameters
    ----------
    tol : float
        Truncation error of w in a step, relative to the largest of |w|, |v| of blocks with friction, and what w
        changes by in the step. The error at the end is that of all steps, as the system amplifies it; cost grows with
        log(1 / tol) only. What is above 1e-5 is taken for 1e-5 by series, whose cost hardly falls further.

    Notes
    -----
    There are two methods: Taylor series, whose error is far below `tol`, or about it where friction depends on the
    speed of slip, and, for large systems of many couplings, waveform relaxation, whose error of the state is about
    `tol`; where F changes slowly, its exits may be late by some hundred times that. `is_by_waves` says which a run is
    made by, and `Stats.method` of the run. Blocks that move alike have their events at one instant by series.

    Raises
    ------
    TypeError, ValueError
        If `tol` is no number in (1e-16, 1e-2), or, once it is run, the system has numbers so small that what the
        method takes of them leaves float64.
    """

    name = "coulomb"
    title = "exact"
    noun = "the exact law"
    about = "Coulomb's set-valued law, followed from event to event."
    kernels = "stickslip.sim.engines.coulomb"
    keeps_stills = True
    sizes = (SMALL, SIZE_OF_WAVES)
    is_exact = True
    takes = frozenset({"static", "weakening", "back_slip", "force", "belt_speed", "damping matrix"})

    tol: float = setting(1e-10, TOL)

    def integrate(self, task: Task) -> Run:
        from stickslip.sim.engines.coulomb import integrate  # as in `prepare`

        return integrate.alone(self, task)

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        from stickslip.sim.engines.coulomb import integrate  # it loads numba, half a second that settings do not need

        return integrate.runs(tasks, self)

    @staticmethod
    def accumulation(system: System, length: float) -> float:
        """How many times the error of steps adds up beyond what is usual, over a run of this length; at least 1.

        Until damping has made errors fade, or to the end.
        """
        lasting = min(length, 1.0 / system.least_damping) if system.least_damping > 0.0 else length
        return max(1.0, system.fastest_rate * lasting / MEMORY)

    def tol_of_series(self, system: System, length: float) -> float:
        """The tolerance of a step of series."""
        if self.tol <= LOOSEST_OF_LONG:
            return self.tol
        return min(self.tol, max(LOOSEST / self.accumulation(system, length), LOOSEST_OF_LONG))

    def tol_of_waves(self, system: System, length: float) -> float:
        """The tolerance of a step of waveform relaxation."""
        return min(self.tol, LOOSEST_OF_WAVES) / self.accumulation(system, length)

    def is_by_waves(self, system: System, length: float = math.inf) -> bool:
        """Whether runs of a system are made by waveform relaxation, as far as they are not started at an event.

        If n is at least 64 and `tol` at least 6e-7 (95 blocks: 1e-7, 258: 1e-9, 425: 1e-10), or, where static
        friction is above the kinetic, 3.6e-6 (99: 1e-6, 212: 1e-7, 574: 5e-9, and no less), sixty times as much if
        damping is light; with fewer than six entries a row of K, 1e-6 at least, and no light damping; if the run is
        not short, the belts have constant speeds, one of which is not zero, there are no forces, friction does not
        depend on the speed of slip, which may go to either side, and the R of no block is far above all rates.
        Damping between blocks gives F a kink at each event of another block, which no polynomial over a macro step
        follows: such systems take series, as do `simulate` with `modes`, a start at which |F| is at static friction,
        and a run that this method cannot carry through. Over this length errors of steps add up where damping is
        weak, and `tol` is that of a step.
        """
        n, phases = system.n, system.fastest_rate * length
        is_short = phases > NO_LENGTH and n**3 * phases < SHORT
        if n < SIZE_OF_WAVES or is_short or self.accumulation(system, length) > MOST_MEMORY:
            return False
        jumps = system.is_static_above
        tol, fall, lowest = OF_JUMPS if jumps else OF_WAVES
        is_light = system.least_damping < LIGHT * system.fastest_rate
        least = max(tol * (SIZE_OF_WAVES / n) ** fall, lowest)
        if is_light:
            least = max(TOL_OF_LIGHT * least, LEAST_OF_LIGHT_JUMPS if jumps else LEAST_OF_LIGHT)
        if system.entries_a_row < MANY_ENTRIES:
            if is_light:
                return False
            least = max(TOL_OF_FEW, least)
        if self.tol_of_waves(system, length) < 0.999 * least or system.cross_damping is not None or system.changes:
            return False
        if system.force or system.weakening is not None or not system.back_slip or system.fastest_belt == 0.0:
            return False
        from stickslip.sim.engines.coulomb.overdamped import is_heavy  # as in `prepare`

        return not is_heavy(system.damping, system.row_sums.max(), 0.0).any()

    @staticmethod
    def is_sparse(system: System, by_waves: bool) -> bool:
        """Whether a method takes K as a sparse array, however it is stored."""
        if by_waves:
            return system.entries_a_row <= (ROWS if system.n <= CACHED else ROWS_BEYOND) * system.n
        if system.weakening is not None or system.force or system.changes or system.cross_damping is not None:
            return not isinstance(system.stiffness, np.ndarray)  # events are no local updates, or nothing else
        return system.n >= SIZE_OF_WAVES and system.entries_a_row <= 1.0 + LOCAL * system.n

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        # terms of a series: one more for each factor of its last
        return rate * max(0.3, 1.0 + 0.11 * math.log10(1e-10 / settings["tol"]))
