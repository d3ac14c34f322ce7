"""Passes that take particles a third-order Runge-Kutta step along the grid's velocity."""

from typing import Any

import warp as wp

from warp_lcp.grid.particle_loops import particle_pass
from warp_lcp.rows import RowPass

MARGIN = 1e-3  # how far from a wall particles stay, in cells: well above the rounding of float32 positions in 10^3 cells


def runge_kutta(module: str, name: str, walls: dict[str, Any], endless: int, **more: Any) -> RowPass:
    """Return a pass that moves particles and counts those that were stopped.

    Args:
        module: of Warp, for a domain all of whose axes end.
        name: of the pass.
        walls: what stops them.
        endless: has bit n set if axis n has no end; the header finds it as ENDLESS.
        more: `numbers` and `constants` of the pass.
    """
    more["numbers"] = {"h": wp.float32} | more.get("numbers", {})
    more["constants"] = {"MARGIN": MARGIN, "ENDLESS": endless} | more.get("constants", {})
    whole = dict.fromkeys("uvw", wp.float32) | walls | {"stopped": wp.int32}
    module += f"_{endless}" * (endless > 0)
    return particle_pass(f"{module}.{name}", {"position": wp.vec3}, whole=whole, optional=("w",), **more)
