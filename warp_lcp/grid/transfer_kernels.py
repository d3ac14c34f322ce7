# mypy: ignore-errors
"""Kernels of the transfers. `scatter` and `gather_weights` are two forms of one sum, `interpolate` is its adjoint.

Node (k, j, i) of component `axis` lies at the grid coordinates (i, j + 1/2, k + 1/2) with the axis' own 1/2 left out, plus the origin of a
part of a grid. In 2-D the nodes of one plane are used: the coordinate along z is that of the plane, and the plane above is the same one.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.grid.cell_kernel import cell_kernel
from warp_lcp.grid.particle_loops import particle_pass
from warp_lcp.rows import RowPass

TINY_WEIGHT = 1e-9  # below it a face counts as untouched
# A particle that lies exactly on the boundary between cells would leave one face of its own cell without weight, hence without gravity.
EDGE = {wp.float32: 1e-5, wp.float64: 1e-12}
VECTORS = {wp.float32: wp.vec3, wp.float64: wp.vec3d}


@functools.cache
def kernels(real: Any) -> SimpleNamespace:
    """Return the passes for fields and particles of float32 or float64, and what makes means of sums."""
    name, vector = f"warp_lcp.grid.transfer_{real.__name__}", VECTORS[real]
    constants, particles = {"EDGE": EDGE[real], "TINY_WEIGHT": TINY_WEIGHT}, dict.fromkeys(("position", "velocity", "gradient"), vector)

    def made(which: str, box: dict[str, Any], whole: dict[str, Any], numbers: dict[str, Any]) -> RowPass:
        absent = ("gradient", "saved")
        more = {"whole": whole, "numbers": {"axis": int} | numbers, "constants": constants, "optional": absent}
        return particle_pass(f"{name}.{which}", box, real=real, **more)

    @cell_kernel(name)
    def normalize(k, j, i, weight: wp.array3d(dtype=real), field: wp.array3d(dtype=real)):
        w = weight[k, j, i]
        if w > real(TINY_WEIGHT):
            field[k, j, i] = field[k, j, i] / w
        else:
            field[k, j, i] = real(0.0)

    return SimpleNamespace(
        scatter=made("scatter", particles, {"momentum": real, "weight": real}, {}),
        interpolate=made("interpolate", particles, {"field": real, "saved": real}, {"flip": real}),
        gather_weights=made("gather_weights", {"field": real, "weight": real}, {"offsets": wp.int32, **particles}, {}),
        normalize=normalize,
    )
