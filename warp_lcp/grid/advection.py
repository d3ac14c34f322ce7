"""Advection of particles and fields by the velocity of the grid.

Third-order Runge-Kutta with the weights 2/9, 3/9, 4/9 at 0, 1/2, 3/4 of the step [Ralston 1962].
Three ways:

Particles among whole cells (`advect`) never enter a SOLID cell. Every stage walks from cell to
cell: a particle that meets a closed face stops before it and slides along it. A distance would not
work here: pushing particles out along it strands them in SOLID cells. The number of cells to the
nearest solid shows which particles cannot be stopped; only the others walk.

Particles among walls that are given by their distance (`advect_with_distance`) move freely if their
distance to walls exceeds their path. The others move in strides that the distance allows, but of
half a cell at least, so that a particle at rest on a wall can move. A particle that ends a stride
too near a wall or inside it is put back along the normal; on a plane this removes just the normal
part of the path. The rest of the path loses its part into the wall, and between two walls all but
the part along their edge. A stride that would end on another side of a wall is halved, so that
particles do not tunnel through plates of more than a cell at any speed. The distance is
interpolated between nodes, which defines where solids are, and combined with that to the domain's
walls.

Fields (`carry_field`): f(x, t + dt) = f(y, t), where y is found by such a step back along the
velocity, so that fields and particles follow the same path. A velocity is interpolated by cubics
through four nodes along each axis (Catmull and Rom's), limited to the range of the 2^dimension
nodes around y: a wave of 16 cells that moves by 0.4 cells a step has 87 % of its height after 80
steps, with linear interpolation 23 %. A distance is interpolated linearly, which is exact for the
distance to a plane.
"""

import functools
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.grid.particle_loops import MARGIN, launch
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.recorded_arguments import Scalar, scaled
from warp_lcp.operators.grid_poisson import SOLID

# Cells. A particle that moves further in a step walks from cell to cell, which is always right.
MAX_CLEARANCE = 6
CENTERS = 3  # the `axis` of a field at cell centers

# Distance from walls [cells] at which particles are put. Float32 positions in 10^3 cells round by
# less than its excess over MARGIN.
AIM = 1.1 * MARGIN
SLACK = 0.25  # largest excess of the interpolated distance over the free distance [cells]
# Stride [cells] of a particle near a wall before it evaluates the distance again; shorter where the
# stride would end on another side of the wall.
STRIDE = 0.5
SHORTEST = 0.02  # shortest stride [cells], where a wall is thinner than that
STRIDES = 64  # most strides of a move: 32 cells along a wall
# Cosine between the normals of two walls. Walls whose normals are further apart stop a particle
# between them; along nearer ones it slides.
CORNER = 0.5
BEND = 0.9  # cosine between normals above which two walls count as one
LEG = 0.25  # step [cells] of the search for a way out along one direction
# Cells by which a step may put a particle back: more than its stride and the diagonal of the walls'
# rounding.
REACH = 1.0
PUSH = 3.0  # cells by which a wall may push a particle in a step

_WALLS = {
    "MARGIN": MARGIN,
    "AIM": AIM,
    "SLACK": SLACK,
    "STRIDE": STRIDE,
    "SHORTEST": SHORTEST,
    "LEG": LEG,
    "REACH": REACH,
} | {"STRIDES": STRIDES, "CORNER": CORNER, "BEND": BEND, "CENTERS": CENTERS}
KERNELS = KernelFile(Path(__file__).parent / "headers/advection.h", _WALLS)
PUSH_OUT = KernelFile(
    Path(__file__).parent / "headers/walls.h",
    {"MARGIN": MARGIN, "LEG": LEG, "AIM": AIM, "PUSH": PUSH},
)["warp_lcp.grid.push_out.push_out"]


@functools.cache
def advect_pass(endless: int) -> StencilKernel:
    """Return the kernel of `advect` for a set of periodic axes (bit n: axis n)."""
    module = "warp_lcp.grid.advection" + f"_{endless}" * (endless > 0)
    return KERNELS.kernel(
        "warp_lcp.grid.advection.advect", module=module, constants={"ENDLESS": endless}
    )


@functools.cache
def distance_pass(endless: int) -> StencilKernel:
    """Return the kernel of `advect_with_distance` for a set of periodic axes."""
    module = "warp_lcp.grid.distance_advection" + f"_{endless}" * (endless > 0)
    name = "warp_lcp.grid.distance_advection.advect_with_distance"
    return KERNELS.kernel(name, module=module, constants={"ENDLESS": endless})


@functools.cache
def carry_pass(axis: int) -> StencilKernel:
    """Return the kernel of `carry_field` for the faces of an axis or `CENTERS`."""
    module = f"warp_lcp.grid.semi_lagrangian_{axis}"
    return KERNELS.kernel(
        "warp_lcp.grid.semi_lagrangian.carry", module=module, constants={"AXIS": axis}
    )


@forward_kernel(module="warp_lcp.grid.clearance")
@typing.no_type_check
def clearance_kernel(
    cells: wp.array3d(dtype=wp.int8), planes: int, distance: int, room: wp.array3d(dtype=wp.int8)
):
    """Mark cells at one distance from the nearest SOLID cell per launch.

    The launch with `distance` = 0 marks SOLID cells 0 and others MAX_CLEARANCE. The launch with
    distance d marks the cells around those of d - 1 with d.

    In place without a race: a cell that another thread marks in this launch was more than d - 1 and
    becomes d, no source either way.
    """
    k, j, i = wp.tid()
    if distance == 0:
        room[k, j, i] = wp.where(
            cells[k, j, i] == wp.int8(SOLID), wp.int8(0), wp.int8(MAX_CLEARANCE)
        )
    elif int(room[k, j, i]) > distance:
        near = int(0)
        for c in range(wp.max(k - planes + 1, 0), wp.min(k + planes, room.shape[0])):
            for b in range(wp.max(j - 1, 0), wp.min(j + 2, room.shape[1])):
                for a in range(wp.max(i - 1, 0), wp.min(i + 2, room.shape[2])):
                    if int(room[c, b, a]) == distance - 1:
                        near = 1
        if near > 0:
            room[k, j, i] = wp.int8(distance)


@dataclass(frozen=True, slots=True)
class FaceVelocity:
    """Velocity on the lower faces of cells, float32 or float64, as kernels take it.

    Attributes:
        u: component along x [m/s].
        v: component along y [m/s].
        w: component along z [m/s]; None in 2-D.
    """

    u: wp.array
    v: wp.array
    w: wp.array | None

    @classmethod
    def of(cls, components: Sequence[wp.array]) -> "FaceVelocity":
        """Return the velocity of two or three components."""
        u, v, w = three_components(components)
        return cls(u, v, w)


def clearance(grid: StaggeredGrid, cells: wp.array) -> wp.array:
    """Return the distance to the nearest SOLID cell in cells, diagonals counting 1.

    0 in SOLID cells, at most MAX_CLEARANCE.

    Args:
        grid: the grid.
        cells: int8 of AIR, FLUID, SOLID, in the stored shape; the ring is SOLID, or AIR where
            particles may leave the domain.

    Returns:
        int8, in the stored shape.
    """
    room = grid.field(wp.int8)
    for distance in range(MAX_CLEARANCE):
        wp.launch(
            clearance_kernel, grid.shape, [cells, grid.planes, distance, room], device=grid.device
        )
    return room


def advect(
    grid: StaggeredGrid,
    fields: list[wp.array],
    room: wp.array,
    dt: float | Scalar,
    position: wp.array,
    stopped: wp.array,
    endless: int = 0,
) -> None:
    """Advect particles for a time step among whole-cell solids.

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        room: result of `clearance`. Every particle lies in a cell that is not SOLID.
        dt: time step [s].
        position: [m], shape (n,) (updated).
        stopped: int32, shape (1,): raised by the number of particles that a closed face stopped.
        endless: bit n is set if axis n is periodic: velocities beyond its sides are those at the
            opposite side, as are the ring's. Particles may end up beyond a side.
    """
    launch(
        advect_pass(endless),
        len(position),
        grid,
        FaceVelocity.of(fields),
        position=position,
        room=room,
        stopped=stopped,
        h=scaled(dt, 1.0 / grid.spacing),
    )


def advect_with_distance(
    grid: StaggeredGrid,
    fields: list[wp.array],
    distance: wp.array,
    dt: float | Scalar,
    position: wp.array,
    stopped: wp.array,
    *,
    open_sides: int = 0,
    endless: int = 0,
) -> None:
    """Advect particles for a time step among walls given by their distance.

    No particle ends within MARGIN cells of a wall unless it started there.

    Where no place outside of a wall is found within a cell, a particle stays where its last open
    stride ended. A move goes at most 1024 cells, and 32 along walls.

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        distance: to solids at the low corners of the cells, float32 in cells, > 0 in the open; in
            the stored shape. In 2-D the plane k = 1 is used. The domain's walls need not be in it.
        dt: time step [s].
        position: [m], shape (n,) (updated).
        stopped: int32, shape (1,): raised by the number of particles that met a wall.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: particles cross them and end on
            them or beyond.
        endless: bit n is set if axis n is periodic, see `advect`; its sides count as open.
    """
    launch(
        distance_pass(endless),
        len(position),
        grid,
        FaceVelocity.of(fields),
        position=position,
        distance=distance,
        stopped=stopped,
        h=scaled(dt, 1.0 / grid.spacing),
        open_sides=open_sides,
    )


def push_out(
    grid: StaggeredGrid,
    distance: wp.array,
    position: wp.array,
    moved: wp.array,
    left: wp.array,
    *,
    open_sides: int = 0,
) -> None:
    """Push particles out of walls along the gradient of the distance.

    Of walls that have moved over them or come too close.

    Args:
        grid: the grid.
        distance: to solids in cells, as for `advect_with_distance`.
        position: [m], shape (n,) (updated): moved by at most PUSH cells.
        moved: int32, shape (1,): raised by the number of particles that were put outside.
        left: int32, shape (1,): raised by the number of those for which no way out was found; they
            stay where they were.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: particles beyond stay there.
    """
    launch(
        PUSH_OUT,
        len(position),
        grid,
        position=position,
        distance=distance,
        open_sides=open_sides,
        moved=moved,
        left=left,
    )


def carry_field(
    grid: StaggeredGrid,
    window: Window,
    velocity: list[wp.array],
    way: float | Scalar,
    field: wp.array,
    out: wp.array,
    *,
    axis: int,
    level: wp.array,
    least: float,
    before: tuple[int, int, int] = (0, 0, 0),
) -> None:
    """Advect a field for a time step (semi-Lagrangian).

    Args:
        grid: the grid.
        window: cells to consider, in the domain and the ring's upper layer.
        velocity: velocity of each component on the faces [m/s].
        way: dt / dx [s/m].
        field: float32, of faces or cells; not `out`.
        out: float32 (written). Where the level is no more than `least`: the velocity as it was, 0
            at cell centers.
        axis: whose faces the field lies on, or `CENTERS`.
        level: float32 of cells; a face has the mean of its two.
        least: see `out`.
        before: cells (x, y, z) of a larger grid before this one, whose places are rounded as there.
    """
    if min(window.low) < 1:
        window = Window.of([max(start, 1) for start in window.low], window.high, window.device)
    before_x, before_y, before_z = before
    window.run(
        carry_pass(axis),
        FaceVelocity.of(velocity),
        planes=grid.planes,
        h=way,
        least=least,
        level=level,
        field=field,
        out=out,
        before_x=before_x,
        before_y=before_y,
        before_z=before_z,
    )
