"""Signed distances of solids at grid nodes, in cells, positive in the open.

Node (k, j, i) is the low corner of stored cell (k, j, i). Each node stores the two nearest solids,
so that a face can choose the one nearest to its center. Distances below `FAR` cells are exact,
others are at least that large: only nodes near solids are measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import ge
from pathlib import Path
from typing import cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warp_lcp.grid import node_distance_kernels as kernels
from warp_lcp.grid.motion import UNLIMITED
from warp_lcp.grid.node_distance_kernels import COARSE, FAR, NearestSolids
from warp_lcp.grid.signed_distance import Box, Capsule, Geometry, Plane, Sphere, TriangleMesh, Union
from warp_lcp.grid.signed_distance_kernels import StridedBox, block_of, item_points
from warp_lcp.grid.staggered import ActiveWindow, StaggeredGrid, Window
from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.host_array import HostArray
from warp_lcp.kernels.host_kernel import HostKernel
from warp_lcp.kernels.launch_graph import clear, copy

NodeBox = tuple[Sequence[int], Sequence[int]]  # the first node (x, y, z) and one past the last
SingleShape = Box | Sphere | Capsule | Plane | TriangleMesh
CHUNK = 1 << 18  # points at a time: 8 MB of positions, distances and nodes
KINDS: dict[type, int] = {
    Box: kernels.BOX,
    Sphere: kernels.SPHERE,
    Capsule: kernels.CAPSULE,
    Plane: kernels.PLANE,
}
PLACE = HostKernel(
    KernelFile(Path(__file__).parent / "headers/moving_solids.h")[
        "warp_lcp.grid.node_distance.place"
    ]
)
# Fraction of the domain's longest side. Smaller distances are rounding errors of float32 positions,
# and count as 0.
SNAP = 1e-6


class NodeDistances:
    """The two nearest solids of each node.

    Args:
        grid: the grid; arrays have its stored shape.
        second: whether to keep the second nearest, too; without it its arrays are those of the
            nearest.

    Attributes:
        near: float32 distance to the nearest solid [cells].
        owner: int16 its number; 0: none is near.
        next_near: float32 distance to the second nearest [cells].
        next_owner: int16 its number.
        struct: the same as a kernel argument.
    """

    def __init__(self, grid: StaggeredGrid, *, second: bool) -> None:
        self.grid = grid
        self.near, self.owner = grid.field(), grid.field(wp.int16)
        self.next_near, self.next_owner = (
            (grid.field(), grid.field(wp.int16)) if second else (self.near, self.owner)
        )
        self.near.fill_(FAR)
        self.next_near.fill_(FAR)
        self.struct = NearestSolids()
        self.struct.near, self.struct.owner = self.near, self.owner
        self.struct.next_near, self.struct.next_owner = self.next_near, self.next_owner

    @property
    def arrays(self) -> list[wp.array]:
        """The four fields, in the order of the attributes."""
        return [self.near, self.owner, self.next_near, self.next_owner]

    def copy_from(self, other: NodeDistances) -> None:
        """Copy all fields from `other`."""
        for target, source in zip(self.arrays, other.arrays, strict=True):
            copy(target, source)


def node_window(grid: StaggeredGrid, low: Sequence[int], high: Sequence[int]) -> Window:
    """Return the window of nodes low <= (x, y, z) < high, which may be empty."""
    if any(map(ge, low, high)):
        return Window((1, 1, 1), (1, 1, 2), grid.device)
    return Window(_kji(low), _kji(high), grid.device)


def nodes_near(
    grid: StaggeredGrid, geometry: Geometry, reach: float = FAR
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the range of nodes (x, y, z) within `reach` cells of a solid's box.

    The first node and the one past the last; None if there are none.
    """
    bounds = geometry.bounds()
    low, high = nodes_within(grid, UNLIMITED if bounds is None else bounds, reach)
    return (low, high) if (low < high).all() else None


def box_near(grid: StaggeredGrid, geometry: Geometry) -> NodeBox | None:
    """Return the box of `nodes_near`."""
    near = nodes_near(grid, geometry)
    return None if near is None else (near[0].tolist(), near[1].tolist())


def nodes_within(
    grid: StaggeredGrid, bounds: np.ndarray, reach: float = FAR
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges of nodes (x, y, z) within `reach` cells of boxes [m].

    Boxes have the shape (..., 2, 3). Returns the first nodes and those past the last, shape (...,
    3) each. A box without nodes has a first node that is not below the last on some axis.
    """
    end = np.array(grid.shape[::-1])
    touched = np.clip(
        bounds / grid.spacing + 1.0 - np.array(grid.origin) + np.array([[-reach], [reach]]),
        -1.0,
        end,
    )
    low = np.ceil(np.maximum(touched[..., 0, :], 0.0)).astype(np.int64)
    high = np.minimum(np.floor(touched[..., 1, :]).astype(np.int64) + 1, end)
    if grid.dimension == 2:
        low[..., 2], high[..., 2] = 1, 2
    return low, high


class ShapeTable:
    """Device table of boxes, spheres, capsules and planes, entered by one launch.

    Args:
        grid: the grid.
        solids: number and shape of each as the scene places it, of a kind that `holds` accepts.
        places: indices of these among the solids that move.

    Attributes:
        low: first node (x, y, z) near each solid where it is, shape (n, 3).
        high: one past the last.
        box: around the nodes near them; None if there are none.
    """

    def __init__(
        self, grid: StaggeredGrid, solids: Sequence[tuple[int, Geometry]], places: Sequence[int]
    ) -> None:
        self.grid, self.places = grid, list(places)
        shapes = [part for _, geometry in solids for part in _parts(geometry)]
        counts = [len(_parts(geometry)) for _, geometry in solids]
        starts = np.cumsum([0, *counts])
        hulls = [shape.hull() for shape in shapes]
        most = max(1, *(len(corners) for corners, _ in hulls))
        corners = [np.resize(c, (most, 3)) if len(c) else np.zeros((most, 3)) for c, _ in hulls]
        limits = [
            UNLIMITED if (box := shape.bounds()) is None else np.where(np.isfinite(box), 0.0, box)
            for shape in shapes
        ]
        placements = [shape.placement for shape in shapes]
        of_placements: list[ArrayLike] = [
            [p.rotation for p in placements],
            [p.translation for p in placements],
            [p.scale for p in placements],
        ]
        of_shapes: list[ArrayLike] = [
            [shape.origin() for shape in shapes],
            corners,
            [margin for _, margin in hulls],
            limits,
        ]  # infinite where without an end
        self._fixed = np.concatenate(
            [np.ravel(of) for of in (*of_placements, *of_shapes, [grid.spacing, FAR])]
        )
        self._places = np.concatenate([starts, grid.origin, grid.shape[::-1]])
        self._numbers = {
            "count": len(solids),
            "shapes": len(shapes),
            "corners": most,
            "flat": grid.dimension == 2,
        }
        self._solids = HostArray(len(solids), kernels.ShapeGroup, grid.device)
        self._shapes = HostArray(len(shapes), kernels.PlacedShape, grid.device)
        for row, shape in zip(self._shapes.host, shapes, strict=True):
            row["kind"], numbers = KINDS[type(shape)], shape.parameters(grid.device)
            row["frame"]["scale"], row["frame"]["sign"] = (
                shape.placement.scale * shape.unit_length(),
                -1.0 if shape.invert else 1.0,
            )
            for number in numbers:
                row["radius" if isinstance(number, float) else "way"] = number
        groups = self._solids.host
        groups["number"], groups["first"], groups["end"] = (
            [number for number, _ in solids],
            starts[:-1],
            starts[1:],
        )
        self._block = block_of(np.zeros(3), np.ones(3), grid.spacing, grid.dimension, grid.origin)
        self.low = self.high = np.zeros((len(solids), 3), dtype=np.int64)
        self.box: NodeBox | None = None
        self._window = ActiveWindow(grid.domain)

    @staticmethod
    def holds(geometry: Geometry) -> bool:
        """Return whether a solid consists of boxes, spheres, capsules and planes only."""
        return all(type(part) in KINDS for part in _parts(geometry))

    def place(self, rotation: np.ndarray, translation: np.ndarray) -> None:
        """Place the solids by poses, shapes (n, 3, 3) and (n, 3) [m]."""
        n, shapes = self._numbers["count"], self._numbers["shapes"]
        given = (rotation, translation, self._fixed)
        reals, (near,) = PLACE.run(
            given, (self._places,), work=12 * shapes + 6 * n + 6, **self._numbers
        )
        begin = 12 * n + len(self._fixed)
        middle, after = begin + 9 * shapes, begin + 12 * shapes
        inverse, origin = reals[begin:middle], reals[middle:after]
        nodes, around = (
            reals[after : after + 6 * n],
            reals[after + 6 * n : after + 6 * n + 6].tolist(),
        )
        frame, solids, boxes = (
            self._shapes.host["frame"],
            self._solids.host,
            nodes.reshape(n, 2, 3).astype(np.int64),
        )
        frame["inverse_rotation"], frame["translation"] = (
            inverse.reshape(-1, 3, 3),
            origin.reshape(-1, 3),
        )
        self.low, self.high = boxes[:, 0], boxes[:, 1]
        solids["low"], solids["high"] = self.low, self.high
        self._solids.send()
        self._shapes.send()
        low, high = map(int, around[:3]), map(int, around[3:])
        self.box = (tuple(low), tuple(high)) if near[0] else None
        self._window.move_to(node_window(self.grid, *(self.box or ((0, 0, 0), (0, 0, 0)))))

    @property
    def placed(self) -> wp.array:
        """The shapes at their current places."""
        return self._shapes.array

    def enter(self, nodes: NodeDistances, snap: float) -> None:
        """Enter the solids' distances; those within `snap` [cells] of a surface are 0."""
        self._window.launch(
            kernels.enter_solids,
            [self._block, self._solids.array, self._shapes.array, snap, nodes.struct],
        )


class NodeSampler:
    """Measure solids at nodes or at the centers of cells, in blocks of limited size.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid
        self.snap = max(SNAP * max(grid.domain_counts), 1e-6)
        size = max(min(CHUNK, grid.size), max(grid.shape) * COARSE**2)  # a row of groups fits
        self._points = wp.empty(size, dtype=wp.vec3, device=grid.device)
        self._distances = wp.empty(size, dtype=wp.float32, device=grid.device)
        # Points (x, y, z), and the sign if it is sure.
        self._list, self._sure = (
            wp.empty(size, dtype=wp.vec4i, device=grid.device) for _ in range(2)
        )
        self._listed = wp.zeros(2, dtype=wp.int32, device=grid.device)

    def enter(self, nodes: NodeDistances, number: int, geometry: Geometry) -> None:
        """Enter a solid's distances.

        Args:
            nodes: node distances (updated) of the sampler's grid, or of another part of the same
                grid.
            number: the solid's, > 0.
            geometry: the solid.
        """
        near, before = nodes_near(nodes.grid, geometry), nodes.grid.origin
        if near is None:
            return
        # A mesh takes microseconds a node, most of them for the sign. The distance at the middle of
        # a group of nodes shows whether the others matter, and gives the sign of many.
        stride = COARSE if isinstance(geometry, TriangleMesh) else 1
        for block, distances in self.measured(
            geometry, *near, stride=stride, offset=0.5 * (stride - 1), before=before
        ):
            if stride == 1:
                inputs = [block, distances, self.snap, number, nodes.struct]
                wp.launch(kernels.claim_nodes, len(distances), inputs, device=self.grid.device)
                continue
            self._listed.zero_()
            inputs = [block, distances, number, nodes.struct, self._list, self._sure, self._listed]
            wp.launch(kernels.claim_groups, len(distances), inputs, device=self.grid.device)
            block.offset = 0.0
            for listed, count in zip(
                (self._list, self._sure), self._listed.numpy().tolist(), strict=True
            ):
                if count:
                    known = listed is self._sure
                    distances = self._measure(
                        geometry, count, kernels.listed_points, [block, listed], unsigned=known
                    )
                    inputs = [block, listed, distances, self.snap, number, nodes.struct]
                    wp.launch(kernels.claim_listed, count, inputs, device=self.grid.device)

    def look_at_centers(
        self,
        nodes: NodeDistances,
        solids: Callable[[], Sequence[Geometry]],
        low: Sequence[int],
        high: Sequence[int],
        marks: wp.array,
        listed: bool = False,
    ) -> None:
        """Mark open gaps of one cell as HOLLOW.

        These are the cells that lie in the open although all their corners have distance 0. Plates
        of one cell have such corners as well, and get no mark.

        Args:
            nodes: the distances to all solids.
            solids: function that returns all solids; it is called if there is such a cell.
            low: first node (x, y, z) of the cells considered.
            high: one past the last node.
            marks: int8, one a stored cell (updated).
            listed: whether `list_flat_cells` has listed the cells.
        """
        low, high = self.inner(low, high)
        if any(map(ge, low, high)):
            return
        if not listed:
            self.list_flat_cells(nodes, node_window(self.grid, low, high))
        node_count = int(self._listed.numpy()[0])
        if node_count > len(self._list):
            longest = int(np.argmax(np.subtract(high, low)))
            middle = (low[longest] + high[longest]) // 2
            for part in (slice(None, middle), slice(middle, None)):
                begin, end = list(low), list(high)
                begin[longest], end[longest] = (
                    part.start or begin[longest],
                    part.stop or end[longest],
                )
                self.look_at_centers(nodes, solids, begin, end, marks)
        elif node_count:
            block, listed = (
                self._block(np.array(low), np.array(high), offset=0.5),
                self._list[:node_count],
            )
            for order, geometry in enumerate(solids()):
                distances = self._measure(
                    geometry, node_count, kernels.listed_points, [block, listed]
                )
                wp.launch(
                    kernels.mark_listed,
                    node_count,
                    [listed, distances, order == 0, marks],
                    device=self.grid.device,
                )

    def inner(self, low: Sequence[int], high: Sequence[int]) -> NodeBox:
        """Shrink a box of nodes to low corners of cells inside the ring."""
        return [max(start, 1) for start in low], [
            min(stop, end - 1) for stop, end in zip(high, self.grid.shape[::-1], strict=True)
        ]

    def list_flat_cells(self, nodes: NodeDistances, window: Window) -> None:
        """List the cells of a window whose corners all have distance 0."""
        clear(self._listed)
        window.launch(
            kernels.find_flat_cells, [self.grid.planes, nodes.near, self._list, self._listed]
        )

    def _measure(
        self,
        geometry: Geometry,
        count: int,
        fill: wp.Kernel,
        inputs: Sequence[object],
        *,
        unsigned: bool = False,
    ) -> wp.array:
        """Return the distances [m] of `count` points that a kernel makes.

        `unsigned` is possible for meshes only.
        """
        points, distances = self._points[:count], self._distances[:count]
        wp.launch(fill, count, [*inputs, points], device=self.grid.device)
        if unsigned and isinstance(geometry, TriangleMesh):
            geometry.distance_to_surface(points, distances)
        else:
            geometry.signed_distance(points, distances)
        return distances

    def _block(
        self,
        low: np.ndarray,
        high: np.ndarray,
        before: tuple[int, int, int] | None = None,
        *,
        stride: int = 1,
        offset: float = 0.0,
    ) -> StridedBox:
        return block_of(
            low,
            high,
            self.grid.spacing,
            self.grid.dimension,
            before or self.grid.origin,
            stride=stride,
            offset=offset,
        )

    def measured(
        self,
        geometry: Geometry,
        low: np.ndarray,
        high: np.ndarray,
        *,
        stride: int = 1,
        offset: float,
        before: tuple[int, int, int] | None = None,
    ) -> Iterator[tuple[StridedBox, wp.array]]:
        """Yield blocks of a box of nodes that fit in memory, each with its distances [m].

        Blocks are planes or else rows.

        Args:
            geometry: the solid.
            low: first node (x, y, z).
            high: one past the last.
            stride: nodes along each axis for which one distance stands.
            offset: offset of the measured point from the low node of its group, in cells.
            before: cells (x, y, z) of the whole grid before the first node's; None for those before
                the sampler's grid.
        """
        room = len(self._points) // stride**3
        across, rows, _ = (int(v) for v in -(-(high - low) // stride))
        depth, height = (
            (room // (across * rows), rows)
            if across * rows <= room
            else (1, max(room // across, 1))
        )
        for bottom in range(int(low[2]), int(high[2]), depth * stride):
            for front in range(int(low[1]), int(high[1]), height * stride):
                begin = np.array([low[0], front, bottom])
                end = np.minimum(
                    begin + np.array([high[0] - low[0], height * stride, depth * stride]), high
                )
                block = self._block(begin, end, before, stride=stride, offset=offset)
                nx, ny, nz = (int(n) for n in np.array(block.counts))
                yield block, self._measure(geometry, nx * ny * nz, item_points, [block])


def _parts(geometry: Geometry) -> list[SingleShape]:
    """Return the shapes of which a solid is the union."""
    return (
        [shape for part in geometry.parts for shape in _parts(part)]
        if isinstance(geometry, Union)
        else [cast(SingleShape, geometry)]
    )


def _kji(corner: Sequence[int]) -> tuple[int, int, int]:
    return int(corner[2]), int(corner[1]), int(corner[0])
