"""Models of a liquid: surface, pressure, surface tension, viscosity, user models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.fluids.coupling import BodyCoupling
from warp_lcp.fluids.pressure import PressureProjection
from warp_lcp.fluids.scene import LiquidScene
from warp_lcp.fluids.stokes import StokesSolve
from warp_lcp.fluids.surface import FreeSurface, GhostFluidSurface, NoSurface, WholeCellSurface
from warp_lcp.fluids.surface_tension import SurfaceTension
from warp_lcp.fluids.unilateral_pressure import UnilateralPressure
from warp_lcp.fluids.viscosity import Viscosity
from warp_lcp.grid.level_set import Fill
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material.boundary import Boundary, CutBoundary
from warp_lcp.material.particle_log import Row
from warp_lcp.rigid.bodies import RigidBodies

if TYPE_CHECKING:
    from warp_lcp.fluids.simulator import LiquidSimulation
    from warp_lcp.fluids.whitewater import Whitewater


class LiquidModel(Protocol):
    """User-defined model in the step of a liquid, such as a force.

    It is passed to `LiquidSimulation` in `models`. It acts on all of the liquid: with such models,
    the momentum corrections of airborne material are off, which assume gravity alone.

    The same code runs in one process and on MPI ranks: `liquid.grid.part` tells which cells belong
    to this process, fills ghost cells and sums over all ranks. Every rank calls `act` in every
    step.

    Attributes:
        columns: log columns that `act` fills.
    """

    columns: tuple[str, ...]

    def allocate(self, liquid: LiquidSimulation) -> None:
        """Allocate arrays on `liquid.grid`.

        Called again whenever the grid has changed.
        """

    def act(self, liquid: LiquidSimulation, window: Window, dt: float) -> Row:
        """Change `liquid.velocity`, after gravity, before viscosity; collective.

        Args:
            liquid: the simulation. Faces in liquid are marked in `liquid.projection.known`; forces
                act for `liquid.kick_dt` [s].
            window: cells that the liquid can touch in the step.
            dt: time step [s].

        Returns:
            The values of `columns`, the same on all ranks.

        Raises:
            StepFailed: a smaller dt may be tried; on all ranks.
        """


# Error of a coupled solve, as a share of the splitting error that is tolerated.
COUPLED_ACCURACY = 0.01
VISCOUS_TOLERANCE = 1e-4  # used where the pressure's tolerance is derived from the time step


def make_surface(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, fill: Fill | None = None
) -> FreeSurface:
    """Return the free surface of a scene.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        fill: adds the density of liquid without particles, such as below a narrow band.
    """
    # Walls that a caller moves could make room.
    if scene.stays_full and not boundary.velocity:
        return NoSurface(grid, boundary)
    count = scene.particles.per_axis**grid.dimension
    if scene.pressure.surface == "ghost-fluid":
        smoothing = scene.pressure.smoothing
        return GhostFluidSurface(
            grid, boundary, particles_a_cell=count, smoothing=smoothing, fill=fill
        )
    return WholeCellSurface(grid, boundary, particles_a_cell=count, fill=fill)


def make_tension(
    scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, surface: FreeSurface
) -> SurfaceTension | None:
    """Return the surface tension of a scene, or None without tension or surface."""
    settings = scene.surface_tension
    if settings is None or surface.phi is None:
        return None
    angle, density = settings.contact_angle, scene.physics.density
    return SurfaceTension(
        grid,
        boundary,
        surface.phi,
        coefficient=settings.coefficient,
        contact_angle=angle,
        density=density,
    )


def make_whitewater(scene: LiquidScene, grid: StaggeredGrid) -> Whitewater | None:
    """Return the whitewater of a scene, or None without the table or a free surface."""
    if not scene.has_whitewater:
        return None
    # Imported here, so that other scenes compile and import nothing of it.
    from warp_lcp.fluids.whitewater import Whitewater

    return Whitewater(scene, grid)


def whitewater_reach(scene: LiquidScene) -> tuple[str, float] | None:
    """Return the key and the distance [m] at which whitewater reads the liquid.

    None without whitewater.
    """
    settings = scene.resolved_whitewater
    if settings is None:
        return None
    assert settings.length is not None
    return "whitewater.length", settings.length


def make_pressure(
    scene: LiquidScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    surface: FreeSurface,
    weights: list[wp.array],
    bodies: RigidBodies | None,
) -> PressureProjection:
    """Return the pressure solver of a scene, for the liquid and its rigid bodies.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        surface: the free surface.
        weights: particle weights on the faces of each component.
        bodies: rigid bodies among the solids; None without any.
    """
    solver, coupling = (
        wl.default_chain(wl.METHODS[scene.solver.method](precision=scene.solver.precision)),
        None,
    )
    tolerance, most = scene.solver.tolerance, scene.solver.max_iterations
    gravity = float(np.linalg.norm(scene.physics.gravity))
    if bodies is not None:
        assert isinstance(boundary, CutBoundary), "a scene with bodies has cut cells"
        coupling = BodyCoupling(grid, boundary, bodies, scene.physics.density)
    if scene.pressure.model == "unilateral" and isinstance(surface, GhostFluidSurface):
        return UnilateralPressure(
            grid,
            boundary,
            solver,
            tolerance=tolerance,
            max_iterations=most,
            gravity=gravity,
            coupling=coupling,
            level_set=surface.level_set,
            weights=weights,
        )
    return PressureProjection(
        grid,
        boundary,
        solver,
        tolerance=tolerance,
        max_iterations=most,
        gravity=gravity,
        coupling=coupling,
        phi=surface.phi,
        walls_separate=scene.walls_separate,
        weights=weights if scene.short_steps else None,
    )


def make_viscosity(
    scene: LiquidScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    surface: FreeSurface,
    bodies: RigidBodies | None,
) -> Viscosity | None:
    """Return the viscosity of a scene, or None."""
    if scene.viscosity is None:
        return None
    tolerance = scene.solver.tolerance if scene.solver.tolerance != "auto" else VISCOUS_TOLERANCE
    relative = scene.carried_numbers([*scene.liquid, *scene.source])
    return Viscosity(
        grid,
        boundary,
        viscosity=scene.viscosity.value,
        density=scene.physics.density,
        slip_lengths=scene.slip_lengths,
        thickest=None if relative is None else max(*relative, 1.0),
        phi=surface.phi,
        tolerance=tolerance,
        sources=bool(scene.source),
        bodies=bodies,
    )


def make_stokes(
    scene: LiquidScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    surface: FreeSurface,
    viscosity: Viscosity | None,
    projection: PressureProjection,
    bodies: RigidBodies | None,
) -> StokesSolve | None:
    """Return the coupled solve of velocity and pressure of a scene, or None."""
    if scene.viscosity is None or viscosity is None or not scene.couples:
        return None
    return StokesSolve(
        grid,
        boundary,
        viscosity,
        projection,
        phi=surface.phi,
        splitting_tolerance=scene.viscosity.splitting_tolerance,
        tolerance=max(viscosity.tolerance, COUPLED_ACCURACY * scene.viscosity.splitting_tolerance),
        density=scene.physics.density,
        bodies=bodies,
    )
