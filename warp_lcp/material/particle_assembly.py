"""Make the parts of a particle simulation from its scene.

Walls, the first particles, sources and outlets, reseeding and density correction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.grid.barriers import BARRIER, Barriers
from warp_lcp.grid.cut_cells import DEEP, CutCells
from warp_lcp.grid.domain_sides import PeriodicSides, open_sides_of, periodic_sides, side_bits
from warp_lcp.grid.grid_part import subdomain_of
from warp_lcp.grid.particle_seeding import seed
from warp_lcp.grid.particles import Particles
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.surface_mesh import SurfaceMesh, SurfaceObstacles
from warp_lcp.grid.thin_walls import (
    SHEET,
    STRIDE_ROOM,
    THIN,
    ThinWalls,
    fills_cells,
    is_sheet,
    is_thin,
    is_thin_in_parts,
)
from warp_lcp.grid.voxelize import PlacedSolid, inside, placement_notes, voxelize
from warp_lcp.material.ballistic_fragments import BallisticFragments
from warp_lcp.material.boundary import Boundary, CutBoundary, WholeCells
from warp_lcp.material.density_correction import DensityCorrection, DensityMonitor
from warp_lcp.material.domain_window import DomainWindow
from warp_lcp.material.narrow_band import NarrowBand
from warp_lcp.material.partial_sites import seed_regions
from warp_lcp.material.particle_scene import ParticleScene
from warp_lcp.material.particle_volume import ParticleVolume
from warp_lcp.material.reseeding import Reseeding
from warp_lcp.material.sources import Drain, Outlets, Source, Sources
from warp_lcp.material.spray import Spray
from warp_lcp.rigid.bodies import RigidBodies
from warp_lcp.rigid.body import BodyMotion, RigidBody
from warp_lcp.rigid.mass_properties import mass_properties
from warp_lcp.rigid.obstacles import domain_walls, obstacle
from warp_lcp.scene.scene import Scene
from warp_lcp.scene.shapes import Shape, SolidProperties

if TYPE_CHECKING:
    from warp_lcp.granular.wall_friction import SandSolids


def placed_solids(scene: Scene, folder: Path) -> list[PlacedSolid]:
    """Return the scene's solids; rigid bodies have the motion of a body each.

    Files named in the scene are relative to `folder`.

    Raises:
        ValueError: a file cannot be read, or a rigid body has no mass of its own.
    """
    placed = []
    for number, (solid, friction) in enumerate(
        zip(scene.solid, scene.body_frictions(), strict=True)
    ):
        geometry, name = (
            solid.to_geometry(folder, scene.dimension),
            f"solid[{number}] ({solid.shape})",
        )
        motion = solid.motion.to_motion(scene.dimension) if solid.motion else None
        if solid.is_body:
            motion = BodyMotion(_body(solid, geometry, name, friction, scene.dimension))
        separating = (solid.wall or scene.domain.wall) == "separating"
        placed.append(
            PlacedSolid(
                geometry=geometry,
                separating=separating,
                name=name,
                motion=motion,
                among=scene.materials()[0],
            )
        )
    return placed


def make_bodies(
    scene: Scene, placed: Sequence[PlacedSolid], make: Callable[..., RigidBodies] = RigidBodies
) -> RigidBodies | None:
    """Return the rigid bodies among a scene's solids; None if there are none.

    The bodies meet the scene's walls and its other solids.

    Args:
        scene: the scene.
        placed: its solids, of `placed_solids`; the boundary must have the same.
        make: constructor with the arguments of `RigidBodies`.

    Raises:
        ValueError: a body overlaps a wall, a solid or another body, or its center lies outside the
            domain.
    """
    motions = {
        number: solid.motion
        for number, solid in enumerate(placed, start=1)
        if isinstance(solid.motion, BodyMotion)
    }
    if not motions:
        return None
    walls = domain_walls(
        scene.domain.size, open_sides=side_bits(scene.domain.open), endless=scene.endless
    )
    other_shapes = [
        obstacle(solid, scene.dimension)
        for number, solid in enumerate(placed, start=1)
        if number not in motions
    ]
    bodies = [motion.body for motion in motions.values()]
    for body in bodies:
        if not (
            (body.position >= 0.0) & (body.position <= np.array(_vector(scene.domain.size)))
        ).all():
            raise ValueError(
                f"{body.name} has its center of mass at {body.position.round(6).tolist()} m, "
                "outside the domain"
            )
    shapes = [placed[number - 1].geometry for number in motions]
    joints = scene.joints()
    rigid_bodies = make(
        bodies,
        shapes,
        list(motions),
        (walls, *other_shapes),
        scene.dimension,
        **({"joints": joints} if joints else {}),
    )
    rigid_bodies.exits = (scene.domain.size, side_bits(scene.domain.open))
    return rigid_bodies


def make_boundary(
    scene: ParticleScene,
    grid: StaggeredGrid,
    folder: Path,
    wall_velocity: np.ndarray | None = None,
    *,
    solids: Sequence[PlacedSolid] | None = None,
) -> tuple[Boundary, tuple[str, ...]]:
    """Return the scene's boundary (solids and walls) and warnings; collective.

    Args:
        scene: the scene.
        grid: its grid.
        folder: folder of the files that it names.
        wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids, 3),
            constant; None if all are at rest, or have their own motion.
        solids: solids of `placed_solids`; made here if None.

    Raises:
        ValueError: solids cut cells and there is a `wall_velocity`.
    """
    placed = placed_solids(scene, folder) if solids is None else solids
    if grid.part.shared:
        shared, warnings = subdomain_of(grid).make_boundary(scene, placed)
        return shared, tuple(warnings)
    around = PeriodicSides(grid, scene.endless) if scene.endless else None
    separating, covered = scene.domain.wall == "separating", grid.whole is not None
    sides = open_sides_of(grid, side_bits(scene.domain.open))
    shapes: list[Geometry] = []
    if scene.domain.solids == "cut-cell":
        if wall_velocity is not None:
            raise ValueError(
                'wall_velocity: only for solids = "voxel"; with cut cells, give the solid a motion'
            )
        passed = sides | side_bits(periodic_sides(scene.endless))
        thin, crossing = (
            make_thin_walls(scene, grid, placed, passed, crossing=c) for c in (False, True)
        )
        cut = CutCells(
            grid,
            placed,
            wall_separating=separating,
            open_sides=sides,
            remarks=not covered,
            left_out=crossing.everywhere if crossing is not None else (),
            held=crossing.numbers if crossing is not None else (),
            repeated_sides=side_bits(periodic_sides(scene.endless)),
        )
        # On other ranks solids may cut cells.
        if not cut.whole_cells or (covered and placed) or thin is not None:
            barriers = Barriers(grid, crossing, cut, around) if crossing is not None else None
            grid.divide(barriers)
            boundary = CutBoundary(grid, cut, sides=around, thin=thin, barriers=barriers)
            return boundary, (*cut.notes, *(barriers.notes() if barriers is not None else ()))
        shapes = [solid.geometry for solid in placed]
    ends = side_bits(periodic_sides(scene.endless))
    voxels = voxelize(
        grid, placed, wall_separating=separating, open_sides=sides | ends, remarks=not covered
    )
    if wall_velocity is None and scene.source:
        # Memory for the velocities of sources' faces.
        wall_velocity = np.zeros((1 + len(placed), 3))
    return WholeCells(
        grid, voxels, wall_velocity, open_sides=sides, sides=around, shapes=shapes
    ), voxels.notes


def make_thin_walls(
    scene: ParticleScene,
    grid: StaggeredGrid,
    placed: Sequence[PlacedSolid],
    open_sides: int,
    *,
    crossing: bool,
) -> ThinWalls | None:
    """Return the solids that are too thin for the grid; None if there are none.

    Particles meet them as exact shapes.

    One that moves must be thicker than what it may go in a step.

    A solid is too thin below THIN cells; one that moves below max(THIN, cfl + STRIDE_ROOM) cells.
    With `crossing` the limit is BARRIER cells, for rigid bodies SHEET cells.

    Args:
        scene: the scene.
        grid: its grid.
        placed: its solids.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`; those of periodic axes are
            added.
        crossing: only those that are too thin to cut cells; of rigid bodies only sheets, since
            other bodies are pushed by the pressure through the cells that they cut.
    """
    # Thickness limit by whether solids move.
    walls = {False: THIN, True: max(THIN, scene.time.cfl + STRIDE_ROOM)}

    def suits(solid: PlacedSolid) -> bool:
        shape, dx, is_body = solid.geometry, grid.spacing, isinstance(solid.motion, BodyMotion)
        if crossing and is_body and not is_sheet(shape, SHEET * dx, grid.dimension):
            return False
        most = walls[solid.motion is not None]
        if crossing:
            most = SHEET if is_body else BARRIER
            if is_body and is_thin_in_parts(shape, most * dx, grid.device):
                return False
        fills = solid.motion is None and fills_cells(shape, grid, DEEP)
        return is_thin(shape, most * dx, grid.device) and not fills

    thin = [suits(solid) for solid in placed]
    if not any(thin):
        return None
    ends = side_bits(periodic_sides(scene.endless))
    in_parts = [
        crossing
        and is_one
        and is_thin_in_parts(solid.geometry, BARRIER * grid.spacing, grid.device)
        for solid, is_one in zip(placed, thin, strict=True)
    ]
    return ThinWalls(
        grid,
        placed,
        thin,
        open_sides | ends,
        scene.endless,
        in_parts=in_parts,
        thickness=BARRIER * grid.spacing,
    )


@dataclass(frozen=True)
class GridComponents:
    """Parts of a simulation that belong to one grid, and are made again for another.

    Attributes:
        boundary: solids and the domain's walls.
        sources: inflow of material.
        band: the narrow band of particles; None if they are everywhere.
        solids: the solids as the material's own solver uses them, if it uses another form.
    """

    boundary: Boundary
    sources: Sources | None = None
    band: NarrowBand | None = None
    solids: SandSolids | None = None


def make_spray(
    scene: ParticleScene, coverage: DomainWindow | None, placed: Sequence[PlacedSolid]
) -> Spray | None:
    """Return the spray for lone particles without a grid; None if not possible.

    The scene needs a grid that follows the material, and no surface mesh.
    """
    if (
        coverage is None
        or not (coverage.active and scene.flies)
        or scene.output.surface
        or scene.output.volume
    ):
        return None
    return Spray(
        coverage.domain,
        placed,
        side_bits(scene.domain.open),
        keeps=scene.carried_numbers(()) is not None,
        ids=scene.output.ids,
    )


def make_flights(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary
) -> BallisticFragments | None:
    """Return the airborne bodies, which conserve momenta; None if the scene has none."""
    return (
        BallisticFragments(grid, boundary, coheres=scene.coheres, settles=scene.speeds_up)
        if scene.flies
        else None
    )


def make_surface_mesh(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary
) -> SurfaceMesh | None:
    """Return the surface mesh of the particles, if the scene's output has one."""
    if not scene.output.surface:
        return None
    return SurfaceMesh(
        grid,
        per_axis=scene.particles.per_axis,
        resolution=scene.output.surface_resolution,
        smoothing=scene.output.surface_smoothing,
        obstacles=SurfaceObstacles(
            boundary.base, boundary.distance, boundary.moves, boundary.shapes, grid.barriers
        )
        if scene.solid
        else None,
    )


def make_particle_volume(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary
) -> ParticleVolume | None:
    """Return the measurement of the material's volume, if the scene's output has it."""
    if not scene.output.volume:
        return None
    return ParticleVolume(
        grid,
        boundary,
        particles_a_cell=scene.particles.per_axis**grid.dimension,
        with_velocity=scene.output.volume_format == "vdb",
    )


def seed_materials(
    scene: ParticleScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    folder: Path,
    without: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Fill the scene's materials with points in this process's cells; collective.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        folder: folder of the files that it names.
        without: cells that get no points, bool of shape (nz, ny, nx).

    Returns:
        Positions [m], float32, shape (n, 3); the entry of `scene.materials()` that each belongs to,
        shape (n,); warnings.

    Raises:
        ValueError: a material has no particle on any rank; on all ranks.
    """
    key, materials = scene.materials()
    geometries = [material.to_geometry(folder, scene.dimension) for material in materials]
    regions = [region_of(geometry, boundary, grid.device) for geometry in geometries]
    names = [f"{key}[{number}] ({material.shape})" for number, material in enumerate(materials)]
    notes: list[str] = []
    for name, geometry in zip(names, geometries, strict=True):
        notes += placement_notes(geometry, name, grid)
    settings = scene.particles
    open_cells = grid.interior(boundary.base.numpy()) != wl.SOLID
    # A cell whose center lies in a thin solid may have room beside it.
    if grid.barriers is not None:
        open_cells |= grid.interior(grid.barriers.near.numpy()) > 0
    if without is not None:
        open_cells &= ~without
    grid.part.keep_own(open_cells)
    position, owner = seed_regions(
        grid,
        boundary,
        geometries,
        regions,
        open_cells,
        per_axis=settings.per_axis,
        jitter=settings.jitter,
        random_seed=settings.seed,
    )
    counts = grid.part.ranks.sum(np.bincount(owner, minlength=len(geometries)))
    for name, count in zip(names, counts, strict=False):
        if count == 0 and without is None:
            raise ValueError(
                f"{name} holds no particle: it is too small for cells of {grid.spacing:.4g} m, or "
                "lies in solids, outside the domain or in "
                f"an earlier {key}"
            )
    return position, owner, notes


def make_particles(
    scene: ParticleScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    folder: Path,
    without: np.ndarray | None = None,
) -> tuple[Particles, list[str]]:
    """Return the particles of all materials, as of `seed_materials`, and warnings.

    Arguments as of `seed_materials`.

    Raises:
        ValueError: a material has no particle.
    """
    position, owner, notes = seed_materials(scene, grid, boundary, folder, without)
    velocity = start_velocities(scene).astype(np.float32)[owner]
    affine, kept = scene.particles.transfer == "apic", kept_by(scene, owner)
    # Transfers near barriers, and of what particles carry, gather the particles of cells.
    indexed = True if grid.barriers is not None or kept is not None else None
    ids = scene.output.ids
    particles = Particles(
        grid, position, velocity, affine=affine, kept=kept, ids=ids, indexed=indexed
    )
    return particles, notes


def kept_by(scene: ParticleScene, owner: np.ndarray) -> np.ndarray | None:
    """Return the number that particles carry, shape (n,), by material.

    Returns None if they carry none.
    """
    kept = scene.carried_numbers(scene.materials()[1])
    return None if kept is None else np.array([*kept, 1.0], dtype=np.float32)[owner]


def start_velocities(scene: ParticleScene) -> np.ndarray:
    """Return the velocity of each material at the start [m/s], shape (materials, 3).

    One material at rest if there is none.
    """
    return np.array(
        [_vector(material.velocity or [0.0, 0.0]) for material in scene.materials()[1]]
        or [_vector([0.0, 0.0])]
    )


def make_sources(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, folder: Path
) -> Sources | None:
    """Return the scene's sources, if it has any; collective.

    Raises:
        ValueError: a source has no open cell.
    """
    if not scene.source:
        return None
    carried = scene.carried_numbers(scene.source)
    sources = [
        Source(
            name=f"source[{number}] ({source.shape})",
            contains=_inside(source.to_geometry(folder, scene.dimension), grid.device),
            velocity=np.array(_vector(source.velocity)),
            start=source.begin,
            stop=np.inf if source.stop is None else source.stop,
            kept=None if carried is None else carried[number],
        )
        for number, source in enumerate(scene.source)
    ]
    settings = scene.particles
    return Sources(
        grid,
        boundary,
        sources,
        per_axis=settings.per_axis,
        jitter=settings.jitter,
        random_seed=settings.seed,
    )


def make_outlets(scene: ParticleScene, grid: StaggeredGrid, folder: Path) -> Outlets | None:
    """Return the scene's drains and open sides, if it has any."""
    if not scene.drain and not scene.domain.open:
        return None
    drains = [
        Drain(
            drain.to_geometry(folder, scene.dimension),
            drain.begin,
            np.inf if drain.stop is None else drain.stop,
        )
        for drain in scene.drain
    ]
    return Outlets(grid, drains, side_bits(scene.domain.open))


def make_narrow_band(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, folder: Path
) -> NarrowBand | None:
    """Return the narrow band of deep material, None if it is off; collective."""
    settings, particles = scene.particles.narrow_band, scene.particles
    if settings is None:
        return None
    return NarrowBand(
        grid,
        boundary,
        width=settings.width,
        per_axis=particles.per_axis,
        jitter=particles.jitter,
        random_seed=particles.seed,
        keep=_exchange_cells(scene, grid, folder),
    )


def start_band(
    scene: ParticleScene,
    grid: StaggeredGrid,
    boundary: Boundary,
    folder: Path,
    band: NarrowBand | None,
) -> np.ndarray | None:
    """Put the deep material into a narrow band, and return its cells.

    bool of shape (nz, ny, nx); None without a band.
    """
    if band is None:
        return None
    regions = [
        region_of(material.to_geometry(folder, scene.dimension), boundary, grid.device)
        for material in scene.materials()[1]
    ]
    open_cells = grid.interior(boundary.base.numpy()) != wl.SOLID
    position, number = seed(grid, regions, open_cells, per_axis=1, jitter=0.0, random_seed=0)
    i, j, k = ((position / grid.spacing).astype(int) - np.array(grid.origin)).T
    owner = np.full(open_cells.shape, -1)
    owner[k, j, i] = number
    return band.start(owner, start_velocities(scene))


def _exchange_cells(scene: ParticleScene, grid: StaggeredGrid, folder: Path) -> np.ndarray | None:
    """Return a mask of stored cells near a source or a drain; None without both.

    A cell is near if the signed distance of its center from a source or a drain is less than dx
    [m].
    """
    regions: list[Shape] = [*scene.source, *scene.drain]
    if not regions:
        return None
    near = np.zeros(grid.shape, dtype=bool)
    K, J, I = np.meshgrid(*(np.arange(1, n + 1) for n in grid.counts[::-1]), indexing="ij")
    centers = grid.to_world(
        np.stack([I.ravel(), J.ravel(), K.ravel()], axis=1) + np.array(grid.origin) + 0.5
    )
    if grid.dimension == 2:
        centers[:, 2] = 0.0
    points = wp.array(centers.astype(np.float32), dtype=wp.vec3, device=grid.device)
    distance = wp.zeros(len(centers), dtype=wp.float32, device=grid.device)
    for region in regions:
        region.to_geometry(folder, scene.dimension).signed_distance(points, distance)
        near[1:-1, 1:-1, 1:-1] |= (distance.numpy() < grid.spacing).reshape(grid.counts[::-1])
    return near


def make_reseeding(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary
) -> Reseeding | None:
    """Return the reseeding of particles; None if the scene has none."""
    settings = scene.particles.reseed
    if settings is None:
        return None
    at_rest = scene.particles.per_axis**grid.dimension
    least, most = scene.particles.reseed_range(grid.dimension)
    return Reseeding(
        grid, boundary, least=least, most=most, particles_a_cell=at_rest, every=settings.every
    )


def make_density_correction(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary, *, most: float | None = None
) -> DensityCorrection:
    """Return the density correction of a scene.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
        most: largest density of a cell, relative to rest; None: that of the scene.

    Raises:
        ValueError: the scene has none.
    """
    settings = scene.correction
    if settings is None:
        raise ValueError("density_correction.every = 0: must be at least 1")
    solver = wl.default_chain(wl.ProjectedMultigrid(precision=scene.solver.precision))
    return DensityCorrection(
        grid,
        boundary,
        solver,
        particles_a_cell=scene.particles.per_axis**grid.dimension,
        max_density=most if most is not None else settings.largest(scene.particles.per_axis),
        every=settings.every,
        gain=scene.correction_gain,
        even=scene.keeps_volume,
        tolerance=settings.tolerance,
    )


def make_density_monitor(
    scene: ParticleScene, grid: StaggeredGrid, boundary: Boundary
) -> DensityMonitor | None:
    """Return the monitor that decides when to correct the density.

    None if the scene sets the steps, or if there is no correction.

    Args:
        scene: the scene.
        grid: its grid.
        boundary: its solids.
    """
    settings = scene.correction
    if scene.corrects_steadily or settings is None:
        return None
    count = scene.particles.per_axis
    return DensityMonitor(
        grid, boundary, particles_a_cell=count**grid.dimension, max_density=settings.largest(count)
    )


def _body(
    solid: SolidProperties, geometry: Geometry, name: str, friction: float, dimension: int
) -> RigidBody:
    """Return the rigid body of a solid."""
    try:
        properties = mass_properties(geometry, dimension, mass=solid.mass, density=solid.density)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    spin = np.radians(solid.angular_velocity or [0.0] * 3)
    return RigidBody(
        properties,
        name=name,
        friction=friction,
        restitution=solid.restitution,
        velocity=np.array(_vector(solid.velocity or [0.0, 0.0])),
        angular_velocity=np.array([0.0, 0.0, *spin][-3:]),
    )


def _vector(entries: list[float]) -> list[float]:
    """Return a vector of two or three entries as one of three entries."""
    return [*entries, 0.0][:3]


def _inside(geometry: Geometry, device: wp.Device) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that tests which points lie in a geometry."""
    return lambda points: inside([geometry], points, device=device)


def region_of(
    geometry: Geometry, boundary: Boundary, device: wp.Device
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that tests which points lie in a geometry and outside solids."""

    def holds(points: np.ndarray) -> np.ndarray:
        result = inside([geometry], points, device=device)
        result[result] = boundary.admits(points[result])
        return result

    return holds
