"""Cut cells: open fractions of faces and the velocity of solids.

They are computed from the solids' signed distances at the nodes of the grid (the cells' corners),
linear in between. This is exact for planes and of second order for smooth walls. At a solid's
edges, and where it or a gap is thinner than two cells, the error is a part of a cell.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import groupby
from operator import le, lt

import numpy as np
import warp as wp

from warp_lcp.grid import cut_cells_kernels as kernels
from warp_lcp.grid.cut_cells_kernels import integrate_kernel
from warp_lcp.grid.distributed_distance import enter_layers, measure_together
from warp_lcp.grid.domain_sides import SIDES, continue_beyond, open_ring
from warp_lcp.grid.motion import Motions, Pose
from warp_lcp.grid.moving_mesh_distance import FlatCells, MovingMesh, tables_of
from warp_lcp.grid.node_distance import (
    NodeBox,
    NodeDistances,
    NodeSampler,
    ShapeTable,
    box_near,
    node_window,
)
from warp_lcp.grid.signed_distance import Geometry, TriangleMesh
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid
from warp_lcp.grid.voxelize import PlacedSolid, check_open, start_notes
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.launch_graph import LaunchGraph, clear, copy
from warp_lcp.operators.grid_poisson import SOLID

CLOSE = 1.0  # cells from a solid within which the two sides of a periodic axis must agree
NOWHERE: NodeBox = (0, 0, 0), (0, 0, 0)  # a box without nodes

DEEP = 1e-2  # cells from a solid's surface within which a node lies on it


class CutCells:
    """Cut cells: open fractions of faces and cells beside solids at a time.

    Node (k, j, i) is the low corner of stored cell (k, j, i), face (k, j, i) of a component the
    cell's lower face; 2-D uses plane k = 1. On a rank's part of a grid making it, and `place`, are
    collective where solids move or periodic axes are cut.

    Args:
        grid: the grid.
        solids: in the order of their numbers, 1 + s; the domain is number 0.
        wall_separating: whether liquid may leave the domain's wall.
        capacity: whether to keep the capacity.
        remarks: write notes about faces, and refuse a grid without open cells; False for a part of
            a larger grid.
        left_out: numbers of solids that cut no cells; their velocities are still computed.
        held: numbers of solids that may be thinner than cells without a note.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: there the faces are open as far
            as no solid closes them, and the ring is air.
        repeated_sides: bits of the sides of periodic axes, whose faces are open likewise; the ring
            there has no state of its own.

    Attributes:
        distance: float32 signed distance to the nearest solid at nodes [cells], positive in the
            open, exact below `FAR` cells; others are at least that. Without the domain's walls:
            beside them linear interpolation would close what is open by less than a cell.
        nearest: the solids' two nearest to each node, see `NodeDistances`: owner, next_near,
            next_owner; empty when no solid moves.
        open: float32 open fraction of each face, a list of one field a component: 0, or in [1e-3,
            1]; 0 on the domain's faces and outside, except at open and repeated sides.
        wall: int16 number of the solid that closes a face, the nearest to its center: -1 on open
            faces, 0 on the domain's.
        base: int8, SOLID where all faces of a cell are closed, else AIR; the ring is SOLID.
        capacity: float32 integral of the cell's quadratic B-spline kernel over the open space, 1
            away from walls; None if not requested.
        velocity: float32 mean velocity of the closed part of each face [m/s], the component along
            the face's normal: that of the moving solid, times its part; None when no solid moves.
        turn: mat33 of shape (1 + solids,): the velocity of a solid's point x is turn x + shift
            [1/s].
        shift: vec3 [m/s].
        separating: uint8 of shape (1 + solids,).
        names: names of the solids by number, the first "domain".
        notes: warnings for the start of a run.
        whole_cells: whether every face is open or closed, no solid reaches into a cell with an open
            face and nothing moves.
        moves: whether a solid moves.
        moving: kernel argument with the moving solids that cover a face.

    Raises:
        ValueError: a solid that stands still lies wholly outside the domain, or the solids leave no
            open cell.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        solids: Sequence[PlacedSolid],
        *,
        wall_separating: bool,
        capacity: bool = True,
        open_sides: int = 0,
        remarks: bool = True,
        left_out: Collection[int] = (),
        held: Collection[int] = (),
        repeated_sides: int = 0,
    ) -> None:
        self.grid, self.solids, self.open_sides, self._left_out = (
            grid,
            tuple(solids),
            open_sides,
            frozenset(left_out),
        )
        self._sides_with_faces = open_sides | repeated_sides
        self.moves = any(solid.motion is not None for solid in solids)
        # Differences of distances between the sides of each periodic axis that is cut [cells].
        self._differences: dict[int, float] = {}
        self.names = ("domain", *(solid.name for solid in solids))
        self.separating = wp.array(
            [wall_separating, *(solid.separating for solid in solids)],
            dtype=wp.uint8,
            device=grid.device,
        )
        self.open, self.wall = grid.faces(), grid.faces(wp.int16)
        self.base, self._state = grid.field(wp.int8), grid.field(wp.int8)
        if open_sides:
            self._state.assign(
                np.where(open_ring(grid.shape, open_sides), kernels.OPEN, kernels.CLOSED).astype(
                    np.int8
                )
            )
        self.capacity = grid.field() if capacity else None
        self.velocity = grid.faces() if self.moves else None
        self._counts = wp.zeros(2, dtype=wp.int32, device=grid.device)
        self._turn, self._shift = (
            HostArray(1 + len(solids), of, grid.device) for of in (wp.mat33, wp.vec3)
        )
        self.turn, self.shift = self._turn.array, self._shift.array
        notes = start_notes(self.solids, grid, held)
        self._sampler, self._nodes = NodeSampler(grid), NodeDistances(grid, second=len(solids) > 1)
        self.distance = self._nodes.near
        self.nearest = self._nodes.arrays[1:] if self.moves else []
        standing = [
            (number, solid.geometry) for number, solid in self._cutting() if solid.motion is None
        ]
        for number, geometry in standing:
            self._sampler.enter(self._nodes, number, geometry)
        self._marks = wp.array(_ring(grid, open_sides), dtype=wp.int8, device=grid.device)
        self._sampler.look_at_centers(
            self._nodes,
            lambda: [geometry for _, geometry in standing],
            (0, 0, 0),
            grid.shape[::-1],
            self._marks,
        )
        wp.copy(self.base, self._marks)
        # Nodes near the moving solids at the last update of the velocity.
        self._moved_from: NodeBox | None = None
        # Nodes near the moving solids at their current places.
        self._moved_to: NodeBox | None = None
        moving = [
            (number, solid)
            for number, solid in enumerate(solids, start=1)
            if solid.motion is not None
        ]
        self.motions, self._moving = (
            Motions([solid.motion for _, solid in moving if solid.motion is not None]),
            [number for number, _ in moving],
        )
        next_to_each_other = len(moving) and self._moving[-1] - self._moving[0] == len(moving) - 1
        self._moves = (
            slice(self._moving[0], self._moving[-1] + 1) if next_to_each_other else self._moving
        )
        if self.moves:
            self._runs = list(
                _runs(grid, [(number, solid.geometry) for number, solid in moving], self._left_out)
            )
            self._standing = NodeDistances(grid, second=len(solids) > 1)
            self._standing.copy_from(self._nodes)
            self._flat = self._flat_cells(standing)
            self._near, self._swept = ActiveWindow(grid.domain), ActiveWindow(grid.domain)
            # A mesh is measured in parts, and the host decides about each part.
            measured = any(isinstance(run, int) for run in self._runs)
            self._entering = LaunchGraph(grid.device, self._launch_entering, at_once=measured)
            self._refreshing = LaunchGraph(grid.device, self._launch_refreshing)
            self._before = self._after = lambda: None
            self._filling = LaunchGraph(grid.device, self._launch_velocity)
            self.moving = kernels.MovingSolids()
            self.moving.nodes, self.moving.standing = self._nodes.struct, self._standing.near
            self.moving.moves = wp.array(
                [False, *(s.motion is not None for s in solids)], dtype=wp.uint8, device=grid.device
            )
            self.place(0.0)
        else:
            self._join()
            self._refresh()
        dropped, partial = self._counts.numpy().tolist()
        self.whole_cells = partial == 0 and not self.moves and not self._reaches_into_open_cells()
        self.notes = (*notes, *(self._result_notes(dropped) if remarks else ()))
        if not self.moves:  # needed by `place` only
            del self._sampler, self._nodes, self._marks

    def _cutting(self) -> Iterator[tuple[int, PlacedSolid]]:
        """Yield the solids that cut cells, with their numbers."""
        return (
            (number, solid)
            for number, solid in enumerate(self.solids, start=1)
            if number not in self._left_out
        )

    @property
    def dropped(self) -> int:
        """Number of faces with an open fraction below 1e-3, set to 0."""
        return int(self._counts.numpy()[0])

    def move(self, time: float, dt: float) -> None:
        """Move the solids to a time and set their velocity.

        The velocity is that of the step that ends then; nothing happens if none moves.

        Args:
            time: [s].
            dt: the step that ends at `time` [s].
        """
        self.place(time)
        self.set_velocity(time, -dt)

    def place(self, time: float) -> None:
        """Place the solids at a time [s] and recompute all fields but the velocity.

        Nothing happens if none moves.
        """
        if not self.moves:
            return
        self._enter_moving(time)
        self._join()
        self._refreshing.run()

    def accompany(self, before: Callable[[], None], after: Callable[[], None]) -> None:
        """Register launches of `place`: before distances change, and at the end."""
        self._before, self._after = before, after
        self._entering.forget()
        self._refreshing.forget()

    def set_velocity(self, time: float, dt: float) -> None:
        """Set the velocity: displacement of the solids' points over a time, divided by it.

        The volume that a wall sweeps so equals that of its displacement, whatever the motion within
        the step. Bodies that the material moves have the velocities of their state: these are what
        the material changes, and a rotation of such a field changes no volume.

        Args:
            time: time at which the solids were placed [s].
            dt: how long from there on [s]; negative: the step that ended at `time`.

        Raises:
            ValueError: dt is 0.
        """
        if self.velocity is None:
            return
        if dt == 0.0:
            raise ValueError("dt = 0: a velocity needs two different times")
        self._turn.host[self._moves], self._shift.host[self._moves] = self.motions.velocity_fields(
            time, dt
        )
        self._turn.send()
        self._shift.send()
        near = _around([box for box in (self._moved_from, self._moved_to) if box is not None])
        if near is None:
            return
        first = [max(start, 1) for start in near[0]]
        end = [min(stop, count + 2) for stop, count in zip(near[1], self.grid.counts, strict=True)]
        if all(map(lt, first, end)):
            self._swept.move_to(node_window(self.grid, first, end))
            self._filling.run()
        self._moved_from = self._moved_to

    def _launch_velocity(self) -> None:
        """Launch the pass that sets the velocity of the solids on faces."""
        assert self.velocity is not None, "a solid moves"
        grid = self.grid
        # 2-D has no third component.
        fields = [
            field
            for each in (self.open, self.wall, self.velocity)
            for field in (*each, *each[1:2])[:3]
        ]
        inputs = [
            self.moving,
            grid.planes,
            grid.spacing,
            wp.vec3i(*grid.origin),
            wp.vec3i(*grid.counts),
        ]
        self._swept.launch(
            kernels.velocity_kernel, [*inputs, *fields[:6], self.turn, self.shift, *fields[6:]]
        )

    def moving_block(self) -> tuple[list[int], list[int]] | None:
        """Return the block of cells beside moving solids, or None.

        Low and high cell (x, y, z), both included.
        """
        if self._moved_to is None:
            return None
        first, last = (
            [max(start - 1, 1) for start in self._moved_to[0]],
            list(map(min, self._moved_to[1], self.grid.counts)),
        )
        return (first, last) if all(map(le, first, last)) else None

    def _enter_moving(self, time: float) -> None:
        """Enter the distances of the moving solids, and repeat the test of flat cells.

        Flat cells have distance 0 at all corners; only their centers show whether they are open.
        """
        rotations, translations = self.motions.poses([time])
        self._poses = rotations[0], translations[0]
        self._placed_at: dict[int, Geometry] = {}
        for run in self._runs:
            if not isinstance(run, int):
                run.place(rotations[0, run.places], translations[0, run.places])
        boxes = [
            box_near(self.grid, self._placed(run)) if isinstance(run, int) else run.box
            for run in self._runs
        ]
        self._moved_to = _around([box for box in boxes if box is not None])
        self._near.move_to(
            node_window(self.grid, *self._sampler.inner(*(self._moved_to or NOWHERE)))
        )
        self._entering.run()
        if self._moved_to is not None and self._flat is None:
            self._sampler.look_at_centers(
                self._nodes, self._all_placed, *self._moved_to, self.base, listed=True
            )

    def _launch_refreshing(self) -> None:
        self._refresh()
        self._after()

    def _launch_entering(self) -> None:
        """Launch the entry of the moving solids' distances, and list the flat cells.

        Flat cells have distance 0 at all corners; only their centers show whether they are open.
        """
        self._before()
        self._nodes.copy_from(self._standing)
        copy(self.base, self._marks)
        self._enter()
        if self._flat is None:
            self._sampler.list_flat_cells(self._nodes, self._near)
        else:
            self._flat.mark(self._nodes, self._near, self.base)

    def _flat_cells(self, standing: Sequence[tuple[int, Geometry]]) -> FlatCells | None:
        """Return the marker of gaps of one cell that works without the host.

        Returns None on the CPU, and if a solid is neither of shapes that tables hold nor a mesh.
        """
        moving = [run for run in self._runs if not isinstance(run, int)]
        grid = self.grid
        suits = grid.device.is_cuda and not grid.part.shared and len(moving) == len(self._runs)
        still = tables_of(grid, standing) if suits else None
        return None if still is None else FlatCells(self.grid, [*still, *moving])

    def _placed(self, place: int) -> Geometry:
        """Return a moving solid at its current place, by its index among the moving ones.

        The object stays the same until the solid moves again.
        """
        if place not in self._placed_at:
            rotations, translations = self._poses
            pose = Pose(rotations[place], translations[place])
            self._placed_at[place] = self.solids[self._moving[place] - 1].geometry.moved(pose)
        return self._placed_at[place]

    def _all_placed(self) -> list[Geometry]:
        """Return all solids at their current places."""
        standing = [solid.geometry for _, solid in self._cutting() if solid.motion is None]
        return [
            *standing,
            *(
                self._placed(place)
                for place, number in enumerate(self._moving)
                if number not in self._left_out
            ),
        ]

    def _enter(self) -> None:
        """Enter the distances of the moving solids at their current places.

        A mesh takes microseconds a node, so several processes share its nodes; then this is
        collective.
        """
        geometries = {run: self._placed(run) for run in self._runs if isinstance(run, int)}
        meshes = {
            run: solid for run, solid in geometries.items() if isinstance(solid, TriangleMesh)
        }
        layers = measure_together(self._sampler, meshes) if self.grid.part.ranks.size > 1 else {}
        for run in self._runs:
            if not isinstance(run, int):
                run.enter(self._nodes, self._sampler.snap)
            elif run in layers:
                enter_layers(self._nodes, self._moving[run], layers[run])
            else:
                self._sampler.enter(self._nodes, self._moving[run], geometries[run])

    def _join(self) -> None:
        """Fill distances and marks beyond cut periodic sides from the ranks there.

        With the distances d of this part [cells] and the received ones d', the difference of an
        axis is the largest |clip(d, -CLOSE, CLOSE) - clip(d', -CLOSE, CLOSE)| over the domain's
        upper side.
        """
        part, near = self.grid.part, self._nodes.near
        if not part.joined:
            return
        measured = np.clip(near.numpy(), -CLOSE, CLOSE)
        part.fill(*self._nodes.arrays, self.base)
        apart = np.abs(measured - np.clip(near.numpy(), -CLOSE, CLOSE))
        for axis in part.joined:
            # The domain's upper side, if the part reaches it.
            end = self.grid.domain_counts[axis] + 1 - self.grid.origin[axis]
            self._differences[axis] = float(
                np.moveaxis(apart, 2 - axis, 0)[end : end + 1].max(initial=0.0)
            )

    def difference(self, axis: int) -> float:
        """Return the difference of distances at two periodic sides [cells]; collective.

        Distances are compared as far as solids are near.
        """
        if axis in self._differences:
            mine = self._differences[axis]
        else:
            lines = np.moveaxis(np.clip(self.distance.numpy(), -CLOSE, CLOSE), 2 - axis, 0)
            mine = float(np.abs(lines[1] - lines[-1]).max())
        return float(self.grid.part.ranks.max(mine))

    def _refresh(self) -> None:
        """Recompute all fields that follow from the distances at nodes [cells].

        Open fractions of faces, from 0 to 1, come first, then those on the domain's sides that
        material can cross.
        The states of cells follow from fractions, and the capacity from states and distances.
        """
        grid, nodes = self.grid, self._nodes
        planes = grid.planes
        ax, ay, az = [*self.open, *self.open[1:2]][:3]  # in 2-D nothing is done to the third
        wx, wy, wz = [*self.wall, *self.wall[1:2]][:3]
        d, o, d2, o2 = nodes.arrays
        clear(self._counts)
        # The marks are in `base` until the next kernel fills it.
        grid.domain.run(
            kernels.FRACTIONS,
            planes=planes,
            marks=self.base,
            counts=self._counts,
            d=d,
            o=o,
            d2=d2,
            o2=o2,
            ax=ax,
            ay=ay,
            az=az,
            wx=wx,
            wy=wy,
            wz=wz,
        )
        for number in range(2 * grid.dimension):
            if self._sides_with_faces >> number & 1:
                self._open_side(number >> 1, SIDES[number])
        grid.domain.run(
            kernels.STATES,
            planes=planes,
            d=nodes.near,
            base=self.base,
            state=self._state,
            ax=ax,
            ay=ay,
            az=az,
        )
        if self.capacity is not None:
            integrate_kernel(
                grid.domain, planes, nodes.near, self._state, self.capacity, grid.origin
            )
            continue_beyond(grid, self.open_sides, self.capacity)

    def _open_side(self, axis: int, name: str) -> None:
        """Fill the fractions of the faces on an open or a periodic side of the domain.

        Face i lies below cell i: the side has the index 1 at the lower end, n + 1 at the upper one.
        """
        grid = self.grid
        face = 1 + grid.counts[axis] if SIDES.index(name) & 1 else 1
        low, high = [1, 1, 1], list(grid.counts)
        low[axis] = high[axis] = face
        inputs = [
            grid.planes,
            axis,
            self._nodes.near,
            self._nodes.arrays[1],
            self.open[axis],
            self.wall[axis],
            self._counts,
        ]
        grid.window(low, high).launch(kernels.side_kernel, inputs)

    def _reaches_into_open_cells(self) -> bool:
        """Return whether a corner of a cell with an open face lies in a solid.

        Diagonals through corners leave faces open or closed, too, so the open fractions do not show
        it.
        """
        corners = self.distance.numpy()
        for axis in range(self.grid.dimension):
            corners = np.minimum(corners, np.roll(corners, -1, axis=2 - axis))
        return bool(
            (
                self.grid.interior(corners)[self.grid.interior(self.base.numpy()) != SOLID] < -DEEP
            ).any()
        )

    def _result_notes(self, dropped: int) -> list[str]:
        """Return notes about the faces."""
        grid = self.grid
        check_open(not self.solids or bool((grid.interior(self.base.numpy()) != SOLID).any()))
        counts = [
            np.bincount(wall.numpy().ravel() + 1, minlength=1 + len(self.names))
            for wall in self.wall
        ]
        closed = np.sum(counts, axis=0)[1:]
        notes = [
            f"{solid.name} closes no part of a face: it is too small for cells of "
            f"{grid.spacing:.4g} m, or lies in other solids"
            for number, solid in self._cutting()
            if not closed[number] and solid.motion is None
        ]
        if dropped:
            notes.append(f"{dropped} faces are less than {kernels.DROP:g} open and count as closed")
        return notes


def _ring(grid: StaggeredGrid, open_sides: int) -> np.ndarray:
    """Return SOLID in the ring except beyond open sides, else 0, in the stored shape."""
    host = np.full(grid.shape, SOLID, dtype=np.int8)
    host[1:-1, 1:-1, 1:-1] = 0
    host[open_ring(grid.shape, open_sides)] = 0
    return host


def _around(boxes: Sequence[NodeBox]) -> NodeBox | None:
    """Return the box around boxes of nodes; None if there are none."""
    lows, highs = zip(*boxes, strict=True) if boxes else ((), ())
    return (
        (tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True))))
        if boxes
        else None
    )


def _runs(
    grid: StaggeredGrid, solids: Sequence[tuple[int, Geometry]], left_out: Collection[int]
) -> Iterator[ShapeTable | MovingMesh | int]:
    """Split solids, in order, into tables of neighboring entries that tables hold.

    On a GPU meshes are yielded as `MovingMesh`, and other solids by their index.
    """
    cutting = [place for place, (number, _) in enumerate(solids) if number not in left_out]
    for held, of in groupby(cutting, key=lambda place: ShapeTable.holds(solids[place][1])):
        if held:
            places = list(of)
            yield ShapeTable(grid, [solids[place] for place in places], places)
            continue
        for place in of:
            number, geometry = solids[place]
            if grid.device.is_cuda and not grid.part.shared and isinstance(geometry, TriangleMesh):
                yield MovingMesh(grid, number, geometry, [place])
            else:
                yield place
