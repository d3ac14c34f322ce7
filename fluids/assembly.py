"""What a scene of liquid asks for, made: walls, surface and pressure, the first particles, where liquid comes in and goes out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from fluids.boundary import Boundary, WholeCells
from fluids.cut_boundary import CutBoundary
from fluids.outlets import Drain, Outlets
from fluids.pressure import PressureProjection
from fluids.scene import LiquidScene
from fluids.sources import Source, Sources
from fluids.surface import FreeSurface, GhostFluidSurface, WholeCellSurface
from fluids.unilateral import UnilateralPressure
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.particles import Particles, seed
from warp_lcp.grid.sides import side_bits
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid, inside, placement_notes, voxelize


def make_boundary(
    scene: LiquidScene, grid: StaggeredGrid, folder: Path, wall_velocity: np.ndarray | None
) -> tuple[Boundary, tuple[str, ...]]:
    """Return solids and walls as the scene asks for them, and warnings."""
    placed = [
        PlacedSolid(
            geometry=solid.to_geometry(folder, scene.dimension),
            separating=(solid.wall or scene.domain.wall) == "separating",
            name=f"solid[{number}] ({solid.shape})",
            motion=solid.motion.to_motion(scene.dimension) if solid.motion else None,
        )
        for number, solid in enumerate(scene.solid)
    ]
    separating, sides = scene.domain.wall == "separating", side_bits(scene.domain.open)
    if scene.domain.solids == "cut-cell":
        if wall_velocity is not None:
            raise ValueError('wall_velocity: only for solids = "voxel"; solids that cut cells have a motion')
        cut = CutCells(grid, placed, wall_separating=separating, open_sides=sides)
        if not cut.whole_cells:
            return CutBoundary(grid, cut), cut.notes
    solids = voxelize(
        grid.counts, grid.spacing, grid.dimension, placed, wall_separating=separating, device=grid.device, open_sides=sides
    )  # fmt: skip
    if wall_velocity is None and scene.source:
        wall_velocity = np.zeros((1 + len(placed), 3))  # what a source's faces are given goes there
    return WholeCells(grid, solids, wall_velocity, open_sides=sides), solids.notes


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


def make_particles(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> tuple[Particles, list[str]]:
    """Return the particles of all liquids, and warnings.

    Raises:
        ValueError: a liquid has no particle.
    """
    geometries = [liquid.to_geometry(folder, scene.dimension) for liquid in scene.liquid]
    regions = [_region(geometry, boundary, grid.device) for geometry in geometries]
    notes: list[str] = []
    for number, (liquid, geometry) in enumerate(zip(scene.liquid, geometries, strict=True)):
        notes += placement_notes(geometry, f"liquid[{number}] ({liquid.shape})", grid.counts, grid.spacing, grid.dimension)
    settings = scene.particles
    open_cells = grid.interior(boundary.base.numpy()) != wl.SOLID
    position, owner = seed(
        grid, regions, open_cells, per_axis=settings.per_axis, jitter=settings.jitter, random_seed=settings.seed
    )  # fmt: skip
    counts = np.bincount(owner, minlength=len(geometries))
    for number, count in enumerate(counts[: len(geometries)]):
        if count == 0:
            raise ValueError(
                f"liquid[{number}] ({scene.liquid[number].shape}) holds no particle: it is too small for cells of {grid.spacing:.4g} m, or "
                "lies in solids, outside the domain or in an earlier liquid"
            )
    start = np.array([_vector(liquid.velocity or [0.0, 0.0]) for liquid in scene.liquid] or [_vector([0.0, 0.0])], dtype=np.float32)
    return Particles(grid, position, start[owner], affine=settings.transfer == "apic"), notes


def make_sources(scene: LiquidScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> Sources | None:
    """Return the scene's sources, if it has any.

    Raises:
        ValueError: a source has no open cell.
    """
    if not scene.source:
        return None
    sources = [
        Source(
            name=f"source[{number}] ({source.shape})",
            contains=_inside(source.to_geometry(folder, scene.dimension), grid.device),
            velocity=np.array(_vector(source.velocity)),
            start=source.begin,
            stop=np.inf if source.stop is None else source.stop,
        )
        for number, source in enumerate(scene.source)
    ]
    settings = scene.particles
    return Sources(grid, boundary, sources, per_axis=settings.per_axis, jitter=settings.jitter, random_seed=settings.seed)


def make_outlets(scene: LiquidScene, grid: StaggeredGrid, folder: Path) -> Outlets | None:
    """Return the scene's drains and open sides, if it has any."""
    if not scene.drain and not scene.domain.open:
        return None
    drains = [
        Drain(drain.to_geometry(folder, scene.dimension), drain.begin, np.inf if drain.stop is None else drain.stop)
        for drain in scene.drain
    ]
    return Outlets(grid, drains, side_bits(scene.domain.open))


def _vector(entries: list[float]) -> list[float]:
    """Return a vector of two or three entries as one of three."""
    return [*entries, 0.0][:3]


def _inside(geometry: Geometry, device: wp.Device) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that tells which points lie in a geometry."""
    return lambda points: inside([geometry], points, device=device)


def _region(geometry: Geometry, boundary: Boundary, device: wp.Device) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that tells which points lie in a geometry and outside solids."""

    def holds(points: np.ndarray) -> np.ndarray:
        result = inside([geometry], points, device=device)
        result[result] = boundary.admits(points[result])
        return result

    return holds
