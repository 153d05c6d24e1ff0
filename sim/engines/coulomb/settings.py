"""The exact engine's settings; its method is in ``step.py`` and, where K is sparse, ``sparse.py``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stickslip.sim.engines.contract import Engine, Task, setting
from stickslip.sim.engines.tolerances import TOL
from stickslip.sim.runs.run import Run


@dataclass(frozen=True, kw_only=True, eq=False)
class Coulomb(Engine):
    """The set-valued law, exact: every event where a series has it.

    Parameters
    ----------
    tol : float
        Truncation error of w in a step, relative to the largest of |w|, |v| and what w changes by in the step. The
        error at the end is that of all steps, as the system amplifies it; cost grows with log(1 / tol) only. What is
        above 1e-3 is taken for 1e-3: looser runs would cost more.

    Raises
    ------
    TypeError, ValueError
        If `tol` is no number in (1e-16, 1e-2), or, once it is run, the system has cross damping.
    """

    name = "coulomb"
    about = "exact, event-driven."
    kernels = "stickslip.sim.engines.coulomb"
    is_exact = True
    takes = frozenset({"static", "weakening", "back_slip", "force", "belt_speed"})

    tol: float = setting(1e-10, TOL)

    def integrate(self, task: Task) -> Run:
        return self.prepare([task])[0]()

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        from stickslip.sim.engines.coulomb import integrate  # it loads numba, half a second that settings do not need

        return integrate.runs(tasks, self.tol)

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        # terms of a series: one more for each factor of its last
        return rate * max(0.3, 1.0 + 0.11 * math.log10(1e-10 / settings["tol"]))
