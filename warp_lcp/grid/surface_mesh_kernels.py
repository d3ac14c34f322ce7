# mypy: ignore-errors
"""Kernels of the surface that a picture shows: its field on a lattice, what solids take away of it, and how fast it moves."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.operators.grid_poisson import SOLID

FAR = 2.0  # lattice cells: a distance to solids that takes nothing from the liquid
# of a kernel: where less of it is open the distance is continued from outside the solid
LEAST_OPEN = 0.25
# A particle is boosted by gain ((THIN / share)^POWER - 1) where the smoothed share is below THIN:
# by nothing at a plane surface, where the outermost particles have about 0.63, by most in a drop of
# one particle, by about 1/2 in a sheet of one layer, which keeps its thickness.
THIN, POWER = 0.6, 0.4


_options = {"module": "warp_lcp.grid.surface_mesh"}


KERNELS = KernelFile(
    Path(__file__).parent / "headers/surface_mesh.h",
    {"LEAST_OPEN": LEAST_OPEN, "THIN": THIN, "POWER": POWER},
)
DISTANCE = KERNELS["warp_lcp.grid.surface_mesh.surface_distance"]
ROOM = KERNELS["warp_lcp.grid.surface_mesh.room"]
CARVE = KERNELS["warp_lcp.grid.surface_mesh.carve"]
BOOST = KERNELS["warp_lcp.grid.surface_mesh.boost"]


@forward_kernel(**_options)
def mirror_kernel(fold: bool, lines: F32):
    """Give the ring at both ends of a line the values beside it, after adding to those what the ring holds; a thread a line."""
    a, b = wp.tid()
    last = lines.shape[2] - 1
    for end in range(2):
        ring = end * last
        beside = wp.where(end == 0, 1, last - 1)
        if fold:
            lines[a, b, beside] += lines[a, b, ring]
        lines[a, b, ring] = lines[a, b, beside]


@wp.func
def is_solid(base: I8, planes: int, parts: int, k: int, j: int, i: int):
    """Tell whether a lattice cell lies in a cell that is SOLID; cells of the ring are not."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    return base[c, (j - 1) // parts + 1, (i - 1) // parts + 1] == wp.int8(SOLID)


@cell_kernel("warp_lcp.grid.surface_mesh")
def whole_cell_room_kernel(k, j, i, planes: int, parts: int, base: I8, out: F32):
    """Say half a lattice cell on both sides of the faces of whole solid cells, far elsewhere."""
    d = float(FAR)
    if is_solid(base, planes, parts, k, j, i):
        d = float(-0.5)
    else:
        for a in range(2):
            s = 2 * a - 1
            if is_solid(base, planes, parts, k, j, wp.clamp(i + s, 1, out.shape[2] - 2)):
                d = float(0.5)
            if is_solid(base, planes, parts, k, wp.clamp(j + s, 1, out.shape[1] - 2), i):
                d = float(0.5)
            if planes == 2 and is_solid(
                base, planes, parts, wp.clamp(k + s, 1, out.shape[0] - 2), j, i
            ):
                d = float(0.5)
    out[k, j, i] = d


@cell_kernel("warp_lcp.grid.surface_mesh")
def fill_kernel(k, j, i, planes: int, parts: int, least: float, depth: F32, base: I8, density: F32):
    """Make lattice cells full that lie in open cells deeper than `least`."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    b = (j - 1) // parts + 1
    a = (i - 1) // parts + 1
    if depth[c, b, a] >= least and base[c, b, a] != wp.int8(SOLID):
        density[k, j, i] = 1.0


@cell_kernel("warp_lcp.grid.surface_mesh")
def open_share_kernel(k, j, i, room: F32, out: F32):
    """Estimate which share of each lattice cell is open."""
    out[k, j, i] = wp.clamp(room[k, j, i] + 0.5, 0.0, 1.0)


@forward_kernel(**_options)
def clamp_kernel(points: wp.array(dtype=wp.vec3), size: wp.vec3, out: wp.array(dtype=wp.vec3)):
    """Bring points that are beyond the far sides back to them."""
    p = wp.tid()
    out[p] = wp.min(points[p], size)
