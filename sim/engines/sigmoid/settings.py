"""The stiff engine's settings; its method is in ``engines/waveform``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from stickslip.sim.engines.contract import Choice, Engine, Number, Numbers, Ratios, Task, setting
from stickslip.sim.engines.tolerances import ATOL, RTOL, WIDTH
from stickslip.sim.runs.run import Run


@dataclass(frozen=True, kw_only=True, eq=False)
class Sigmoid(Engine):
    """The sign smoothed to tanh((w - v) / (ratio eps)).

    With static friction above the kinetic it is s(lambda) = lambda + c lambda (1 - lambda^2) of that lambda, where c
    makes the largest s static over kinetic: see `StaticAboveKinetic` in `gallery/theory/laws`. With weakening, mu is
    mu(|w - v|); on a closed side the law is its tangent at w = v.

    Parameters
    ----------
    eps : float
        Smoothing of the sign, > 0.
    ratio : float or array_like, shape (n,)
        r_i > 0: block i has delta_i = r_i eps.
    rtol, atol : float
        A step's error in every z_i and w_i is kept below atol + rtol |value| (the largest, not the mean).
    stick : "manifold" or "threshold"
        When a block counts as sticking, with delta_i = r_i eps:

        - "manifold": |F_i| < mu_i, F = R v + K z + N w, and |w_i - v| < delta_i ln(1 / delta_i). The slow manifold is
          w - v = delta atanh(lambda), so this is the definition whose entries and exits tend to those of the Coulomb
          law as eps -> 0. A static friction above mu_i takes the place of mu_i; but a block that slips beyond the
          peak of friction goes on slipping while F, above mu_i, pushes it on.
        - "threshold": |w_i - v| < c delta_i, that is |lambda| < tanh c: the plain reading, which does not.

        A block without friction never sticks (unless it rests on the belt, with no force: there it has no side).
    threshold : float
        c > 0 of ``stick="threshold"``.
    thresholds : array_like, shape (m,)
        Further c, each once: the events by these definitions too, from the same run (`Run.by_threshold`).

    Notes
    -----
    The error at t_end, and at the samples, is within 20 times `atol + rtol S` times the sensitivity of the motion,
    but for a few runs in a thousand: S the largest |z_i|, |w_i| of the run, the sensitivity how far a displacement
    is carried, at least 1. This holds over a hundred cycles of stick and slip too. Where little is damped and blocks
    only slip, errors add up over hundreds of periods: within 1000 times; on belts that change their speed again and
    again, over hundreds of transitions. This is tested on random systems, not proved: springs to 1e3, damping 0 to
    50, delta 1e-9 to 0.1, t to 20, and t to 1000 on cycles.

    A run that is certain to come to rest under constant forces, all w_i = 0, without another event goes on to its
    end without steps, unless ``stop_early=False``.

    Raises
    ------
    TypeError, ValueError
        If a setting is of the wrong kind or out of range; the message names it.
    """

    name = "sigmoid"
    about = "friction mu tanh((w - v) / (r_i eps)) at velocity w, smooth within a few eps of the belt's speed v."
    kernels = "stickslip.sim.engines.sigmoid"
    keeps_stills = True
    takes = frozenset({"static", "weakening", "back_slip", "force", "belt_speed", "damping matrix"})

    eps: float = setting(0.03, WIDTH)
    ratio: ArrayLike = setting(1.0, Ratios(words="stiffness ratios r_i", in_id="", in_all=True))
    rtol: float = setting(1e-6, RTOL)
    atol: float = setting(1e-6, ATOL)
    stick: str = setting(
        "manifold",
        Choice(
            words="definition of sticking: the one that converges to Coulomb, or |w - v| < threshold r_i eps",
            column="what counts as sticking: manifold or threshold (sigmoid)",
            in_label="unless default",
            in_all=True,
            choices=("manifold", "threshold"),
        ),
    )
    threshold: float = setting(
        1.0,
        Number(
            words='threshold, with stick = "threshold"',
            column="a block sticks when |w - v| < threshold r_i eps (sigmoid, threshold)",
            in_id="c",
            in_label="always",
            in_all=True,
            only_with=("stick", "threshold"),
            above=0,
        ),
    )
    thresholds: tuple[float, ...] = setting(
        (),
        Numbers(
            words="thresholds of further definitions |w - v| < threshold r_i eps, recorded from the same runs",
            example=[0.5, 1.0, 2.0],
        ),
    )

    def integrate(self, task: Task) -> Run:
        return self.prepare([task])[0]()

    def prepare(self, tasks: Sequence[Task]) -> list[Callable[[], Run]]:
        from stickslip.sim.engines.sigmoid import integrate  # it loads numba, half a second that settings do not need

        return integrate.runs(tasks, self)

    @staticmethod
    def cost(rate: float, settings: Mapping[str, Any]) -> float:
        # a part that does not depend on tolerances, and steps of order five; thinner layers take more substeps
        rate *= 0.1 + 0.16 * (1e-6 / (settings["rtol"] * settings["atol"]) ** 0.5) ** 0.2
        rate *= max((0.03 / settings["eps"]) ** 0.18, 0.6)
        if settings["ratio"] == "uniform":
            rate *= 1.4
        return rate * (1.0 + 0.06 * len(settings["thresholds"]))

    @staticmethod
    def problem(settings: Mapping[str, Any]) -> str:
        if settings["stick"] == "manifold" and settings["eps"] >= 1:
            return f'eps: expected less than 1 with stick = "manifold", got {settings["eps"]}; smooth less'
        return ""
