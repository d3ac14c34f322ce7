"""Galerkin multigrid of a grid stencil."""

from warp_lcp.multigrid.cycle_settings import CycleSettings
from warp_lcp.multigrid.hierarchy import Hierarchy

__all__ = ["CycleSettings", "Hierarchy"]
