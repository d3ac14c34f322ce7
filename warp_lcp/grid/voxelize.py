"""Which cells of the grid are solid, and which points lie inside a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.motion import Motion
from warp_lcp.grid.sides import open_ring
from warp_lcp.grid.solid_notes import check_open, placement_notes, small_notes, thin_notes
from warp_lcp.grid.solids import Geometry
from warp_lcp.grid.solids_kernels import block_of, claim_cells, item_points

OPEN = -1
DOMAIN_WALL = 0
CHUNK = 1 << 20  # points at a time: 16 MB of positions and distances


@dataclass(frozen=True, kw_only=True)
class PlacedSolid:
    """A solid of a scene.

    Args:
        geometry: the region it fills.
        separating: whether liquid may leave its wall (otherwise it slides along it only).
        name: what messages call it, for example `solid[2] (sphere)`.
        motion: takes the geometry from where it is placed to where it is; None: it stands still.
        among: what messages call the material around it.
    """

    geometry: Geometry
    separating: bool
    name: str
    motion: Motion | None = None
    among: str = "material"


@dataclass(frozen=True, kw_only=True)
class VoxelSolids:
    """Solids as whole cells.

    Args:
        index: int32 of shape (nz + 2, ny + 2, nx + 2): -1 in open cells, 0 in the domain's wall (the ring, but for what lies beyond open
            sides), 1 + s in cells of solid s.
        separating: uint8 of shape (1 + solids,), on the device: 1 where the wall of that index lets liquid leave.
        names: of those indices, the first "domain".
        covered: number of cells whose center lies in each solid (whichever claimed it), without the domain; shape (solids,).
        notes: warnings worth a line at the start of a run.
    """

    index: wp.array3d(dtype=wp.int32)
    separating: wp.array(dtype=wp.uint8)
    names: tuple[str, ...]
    covered: tuple[int, ...]
    notes: tuple[str, ...]


def voxelize(
    counts: tuple[int, int, int],
    spacing: float,
    dimension: int,
    solids: Sequence[PlacedSolid],
    *,
    wall_separating: bool,
    device: wp.Device | str,
    open_sides: int = 0,
    origin: tuple[int, int, int] = (0, 0, 0),
    remarks: bool = True,
) -> VoxelSolids:
    """Give every cell whose center lies inside a solid to the first such solid.

    Args:
        counts: number of cells (nx, ny, nz), nz = 1 in 2-D.
        spacing: side of a cell [m].
        dimension: 2 or 3.
        solids: in the order of their claims.
        wall_separating: whether liquid may leave the domain's wall.
        device: where the arrays live.
        open_sides: of `warp_lcp.grid.sides.side_bits`: beyond them cells are open.
        origin: cells (x, y, z) of a larger grid before the first one, if this is a part of one.
        remarks: make notes and refuse what makes no sense at the start of a run; False: solids are where they have moved to.

    Raises:
        ValueError: with `remarks`, a solid lies wholly outside the domain, or the solids leave no open cell.
    """
    nx, ny, nz = counts
    if dimension == 2 and nz != 1:
        raise ValueError(f"a 2-D grid has one layer of cells, not {nz}")
    device = wp.get_device(device)
    host = np.full((nz + 2, ny + 2, nx + 2), DOMAIN_WALL, dtype=np.int32)
    host[1:-1, 1:-1, 1:-1] = OPEN
    host[open_ring((nz + 2, ny + 2, nx + 2), open_sides)] = OPEN
    index = wp.array(host, dtype=wp.int32, device=device)
    covered = wp.zeros(1 + len(solids), dtype=wp.int32, device=device)
    notes: list[str] = []
    for number, solid in enumerate(solids, start=1):
        if remarks:
            notes += placement_notes(solid.geometry, solid.name, counts, spacing, dimension)
            notes += thin_notes(solid.geometry, solid.name, solid.among, spacing, device)
        _claim(index, covered, solid.geometry, number, spacing, dimension, origin)
    claimed = covered.numpy()[1:]
    if remarks:
        notes += small_notes((solid.name for solid in solids), claimed, spacing)
        check_open(not solids or bool((index.numpy()[1:-1, 1:-1, 1:-1] == OPEN).any()))
    return VoxelSolids(
        index=index,
        separating=wp.array([wall_separating, *(solid.separating for solid in solids)], dtype=wp.uint8, device=device),
        names=("domain", *(solid.name for solid in solids)),
        covered=tuple(int(cells) for cells in claimed),
        notes=tuple(notes),
    )


def inside(geometries: Sequence[Geometry], points: np.ndarray, *, device: wp.Device | str) -> np.ndarray:
    """Tell which points lie inside at least one of the geometries.

    Args:
        geometries: the regions; none contain nothing.
        points: [m], shape (m, 3); z = 0 in 2-D.
        device: where distances are evaluated, `CHUNK` points at a time.

    Returns:
        bool of shape (m,).

    Raises:
        ValueError: the points do not have three coordinates.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have shape (m, 3), not {points.shape}")
    result = np.zeros(len(points), dtype=bool)
    for geometry in geometries:
        bounds = geometry.bounds()
        near = ~result
        if bounds is not None:
            for axis, column in enumerate(points.T):
                near &= (column >= bounds[0][axis]) & (column <= bounds[1][axis])
        wanted = np.flatnonzero(near)
        for first in range(0, len(wanted), CHUNK):
            part = wanted[first : first + CHUNK]
            positions = wp.array(points[part], dtype=wp.vec3, device=device)
            distance = wp.empty(len(part), dtype=wp.float32, device=device)
            geometry.signed_distance(positions, distance)
            result[part] = distance.numpy() < 0.0
    return result


def _claim(
    index: wp.array3d(dtype=wp.int32),
    covered: wp.array(dtype=wp.int32),
    geometry: Geometry,
    number: int,
    spacing: float,
    dimension: int,
    origin: tuple[int, int, int],
) -> None:
    """Give the open cells inside a geometry to solid `number`, a few layers of its bounds at a time."""
    low, high = _cell_range(index.shape, geometry.bounds(), spacing, dimension, origin)
    across = high[:2] - low[:2]
    if not (low < high).all():
        return
    layers = max(1, CHUNK // int(across.prod()))
    for bottom in range(int(low[2]), int(high[2]), layers):
        top = min(bottom + layers, int(high[2]))
        size = int(across.prod()) * (top - bottom)
        block = block_of([*low[:2], bottom], [*high[:2], top], spacing, dimension, origin, offset=0.5)
        points = wp.empty(size, dtype=wp.vec3, device=index.device)
        distance = wp.empty(size, dtype=wp.float32, device=index.device)
        wp.launch(item_points, size, [block, points], device=index.device)
        geometry.signed_distance(points, distance)
        wp.launch(claim_cells, size, [block, distance, number, index, covered], device=index.device)


def _cell_range(
    shape: tuple[int, ...], bounds: np.ndarray | None, spacing: float, dimension: int, origin: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and one past the last interior cell (x, y, z) that bounds [m] can touch, with a cell to spare."""
    end = np.array(shape[::-1]) - 1
    low, high = np.ones(3, dtype=np.int64), end.copy()
    if bounds is not None:
        touched = np.clip(bounds / spacing + 1.0 - np.array(origin), 0.0, end)
        axes = slice(dimension)
        low[axes] = np.clip(np.floor(touched[0]) - 1, 1, end)[axes].astype(np.int64)
        high[axes] = np.clip(np.floor(touched[1]) + 2, 1, end)[axes].astype(np.int64)
    return low, high
