"""Liquids on a staggered grid that let go of their walls: the plug-in `fluids` of warp_lcp."""

from fluids.pressure import PressureProjection, Projection
from fluids.scene import LiquidScene
from fluids.simulator import FluidsSimulator, LiquidSimulation

SIMULATOR = FluidsSimulator()

__all__ = ["SIMULATOR", "FluidsSimulator", "LiquidScene", "LiquidSimulation", "PressureProjection", "Projection"]
