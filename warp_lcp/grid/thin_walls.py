"""Thin solids, which particles meet as exact shapes.

A grid's cells cannot separate the two sides of such a solid. Distances at the nodes of a grid do
not see a wall between the nodes, and a particle that a step takes to the other side of it is in the
open. Therefore the path of each particle within a step is traced in the frame of each solid, from
the solid's old place to its new one. Where the path crosses the surface the particle stops and
slides on, at the true surface and on its own side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
import warp as wp

from warp_lcp.grid import thin_walls_kernels as kernels
from warp_lcp.grid.cell_kernel import launch_list
from warp_lcp.grid.motion import Motion, Motions, RigidMotion
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.signed_distance import Box, Capsule, Geometry, Sphere, TriangleMesh, Union
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid
from warp_lcp.kernels.launch_graph import copy
from warp_lcp.kernels.types import DeviceArray

THIN = 3.0  # cells: particles meet thinner solids as exact shapes
SHEET = 1.0  # cells: rigid bodies of at least this thickness cut cells
STRIDE_ROOM = 0.5  # cells by which a moving solid must be thicker than its largest step
# Cells by which shapes are enlarged, so that there is no crack between shapes that touch.
SKIN = 1e-4
THIN_SHARE = 1e-3  # least share of a mesh's surface that is thin, for the mesh to be thin
# Share of a mesh's surface above which the mesh is a shell: thin everywhere but at its rims.
SHELL_SHARE = 0.8
# Cells around a group's shapes that belong to their box: more than particles keep off.
BOX_ROOM = 0.05
COST = 32  # work of a particle, in cells of a usual pass
# Cells that material near moving thin solids may go in a step, in the frame of the solids.
RELATIVE_WAY = 1.0
WAY_ROUNDING = 1e-3  # relative excess of the way that does not shorten a step
SHORTENINGS = 12  # most times that a step is shortened, to half its length at least each time
SimpleShape = Box | Sphere | Capsule | TriangleMesh


def parts_of(geometry: Geometry) -> list[Geometry]:
    """Return the shapes of which a region is the union."""
    return (
        [part for of in geometry.parts for part in parts_of(of)]
        if isinstance(geometry, Union)
        else [geometry]
    )


def is_thin(geometry: Geometry, thickness: float, device: wp.Device) -> bool:
    """Return whether a part of a solid is thinner than `thickness` [m].

    Half spaces and inverted shapes are not thin.
    """
    return any(_is_thin(part, thickness, device) for part in parts_of(geometry))


def _is_thin(shape: Geometry, thickness: float, device: wp.Device) -> bool:
    if not isinstance(shape, SimpleShape) or shape.invert:
        return False
    if isinstance(shape, TriangleMesh):
        return shape.thin_fraction(thickness, device) > THIN_SHARE
    least = shape.half_extents().min() if isinstance(shape, Box) else shape.radius
    return bool(2.0 * least * shape.placement.scale < thickness)


def is_thin_in_parts(geometry: Geometry, thickness: float, device: wp.Device) -> bool:
    """Return whether only a part of each thin mesh is thinner than `thickness` [m].

    Such a solid has a thick body and thin limbs. Boxes, balls and capsules are thin everywhere.
    """
    thin = [part for part in parts_of(geometry) if _is_thin(part, thickness, device)]
    return bool(thin) and all(
        isinstance(part, TriangleMesh) and part.thin_fraction(thickness, device) <= SHELL_SHARE
        for part in thin
    )


def is_sheet(geometry: Geometry, thickness: float, dimension: int) -> bool:
    """Return whether all parts of a solid are sheets.

    Meshes are sheets, and boxes thinner than `thickness` [m] along one axis only.
    """
    return all(_is_sheet(part, thickness, dimension) for part in parts_of(geometry))


def _is_sheet(shape: Geometry, thickness: float, dimension: int) -> bool:
    if not isinstance(shape, Box):
        return isinstance(shape, TriangleMesh)
    sides = 2.0 * shape.half_extents()[:dimension] * shape.placement.scale
    return bool(np.count_nonzero(sides < thickness) <= 1)


def fills_cells(geometry: Geometry, grid: StaggeredGrid, error: float) -> bool:
    """Return whether a solid consists of boxes whose sides lie on faces of cells.

    The sides may be off by `error` [cells].
    """
    return all(_fills_cells(part, grid, error) for part in parts_of(geometry))


def _fills_cells(shape: Geometry, grid: StaggeredGrid, error: float) -> bool:
    if not isinstance(shape, Box) or not np.allclose(
        np.abs(shape.placement.rotation).max(axis=0), 1.0, rtol=0.0, atol=1e-12
    ):
        return False
    bounds = shape.bounds()
    assert bounds is not None, "the box is not inverted"
    ends = bounds[:, : grid.dimension] / grid.spacing
    return bool((np.abs(ends - np.round(ends)) <= error).all())


class ThinWalls:
    """Thin solids of a scene as exact shapes, and their motion within a step.

    Args:
        grid: the grid; any part of the domain's.
        solids: solids of the scene; numbers of walls are 1 + s.
        thin: numbers of the thin ones.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: particles may leave the domain
            there, for good or to the other end of an axis.
        in_parts: whether each solid is thin in parts only; none if empty.
        thickness: the solids are thin where they are thinner [m]; used with `in_parts`.
        endless: periodic axes; solids near one side have images beyond the other.

    Attributes:
        numbers: numbers of these solids.
        in_parts: numbers of those that are thin in parts only.
        everywhere: numbers of the others.
        has_meshes: whether one of the shapes is a mesh.
        moves: whether one of them moves.
        thin_shapes: the shapes, of the solids in `in_parts` only the thin parts of their surface.
        least: smallest coordinates of particles [m], -inf where they may leave.
        most: largest coordinates, likewise.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        solids: Sequence[PlacedSolid],
        thin: Sequence[bool],
        open_sides: int,
        endless: Sequence[int] = (),
        in_parts: Sequence[bool] = (),
        thickness: float = 0.0,
    ) -> None:
        self.grid = grid
        self.numbers = [number for number, is_one in enumerate(thin, start=1) if is_one]
        self.in_parts = [number for number, is_one in enumerate(in_parts, start=1) if is_one]
        self.everywhere = [number for number in self.numbers if number not in self.in_parts]
        self.moves = any(solids[number - 1].motion is not None for number in self.numbers)
        groups: list[tuple[Motion | None, list[tuple[int, Geometry]]]] = []
        for number in self.numbers:
            solid = solids[number - 1]
            of = next((shapes for motion, shapes in groups if _alike(motion, solid.motion)), None)
            if of is None:
                of = []
                groups.append((solid.motion, of))
            of += [(number, part) for part in parts_of(solid.geometry)]
        self._motions = Motions([motion for motion, _ in groups if motion is not None])
        shapes = [
            _shape(number, part, grid.device, SKIN * grid.spacing)
            for _, of in groups
            for number, part in of
        ]
        # Parts of the solids, which own the meshes on the device.
        self._geometries = [part for _, of in groups for _, part in of]
        ends = np.cumsum([0, *(len(of) for _, of in groups)])
        self.has_meshes = any(isinstance(part, TriangleMesh) for part in self._geometries)
        self._groups = list[kernels.ThinGroup]()
        self._moving: list[tuple[int, int, np.ndarray]] = []
        moving = 0
        for (motion, _), (first, end) in zip(groups, pairwise(ends), strict=True):
            for image in _images(grid, endless):
                group = kernels.ThinGroup()
                group.first, group.end = int(first), int(end)
                group.turn = group.turn_before = wp.mat33d(np.eye(3))
                group.shift = group.shift_before = wp.vec3d(*image)
                if motion is not None:
                    self._moving.append((len(self._groups), moving, image))
                self._find_box(group)
                self._groups.append(group)
            moving += motion is not None
        self.shapes = wp.array(shapes, dtype=kernels.ThinShape, device=grid.device)
        self.thin_shapes, self._thin_parts = self._only_thin(shapes, thickness)
        self.groups = wp.array(self._groups, dtype=kernels.ThinGroup, device=grid.device)
        margin = MARGIN * grid.spacing
        low, high = np.full(3, margin), grid.extent - margin
        for axis in range(3):
            low[axis] = (
                low[axis] if axis < grid.dimension and not open_sides >> (2 * axis) & 1 else -np.inf
            )
            high[axis] = (
                high[axis]
                if axis < grid.dimension and not open_sides >> (2 * axis + 1) & 1
                else np.inf
            )
        self._margin, self.least, self.most = wp.float64(margin), low, high
        self._start = wp.empty(0, dtype=wp.vec3, device=grid.device)
        self._speed = wp.empty(0, dtype=wp.float64, device=grid.device)
        self.place(0.0)
        self.place(0.0)

    def _only_thin(
        self, shapes: Sequence[kernels.ThinShape], thickness: float
    ) -> tuple[DeviceArray, list[wp.Mesh]]:
        """Return the shapes with thin parts of meshes, and these meshes.

        Shapes are those of all solids, in the order of `_geometries`.
        """
        if not self.in_parts:
            return self.shapes, []
        device, parts, result = self.grid.device, list[wp.Mesh](), list[kernels.ThinShape]()
        for shape, geometry in zip(shapes, self._geometries, strict=True):
            if shape.solid not in self.in_parts:
                result.append(shape)
            elif (
                isinstance(geometry, TriangleMesh)
                and geometry.thin_fraction(thickness, device) > THIN_SHARE
            ):
                parts.append(geometry.thin_part(thickness, device))
                result.append(_shape(shape.solid, geometry, device, 0.0))
                result[-1].mesh = parts[-1].id
            else:
                # A thick part has no thin surface: its bounding box is far away from all points.
                result.append(_shape(shape.solid, geometry, device, 0.0))
                result[-1].low = result[-1].high = wp.vec3d(*np.full(3, kernels.ENDLESS))
        return wp.array(result, dtype=kernels.ThinShape, device=device), parts

    def place(self, time: float) -> None:
        """Move the solids to a time [s].

        Their old places are the start of the next step's particle paths.
        """
        if not self._moving:
            return
        rotations, translations = self._motions.poses([time])
        for place, motion, image in self._moving:
            group = self._groups[place]
            group.turn_before, group.shift_before = group.turn, group.shift
            group.turn = wp.mat33d(rotations[0, motion])
            group.shift = wp.vec3d(*(translations[0, motion] + image))
            self._find_box(group)
        self.groups.assign(self._groups)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of a box around the solids at their current places.

        Low and high corner [m], shape (3,) each.
        """
        boxes = np.array([self._bounds_of(group) for group in self._groups])
        return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)

    def _bounds_of(self, group: kernels.ThinGroup) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of a box around a group at its current place [m], (3,) each."""
        lows, highs = [], []
        turn, shift = np.array(group.turn).reshape(3, 3), np.array(group.shift)
        for geometry in self._geometries[group.first : group.end]:
            box = geometry.bounds()
            assert box is not None, "thin solids are bounded"
            low, high = np.clip(box, -kernels.ENDLESS, kernels.ENDLESS)
            middle, reach = 0.5 * (low + high), np.abs(turn) @ (0.5 * (high - low))
            lows.append(turn @ middle + shift - reach)
            highs.append(turn @ middle + shift + reach)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def _find_box(self, group: kernels.ThinGroup) -> None:
        """Set the box of a group: lines and particles farther away need not be tested."""
        low, high = self._bounds_of(group)
        room = BOX_ROOM * self.grid.spacing
        group.low, group.high = wp.vec3(*(low - room)), wp.vec3(*(high + room))

    def longest_step(
        self, position: wp.array, velocity: wp.array, time: float, dt: float, reach: float
    ) -> float:
        """Return the longest step [s] that resolves how material meets moving solids; collective.

        Let w(x) be the velocity of a solid at x, its mean over the step. A particle goes

            |v - w(x)| dt

        in the frame of the solid, at most `RELATIVE_WAY` cells. In longer steps the material piles
        up at the walls that it meets: its velocity, computed at the start of the step, still leads
        into the wall when the wall is there. Material that moves with the solids, however fast,
        does not shorten the step. Rigid bodies, whose velocities are not known beforehand, do not
        count.

        Args:
            position: of the particles [m], shape (n,).
            velocity: of the particles [m/s], shape (n,).
            time: start of the step [s]; the solids have been placed there.
            dt: longest step to consider [s].
            reach: particles within this distance [m] of a box around a solid count.

        Returns:
            Infinity if `dt` is short enough.
        """
        if all(isinstance(motion, RigidMotion) for motion in self._motions.motions):
            return math.inf
        most, longest = RELATIVE_WAY * self.grid.spacing, dt
        for _ in range(SHORTENINGS):
            speed = self._relative_speed(position, velocity, time, dt, reach)
            way = float(self.grid.part.ranks.max(speed)) * dt
            # Also if a velocity is not a number, which the totals report.
            if not way > most * (1.0 + WAY_ROUNDING):
                break
            # Where the solid starts to move, the way is proportional to dt^2: a step in proportion
            # to the way would be too short.
            dt *= max(most / way, 0.5)
        return dt if dt < longest else math.inf

    def _relative_speed(
        self, position: wp.array, velocity: wp.array, time: float, dt: float, reach: float
    ) -> float:
        """Return the largest speed of particles relative to driven solids near them [m/s]."""
        count = len(position)
        if count == 0:  # a rank without material
            return 0.0
        turns, shifts = self._motions.velocity_fields(time, dt)
        boxes = []
        for place, motion, image in self._moving:
            if isinstance(self._motions.motions[motion], RigidMotion):
                continue
            low, high = self._bounds_of(self._groups[place])
            box = kernels.MovingBox()
            box.low, box.high = wp.vec3d(*(low - reach)), wp.vec3d(*(high + reach))
            box.turn = wp.mat33d(turns[motion])
            # The point x of an image moves as x - image does.
            box.shift = wp.vec3d(*(shifts[motion] - turns[motion] @ image))
            boxes.append(box)
        device = self.grid.device
        if len(self._speed) < count:
            self._speed = wp.empty(count + count // 4, dtype=wp.float64, device=device)
        speed = self._speed[:count]
        moving = wp.array(boxes, dtype=kernels.MovingBox, device=device)
        launch_list(
            kernels.relative_speed_kernel, count, [position, velocity, moving, speed], device=device
        )
        return float(speed.numpy().max())

    def store_positions(self, position: wp.array) -> None:
        """Store the positions of particles [m], shape (n,), before they move."""
        count = len(position)
        if count == 0:  # a rank without material
            return
        if len(self._start) < count:
            room = count + count // 4
            self._start = wp.empty(room, dtype=wp.vec3, device=self.grid.device)
        copy(self._start[:count], position)

    def start_of(self, position: wp.array) -> wp.array:
        """Return the stored positions of particles [m], shape (n,)."""
        return self._start[: len(position)] if len(position) else position

    def stop(self, position: wp.array, *, still: bool) -> None:
        """Move particles that have crossed a thin solid back to its surface, and along it.

        The paths start at the positions stored by `store_positions`.

        Args:
            position: [m], shape (n,) (updated).
            still: whether the solids have not moved since then.
        """
        if len(position) == 0:
            return
        kernel_args = [
            self.start_of(position),
            position,
            self.shapes,
            self.groups,
            int(still),
            self._margin,
            self.grid.planes,
        ]
        launch_list(
            kernels.stop_kernel,
            len(position),
            [*kernel_args, wp.vec3d(*self.least), wp.vec3d(*self.most)],
            device=self.grid.device,
            cost=COST,
        )

    def room(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Return the distance of points [m], shape (n, 3), from the nearest solid, shape (n,).

        It is at most `reach` [m]; from a mesh it is measured to the surface on either side.
        """
        at = wp.array(np.asarray(points, dtype=np.float32), dtype=wp.vec3, device=self.grid.device)
        room = wp.empty(len(points), dtype=wp.float64, device=self.grid.device)
        if len(points):
            launch_list(
                kernels.room_kernel,
                len(points),
                [at, self.shapes, self.groups, wp.float64(reach), room],
                device=self.grid.device,
                cost=COST,
            )
        return np.asarray(room.numpy())

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return a mask of points [m], shape (n, 3), that keep their distance.

        A particle may start there.
        """
        result = self.room(points, 2.0 * float(self._margin)) >= float(self._margin)
        for group in self._groups:
            turn, shift = np.array(group.turn).reshape(3, 3), np.array(group.shift)
            meshes = (
                geometry
                for geometry in self._geometries[group.first : group.end]
                if isinstance(geometry, TriangleMesh)
            )
            for mesh in meshes:
                own = ((np.asarray(points) - shift) @ turn).astype(np.float32)
                distance = wp.empty(len(points), dtype=wp.float32, device=self.grid.device)
                mesh.signed_distance(wp.array(own, dtype=wp.vec3, device=distance.device), distance)
                result &= distance.numpy() > 0.0
        return np.asarray(result)


def _images(grid: StaggeredGrid, endless: Sequence[int]) -> list[np.ndarray]:
    """Return the shifts of a solid's periodic images [m], (3,) each."""
    steps = [(0, -1, 1) if axis in endless else (0,) for axis in range(3)]
    return [grid.extent * np.array(step) for step in product(*steps)]


def _alike(one: Motion | None, other: Motion | None) -> bool:
    """Return whether two motions are the same; those of rigid bodies never are."""
    if one is other or one is None or other is None:
        return one is other
    try:
        return type(one) is type(other) and bool(one == other)
    except ValueError:  # arrays among their members
        return False


def _shape(number: int, geometry: Geometry, device: wp.Device, skin: float) -> kernels.ThinShape:
    """Return a shape as kernels take it, enlarged by a `skin` [m].

    A mesh is not enlarged.
    """
    assert isinstance(geometry, SimpleShape), "half spaces are not thin"
    result, place, bounds = kernels.ThinShape(), geometry.placement, geometry.bounds()
    assert bounds is not None, "an inverted shape is not thin"
    result.solid = number
    result.turn = wp.mat33d(place.rotation.T)
    result.shift = wp.vec3d(*(place.translation + place.scale * place.rotation @ geometry.origin()))
    low, high = np.clip([bounds[0] - skin, bounds[1] + skin], -kernels.ENDLESS, kernels.ENDLESS)
    result.low, result.high = wp.vec3d(*low), wp.vec3d(*high)
    if isinstance(geometry, Box):
        half = np.minimum(place.scale * geometry.half_extents() + skin, kernels.ENDLESS)
        result.kind, result.half = kernels.BOX, wp.vec3d(*half)
    elif isinstance(geometry, Sphere):
        result.kind, result.radius = kernels.SPHERE, place.scale * geometry.radius + skin
    elif isinstance(geometry, Capsule):
        result.kind, result.radius = kernels.CAPSULE, place.scale * geometry.radius + skin
        result.half = wp.vec3d(*(place.scale * geometry.axis()))
    else:
        result.kind, result.radius = kernels.MESH, place.scale * geometry.unit_length()
        result.mesh = geometry.surface.on_device(device).id
    return result
