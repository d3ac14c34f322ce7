# mypy: ignore-errors
"""Kernels of the level set: density, distance from the filled share, volume.

A cell's kernel is the quadratic B-spline around its center, three cells wide along each axis. G(s)
is the share of the kernel that a half space filled up to s cells from the center holds, a cubic in
pieces: (s + 3/2)^3 / 6 up to -1/2, 1/2 + 3/4 s - s^3 / 3 up to 1/2, and G(-s) = 1 - G(s). phi is
minus the s at which G(s) is the filled share.
"""

from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.kernels import KernelFile
from warp_lcp.operators.grid_poisson import SOLID

# Least open share of a cell's kernel. Where less is open, it holds too few particles (one, of four
# a cell), and an empty wedge deep in the liquid would count as air, into which the liquid falls.
# Such a cell gets its neighbors' distance.
MIN_CAPACITY = 0.25
TAIL = 1e-4  # least filled share with a quantile, after smoothing
EXTENDED = 2  # layers of cells to which the distance is extrapolated

_CONSTANTS = {"MIN_CAPACITY": MIN_CAPACITY, "TAIL": TAIL, "SOLID": SOLID}
KERNELS = KernelFile(Path(__file__).parent / "headers/level_set.h", _CONSTANTS)
BINOMIAL = KERNELS["warp_lcp.grid.level_set.binomial"]
DISTANCE = KERNELS["warp_lcp.grid.level_set.level_set_distance"]
VOLUME = KERNELS["warp_lcp.grid.volume.volume"]
SCATTER = KERNELS["grid.density.scatter_density"]
GATHER = KERNELS["warp_lcp.grid.density.gather_density"]


@wp.func
def slope_beside(here: float, below: float, above: float, has_below: bool, has_above: bool):
    """Return the central difference, or the one-sided one with one neighbor only."""
    if has_below and has_above:
        return 0.5 * (above - below)
    if has_above:
        return above - here
    if has_below:
        return here - below
    return 0.0


@cell_kernel("warp_lcp.grid.level_set")
def wall_shift_kernel(
    k, j, i, variance: float, limit: float, capacity: F32, phi: F32, known: I8, out: F32
):
    """Shift phi from the centroid of a kernel's open part back to the cell's center.

    A wall cuts a part off the kernel, so the remaining part measures the liquid at c + s, with s =
    integral of (x - c) K over the open part, divided by the capacity. For a Gaussian of this
    variance s = variance grad(capacity) / capacity. Hence the result phi - s . grad(phi).
    """
    one = wp.int8(1)
    here = phi[k, j, i]
    value = here
    c = capacity[k, j, i]
    inside = (
        k > 0
        and j > 0
        and i > 0
        and k + 1 < phi.shape[0]
        and j + 1 < phi.shape[1]
        and i + 1 < phi.shape[2]
    )
    if inside and known[k, j, i] == one and c < 0.999 and wp.abs(here) < 0.98 * limit:
        gx = slope_beside(
            here,
            phi[k, j, i - 1],
            phi[k, j, i + 1],
            known[k, j, i - 1] == one,
            known[k, j, i + 1] == one,
        )
        gy = slope_beside(
            here,
            phi[k, j - 1, i],
            phi[k, j + 1, i],
            known[k, j - 1, i] == one,
            known[k, j + 1, i] == one,
        )
        gz = slope_beside(
            here,
            phi[k - 1, j, i],
            phi[k + 1, j, i],
            known[k - 1, j, i] == one,
            known[k + 1, j, i] == one,
        )
        grad = wp.vec3(gx, gy, gz) / wp.max(wp.length(wp.vec3(gx, gy, gz)), 1.0)
        s = 0.5 * wp.vec3(
            capacity[k, j, i + 1] - capacity[k, j, i - 1],
            capacity[k, j + 1, i] - capacity[k, j - 1, i],
            capacity[k + 1, j, i] - capacity[k - 1, j, i],
        )
        if phi.shape[0] == 3:
            s[2] = 0.0
        s = s * (variance / wp.max(c, 1e-3))
        s = s / wp.max(wp.length(s), 1.0)
        value = wp.clamp(here - wp.dot(s, grad), -limit, limit)
    out[k, j, i] = value


@cell_kernel("warp_lcp.grid.level_set")
def clear_kernel(k, j, i, limit: float, phi: F32, known: I8):
    """Reset the level set to air where an earlier update has written."""
    phi[k, j, i] = limit
    known[k, j, i] = wp.int8(0)


@cell_kernel("warp_lcp.grid.level_set")
def whole_cell_capacity_kernel(k, j, i, planes: int, base: I8, capacity: F32):
    """Sum up the shares 1/6, 2/3, 1/6 of a cell's kernel over open cells."""
    total = float(0.0)
    for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, base.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, base.shape[1])):
            for a in range(wp.max(i - 1, 0), wp.min(i + 2, base.shape[2])):
                if base[c, b, a] != wp.int8(SOLID):
                    w = float(1.0)
                    w *= wp.where(a == i, 2.0 / 3.0, 1.0 / 6.0)
                    w *= wp.where(b == j, 2.0 / 3.0, 1.0 / 6.0)
                    if planes == 2:
                        w *= wp.where(c == k, 2.0 / 3.0, 1.0 / 6.0)
                    total += w
    capacity[k, j, i] = total
