"""Solids as whole cells, points inside regions, and warnings about solids.

Warnings are of meshes that needed repair, that reach out of the domain or are thinner than a cell.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_lcp.grid.domain_sides import open_ring
from warp_lcp.grid.motion import Motion
from warp_lcp.grid.node_distance import CHUNK, NodeSampler, nodes_near
from warp_lcp.grid.signed_distance import Geometry, TriangleMesh
from warp_lcp.grid.signed_distance_kernels import claim_cells
from warp_lcp.grid.staggered import StaggeredGrid

OPEN = -1
DOMAIN_WALL = 0
STRAY = 0.5  # cells by which a mesh may reach out of the domain without a warning
THIN_SHARE = 0.01  # share of a mesh's surface above which thin parts cause a warning
# Share of a mesh's surface. More area that is inside out is no blemish: its inside would be
# missing.
INVERTED_SHARE = 0.01


@dataclass(frozen=True, kw_only=True)
class PlacedSolid:
    """Placed solid of a scene.

    Args:
        geometry: the region it fills.
        separating: whether liquid may leave its wall (otherwise it slides along it only).
        name: name of the solid in messages, for example `solid[2] (sphere)`.
        motion: motion from the initial place of the geometry; None if it stands still.
        among: name of the surrounding material in messages.
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
        index: int32 of shape (nz + 2, ny + 2, nx + 2): -1 in open cells, 0 in the domain's wall
            (the ring, but for what lies beyond open sides), 1 + s in cells of solid s.
        separating: uint8 of shape (1 + solids,), on the device: 1 where the wall of that index lets
            liquid leave.
        names: names by index, the first "domain".
        covered: number of cells whose center lies in each solid, including cells assigned to
            another; shape (solids,), without the domain.
        notes: warnings for the start of a run.
    """

    index: wp.array3d(dtype=wp.int32)
    separating: wp.array(dtype=wp.uint8)
    names: tuple[str, ...]
    covered: tuple[int, ...]
    notes: tuple[str, ...]


def voxelize(
    grid: StaggeredGrid,
    solids: Sequence[PlacedSolid],
    *,
    wall_separating: bool,
    open_sides: int = 0,
    remarks: bool = True,
    counts: bool = True,
) -> VoxelSolids:
    """Assign every cell whose center lies inside a solid to the first such solid.

    Args:
        grid: the grid.
        solids: the solids, in the order of their claims.
        wall_separating: whether liquid may leave the domain's wall.
        open_sides: bits of `warp_lcp.grid.domain_sides.side_bits`: beyond them cells are open.
        remarks: write notes and refuse errors at the start of a run; False once solids have moved.
        counts: fill `covered`, which waits for the device; needed for remarks.

    Raises:
        ValueError: with `remarks`, a solid lies wholly outside the domain, or the solids leave no
            open cell.
    """
    host = np.full(grid.shape, DOMAIN_WALL, dtype=np.int32)
    grid.interior(host)[...] = OPEN
    host[open_ring(grid.shape, open_sides)] = OPEN
    index = wp.array(host, dtype=wp.int32, device=grid.device)
    covered = wp.zeros(1 + len(solids), dtype=wp.int32, device=grid.device)
    notes = start_notes(solids, grid) if remarks else []
    sampler, end = NodeSampler(grid), np.array(grid.shape[::-1]) - 1
    for number, solid in enumerate(solids, start=1):
        near = nodes_near(grid, solid.geometry, reach=1.0)
        low, high = (
            (end, end) if near is None else (np.maximum(near[0], 1), np.minimum(near[1], end))
        )
        for block, distances in (
            sampler.measured(solid.geometry, low, high, offset=0.5) if (low < high).all() else ()
        ):
            wp.launch(
                claim_cells,
                len(distances),
                [block, distances, number, index, covered],
                device=grid.device,
            )
    claimed = covered.numpy()[1:] if counts else np.zeros(len(solids), dtype=np.int32)
    if remarks:
        notes += small_notes((solid.name for solid in solids), claimed, grid.spacing)
        check_open(not solids or bool((grid.interior(index.numpy()) == OPEN).any()))
    return VoxelSolids(
        index=index,
        separating=wp.array(
            [wall_separating, *(solid.separating for solid in solids)],
            dtype=wp.uint8,
            device=grid.device,
        ),
        names=("domain", *(solid.name for solid in solids)),
        covered=tuple(int(cells) for cells in claimed),
        notes=tuple(notes),
    )


def inside(
    geometries: Sequence[Geometry], points: np.ndarray, *, device: wp.Device | str
) -> np.ndarray:
    """Return a mask of the points that lie inside any of the geometries.

    Args:
        geometries: the regions; none contain nothing.
        points: [m], shape (m, 3); z = 0 in 2-D.
        device: device on which distances are evaluated.

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
        candidates = np.flatnonzero(~result) if result.any() else np.arange(len(points))
        # points often are of one plane
        for axis, low, high in (
            [] if bounds is None else list(zip(range(3), *bounds, strict=True))[::-1]
        ):
            column = points[candidates, axis]
            candidates = candidates[(column >= low) & (column <= high)]
        for first in range(0, len(candidates), CHUNK):
            part = candidates[first : first + CHUNK]
            positions = wp.array(points[part], dtype=wp.vec3, device=device)
            distance = wp.empty(len(part), dtype=wp.float32, device=device)
            geometry.signed_distance(positions, distance)
            result[part] = distance.numpy() < 0.0
    return result


def signed_distance(geometry: Geometry, points: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return the signed distance of points from a geometry [m], negative inside.

    Args:
        geometry: the region.
        points: [m], shape (m, 3); z = 0 in 2-D.
        device: device on which distances are evaluated.

    Returns:
        Distances, shape (m,).
    """
    result = np.empty(len(points), dtype=np.float32)
    for first in range(0, len(points), CHUNK):
        part = slice(first, first + CHUNK)
        positions = wp.array(points[part], dtype=wp.vec3, device=device)
        distance = wp.empty(len(positions), dtype=wp.float32, device=device)
        geometry.signed_distance(positions, distance)
        result[part] = distance.numpy()
    return result


def start_notes(
    solids: Sequence[PlacedSolid], grid: StaggeredGrid, held: Collection[int] = ()
) -> list[str]:
    """Return warnings about solids at the start of a run.

    Solids that move may enter later and are checked less. Those with the numbers `held`, from 1 on,
    may be thinner than cells.

    Raises:
        ValueError: a solid that stands still lies wholly outside the domain, or a part of a mesh is
            turned inside out.
    """
    notes = []
    for number, solid in enumerate(solids, start=1):
        still = solid.motion is None
        notes += (
            placement_notes(solid.geometry, solid.name, grid)
            if still
            else repair_notes(solid.geometry, solid.name)
        )
        notes += [] if number in held else _thin_notes(solid, grid)
    return notes


def check_open(any_open: bool) -> None:
    """Refuse solids that leave no open cell.

    Raises:
        ValueError: `any_open` is False.
    """
    if not any_open:
        raise ValueError(
            "the solids fill the whole domain: no open cell is left (is one inverted, or a plane's "
            "normal the wrong way round?)"
        )


def small_notes(names: Iterable[str], covered: Iterable[int], spacing: float) -> list[str]:
    """Return warnings about solids that contain no cell center.

    For cells of `spacing` [m].
    """
    note = f"is too small for the grid: no center of a cell of {spacing:.4g} m lies inside it"
    return [f"{name} {note}" for name, cells in zip(names, covered, strict=False) if not cells]


def placement_notes(geometry: Geometry, name: str, grid: StaggeredGrid) -> list[str]:
    """Return warnings about a region: repaired meshes, meshes outside the domain.

    Args:
        geometry: a solid, or the liquid's start.
        name: name of the region in messages.
        grid: the grid, or a part of one.

    Raises:
        ValueError: the region lies wholly outside the domain.
    """
    notes = repair_notes(geometry, name)
    bounds = geometry.bounds()
    if bounds is None:
        return notes
    low, high = bounds
    dimension, spacing = grid.dimension, grid.spacing
    if dimension == 2 and (low[2] > 0.0 or high[2] < 0.0):
        raise ValueError(
            f"{name} spans z = [{low[2]:.4g}, {high[2]:.4g}] m and misses z = 0, the plane of a "
            "2-D scene; check its translation"
        )
    low, high = low[:dimension], high[:dimension]
    size = spacing * np.array(grid.domain_counts[:dimension])
    if (high <= 0.0).any() or (low >= size).any():
        spans = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))
        domain = " x ".join(f"[0, {extent:.4g}]" for extent in size)
        raise ValueError(
            f"{name} lies wholly outside the domain: it spans {spans} m, the domain {domain} m; "
            "check its scale and translation"
        )
    stray = max(float((-low).max()), float((high - size).max()))
    if isinstance(geometry, TriangleMesh) and stray > STRAY * spacing:
        notes.append(
            f"{name} reaches {stray:.4g} m out of the domain; the part outside has no effect"
        )
    return notes


def repair_notes(geometry: Geometry, name: str) -> list[str]:
    """Return the repairs and self-intersections of a mesh, a line each.

    Raises:
        ValueError: a part of the mesh is turned inside out, so that its inside would count as
            outside.
    """
    if not isinstance(geometry, TriangleMesh):
        return []
    surface, crossings = geometry.surface, geometry.surface.crossings
    notes = [f"{name}: {warning}" for warning in surface.warnings]
    if crossings.place is None:
        return notes
    what = (
        f"{crossings.count} of its {len(surface.triangles)} triangles cross others, first"
        if crossings.count
        else "a part lies inside another,"
    )
    what += f" at {[float(f'{coordinate:.4g}') for coordinate in crossings.place]}"
    if crossings.inverted > INVERTED_SHARE:
        raise ValueError(
            f"{name}: {surface.name}: {what}, and about {crossings.inverted:.0%} of its surface is "
            "inside out there: what that surrounds would "
            "count as outside. Repair the mesh (in Blender: a Remesh modifier; in MeshLab: Remove "
            "Self Intersecting Faces, Close Holes)"
        )
    return [*notes, f"{name}: {surface.name}: {what}; overlapping parts count as inside, once"]


def _thin_notes(solid: PlacedSolid, grid: StaggeredGrid) -> list[str]:
    """Return a warning if a mesh has walls that the cells may miss.

    Material may then pass through them.
    """
    geometry = solid.geometry
    if not isinstance(geometry, TriangleMesh) or geometry.invert:
        return []
    thin = geometry.thin_fraction(grid.spacing, grid.device)
    if thin <= THIN_SHARE:
        return []
    return [
        f"{solid.name} is thinner than a cell of {grid.spacing:.4g} m under {thin:.0%} of its "
        f"surface: {solid.among} may pass there"
    ]
