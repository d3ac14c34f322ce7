"""What a scene of liquid asks for besides what all materials have, made: surface and pressure."""

from __future__ import annotations

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.surface import FreeSurface, GhostFluidSurface, NoSurface, WholeCellSurface
from warp_lcp.fluids.unilateral import UnilateralPressure
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.material.boundary import Boundary
from warp_lcp.material.cut_boundary import CutBoundary
from warp_lcp.material.narrow_band import NarrowBand
from warp_lcp.rigid.bodies import RigidBodies


def make_surface(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, band: NarrowBand | None) -> FreeSurface:
    """Return the free surface that a scene asks for, around particles that are everywhere or in a band."""
    if stays_full(scene, boundary):
        return NoSurface(grid, boundary)
    count = scene.particles.per_axis**grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        fill = band.fill if band is not None else None
        return GhostFluidSurface(grid, boundary, particles_a_cell=count, smoothing=scene.pressure.smoothing, fill=fill)
    return WholeCellSurface(grid, boundary, particles_a_cell=count)


def make_pressure(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, weights: list[wp.array], bodies: RigidBodies | None
) -> PressureProjection:
    """Return the pressure that a scene asks for, of liquid and the bodies in it.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        surface: the free surface.
        weights: those of the particles on each component's faces.
        bodies: those that the liquid moves, among the solids; None: there are none.
    """
    settings = scene.solver
    solver = wl.METHODS[settings.method](precision=settings.precision)
    coupling = None
    if bodies is not None:
        assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
        coupling = BodyCoupling(grid, boundary, bodies, scene.physics.density)
    gravity = float(np.linalg.norm(scene.physics.gravity))
    if isinstance(surface, GhostFluidSurface) and scene.pressure.model == "unilateral":
        return UnilateralPressure(
            grid, boundary, solver, level_set=surface.level_set, weights=weights, tolerance=settings.tolerance,
            max_iterations=settings.max_iterations, coupling=coupling, gravity=gravity,
        )  # fmt: skip
    return PressureProjection(
        grid, boundary, solver, tolerance=settings.tolerance, max_iterations=settings.max_iterations, phi=surface.phi, coupling=coupling,
        lets_go=scene.lets_go, weights=weights if scene.short_steps else None, gravity=gravity,
    )  # fmt: skip


def stays_full(scene: LiquidScene, boundary: Boundary) -> bool:
    """Return whether every cell is liquid for ever: walls that a caller moves might make room."""
    return scene.stays_full and not boundary.velocity
