# mypy: ignore-errors
"""Kernels of the surface mesh: its field on a lattice, solids, and velocity."""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.operators.grid_poisson import SOLID

FAR = 2.0  # lattice cells: beyond this distance a solid does not reduce the liquid
# Share of a kernel. Where less is open, the distance is extrapolated from outside the solid.
LEAST_OPEN = 0.25
# A particle is amplified by gain (sqrt(THIN / fullness) - 1) where the fullness around it, see the
# kernel `boost`, is below THIN. For a kernel of 1.5 particle distances the fullness is 0.9 to 1.0
# up to half a particle distance below a plane surface, 0.6 in a sheet of two layers, 0.27 in
# one of one layer, and that of its own kernel, 0.02, in a drop of one particle.
THIN = 1.0
# Share of a particle's lattice cell from which on the fullness at the particle is not below THIN.
CROWDED = 0.8
# Share of the narrow kernels from which on a surface is not moved back: they have filled it.
FILLED = 0.18


_options = {"module": "warp_lcp.grid.surface_mesh"}


KERNELS = KernelFile(
    Path(__file__).parent / "headers/surface_mesh.h",
    {"LEAST_OPEN": LEAST_OPEN, "THIN": THIN, "CROWDED": CROWDED, "FILLED": FILLED},
)
DISTANCE = KERNELS["warp_lcp.grid.surface_mesh.surface_distance"]
ROOM = KERNELS["warp_lcp.grid.surface_mesh.room"]
CARVE = KERNELS["warp_lcp.grid.surface_mesh.carve"]
RESTORE = KERNELS["warp_lcp.grid.surface_mesh.restore"]
BOOST = KERNELS["warp_lcp.grid.surface_mesh.boost"]


@forward_kernel(**_options)
def mirror_kernel(fold: bool, lines: F32):
    """Copy the values beside both ends of a line to the ring.

    With `fold`, the ring's values are first added to those beside it. One thread takes a line.
    """
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
    """Return whether a lattice cell lies in a SOLID cell; cells of the ring do not."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    return base[c, (j - 1) // parts + 1, (i - 1) // parts + 1] == wp.int8(SOLID)


@cell_kernel("warp_lcp.grid.surface_mesh")
def whole_cell_room_kernel(k, j, i, planes: int, parts: int, base: I8, out: F32):
    """Write the distance to whole solid cells: half a lattice cell beside their faces.

    Elsewhere it is a large number.

    In lattice cells: -1/2 in a solid cell, 1/2 in an open one beside it, else FAR.
    """
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
    """Fill lattice cells that lie in open cells deeper than `least`."""
    c = wp.where(planes == 2, (k - 1) // parts + 1, 1)
    b = (j - 1) // parts + 1
    a = (i - 1) // parts + 1
    if depth[c, b, a] >= least and base[c, b, a] != wp.int8(SOLID):
        density[k, j, i] = 1.0


@cell_kernel("warp_lcp.grid.surface_mesh")
def open_share_kernel(k, j, i, room: F32, out: F32):
    """Estimate the open share of each lattice cell."""
    out[k, j, i] = wp.clamp(room[k, j, i] + 0.5, 0.0, 1.0)


@forward_kernel(**_options)
def clamp_kernel(points: wp.array(dtype=wp.vec3), size: wp.vec3, out: wp.array(dtype=wp.vec3)):
    """Move points that are beyond the far sides back to these sides."""
    p = wp.tid()
    out[p] = wp.min(points[p], size)
