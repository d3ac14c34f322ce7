"""What a scene of liquid asks for besides what all materials have, made: surface and pressure."""

from __future__ import annotations

import warp as wp

import warp_lcp as wl
from fluids.pressure import PressureProjection
from fluids.scene import LiquidScene
from fluids.surface import FreeSurface, GhostFluidSurface, WholeCellSurface
from fluids.unilateral import UnilateralPressure
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import Boundary


def make_surface(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary) -> FreeSurface:
    """Return the free surface that a scene asks for."""
    count = scene.particles.per_axis**grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        return GhostFluidSurface(grid, boundary, particles_a_cell=count, smoothing=scene.pressure.smoothing)
    return WholeCellSurface(grid, boundary, particles_a_cell=count)


def make_pressure(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, weights: list[wp.array]
) -> PressureProjection:
    """Return the pressure that a scene asks for; `weights` are those of the particles on each component's faces."""
    settings = scene.solver
    solver = wl.METHODS[settings.method](precision=settings.precision)
    if isinstance(surface, GhostFluidSurface) and scene.pressure.model == "unilateral":
        return UnilateralPressure(
            grid, boundary, solver, level_set=surface.level_set, weights=weights, tolerance=settings.tolerance,
            max_iterations=settings.max_iterations,
        )  # fmt: skip
    return PressureProjection(
        grid, boundary, solver, tolerance=settings.tolerance, max_iterations=settings.max_iterations, phi=surface.phi
    )  # fmt: skip
