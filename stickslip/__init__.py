"""Blocks held by dry friction: `from stickslip import draw_system, simulate` is all that a single run needs.

The names are those of `sim`. Ensembles are in `pipeline`, their statistics in `analysis`; the command is also
``python -m stickslip``.
"""

from importlib.metadata import version

from sim import (
    COUPLINGS,
    READINGS,
    EventSeries,
    IntegrationError,
    Run,
    Samples,
    Stats,
    System,
    draw_system,
    perturb_system,
    simulate,
)

__version__ = version("stickslip")

__all__ = [
    "COUPLINGS",
    "READINGS",
    "EventSeries",
    "IntegrationError",
    "Run",
    "Samples",
    "Stats",
    "System",
    "__version__",
    "draw_system",
    "perturb_system",
    "simulate",
]
