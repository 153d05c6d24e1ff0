"""The engines, and what they share; `contract` says what one is."""

from stickslip.sim.engines.contract import Engine, Setting
from stickslip.sim.engines.coulomb.settings import Coulomb
from stickslip.sim.engines.moreau.settings import Moreau
from stickslip.sim.engines.sigmoid.settings import Sigmoid

#: All there are, by name: a file and a line here make one known to `simulate`, scenes, datasets and reports.
ENGINES: dict[str, type[Engine]] = {
    engine.name: engine
    for engine in (
        Coulomb,
        Sigmoid,
        Moreau,
    )
}

#: All that any of them has to set, by name; a name means the same in each.
SETTINGS: dict[str, Setting] = {
    name: setting for engine in ENGINES.values() for name, setting in engine.settings().items()
}
