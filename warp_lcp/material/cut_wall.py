"""Velocity around the material after the projection where walls cut cells: into the air, and at walls that hold it or let it go.

The order is that of `warp_lcp.material.wall`, for the same reasons. 1. One layer is extrapolated from the projected faces. 2. Open faces
between AIR cells that particles gave weight keep their own velocity. 3. Further layers are extrapolated from both; closed faces have taken
part and carry the material's velocity. 4. With n the gradient of the distance to the wall that closes a face, at the face's center, u the
velocity there and u_s the wall's, w = n.(u - u_s) is the relative normal velocity. (Beside two walls the gradient of the smaller distance
lies between their normals: with one wall's u_s it would turn the flow before a piston away from the floor.) Where the wall holds the
material the face loses w n, of either sign, so that a moving wall drags its material along; released cells and AIR lose it only where
w < 0, so that the last particles can leave. 5. Faces of the ring beside the domain's walls follow the faces next to them, so that
tangential flow is not slowed by a wall.

Partly open faces have been projected and keep their velocity. The interpolated u takes known faces alone.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import warp as wp

from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.extrapolate import extrapolate
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.material.boundary_kernels import HELD, RELEASED, TOUCHES_NOTHING
from warp_lcp.material.wall import KEEP_SPRAY, Join, keep_released_kernel
from warp_lcp.operators.grid_poisson import FLUID, SOLID
from warp_lcp.rows import RowPass

DEPTH = 2.0  # cells inside a wall beyond which no particle's tent reaches a face: sqrt(3), and what the distance errs

F32, I8, I16 = wp.float32, wp.int8, wp.int16
HEADERS = Path(__file__).parent / "headers"
_CONSTANTS = {"TINY_WEIGHT": TINY_WEIGHT, "DEPTH": DEPTH, "SOLID": SOLID, "FLUID": FLUID} | {
    "TOUCHES_NOTHING": TOUCHES_NOTHING, "HELD": HELD, "RELEASED": RELEASED,
}  # fmt: skip
_FACE, _AXIS = {"known": I8, "open": F32, "result": F32}, {"axis": int, "planes": int}
_COMPONENTS = {f"{name}{c}": kind for name, kind in (("", F32), ("known_", I8), ("wall_", I16), ("moving_", F32)) for c in "uvw"}
_NEAREST = {"owner": I16, "next_near": F32, "next_owner": I16}


def _made(name: str, box: dict[str, Any], **more: Any) -> RowPass:
    absent = (*_COMPONENTS, *_NEAREST)
    path = HEADERS / f"{name}.h"
    return RowPass(f"warp_lcp.material.cut_wall.{name}", path, F32, box=box, constants=_CONSTANTS, optional=absent, **more)


CONSTRAIN = _made(
    "constrain",
    _FACE | _COMPONENTS | _NEAREST | {"kind": I8, "contact": wp.uint8, "distance": F32},
    numbers=_AXIS | {"dx": F32},
    whole={"turn": wp.mat33, "shift": wp.vec3, "separating": wp.uint8},
)
TAKE = _made("take", _FACE | {"field": F32}, numbers=_AXIS)


def extend_velocity_cut(
    window: Window,
    velocity: Sequence[wp.array],
    weights: Sequence[wp.array],
    known: Sequence[wp.array],
    kind: wp.array,
    contact: wp.array,
    cut: CutCells,
    scratch: Sequence[wp.array],
    layers: int,
    *,
    join: Join | None = None,
) -> None:
    """Continue the projected velocity into air and walls.

    Args:
        window: faces to consider.
        velocity: each component [m/s] (updated): projected where `known`, the particles' average where there is weight.
        weights: of the particles on each component's faces.
        known: int8 of each component (updated): 1 on projected faces, 0 on others, -1 on those deep inside solids.
        kind: int8 of AIR, FLUID, SOLID.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
        cut: the walls: distances at nodes, open fractions, whose wall closes a face, and its velocity.
        scratch: a float32 field for each component (written).
        layers: how far into air and walls, in faces.
        join: called with the marks and the velocity of a component after each layer, see `warp_lcp.grid.extrapolate`.
    """
    for axis, (field, weight, marks, fraction) in enumerate(zip(velocity, weights, known, cut.open, strict=True)):
        window.launch(keep_released_kernel, [axis, kind, contact, weight, field, marks])
        extrapolate(window, marks, field, 1, join=join)
        window.run(KEEP_SPRAY, axis=axis, known=marks, weight=weight, kind=kind, open=fraction)
        extrapolate(window, marks, field, layers, join=join)
    parts = zip(("", "known_", "wall_", "moving_"), (velocity, known, cut.wall, cut.velocity or ()), strict=True)
    fields: dict[str, Any] = dict.fromkeys(_COMPONENTS) | {
        f"{name}{c}": field for name, of in parts for c, field in zip("uvw", of, strict=False)
    }
    fields |= dict(zip(_NEAREST, cut.nearest or [None] * 3, strict=True)) | {"kind": kind, "contact": contact, "distance": cut.distance}
    fields |= {"turn": cut.turn, "shift": cut.shift, "separating": cut.separating, "dx": cut.grid.spacing}
    faces = [{"known": m, "open": o, "result": r} for m, o, r in zip(known, cut.open, scratch, strict=True)]
    planes = len(velocity) - 1
    for axis, face in enumerate(faces):
        window.run(CONSTRAIN, axis=axis, planes=planes, **face, **fields)
    for axis, (face, field) in enumerate(zip(faces, velocity, strict=True)):
        window.run(TAKE, axis=axis, planes=planes, **face, field=field)
