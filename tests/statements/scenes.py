"""The datasets: ensembles that ship, shrunk, and planted ones in every state."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stickslip.workflows.scenes import shipped

OWN = '''\
from typing import Annotated, NamedTuple

from stickslip import System
from stickslip.analysis import Answer, Form, Level, Quantity, named

import numpy as np
import pandas as pd


class Measured(NamedTuple):
    never_left: Annotated[float, "share of blocks that never let go after t_burn", {"least": 0}]
    last_exit: Annotated[float | None, "when the last block let go", {"absent": "none let go"}]
    first_rest: Annotated[float | None, "when all blocks first stuck", {"since": 0}]
    is_calm: Annotated[bool, "whether few blocks let go"]


def quiet(run, system, window) -> Measured:
    exits = (run.events.mode != 0) & (run.events.previous_mode == 0) & (run.events.t >= window[0])
    last = run.events.t[exits].max() if exits.any() else None
    n_stick = run.n_stick(run.events.t)
    rest = run.events.t[n_stick == system.n]
    left = len(set(run.events.block[exits]))
    return Measured(1.0 - left / system.n, last, float(rest[0]) if len(rest) else None, left < system.n / 2)


def draw(n, rng, spring, loss=0.5):
    if spring > 2.0:
        raise ValueError("the springs break")
    K = spring * rng.uniform(-0.2, 0.2, (n, n))
    return System((K - K.T) / 2 + 0.1 * np.eye(n), damping=rng.uniform(loss, 2 * loss, n))


def question(study):
    """At which belt speed do blocks stick longest?

    The share of the time after t_burn that a block sticks, averaged over blocks and runs.
    """
    shares = {group.at["belt_speed"]: study.mean(group, "stick_share") for group in study.groups}
    best = max(shares, key=lambda belt: shares[belt].value)
    rows = pd.DataFrame([{"belt_speed": belt, **named("share", share)} for belt, share in shares.items()])
    share = Quantity("stick_share", "largest share of the time that a block sticks", Form.SHARE)
    return Answer(findings=[Level(share, shares[best], f"belt speed {best:g}")], tables={"shares": rows})
'''

EXACT, LOOSE = 'name = "coulomb"\ntol = 1e-6', 'name = "coulomb"\ntol = 1e-4'
SMOOTH = 'name = "sigmoid"\neps = 0.05\nrtol = 1e-5\natol = 1e-5'
STEPS = 'name = "moreau"\nstep = 0.05'
CHAIN = 'coupling = "chain"\nn = 8\nkappa = 1.0\ndamping = 0.1'
HELD = f"{CHAIN}\nstatic = 1.3"
CROWD = 'coupling = "antisymmetric"\nn = 150\nkappa = 0.2'
SWEPT = CROWD.replace("kappa = 0.2", "kappa = [0.2, 0.25]")
BLOCK = 'coupling = "chain"\nn = 1\nleaf = 1.0\ndamping = 0.1\nstatic = 1.5'
SHARED = "z = -0.7\nw = -0.4"


class Plan(NamedTuple):
    """How a dataset is made: scenes run into it one after the other, and files beside them.

    Attributes
    ----------
    scenes : tuple of str
    files : mapping of str to (str or callable)
        The text of each, or what writes it at a path.
    n_shards : int, optional
        The run of the last scene is broken off after so many.
    """

    scenes: tuple[str, ...]
    files: Mapping[str, str | Callable[[Path], object]] = {}
    n_shards: int | None = None


def scene(
    system: str,
    *tables: str,
    start: str = 'z = {uniform = [-0.5, 0.5]}\nw = "belt"',
    run: str = "",
    engines: tuple[str, ...] = (EXACT,),
    analysis: str = "",
) -> str:
    """A scene of short runs; keys of `run` and of `analysis` take the place of those that all have."""
    parts = [f"[system]\n{system}", f"[start]\n{start}", "[run]\n" + _with("t_end = 100.0\nmatrices = 4", run)]
    parts += [f"[[engine]]\n{engine}" for engine in engines]
    return "\n".join([*parts, *tables, "[analysis]\n" + _with("t_burn = 20.0\ndt = [1.0]\nresamples = 20", analysis)])


def crowd(*tables: str, system: str = CROWD, run: str = "", analysis: str = "", **more: Any) -> str:
    """A scene of so many blocks that they stick and slip for long."""
    lasting = {"run": f"t_end = 400.0\n{run}", "analysis": f"t_burn = 100.0\n{analysis}"}
    return scene(system, *tables, **({"start": SHARED} | lasting | more))


def _with(keys: str, changes: str) -> str:
    lines = {line.partition(" = ")[0]: line for line in f"{keys}\n{changes}".splitlines()}
    return "\n".join(lines.values())


def shrunk(name: str, **changes: object) -> str:
    """A scene that ships, with other values of some keys."""
    text = shipped()[name].read_text()
    for key, value in changes.items():
        text, n = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
        if not n:
            raise ValueError(f"{name}: expected a key {key}, got none")
    return text


def _springs(seed: int) -> Callable[[Path], object]:
    def write(file: Path) -> None:
        rng = np.random.default_rng(seed)
        n = 8
        K = 2.1 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
        np.savez(file, stiffness=K, friction=rng.uniform(0.8, 1.2, n), damping=np.full(n, 0.1))

    return write


FILES = {f"K{k}.npz": _springs(k) for k in range(4)}
MINE = {"mine.py": OWN}
GRID = f"{HELD}\nfriction = [0.8, 1.0]\nbelt_speed = [-0.1, -0.2]"
EPISODES, MANY = "[record]\nepisodes = true", "t_end = 600.0\nmatrices = 6"
NUMBERS = (
    "[record]\namplitude = true\nslip_speed = true\nfriction_power = true\nstick_share = true\nwaiting = true\n"
    "energy = true\ngrowth_rate = true\ndt = 0.1"
)

SHIPPED = {
    "basin": {"draws": 150},
    "burridge_knopoff": {"n": 20, "t_end": 4000.0, "matrices": 6, "t_burn": 500.0},
    "burridge_knopoff_slow": {"n": [10, 20], "t_end": 2e5, "matrices": 6, "t_burn": 4e4},
    "carlson_langer": {"n": 20, "t_end": 8000.0, "matrices": 4, "t_burn": 2000.0},
    "cascades": {"t_end": 1500.0, "matrices": 5, "t_burn": 100.0, "resamples": 20},
    "counting": {"n": [100, 150], "t_end": 500.0, "matrices": 5, "t_burn": 100.0},
    "quick": {"resamples": 20},
    "rhythm": {"n": [150, 175], "belt_speed": [-0.15, -0.2], "t_end": 1200.0, "matrices": 4, "t_burn": 100.0},
    "robustness": {"n": [20, 150], "t_end": 400.0, "matrices": 4, "t_burn": 100.0},
    "statistics": {"n": 150, "t_end": 300.0, "matrices": 4, "t_burn": 100.0, "resamples": 20},
    "survival": {"n": [20, 100, 250], "t_end": 400.0, "matrices": 6, "t_burn": 100.0},
    "thousands": {"matrices": 15},
}

#: By name. What a name says is what its data have beside what all have.
_PLANS: dict[str, str | Plan] = {name: shrunk(name, **changes) for name, changes in SHIPPED.items()} | {
    # what is swept
    "ratios_of_friction": scene(f"{CHAIN}\nfriction = [0.8, 1.0]\nstatic = [{{ratio = 1.2}}, {{ratio = 1.5}}]"),
    "ratios_alike": scene(f"{CHAIN}\nfriction = [0.5, 1.0]\nstatic = [{{ratio = 1.5}}, {{ratio = 3.0}}]"),
    "ratios_drawn": scene(f"{CHAIN}\nstatic = [{{ratio = 1.3}}, {{ratio = {{uniform = [1.1, 1.4]}}}}]"),
    "grid": scene(GRID),
    "grid_half_done": Plan((scene(GRID, run="matrices = 6"),), n_shards=4),
    "grid_begun": Plan((scene(GRID),), n_shards=1),
    "grid_diagonal": Plan((scene(GRID, run='zip = [["friction", "belt_speed"]]'), scene(GRID)), n_shards=0),
    "grid_grown": Plan(
        (scene(f"{HELD}\nfriction = [0.8]", run="matrices = 2"), scene(f"{HELD}\nfriction = [0.8, 1.0]"))
    ),
    "zipped": scene(f"{HELD}\nfriction = [0.5, 1.0]\nleaf = [0.1, 0.2]", run='zip = [["friction", "leaf"]]'),
    "three_keys": scene(f"{HELD}\nmass = [0.5, 1.0]\nleaf = [0.1, 0.3]", start='z = [0.1, 0.4]\nw = "belt"'),
    "distributions": scene(f"{HELD}\nfriction = [1.0, {{uniform = [0.9, 1.1]}}, {{uniform = [0.8, 1.2]}}]"),
    "courses": scene(f"{HELD}\nbelt_speed = {{times = [0.0, 50.0], values = [-0.1, -0.2]}}\nleaf = [0.1, 0.2]"),
    "forces": scene(
        f"{HELD}\nforce = {{amplitude = [0.1, 0.4], frequency = [0.5, 1.0]}}", "[record]\nwaiting = true"
    ),
    "weakening": scene(f'{HELD}\nweakening = {{law = "rational", rate = [1.0, 4.0]}}', EPISODES, run=MANY),
    "networks": scene('coupling = "network"\nn = 12\ndegree = [2.0, 4.0]\nstatic = 1.2\ndamping = 0.1'),
    "sizes": crowd("[record]\ncollapse = true", system='coupling = "antisymmetric"\nn = [10, 40, 120]'),
    "swept_crowds": crowd("[record]\nevents = true", system=SWEPT),
    # what is drawn, and what is independent
    "run_of_blocks": crowd("[record]\nevents = true", run="matrices = 1"),
    "run_of_a_block": scene(BLOCK, run="matrices = 1", start='z = 0.3\nw = "belt"'),
    "starts": scene(HELD, start='z = {uniform = [-0.5, 0.5]}\nw = "belt"\ndraws = 12', run="matrices = 1"),
    "starts_of_systems": crowd(start="z = {normal = [0.0, 0.5]}\nw = {uniform = [-0.4, 0.0]}\ndraws = 2"),
    "starts_of_a_block": scene(
        BLOCK, "[record]\nattractor = true", start="z = {uniform = [-2, 2]}\nw = 0.0\ndraws = 12", run="matrices = 1"
    ),
    "seeds": crowd(system=SWEPT, run="seed = [3, 4]\nmatrices = 3"),
    "files": Plan(
        (
            scene(
                'coupling = "file"\npath = "K*.npz"\nbelt_speed = [-0.1, -0.2]\nstatic = {ratio = 1.3}',
                start="z = {uniform = [-1, 1]}\nw = 0.0\ndraws = 3",
                run="matrices = 1",
            ),
        ),
        FILES,
    ),
    "functions": Plan(
        (scene('coupling = "mine:draw"\nn = 20\nparameters = {spring = [0.5, 1.0]}', start=SHARED),), MINE
    ),
    "failures": Plan(
        (
            scene(
                'coupling = "mine:draw"\nn = 10\nparameters = {spring = [1.0, 3.0]}\nbelt_speed = [-0.1, -0.2]',
                start=SHARED,
            ),
        ),
        MINE,
    ),
    "escapes": crowd(system=CROWD.replace("kappa = 0.2", "kappa = [0.2, 2.0]")),
    "settled": scene(HELD, "[record]\nend = true"),
    "from_ends": scene(f"{HELD}\nbelt_speed = [-0.1, -0.2]", start='dataset = "../settled/settled"'),
    # copies of a system
    "changes": crowd('[perturbation]\nreadings = ["scale", "relative"]\nsizes = [0.01, 0.05]\ndraws = 2'),
    "changes_of_a_sweep": crowd("[perturbation]\nsizes = [0.05]", system=SWEPT),
    "twins": crowd("[twins]\nsizes = [1e-8, 1e-3]", "[record]\nseparation = 0.5", engines=(EXACT, SMOOTH)),
    "stiffness_ratios": crowd(engines=(EXACT, f'{SMOOTH}\nratio = "uniform"\nratio_draws = 2', SMOOTH)),
    "thresholds": crowd(engines=(EXACT, f"{SMOOTH}\nthresholds = [0.5, 1.0, 2.0]")),
    # engines
    "engines": crowd(engines=(EXACT, LOOSE, SMOOTH, STEPS)),
    "engines_of_episodes": scene(
        HELD, EPISODES, run=MANY, engines=(EXACT, SMOOTH, STEPS), analysis='question = "episodes"'
    ),
    "sigmoid_alone": crowd(engines=('name = "sigmoid"\neps = [0.03, 0.1]\nrtol = 1e-5\natol = 1e-5',)),
    "steps_of_a_sweep": scene(GRID, engines=(EXACT, STEPS)),
    # what is recorded
    "numbers": scene(f"{HELD}\nbelt_speed = [-0.1, -0.2]", NUMBERS),
    "censored": scene(
        f"{HELD}\nbelt_speed = [-0.01, -0.02]", "[record]\nfirst_exit = true", run="t_end = 60.0\nmatrices = 8"
    ),
    "attractors": scene(
        f"{BLOCK}\nbelt_speed = [-0.2, -0.6, -1.2]", "[record]\nattractor = true", run="t_end = 300.0\nmatrices = 6"
    ),
    "attractors_of_chains": scene(
        'coupling = "chain"\nn = 2\nkappa = 1.0\ndamping = 0.05\nstatic = 1.4',
        "[record]\nattractor = true",
        start='z = {uniform = [-1, 1]}\nw = "belt"\ndraws = 4',
        run="t_end = 400.0\nmatrices = 3",
    ),
    "records_of_a_function": Plan(
        (scene(f"{HELD}\nbelt_speed = [-0.05, -0.1]", '[record]\nown = "mine:quiet"'),), MINE
    ),
    "questions_of_a_function": Plan(
        (
            scene(
                f"{HELD}\nbelt_speed = [-0.3, -0.2, -0.1]",
                "[record]\nstick_share = true",
                analysis='question = ["mine:question", "sweep"]',
            ),
        ),
        MINE,
    ),
    "margins": crowd(engines=(EXACT, SMOOTH), analysis='question = "engines"\nconfidence = 0.9'),
}
PLANS = {name: plan if isinstance(plan, Plan) else Plan((plan,)) for name, plan in _PLANS.items()}

#: Datasets that are set side by side.
COMPARED = (("grid", "grid_half_done"), ("engines", "margins"), ("changes", "seeds"))
