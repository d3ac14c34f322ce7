"""Build a liquid's models: surface, pressure, surface tension, viscosity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
    settings = {"coefficient": given.coefficient, "contact_angle": given.contact_angle, "density": scene.physics.density}
    return make(grid, boundary, surface.phi, **settings)


def pressure_settings(scene: LiquidScene, surface: FreeSurface, weights: list[wp.array]) -> dict[str, Any]:
    """Return the arguments of `PressureProjection` that a scene sets.

    Includes the particle weights on the faces of each component.
    """
    settings, gravity = scene.solver, float(np.linalg.norm(scene.physics.gravity))
    resting = {"lets_go": scene.lets_go, "weights": weights if scene.short_steps else None, "phi": surface.phi}
    return {"tolerance": settings.tolerance, "max_iterations": settings.max_iterations, "gravity": gravity} | resting


def unilateral_settings(scene: LiquidScene, surface: GhostFluidSurface, weights: list[wp.array]) -> dict[str, Any]:
    """Return the arguments of `UnilateralPressure` that a scene sets.

    Arguments as in `pressure_settings`.
    """
    settings = pressure_settings(scene, surface, weights)
    shared = {name: settings[name] for name in ("tolerance", "max_iterations", "gravity")}
    return shared | {"level_set": surface.level_set, "weights": weights}


def make_pressure(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface, weights: list[wp.array], bodies: RigidBodies | None
) -> PressureProjection:
    """Return the pressure solver of a scene, for the liquid and its rigid bodies.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        surface: the free surface.
        weights: of the particles on the faces of each component.
        bodies: rigid bodies among the solids; None: there are none.
    """
    solver = wl.METHODS[scene.solver.method](precision=scene.solver.precision)
    coupling, settings = None, pressure_settings(scene, surface, weights)
    if bodies is not None:
        assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
        coupling = BodyCoupling(grid, boundary, bodies, scene.physics.density)
    if scene.pressure.model == "unilateral" and isinstance(surface, GhostFluidSurface):
        return UnilateralPressure(grid, boundary, solver, coupling=coupling, **unilateral_settings(scene, surface, weights))
    return PressureProjection(grid, boundary, solver, coupling=coupling, **settings)


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
    settings: dict[str, Any] = {"viscosity": scene.viscosity.value, "density": scene.physics.density, "slip_lengths": scene.slip_lengths}
    kept = scene.kept([*scene.liquid, *scene.source])
    settings["thickest"] = None if kept is None else max(*kept, 1.0)
    return make(grid, boundary, phi=surface.phi, tolerance=tolerance, sources=bool(scene.source), bodies=bodies, **settings)
