"""Dry sand that flows, piles up and comes to rest: the plug-in `granular`."""

from warp_lcp.granular.simulator import GranularSimulator

SIMULATOR = GranularSimulator()

__all__ = ["SIMULATOR", "GranularSimulator"]
