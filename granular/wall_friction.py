"""Solids in sand: whole cells with contact and friction, or cut cells.

See `granular.cut_walls` for solids that cut cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.granular.cut_walls import CutWalls
from warp_lcp.granular.fields import WallFaces
from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.grid.voxelize import PlacedSolid, voxelize
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, launch
from warp_lcp.material import boundary_kernels as kernels
from warp_lcp.material.boundary import Boundary, CutBoundary, Faces
from warp_lcp.rigid.body import BodyMotion

INTS, BYTES = wp.array(dtype=wp.int32), wp.array(dtype=wp.uint8)
CUDA_LISTS = 1024  # parts of the list of faces, one per thread on a GPU


@wp.func
@no_type_check
def part_begin(part: int, entries: int, parts: int):
    """Return the first entry of one of equal parts of a list."""
    return int((wp.int64(part) * wp.int64(entries)) // wp.int64(parts))


class SandWalls:
    """Friction on the faces between sand and solids.

    Args:
        grid: the grid.
        index: int, -1 in open cells, the wall number elsewhere, shape of the grid's fields.
        friction: Coulomb's coefficient of each wall, >= 0; inf sticks.
        rubbing_only: omit the faces of walls without friction. Their stresses are 0 as long as no
            wall moves. A moving wall can reach cells with stresses, which its faces must then
            remove.
        counted: cells whose faces are included; None for all.

    Attributes:
        count: number of faces.
        cells: int32, flat index of each face's open cell.
        sides: uint8, 2 axis + side.
        walls: int32, wall number of each face.
        friction: float32, friction coefficient of each wall.
        active: int32: number of faces beside sand, followed by their entries.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        index: np.ndarray,
        friction: Sequence[float],
        *,
        rubbing_only: bool = False,
        counted: Window | None = None,
    ) -> None:
        device = grid.device
        self.friction = wp.array(np.minimum(friction, 1e6), dtype=wp.float32, device=device)
        cells, sides, walls = wall_faces(index, grid.dimension, counted)
        if rubbing_only:
            rubs = np.asarray(friction)[walls] > 0.0
            cells, sides, walls = cells[rubs], sides[rubs], walls[rubs]
        self.count, self.host_cells, self.host_sides = len(cells), cells, sides
        self.cells = wp.array(cells, dtype=wp.int32, device=device)
        self.sides = wp.array(sides, dtype=wp.uint8, device=device)
        self.walls = wp.array(walls, dtype=wp.int32, device=device)
        self.faces = WallFaces(self.cells, self.sides, self.walls, self.friction)
        self._counts = wp.zeros(CUDA_LISTS if device.is_cuda else 0, dtype=wp.int32, device=device)
        self.active = wp.zeros(1 + self.count, dtype=wp.int32, device=device)

    def activate(self, flags: wp.array) -> None:
        """List the faces whose cells hold sand.

        Their number and their entries, ascending, are written to `active`.

        Args:
            flags: uint8 flags of the cells, 0 without sand.
        """
        device, fields = flags.device, [self.cells, flags.flatten(), self.active]
        if not device.is_cuda:
            launch(activate_kernel, 1, fields, device=device)
            return
        for kernel in (count_active_kernel, list_active_kernel):
            launch(kernel, CUDA_LISTS, [*fields, self._counts], device=device)


@forward_kernel(module="granular.walls")
@no_type_check
def activate_kernel(cells: INTS, flags: BYTES, active: INTS):
    """List the entries whose cells hold sand, in order, after their number."""
    count = int(0)
    for face in range(cells.shape[0]):
        if flags[cells[face]] != wp.uint8(0):
            count += 1
            active[count] = face
    active[0] = count


@forward_kernel(module="granular.walls_cuda")
@no_type_check
def count_active_kernel(cells: INTS, flags: BYTES, active: INTS, counts: INTS):
    """Count the entries with sand in one of equal parts of the list.

    With one thread per part.
    """
    t, n, count = wp.tid(), cells.shape[0], int(0)
    for face in range(part_begin(t, n, counts.shape[0]), part_begin(t + 1, n, counts.shape[0])):
        if flags[cells[face]] != wp.uint8(0):
            count += 1
    counts[t] = count


@forward_kernel(module="granular.walls_cuda")
@no_type_check
def list_active_kernel(cells: INTS, flags: BYTES, active: INTS, counts: INTS):
    """List the entries with sand of one part of the list.

    They follow those of the parts before it, so that the order is that of the list.
    """
    t, n, count = wp.tid(), cells.shape[0], int(0)
    for before in range(t):
        count += counts[before]
    for face in range(part_begin(t, n, counts.shape[0]), part_begin(t + 1, n, counts.shape[0])):
        if flags[cells[face]] != wp.uint8(0):
            count += 1
            active[count] = face
    if t == counts.shape[0] - 1:
        active[0] = count


class SandSolids:
    """Solids and the domain's walls, as whole cells with friction.

    The constructor, `place` and `begin_step` are collective. A cell belongs to a solid if its
    center lies inside. Particles move between the surfaces of `boundary`, which may cut cells.

    Args:
        grid: the grid.
        placed: the solids.
        boundary: surfaces for the motion of particles.
        friction: Coulomb's coefficient of the domain's walls and of each solid.
        prescribed: allocate velocities on faces even if no solid moves, since sources prescribe
            some.
        cuts: let solids cut cells for the stresses too, if they do so in `boundary`; not along
            periodic axes, with bodies that sand moves, or moving solids thinner than cells.

    Attributes:
        cut: open fractions and walls of cut cells; None if solids are whole cells.
        index: int32, -1 in open cells, the wall number elsewhere.
        base: int8, SOLID or AIR.
        velocity: velocity of whole cells of solids, and of sources, on each component's faces
            [m/s]; empty if there is none.
        separating: uint8 of each wall: all ones.
        walls: faces between open cells and solids; a new object whenever cells have changed.
        notes: warnings for the start of a run.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        placed: Sequence[PlacedSolid],
        boundary: Boundary,
        friction: Sequence[float],
        *,
        prescribed: bool = False,
        cuts: bool = False,
    ) -> None:
        # Cells whose walls are included; None for all.
        self._counted = grid.part.owned if grid.part.shared else None
        self.grid, self._placed, self._boundary, self._friction = (
            grid,
            tuple(placed),
            boundary,
            list(friction),
        )
        self.base, self.index = grid.field(wp.int8), grid.field(wp.int32)
        self.separating = wp.full(1 + len(placed), 1, dtype=wp.uint8, device=grid.device)
        self._setting = LaunchGraph(grid.device, self._launch_velocity)
        # Middles of the solids, whose images along periodic axes have their velocity; lengths of
        # these axes.
        self._middle: wp.array | None = None
        self._length = wp.vec3()
        if boundary.moves and boundary.sides is not None:
            self._middle = wp.zeros(1 + len(placed), dtype=wp.vec3, device=grid.device)
            endless = [axis in boundary.sides.endless for axis in range(3)]
            self._length = wp.vec3(*np.where(endless, grid.extent, 0.0))
        self._cells: np.ndarray | None = None  # `index` for which `walls` was built
        self._floats = any(isinstance(solid.motion, BodyMotion) for solid in placed)
        self.cut = (
            CutWalls(grid, boundary.cut, friction, self._counted)
            if cuts and isinstance(boundary, CutBoundary) and self._fit(boundary)
            else None
        )
        whole_cells_move = boundary.moves and self.cut is None
        self.velocity: Faces = grid.faces() if whole_cells_move or prescribed else []
        self.place(0.0)
        whole = isinstance(boundary, CutBoundary) and self.cut is None
        self.notes = (*self._thin_notes(), *((self._whole_note(cuts),) if whole else ()))

    def _fit(self, boundary: CutBoundary) -> bool:
        """Return whether the solids can cut cells for the stresses."""
        thin_ones_move = boundary.moves and boundary.barriers is not None
        return boundary.sides is None and not self._floats and not thin_ones_move

    @property
    def host_index(self) -> np.ndarray:
        """`index` on the host, read-only, if solids move."""
        assert self._cells is not None
        return self._cells

    @property
    def moves(self) -> bool:
        """Return whether a solid moves."""
        return self._boundary.moves

    def place(self, time: float) -> np.ndarray:
        """Place the solids at their positions at `time` [s], after those of `boundary`.

        Returns:
            Flat indices of the cells in which a wall that cut them is gone.
        """
        grid = self.grid
        if self.cut is not None and self._cells is not None:
            wp.copy(self.base, self._boundary.base)
            return self.cut.place()
        now = [
            solid
            if solid.motion is None
            else PlacedSolid(
                geometry=solid.geometry.moved(solid.motion.pose(time)),
                separating=True,
                name=solid.name,
            )
            for solid in self._placed
        ]
        starts = self._cells is None
        voxels = voxelize(
            grid,
            now,
            wall_separating=True,
            open_sides=self._boundary.open_sides,
            remarks=False,
            counts=starts,
        )
        if starts:
            self._covered = voxels.covered
        wp.copy(self.index, voxels.index)
        if grid.barriers is not None:
            grid.barriers.enter(self.index)
        if self._boundary.sides is not None:
            self._boundary.sides.wrap(self.index)
        grid.part.fill(self.index)
        grid.everywhere.launch(kernels.base_kernel, [self.index, self.base])
        cells = self.index.numpy()
        if self.cut is not None:  # only the domain's walls are whole cells
            wp.copy(self.base, self._boundary.base)
            cells = cells.copy()
            grid.interior(cells)[...] = -1
        # Otherwise recorded launches for these walls stay valid.
        if self._cells is None or not np.array_equal(cells, self._cells):
            rubbing = not self.moves or self.cut is not None
            self._cells, self.walls = (
                cells.copy(),
                SandWalls(grid, cells, self._friction, rubbing_only=rubbing, counted=self._counted),
            )
        return np.zeros(0, dtype=np.int64)

    def _thin_notes(self) -> tuple[str, ...]:
        """Return a warning for each solid at rest that is too thin for the stresses."""
        # Number of cell centers in each solid.
        covered = self.grid.part.ranks.sum(np.array([*self._covered, 0]))[:-1]
        barrier_numbers = self.grid.barriers.walls.numbers if self.grid.barriers is not None else ()
        return tuple(
            f"{solid.name} contains no center of a cell of {self.grid.spacing:.4g} m: it supports "
            "no sand, and particles may pass through"
            for number, (solid, cells) in enumerate(
                zip(self._placed, covered.tolist(), strict=True), start=1
            )
            if self.cut is None
            and not cells
            and solid.motion is None
            and number not in barrier_numbers
        )

    def _whole_note(self, cuts: bool) -> str:
        """Return the reason why solids that cut cells are whole cells for the stresses."""
        reason = (
            "sand moves some of them"
            if self._floats
            else "an axis is periodic"
            if cuts and self._boundary.sides is not None
            else "solids thinner than cells move"
            if cuts
            else 'solver.method is "interleaved-sweeps"'
        )
        return (
            'the stress solve uses whole cells for solids, as with domain.solids = "voxel", '
            f"because {reason}: sand may rest up to half "
            "a cell off their surfaces; particles collide with the surfaces"
        )

    def begin_step(self, time: float, dt: float) -> None:
        """Compute the solids' velocities in the step from `time` [s] of length `dt` [s]."""
        self._boundary.begin_step(time, dt)
        if self.cut is not None and self.moves:
            self.cut.find_velocity()
        if self.velocity:
            if self._middle is not None:
                self._middle.assign(self._middles(time))
            self._setting.run()
            if self.moves and self.grid.part.joined:
                # Periodic axes: the values come from the opposite side.
                self.grid.part.fill(*self.velocity)

    def _middles(self, time: float) -> np.ndarray:
        """Return the middles of the boxes around the solids at a time [s], shape (1 + solids, 3).

        The domain's, and those of unbounded solids, are 0 [m]; so is z in 2-D.
        """
        axes = slice(self.grid.dimension)
        middles = np.zeros((1 + len(self._placed), 3), dtype=np.float32)
        for number, solid in enumerate(self._placed, start=1):
            box = solid.geometry.bounds()
            if box is not None and np.isfinite(box[:, axes]).all():
                middle = np.zeros(3)
                middle[axes] = np.mean(box[:, axes], axis=0)
                if solid.motion is not None:
                    pose = solid.motion.pose(time)
                    middle = pose.rotation @ middle + pose.translation
                middles[number] = middle
        return middles

    def _launch_velocity(self) -> None:
        """Launch the update of the velocity of the solids' faces."""
        boundary, grid = self._boundary, self.grid
        if self.moves and self.cut is None and isinstance(boundary, CutBoundary):
            cut = boundary.cut
            for axis, field in enumerate(self.velocity):
                inputs = [
                    axis,
                    grid.planes,
                    grid.spacing,
                    wp.vec3i(*grid.origin),
                    self.index,
                    cut.turn,
                    cut.shift,
                    self._middle,
                    self._length,
                    field,
                ]
                grid.everywhere.launch(kernels.wall_velocity_kernel, inputs)
        else:
            clear(*self.velocity)  # clear the values of sources that have stopped


def wall_faces(
    index: np.ndarray, dimension: int, counted: Window | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces between open cells and solids, by cell.

    Args:
        index: int, -1 in open cells, the wall number elsewhere; shape of the grid's fields.
        dimension: 2 or 3.
        counted: cells whose faces are included; None for all.

    Returns:
        For each face its open cell's flat index (int32), 2 axis + side (uint8) and its wall number
        (int32).
    """
    faces: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    inner = np.zeros(index.shape, dtype=bool)
    inner[
        (slice(1, -1),) * 3 if counted is None else tuple(map(slice, counted.low, counted.high))
    ] = True
    flat, open_ = index.ravel(), np.flatnonzero((index.ravel() < 0) & inner.ravel())
    for axis, stride in zip(
        range(dimension), (1, index.shape[2], index.shape[1] * index.shape[2]), strict=False
    ):
        for side in range(2):
            beyond = open_ + (stride if side else -stride)
            wall = flat[beyond]
            at = wall >= 0
            faces.append((open_[at], np.full(int(at.sum()), 2 * axis + side), wall[at]))
    cells, sides, walls = (np.concatenate(parts) for parts in zip(*faces, strict=True))
    order = np.argsort(cells, kind="stable")
    return (
        cells[order].astype(np.int32),
        sides[order].astype(np.uint8),
        walls[order].astype(np.int32),
    )
