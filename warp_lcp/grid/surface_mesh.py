"""Surface mesh of particles for pictures.

Closed, smooth over the particles, flat along walls; single drops and thin sheets are kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid import surface_mesh_kernels as kernels
from warp_lcp.grid.barriers import Barriers
from warp_lcp.grid.extrapolate import extrapolate, weighted_kernel
from warp_lcp.grid.level_set_kernels import BINOMIAL, SCATTER
from warp_lcp.grid.marching_cubes import DeviceMesh, MarchingCubes
from warp_lcp.grid.mesh_smoothing import ON_SOLID, TOUCHING
from warp_lcp.grid.mesh_smoothing import smooth as smooth_mesh
from warp_lcp.grid.mesh_walls import MeshWalls, fit_to_walls
from warp_lcp.grid.particle_loops import MARGIN, launch, scatter, touched_planes
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.transfer import faces_to_particles, particles_to_faces

# Particle distances. Standard deviation of the narrowest kernel without gaps, the quadratic
# B-spline.
SHARPEST = 0.5
EXTENDED = 2  # layers to which the distance is extrapolated into solids, and the velocity into air
# Largest smoothed share that a lone particle is assumed to have. Kernels as narrow as particles
# cannot distinguish it from others.
CROWD = 0.1
# A layer of evenly spread particles keeps its thickness if its narrow kernels are amplified by
# 1 - 2 s, with s the smoothed share in it. Uneven particles need more, or there are holes.
UNEVEN = 1.6
SAMPLED = 0.25  # variance that interpolation by quadratic B-splines adds [lattice cells^2]
# Standard deviation of the kernel behind the curvature: times that of the share, at least 2.5
# particle distances. Otherwise bumps of particles grow.
WIDER, WIDE = 5.0 / 3.0, 2.5
# Curvatures, times the spread. Below the first a surface is taken for plane: five times the RMS
# curvature of a stirred pool. The other is that of a ball of 3/4 of the spread.
BEADS, SHARPEST_BALL = 0.15, 1.5
# Rounds of smoothing the mesh: facets as large as lattice cells are gone, and 0.1 % of the volume.
ROUNDS = 3
SEEN = 2 * ROUNDS + 1  # lattice cells around a cell that its smoothed points depend on
OUTSIDE = 1.0  # value outside of the surface, in the ring at cuts
# Bytes of a lattice cell; and more where there are solids.
MESH_LATTICE_BYTES, MESH_SOLID_BYTES = 16, 13
MESH_POINT_BYTES = 80  # bytes of a point, with its triangles and its velocity


def surface_layers(parts: int) -> int:
    """Return the number of layers of ghost cells that a surface needs.

    Args:
        parts: lattice cells along the edge of a cell.
    """
    return -(-SEEN // parts) + 1


@dataclass(frozen=True)
class SurfaceObstacles:
    """Solids inside the domain.

    Attributes:
        base: int8, SOLID in cells that hold no material.
        distance: signed distance at the cells' low corners [cells], float32, > 0 in the open; None:
            solids are whole cells.
        moves: whether they may be somewhere else each time.
        shapes: returns the solids' shapes where they are; the surface then ends
            `mesh_walls.OVERLAP` inside them. None: it ends where `distance`, or the cells, have the
            walls.
        thin: solids that `distance` does not have, as they are thinner than cells; None if there
            are none.
    """

    base: wp.array
    distance: wp.array | None
    moves: bool
    shapes: Callable[[], Sequence[Geometry]] | None = None
    thin: Barriers | None = None


@dataclass(frozen=True)
class FilledInterior:
    """Full region without particles (inside a narrow band).

    Attributes:
        depth: below the surface [cells], float32, one value a cell.
        least: cells at least so deep are full.
        base: int8, SOLID in cells that hold no material.
    """

    depth: wp.array
    least: float
    base: wp.array


class SurfaceMesh:
    """Surface mesh around particles.

    The density of the particles is computed on a lattice finer than the grid, smoothed over
    `smoothing` particle distances, and divided by the open part of the kernel beside solids and
    walls: the filled share. The surface is where this share is 1/2. It is unbiased for a plane, and
    flat at walls that the plane meets at a right angle; where it is curved, it is moved back by as
    much as smoothing has moved it, see the kernel `restore`. In drops, filaments and sheets too
    thin for the kernel, narrow kernels of the particles are added to the share. Their weight grows
    as the fullness falls, see the kernel `boost`, so that a drop of one particle remains. The
    surface is cut along walls, solids and the domain's sides, open and periodic ones included.

    Args:
        grid: the grid.
        per_axis: particles along the edge of a full cell at rest.
        resolution: lattice cells along the edge of a cell; default: as many as particles, the
            finest useful resolution.
        smoothing: standard deviation of the kernel [particle distances], at least that of the
            narrow one, 1/2.
        obstacles: solids; None if there are only the domain's walls.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        *,
        per_axis: int,
        resolution: int | None = None,
        smoothing: float = 1.5,
        obstacles: SurfaceObstacles | None = None,
    ) -> None:
        parts = per_axis if resolution is None else resolution
        if per_axis < 1 or parts < 1:
            raise ValueError(
                f"per_axis = {per_axis}, resolution = {resolution}: must be at least 1"
            )
        if not (math.isfinite(smoothing) and smoothing >= SHARPEST):
            raise ValueError(
                f"smoothing = {smoothing}: must be at least {SHARPEST} particle distances"
            )
        self.grid, self.obstacles, self._parts = grid, obstacles, parts
        self.lattice = grid.refined(parts)
        distance = parts / per_axis  # distance of particles at rest, in lattice cells
        self._each = distance**grid.dimension
        self._thin_passes, self._passes, wide_passes = (
            max(0, round(2.0 * ((sigma * distance) ** 2 - 0.25)))
            for sigma in (SHARPEST, smoothing, max(WIDER * smoothing, WIDE))
        )
        self._more_passes = wide_passes - self._passes
        self._spread = math.sqrt(0.25 + 0.5 * self._passes)
        # A drop of one particle has at least 2^-dimension of its narrow kernel on one lattice node.
        # That value is scaled to the share 1/2.
        self._most = 2.0 ** (grid.dimension - 1)
        alone = min(
            self._each * (2.0 * math.pi * (self._spread**2 + SAMPLED)) ** (-0.5 * grid.dimension),
            CROWD,
        )
        # Smoothed share in a sheet of one layer.
        layer = min(distance / (math.sqrt(2.0 * math.pi) * self._spread), 0.5)
        self._gain = max(
            self._most / (math.sqrt(kernels.THIN / alone) - 1.0),
            UNEVEN * (1.0 - 2.0 * layer) / (math.sqrt(kernels.THIN / layer) - 1.0),
        )
        self._fields = [self.lattice.field() for _ in range(4)]
        self._room = self.lattice.field() if obstacles else None
        self._capacity = self.lattice.field() if obstacles else None
        self._wide_capacity = self.lattice.field() if obstacles else None
        self._known = self.lattice.field(wp.int8) if obstacles else None
        self._cubes = MarchingCubes(self.lattice)
        self._placed = False
        # Cells whose triangles this rank keeps; None for all.
        self._kept = self._lattice_cells() if grid.part.shared else None

    def find(self, position: wp.array, interior: FilledInterior | None = None) -> DeviceMesh:
        """Return the surface around particles, ghosts among them; collective.

        On CUDA the last bits may differ between runs, as do sums over particles.

        Args:
            position: [m], shape (n,), vectors; z = 0 in 2-D.
            interior: full region without particles.
        """
        lattice = self.lattice
        if self.obstacles is not None and (self.obstacles.moves or not self._placed):
            self._place(self.obstacles)
        raw, first, second, free = self._fields
        raw.zero_()
        scatter(
            SCATTER,
            lattice,
            position,
            touched_planes(lattice, position),
            each=self._each,
            density=raw,
        )
        self._mirror(raw, fold=True)
        if interior is not None:
            inputs = [
                lattice.planes,
                self._parts,
                interior.least,
                interior.depth,
                interior.base,
                raw,
            ]
            lattice.domain.launch(kernels.fill_kernel, inputs)
            self._mirror(raw)
        smooth = self._smoothed(raw, first, second, self._passes)
        thin, phi = (field for field in (raw, first, second) if field is not smooth)
        thin.zero_()
        launch(
            kernels.BOOST,
            len(position),
            lattice,
            position=position,
            each=self._each,
            smooth=smooth,
            capacity=self._capacity,
            thin=thin,
            gain=self._gain,
            most=self._most,
            spread=math.sqrt(self._spread**2 + SAMPLED),
        )
        self._mirror(thin, fold=True)
        if self._thin_passes:
            done = self._smoothed(thin, phi, thin, self._thin_passes)
            thin, phi = done, phi if done is thin else thin
        window = lattice.everywhere
        window.run(
            kernels.DISTANCE,
            phi=phi,
            known=self._known,
            smooth=smooth,
            thin=thin,
            capacity=self._capacity,
            planes=lattice.planes,
            spread=self._spread,
        )
        wide = self._smoothed(smooth, free, smooth, self._more_passes)
        self._restore(phi, thin, wide)
        if self._room is not None:
            extrapolate(window, self._known, phi, EXTENDED)
            window.run(kernels.CARVE, room=self._room, phi=phi)
        return self._mesh(phi, wide.view(wp.int32))

    def _restore(self, phi: wp.array, thin: wp.array, wide: wp.array) -> None:
        """Move a curved surface back by as much as smoothing has moved it.

        Args:
            phi: distance [lattice cells] (updated).
            thin: share of the narrow kernels.
            wide: the smoothed share, smoothed further.
        """
        self.lattice.domain.run(
            kernels.RESTORE,
            phi=phi,
            thin=thin,
            wide=wide,
            capacity=self._wide_capacity,
            planes=self.lattice.planes,
            variance=self._spread**2,
            beads=BEADS / self._spread,
            most=SHARPEST_BALL / self._spread,
        )

    def _lattice_cells(self) -> Window:
        """Return the lattice cells that have their low node in this rank's box.

        Cells with their low node in the ring beyond the domain's low sides are included.
        """
        lattice, part = self.lattice, self.grid.part
        each = np.array([self._parts] * 2 + [self._parts if lattice.dimension == 3 else 1])[::-1]
        low, high = (
            (np.array(corner) - 1) * each + 1 for corner in (part.owned.low, part.owned.high)
        )
        for axis in range(lattice.dimension):
            low[2 - axis] -= part.first[axis] == 0
        return Window.of(low.tolist(), high.tolist(), lattice.device)

    def _mesh(self, phi: wp.array, number: wp.array) -> DeviceMesh:
        """Return the smoothed surface phi = 0, on ranks that of this rank's cells.

        `number` is scratch memory.
        """
        if self._kept is None:
            return self._whole_mesh(phi, number)
        part, lattice = self.grid.part, self.lattice
        part.fill(phi, parts=self._parts)
        for axis in range(lattice.dimension):
            for side in range(2):
                if part.cuts >> 2 * axis + side & 1:
                    phi.transpose((2 - axis, *(n for n in range(3) if n != 2 - axis)))[-side].fill_(
                        OUTSIDE
                    )
        mesh = self._whole_mesh(phi, number)
        kept = self._cubes.corners(phi, number, self._kept).numpy()
        used, corners = np.unique(kept, return_inverse=True)
        points = wp.array(mesh.points.numpy()[used], dtype=wp.vec3, device=lattice.device)
        return DeviceMesh(
            points, wp.array(corners.reshape(kept.shape), dtype=wp.int32, device=lattice.device)
        )

    def _whole_mesh(self, phi: wp.array, number: wp.array) -> DeviceMesh:
        """Return the smoothed surface phi = 0 of all lattice cells."""
        mesh = self._cubes.contour(phi, number)
        flags = smooth_mesh(mesh, self.lattice, self._room, ROUNDS)
        shapes = (
            self.obstacles.shapes()
            if self.obstacles is not None and self.obstacles.shapes is not None
            else ()
        )
        if shapes and len(mesh.points):
            self._fit(mesh, flags.numpy(), shapes)
        return mesh

    def _fit(self, mesh: DeviceMesh, flags: np.ndarray, shapes: Sequence[Geometry]) -> None:
        """Move the points on solids onto the solids' shapes.

        Points on a side of the domain move along that side.

        Points are in m, `points` in cells and `place` in lattice cells.
        """
        spacing, lattice = self.grid.spacing, self.lattice
        points = mesh.points.numpy() / spacing
        place = points * (spacing / lattice.spacing)
        fixed = (place < TOUCHING) | (place > np.array(lattice.domain_counts) - TOUCHING)
        fixed[:, lattice.dimension :] = True
        walls = MeshWalls(shapes, spacing, lattice.dimension, lattice.device)
        on_solid = (flags & ON_SOLID) > 0
        fitted = fit_to_walls(points, mesh.corners.numpy(), on_solid, fixed, walls)
        # Along a side a point could leave the domain beyond a corner.
        size = np.asarray(lattice.extent)
        mesh.points.assign(np.clip(fitted * spacing, 0.0, size).astype(np.float32))

    def _place(self, obstacles: SurfaceObstacles) -> None:
        """Compute the open share of each kernel beside the solids."""
        lattice, domain = self.lattice, self.lattice.domain
        room, capacity = self._room, self._capacity
        if obstacles.distance is not None:
            domain.run(
                kernels.ROOM,
                distance=obstacles.distance,
                out=room,
                planes=lattice.planes,
                parts=self._parts,
            )
        else:
            domain.launch(
                kernels.whole_cell_room_kernel, [lattice.planes, self._parts, obstacles.base, room]
            )
        if obstacles.thin is not None:
            obstacles.thin.limit_room(lattice, room)
        self._mirror(room)
        lattice.everywhere.launch(kernels.open_share_kernel, [room, capacity])
        passes = self._passes + 1  # a cell's own extent widens the kernel by about as much
        first, second = self._fields[:2]
        wp.copy(capacity, self._smoothed(capacity, first, second, passes))
        wide = self._smoothed(capacity, first, second, self._more_passes)
        wp.copy(self._wide_capacity, wide)
        self._placed = True

    def _smoothed(
        self, source: wp.array, first: wp.array, second: wp.array, passes: int
    ) -> wp.array:
        """Return the source after binomial passes (1, 2, 1)/4.

        The field is mirrored at the domain's sides. The result is in one of the two scratch fields.
        """
        for _ in range(passes):
            self.lattice.everywhere.run(
                BINOMIAL, planes=self.lattice.planes, source=source, out=first
            )
            self._mirror(first)
            source, first, second = first, second, first
        return source

    def _mirror(self, field: wp.array, *, fold: bool = False) -> None:
        """Extend a field beyond the domain's sides by mirroring.

        With `fold`, values in the ring are first added to the cells beside it.
        """
        for axis in range(self.lattice.dimension):
            lines = field.transpose((*(n for n in range(3) if n != 2 - axis), 2 - axis))
            wp.launch(
                kernels.mirror_kernel, lines.shape[:2], [fold, lines], device=self.lattice.device
            )
        self.grid.part.fill(field, parts=self._parts)


def faces_from_particles(
    grid: StaggeredGrid,
    position: wp.array,
    velocity: wp.array,
    fields: list[wp.array],
    weights: list[wp.array],
) -> None:
    """Transfer velocity from particles to the faces, and extrapolate.

    By `EXTENDED` layers.

    Args:
        grid: the grid.
        position: [m], shape (n,), vectors.
        velocity: [m/s], shape (n,), vectors.
        fields: velocity of each component on the faces [m/s] (written).
        weights: a field a component (written), scratch memory.
    """
    particles_to_faces(grid, position, velocity, [], fields, weights)
    grid.part.fill(*fields, *weights)
    known = grid.field(wp.int8)
    for field, weight in zip(fields, weights, strict=True):
        grid.everywhere.launch(weighted_kernel, [0.0, weight, known])
        extrapolate(grid.everywhere, known, field, EXTENDED)


def sample(grid: StaggeredGrid, fields: list[wp.array], points: wp.array) -> wp.array:
    """Return the velocity at points [m/s], wp.vec3, shape (m,).

    Args:
        grid: the grid.
        fields: velocity of each component on the faces [m/s].
        points: [m], shape (m,), vectors.
    """
    sampled, within = (wp.zeros(len(points), dtype=wp.vec3, device=grid.device) for _ in range(2))
    # Particles may come as near to the far sides as this.
    size = wp.vec3(*((n - MARGIN) * grid.spacing for n in grid.domain_counts))
    wp.launch(kernels.clamp_kernel, len(points), [points, size, within], device=grid.device)
    faces_to_particles(grid, fields, within, sampled, [])
    return sampled
