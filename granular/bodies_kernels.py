# mypy: ignore-errors
"""Kernels of rigid bodies in sand: forces, velocities and trial steps."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_lcp.granular.stress_kernels import KERNELS
from warp_lcp.granular.stress_layout import HOLDS, NEARLY, SHEARS_HERE
from warp_lcp.kernels import StencilKernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.layout import make_struct, put

if TYPE_CHECKING:
    from warp._src.codegen import Struct, StructInstance

_INTS, _BYTES, _REALS = (
    wp.array(dtype=wp.int32),
    wp.array(dtype=wp.uint8),
    wp.array(dtype=wp.float64),
)
_ROW, _SINGLE, _PAIRS = (
    wp.array2d(dtype=wp.float64),
    wp.array(dtype=wp.float32),
    wp.array(dtype=wp.vec2d),
)
_MATS, _SPANS = wp.array3d(dtype=wp.float64), wp.array2d(dtype=wp.int32)
options = {"module": "granular.bodies"}


@functools.cache
def vector_struct(real: type) -> "Struct":
    """Return the struct of a vector field's components as flat arrays."""
    return make_struct(f"Vector_{real.__name__}", dict.fromkeys("xyz", wp.array(dtype=real)))


def flat_vector(fields: Sequence[wp.array]) -> "StructInstance":
    """Return the components of a vector field as flat arrays; missing ones are null."""
    return put(
        vector_struct(fields[0].dtype)(),
        dict(zip("xyz", [field.flatten() for field in fields], strict=False)),
    )


Vector = vector_struct(wp.float32)


@wp.struct
class FieldShape:
    """Shape of the grid's fields."""

    dimension: int
    layer: int  # elements per layer of a field
    strides: wp.vec3i  # offset in elements to the next cell along x, y, z


@wp.struct
class IncidenceFields:
    """Faces, cells or edges beside bodies, see `body_faces.Incidence`."""

    at: _INTS
    axis: _BYTES
    body: _INTS
    row: _MATS
    copies: _BYTES  # bit mask of an edge's copies that act on the body on this rank


@wp.func
def entry(v: Any, axis: int, n: int):
    """Return element n of the component along an axis."""
    if axis == 0:
        return v.x[n]
    if axis == 1:
        return v.y[n]
    return v.z[n]


@wp.func
def set_entry(v: Any, axis: int, n: int, value: Any):
    """Set element n of the component along an axis."""
    if axis == 0:
        v.x[n] = value
    elif axis == 1:
        v.y[n] = value
    else:
        v.z[n] = value


@wp.func
def axes_of(shear: int):
    """Return the two axes of a shear."""
    return wp.where(shear == 2, 1, 0), wp.where(shear == 0, 1, 2)


@wp.func
def stress_part(stress: _SINGLE, layer: int, cell: int, axis: int, dimension: int):
    """Return the normal stress of a cell along an axis, compression negative."""
    x = wp.float64(stress[cell])
    if dimension == 3:
        return wp.float64(stress[(1 + axis) * layer + cell]) - x
    n = wp.float64(stress[layer + cell])
    return wp.where(axis == 0, n, -n) - x


@wp.func
def copy_of(stress: _SINGLE, n: int, copies: int, q: int):
    """Return the stress of an edge's copy, 0 if it acts on the body on another rank."""
    return wp.where((copies >> q) & 1 == 1, wp.float64(stress[n]), wp.float64(0.0))


@forward_kernel(**options)
def forget_kernel(slot: _INTS, now: _SINGLE, before: _SINGLE, point: _SINGLE):
    """Set the stresses at the given slots to 0."""
    n = slot[wp.tid()]
    now[n] = 0.0
    before[n] = 0.0
    point[n] = 0.0


@forward_kernel(**options)
def force_kernel(
    grid: FieldShape,
    spans: _SPANS,
    stress: _SINGLE,
    cells: IncidenceFields,
    edges: IncidenceFields,
    share: Vector,
    out: _ROW,
):
    """Compute the force of some cells and edges on a body.

    F = - sum of rows times stresses, see `granular.body_faces`. Each thread sums a run of cells and
    edges in order, so that the result does not depend on the number of threads.
    """
    part = wp.tid()
    freedoms = out.shape[1]
    for q in range(freedoms):
        out[part, q] = wp.float64(0.0)
    for n in range(spans[part, 0], spans[part, 1]):
        for axis in range(grid.dimension):
            normal = stress_part(stress, grid.layer, cells.at[n], axis, grid.dimension)
            for q in range(freedoms):
                out[part, q] = out[part, q] - cells.row[n, axis, q] * normal
    first = wp.where(grid.dimension == 3, 4, 2)
    for n in range(spans[part, 2], spans[part, 3]):
        at = edges.at[n]
        d = int(edges.axis[n])
        a, b = axes_of(d)
        alpha, beta = grid.strides[a], grid.strides[b]
        weight = entry(share, d, at)
        if weight != 0.0:
            base = (first + 4 * d) * grid.layer + at
            c = int(edges.copies[n])
            low = copy_of(stress, base, c, 0) + copy_of(stress, base + grid.layer - alpha, c, 1)
            high = copy_of(stress, base + 2 * grid.layer - beta, c, 2) + copy_of(
                stress, base + 3 * grid.layer - alpha - beta, c, 3
            )
            shear = wp.float64(wp.abs(weight)) * (low + high)
            for q in range(freedoms):
                out[part, q] = out[part, q] - edges.row[n, 0, q] * shear


@forward_kernel(**options)
def add_runs_kernel(parts: _SPANS, partial: _ROW, met: _INTS, total: _ROW):
    """Sum the runs of each body on this rank, with a thread per entry.

    0 if no force is computed.
    """
    body, q = wp.tid()
    value = wp.float64(0.0)
    if met[0] != 0:
        for part in range(parts[body, 0], parts[body, 1]):
            value += partial[part, q]
    total[body, q] = value


@forward_kernel(**options)
def respond_kernel(
    implicit: int,
    parts: _SPANS,
    partial: _ROW,
    start: _ROW,
    response: _MATS,
    correction: _MATS,
    force: _ROW,
    error: _ROW,
    velocity: _ROW,
):
    """Compute the force on a body, and the velocity that results from it.

    If `implicit` is set, the velocity is moved by one Newton-like step, V - (1 + W G)^-1 (V - V* -
    W F), toward the velocity whose stresses result in itself.
    """
    body = wp.tid()
    freedoms = velocity.shape[1]
    for q in range(freedoms):
        total = wp.float64(0.0)
        for part in range(parts[body, 0], parts[body, 1]):
            total += partial[part, q]
        force[body, q] = total
    for q in range(freedoms):
        left = start[body, q]
        for r in range(freedoms):
            left += response[body, q, r] * force[body, r]
        error[body, q] = left - velocity[body, q]
    for q in range(freedoms):
        change = error[body, q]
        if implicit != 0:
            change = wp.float64(0.0)
            for r in range(freedoms):
                change += correction[body, q, r] * error[body, r]
        velocity[body, q] = velocity[body, q] + change


@forward_kernel(**options)
def layer_kernel(
    faces: IncidenceFields,
    mass: Vector,
    u: Vector,
    weight: Vector,
    cells: _INTS,
    flags: _BYTES,
    out: _PAIRS,
    held: _REALS,
):
    """Compute mass and velocity of the sand that moves with a body's face.

    It is half of the cell in front of the face. Threads beyond the faces copy the flags of cells,
    so that the host reads them together with the rest.
    """
    n = wp.tid()
    count = faces.at.shape[0]
    if n >= count:
        held[n - count] = wp.float64(flags[cells[n - count]])
        return
    a = int(faces.axis[n])
    at = faces.at[n]
    out[n] = wp.vec2d()
    if entry(weight, a, at) > 0.0:
        out[n] = wp.vec2d(
            wp.float64(0.5) * wp.float64(entry(mass, a, at)), wp.float64(entry(u, a, at))
        )


# The scales are 1 / diagonal of the gradient. Pressure: sum over the faces of m' / m, with m' = m
# in loose cells, 1 in full ones, and linear between:
# full = clip(1 - drive (dt / dx) / NEARLY, 0, 1), where drive dt / dx is the free fraction of the
# cell. Friction: `stiff` of `packing_kernels.stiffness_kernel`. Masses are relative to a full face,
# so that both are without unit.
@forward_kernel(**options)
def stiffness_kernel(
    grid: FieldShape,
    cells: IncidenceFields,
    flags: _BYTES,
    drive: _SINGLE,
    stiff: _SINGLE,
    mass: Vector,
    inverse: Vector,
    step: float,
    out: _PAIRS,
):
    """Compute the inverse step scales of pressure and friction in a cell.

    0 where a cell has none. `step` is dt / dx [s/m].
    """
    n = wp.tid()
    at = cells.at[n]
    steps = wp.vec2d()
    if (int(flags[at]) & HOLDS) != 0:
        full = wp.clamp(1.0 - drive[at] * step / NEARLY, 0.0, 1.0)
        diagonal = float(0.0)
        for side in range(2):
            for axis in range(grid.dimension):
                o = at + side * grid.strides[axis]
                m = entry(mass, axis, o)
                diagonal += (m + full * (1.0 - m)) * entry(inverse, axis, o)
        if diagonal > 0.0:
            steps[0] = wp.float64(1.0) / wp.float64(diagonal)
    if (int(flags[at]) & SHEARS_HERE) != 0 and stiff[at] > 0.0:
        steps[1] = wp.float64(1.0) / wp.float64(stiff[at])
    out[n] = steps


@forward_kernel(**options)
def lightness_kernel(
    grid: FieldShape, edges: IncidenceFields, share: Vector, inverse: Vector, out: _REALS
):
    """Compute 1 / sum of the inverse masses around an edge.

    0 where it has no shear.
    """
    n = wp.tid()
    at = edges.at[n]
    d = int(edges.axis[n])
    a, b = axes_of(d)
    around = (
        entry(inverse, a, at)
        + entry(inverse, a, at - grid.strides[b])
        + entry(inverse, b, at)
        + entry(inverse, b, at - grid.strides[a])
    )
    out[n] = wp.float64(0.0)
    if entry(share, d, at) != 0.0 and around > 0.0:
        out[n] = wp.float64(1.0) / wp.float64(around)


@dataclass(frozen=True)
class SandBodyKernels:
    """Kernels of rigid bodies in the stress solve.

    Attributes:
        move: velocity of the bodies' faces.
        strain: shear rates of the edges beside bodies.
        trial: projected step of the cells beside bodies.
        trial_wall: that of the walls beside them.
    """

    move: wp.Kernel
    strain: wp.Kernel
    trial: StencilKernel
    trial_wall: StencilKernel


@functools.cache
def body_kernels(dimension: int, real: type, box: bool, rate: bool = False) -> SandBodyKernels:
    """Return the kernels for 2 or 3 dimensions, with velocities of type `real`."""
    name = f"bodies_{dimension}d_{real.__name__}{'_box' * box}{'_rate' * rate}"
    module, Velocity = f"granular.{name}", vector_struct(real)

    @forward_kernel(module=module)
    def move(faces: IncidenceFields, velocity: _ROW, moved: Velocity):
        """Set the velocity of the bodies' faces."""
        n = wp.tid()
        b = faces.body[n]
        u = wp.float64(0.0)
        for q in range(velocity.shape[1]):
            u += faces.row[n, 0, q] * velocity[b, q]
        set_entry(moved, int(faces.axis[n]), faces.at[n], real(u))

    @forward_kernel(module=module)
    def strain(grid: FieldShape, edges: IncidenceFields, u: Velocity, rates: Velocity):
        """Compute twice the shear rate of the edges beside bodies, times dx."""
        n = wp.tid()
        i = edges.at[n]
        d = int(edges.axis[n])
        a, b = axes_of(d)
        along, across = (
            entry(u, a, i) - entry(u, a, i - grid.strides[b]),
            entry(u, b, i) - entry(u, b, i - grid.strides[a]),
        )
        set_entry(rates, d, i, along + across)

    words = {"DIM": dimension, "BOX": box, "RATE": rate, "RESIDUAL": 0, "TRIAL": 1}
    made = functools.partial(
        KERNELS.kernel, module=f"granular.{name}", compute=real, constants=words
    )
    trial, trial_wall = made("granular.bodies.step"), made("granular.bodies.wall_step")
    return SandBodyKernels(move=move, strain=strain, trial=trial, trial_wall=trial_wall)
