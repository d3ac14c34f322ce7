"""Liquid on several processes."""

from warp_lcp.fluids.distributed.assembly import create
from warp_lcp.fluids.distributed.simulation import DistributedLiquid

__all__ = ["DistributedLiquid", "create"]
