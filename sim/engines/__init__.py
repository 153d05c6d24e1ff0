"""The engines, and what they share; `contract` says what one is."""

from stickslip.sim.engines import coulomb, moreau, sigmoid
from stickslip.sim.engines.contract import Engine, Setting

#: All there are, by name: a file and a line here make one known to `simulate`, scenes, datasets and reports.
ENGINES: dict[str, type[Engine]] = {
    engine.name: engine
    for engine in (
        coulomb.Coulomb,
        sigmoid.Sigmoid,
        moreau.Moreau,
    )
}

#: All that any of them has to set, by name; a name means the same in each.
SETTINGS: dict[str, Setting] = {
    name: setting for engine in ENGINES.values() for name, setting in engine.settings().items()
}
