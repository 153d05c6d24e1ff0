"""Laws by which kinetic friction falls with the speed of slip; `law` says what one is."""

from stickslip.sim.systems.weakening.law import Weakening
from stickslip.sim.systems.weakening.rational import Rational
from stickslip.sim.systems.weakening.stribeck import Stribeck

__all__ = ["LAWS", "Rational", "Stribeck", "Weakening", "require_form"]

#: All there are, by name: a file and a line here make one known to systems, engines and scenes.
LAWS: dict[str, type[Weakening]] = {
    law.name: law
    for law in (
        Rational,
        Stribeck,
    )
}


def require_form(weakening: Weakening, form: str, engine: str) -> None:
    """TypeError if a system's law is not in `LAWS`, or lacks the form that an engine needs."""
    if type(weakening) not in LAWS.values() or getattr(weakening, form) is None:
        known = " or ".join(law.__name__ for law in LAWS.values() if getattr(law, form) is not None)
        missing = f", which has no `{form}`" if type(weakening) in LAWS.values() else ""
        raise TypeError(f"weakening: expected {known}, all that engine={engine!r} knows, got {weakening!r}{missing}")
