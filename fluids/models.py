"""Build a liquid's models: surface, pressure, surface tension, viscosity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.surface import FreeSurface, GhostFluidSurface, NoSurface, WholeCellSurface
from warp_lcp.fluids.surface_tension import SurfaceTension
from warp_lcp.fluids.unilateral import UnilateralPressure
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.level_set import Fill
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material.boundary import Boundary, CutBoundary
from warp_lcp.rigid.bodies import RigidBodies

VISCOUS_TOLERANCE = 1e-4  # where the pressure's comes from the time step


def make_surface(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, fill: Fill | None = None, counted: Window | None = None
) -> FreeSurface:
    """Return the free surface of a scene.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        fill: adds the density of liquid without particles, such as below a narrow band.
        counted: cells whose volume is computed; None: all.
    """
    if scene.stays_full and not boundary.velocity:  # walls that a caller moves might make room
        return NoSurface(grid, boundary, counted)
    count = scene.particles.per_axis**grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        smoothing = scene.pressure.smoothing
        return GhostFluidSurface(grid, boundary, particles_a_cell=count, smoothing=smoothing, fill=fill, counted=counted)
    return WholeCellSurface(grid, boundary, particles_a_cell=count, fill=fill)


def make_tension(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, make: Callable[..., SurfaceTension] = SurfaceTension
) -> SurfaceTension | None:
    """Return the surface tension of a scene, or None without tension or surface.

    `make` is called with the arguments of `SurfaceTension`.
    """
    given = scene.surface_tension
    if given is None or surface.phi is None:
        return None
    angle, density = given.contact_angle, scene.physics.density
    return make(grid, boundary, surface.phi, coefficient=given.coefficient, contact_angle=angle, density=density)


def make_pressure(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, weights: list[wp.array],
    coupling: BodyCoupling | None, make: Callable[..., PressureProjection] = PressureProjection,
    make_unilateral: Callable[..., PressureProjection] = UnilateralPressure,
) -> PressureProjection:  # fmt: skip
    """Return the pressure solver of a scene, for the liquid and its rigid bodies.

    `make` and `make_unilateral` are called with the arguments of `PressureProjection` and `UnilateralPressure`.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        surface: the free surface.
        weights: of the particles on the faces of each component.
        coupling: coupling with rigid bodies among the solids; None: there are none.
        make: makes the projection.
        make_unilateral: makes that of a unilateral pressure.
    """
    solver = wl.METHODS[scene.solver.method](precision=scene.solver.precision)
    tolerance, most = scene.solver.tolerance, scene.solver.max_iterations
    gravity = float(np.linalg.norm(scene.physics.gravity))
    if scene.pressure.model == "unilateral" and isinstance(surface, GhostFluidSurface):
        return make_unilateral(
            grid, boundary, solver, tolerance=tolerance, max_iterations=most, gravity=gravity, coupling=coupling,
            level_set=surface.level_set, weights=weights,
        )  # fmt: skip
    return make(
        grid, boundary, solver, tolerance=tolerance, max_iterations=most, gravity=gravity, coupling=coupling, phi=surface.phi,
        lets_go=scene.lets_go, weights=weights if scene.short_steps else None,
    )  # fmt: skip


def make_coupling(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, bodies: RigidBodies | None,
    make: Callable[..., BodyCoupling] = BodyCoupling,
) -> BodyCoupling | None:  # fmt: skip
    """Return the coupling of a scene's liquid with its rigid bodies, None without bodies.

    `make` is called with the arguments of `BodyCoupling`.
    """
    if bodies is None:
        return None
    assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
    return make(grid, boundary, bodies, scene.physics.density)


def make_viscosity(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, bodies: RigidBodies | None,
    make: Callable[..., Viscosity] = Viscosity,
) -> Viscosity | None:  # fmt: skip
    """Return the viscosity of a scene, or None.

    `make` is called with the arguments of `Viscosity`.
    """
    if scene.viscosity is None:
        return None
    tolerance = scene.solver.tolerance if scene.solver.tolerance != "auto" else VISCOUS_TOLERANCE
    kept = scene.kept([*scene.liquid, *scene.source])
    return make(
        grid, boundary, viscosity=scene.viscosity.value, density=scene.physics.density, slip_lengths=scene.slip_lengths,
        thickest=None if kept is None else max(*kept, 1.0), phi=surface.phi, tolerance=tolerance, sources=bool(scene.source), bodies=bodies,
    )  # fmt: skip
