"""Time stepping with fixed steps, to compare with; its method is in ``step.py``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stickslip.sim.engines.contract import Engine, Task, setting
from stickslip.sim.engines.tolerances import STEP
from stickslip.sim.runs.run import Run


@dataclass(frozen=True, kw_only=True, eq=False)
class Moreau(Engine):
    """The set-valued law by time stepping, as it is often run elsewhere: no events are located.

    The midpoint rule, friction implicit: at the end of a step each block's velocity is projected on the belt's. J. J.
    Moreau, in: Nonsmooth Mechanics and Applications (1988) 1-82. A block that sticks is held by its static friction.
    An entry is at the end of its step, an exit at the beginning. What enters and leaves within a step is not seen. Of
    the rules of `contract` it does not keep that a run ends `collapsed`.

    Parameters
    ----------
    step : float
        The longest step; all are equal.

    Raises
    ------
    TypeError, ValueError
        If `step` is no number > 0, or, once it is run, the system has cross damping, or a negative damping R with
        -R `step` of 2 or more.
    """

    name = "moreau"
    about = "time steps of Moreau and Jean under Coulomb's law, to compare with; no event is located."
    kernels = "stickslip.sim.engines.moreau"
    locates_events = False
    keeps_stills = True
    takes = frozenset({"static"})

    step: float = setting(0.01, STEP)

    def integrate(self, task: Task) -> Run:
        from stickslip.sim.engines.moreau import integrate  # it loads numba, half a second that settings do not need

        return integrate.integrate(task, self.step)

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        return rate / (43.0 * settings["step"])  # the exact engine takes 43 products a unit of time
