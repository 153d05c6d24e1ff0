"""Laws by which kinetic friction falls with the speed of slip; `law` says what one is."""

from stickslip.sim.systems.weakening.law import LAW_OF, Weakening, parameter
from stickslip.sim.systems.weakening.rational import Rational
from stickslip.sim.systems.weakening.stribeck import Stribeck
from stickslip.sim.systems.weakening.tabulated import Curve, Table

__all__ = ["LAWS", "LAW_OF", "Curve", "Rational", "Stribeck", "Table", "Weakening", "parameter"]

#: Those that scenes know, by name: a file and a line here make one known to them.
LAWS: dict[str, type[Weakening]] = {
    law.name: law
    for law in (
        Rational,
        Stribeck,
    )
}
