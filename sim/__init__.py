"""The physics: a system in, an event series out. No files, no dask, no pandas."""

from stickslip.sim.runs.run import IntegrationError, Run, Samples, Stats
from stickslip.sim.runs.series import EventSeries
from stickslip.sim.simulation import simulate
from stickslip.sim.systems.couplings import COUPLINGS, READINGS, draw_system, perturb_system
from stickslip.sim.systems.drive import Harmonic, Piecewise
from stickslip.sim.systems.scales import Scales
from stickslip.sim.systems.system import System
from stickslip.sim.systems.weakening import Curve, Rational, Stribeck, Table, Weakening

__all__ = [
    "COUPLINGS",
    "READINGS",
    "Curve",
    "EventSeries",
    "Harmonic",
    "IntegrationError",
    "Piecewise",
    "Rational",
    "Run",
    "Samples",
    "Scales",
    "Stats",
    "Stribeck",
    "System",
    "Table",
    "Weakening",
    "draw_system",
    "perturb_system",
    "simulate",
]
