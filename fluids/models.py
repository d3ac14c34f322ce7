"""The models of a liquid that a scene asks for, made: free surface, pressure, surface tension, viscosity."""

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
    """Return the free surface that a scene asks for.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        fill: adds to the particles' density what none of them stands for, as where they are in a band alone.
        counted: cells whose volume is asked for; None: all.
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
    """Return the surface tension of a scene, made by what takes the arguments of `SurfaceTension`; None: it has none, or no surface."""
    given = scene.surface_tension
    if given is None or surface.phi is None:
        return None
    settings = {"coefficient": given.coefficient, "contact_angle": given.contact_angle, "density": scene.physics.density}
    return make(grid, boundary, surface.phi, **settings)


def pressure_settings(scene: LiquidScene, surface: FreeSurface, weights: list[wp.array]) -> dict[str, Any]:
    """Return what a scene sets of `PressureProjection`, with the weights of the particles on each component's faces."""
    settings, gravity = scene.solver, float(np.linalg.norm(scene.physics.gravity))
    resting = {"lets_go": scene.lets_go, "weights": weights if scene.short_steps else None, "phi": surface.phi}
    return {"tolerance": settings.tolerance, "max_iterations": settings.max_iterations, "gravity": gravity} | resting


def unilateral_settings(scene: LiquidScene, surface: GhostFluidSurface, weights: list[wp.array]) -> dict[str, Any]:
    """Return what a scene sets of `UnilateralPressure`; arguments as of `pressure_settings`."""
    settings = pressure_settings(scene, surface, weights)
    shared = {name: settings[name] for name in ("tolerance", "max_iterations", "gravity")}
    return shared | {"level_set": surface.level_set, "weights": weights}


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
    """Return the viscosity that a scene asks for, if it does, made by what takes the arguments of `Viscosity`."""
    if scene.viscosity is None:
        return None
    tolerance = scene.solver.tolerance if scene.solver.tolerance != "auto" else VISCOUS_TOLERANCE
    settings: dict[str, Any] = {"viscosity": scene.viscosity.value, "density": scene.physics.density, "slip_lengths": scene.slip_lengths}
    kept = scene.kept([*scene.liquid, *scene.source])
    settings["thickest"] = None if kept is None else max(*kept, 1.0)
    return make(grid, boundary, phi=surface.phi, tolerance=tolerance, sources=bool(scene.source), bodies=bodies, **settings)
