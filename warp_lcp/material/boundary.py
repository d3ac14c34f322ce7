"""Walls and solids: open fractions and velocity of faces, admitted positions.

Two classes have the same interface: `WholeCells`, whose cells are solid or open, and `CutBoundary`,
whose faces are open in part, whose particles keep their distance, and whose solids may move.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import warp as wp

from warp_lcp.grid.advection import advect, advect_with_distance, clearance, push_out
from warp_lcp.grid.barriers import Barriers
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.domain_sides import PeriodicSides, continue_beyond, with_periodic
from warp_lcp.grid.level_set import whole_cell_capacity
from warp_lcp.grid.motion import Motions, boxes_of, kinks
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.thin_walls import ThinWalls
from warp_lcp.grid.voxelize import VoxelSolids
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy, launch
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import Scalar
from warp_lcp.material import boundary_kernels as kernels
from warp_lcp.material.velocity_extrapolation import (
    LayerCallback,
    SprayViscosity,
    extend_velocity,
    extend_velocity_cut,
)

Faces = list[wp.array]  # one field a component


class Boundary(Protocol):
    """Solids and the domain's walls.

    Attributes:
        sides: the periodic sides; None if there are none.
        open_sides: open sides of the domain, see `warp_lcp.grid.domain_sides`; they include the
            sides of periodic axes.
        base: int8 cells without material: SOLID or AIR. The ring is SOLID, or AIR beyond open
            sides.
        touch: uint8 a cell: TOUCHES if a face is not open, LETS_GO if the wall of such a face
            separates.
        open: float32 open fraction a_f of each component's lower faces; empty: a face is closed
            where a cell beside it is SOLID.
        velocity: float32 velocity of the solids on each component's faces [m/s]; empty if they
            stand still.
        capacity: float32 open fraction of a cell's quadratic kernel.
        distance: float32 distance to the solids at the cells' low corners [cells]; None for whole
            cells.
        room: int8 number of cells to the nearest SOLID one, see `clearance`; None for cut cells.
        kinks: times [s] at which the velocity of a solid jumps.
        thin: solids that particles meet as exact shapes; None if none is thin.
    """

    moves: bool  # whether a solid moves
    thin: ThinWalls | None
    sides: PeriodicSides | None
    open_sides: int
    base: wp.array
    touch: wp.array
    open: Faces
    velocity: Faces
    capacity: wp.array | None
    distance: wp.array | None
    room: wp.array | None
    kinks: tuple[float, ...]

    def top_speed(self, time: float, span: float) -> float:
        """Return the largest speed of the solids [m/s] in a time span.

        From `time` to `time` + `span` [s].
        """

    def begin_step(self, time: float, dt: float) -> None:
        """Compute the velocity of the solids from `time` on [s]."""

    def extrapolate_velocity(
        self,
        window: Window,
        velocity: Faces,
        weights: Faces,
        known: Faces,
        kind: wp.array,
        contact: wp.array,
        layers: int,
        join: LayerCallback | None = None,
        spray: SprayViscosity | None = None,
    ) -> None:
        """Extrapolate the projected velocity into air and walls.

        See `warp_lcp.material.velocity_extrapolation`, also for `join` and `spray`.
        """

    def placed(self) -> list[wp.array]:
        """Return the fields of the placed solids.

        On ranks, values beyond the box come from other ranks.
        """

    def advect(self, fields: Faces, dt: float, time: float, position: wp.array) -> None:
        """Advect particles, then move the solids to `time`."""

    def collision_counts(self) -> tuple[int, int, int]:
        """Return numbers of particles that met a wall, were pushed, and are stuck.

        During the last advection; stuck inside a solid.
        """

    def displace(self, fields: Faces, position: wp.array) -> None:
        """Move particles by a displacement [m] on the faces.

        Walls stop them; solids do not move.
        """

    def place(self, time: float) -> None:
        """Place the solids at `time` [s]."""

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return at which points [m], shape (n, 3), a particle may start.

        This restricts positions further than open cells do.
        """

    def shapes(self) -> Sequence[Geometry]:
        """Return the solids' current shapes, if the walls coincide with them."""


class WholeCells:
    """Solids that fill whole cells.

    Args:
        grid: the grid.
        solids: the solid cells, and the walls that separate.
        wall_velocity: velocity [m/s] of the domain's wall and of each solid, shape (1 + solids, 3),
            constant; the cells stay fixed. None if all are at rest.
        open_sides: the open sides for which `solids` was made, except periodic ones.
        sides: the periodic sides, which are open in `solids`; None if there are none.
        shapes: shapes of the solids, if they fill whole cells exactly.

    Raises:
        ValueError: `wall_velocity` has another shape.
    """

    distance: wp.array | None = None
    kinks: tuple[float, ...] = ()
    moves = False
    thin: ThinWalls | None = None

    def __init__(
        self,
        grid: StaggeredGrid,
        solids: VoxelSolids,
        wall_velocity: np.ndarray | None = None,
        *,
        open_sides: int,
        sides: PeriodicSides | None = None,
        shapes: Sequence[Geometry] = (),
    ) -> None:
        self.grid, self.solids, self.sides, self._shapes = grid, solids, sides, tuple(shapes)
        self.open_sides, self._endless = (
            with_periodic(open_sides, sides),
            sides.bits if sides is not None else 0,
        )
        if wall_velocity is not None and np.shape(wall_velocity) != (len(solids.separating), 3):
            raise ValueError(
                f"wall_velocity has shape {np.shape(wall_velocity)}: expected "
                f"({len(solids.separating)}, 3)"
            )
        self.base, self.touch, self.capacity = (
            grid.field(wp.int8),
            grid.field(wp.uint8),
            grid.field(),
        )
        self.open: Faces = []
        self.wall_velocity = wall_velocity
        self.velocity: Faces = grid.faces() if wall_velocity is not None else []
        everywhere = Window((0, 0, 0), grid.shape, grid.device)
        everywhere.launch(kernels.base_kernel, [solids.index, self.base])
        if sides is not None:
            sides.wrap(self.base)
        grid.domain.launch(
            kernels.touch_kernel, [solids.index, solids.separating, grid.planes, self.touch]
        )
        whole_cell_capacity(grid, self.base, self.capacity)
        continue_beyond(grid, open_sides, self.capacity)
        if sides is not None:
            sides.wrap(self.capacity)
        if wall_velocity is not None:
            shift = wp.array(
                np.asarray(wall_velocity, dtype=np.float32), dtype=wp.vec3, device=grid.device
            )
            turn = wp.zeros(len(shift), dtype=wp.mat33, device=grid.device)
            walls = [grid.planes, grid.spacing, wp.vec3i(*grid.origin), solids.index, turn, shift]
            walls += [None, wp.vec3()]
            for axis, field in enumerate(self.velocity):
                grid.everywhere.launch(kernels.wall_velocity_kernel, [axis, *walls, field])
        self.room = clearance(grid, self.base)
        self._stopped, self._dt = DeviceScalar(grid.device, dtype=wp.int32), Scalar()
        self._advection = LaunchGraph(grid.device, self._advect)
        self._displacement = LaunchGraph(grid.device, self._displace)

    def top_speed(self, time: float, span: float) -> float:
        """Return 0: the solids do not move."""
        return 0.0

    def begin_step(self, time: float, dt: float) -> None:
        """Do nothing: velocities are constant."""

    def extrapolate_velocity(
        self,
        window: Window,
        velocity: Faces,
        weights: Faces,
        known: Faces,
        kind: wp.array,
        contact: wp.array,
        layers: int,
        join: LayerCallback | None = None,
        spray: SprayViscosity | None = None,
    ) -> None:
        """Extrapolate the projected velocity into air and walls."""
        s = self.solids
        extend_velocity(
            window,
            velocity,
            weights,
            known,
            kind,
            contact,
            s.index,
            s.separating,
            self.velocity,
            layers,
            spray=spray,
            join=join,
        )

    def placed(self) -> list[wp.array]:
        """Return the fields of the solids."""
        return [self.base, self.touch, self.capacity, self.room]

    def advect(self, fields: Faces, dt: float, time: float, position: wp.array) -> None:
        """Advect particles, never into a SOLID cell."""
        self._dt.value = dt
        self._advection.run(fields, position)
        self._stopped.changed()

    def _advect(self, fields: Faces, position: wp.array) -> None:
        clear(self._stopped.array)
        advect(self.grid, fields, self.room, self._dt, position, self._stopped.array, self._endless)

    def collision_counts(self) -> tuple[int, int, int]:
        """Return the number of particles that met a wall."""
        return int(self._stopped.numpy()[0]), 0, 0

    def displace(self, fields: Faces, position: wp.array) -> None:
        """Move particles by a displacement [m], never into a SOLID cell."""
        self._displacement.run(fields, position)

    def _displace(self, fields: Faces, position: wp.array) -> None:
        advect(self.grid, fields, self.room, 1.0, position, self._stopped.array, self._endless)

    def place(self, time: float) -> None:
        """Do nothing: the solids do not move."""

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return True for all points: particles may start in open cells."""
        return np.ones(len(points), dtype=bool)

    def shapes(self) -> Sequence[Geometry]:
        """Return the solids' shapes, if they fill whole cells exactly."""
        return self._shapes


ALIKE = 1e-2  # cells by which solids may differ at the two sides of a periodic axis


class CutBoundary:
    """Solids as cut cells with a distance; implements `Boundary`.

    In a step that starts at time t the pressure uses the solids' places at t and their velocity
    from t to t + dt. Then the solids move, and the particles with them: a particle may move where
    space is open before or after the step, and particles that are then inside a solid are pushed
    out. So an advancing wall pushes particles that its own velocity has not carried away, and
    particles can follow a retreating wall. On ranks, making this object is collective, and so are
    `place` and `top_speed` where solids move.

    Args:
        grid: the grid.
        cut: the solids, with their capacity.
        sides: the periodic sides, if there are any; `cut` has walls there.
        thin: the solids that particles meet as exact shapes; None if none is thin.
        barriers: the thin solids that do not cut cells but separate their two sides; None if there
            are none.

    Raises:
        ValueError: solids differ at the two sides of an axis without an end.
    """

    room: wp.array | None = None

    def __init__(
        self,
        grid: StaggeredGrid,
        cut: CutCells,
        *,
        sides: PeriodicSides | None = None,
        thin: ThinWalls | None = None,
        barriers: Barriers | None = None,
    ) -> None:
        self.grid, self.cut, self.moves, self.sides, self.thin, self.barriers = (
            grid,
            cut,
            cut.moves,
            sides,
            thin,
            barriers,
        )
        self.open_sides, self._endless = (
            with_periodic(cut.open_sides, sides),
            sides.bits if sides is not None else 0,
        )
        self._time = 0.0
        self.base, self.open, self.capacity, self.distance = (
            cut.base,
            cut.open,
            cut.capacity,
            cut.distance,
        )
        self.velocity: Faces = cut.velocity or []
        self.touch = grid.field(wp.uint8)
        self._scratch = grid.faces()
        # Distance that decides where particles may move within a step.
        self._reachable = grid.field() if cut.moves else cut.distance
        self._counts, self._dt = DeviceScalar(grid.device, 3, wp.int32), Scalar()
        self._advection = LaunchGraph(grid.device, self._advect)
        self._displacement = LaunchGraph(grid.device, self._displace)
        ranks = grid.part.ranks
        # Solids whose speeds this process evaluates.
        share = slice(ranks.rank, None, ranks.size)
        self._motions = Motions(cut.motions.motions[share])
        self._bounds = boxes_of(
            [solid.geometry.bounds() for solid in cut.solids if solid.motion is not None]
        )[share]
        self._size = grid.extent
        self._size[grid.dimension :] = 0.0
        self.kinks = tuple(time for motion in cut.motions.motions for time in kinks(motion))
        if cut.moves:
            cut.accompany(self._keep_distance, self._find_walls)
        self._find_walls()
        self._join_sides()
        self._cross()
        grid.part.fill(*self.placed())

    def top_speed(self, time: float, span: float) -> float:
        """Return the largest speed of the solids [m/s] in a time span.

        From `time` to `time` + `span` [s].
        """
        mine = self._motions.top_speed(self._bounds, self._size, time, span)
        return float(self.grid.part.ranks.max(mine)) if self.moves else mine

    def begin_step(self, time: float, dt: float) -> None:
        """Compute the velocity of the solids from `time` on [s]."""
        if self.moves:
            self.cut.set_velocity(time, dt)
            if self.barriers is not None:
                self.barriers.set_velocity()

    def extrapolate_velocity(
        self,
        window: Window,
        velocity: Faces,
        weights: Faces,
        known: Faces,
        kind: wp.array,
        contact: wp.array,
        layers: int,
        join: LayerCallback | None = None,
        spray: SprayViscosity | None = None,
    ) -> None:
        """Extrapolate the projected velocity into air and walls."""
        extend_velocity_cut(
            window,
            velocity,
            weights,
            known,
            kind,
            contact,
            self.cut,
            self._scratch,
            layers,
            spray=spray,
            join=join,
        )

    def placed(self) -> list[wp.array]:
        """Return the fields of the placed solids."""
        capacity = [] if self.capacity is None else [self.capacity]
        apart = [] if self.barriers is None else self.barriers.placed()
        cut = self.cut
        fields = [self.base, self.touch, cut.distance, *cut.nearest, *self.open, *cut.wall]
        return [*fields, *capacity, *apart]

    def advect(self, fields: Faces, dt: float, time: float, position: wp.array) -> None:
        """Advect particles, then move the solids to `time`."""
        self._dt.value = dt
        self._look_around(fields, dt, position)
        if self.moves:
            self.place(time)
        self._advection.run(fields, position)
        self._stop_at_thin_walls(position, still=not self.moves)
        self._counts.changed()

    def _look_around(self, fields: Faces, dt: float, position: wp.array) -> None:
        """Advect particles near thin solids by the velocity that they see.

        The solids have not moved yet.
        """
        if self.thin is not None:
            self.thin.store_positions(position)
            if self.barriers is not None:
                self.barriers.carry(fields, dt, self.thin.start_of(position))

    def _stop_at_thin_walls(self, position: wp.array, *, still: bool) -> None:
        """Move particles as `_look_around` has found, and stop them at thin solids.

        The solids have moved unless `still`.
        """
        if self.thin is not None:
            if self.barriers is not None:
                self.barriers.bring(self.thin.start_of(position), position)
            self.thin.stop(position, still=still)

    def _advect(self, fields: Faces, position: wp.array) -> None:
        """Move the particles among the solids' old and new places, then out of the solids."""
        counts, distance = self._counts.array, self.cut.distance
        clear(counts)
        if self.moves:
            launch(
                kernels.larger_kernel,
                self.grid.size,
                [distance.flatten(), self._reachable.flatten()],
                device=self.grid.device,
            )
        sides, ways = self.open_sides, {"open_sides": self.open_sides, "endless": self._endless}
        advect_with_distance(
            self.grid, fields, self._reachable, self._dt, position, counts[0:1], **ways
        )
        if self.moves:
            push_out(self.grid, distance, position, counts[1:2], counts[2:3], open_sides=sides)

    def collision_counts(self) -> tuple[int, int, int]:
        """Return numbers of particles that met a wall, were pushed, and are stuck."""
        met, pushed, stuck = (int(n) for n in self._counts.numpy())
        return met, pushed, stuck

    def displace(self, fields: Faces, position: wp.array) -> None:
        """Move particles by a displacement [m] among the solids at rest."""
        self._look_around(fields, 1.0, position)
        self._displacement.run(fields, position)
        self._stop_at_thin_walls(position, still=True)

    def _displace(self, fields: Faces, position: wp.array) -> None:
        ways = {"open_sides": self.open_sides, "endless": self._endless}
        advect_with_distance(
            self.grid, fields, self.cut.distance, 1.0, position, self._counts.array[0:1], **ways
        )

    def place(self, time: float) -> None:
        """Place the solids at `time` [s]."""
        if self.moves:
            self._time = time
            self.cut.place(time)
            if self.thin is not None:
                self.thin.place(time)
            self._join_sides()
            if self.barriers is not None:
                self.barriers.place(time)
            self._cross()
            self.grid.part.fill(*self.placed())

    def shapes(self) -> Sequence[Geometry]:
        """Return the solids' shapes where they are."""
        return [
            s.geometry if s.motion is None else s.geometry.moved(s.motion.pose(self._time))
            for s in self.cut.solids
        ]

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Return a mask of points [m], shape (n, 3), that keep the distance from walls."""
        coordinates = self.grid.to_grid(points)
        if self.grid.dimension == 2:
            coordinates[:, 2] = 1.0
        last, origin = np.array(self.grid.shape[::-1]) - 2, np.array(self.grid.origin)
        cell = np.clip(np.floor(coordinates).astype(np.int64) - origin, 0, last)
        i, j, k = cell.T
        x, y, z = (coordinates - origin - cell).T
        distance = self.cut.distance.numpy()

        def d(*cell: np.ndarray) -> np.ndarray:
            return np.asarray(distance[cell], dtype=np.float64)

        planes = [
            (1 - y) * ((1 - x) * d(c, j, i) + x * d(c, j, i + 1))
            + y * ((1 - x) * d(c, j + 1, i) + x * d(c, j + 1, i + 1))
            for c in (k, k + 1)
        ]
        between = planes[0] if self.grid.dimension == 2 else (1 - z) * planes[0] + z * planes[1]
        axes = slice(self.grid.dimension)
        side = np.minimum(coordinates - 1.0, np.array(self.grid.domain_counts) + 1.0 - coordinates)[
            :, axes
        ].min(axis=1)
        result = np.asarray(np.minimum(between, side) >= MARGIN)
        return result if self.thin is None else result & self.thin.admits(points)

    def _join_sides(self) -> None:
        """Complete the capacity of cells whose kernels reach beyond periodic sides.

        Solids that differ at the two sides are refused.
        """
        if self.sides is None:
            return
        if self.capacity is not None:
            self.sides.add(self.capacity)
        for axis in self.sides.endless:
            if self.cut.difference(axis) > ALIKE:
                raise ValueError(
                    f"solids differ at the two sides of the periodic {'xyz'[axis]} axis: a solid "
                    "at one side must continue at the other"
                )

    def _keep_distance(self) -> None:
        """Launch the copy of the distance before the solids move.

        Particles may move where space is open before or after the step.
        """
        copy(self._reachable, self.cut.distance)

    def _cross(self) -> None:
        """Close the faces that barriers cross."""
        if self.barriers is not None:
            self.barriers.cross()
            self._find_walls()

    def _find_walls(self) -> None:
        walls = (*self.cut.wall, *self.cut.wall[1:2])[:3]  # 2-D does not use the third
        self.grid.domain.launch(
            kernels.touch_cut_kernel, [self.grid.planes, *walls, self.cut.separating, self.touch]
        )
