"""The pass that tells which particles other ranks must know of."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.particle_loops import particle_pass

INNER, BORDER, OUTSIDE = 0, 1, 2  # of a box: in it and away from its cuts, within reach of them, beyond them
WHERE = particle_pass(
    "warp_lcp.distributed.particles.where",
    {"position": wp.vec3, "where": wp.uint8},
    numbers=dict.fromkeys((f"{end}_{axis}" for end in ("low", "high") for axis in "xyz"), wp.float32) | {"reach": wp.float32},
    headers=Path(__file__).parent / "headers",
)
