"""Other solvers of the same problems."""

from warp_lcp.benchmarks.peers.suite import TITLE, measure

__all__ = ["TITLE", "measure"]
