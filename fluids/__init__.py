"""Liquids on a staggered grid with separating walls: the plug-in `fluids`."""

from warp_lcp.fluids.pressure import PressureProjection, Projection
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.simulator import FluidsSimulator, LiquidSimulation

SIMULATOR = FluidsSimulator()

__all__ = [
    "SIMULATOR",
    "FluidsSimulator",
    "LiquidScene",
    "LiquidSimulation",
    "PressureProjection",
    "Projection",
]
