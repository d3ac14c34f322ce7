"""Seeding of regions beside thin solids: the amount of material is right to one particle.

A lattice point lies in a region or not, and so do all points of a row beside a wall: a box seven
cells wide gets up to 6 % too many or too few particles. Here a site of the lattice is a cube around
a lattice point, and f is the share of a site that lies in regions and outside of solids. A site
with f < 1 gets a particle in that share, at a random place, where t - f is below a limit. The
numbers t, from 0 to 1, are those of a sequence that is even along rows; the limit is such that the
number of particles is the sum of f.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.particles import lattice, seed
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.voxelize import inside, signed_distance
from warp_lcp.material.boundary import Boundary

SAMPLES = {2: 6, 3: 3}  # sample points per site and axis, for its filled share
# Numbers per site: a shift of the sample points along each axis, the choice of one, and t.
DRAWS = 5
# Steps of these numbers along x, y and z: square roots of primes, which have no common period.
STEPS = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47]).reshape(DRAWS, 3) % 1.0
# A site with at least this share counts as full, and one with at most the rest as empty, as long as
# other sites make up for it: single gaps in a row of particles make waves in liquid at rest.
NEARLY = 0.8
FIRST, LAST = -1.0, 1.0  # t - f of nearly full sites; added to t - f in nearly empty ones
Region = Callable[[np.ndarray], np.ndarray]


class PartialSites:
    """Sites of the seeding lattice that regions beside thin solids fill in part.

    Making this object is collective.

    Args:
        grid: the grid.
        boundary: its solids.
        geometries: the regions; a point in several belongs to the first.
        per_axis: sites along an edge of a cell.
        jitter: width of the random displacement of lattice points, which full sites get.
        random_seed: seed of the displacements and of the draws.

    Attributes:
        beside: the regions with a cell that a thin solid crosses.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        boundary: Boundary,
        geometries: Sequence[Geometry],
        *,
        per_axis: int,
        jitter: float,
        random_seed: int,
    ) -> None:
        self.grid, self.boundary, self.geometries = grid, boundary, list(geometries)
        self.per_axis, self.size = per_axis, grid.spacing / per_axis
        self.jitter, self.random_seed = jitter, random_seed
        self._start = np.random.default_rng(random_seed).random(DRAWS)
        self.beside = self._beside()

    def __bool__(self) -> bool:
        """Return whether a region is beside a thin solid."""
        return bool(self.beside)

    def _beside(self) -> list[Geometry]:
        """Return the regions that share a cell with a thin solid; collective."""
        grid, barriers = self.grid, self.grid.barriers
        if barriers is None:
            return []
        k, j, i = np.nonzero(grid.interior(barriers.near.numpy()))
        centers = (np.stack([i, j, k], axis=1) + np.array(grid.origin) + 0.5) * grid.spacing
        if grid.dimension == 2:
            centers[:, 2] = 0.0
        reach = 0.5 * math.sqrt(grid.dimension) * grid.spacing
        centers = centers[barriers.walls.room(centers, reach) < reach]
        shares = [
            bool((signed_distance(geometry, centers, grid.device) < reach).any())
            for geometry in self.geometries
        ]
        found = grid.part.ranks.sum(np.array(shares, dtype=np.int64))
        return [geometry for geometry, n in zip(self.geometries, found, strict=True) if n]

    def _sites_of(self, points: np.ndarray) -> np.ndarray:
        """Return the sites that points lie in, shape (n, 3), counted from the domain's corner."""
        sites = np.floor(np.asarray(points, dtype=np.float64) / self.size).astype(np.int64)
        sites[:, self.grid.dimension :] = 0
        return sites

    def _centers(self, sites: np.ndarray) -> np.ndarray:
        """Return the centers of sites [m], shape (n, 3), z = 0 in 2-D."""
        result = (sites + 0.5) * self.size
        result[:, self.grid.dimension :] = 0.0
        return result

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return whether points lie in partially filled sites, shape (n,)."""
        return self._partial(self._sites_of(points))

    def _partial(self, sites: np.ndarray) -> np.ndarray:
        """Return which sites the surface of a region, or of a thin solid in it, crosses."""
        grid, centers = self.grid, self._centers(sites)
        assert grid.barriers is not None, "regions are beside thin solids"
        reach = 0.5 * math.sqrt(grid.dimension) * self.size
        cells = sites // self.per_axis - np.array(grid.origin)
        near = np.zeros(len(sites), dtype=bool)
        ours = ((cells >= 0) & (cells < np.array(grid.counts))).all(axis=1)
        i, j, k = cells[ours].T
        near[ours] = grid.interior(grid.barriers.near.numpy())[k, j, i] > 0
        near[near] = grid.barriers.walls.room(centers[near], reach) < reach
        result = np.zeros(len(sites), dtype=bool)
        for geometry in self.beside:
            distance = signed_distance(geometry, centers, grid.device)
            result |= near & (distance < reach)
            result |= np.abs(distance) < reach
        return result

    def fill(self, open_cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the particles of the partially filled sites; collective.

        Args:
            open_cells: mask of the cells that may hold particles, shape (nz, ny, nx).

        Returns:
            Positions [m], float32, shape (n, 3), and the region of each, shape (n,).
        """
        grid = self.grid
        candidates = [
            self._candidates(*self._open_sites(plane, open_cells))
            for plane in range(grid.origin[2], grid.origin[2] + grid.counts[2])
        ]
        points, owner, count, draw = (
            np.concatenate(column) for column in zip(*candidates, strict=True)
        )
        samples = SAMPLES[grid.dimension] ** grid.dimension
        share = count / samples
        keys = np.where(share < NEARLY, draw - share, FIRST)
        keys[share <= 1.0 - NEARLY] += LAST
        everyone = grid.part.ranks.collect((keys, int(count.sum())))
        wanted = round(sum(filled for _, filled in everyone) / samples)
        order = np.sort(np.concatenate([other for other, _ in everyone]))
        kept = keys <= (order[wanted - 1] if wanted else -np.inf)
        return points[kept], owner[kept]

    def _open_sites(self, plane: int, open_cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return this process's partially filled sites in a plane of cells, and their points.

        Sites and lattice points [m] have shape (n, 3).
        """
        grid = self.grid
        points = lattice(grid, self.per_axis, self.jitter, self.random_seed, plane)
        sites = self._sites_of(lattice(grid, self.per_axis, 0.0, 0, plane))
        cells = sites // self.per_axis - np.array(grid.origin)
        ours = ((cells >= 0) & (cells < np.array(grid.counts)))[:, :2].all(axis=1)
        sites, cells, points = sites[ours], cells[ours], points[ours]
        free = open_cells[plane - grid.origin[2], cells[:, 1], cells[:, 0]]
        sites, points = sites[free], points[free]
        partial = self._partial(sites)
        return sites[partial], self._clipped(points[partial])

    def _clipped(self, points: np.ndarray) -> np.ndarray:
        """Return points [m], float32, at the distance of particles from the domain's sides."""
        axes, margin = slice(self.grid.dimension), MARGIN * self.grid.spacing
        result = points.astype(np.float32)
        np.clip(result[:, axes], margin, self.grid.extent[axes] - margin, out=result[:, axes])
        return result

    def _candidates(
        self, sites: np.ndarray, usual: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return a point in the filled part of each site that has one.

        A full site gets its lattice point `usual` [m], shape (n, 3).

        Returns:
            Points [m], float32, shape (n, 3); and, of shape (n,), their regions, the number of the
            site's sample points in regions, and t.
        """
        grid, dimension = self.grid, self.grid.dimension
        if not len(sites):
            none = np.zeros(0, dtype=np.int64)
            return usual, none, none, np.zeros(0)
        each, axes = SAMPLES[dimension], slice(dimension)
        draws = (sites @ STEPS.T + self._start) % 1.0
        steps = np.array(list(np.ndindex(*(each,) * dimension)), dtype=np.float64)
        points = np.zeros((len(sites), len(steps), 3))
        points[..., axes] = sites[:, None, axes] + (steps + draws[:, None, axes]) / each
        points *= self.size
        flat = self._clipped(points.reshape(-1, 3))
        free = self.boundary.admits(flat)
        owner = np.full(len(flat), -1)
        for number, geometry in enumerate(self.geometries):
            at = np.flatnonzero(free & (owner < 0))
            owner[at[inside([geometry], flat[at], device=grid.device)]] = number
        owners = owner.reshape(len(sites), len(steps))
        count = (owners >= 0).sum(axis=1)
        some = np.flatnonzero(count)
        # The chosen one among the sample points in regions.
        order = np.minimum((draws[some, 3] * count[some]).astype(int), count[some] - 1)
        chosen = (np.cumsum(owners[some] >= 0, axis=1) > order[:, None]).argmax(axis=1)
        result = flat.reshape(len(sites), len(steps), 3)[some, chosen]
        full = (count[some] >= NEARLY * len(steps)) & self.boundary.admits(usual[some])
        result[full] = usual[some[full]]
        return result, owners[some, chosen], count[some], draws[some, 4]


def seed_regions(
    grid: StaggeredGrid,
    boundary: Boundary,
    geometries: Sequence[Geometry],
    regions: Sequence[Region],
    open_cells: np.ndarray,
    *,
    per_axis: int,
    jitter: float,
    random_seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill regions with particles; collective.

    Without thin solids this is `warp_lcp.grid.particles.seed`.

    Args:
        grid: the grid.
        boundary: its solids.
        geometries: the regions.
        regions: the same as functions of points, outside of solids.
        open_cells: mask of the cells that may hold particles, shape (nz, ny, nx).
        per_axis: points along an edge of a cell.
        jitter: width of the random displacement as a fraction of the points' spacing.
        random_seed: seed of the displacements.

    Returns:
        Positions [m], float32, shape (n, 3), and the region of each, shape (n,).
    """
    partial = PartialSites(
        grid, boundary, geometries, per_axis=per_axis, jitter=jitter, random_seed=random_seed
    )
    position, owner = seed(
        grid,
        regions,
        open_cells,
        per_axis=per_axis,
        jitter=jitter,
        random_seed=random_seed,
        without=partial.holds if partial else None,
    )
    if not partial:
        return position, owner
    more, owners = partial.fill(open_cells)
    return np.concatenate([position, more]), np.concatenate([owner, owners])
