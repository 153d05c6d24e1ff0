"""A block on a slope, pulled for a long time with half the force that friction can hold: it should not move.

Gravity's component along the slope is a constant force F = 1/2, the normal force and the coefficient of friction are
one; the block starts at rest. Under a smoothed law it creeps with the speed at which friction balances F, for the
sigmoid eps atanh F. Dimensionless.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from stickslip import sim
from stickslip.workflows.gallery.charts import Say

#: What pulls, of a friction of one; for how long; the width of the sigmoid.
PULL, T_END, EPS = 0.5, 1e4, 0.03
#: MuJoCo's step. Its creep hardly depends on it.
_STEP = 0.01
#: A unit cube on a plane, both of friction one, and gravity in units of its weight along the normal.
_SCENE = """
<mujoco>
  <option timestep="{step}" gravity="{pull} 0 -1" cone="{cone}" noslip_iterations="{noslip}"/>
  <worldbody>
    <geom type="plane" size="0 0 1" friction="1 0 0"/>
    <body pos="0 0 0.5"><freejoint/><geom type="box" size=".5 .5 .5" mass="1" friction="1 0 0"/></body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class Creep:
    """Creep of the block under a method: a row of the table `creep`; null, with a reason, if the method is absent."""

    method: str
    distance: float | None = None
    expected: float | None = None  #: by the law that it solves
    seconds: float | None = None
    reason: str | None = None


def _ours(engine: str, **settings: Any) -> float:
    block = sim.System([[0.0]], 0.0, belt_speed=0.0, force=PULL)
    return float(sim.simulate(block, 0.0, 0.0, T_END, engine=engine, **settings).z[0])


def _mujoco(cone: str, noslip: int) -> float:
    import mujoco

    source = _SCENE.format(step=_STEP, pull=PULL, cone=cone, noslip=noslip)
    model = mujoco.MjModel.from_xml_string(source)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(T_END / _STEP))
    return float(data.qpos[0])


_METHODS: tuple[tuple[str, Callable[[], float], float], ...] = (
    ("coulomb engine", lambda: _ours("coulomb"), 0.0),
    (f"sigmoid engine, eps = {EPS:g}", lambda: _ours("sigmoid", eps=EPS), EPS * math.atanh(PULL) * T_END),
    ("MuJoCo, as it comes", lambda: _mujoco("pyramidal", 0), 0.0),
    ("MuJoCo, elliptic cone, 5 noslip iterations", lambda: _mujoco("elliptic", 5), 0.0),
)


def creep(say: Say) -> list[Creep]:
    """The block, by every method."""
    rows = []
    for name, distance, expected in _METHODS:
        if name.startswith("MuJoCo") and find_spec("mujoco") is None:
            rows.append(Creep(name, reason="mujoco is not installed"))
            continue
        start = time.perf_counter()
        rows.append(Creep(name, distance(), expected, time.perf_counter() - start))
        say(f"slope: {name}: {rows[-1].distance:.3g} in {T_END:g}")
    return rows
