"""Signed distances of solids at the nodes of a grid, in cells, positive in the open.

Node (k, j, i) is the low corner of stored cell (k, j, i). Each node keeps the two nearest solids, so that a face can tell which of them is
nearest to its center. Distances below `FAR` cells are exact, others are at least that large: only nodes near solids are measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.grid import node_distance_kernels as kernels
from warp_lcp.grid.node_distance_kernels import COARSE, FAR, Nearest
from warp_lcp.grid.solids import Geometry, TriangleMesh
from warp_lcp.grid.solids_kernels import block_of, item_points
from warp_lcp.grid.staggered import StaggeredGrid, Window

CHUNK = 1 << 18  # points at a time: 8 MB of positions, distances and nodes
SNAP = 1e-6  # of the domain's longest side: distances below it are rounding errors of float32 positions, and count as 0


class NodeDistances:
    """The two nearest solids of each node.

    Args:
        grid: the grid; arrays have its stored shape.
        second: whether to keep the second nearest, too; without it its arrays are those of the nearest.

    Attributes:
        near: float32 distance to the nearest solid [cells].
        owner: int16 its number; 0: none is near.
        next_near: float32 distance to the second nearest [cells].
        next_owner: int16 its number.
        struct: what kernels take.
    """

    def __init__(self, grid: StaggeredGrid, *, second: bool) -> None:
        self.grid = grid
        self.near, self.owner = grid.field(), grid.field(wp.int16)
        self.next_near, self.next_owner = (grid.field(), grid.field(wp.int16)) if second else (self.near, self.owner)
        self.near.fill_(FAR)
        self.next_near.fill_(FAR)
        self.struct = Nearest()
        for name in ("near", "owner", "next_near", "next_owner"):
            setattr(self.struct, name, getattr(self, name))

    @property
    def arrays(self) -> list[wp.array]:
        """The four fields, in the order of the attributes."""
        return [self.near, self.owner, self.next_near, self.next_owner]

    def copy_from(self, other: NodeDistances) -> None:
        """Become a copy of `other`."""
        for target, source in zip(self.arrays, other.arrays, strict=True):
            wp.copy(target, source)


def nodes_near(grid: StaggeredGrid, geometry: Geometry, reach: float = FAR) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the first stored node and the one past the last (x, y, z) within `reach` cells of a solid's bounds; None: there are none."""
    end = np.array(grid.shape[::-1])
    low, high = np.zeros(3, dtype=np.int64), end.copy()
    bounds = geometry.bounds()
    if bounds is not None:
        touched = np.clip(bounds / grid.spacing + 1.0 - np.array(grid.origin) + np.array([[-reach], [reach]]), -1.0, end)
        low, high = np.ceil(np.maximum(touched[0], 0.0)).astype(np.int64), np.minimum(np.floor(touched[1]).astype(np.int64) + 1, end)
    if grid.dimension == 2:
        low[2], high[2] = 1, 2
    return (low, high) if (low < high).all() else None


class NodeSampler:
    """Measure solids at nodes, or at the centers of cells, a part of them at a time.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid
        self.snap = max(SNAP * max(grid.domain_counts), 1e-6)
        size = max(min(CHUNK, grid.size), max(grid.shape) * COARSE**2)  # a row of groups fits
        self._points = wp.empty(size, dtype=wp.vec3, device=grid.device)
        self._distances = wp.empty(size, dtype=wp.float32, device=grid.device)
        self._list, self._sure = (wp.empty(size, dtype=wp.vec4i, device=grid.device) for _ in range(2))  # (x, y, z, sign if sure)
        self._listed = wp.zeros(2, dtype=wp.int32, device=grid.device)

    def enter(self, nodes: NodeDistances, number: int, geometry: Geometry) -> None:
        """Enter a solid's distances.

        Args:
            nodes: where to (updated), of the sampler's grid or of another part of the same one.
            number: the solid's, > 0.
            geometry: the solid.
        """
        near, before = nodes_near(nodes.grid, geometry), nodes.grid.origin
        if near is None:
            return
        # A mesh takes microseconds a node, most of them for the sign: the distance at the middle of a group of nodes tells whether the
        # others matter, and the sign of many.
        stride = COARSE if isinstance(geometry, TriangleMesh) else 1
        for block, distances in self.measured(geometry, *near, stride=stride, offset=0.5 * (stride - 1), before=before):
            if stride == 1:
                inputs = [block, distances, self.snap, number, nodes.struct]
                wp.launch(kernels.claim_nodes, len(distances), inputs, device=self.grid.device)
                continue
            self._listed.zero_()
            inputs = [block, distances, number, nodes.struct, self._list, self._sure, self._listed]
            wp.launch(kernels.claim_groups, len(distances), inputs, device=self.grid.device)
            block.offset = 0.0
            for listed, count in zip((self._list, self._sure), self._listed.numpy().tolist(), strict=True):
                if count:
                    known = listed is self._sure
                    distances = self._measure(geometry, count, kernels.listed_points, [block, listed], unsigned=known)
                    inputs = [block, listed, distances, self.snap, number, nodes.struct]
                    wp.launch(kernels.claim_listed, count, inputs, device=self.grid.device)

    def look_at_centers(self, nodes: NodeDistances, solids: Sequence[Geometry], low: np.ndarray, high: np.ndarray, marks: wp.array) -> None:
        """Mark as HOLLOW the cells in the open whose corners all have distance 0: gaps of one cell, where plates have no mark.

        Args:
            nodes: the distances to all solids.
            solids: all of them.
            low: first node (x, y, z) from which on cells are considered.
            high: one past the last node.
            marks: int8, one a stored cell (updated).
        """
        low, high = np.maximum(low, 1), np.minimum(high, np.array(self.grid.shape[::-1]) - 1)
        if (low >= high).any():
            return
        window = Window(_kji(low), _kji(high), self.grid.device)
        self._listed.zero_()
        window.launch(kernels.find_flat_cells, [self.grid.planes, nodes.near, self._list, self._listed])
        found = int(self._listed.numpy()[0])
        if found > len(self._list):
            longest = int(np.argmax(high - low))
            middle = int(low[longest] + high[longest]) // 2
            for part in (slice(None, middle), slice(middle, None)):
                begin, end = low.copy(), high.copy()
                begin[longest], end[longest] = part.start or begin[longest], part.stop or end[longest]
                self.look_at_centers(nodes, solids, begin, end, marks)
        elif found:
            block, listed = self._block(low, high, offset=0.5), self._list[:found]
            for order, geometry in enumerate(solids):
                distances = self._measure(geometry, found, kernels.listed_points, [block, listed])
                wp.launch(kernels.mark_listed, found, [listed, distances, order == 0, marks], device=self.grid.device)

    def _measure(self, geometry: Geometry, count: int, fill: wp.Kernel, inputs: list[Any], *, unsigned: bool = False) -> wp.array:
        """Return the distances [m] of `count` points that a kernel makes; only a mesh can be asked for those without sign."""
        points, distances = self._points[:count], self._distances[:count]
        wp.launch(fill, count, [*inputs, points], device=self.grid.device)
        if unsigned and isinstance(geometry, TriangleMesh):
            geometry.distance_to_surface(points, distances)
        else:
            geometry.signed_distance(points, distances)
        return distances

    def _block(self, low: np.ndarray, high: np.ndarray, before: tuple[int, int, int] | None = None, **more: Any) -> Any:
        return block_of(low, high, self.grid.spacing, self.grid.dimension, before or self.grid.origin, **more)

    def measured(
        self, geometry: Geometry, low: np.ndarray, high: np.ndarray, *, stride: int = 1, offset: float,
        before: tuple[int, int, int] | None = None,
    ) -> Iterator[tuple[Any, wp.array]]:  # fmt: skip
        """Cut a box of nodes into blocks that fit, planes or else rows, and yield each with its distances [m].

        Args:
            geometry: the solid.
            low: first node (x, y, z).
            high: one past the last.
            stride: nodes along each axis for which one distance stands.
            offset: from the low one of them to where it is measured, in cells.
            before: cells (x, y, z) of the whole grid before the first node's; None: those before the sampler's grid.
        """
        room = len(self._points) // stride**3
        across, rows, _ = (int(v) for v in -(-(high - low) // stride))
        depth, height = (room // (across * rows), rows) if across * rows <= room else (1, max(room // across, 1))
        for bottom in range(int(low[2]), int(high[2]), depth * stride):
            for front in range(int(low[1]), int(high[1]), height * stride):
                begin = np.array([low[0], front, bottom])
                end = np.minimum(begin + np.array([high[0] - low[0], height * stride, depth * stride]), high)
                block = self._block(begin, end, before, stride=stride, offset=offset)
                counts = block.counts
                yield block, self._measure(geometry, counts[0] * counts[1] * counts[2], item_points, [block])


def _kji(corner: np.ndarray) -> tuple[int, int, int]:
    return int(corner[2]), int(corner[1]), int(corner[0])
