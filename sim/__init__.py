"""The physics: a system in, an event series out. No files, no dask, no pandas."""

from sim.coupling import COUPLINGS, READINGS, draw_system, perturb_system
from sim.run import IntegrationError, Run, Samples, Stats, simulate
from sim.series import EventSeries
from sim.system import System

__all__ = [
    "COUPLINGS",
    "READINGS",
    "EventSeries",
    "IntegrationError",
    "Run",
    "Samples",
    "Stats",
    "System",
    "draw_system",
    "perturb_system",
    "simulate",
]
