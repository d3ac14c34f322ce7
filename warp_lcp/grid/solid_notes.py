"""What to warn about before a run: meshes that needed repair, that reach out of the domain or are thinner than a cell."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import warp as wp

from warp_lcp.grid.solids import Geometry, TriangleMesh

STRAY = 0.5  # of a cell: a mesh may reach this far out of the domain before anyone is told
THIN_SHARE = 0.01  # of a mesh's surface, from which thin parts are worth a warning
INVERTED_SHARE = 0.01  # of a mesh's surface, from which what is inside out is no longer a blemish: its inside would be missing


def check_open(any_open: bool) -> None:
    """Refuse solids that leave no open cell.

    Raises:
        ValueError: `any_open` is False.
    """
    if not any_open:
        raise ValueError(
            "the solids fill the whole domain: no open cell is left (is one inverted, or a plane's normal the wrong way round?)"
        )


def small_notes(names: Iterable[str], covered: Iterable[int], spacing: float) -> list[str]:
    """Return warnings about solids that cover no center of a cell of `spacing` [m]."""
    note = f"is too small for the grid: no center of a cell of {spacing:.4g} m lies inside it"
    return [f"{name} {note}" for name, cells in zip(names, covered, strict=False) if not cells]


def placement_notes(geometry: Geometry, name: str, counts: tuple[int, int, int], spacing: float, dimension: int) -> list[str]:
    """Return warnings about a region: what its mesh needed repaired, and that a mesh sticks out of the domain.

    Args:
        geometry: a solid, or the liquid's start.
        name: what messages call it.
        counts: number of cells (nx, ny, nz), nz = 1 in 2-D.
        spacing: side of a cell [m].
        dimension: 2 or 3.

    Raises:
        ValueError: the region lies wholly outside the domain.
    """
    notes = repair_notes(geometry, name)
    bounds = geometry.bounds()
    if bounds is None:
        return notes
    low, high = bounds
    if dimension == 2 and (low[2] > 0.0 or high[2] < 0.0):
        raise ValueError(
            f"{name} spans z = [{low[2]:.4g}, {high[2]:.4g}] m and misses the plane z = 0, which is a 2-D scene's; check its translation"
        )
    low, high = low[:dimension], high[:dimension]
    size = spacing * np.array(counts[:dimension])
    if (high <= 0.0).any() or (low >= size).any():
        spans = " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))
        domain = " x ".join(f"[0, {extent:.4g}]" for extent in size)
        raise ValueError(
            f"{name} lies wholly outside the domain: it spans {spans} m, the domain {domain} m; check its scale and translation"
        )
    stray = max(float((-low).max()), float((high - size).max()))
    if isinstance(geometry, TriangleMesh) and stray > STRAY * spacing:
        notes.append(f"{name} reaches {stray:.4g} m out of the domain; what is out there has no effect")
    return notes


def repair_notes(geometry: Geometry, name: str) -> list[str]:
    """Return what a mesh needed repaired and where it crosses itself, a line each.

    Raises:
        ValueError: a part of the mesh is turned inside out, so that its inside would count as outside.
    """
    if not isinstance(geometry, TriangleMesh):
        return []
    surface, found = geometry.surface, geometry.surface.crossings
    notes = [f"{name}: {warning}" for warning in surface.warnings]
    if found.place is None:
        return notes
    what = f"{found.count} of its {len(surface.triangles)} triangles cross others, first" if found.count else "a part lies inside another,"
    what += f" at {[float(f'{coordinate:.4g}') for coordinate in found.place]}"
    if found.inverted > INVERTED_SHARE:
        raise ValueError(
            f"{name}: {surface.name}: {what}, and about {found.inverted:.0%} of its surface is inside out there: what that surrounds would "
            "count as outside. Repair the mesh (in Blender: a Remesh modifier; in MeshLab: Remove Self Intersecting Faces, Close Holes)"
        )
    return [*notes, f"{name}: {surface.name}: {what}; what is surrounded twice counts as inside, once"]


def thin_notes(geometry: Geometry, name: str, among: str, spacing: float, device: wp.Device) -> list[str]:
    """Return a warning when a mesh has walls that the cells may miss, so that what it is `among` may pass: thinner than `spacing` [m]."""
    if not isinstance(geometry, TriangleMesh) or geometry.invert:
        return []
    thin = geometry.thin_fraction(spacing, device)
    if thin <= THIN_SHARE:
        return []
    return [f"{name} is thinner than a cell of {spacing:.4g} m under {thin:.0%} of its surface: {among} may pass there"]
