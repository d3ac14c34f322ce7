# mypy: ignore-errors
"""Distances of a moving triangle mesh at nodes, and gaps of one cell, on a GPU.

The launches need no readback, so they can be recorded.
"""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.motion import Pose
from warp_lcp.grid.node_distance import NodeBox, NodeDistances, ShapeTable, node_window, nodes_near
from warp_lcp.grid.node_distance_kernels import (
    COARSE,
    FAR,
    HOLLOW,
    ROUNDING,
    NearestSolids,
    PlacedShape,
    enter,
    shape_distance,
    snapped,
)
from warp_lcp.grid.signed_distance import Geometry, TriangleMesh
from warp_lcp.grid.signed_distance_kernels import (
    ShapeFrame,
    StridedBox,
    block_of,
    node_position,
    to_mesh,
    to_mesh_surface,
)
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.kernels.host_array import HostArray

MODULE = "warp_lcp.grid.moving_mesh_distance"
_FAR, _ROUNDING, _HOLLOW = wp.constant(FAR), wp.constant(ROUNDING), wp.constant(wp.int8(HOLLOW))
Blocks, Frames, Distances = (
    wp.array(dtype=StridedBox),
    wp.array(dtype=ShapeFrame),
    wp.array(dtype=wp.float32),
)


@cell_kernel(MODULE)
def measure_groups(k, j, i, blocks: Blocks, frames: Frames, mesh: wp.uint64, out: Distances):
    """Measure a mesh at the middles of groups of nodes [m]."""
    block = blocks[0]
    p = node_position(block, block.low + block.stride * wp.vec3i(i, j, k), block.offset)
    out[(k * block.counts[1] + j) * block.counts[0] + i] = to_mesh(p, frames[0], mesh)


@cell_kernel(MODULE)
def enter_mesh(
    k,
    j,
    i,
    blocks: Blocks,
    frames: Frames,
    mesh: wp.uint64,
    distance: Distances,
    snap: float,
    solid: int,
    nodes: NearestSolids,
):
    """Enter a mesh's distance at a node.

    The distance at the middle of the node's group bounds it and may decide its sign, as in
    `claim_groups`.

    In cells, with the distance d_m at the middle x_m of the group: |d| >= |d_m| - |x - x_m|. If
    this bound is FAR or more, it is entered with the sign of d_m. Else the distance from the
    surface is measured; its sign is that of d_m where the bound exceeds ROUNDING, and is measured
    too elsewhere.
    """
    block = blocks[0]
    node = wp.vec3i(i, j, k)
    a = (i - block.low[0]) // block.stride
    b = (j - block.low[1]) // block.stride
    c = (k - block.low[2]) // block.stride
    center = distance[(c * block.counts[1] + b) * block.counts[0] + a] / block.spacing
    x = float(i - block.low[0] - a * block.stride) - block.offset
    y = float(j - block.low[1] - b * block.stride) - block.offset
    z = float(k - block.low[2] - c * block.stride) - block.offset
    if block.flat:
        z = 0.0
    d = wp.abs(center) - wp.length(wp.vec3(x, y, z))
    if d >= _FAR:
        d = wp.sign(center) * d
    else:
        p = node_position(block, node, 0.0)
        if d > _ROUNDING:
            d = snapped(to_mesh_surface(p, frames[0], mesh), block.spacing, snap)
            if center < 0.0:
                d = -d
        else:
            d = snapped(to_mesh(p, frames[0], mesh), block.spacing, snap)
    enter(node, d, solid, nodes)


@wp.func
def is_flat(k: int, j: int, i: int, planes: int, near: F32):
    """Return whether all corners of a cell have distance 0, as in `find_flat_cells`."""
    most = wp.abs(near[k, j, i])
    if most == 0.0:
        most = wp.abs(near[k, j, i + 1]) + wp.abs(near[k, j + 1, i]) + wp.abs(near[k, j + 1, i + 1])
        if planes == 2:
            most = most + wp.abs(near[k + 1, j, i]) + wp.abs(near[k + 1, j, i + 1])
            most = most + wp.abs(near[k + 1, j + 1, i]) + wp.abs(near[k + 1, j + 1, i + 1])
    return most == 0.0


@cell_kernel(MODULE)
def mark_flat_cells(
    k,
    j,
    i,
    planes: int,
    near: F32,
    block: StridedBox,
    shapes: wp.array(dtype=PlacedShape),
    begin: bool,
    marks: I8,
):
    """Mark flat cells HOLLOW whose center no solid so far covers, see `mark_listed`."""
    if is_flat(k, j, i, planes, near):
        p = node_position(block, wp.vec3i(i, j, k), 0.5)
        if begin:
            marks[k, j, i] = _HOLLOW
        for s in range(shapes.shape[0]):
            if shape_distance(p, shapes[s]) <= 0.0:
                marks[k, j, i] = wp.int8(0)


@cell_kernel(MODULE)
def mark_flat_cells_of_mesh(
    k,
    j,
    i,
    planes: int,
    near: F32,
    block: StridedBox,
    frames: Frames,
    mesh: wp.uint64,
    begin: bool,
    marks: I8,
):
    """Mark flat cells HOLLOW whose center a mesh and solids so far do not cover."""
    if is_flat(k, j, i, planes, near):
        if begin:
            marks[k, j, i] = _HOLLOW
        if to_mesh(node_position(block, wp.vec3i(i, j, k), 0.5), frames[0], mesh) <= 0.0:
            marks[k, j, i] = wp.int8(0)


class MovingMesh:
    """Moving mesh whose distances are entered by recordable launches.

    It has the interface of `ShapeTable`.

    Args:
        grid: the grid.
        number: the solid's.
        geometry: the mesh as the scene places it.
        places: index of the mesh among the solids that move.
    """

    def __init__(
        self, grid: StaggeredGrid, number: int, geometry: TriangleMesh, places: Sequence[int] = ()
    ) -> None:
        self.grid, self.places, self._number, self._geometry = grid, list(places), number, geometry
        self._block, self._frame = (
            HostArray(1, StridedBox, grid.device),
            HostArray(1, ShapeFrame, grid.device),
        )
        size = math.prod(-(-n // COARSE) for n in grid.shape)
        self._distances = wp.empty(size, dtype=wp.float32, device=grid.device)
        self._groups, self._window = ActiveWindow(grid.domain), ActiveWindow(grid.domain)
        self.box: NodeBox | None = None
        (self._mesh,) = geometry.parameters(grid.device)

    def place(self, rotation: np.ndarray, translation: np.ndarray) -> None:
        """Place the mesh by a pose, shapes (1, 3, 3) and (1, 3) [m]."""
        placed, grid = self._geometry.moved(Pose(rotation[0], translation[0])), self.grid
        near = nodes_near(grid, placed)
        self._frame.host[0] = placed.frame().numpy_value()
        self._frame.send()
        self.box = None if near is None else (near[0].tolist(), near[1].tolist())
        self._window.move_to(node_window(grid, *(self.box or ((0, 0, 0), (0, 0, 0)))))
        if near is None:
            self._groups.move_to(self._window)
            return
        block = block_of(
            *near,
            grid.spacing,
            grid.dimension,
            grid.origin,
            stride=COARSE,
            offset=0.5 * (COARSE - 1),
        )
        self._block.host[0] = block.numpy_value()
        self._block.send()
        self._groups.move_to(
            Window((0, 0, 0), tuple(int(n) for n in reversed(list(block.counts))), grid.device)
        )

    def enter(self, nodes: NodeDistances, snap: float) -> None:
        """Enter the mesh's distances; those within `snap` [cells] of its surface are 0."""
        inputs = [self._block.array, self._frame.array, self._mesh, self._distances]
        self._groups.launch(measure_groups, inputs)
        self._window.launch(enter_mesh, [*inputs, snap, self._number, nodes.struct])

    def mark(
        self, window: Window, near: wp.array, block: StridedBox, marks: wp.array, *, begin: bool
    ) -> None:
        """Unmark flat cells that the mesh covers, see `FlatCells`."""
        inputs = [self.grid.planes, near, block, self._frame.array, self._mesh, begin, marks]
        window.launch(mark_flat_cells_of_mesh, inputs)


class FlatCells:
    """Mark gaps of one cell between solids without the host.

    The marks are those of `NodeSampler.look_at_centers`.

    Args:
        grid: the grid.
        solids: tables of all solids.
    """

    def __init__(self, grid: StaggeredGrid, solids: Sequence[ShapeTable | MovingMesh]) -> None:
        self.grid, self._solids = grid, list(solids)
        self._block = block_of(np.zeros(3), np.ones(3), grid.spacing, grid.dimension, grid.origin)

    def mark(self, nodes: NodeDistances, window: Window, marks: wp.array) -> None:
        """Mark open cells of a window HOLLOW whose corners all have distance 0.

        Args:
            nodes: the distances to all solids.
            window: cells that are considered.
            marks: int8, one a stored cell (updated).
        """
        for order, solid in enumerate(self._solids):
            if isinstance(solid, MovingMesh):
                solid.mark(window, nodes.near, self._block, marks, begin=order == 0)
            else:
                inputs = [
                    self.grid.planes,
                    nodes.near,
                    self._block,
                    solid.placed,
                    order == 0,
                    marks,
                ]
                window.launch(mark_flat_cells, inputs)


def tables_of(
    grid: StaggeredGrid, solids: Sequence[tuple[int, Geometry]]
) -> list[ShapeTable | MovingMesh] | None:
    """Return tables of standing solids, in order; None if one fits in no table."""
    tables: list[ShapeTable | MovingMesh] = []
    for number, geometry in solids:
        if ShapeTable.holds(geometry):
            tables.append(ShapeTable(grid, [(number, geometry)], []))
        elif isinstance(geometry, TriangleMesh):
            tables.append(MovingMesh(grid, number, geometry))
        else:
            return None
    for table in tables:
        table.place(np.eye(3)[None], np.zeros((1, 3)))
    return tables
