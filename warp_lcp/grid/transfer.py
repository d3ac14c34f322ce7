"""Velocity from particles to faces and back: PIC, FLIP and APIC with tent weights.

APIC [Jiang et al. 2015] carries the gradient of each component. With multilinear weights on faces its momentum a node is
m_i v_i = sum_p w_ip m_p (v_p + c_p . (x_i - x_p)) and the gradient on the way back is that of the interpolated field, c_p = sum_i
grad w_ip v_i, so that linear and angular momentum survive the round trip.
"""

import functools
import typing
from types import SimpleNamespace

import warp as wp

from warp_lcp.grid.staggered import CellRange, StaggeredGrid, Window

TINY_WEIGHT = 1e-9  # below it a face counts as untouched
# A particle that lies exactly on the boundary between cells would leave one face of its own cell without weight, hence without gravity.
EDGE = {wp.float32: 1e-5, wp.float64: 1e-12}
VECTORS = {wp.float32: wp.vec3, wp.float64: wp.vec3d}


@functools.cache
def kernels(real: typing.Any) -> SimpleNamespace:
    """Return the kernels for fields and particles of float32 or float64."""
    vec3 = VECTORS[real]
    edge = EDGE[real]
    name = f"warp_lcp.grid.transfer_{real.__name__}"

    @wp.func
    @typing.no_type_check
    def node_coordinates(x: vec3, inverse_dx: real, axis: int, planes: int):
        """Coordinates among the nodes of a component: node (k, j, i) of component x lies at grid coordinates (i, j + 1/2, k + 1/2)."""
        # first the grid coordinate, rounded as where particles are sorted: both must agree on the cell
        y = x * inverse_dx + vec3(real(1.0), real(1.0), real(1.0))
        y = y - vec3(real(0.5), real(0.5), real(0.5))
        y[axis] = y[axis] + real(0.5)
        if planes == 1:
            y[2] = real(1.0)  # 2-D: the plane in use, no interpolation along z
        return y

    @wp.func
    @typing.no_type_check
    def fractions(y: vec3, axis: int):
        f = vec3(y[0] - wp.floor(y[0]), y[1] - wp.floor(y[1]), y[2] - wp.floor(y[2]))
        f[axis] = wp.clamp(f[axis], real(edge), real(1.0) - real(edge))
        return f

    @wp.func
    @typing.no_type_check
    def add_plane(
        momentum: wp.array3d(dtype=real),
        weight: wp.array3d(dtype=real),
        k: int,
        j: int,
        i: int,
        f: vec3,
        share: real,
        v: real,
        c: vec3,
    ):
        """Give the four nodes of a plane their shares; v is what node (k, j, i) sees. Unrolled: a loop costs twice the time."""
        ax = (real(1.0) - f[0]) * share
        bx = f[0] * share
        ay = real(1.0) - f[1]
        by = f[1]
        wp.atomic_add(momentum, k, j, i, ax * ay * v)
        wp.atomic_add(weight, k, j, i, ax * ay)
        wp.atomic_add(momentum, k, j, i + 1, bx * ay * (v + c[0]))
        wp.atomic_add(weight, k, j, i + 1, bx * ay)
        wp.atomic_add(momentum, k, j + 1, i, ax * by * (v + c[1]))
        wp.atomic_add(weight, k, j + 1, i, ax * by)
        wp.atomic_add(momentum, k, j + 1, i + 1, bx * by * (v + c[0] + c[1]))
        wp.atomic_add(weight, k, j + 1, i + 1, bx * by)

    @wp.kernel(enable_backward=False, module=name)
    @typing.no_type_check
    def scatter(
        axis: int,
        planes: int,
        dx: real,
        inverse_dx: real,
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
        momentum: wp.array3d(dtype=real),
        weight: wp.array3d(dtype=real),
    ):
        p = wp.tid()
        y = node_coordinates(position[p], inverse_dx, axis, planes)
        f = fractions(y, axis)
        i = int(y[0])
        j = int(y[1])
        k = int(y[2])
        v = velocity[p][axis]
        c = vec3()
        if gradient:
            c = gradient[p] * dx
        if planes == 1:
            v = v - c[0] * f[0] - c[1] * f[1]
            add_plane(momentum, weight, k, j, i, f, real(1.0), v, c)
        else:
            v = v - wp.dot(c, f)
            add_plane(momentum, weight, k, j, i, f, real(1.0) - f[2], v, c)
            add_plane(momentum, weight, k + 1, j, i, f, f[2], v + c[2], c)

    @wp.func
    @typing.no_type_check
    def plane_value(field: wp.array3d(dtype=real), k: int, j: int, i: int, f: vec3):
        """Return the value in a plane of nodes and its derivatives along x and y, per cell."""
        a = field[k, j, i]
        b = field[k, j, i + 1]
        c = field[k, j + 1, i]
        d = field[k, j + 1, i + 1]
        low = a + f[0] * (b - a)
        high = c + f[0] * (d - c)
        return vec3(low + f[1] * (high - low), (b - a) + f[1] * ((d - c) - (b - a)), high - low)

    @wp.func
    @typing.no_type_check
    def value(field: wp.array3d(dtype=real), k: int, j: int, i: int, f: vec3, planes: int):
        """Return the interpolated value."""
        low = plane_value(field, k, j, i, f)
        if planes == 1:
            return low[0]
        high = plane_value(field, k + 1, j, i, f)
        return low[0] + f[2] * (high[0] - low[0])

    @wp.kernel(enable_backward=False, module=name)
    @typing.no_type_check
    def gather(
        axis: int,
        planes: int,
        inverse_dx: real,
        flip: real,
        position: wp.array(dtype=vec3),
        field: wp.array3d(dtype=real),
        saved: wp.array3d(dtype=real),
        velocity: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
    ):
        p = wp.tid()
        y = node_coordinates(position[p], inverse_dx, axis, planes)
        f = fractions(y, axis)
        i = int(y[0])
        j = int(y[1])
        k = int(y[2])
        low = plane_value(field, k, j, i, f)
        new = low[0]
        g = vec3(low[1], low[2], real(0.0))
        if planes == 2:
            high = plane_value(field, k + 1, j, i, f)
            new = low[0] + f[2] * (high[0] - low[0])
            g = vec3(low[1] + f[2] * (high[1] - low[1]), low[2] + f[2] * (high[2] - low[2]), high[0] - low[0])
        v = velocity[p]
        if saved:
            new += flip * (v[axis] - value(saved, k, j, i, f, planes))
        v[axis] = new
        velocity[p] = v
        if gradient:
            gradient[p] = g * inverse_dx

    @wp.kernel(enable_backward=False, module=name)
    @typing.no_type_check
    def normalize(cells: CellRange, weight: wp.array3d(dtype=real), field: wp.array3d(dtype=real)):
        plane, row, chunk = wp.tid()
        k = cells.k + plane
        j = cells.j + row
        first = cells.i + chunk * cells.grain
        for i in range(first, wp.min(first + cells.grain, cells.end)):
            w = weight[k, j, i]
            if w > real(TINY_WEIGHT):
                field[k, j, i] = field[k, j, i] / w
            else:
                field[k, j, i] = real(0.0)

    return SimpleNamespace(scatter=scatter, gather=gather, normalize=normalize)


def particles_to_faces(
    grid: StaggeredGrid,
    position: wp.array,
    velocity: wp.array,
    affine: list[wp.array],
    fields: list[wp.array],
    weights: list[wp.array],
    *,
    window: Window | None = None,
) -> None:
    """Average the particles' velocities on the faces, all particles alike.

    Args:
        grid: the grid; every particle lies in its domain.
        position: [m], shape (n,), vectors.
        velocity: [m/s], shape (n,), vectors.
        affine: gradient of each component [1/s], shape (n,) each (APIC), or empty (PIC and FLIP).
        fields: velocity of each component [m/s] (written), 0 on faces without weight.
        weights: sum of the tent weights of each component (written), in particles.
        window: faces that particles can reach; all of them if None.
    """
    real = fields[0].dtype
    kernel = kernels(real)
    window = window or grid.everywhere
    for axis, (field, weight) in enumerate(zip(fields, weights, strict=True)):
        field.zero_()
        weight.zero_()
        gradient = affine[axis] if affine else None
        inputs = [axis, grid.planes, grid.spacing, 1.0 / grid.spacing, position, velocity, gradient, field, weight]
        wp.launch(kernel.scatter, len(position), inputs, device=grid.device)
        window.launch(kernel.normalize, [weight, field])


def faces_to_particles(
    grid: StaggeredGrid,
    fields: list[wp.array],
    position: wp.array,
    velocity: wp.array,
    affine: list[wp.array],
    *,
    saved: list[wp.array] | None = None,
    flip: float = 0.0,
) -> None:
    """Interpolate the faces' velocities at the particles.

    Args:
        grid: the grid; every particle lies in its domain.
        fields: velocity of each component on the faces [m/s].
        position: [m], shape (n,), vectors.
        velocity: [m/s], shape (n,), vectors (written): v = interpolated + flip (v_before - interpolated `saved`).
        affine: gradient of each component [1/s] (written, APIC), or empty.
        saved: the faces' velocities as they came from the particles [m/s], for FLIP.
        flip: share of FLIP, 0 (PIC) to 1; needs `saved`.
    """
    kernel = kernels(fields[0].dtype)
    for axis, field in enumerate(fields):
        gradient = affine[axis] if affine else None
        old = saved[axis] if saved and flip > 0.0 else None
        inputs = [axis, grid.planes, 1.0 / grid.spacing, flip, position, field, old, velocity, gradient]
        wp.launch(kernel.gather, len(position), inputs, device=grid.device)
