# mypy: ignore-errors
"""Kernels of surface tension: the smoothed share of liquid beside walls, its curvature, the push on the surface, its energy."""

import functools
from pathlib import Path
from types import SimpleNamespace

import warp as wp

from warp_lcp.fluids.pressure import CONSTANTS, F32, FACES, I8, THETA_MIN
from warp_lcp.grid.cell_kernel import F32 as FIELD
from warp_lcp.grid.cell_kernel import I8 as MARKS
from warp_lcp.grid.cell_kernel import INTS, POINTS, cell_kernel, list_kernel
from warp_lcp.grid.particle_loops import cell_pass
from warp_lcp.rows import RowPass

HEADERS = Path(__file__).parent / "headers"
MODULE = "fluids.surface_tension"
FLOATS = wp.array(dtype=wp.float32)
TAIL = wp.constant(1e-4)  # shares nearer to 0 or 1 have no place on the profile
BAND = 0.02  # cells whose share is nearer to 0 or 1 are too far from the surface to matter
HALF = 0.3  # the part of the shares on either side of the surface that its area is found from
FARTHEST = 1.5  # cells from one beside the surface to the smooth surface
PROFILE = {"planes": int, "linear": wp.float32, "cubic": wp.float32}  # of the distance that a smooth share means
_SHARES = {"headers": HEADERS, "constants": CONSTANTS | {"BAND": BAND, "FARTHEST": FARTHEST}}
CURVATURE = cell_pass(f"{MODULE}.curvature", "once twice bend", numbers={**PROFILE, "limit": wp.float32}, **_SHARES)
JUMP = cell_pass(f"{MODULE}.jump", "once twice bend jump", {"kind": wp.int8}, numbers={**PROFILE, "scale": wp.float32}, **_SHARES)


@functools.cache
def push_pass(cut: bool) -> SimpleNamespace:
    """Return `push`, which acts on the velocity, and `energy`, which sums the surface up; `cut`: whether faces have open fractions."""
    module = MODULE + "_cut" * cut
    flags = {"CUT": cut, "MOVING": False, "GHOST": True, "BOUNDED": False, "THETA_MIN": THETA_MIN, "HALF": HALF}
    surface, numbers = {"kind": I8, **FACES, "phi": F32}, {"planes": int}
    optional = (*FACES,)

    def made(name: str, compute: object, fields: dict, **more: object) -> RowPass:
        taken = numbers | more.pop("numbers", {})
        path = HEADERS / f"{name}.h"
        return RowPass(
            f"{module}.{name}", path, compute, box=surface | fields, numbers=taken, constants=CONSTANTS | flags, optional=optional, **more
        )

    return SimpleNamespace(
        push=made("push", F32, {"jump": F32, "field": F32}, numbers={"axis": int}),
        energy=made("surface_energy", wp.float64, {"once": F32, "twice": F32}, numbers=PROFILE, sums=("area", "wetted")),
    )


@wp.func
def filled(s: float):
    """Return the share of a cell's kernel that a half space filled up to s cells from its center holds, see `warp_lcp.grid.level_set`."""
    t = wp.min(1.5 - wp.abs(s), 1.0)
    share = t * t * t / 6.0
    if wp.abs(s) < 0.5:
        share = 0.5 - 0.75 * wp.abs(s) + wp.abs(s) * s * s / 3.0
    share = wp.where(wp.abs(s) >= 1.5, 0.0, share)
    return wp.where(s > 0.0, 1.0 - share, share)


@cell_kernel(MODULE)
def share_kernel(k, j, i, phi: FIELD, blocked: MARKS, share: FIELD):
    """Say how full the kernel of each open cell is."""
    share[k, j, i] = wp.where(blocked[k, j, i] == wp.int8(0), filled(-phi[k, j, i]), 0.0)


@list_kernel(MODULE)
def continue_kernel(
    i, cells: INTS, points: POINTS, way: FLOATS, cosine: float, spread: float, planes: int, blocked: MARKS, share: FIELD, flat: FLOATS
):
    """Continue the share into a wall's cell from the open cells around a point before the wall, `way` cells nearer to the open.

    Along it the distance to the surface falls by the angle's cosine; a profile of the normal distribution with the spread [cells] turns
    shares into distances and back. A cell reads open cells and writes none.
    """
    p = points[i]
    a = int(wp.floor(p[0]))
    b = int(wp.floor(p[1]))
    c = int(wp.floor(p[2]))
    total = float(0.0)
    weight = float(0.0)
    for dk in range(planes):
        for dj in range(2):
            for di in range(2):
                w = wp.where(di == 0, 1.0 - (p[0] - float(a)), p[0] - float(a))
                w *= wp.where(dj == 0, 1.0 - (p[1] - float(b)), p[1] - float(b))
                if planes == 2:
                    w *= wp.where(dk == 0, 1.0 - (p[2] - float(c)), p[2] - float(c))
                if w > 1e-3:
                    if blocked[c + dk, b + dj, a + di] == wp.int8(0):
                        total += w * share[c + dk, b + dj, a + di]
                        weight += w
    if weight > 0.0:
        value = total / weight
        if cosine != 0.0 and value > TAIL and value < 1.0 - TAIL:
            place = spread * 1.41421356 * wp.erfinv(2.0 * value - 1.0) + way[i] * cosine
            value = 0.5 + 0.5 * wp.erf(place / (1.41421356 * spread))
        flat[cells[i]] = value


@wp.kernel(enable_backward=False, module=MODULE)
def calm_kernel(factor: float, deepest: float, key: wp.array(dtype=wp.int32), phi: FLOATS, gradient: POINTS):
    """Weaken a velocity's gradient in particles whose cell is near the surface."""
    particle = wp.tid()
    if phi[key[particle]] > deepest:
        gradient[particle] = factor * gradient[particle]
