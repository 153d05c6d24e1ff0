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

#: All that any of them has to set, by name; a name means the same in each, as the first that has it says.
SETTINGS: dict[str, Setting] = {}
for _engine in ENGINES.values():
    SETTINGS |= _engine.settings() | SETTINGS

#: That of `simulate`, if none is named.
DEFAULT = Coulomb.name


def place(name: str) -> int:
    """Where an engine stands on a page: the exact ones come first, then all as in `ENGINES`."""
    return sorted(ENGINES, key=lambda other: not ENGINES[other].is_exact).index(name)
