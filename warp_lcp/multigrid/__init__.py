"""Multigrid: cycle, levels and hierarchies of grid stencils and sparse matrices."""

from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy

__all__ = ["CycleSettings", "Hierarchy"]
