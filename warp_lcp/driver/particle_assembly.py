"""What a scene of particles asks for, made: walls, the first particles, where material comes in and goes out, what evens it out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.driver.particle_scene import ParticleScene
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.particles import Particles, seed
from warp_lcp.grid.periodic import PeriodicSides, periodic_sides
from warp_lcp.grid.sides import side_bits
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid, inside, placement_notes, voxelize
from warp_lcp.material.boundary import Boundary, WholeCells
from warp_lcp.material.cut_boundary import CutBoundary
from warp_lcp.material.density_correction import DensityCorrection
from warp_lcp.material.outlets import Drain, Outlets
from warp_lcp.material.reseeding import Reseeding
from warp_lcp.material.sources import Source, Sources


def placed_solids(scene: ParticleScene, folder: Path) -> list[PlacedSolid]:
    """Return the scene's solids; files that it names are relative to `folder`."""
    return [
        PlacedSolid(
            geometry=solid.to_geometry(folder, scene.dimension),
            separating=(solid.wall or scene.domain.wall) == "separating",
            name=f"solid[{number}] ({solid.shape})",
            motion=solid.motion.to_motion(scene.dimension) if solid.motion else None,
        )
        for number, solid in enumerate(scene.solid)
    ]


def make_boundary(
    scene: ParticleScene, grid: StaggeredGrid, folder: Path, wall_velocity: np.ndarray | None = None
) -> tuple[Boundary, tuple[str, ...]]:
    """Return solids and walls as the scene asks for them, and warnings.

    Args:
        scene: the scene.
        grid: its grid.
        folder: where the files are that it names.
        wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids, 3), constant; None: all stand still, or
            have their own motion.

    Raises:
        ValueError: solids cut cells and there is a `wall_velocity`.
    """
    placed, around = placed_solids(scene, folder), PeriodicSides(grid, scene.endless) if scene.endless else None
    separating, sides = scene.domain.wall == "separating", side_bits(scene.domain.open)
    if scene.domain.solids == "cut-cell":
        if wall_velocity is not None:
            raise ValueError('wall_velocity: only for solids = "voxel"; solids that cut cells have a motion')
        cut = CutCells(grid, placed, wall_separating=separating, open_sides=sides)
        if not cut.whole_cells:
            return CutBoundary(grid, cut, sides=around), cut.notes
    solids = voxelize(
        grid.counts, grid.spacing, grid.dimension, placed, wall_separating=separating, device=grid.device,
        open_sides=sides | side_bits(periodic_sides(scene.endless)),
    )  # fmt: skip
    if wall_velocity is None and scene.source:
        wall_velocity = np.zeros((1 + len(placed), 3))  # what a source's faces are given goes there
    return WholeCells(grid, solids, wall_velocity, open_sides=sides, sides=around), solids.notes


def seed_materials(scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Fill the scene's materials with points.

    Returns:
        Positions [m], float32, shape (n, 3); the entry of `scene.materials()` that each belongs to, shape (n,); warnings.

    Raises:
        ValueError: a material has no particle.
    """
    key, materials = scene.materials()
    geometries = [material.to_geometry(folder, scene.dimension) for material in materials]
    regions = [_region(geometry, boundary, grid.device) for geometry in geometries]
    names = [f"{key}[{number}] ({material.shape})" for number, material in enumerate(materials)]
    notes: list[str] = []
    for name, geometry in zip(names, geometries, strict=True):
        notes += placement_notes(geometry, name, grid.counts, grid.spacing, grid.dimension)
    settings = scene.particles
    open_cells = grid.interior(boundary.base.numpy()) != wl.SOLID
    position, owner = seed(
        grid, regions, open_cells, per_axis=settings.per_axis, jitter=settings.jitter, random_seed=settings.seed
    )  # fmt: skip
    counts = np.bincount(owner, minlength=len(geometries))
    for name, count in zip(names, counts, strict=False):
        if count == 0:
            raise ValueError(
                f"{name} holds no particle: it is too small for cells of {grid.spacing:.4g} m, or lies in solids, outside the domain or in "
                f"an earlier {key}"
            )
    return position, owner, notes


def make_particles(scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> tuple[Particles, list[str]]:
    """Return the particles of all materials, in the order of `seed_materials`, and warnings.

    Raises:
        ValueError: a material has no particle.
    """
    position, owner, notes = seed_materials(scene, grid, boundary, folder)
    start = [_vector(material.velocity or [0.0, 0.0]) for material in scene.materials()[1]] or [_vector([0.0, 0.0])]
    velocity = np.array(start, dtype=np.float32)[owner]
    return Particles(grid, position, velocity, affine=scene.particles.transfer == "apic"), notes


def make_sources(scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, folder: Path) -> Sources | None:
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


def make_outlets(scene: ParticleScene, grid: StaggeredGrid, folder: Path) -> Outlets | None:
    """Return the scene's drains and open sides, if it has any."""
    if not scene.drain and not scene.domain.open:
        return None
    drains = [
        Drain(drain.to_geometry(folder, scene.dimension), drain.begin, np.inf if drain.stop is None else drain.stop)
        for drain in scene.drain
    ]
    return Outlets(grid, drains, side_bits(scene.domain.open))


def make_reseeding(scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary) -> Reseeding | None:
    """Return what evens out the particles if a scene asks for it."""
    settings = scene.particles.reseed
    if settings is None:
        return None
    at_rest = scene.particles.per_axis**grid.dimension
    least, most = scene.particles.reseed_range(grid.dimension)
    return Reseeding(grid, boundary, least=least, most=most, particles_a_cell=at_rest, every=settings.every)


def make_density_correction(scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary) -> DensityCorrection | None:
    """Return the density correction if a scene asks for one."""
    settings = scene.density_correction
    if settings is None:
        return None
    count = scene.particles.per_axis
    most = settings.largest(count)
    solver = wl.ProjectedMultigrid(precision=scene.solver.precision)
    return DensityCorrection(
        grid, boundary, solver, particles_a_cell=count**grid.dimension, max_density=most, every=settings.every,
        gain=scene.correction_gain, tolerance=settings.tolerance,
    )  # fmt: skip


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
