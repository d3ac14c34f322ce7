"""Extrapolate the projected velocity into air and to walls.

The order matters. 0. Closed faces of RELEASED cells with particle weight keep their own velocity,
but no more than the mean of the projected faces around them. (Extrapolated values would throw
everything that rests at a wall after the one particle that leaves it. Their own velocity alone
would let a cell's worth of a full box fall.) 1. One layer is extrapolated from the projected faces.
2. Faces between AIR cells with particle weight keep their own velocity: extrapolating over spray
would make a droplet hang above a pool. If the material is viscous, its stress slows them first, see
`SprayViscosity`. 3. Further layers are extrapolated from all of them. Closed
faces are included and now have the material's velocity, not the wall's. 4. Held cells set their
closed faces to the wall's normal velocity (not merely less of the inward one: a moving wall drags
its material along). Released and AIR cells lose only the part into the wall, so that the last
particles can leave. 5. Faces inside solids follow the faces beside them, so that a wall does not
slow tangential flow.

Where walls cut cells the order is the same, for the same reasons; partly open faces have been
projected and keep their velocity. 4. Let n be the gradient of the distance to the wall that closes
a face, at the face's center, u the velocity there (of known faces alone), and u_s the wall's
velocity. The relative normal velocity is w = n.(u - u_s). (Beside two walls the gradient of the
smaller distance lies between their normals: with one wall's u_s it would turn the flow before a
piston away from the floor.) Where the wall holds the material the face loses w n, of either sign;
released cells and AIR lose it only where w < 0. 5. Faces of the ring beside the domain's walls
follow the faces next to them.
"""

import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.grid.advection import FaceVelocity
from warp_lcp.grid.cell_kernel import F32, I8, I32, U8, cell_below, cell_kernel, next_to
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.extrapolate import BLOCKED, extrapolate
from warp_lcp.grid.staggered import Window, three_components
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material.boundary_kernels import HELD, RELEASED, TOUCHES_NOTHING
from warp_lcp.operators.grid_poisson import FLUID, SOLID

LayerCallback = Callable[
    [wp.array, wp.array], None
]  # takes the marks and the velocity of a component

# Cells inside a wall beyond which no particle's tent reaches a face: sqrt(3), plus the error of the
# distance.
DEPTH = 2.0
_CONSTANTS = {"TINY_WEIGHT": TINY_WEIGHT, "DEPTH": DEPTH, "SOLID": SOLID, "FLUID": FLUID} | {
    "TOUCHES_NOTHING": TOUCHES_NOTHING,
    "HELD": HELD,
    "RELEASED": RELEASED,
}
KERNELS = KernelFile(Path(__file__).parent / "headers/wall.h", _CONSTANTS)
KEEP_SPRAY = KERNELS["warp_lcp.material.velocity_extrapolation.keep_spray"]
_FLUID = wp.constant(wp.int8(FLUID))
_SOLID = wp.constant(wp.int8(SOLID))


@cell_kernel("warp_lcp.material.velocity_extrapolation")
@typing.no_type_check
def keep_released_kernel(
    k, j, i, axis: int, kind: I8, contact: U8, weight: F32, field: F32, known: I8
):
    """Keep the velocity of closed faces of RELEASED cells that carry weight.

    They are still unknown, and become known after the first layer. They move as their own particles
    do, but no faster than the mean of the known faces around them, nor against it.
    """
    # u = sign(u) min(|u|, |m|) if u m > 0, else 0 [m/s], with m the mean of the known faces among
    # the six next to this one. Faces that become known here are marked 2, so that they do not count
    # in m.
    # A face with weight is not on the array's edge, see below.
    if known[k, j, i] == wp.int8(0) and weight[k, j, i] > TINY_WEIGHT:
        c = k - wp.where(axis == 2, 1, 0)
        b = j - wp.where(axis == 1, 1, 0)
        a = i - wp.where(axis == 0, 1, 0)
        here = kind[k, j, i] == _FLUID and int(contact[k, j, i]) == RELEASED
        if here or (kind[c, b, a] == _FLUID and int(contact[c, b, a]) == RELEASED):
            total = float(0.0)
            count = float(0.0)
            for n in range(6):
                side = 1 - 2 * (n & 1)
                z = k + wp.where(n // 2 == 2, side, 0)
                y = j + wp.where(n // 2 == 1, side, 0)
                x = i + wp.where(n // 2 == 0, side, 0)
                if z >= 0 and z < known.shape[0] and y < known.shape[1] and x < known.shape[2]:
                    if known[z, y, x] == wp.int8(1):
                        total += field[z, y, x]
                        count += 1.0
            if count > 0.0:
                own = field[k, j, i]
                around = total / count
                field[k, j, i] = wp.where(
                    own * around > 0.0, wp.sign(own) * wp.min(wp.abs(own), wp.abs(around)), 0.0
                )
            known[k, j, i] = wp.int8(2)


@cell_kernel("warp_lcp.material.velocity_extrapolation")
@typing.no_type_check
def closed_face_kernel(
    k,
    j,
    i,
    axis: int,
    kind: I8,
    contact: U8,
    index: I32,
    separating: wp.array(dtype=wp.uint8),
    solid: F32,
    field: F32,
):
    """Set the wall's normal velocity on closed faces, or limit theirs.

    Where the material may leave, only the part into the wall is removed.
    """
    c, b, a = cell_below(axis, k, j, i)
    here = index[k, j, i]
    below = index[c, b, a]
    if (here >= 0) != (below >= 0):
        wall = wp.max(here, below)
        outward = float(1.0)  # from the wall into the open
        filled = kind[k, j, i] == _FLUID
        leaving = int(contact[k, j, i]) == RELEASED
        if here >= 0:
            outward = -1.0
            filled = kind[c, b, a] == _FLUID
            leaving = int(contact[c, b, a]) == RELEASED
        target = float(0.0)
        if solid:
            target = solid[k, j, i]
        held = filled and (separating[wall] == wp.uint8(0) or not leaving)
        if held or outward * (field[k, j, i] - target) < 0.0:
            field[k, j, i] = target


@cell_kernel("warp_lcp.material.velocity_extrapolation")
@typing.no_type_check
def viscous_spray_kernel(
    k,
    j,
    i,
    axis: int,
    layer: int,
    strength: float,
    relative: F32,
    kind: I8,
    open: F32,
    apart: U8,
    weight: F32,
    field: F32,
    known: I8,
):
    """Apply viscous stress to open faces with weight beside faces known up to `layer`.

    They are marked layer + 1, see `SprayViscosity`.

    Args:
        k: plane of the face.
        j: row of the face.
        i: place in its row.
        axis: component of the velocity.
        layer: largest mark of the faces whose velocity is read.
        strength: tau of a relative viscosity of 1.
        relative: relative viscosity of cells, or an empty array if it is 1.
        kind: AIR, FLUID, SOLID.
        open: open fractions of the component's faces, or an empty array without cut cells.
        apart: bit d is set if a thin solid lies between this face and the one below along axis d.
        weight: weights of the particles.
        field: the component [m/s] (updated).
        known: marks (updated).
    """
    # A face with weight is not on the array's edge.
    if known[k, j, i] == wp.int8(0) and weight[k, j, i] > TINY_WEIGHT:
        c, b, a = cell_below(axis, k, j, i)
        free = kind[k, j, i] != _SOLID and kind[c, b, a] != _SOLID
        if open:
            free = open[k, j, i] > 0.0
        if free:
            own = field[k, j, i]
            total = float(0.0)
            links = float(0.0)
            beside = int(0)
            for n in range(6):
                d = n >> 1
                side = 2 * (n & 1) - 1
                z, y, x = next_to(d, side, k, j, i)
                if z >= 0 and z < known.shape[0] and y < known.shape[1] and x < known.shape[2]:
                    mark = int(known[z, y, x])
                    divided = int(0)
                    if apart:
                        divided = int(apart[wp.max(z, k), wp.max(y, j), wp.max(x, i)]) >> d & 1
                    if mark > 0 and mark <= layer and divided == 0:
                        beside += 1
                        u = field[z, y, x]
                        # Material that comes closer along the axis moves on until it has arrived.
                        if d != axis or float(side) * (own - u) < 0.0:
                            total += u
                            links += 1.0
            if beside > 0:
                tau = strength
                if relative:
                    tau *= 0.5 * (relative[k, j, i] + relative[c, b, a])
                field[k, j, i] = (own + tau * total) / (1.0 + tau * links)
                known[k, j, i] = wp.int8(layer + 1)


SPRAY_LAYERS = 2  # layers of faces that particles in AIR cells beside liquid reach, after the first


@dataclass(frozen=True, slots=True)
class SprayViscosity:
    """Viscous stress on faces between AIR cells that carry particles.

    Such particles, as those at the corners of a thread's tip, are no unknowns of the viscous solve.
    Gravity alone would tear them off, however thick the liquid is. A face with the velocity u* and
    the mass of a cell is linked to the faces g beside it that are known:

        u - u* + tau sum_g (u - u_g) = 0,   tau = nu dt / dx^2,

    in one implicit step of each layer, outwards. Links to faces ahead that it approaches are left
    out: a droplet above a pool would hang there.

    Attributes:
        strength: tau of a relative viscosity of 1.
        relative: relative viscosity of cells; None if it is 1.
    """

    strength: Scalar
    relative: wp.array | None = None

    def act(
        self,
        window: Window,
        axis: int,
        velocity: wp.array,
        weight: wp.array,
        known: wp.array,
        kind: wp.array,
        *,
        open_fraction: wp.array | None = None,
        apart: wp.array | None = None,
        join: LayerCallback | None = None,
    ) -> None:
        """Update a component after the first extrapolated layer; arguments as of the kernel."""
        for layer in range(2, 2 + SPRAY_LAYERS):
            fields = [kind, open_fraction, apart, weight, velocity, known]
            window.launch(
                viscous_spray_kernel, [axis, layer, self.strength, self.relative, *fields]
            )
            if join is not None:
                join(known, velocity)


def extend_velocity(
    window: Window,
    velocity: Sequence[wp.array],
    weights: Sequence[wp.array],
    known: Sequence[wp.array],
    kind: wp.array,
    contact: wp.array,
    index: wp.array,
    separating: wp.array,
    solid_velocity: Sequence[wp.array],
    layers: int,
    *,
    spray: SprayViscosity | None = None,
    join: LayerCallback | None = None,
) -> None:
    """Extrapolate the projected velocity into air and walls.

    Args:
        window: faces to consider.
        velocity: each component [m/s] (updated): projected where `known`, the particles' average
            where there is weight.
        weights: weights of the particles on each component's faces.
        known: int8 of each component (updated): 1 on projected faces, 0 on others, -1 inside
            solids.
        kind: int8 of AIR, FLUID, SOLID.
        contact: uint8 of TOUCHES_NOTHING, HELD, RELEASED.
        index: int32: -1 in open cells, the wall's number elsewhere.
        separating: uint8 a wall.
        solid_velocity: velocity of the solids on each component's faces [m/s], or empty if all
            stand still.
        layers: number of layers of faces to fill in the air.
        spray: viscous stress on spray beside liquid; None if the material has none.
        join: called with the marks and the velocity of a component after each layer, see
            `warp_lcp.grid.extrapolate`.
    """
    for axis, (field, weight, marks) in enumerate(zip(velocity, weights, known, strict=True)):
        window.launch(keep_released_kernel, [axis, kind, contact, weight, field, marks])
        extrapolate(window, marks, field, 1, join=join)
        if spray is not None:
            spray.act(window, axis, field, weight, marks, kind, join=join)
        window.run(KEEP_SPRAY, axis=axis, known=marks, weight=weight, kind=kind, open=None)
        if join is not None:
            join(marks, field)
        extrapolate(window, marks, field, layers, join=join)
        solid = solid_velocity[axis] if solid_velocity else None
        window.launch(closed_face_kernel, [axis, kind, contact, index, separating, solid, field])
        if join is not None:
            join(marks, field)
        # A particle's tent reaches faces inside a solid beside its cell and, in 3-D, the faces
        # beside those.
        extrapolate(
            window, marks, field, len(velocity) - 1, start=layers + 1, fill=BLOCKED, join=join
        )


CONSTRAIN = KERNELS["warp_lcp.material.cut_wall.constrain"]
TAKE = KERNELS["warp_lcp.material.cut_wall.take"]


@dataclass(frozen=True, slots=True)
class WallFields:
    """Walls that cut cells, for the kernel that constrains velocities beside them.

    Components along z are None in 2-D.

    Attributes:
        known_u: marks of the faces along x: 1 known, 0 not, -1 deep inside solids; int8.
        known_v: likewise along y.
        known_w: likewise along z.
        wall_u: numbers of the walls that close the faces along x, int16.
        wall_v: likewise along y.
        wall_w: likewise along z.
        moving_u: velocity of solids on the faces along x [m/s], float32; None if they rest.
        moving_v: likewise along y.
        moving_w: likewise along z.
        owner: number of the solid nearest to each node, int16; None if there is one solid.
        next_near: distance of the next one [cells].
        next_owner: its number.
        distance: to solids at nodes [cells], float32.
        turn: rotation of each solid.
        shift: position of each solid.
        separating: whether material leaves each wall freely, uint8.
    """

    known_u: wp.array
    known_v: wp.array
    known_w: wp.array | None
    wall_u: wp.array
    wall_v: wp.array
    wall_w: wp.array | None
    moving_u: wp.array | None
    moving_v: wp.array | None
    moving_w: wp.array | None
    owner: wp.array | None
    next_near: wp.array | None
    next_owner: wp.array | None
    distance: wp.array
    turn: wp.array
    shift: wp.array
    separating: wp.array

    @classmethod
    def of(cls, cut: CutCells, known: Sequence[wp.array]) -> "WallFields":
        """Return the fields of walls, with the marks of each component's faces."""
        components = [
            field for of in (known, cut.wall, cut.velocity or ()) for field in three_components(of)
        ]
        nearest = cut.nearest or [None, None, None]
        return cls(*[*components, *nearest, cut.distance, cut.turn, cut.shift, cut.separating])


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
    spray: SprayViscosity | None = None,
    join: LayerCallback | None = None,
) -> None:
    """Extrapolate the projected velocity into air and walls that cut cells.

    Args as of `extend_velocity`, but:
        known: -1 on faces deep inside solids. cut: the walls: distances at nodes, open fractions,
        whose wall closes a face, and its velocity. scratch: a float32 field for each component
        (written). layers: how far into air and walls, in faces.
    """
    barriers = cut.grid.barriers
    for axis, (field, weight, marks, fraction) in enumerate(
        zip(velocity, weights, known, cut.open, strict=True)
    ):
        window.launch(keep_released_kernel, [axis, kind, contact, weight, field, marks])
        apart = barriers.apart[axis] if barriers is not None else None
        extrapolate(window, marks, field, 1, join=join, apart=apart)
        if spray is not None:
            spray.act(
                window,
                axis,
                field,
                weight,
                marks,
                kind,
                open_fraction=fraction,
                apart=apart,
                join=join,
            )
        window.run(KEEP_SPRAY, axis=axis, known=marks, weight=weight, kind=kind, open=fraction)
        extrapolate(window, marks, field, layers, join=join, apart=apart)
    if barriers is not None:
        barriers.constrain(window, velocity, known, kind, contact, RELEASED)
    faces, placement = FaceVelocity.of(velocity), cut.grid.placement
    walls = WallFields.of(cut, known)
    for axis, (marks, open_, result) in enumerate(zip(known, cut.open, scratch, strict=True)):
        window.run(
            CONSTRAIN,
            placement,
            faces,
            walls,
            axis=axis,
            known=marks,
            open=open_,
            result=result,
            kind=kind,
            contact=contact,
        )
    for axis, (marks, open_, result, field) in enumerate(
        zip(known, cut.open, scratch, velocity, strict=True)
    ):
        window.run(TAKE, placement, axis=axis, known=marks, open=open_, result=result, field=field)
