"""The passes that move particles among walls given by their distance, and out of walls that have moved."""

import functools

import warp as wp

from warp_lcp.grid.particle_loops import particle_pass
from warp_lcp.grid.runge_kutta import MARGIN, runge_kutta
from warp_lcp.rows import RowPass

AIM = 1.1 * MARGIN  # where particles are put: float32 positions in 10^3 cells round by less than the difference
SLACK = 0.25  # cells by which the interpolated distance may exceed the way that is free
STRIDE = 0.5  # cells a particle goes near a wall before it looks again; shorter where it would come out on another side
SHORTEST = 0.02  # cells a stride is cut to where a wall is thinner than that
STRIDES = 64  # of a move: 32 cells along a wall
CORNER = 0.5  # walls whose normals are further apart (cosine) stop a particle between them, nearer ones it slides over
BEND = 0.9  # normals that are nearer than this are one wall
LEG = 0.25  # cells of such a search in one direction
REACH = 1.0  # cells that a step may put a particle back: more than its stride and the diagonal of the walls' rounding
PUSH = 3.0  # cells that a wall may push a particle in a step

_LENGTHS = {"AIM": AIM, "SLACK": SLACK, "STRIDE": STRIDE, "SHORTEST": SHORTEST, "LEG": LEG, "REACH": REACH}
_OTHERS = {"STRIDES": STRIDES, "CORNER": CORNER, "BEND": BEND}

PUSH_OUT = particle_pass(
    "warp_lcp.grid.push_out.push_out",
    {"position": wp.vec3},
    whole={"distance": wp.float32, "moved": wp.int32, "left": wp.int32},
    numbers={"open_sides": int},
    constants={"MARGIN": MARGIN, "ENDLESS": 0, "LEG": LEG, "AIM": AIM, "PUSH": PUSH},
)


@functools.cache
def advect_pass(endless: int) -> RowPass:
    """Return the pass for a domain whose axis n has no end where bit n is set."""
    walls, numbers = {"distance": wp.float32}, {"open_sides": int}
    name, module = "advect_with_distance", "warp_lcp.grid.distance_advection"
    return runge_kutta(
        module, name, walls, endless, numbers=numbers, constants=_LENGTHS | {"STRIDES": STRIDES, "CORNER": CORNER, "BEND": BEND}
    )
