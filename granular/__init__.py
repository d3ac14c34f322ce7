"""Sand that flows, piles up and comes to rest: a plug-in of warp_lcp."""

from warp_lcp.granular.simulator import GranularSimulator

SIMULATOR = GranularSimulator()

__all__ = ["SIMULATOR", "GranularSimulator"]
