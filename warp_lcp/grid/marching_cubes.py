"""Marching cubes on a device: the surface phi = 0 as triangles or segments.

Closed, without duplicate points; segments in 2-D.

One thread takes a row of cells; a prefix sum gives the places of its points and triangles. A point
belongs to the node at the low end of its edge; a node's points are numbered x, y, z from the number
that the node stores.

The triangles of a case are computed from the cube. Corner c of a cell lies at (c & 1, c >> 1 & 1, c
>> 2 & 1), x first; bit c of a case is set if the corner is inside. Edge 4 a + b runs along axis a
from the b-th of the four corners that are low along it. On a face each run of inside corners is cut
off by a segment, so that two cells have the same segments on the face between them: the surface is
closed. A triangle has no edge within a face except segments, so that each of its edges belongs to
two triangles.
"""

import functools
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.grid.staggered import StaggeredGrid, Window
from warp_lcp.kernels import KernelFile

MOST = 5  # most triangles of a cell
EDGES = tuple(
    (corner, corner | 1 << axis)
    for axis in range(3)
    for corner in range(8)
    if not corner >> axis & 1
)
Edge = int
Loop = tuple[Edge, ...]
Cut = tuple[float, tuple[tuple[Edge, Edge, Edge], ...]]  # a length, and triangles


@functools.cache
def _faces() -> list[tuple[int, int, int, int]]:
    """Return the corners of the cell's faces, counterclockwise seen from outside."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        low = (0, v, u | v, u)
        faces += [low, tuple(corner | 1 << axis for corner in reversed(low))]
    return [(f[0], f[1], f[2], f[3]) for f in faces]


def _edge(a: int, b: int) -> Edge:
    return EDGES.index((min(a, b), max(a, b)))


def _segments(case: int, face: tuple[int, int, int, int]) -> list[tuple[Edge, Edge]]:
    """Return the segments that cut off the runs of inside corners of a face.

    Each goes from the edge before a run to the edge after it.
    """
    inside = [bool(case >> corner & 1) for corner in face]
    segments = []
    for n in range(4):
        if inside[n] and not inside[n - 1]:
            last = n
            while inside[(last + 1) % 4]:
                last = (last + 1) % 4
            segments.append((_edge(face[n - 1], face[n]), _edge(face[last], face[(last + 1) % 4])))
    return segments


def _loops(case: int) -> list[Loop]:
    """Return the closed lines in which the surface meets the cell's faces.

    They are counterclockwise seen from outside the material.
    """
    follows = dict(itertools.chain(*(_segments(case, face) for face in _faces())))
    loops = []
    while follows:
        first, edge = next(iter(follows.items()))
        loop = [first]
        del follows[first]
        while edge != first:
            loop.append(edge)
            edge = follows.pop(edge)
        loops.append(tuple(loop))
    return loops


@functools.cache
def _on_one_face(a: Edge, b: Edge) -> bool:
    corners = set(EDGES[a] + EDGES[b])
    return any(corners <= set(face) for face in _faces())


@functools.cache
def _midpoint(edge: Edge) -> np.ndarray:
    return np.array([[corner >> axis & 1 for axis in range(3)] for corner in EDGES[edge]]).mean(
        axis=0
    )


@functools.cache
def _cut(loop: Loop) -> Cut | None:
    """Return the triangulation of a loop with the shortest diagonals.

    Also returns their length.

    Returns None if every triangulation has a diagonal within a face.

    The recursion over the corner m opposite to the side between the loop's ends, and the parts of
    three or more corners:

        length(loop) = min over m of the sum over the parts (first ... m) and (m ... last) of
                       (length of the part + distance between its ends [cells]).

    Of equal triangulations, within 1e-9, the first one stays.
    """
    if len(loop) == 3:
        return 0.0, ((loop[0], loop[1], loop[2]),)
    best = None
    # The corner opposite to the side between the loop's ends.
    for middle in range(1, len(loop) - 1):
        parts: list[Cut] = [(0.0, ((loop[0], loop[middle], loop[-1]),))]
        for part in (loop[: middle + 1], loop[middle:]):
            if len(part) < 3:
                continue
            best_cut = None if _on_one_face(part[0], part[-1]) else _cut(part)
            if best_cut is None:
                break
            parts.append(
                (
                    best_cut[0] + float(np.linalg.norm(_midpoint(part[0]) - _midpoint(part[-1]))),
                    best_cut[1],
                )
            )
        else:
            length = sum(part[0] for part in parts)
            if best is None or length < best[0] - 1e-9:
                best = length, tuple(itertools.chain(*(part[1] for part in parts)))
    return best


@functools.cache
def triangle_table() -> np.ndarray:
    """Return the triangles of each case as edges, int8, shape (256, 1 + 3 MOST).

    The number of triangles, then three edges each.
    """
    table = np.full((256, 1 + 3 * MOST), -1, dtype=np.int8)
    for case in range(256):
        triangles: list[Edge] = []
        for loop in _loops(case):
            found = _cut(loop)
            assert found is not None  # true of all 256 cases
            triangles += itertools.chain(*found[1])
        table[case, 0] = len(triangles) // 3
        table[case, 1 : 1 + len(triangles)] = triangles
    return table


@functools.cache
def segment_table() -> np.ndarray:
    """Return the segments of each square's case as edges, int8, shape (16, 5).

    The number of segments, then two edges each, the inside on the left.
    """
    table = np.full((16, 5), -1, dtype=np.int8)
    low = _faces()[4]  # z = 0, seen from below
    for case in range(16):
        ends = [edge for segment in _segments(case, low) for edge in segment]
        table[case, 0] = len(ends) // 2
        table[case, 1 : 1 + len(ends)] = ends
    return table


# Fraction of an edge. A point keeps this distance from its ends, so that no triangle shrinks to
# nothing.
CLOSEST = 0.01


KERNELS = KernelFile(Path(__file__).parent / "headers/surface_mesh.h", {"CLOSEST": CLOSEST})
COUNT = KERNELS["warp_lcp.grid.marching_cubes.count"]
POINTS = KERNELS["warp_lcp.grid.marching_cubes.points"]
CORNERS = KERNELS["warp_lcp.grid.marching_cubes.corners"]


@dataclass(frozen=True)
class DeviceMesh:
    """Surface mesh on a device.

    Attributes:
        points: [m], wp.vec3, shape (n,).
        corners: int32, shape (m, 3) of triangles, counterclockwise seen from where phi > 0, or (m,
            2) of segments, phi < 0 on the left.
    """

    points: wp.array
    corners: wp.array


class MarchingCubes:
    """Marching cubes on fields of a grid.

    Args:
        grid: the grid.
    """

    def __init__(self, grid: StaggeredGrid) -> None:
        self.grid = grid
        self._table = wp.array(
            triangle_table() if grid.dimension == 3 else segment_table(),
            dtype=wp.int8,
            device=grid.device,
        )

    def contour(self, phi: wp.array, number: wp.array) -> DeviceMesh:
        """Return the surface phi = 0, linear between cell centers.

        The surface is flat on the domain's sides where it is cut off there. Where it meets a side
        at a right angle it ends there in an edge: crossings between centers beside a side are moved
        onto the side. The points and their order are the same on every run.

        Args:
            phi: float32 at cell centers, in the stored shape; > 0 in the ring, so that the surface
                is closed.
            number: int32 in the stored shape, scratch memory.
        """
        grid, device = self.grid, self.grid.device
        low = (1, 0, 0) if grid.dimension == 2 else (0, 0, 0)
        high = (
            2 if grid.dimension == 2 else grid.shape[0] - 1,
            grid.shape[1] - 1,
            grid.shape[2] - 1,
        )
        # Cells between the centers of cells and of their upper neighbors.
        cells = Window(low, high, device)
        owned, triangle_counts = self._counted(cells, phi)
        points = wp.empty(_total(owned[1]), dtype=wp.vec3, device=device)
        most_x, most_y, most_z = grid.domain_counts
        cells.run(
            POINTS,
            grid.placement,
            whole=True,
            counts=owned[0],
            ends=owned[1],
            into=points,
            phi=phi,
            number=number,
            most_x=most_x,
            most_y=most_y,
            most_z=most_z,
        )
        return DeviceMesh(points, self._corners(cells, phi, number, triangle_counts))

    def corners(self, phi: wp.array, number: wp.array, cells: Window) -> wp.array:
        """Return the corners of the last surface that lie in given cells.

        Args:
            phi: the field passed to `contour`.
            number: the numbers that `contour` has written.
            cells: between the centers of these and of their upper neighbors.
        """
        return self._corners(cells, phi, number, self._counted(cells, phi)[1])

    def _counted(
        self, cells: Window, phi: wp.array
    ) -> tuple[tuple[wp.array, wp.array], tuple[wp.array, wp.array]]:
        """Count the points that the nodes of each row own and the triangles of its cells.

        Each count comes with its inclusive prefix sums over rows.
        """
        owned, triangle_counts = (
            wp.empty(cells.rows, dtype=wp.int32, device=cells.device) for _ in range(2)
        )
        cells.run(
            COUNT,
            whole=True,
            phi=phi,
            planes=self.grid.planes,
            table=self._table,
            owned=owned,
            made=triangle_counts,
        )
        ends = [
            wp.empty(count.size, dtype=wp.int32, device=cells.device)
            for count in (owned, triangle_counts)
        ]
        for count, end in zip((owned, triangle_counts), ends, strict=True):
            wp.utils.array_scan(count.flatten(), end, inclusive=True)
        return (owned, ends[0]), (triangle_counts, ends[1])

    def _corners(
        self,
        cells: Window,
        phi: wp.array,
        number: wp.array,
        triangle_counts: tuple[wp.array, wp.array],
    ) -> wp.array:
        """Return the triangles of cells, given the number of them in each row."""
        corners = wp.empty(
            (_total(triangle_counts[1]), self.grid.dimension), dtype=wp.int32, device=cells.device
        )
        cells.run(
            CORNERS,
            whole=True,
            counts=triangle_counts[0],
            ends=triangle_counts[1],
            phi=phi,
            planes=self.grid.planes,
            number=number,
            table=self._table,
            into=corners,
        )
        return corners


def _total(ends: wp.array) -> int:
    """Return the last of the prefix sums."""
    return int(ends[-1:].numpy()[0])
