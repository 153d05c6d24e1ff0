"""Laws by which kinetic friction falls with the speed of slip; `law` says what one is."""

from stickslip.sim.systems.weakening.law import LAW_OF, Weakening, kind_of, parameter
from stickslip.sim.systems.weakening.rational import Rational
from stickslip.sim.systems.weakening.stribeck import Stribeck

__all__ = ["LAWS", "LAW_OF", "Rational", "Stribeck", "Weakening", "kind_of", "parameter", "require_form"]

#: Those that scenes know, by name: a file and a line here make one known to them.
LAWS: dict[str, type[Weakening]] = {
    law.name: law
    for law in (
        Rational,
        Stribeck,
    )
}


def require_form(weakening: Weakening, form: str, engine: str) -> None:
    """TypeError if a system's law lacks the form that an engine needs."""
    if getattr(weakening, form) is None:
        known = " or ".join(law.__name__ for law in LAWS.values() if getattr(law, form) is not None)
        raise TypeError(
            f"weakening: expected a law with the form `{form}`, which engine={engine!r} needs and {known} has, got"
            f" {weakening!r} without; write it"
        )
