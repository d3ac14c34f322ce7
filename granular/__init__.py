"""Sand that flows, piles up and comes to rest: a plug-in of warp_lcp."""

from granular.simulator import GranularSimulator

SIMULATOR = GranularSimulator()

__all__ = ["SIMULATOR", "GranularSimulator"]
