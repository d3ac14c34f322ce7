"""Kernels of the coupled solve of velocity and pressure, see `fluids.stokes`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from warp_lcp.fluids.pressure import THETA_MIN
from warp_lcp.fluids.viscosity_passes import ALONG, CLOSE
from warp_lcp.kernels import KernelFile, StencilKernel
from warp_lcp.material.boundary_kernels import LETS_GO, RELEASED
from warp_lcp.operators.grid_poisson import AIR, FLUID, SOLID

CONSTANTS = {
    "AIR": AIR,
    "FLUID": FLUID,
    "SOLID": SOLID,
    "RELEASED": RELEASED,
    "LETS_GO": LETS_GO,
    "CLOSE": CLOSE,
    "ALONG": ALONG,
    "THETA_MIN": THETA_MIN,
}
KERNELS = KernelFile(Path(__file__).parent / "headers/stokes.h", CONSTANTS)


@dataclass(frozen=True)
class StokesKernels:
    """Kernels of the coupled solve; the declarations in the header explain them."""

    masses: StencilKernel
    cells: StencilKernel
    edges: StencilKernel
    scale: StencilKernel
    weights: StencilKernel
    gradient: StencilKernel
    force: StencilKernel
    beside_walls: StencilKernel
    outflow: StencilKernel
    held: StencilKernel
    divergence: StencilKernel
    bound: StencilKernel
    right_side: StencilKernel
    correction: StencilKernel
    velocity_correction: StencilKernel
    energy: StencilKernel
    difference: StencilKernel
    start_velocity: StencilKernel
    start_pressure: StencilKernel
    pressure_difference: StencilKernel
    add_velocity: StencilKernel
    add_pressure: StencilKernel


@functools.cache
def stokes_kernels(
    *, cut: bool, moving: bool, ghost: bool, varies: bool, bounded: bool
) -> StokesKernels:
    """Return the kernels of the coupled solve.

    Args:
        cut: whether faces have open fractions.
        moving: whether solids have velocities.
        ghost: whether the free surface lies between cells.
        varies: whether viscosities differ.
        bounded: whether a wall is separating.
    """

    def kernel(name: str, **flags: bool) -> StencilKernel:
        suffix = "".join(f"_{flag.lower()}" for flag, value in flags.items() if value)
        return KERNELS.kernel(
            f"fluids.stokes.{name}", module=f"fluids.stokes{suffix}", constants=flags
        )

    return StokesKernels(
        masses=kernel("masses", CUT=cut, GHOST=ghost, VARIES=varies),
        cells=kernel("cells", CUT=cut),
        edges=kernel("edges"),
        scale=kernel("scale", CUT=cut),
        weights=kernel("weights"),
        gradient=kernel("gradient", CUT=cut),
        force=kernel("force", CUT=cut),
        beside_walls=kernel("beside_walls"),
        outflow=kernel("outflow", CUT=cut),
        held=kernel("held", CUT=cut, MOVING=moving),
        divergence=kernel("divergence", CUT=cut, MOVING=moving, BOUNDED=bounded),
        bound=kernel("bound"),
        right_side=kernel("right_side"),
        correction=kernel("correction"),
        velocity_correction=kernel("velocity_correction"),
        energy=kernel("energy"),
        difference=kernel("difference"),
        start_velocity=kernel("start_velocity"),
        start_pressure=kernel("start_pressure"),
        pressure_difference=kernel("pressure_difference"),
        add_velocity=kernel("add_velocity"),
        add_pressure=kernel("add_pressure"),
    )
