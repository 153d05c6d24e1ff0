"""The physics: a system in, an event series out. No files, no dask, no pandas."""

from stickslip.sim.couplings import COUPLINGS, READINGS, draw_system, perturb_system
from stickslip.sim.drive import Harmonic, Piecewise
from stickslip.sim.run import IntegrationError, Run, Samples, Stats
from stickslip.sim.series import EventSeries
from stickslip.sim.simulation import simulate
from stickslip.sim.system import System
from stickslip.sim.weakening import Rational, Stribeck

__all__ = [
    "COUPLINGS",
    "READINGS",
    "EventSeries",
    "Harmonic",
    "IntegrationError",
    "Piecewise",
    "Rational",
    "Run",
    "Samples",
    "Stats",
    "Stribeck",
    "System",
    "draw_system",
    "perturb_system",
    "simulate",
]
