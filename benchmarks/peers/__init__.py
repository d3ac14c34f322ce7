"""Other solvers of the same problems."""

from benchmarks.peers.suite import TITLE, measure

__all__ = ["TITLE", "measure"]
