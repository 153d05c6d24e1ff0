"""What runs of the exact law settle on: rest, steady sliding, a cycle, a torus, or irregular motion."""

from stickslip.sim.attractors.continuation import continued
from stickslip.sim.attractors.result import Attractor, same_cycle
from stickslip.sim.attractors.settling import attractor

__all__ = ["Attractor", "attractor", "continued", "same_cycle"]
