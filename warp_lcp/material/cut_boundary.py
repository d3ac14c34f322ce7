"""Solids that cut through cells: faces are open in part, particles keep their distance, solids may move."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_lcp.grid.advection import MARGIN, advect_with_distance, push_out
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.motion import kinks, top_speed
from warp_lcp.grid.sides import PeriodicSides, with_periodic
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.material import boundary_kernels as kernels
from warp_lcp.material.boundary import Faces
from warp_lcp.material.cut_wall import extend_velocity_cut
from warp_lcp.material.wall import Join

CLOSE = 1.0  # cells from a solid within which the sides of an axis without an end must be alike
ALIKE = 1e-2  # cells


class CutBoundary:
    """Solids as fractions of faces and a distance; implements `warp_lcp.material.boundary.Boundary`.

    In a step that starts at time t the pressure meets the solids where they are at t, moving as they will until t + dt. Then they move,
    and the particles with them: a particle may go where it is open before or after, and what is then inside a solid is pushed out. So a
    wall that advances pushes what its own velocity has not carried away, and one that retreats can be followed.

    Args:
        grid: the grid.
        cut: the solids, with their capacity.
        sides: of axes without an end, if there are any; `cut` has walls there.

    Raises:
        ValueError: solids differ at the two sides of an axis without an end.
    """

    def __init__(self, grid: StaggeredGrid, cut: CutCells, *, sides: PeriodicSides | None = None) -> None:
        """Allocate the fields."""
        self.grid, self.cut, self.moves, self.sides = grid, cut, cut.moves, sides
        self.open_sides, self._endless = with_periodic(cut.open_sides, sides), sides.bits if sides is not None else 0
        self.base, self.open, self.capacity, self.distance = cut.base, cut.open, cut.capacity, cut.distance
        self.velocity: Faces = cut.velocity or []
        self.touch = grid.field(wp.uint8)
        self._scratch = grid.faces()
        self._reachable = grid.field() if cut.moves else cut.distance  # distance where particles may go within a step
        self._counts = wp.zeros(3, dtype=wp.int32, device=grid.device)
        self._moving = [(solid.motion, solid.geometry.bounds()) for solid in cut.solids if solid.motion is not None]
        self.kinks = tuple(time for motion, _ in self._moving for time in kinks(motion))
        self._find_walls()
        self._join_sides()

    def top_speed(self, time: float, span: float) -> float:
        """Return how fast the solids move at most [m/s] from `time` to `time` + `span` [s]."""
        size = np.array(self.grid.counts) * self.grid.spacing
        size[self.grid.dimension :] = 0.0
        return max((top_speed(motion, bounds, size, time, span) for motion, bounds in self._moving), default=0.0)

    def begin_step(self, time: float, dt: float) -> None:
        """Find how fast the solids move from `time` on [s]."""
        if self.moves:
            self.cut.set_velocity(time, dt)

    def extend(
        self, window: Window, velocity: Faces, weights: Faces, known: Faces, kind: wp.array, contact: wp.array, layers: int,
        join: Join | None = None,
    ) -> None:  # fmt: skip
        """Continue the projected velocity into air and walls."""
        extend_velocity_cut(window, velocity, weights, known, kind, contact, self.cut, self._scratch, layers, join=join)

    def placed(self) -> list[wp.array]:
        """Return the fields of solids that stand still."""
        return [self.base, self.touch, self.cut.distance, *self.open, *self.cut.wall, *([] if self.capacity is None else [self.capacity])]

    def advect(self, fields: Faces, dt: float, time: float, position: wp.array) -> tuple[int, int, int]:
        """Move particles, then the solids to `time`. Return how many met a wall, were pushed by a solid, and are stuck inside one."""
        self._counts.zero_()
        if self.moves:
            wp.copy(self._reachable, self.cut.distance)
            self.place(time)
            wp.launch(
                kernels.larger_kernel, self.grid.size, [self.cut.distance.flatten(), self._reachable.flatten()], device=self.grid.device
            )
        sides, ways = self.open_sides, {"open_sides": self.open_sides, "endless": self._endless}
        advect_with_distance(self.grid, fields, self._reachable, dt, position, self._counts[0:1], **ways)
        if self.moves:
            push_out(self.grid, self.cut.distance, position, self._counts[1:2], self._counts[2:3], open_sides=sides)
        met, pushed, stuck = (int(n) for n in self._counts.numpy())
        return met, pushed, stuck

    def displace(self, fields: Faces, position: wp.array) -> None:
        """Move particles by a displacement [m] among the solids where they are now."""
        ways = {"open_sides": self.open_sides, "endless": self._endless}
        advect_with_distance(self.grid, fields, self.cut.distance, 1.0, position, self._counts[0:1], **ways)

    def place(self, time: float) -> None:
        """Put the solids where they are at `time` [s]."""
        if self.moves:
            self.cut.place(time)
            self._find_walls()
            self._join_sides()

    def admits(self, points: np.ndarray) -> np.ndarray:
        """Tell which points [m] of the domain, shape (n, 3), keep the distance that particles keep from walls."""
        coordinates = self.grid.to_grid(points)
        if self.grid.dimension == 2:
            coordinates[:, 2] = 1.0
        last, origin = np.array(self.grid.shape[::-1]) - 2, np.array(self.grid.origin)
        cell = np.clip(np.floor(coordinates).astype(np.int64) - origin, 0, last)
        i, j, k = cell.T
        x, y, z = (coordinates - origin - cell).T
        d = self.cut.distance.numpy().astype(np.float64)
        planes = [
            (1 - y) * ((1 - x) * d[c, j, i] + x * d[c, j, i + 1]) + y * ((1 - x) * d[c, j + 1, i] + x * d[c, j + 1, i + 1])
            for c in (k, k + 1)
        ]
        between = planes[0] if self.grid.dimension == 2 else (1 - z) * planes[0] + z * planes[1]
        axes = slice(self.grid.dimension)
        side = np.minimum(coordinates - 1.0, np.array(self.grid.whole or self.grid.counts) + 1.0 - coordinates)[:, axes].min(axis=1)
        return np.asarray(np.minimum(between, side) >= MARGIN)

    def _join_sides(self) -> None:
        """Add to the capacity of cells what their kernels reach beyond sides that are the same; refuse solids that differ there."""
        if self.sides is None:
            return
        if self.capacity is not None:
            self.sides.add(self.capacity)
        distance = np.clip(self.distance.numpy(), -CLOSE, CLOSE)
        for axis in self.sides.axes:
            lines = np.moveaxis(distance, 2 - axis, 0)
            if np.abs(lines[1] - lines[-1]).max() > ALIKE:
                raise ValueError(
                    f"solids differ at the two sides of the periodic {'xyz'[axis]} axis: what reaches one must go on at the other"
                )

    def _find_walls(self) -> None:
        self.touch.zero_()
        for axis, wall in enumerate(self.cut.wall):
            self.grid.domain.launch(kernels.touch_cut_kernel, [axis, wall, self.cut.separating, self.touch])
