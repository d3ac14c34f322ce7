"""Sand on several processes."""

from warp_lcp.granular.distributed.assembly import create, refusals
from warp_lcp.granular.distributed.simulation import DistributedSand

__all__ = ["DistributedSand", "create", "refusals"]
