"""Galerkin multigrid of a grid stencil."""

from warp_lcp.multigrid.hierarchy import CycleSettings, Hierarchy

__all__ = ["CycleSettings", "Hierarchy"]
