"""Seeding: particles on a jittered lattice fill regions."""

import typing

import numpy as np

from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.staggered import StaggeredGrid


def lattice(
    grid: StaggeredGrid, per_axis: int, jitter: float, random_seed: int, plane: int
) -> np.ndarray:
    """Return jittered lattice points in one plane of cells.

    per_axis^dimension points per cell; the same in a part of a grid as in the whole.

    Args:
        grid: the grid; of a part one cell more on each side, from which points may be moved into
            it.
        per_axis: points along an edge of a cell.
        jitter: width of the uniform random displacement, as a fraction of the points' spacing.
        random_seed: seed of the displacements, which are one sequence over all of the grid.
        plane: index of the cells along z, from 0; 0 in 2-D.

    Returns:
        Points [m], shape (n, 3), z = 0 in 2-D.
    """
    dimension, spacing = grid.dimension, grid.spacing / per_axis
    site_counts = np.array(grid.domain_counts[:2]) * per_axis
    low = np.maximum(np.array(grid.origin[:2]) - 1, 0) * per_axis
    high = np.minimum((np.array(grid.origin[:2]) + grid.counts[:2] + 1) * per_axis, site_counts)
    x, y = (np.arange(first, last) for first, last in zip(low, high, strict=True))
    z = (
        np.arange(plane * per_axis, (plane + 1) * per_axis)
        if dimension == 3
        else np.zeros(1, dtype=int)
    )
    moved = np.empty((len(z), len(y), len(x), dimension))
    for number, layer in enumerate(z):
        drawn = np.random.PCG64(random_seed)
        # Skip the random numbers of the points before.
        drawn.advance(int((layer * site_counts[1] + low[1]) * site_counts[0]) * dimension)
        rows = np.random.Generator(drawn).random((len(y), site_counts[0], dimension))
        moved[number] = rows[:, low[0] : high[0]]
    Z, Y, X = np.meshgrid(
        z + 0.5 if dimension == 3 else np.zeros(1), y + 0.5, x + 0.5, indexing="ij"
    )
    points = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
    points[:, :dimension] += jitter * (moved.reshape(-1, dimension) - 0.5)
    return points * spacing


def seed(
    grid: StaggeredGrid,
    regions: typing.Sequence[typing.Callable[[np.ndarray], np.ndarray]],
    open_cells: np.ndarray,
    *,
    per_axis: int,
    jitter: float,
    random_seed: int,
    without: typing.Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill regions with particles on a jittered lattice.

    A point in several regions belongs to the first.

    Args:
        grid: the grid.
        regions: functions of points [m], shape (n, 3), that return which lie in the region, shape
            (n,).
        open_cells: mask of the cells that may hold particles, shape (nz, ny, nx).
        per_axis: points along an edge of a cell, >= 1.
        jitter: width of the random displacement as a fraction of the points' spacing, 0 <= jitter
            <= 1.
        random_seed: seed of the displacements; they do not depend on the regions.
        without: function of points [m], shape (n, 3), that returns which get no particle, shape
            (n,).

    Returns:
        Positions [m], float32, shape (n, 3), and the region of each, shape (n,).

    Raises:
        ValueError: `per_axis` or `jitter` is out of range.
    """
    if per_axis < 1:
        raise ValueError(f"per_axis = {per_axis}: must be at least 1")
    if not 0.0 <= jitter <= 1.0:
        raise ValueError(f"jitter = {jitter}: must be between 0 and 1")
    axes, margin = slice(grid.dimension), MARGIN * grid.spacing
    size, last = grid.extent, np.array(grid.domain_counts) - 1
    positions, owners = [], []
    for plane in range(grid.origin[2], grid.origin[2] + grid.counts[2]):
        points = lattice(grid, per_axis, jitter, random_seed, plane).astype(np.float32)
        np.clip(points[:, axes], margin, size[axes] - margin, out=points[:, axes])
        cells = np.minimum((points.astype(np.float64) / grid.spacing).astype(int), last) - np.array(
            grid.origin
        )
        if grid.whole is not None:
            ours = ((cells >= 0) & (cells < np.array(grid.counts)))[:, :2].all(axis=1)
            points, cells = points[ours], cells[ours]
        free = open_cells[plane - grid.origin[2], cells[:, 1], cells[:, 0]]
        points = points[free]
        if without is not None:
            points = points[~without(points)]
        owner = np.full(len(points), -1)
        for number, region in enumerate(regions):
            if len(points):
                owner[(owner < 0) & region(points)] = number
        positions.append(points[owner >= 0])
        owners.append(owner[owner >= 0])
    return np.concatenate(positions), np.concatenate(owners)
