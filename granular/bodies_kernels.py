# mypy: ignore-errors
"""Kernels of rigid bodies in sand: what the stresses do to them, the velocity they get, and trial steps of the stresses around them."""

import functools
from types import SimpleNamespace

import warp as wp

from granular.stress_kernels import CELLS, WALLS, step_source
from granular.yield_set import HOLDS, NEARLY, SHEARS_HERE, STEP_OF_CELL

_F32, _F64, _U8 = (wp.array3d(dtype=t) for t in (wp.float32, wp.float64, wp.uint8))
_STRESS, _SPANS = wp.array4d(dtype=wp.float32), wp.array3d(dtype=wp.int32)
_INTS, _BYTES, _REALS = wp.array(dtype=wp.int32), wp.array(dtype=wp.uint8), wp.array(dtype=wp.float64)
_ROWS, _SINGLE = wp.array2d(dtype=wp.float64), wp.array(dtype=wp.float32)
options = {"enable_backward": False, "module": "granular.bodies"}


@wp.func
def stress_part(stress: _SINGLE, layer: int, cell: int, axis: int, dimension: int):
    """The normal stress of a cell along an axis, compression negative."""
    x = wp.float64(stress[cell])
    if dimension == 3:
        return wp.float64(stress[(1 + axis) * layer + cell]) - x
    n = wp.float64(stress[layer + cell])
    return wp.where(axis == 0, n, -n) - x


@wp.kernel(**options)
def forget_kernel(slot: _INTS, now: _SINGLE, before: _SINGLE, point: _SINGLE):
    """No stress at the slots."""
    n = slot[wp.tid()]
    now[n] = 0.0
    before[n] = 0.0
    point[n] = 0.0


@wp.kernel(**options)
def force_kernel(
    dimension: int, layer: int, freedoms: int, spans: wp.array2d(dtype=wp.int32), stress: _SINGLE,
    cell: _INTS, cell_row: wp.array3d(dtype=wp.float64), edge: _INTS, edge_shear: _BYTES, edge_row: _ROWS, strides: wp.vec3i,
    share_x: _SINGLE, share_y: _SINGLE, share_z: _SINGLE, out: _ROWS,
):  # fmt: skip
    """What a part of the cells and edges beside a body does to it: minus their rows times their stresses."""
    part = wp.tid()
    for q in range(freedoms):
        out[part, q] = wp.float64(0.0)
    for n in range(spans[part, 0], spans[part, 1]):
        for axis in range(dimension):
            normal = stress_part(stress, layer, cell[n], axis, dimension)
            for q in range(freedoms):
                out[part, q] = out[part, q] - cell_row[n, axis, q] * normal
    first = wp.where(dimension == 3, 4, 2)
    for n in range(spans[part, 2], spans[part, 3]):
        at = edge[n]
        d = int(edge_shear[n])
        alpha = wp.where(d == 2, strides[1], strides[0])
        beta = wp.where(d == 0, strides[1], strides[2])
        weight = float(0.0)
        if d == 0:
            weight = share_x[at]
        elif d == 1:
            weight = share_y[at]
        else:
            weight = share_z[at]
        if weight != 0.0:
            base = (first + 4 * d) * layer + at
            low = wp.float64(stress[base]) + wp.float64(stress[base + layer - alpha])
            high = wp.float64(stress[base + 2 * layer - beta]) + wp.float64(stress[base + 3 * layer - alpha - beta])
            shear = wp.float64(wp.abs(weight)) * (low + high)
            for q in range(freedoms):
                out[part, q] = out[part, q] - edge_row[n, q] * shear


@wp.kernel(**options)
def respond_kernel(
    implicit: int, freedoms: int, parts: wp.array2d(dtype=wp.int32), partial: _ROWS, start: _ROWS,
    response: wp.array3d(dtype=wp.float64), correction: wp.array3d(dtype=wp.float64), force: _ROWS, error: _ROWS, velocity: _ROWS,
):  # fmt: skip
    """The force on a body and the velocity that it leaves; implicit: a step towards the velocity whose stresses leave it."""
    body = wp.tid()
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


@wp.kernel(**options)
def layer_kernel(
    face: _INTS, axis: _BYTES, mass_x: _SINGLE, mass_y: _SINGLE, mass_z: _SINGLE, u_x: _SINGLE, u_y: _SINGLE, u_z: _SINGLE,
    weight_x: _SINGLE, weight_y: _SINGLE, weight_z: _SINGLE, out: wp.array(dtype=wp.vec2d),
):  # fmt: skip
    """Mass of the sand that moves with a body's face, half a cell, and the velocity that it had."""
    n = wp.tid()
    a = int(axis[n])
    at = face[n]
    mass = float(0.0)
    u = float(0.0)
    weight = float(0.0)
    if a == 0:
        mass = mass_x[at]
        u = u_x[at]
        weight = weight_x[at]
    elif a == 1:
        mass = mass_y[at]
        u = u_y[at]
        weight = weight_y[at]
    else:
        mass = mass_z[at]
        u = u_z[at]
        weight = weight_z[at]
    if weight > 0.0:
        out[n] = wp.vec2d(wp.float64(0.5) * wp.float64(mass), wp.float64(u))
    else:
        out[n] = wp.vec2d()


@wp.kernel(**options)
def stiffness_kernel(
    strides: wp.vec3i, dimension: int, cell: _INTS, flags: _BYTES, drive: _SINGLE, stiff: _SINGLE,
    mass_x: _SINGLE, mass_y: _SINGLE, mass_z: _SINGLE, inverse_x: _SINGLE, inverse_y: _SINGLE, inverse_z: _SINGLE, numbers: _SINGLE,
    out: wp.array(dtype=wp.vec2d),
):  # fmt: skip
    """Inverses of what the steps of pressure and friction in a cell are scaled by; 0 where it has none."""
    n = wp.tid()
    at = cell[n]
    found = wp.vec2d()
    if (int(flags[at]) & HOLDS) != 0:
        full = wp.clamp(1.0 - drive[at] * numbers[STEP_OF_CELL] / NEARLY, 0.0, 1.0)
        diagonal = float(0.0)
        for side in range(2):
            x = at + side * strides[0]
            y = at + side * strides[1]
            diagonal += (mass_x[x] + full * (1.0 - mass_x[x])) * inverse_x[x]
            diagonal += (mass_y[y] + full * (1.0 - mass_y[y])) * inverse_y[y]
            if dimension == 3:
                z = at + side * strides[2]
                diagonal += (mass_z[z] + full * (1.0 - mass_z[z])) * inverse_z[z]
        if diagonal > 0.0:
            found[0] = wp.float64(1.0) / wp.float64(diagonal)
    if (int(flags[at]) & SHEARS_HERE) != 0 and stiff[at] > 0.0:
        found[1] = wp.float64(1.0) / wp.float64(stiff[at])
    out[n] = found


@wp.kernel(**options)
def lightness_kernel(
    strides: wp.vec3i, edge: _INTS, edge_shear: _BYTES, share_x: _SINGLE, share_y: _SINGLE, share_z: _SINGLE,
    inverse_x: _SINGLE, inverse_y: _SINGLE, inverse_z: _SINGLE, out: _REALS,
):  # fmt: skip
    """1 / sum of the inverse masses around an edge; 0 where it has no shear."""
    n = wp.tid()
    at = edge[n]
    d = int(edge_shear[n])
    weight = float(0.0)
    around = float(0.0)
    if d == 0:
        weight = share_x[at]
        around = inverse_x[at] + inverse_x[at - strides[1]] + inverse_y[at] + inverse_y[at - strides[0]]
    elif d == 1:
        weight = share_y[at]
        around = inverse_x[at] + inverse_x[at - strides[2]] + inverse_z[at] + inverse_z[at - strides[0]]
    else:
        weight = share_z[at]
        around = inverse_y[at] + inverse_y[at - strides[2]] + inverse_z[at] + inverse_z[at - strides[1]]
    out[n] = wp.float64(0.0)
    if weight != 0.0 and around > 0.0:
        out[n] = wp.float64(1.0) / wp.float64(around)


@functools.cache
def body_kernels(dimension: int, real, box: bool, rate: bool = False) -> SimpleNamespace:
    """Return the kernels for 2 or 3 dimensions and velocities of `real`."""
    name = f"granular.bodies_{dimension}d_{real.__name__}{'_box' if box else ''}{'_rate' if rate else ''}"
    field, flat = wp.array3d(dtype=real), wp.array(dtype=real)

    @wp.kernel(enable_backward=False, module=name)
    def move(face: _INTS, axis: _BYTES, body: _INTS, row: _ROWS, velocity: _ROWS, u_x: flat, u_y: flat, u_z: flat):
        """Give the bodies' faces the velocity that they have."""
        n = wp.tid()
        b = body[n]
        u = wp.float64(0.0)
        for q in range(row.shape[1]):
            u += row[n, q] * velocity[b, q]
        a = int(axis[n])
        if a == 0:
            u_x[face[n]] = real(u)
        elif a == 1:
            u_y[face[n]] = real(u)
        else:
            u_z[face[n]] = real(u)

    @wp.kernel(enable_backward=False, module=name)
    def strain(edge: _INTS, shear: _BYTES, strides: wp.vec3i, u_x: flat, u_y: flat, u_z: flat, b_x: flat, b_y: flat, b_z: flat):
        """Twice the shear rate of the edges beside bodies, times dx."""
        n = wp.tid()
        i = edge[n]
        d = int(shear[n])
        if d == 0:
            b_x[i] = (u_x[i] - u_x[i - strides[1]]) + (u_y[i] - u_y[i - strides[0]])
        elif d == 1:
            b_y[i] = (u_x[i] - u_x[i - strides[2]]) + (u_z[i] - u_z[i - strides[0]])
        else:
            b_z[i] = (u_y[i] - u_y[i - strides[2]]) + (u_z[i] - u_z[i - strides[1]])

    @wp.func_native(step_source(CELLS, dimension, real, box=box, rate=rate, trial=True))
    def trial_row(
        spans_: _SPANS, flags_: _U8, now_: _STRESS, before_: _STRESS, point_: _STRESS, drive_: _F32, stiff_: _F32,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field, mass_x: _F32, mass_y: _F32, mass_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: field, u_y: field, u_z: field,
        momentum: _REALS, numbers: _SINGLE, partials: _REALS, chunks: int, chunk: int, k: int, j: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def trial(
        cell: _INTS, spans: _SPANS, flags: _U8, now: _STRESS, before: _STRESS, point: _STRESS, drive: _F32, stiff: _F32,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field, mass_x: _F32, mass_y: _F32, mass_z: _F32,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, u_x: field, u_y: field, u_z: field,
        momentum: _REALS, numbers: _SINGLE, partials: _REALS,
    ):  # fmt: skip
        """A trial step of listed cells."""
        at = cell[wp.tid()]
        i = at % flags.shape[2]
        j = (at / flags.shape[2]) % flags.shape[1]
        k = at / (flags.shape[2] * flags.shape[1])
        trial_row(
            spans, flags, now, before, point, drive, stiff, share_x, share_y, share_z, b_x, b_y, b_z, mass_x, mass_y, mass_z,
            inverse_x, inverse_y, inverse_z, u_x, u_y, u_z, momentum, numbers, partials, 1, 0, k, j, i, i + 1,
        )  # fmt: skip

    @wp.func_native(step_source(WALLS, dimension, real, box=box, rate=rate, trial=True))
    def trial_entries(
        cells: _INTS, sides: _BYTES, walls: _INTS, friction: _SINGLE, active: _INTS, fraction_: _F32,
        now_: _STRESS, before_: _STRESS, point_: _STRESS,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, momentum: _REALS, numbers: _SINGLE,
        partials: _REALS, chunk: int, first: int, last: int,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def trial_wall(
        cells: _INTS, sides: _BYTES, walls: _INTS, friction: _SINGLE, active: _INTS, fraction: _F32,
        now: _STRESS, before: _STRESS, point: _STRESS,
        share_x: _F32, share_y: _F32, share_z: _F32, b_x: field, b_y: field, b_z: field,
        inverse_x: _F32, inverse_y: _F32, inverse_z: _F32, momentum: _REALS, numbers: _SINGLE, partials: _REALS,
    ):  # fmt: skip
        """A trial step of listed wall faces."""
        entry = wp.tid()
        trial_entries(
            cells, sides, walls, friction, active, fraction, now, before, point, share_x, share_y, share_z, b_x, b_y, b_z,
            inverse_x, inverse_y, inverse_z, momentum, numbers, partials, 0, entry, entry + 1,
        )  # fmt: skip

    return SimpleNamespace(move=move, strain=strain, trial=trial, trial_wall=trial_wall)


__all__ = ["body_kernels", "force_kernel", "forget_kernel", "layer_kernel", "lightness_kernel", "respond_kernel", "stiffness_kernel"]
