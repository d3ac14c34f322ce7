"""Barriers: solids thinner than cells, which separate material on their sides.

A face between two cells is closed where a solid stands between the cells' centers, although neither
center lies in it. The face has the velocity of the solid there.

All exchange takes place along lines of sight. A particle contributes to the faces and cells that it
sees in a straight line, and a field is extrapolated from places that are seen. Faces that a
particle does not see get the mean of those that it sees. Both sides so have velocities, pressures,
densities and a surface of their own, in the same fields: a place belongs to the side of the wall
that it lies on.

Far from these solids nothing changes, and the cost is one byte a cell.
"""

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import warp as wp

from warp_lcp.grid import barrier_faces_kernels as faces_kernels
from warp_lcp.grid import barrier_transfer_kernels as transfer_kernels
from warp_lcp.grid import barrier_velocity_kernels as velocity_kernels
from warp_lcp.grid.barrier_fields import binomial_kernel, shift_kernel, surrounded_kernel
from warp_lcp.grid.barrier_geometry import CENTERS, REACH, Barrier
from warp_lcp.grid.barrier_volume import filled_kernel
from warp_lcp.grid.cell_kernel import POINTS, launch_list, list_kernel
from warp_lcp.grid.cut_cells import CutCells
from warp_lcp.grid.domain_sides import PeriodicSides
from warp_lcp.grid.motion import RigidMotion
from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid, Window, three_components
from warp_lcp.grid.thin_walls import ThinWalls
from warp_lcp.kernels.launch_graph import copy
from warp_lcp.operators.grid_poisson import FLUID

# Cells. The level set and velocities are extrapolated two layers into thicker solids, which cut
# cells; in thinner solids these layers would overlap those of the other side.
BARRIER = 3.0
SAMPLES = {2: 96, 3: 12}  # lines per axis of a face, for the part that a solid's edge leaves open
# Rays per edge of a density kernel's support, for the share of it that a cell's center sees. In 2-D
# the share of a half space is right to 0.004, in 3-D to 0.03.
RAYS = {2: 24, 3: 6}
COST = 256  # work of a particle, in cells of a usual pass
Faces = Sequence[wp.array]


@list_kernel("warp_lcp.grid.barriers.bring")
@no_type_check
def bring_kernel(i, start: POINTS, aim: POINTS, position: POINTS):
    """Move a particle to its target, unless the target is its start."""
    a = aim[i]
    s = start[i]
    if a[0] != s[0] or a[1] != s[1] or a[2] != s[2]:
        position[i] = a


class Barriers:
    """Faces that thin solids cross, and transfers that stay on one side of the solids.

    Args:
        grid: the grid.
        walls: the solids.
        cut: cut cells of the other solids; it has the velocities of all solids.
        sides: periodic sides; None if there are none.

    Attributes:
        near: uint8, not 0 in cells near one of the solids: 1, INSIDE if their center is in a mesh.
        apart: uint8 for the faces of each component and, last, the cells: bit d is set where a
            solid stands between a place and the one before it along axis d.
        number: int16, one field a component: the solid that crosses a lower face, 0 if none does.
        below: float32, one field a component: distance from the center of the cell below a crossed
            face to the solid [cells].
        above: the same from the cell above.
        sight: uint8, one field a component: the point of a face that a thin solid closes in part
            where lines of sight end, as a byte (`warp_lcp.grid.barrier_geometry.sight_code`); 0 on
            other faces, whose lines end at their center.
        calm: int8, base of the cells, SOLID in those near the solids: where particles may not be
            taken from one cell to another.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        walls: ThinWalls,
        cut: CutCells,
        sides: PeriodicSides | None = None,
    ) -> None:
        self.grid, self.walls, self.cut, self._periodic = grid, walls, cut, sides
        self.near = grid.field(wp.uint8)
        self.apart = [grid.field(wp.uint8) for _ in range(grid.dimension + 1)]
        self.number, self._share, self._scratch = grid.faces(wp.int16), grid.field(), grid.faces()
        self.below, self.above = grid.faces(), grid.faces()
        self._share.fill_(1.0)
        self.sight = grid.faces(wp.uint8)
        fixed = [True, *(not isinstance(solid.motion, RigidMotion) for solid in cut.solids)]
        self._fixed = wp.array(fixed, dtype=wp.uint8, device=grid.device)
        self._barrier = self._barrier_of(grid, walls.shapes)
        # Barriers are only near the thin parts of solids.
        self._thin = self._barrier_of(grid, walls.thin_shapes)
        margin = np.full(3, MARGIN * grid.spacing)
        self._sides = wp.vec3(*margin), wp.vec3(*(grid.extent - margin))
        self.calm = grid.field(wp.int8)
        self._window: Window | None = None
        self._aim = wp.empty(0, dtype=wp.vec3, device=grid.device)
        self._place()

    def _barrier_of(self, grid: StaggeredGrid, shapes: wp.array) -> Barrier:
        """Return shapes of the solids and a grid, as kernels take them."""
        barrier = Barrier()
        barrier.shapes, barrier.groups, barrier.near = shapes, self.walls.groups, self.near
        barrier.planes, barrier.dx = grid.planes, grid.spacing
        barrier.origin = wp.vec3i(*grid.origin)
        barrier.sight_x, barrier.sight_y, barrier.sight_z = three_components(self.sight)
        return barrier

    def place(self, time: float) -> None:
        """Move the solids to a time [s], after those of the cut cells."""
        if self.walls.moves:
            self.walls.place(time)
            self._place()

    def _place(self) -> None:
        """Find the cells, faces and neighbors that the solids separate."""
        grid, barrier = self.grid, self._barrier
        now = self._around()
        # Cells that are no longer near are unmarked.
        before, self._window = self._window or now, now
        low, high = [*map(min, now.low, before.low)], [*map(max, now.high, before.high)]
        self._all = Window.of(low, high, grid.device)
        self._all.launch(faces_kernels.near_kernel, [self._thin, self.near])
        if self.walls.has_meshes:
            self._all.launch(faces_kernels.inside_kernel, [barrier, self.near])
        self._all.launch(faces_kernels.apart_kernel, [barrier, CENTERS, self.apart[-1]])
        self._wrap(self.near, self.apart[-1])
        rays = RAYS[grid.dimension]
        self._all.launch(faces_kernels.ray_share_kernel, [barrier, rays, self._share])

    def _around(self) -> Window:
        """Return the cells near the solids, cells of the ring included."""
        grid = self.grid
        low, high = self.walls.bounds()
        first = np.clip(
            np.floor(low / grid.spacing) - np.array(grid.origin), -1, np.array(grid.counts)
        ).astype(int)
        last = np.clip(
            np.floor(high / grid.spacing) - np.array(grid.origin), -1, np.array(grid.counts)
        ).astype(int)
        return grid.window(first.tolist(), last.tolist(), grow=int(np.ceil(REACH)) + 1, shift=1)

    def cross(self) -> None:
        """Close the faces that the solids cross, after the cut cells have been placed."""
        cut, barrier = self.cut, self._barrier
        for axis, (number, open_, wall) in enumerate(
            zip(self.number, cut.open, cut.wall, strict=True)
        ):
            gaps = self.below[axis], self.above[axis]
            if cut.velocity is not None:
                self._all.launch(
                    faces_kernels.forget_kernel, [number, self.sight[axis], cut.velocity[axis]]
                )
            self._all.launch(
                faces_kernels.cross_kernel,
                [barrier, axis, self.apart[-1], cut.distance, open_, wall, number, *gaps],
            )
        # Rounding must not make the two copies of a face differ: the solid would be lost where each
        # of the two gives the other's cell to it (`enter`).
        self._wrap(*self.number, *self.below, *self.above, *cut.open, *cut.wall)
        self._find_edges()
        self._wrap(*cut.open, *self.sight)
        for axis, apart in enumerate(self.apart[:-1]):
            self._all.launch(faces_kernels.apart_kernel, [barrier, axis, apart])
            self._wrap(apart)
        inner = self._all.common(self.grid.domain)
        if inner is not None:
            inner.launch(
                faces_kernels.solid_kernel, [barrier, *(*cut.open, *cut.open[:1])[:3], cut.base]
            )
        self.grid.everywhere.launch(faces_kernels.calm_kernel, [self.near, cut.base, self.calm])
        if cut.capacity is not None:
            self._all.launch(
                faces_kernels.capacity_kernel,
                [self._share, bool(self.walls.in_parts), cut.capacity],
            )

    def _wrap(self, *fields: wp.array) -> None:
        """Fill the ring of fields beyond periodic sides, if there are any."""
        if self._periodic is not None:
            self._periodic.wrap(*fields)

    def _find_edges(self) -> None:
        """Find the open fractions of faces in which thin solids end."""
        crossings = faces_kernels.CrossedFaces()
        fields = {
            "number": self.number,
            "below": self.below,
            "above": self.above,
            "wall": self.cut.wall,
        }
        for name, components in fields.items():
            for letter, field in zip("xyz", components, strict=False):
                setattr(crossings, f"{name}_{letter}", field)
        samples = SAMPLES[self.grid.dimension]
        for axis, (open_, sight) in enumerate(zip(self.cut.open, self.sight, strict=True)):
            self._all.launch(
                faces_kernels.edge_kernel,
                [self._barrier, axis, crossings, self._fixed, samples, open_, sight],
            )

    def set_velocity(self) -> None:
        """Set the velocity of the crossed faces, after those of the cut cells."""
        cut = self.cut
        for axis, (number, velocity) in enumerate(
            zip(self.number, cut.velocity or (), strict=False)
        ):
            self._all.launch(
                faces_kernels.wall_velocity_kernel,
                [self._barrier, axis, number, cut.turn, cut.shift, velocity],
            )

    def limit_room(self, lattice: StaggeredGrid, room: wp.array) -> None:
        """Limit the distance to solids by that to the thin ones, which count as thicker.

        Args:
            lattice: a finer grid of the same region.
            room: distance at its cells' centers [lattice cells], float32 (updated).
        """
        barrier = self._barrier_of(lattice, self.walls.shapes)
        lattice.domain.launch(faces_kernels.room_kernel, [barrier, room])

    def enter(self, index: wp.array) -> None:
        """Mark whole cells as the solids' cells.

        Of the two cells beside a crossed face the nearer one belongs to the solid.

        Args:
            index: int32: -1 in open cells, the wall's number elsewhere (updated).
        """
        for axis, (number, below, above) in enumerate(
            zip(self.number, self.below, self.above, strict=True)
        ):
            self._all.launch(faces_kernels.whole_kernel, [axis, number, below, above, index])

    def placed(self) -> list[wp.array]:
        """Return the fields of the placed solids, whose ghost cells other ranks fill."""
        return [
            self.near,
            *self.apart,
            *self.number,
            *self.below,
            *self.above,
            *self.sight,
            self.calm,
        ]

    @property
    def reach(self) -> Window:
        """Cells near the solids at their current and previous places."""
        return self._all

    @property
    def names(self) -> list[str]:
        """Return the names of the solids for messages."""
        return [self.cut.names[number] for number in self.walls.numbers]

    def notes(self) -> list[str]:
        """Return a warning for each solid that is beside a too narrow gap; collective."""
        cut, part = self.cut, self.grid.part
        inner = self._all.common(part.owned)
        gaps = wp.zeros(len(cut.names), dtype=wp.int32, device=self.grid.device)
        if inner is not None:
            for axis, (number, open_) in enumerate(zip(self.number, cut.open, strict=True)):
                inner.launch(faces_kernels.gap_kernel, [self._barrier, axis, open_, number, gaps])
        cell = f"a cell of {self.grid.spacing:.4g} m"
        return [
            f"{name}: a gap beside it is narrower than {cell} and lets nothing through ({count} "
            "faces of cells)"
            for name, count in zip(cut.names, part.ranks.sum(gaps.numpy()).tolist(), strict=True)
            if count
        ]

    def particles_to_faces(
        self,
        window: Window,
        axis: int,
        offsets: wp.array,
        position: wp.array,
        velocity: wp.array,
        gradient: wp.array | None,
        field: wp.array,
        weight: wp.array,
    ) -> None:
        """Average velocities again on faces near the solids.

        Arguments as of `warp_lcp.grid.transfer.particles_to_faces`.
        """
        window.launch(
            transfer_kernels.gather_kernel,
            [self._barrier, axis, offsets, position, velocity, gradient, field, weight],
        )

    def faces_to_particles(
        self,
        axis: int,
        field: wp.array,
        saved: wp.array | None,
        flip: float,
        before: wp.array,
        position: wp.array,
        velocity: wp.array,
        gradient: wp.array | None,
    ) -> None:
        """Interpolate velocities again at particles near the solids.

        Args as of `warp_lcp.grid.transfer.faces_to_particles`, but:
            before: velocities before, for FLIP [m/s].
        """
        given = [self._barrier, axis, field, saved, flip, before, position, velocity, gradient]
        launch_list(
            transfer_kernels.interpolate_kernel,
            len(position),
            given,
            device=self.grid.device,
            cost=COST,
        )

    def density(
        self, window: Window, offsets: wp.array, position: wp.array, density: wp.array, each: float
    ) -> None:
        """Add up the particles again in cells near the solids; each adds `each`."""
        window.launch(
            transfer_kernels.density_kernel, [self._barrier, each, offsets, position, density]
        )

    def smooth(self, window: Window, source: wp.array, out: wp.array) -> None:
        """Repeat a binomial pass near the solids, with values from the same side only.

        Args:
            window: cells of the pass.
            source: float32 field.
            out: result of the pass (updated).
        """
        given = [self.near, self.apart[-1], self.grid.planes, source, out]
        window.launch(binomial_kernel, given)

    def surround(self, window: Window, inside: wp.array, around: wp.array) -> None:
        """Find the cells near the solids whose neighbors on the same side are all inside.

        Args:
            window: cells to consider.
            inside: uint8, 1 in cells inside the material and in solids, 0 elsewhere.
            around: uint8: 1 if the cell and all neighbors that it sees are inside, 0 if not,
                `warp_lcp.grid.barrier_fields.FAR` away from the solids (written).
        """
        given = [self.near, self.apart[-1], self.grid.planes, inside, around]
        window.launch(surrounded_kernel, given)

    def shift(
        self,
        window: Window,
        variance: float,
        limit: float,
        capacity: wp.array,
        phi: wp.array,
        known: wp.array,
        out: wp.array,
    ) -> None:
        """Shift a smooth distance back to the cells' centers again, near the solids.

        Args as of `warp_lcp.grid.level_set_kernels.wall_shift_kernel`, but:
            window: cells of the pass.
        """
        given = [self.near, self.apart[-1], self.grid.planes, variance, limit]
        window.launch(shift_kernel, [*given, capacity, phi, known, out])

    def fill(
        self,
        window: Window,
        phi: wp.array,
        known: wp.array,
        distance: wp.array | None,
        filled: wp.array | None,
    ) -> None:
        """Find the share of each cell near the solids that liquid fills.

        Args:
            window: cells of the pass.
            phi: distance to the surface at the cells' centers [cells], float32, < 0 in the liquid.
            known: int8, 1 where phi is that of an open cell.
            distance: distance to thick solids at the cells' low corners [cells], float32, if any.
            filled: share, float32; -1 where solids are too far away to matter (updated).
        """
        nodes = phi if distance is None else distance
        given = [self._barrier, self.apart[-1], phi, known, nodes, distance is not None, filled]
        window.launch(filled_kernel, given)

    def carry(self, velocity: Faces, dt: float, start: wp.array) -> None:
        """Advect particles near the solids by the velocity that they see.

        The solids have not moved yet. `bring` moves the particles later.

        Args:
            velocity: velocity of each component on the faces [m/s].
            dt: time step [s].
            start: places of the particles [m], shape (n,).
        """
        if len(start) == 0:  # a rank without material
            return
        if len(self._aim) < len(start):
            self._aim = wp.empty(
                len(start) + len(start) // 4, dtype=wp.vec3, device=self.grid.device
            )
        aim = self._aim[: len(start)]
        copy(aim, start)
        ends = [*self._sides, wp.vec3(*self.walls.least), wp.vec3(*self.walls.most)]
        fields = three_components(velocity)
        given = [self._barrier, self.cut.distance, *fields, dt, *ends, start, aim]
        launch_list(
            transfer_kernels.carry_kernel, len(start), given, device=self.grid.device, cost=COST
        )

    def bring(self, start: wp.array, position: wp.array) -> None:
        """Move particles to the places that `carry` has found.

        Args:
            start: places before the step, as passed to `carry`.
            position: places of all particles after the step [m], shape (n,) (updated).
        """
        if len(position) == 0:
            return
        launch_list(
            bring_kernel,
            len(position),
            [start, self._aim[: len(position)], position],
            device=self.grid.device,
        )

    def constrain(
        self,
        window: Window,
        velocity: Faces,
        known: Faces,
        kind: wp.array,
        contact: wp.array,
        released: int,
    ) -> None:
        """Remove the velocity through the walls from crossed faces.

        Args:
            window: faces to consider.
            velocity: velocity of each component [m/s] (updated).
            known: int8, positive where it is known (updated: 0 on crossed faces).
            kind: int8 of AIR, FLUID, SOLID.
            contact: uint8, `released` where material leaves its wall.
            released: see there.
        """
        components, marks = velocity_kernels.FaceComponents(), velocity_kernels.FaceMarks()
        components.u, components.v, components.w = three_components(velocity)
        marks.u, marks.v, marks.w = three_components(known)
        opened = self.cut.open
        for axis, (number, open_, result) in enumerate(
            zip(self.number, opened, self._scratch, strict=True)
        ):
            kernel_args = [
                self._barrier,
                axis,
                number,
                open_,
                components,
                marks,
                self.cut.turn,
                self.cut.shift,
                kind,
                contact,
                FLUID,
                released,
                result,
            ]
            window.launch(velocity_kernels.constrain_kernel, kernel_args)
        for number, open_, result, field, mark in zip(
            self.number, opened, self._scratch, velocity, known, strict=True
        ):
            window.launch(
                velocity_kernels.copy_constrained_kernel, [number, open_, result, field, mark]
            )
