"""Particles to grid (P2G), grid to particles (G2P): PIC, FLIP, APIC, tent weights.

APIC [Jiang et al. 2015] carries the gradient of each component. With multilinear weights on faces
its momentum a node is m_i v_i = sum_p w_ip m_p (v_p + c_p . (x_i - x_p)) and the gradient on the
way back is that of the interpolated field, c_p = sum_i grad w_ip v_i, so that linear and angular
momentum survive the round trip.

The sum over particles has two forms. Particles *scatter* to the faces around them: the faster form
on a CPU, where each task adds to planes of its own, always in the same order. Or each face
*gathers* from the particles of the cells around it, which takes sorted particles and the first
particle of each cell: no two threads write one face, so that a GPU too gives the same bits on every
run.

Node (k, j, i) of component `axis` lies at the grid coordinates (i, j + 1/2, k + 1/2) with the axis'
own 1/2 left out, plus the origin of a part of a grid. In 2-D the nodes of one plane are used: the
coordinate along z is that of the plane, and the plane above is the same one.
"""

import functools
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel
from warp_lcp.grid.particle_loops import launch, scatter, touched_planes
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.kernels.recorded_arguments import Scalar, value_of

TINY_WEIGHT = 1e-9  # least weight of a face that particles touch
# A particle exactly on the boundary between cells would leave one face of its own cell without
# weight, hence without gravity.
EDGE = {wp.float32: 1e-5, wp.float64: 1e-12}
KERNELS = KernelFile(Path(__file__).parent / "headers/transfer.h")


@dataclass(frozen=True)
class TransferKernels:
    """Transfer kernels of a type.

    Attributes:
        scatter: sum over particles, each of which adds to its faces.
        interpolate: its adjoint.
        gather_weights: the sum by faces, each of which reads its particles.
        normalize: division by the weights.
    """

    scatter: StencilKernel
    interpolate: StencilKernel
    gather_weights: StencilKernel
    normalize: wp.Kernel


@functools.cache
def transfer_passes(real: type) -> TransferKernels:
    """Return the transfer kernels for float32 or float64.

    Two forms of the sum over particles, its adjoint `interpolate`, and the division by the weights.
    """
    name = f"warp_lcp.grid.transfer_{real.__name__}"
    make_kernel = functools.partial(
        KERNELS.kernel, compute=real, constants={"EDGE": EDGE[real], "TINY_WEIGHT": TINY_WEIGHT}
    )

    @cell_kernel(name)
    @typing.no_type_check
    def normalize(k, j, i, weight: wp.array3d(dtype=real), field: wp.array3d(dtype=real)):
        w = weight[k, j, i]
        if w > real(TINY_WEIGHT):
            field[k, j, i] = field[k, j, i] / w
        else:
            field[k, j, i] = real(0.0)

    return TransferKernels(
        scatter=make_kernel("grid.transfer.scatter", module=f"grid.transfer_{real.__name__}"),
        interpolate=make_kernel("warp_lcp.grid.transfer.interpolate", module=name),
        gather_weights=make_kernel("warp_lcp.grid.transfer.gather_weights", module=name),
        normalize=normalize,
    )


def particles_to_faces(
    grid: StaggeredGrid,
    position: wp.array,
    velocity: wp.array,
    affine: list[wp.array],
    fields: list[wp.array],
    weights: list[wp.array],
    *,
    window: Window | None = None,
    offsets: wp.array | None = None,
    runs: wp.array | None = None,
) -> None:
    """Particle-to-grid transfer (P2G): average the particles' velocities on the faces.

    All particles have the same weight.

    Args:
        grid: the grid; every particle lies in its domain.
        position: [m], shape (n,), vectors.
        velocity: [m/s], shape (n,), vectors.
        affine: gradient of each component [1/s], shape (n,) each (APIC), or empty (PIC and FLIP).
        fields: velocity of each component [m/s] (written), 0 on faces without weight.
        weights: sum of the tent weights of each component (written), in particles.
        window: faces that particles can reach; all of them if None.
        offsets: first particle of each stored cell, int32, shape (cells + 1,), of particles that
            are sorted by cell: faces gather. None: particles scatter, in any order; on CUDA the
            last bits then differ from run to run.
        runs: `runs` of `Particles`.
    """
    passes = transfer_passes(fields[0].dtype)
    window = window or grid.everywhere
    touched = touched_planes(grid, position) if offsets is None else None
    for axis, (field, weight) in enumerate(zip(fields, weights, strict=True)):
        window.clear(field, weight)
        gradient = affine[axis] if affine else None
        if offsets is not None:
            window.run(
                passes.gather_weights,
                grid.placement,
                grouped=True,
                position=position,
                velocity=velocity,
                gradient=gradient,
                axis=axis,
                offsets=offsets,
                field=field,
                weight=weight,
            )
            if grid.barriers is not None:
                grid.barriers.particles_to_faces(
                    window, axis, offsets, position, velocity, gradient, field, weight
                )
            continue
        scatter(
            passes.scatter,
            grid,
            position,
            touched,
            runs=runs,
            velocity=velocity,
            gradient=gradient,
            axis=axis,
            momentum=field,
            weight=weight,
        )
        window.launch(passes.normalize, [weight, field])


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
    """Grid to particles (G2P): interpolate the faces' velocities at the particles.

    Args:
        grid: the grid; every particle lies in its domain.
        fields: velocity of each component on the faces [m/s].
        position: [m], shape (n,), vectors.
        velocity: [m/s], shape (n,), vectors (written): v = interpolated + flip (v_before -
            interpolated `saved`).
        affine: gradient of each component [1/s] (written, APIC), or empty.
        saved: the faces' velocities as they came from the particles [m/s], for FLIP.
        flip: share of FLIP, 0 (PIC) to 1; needs `saved`.
    """
    passes = transfer_passes(fields[0].dtype)
    before = wp.clone(velocity) if grid.barriers is not None and saved and flip > 0.0 else velocity
    for axis, field in enumerate(fields):
        gradient = affine[axis] if affine else None
        old = saved[axis] if saved and flip > 0.0 else None
        launch(
            passes.interpolate,
            len(position),
            grid,
            position=position,
            velocity=velocity,
            gradient=gradient,
            axis=axis,
            flip=flip,
            field=field,
            saved=old,
        )
        if grid.barriers is not None:
            grid.barriers.faces_to_particles(
                axis, field, old, flip if old else 0.0, before, position, velocity, gradient
            )


@cell_kernel("warp_lcp.grid.gravity")
@typing.no_type_check
def accelerate_kernel(k, j, i, change: float, weight: F32, field: F32):
    """Add a change of velocity [m/s] to every face with weight."""
    if weight[k, j, i] > TINY_WEIGHT:
        field[k, j, i] = field[k, j, i] + change


def accelerate(
    window: Window,
    velocity: Sequence[wp.array],
    weights: Sequence[wp.array],
    change: Sequence[float | Scalar],
) -> None:
    """Change the velocity of every face with particle weight.

    Closed faces included: they pass it on to the material beside them.

    Args:
        window: faces that particles can reach.
        velocity: each component [m/s] (updated).
        weights: weights of the particles on each component's faces.
        change: change of each component [m/s], shape (3,); a recorded launch has one for those that
            are not 0 then.
    """
    for axis, (field, weight) in enumerate(zip(velocity, weights, strict=True)):
        if value_of(change[axis]) != 0.0:
            window.launch(accelerate_kernel, [change[axis], weight, field])
