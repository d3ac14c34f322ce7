"""Seeding of regions beside thin solids: the amount of material is right to one particle.

A lattice point lies in a region or not, and so do all points of a row beside a wall: a box seven
cells wide gets up to 6 % too many or too few particles. Here a site of the lattice is a cube around
a lattice point, and its share is the part of it that lies in regions and outside of solids. Full
sites get their lattice point. The others are gathered into lanes, one site wide, along the surface
that crosses them: a site with a share below 1/2 is added to its neighbor away from the surface, so
that a lane is half a site to one and a half sites wide. A lane gets particles at equal amounts of
material from its begin to its end, in the middle of its width. Random places instead make waves:
liquid at rest beside a sheet reached 5 % of sqrt(g h).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from warp_lcp.grid.particle_loops import MARGIN
from warp_lcp.grid.particle_seeding import lattice, seed
from warp_lcp.grid.signed_distance import Geometry
from warp_lcp.grid.staggered import StaggeredGrid
from warp_lcp.grid.thin_walls import ThinWalls
from warp_lcp.grid.voxelize import signed_distance
from warp_lcp.material.boundary import Boundary

SAMPLES = {2: 8, 3: 4}  # blocks per site and axis, for its share
FULL = 1.0 - 1e-6  # least share of a full site
EMPTY = 1e-6  # share below which a site is empty
# A site with a smaller share is added to its neighbor. Shares of 1/2 are frequent, and rounding
# must not decide.
NARROW = 0.37
WIDE = 1.0 + 1e-3
STEP = 0.05  # sites: step of the differences that give the direction away from a wall
# Factors of a normal's components, by which it belongs to an axis. They differ, since at 45 degrees
# rounding must not decide.
PREFERRED = np.array([1.02, 1.01, 1.0])
# Steps of the place where a particle's region is looked up, along x, y and z: square roots of
# primes, which have no common period.
SHIFTS = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23]).reshape(3, 3) % 1.0
Region = Callable[[np.ndarray], np.ndarray]


@dataclass
class SiteFractions:
    """Parts of sites: of a site that a thin solid divides, one on each side.

    Attributes:
        site: counted from the domain's corner, shape (n, 3).
        share: filled part of the site, shape (n,).
        normal: direction into the material from the surface that crosses the site, shape (n, 3);
            0 in full sites.
        beside: whether that surface is a wall, bool of shape (n,).
        number: blocks of each part, shape (n,); 0 for full sites.
        block: places of the blocks in their sites, part by part, shape (m,).
        weight: filled part of each block, float32, shape (m,).
    """

    site: np.ndarray
    share: np.ndarray
    normal: np.ndarray
    beside: np.ndarray
    number: np.ndarray
    block: np.ndarray
    weight: np.ndarray

    @classmethod
    def joined(cls, pieces: Sequence[SiteFractions]) -> SiteFractions:
        """Return the parts of several objects, ordered by their sites."""
        columns = [
            np.concatenate([getattr(piece, name.name) for piece in pieces]) for name in fields(cls)
        ]
        site, share, normal, beside, number, block, weight = columns
        order = np.lexsort(site.T)
        blocks = _ranges((np.cumsum(number) - number)[order], number[order])
        return cls(
            site[order],
            share[order],
            normal[order],
            beside[order],
            number[order],
            block[blocks],
            weight[blocks],
        )


def _ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the numbers first, first + 1, ..., first + count - 1 of each pair, in a row."""
    ends = np.cumsum(count)
    total = int(ends[-1]) if len(ends) else 0
    return np.asarray(np.arange(total) + np.repeat(first - (ends - count), count))


class PartialSites:
    """Sites of the seeding lattice that regions beside thin solids fill in part.

    Making this object is collective.

    Args:
        grid: the grid.
        boundary: its solids.
        geometries: the regions; a point in several belongs to the first.
        per_axis: sites along an edge of a cell.
        jitter: width of the random displacement of lattice points, which full sites get.
        random_seed: seed of the displacements.

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
        each, axes = SAMPLES[grid.dimension], slice(grid.dimension)
        steps = np.array(list(np.ndindex(*(each,) * grid.dimension)), dtype=np.float64)
        # Centers of a site's blocks from its center [sites].
        self._blocks = np.zeros((len(steps), 3))
        self._blocks[:, axes] = (steps + 0.5) / each - 0.5
        self.beside = self._beside()

    def __bool__(self) -> bool:
        """Return whether a region is beside a thin solid."""
        return bool(self.beside)

    def _beside(self) -> list[Geometry]:
        """Return the regions that share a cell with a thin solid; collective.

        Both the solid and the region must be less than sqrt(d) dx / 2 from the center of a cell
        [m], the distance of its corners.
        """
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
        """Return whether points lie in sites that `fill` fills, shape (n,)."""
        return self._partial(self._sites_of(points))

    def _partial(self, sites: np.ndarray) -> np.ndarray:
        """Return which sites a surface crosses, and their neighbors.

        The surfaces are those of the regions, and of the thin solids in them.

        A surface counts if it is less than (sqrt(d) / 2 + 1) site edges from the center of a site
        [m]: it crosses the site or a neighbor.
        """
        grid, centers = self.grid, self._centers(sites)
        assert grid.barriers is not None, "regions are beside thin solids"
        reach = (0.5 * math.sqrt(grid.dimension) + 1.0) * self.size
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
        """Return the particles of these sites; collective.

        Args:
            open_cells: mask of the cells that may hold particles, shape (nz, ny, nx).

        Returns:
            Positions [m], float32, shape (n, 3), and the region of each, shape (n,).
        """
        grid = self.grid
        planes = range(grid.origin[2], grid.origin[2] + grid.counts[2])
        found = [self._open_sites(plane, open_cells) for plane in planes]
        sites, usual = (np.concatenate(column) for column in zip(*found, strict=True))
        own = SiteFractions.joined([self._parts(sites)])
        parts = SiteFractions.joined(grid.part.ranks.collect(own))
        target, normal = self._gathered(parts)
        in_lane = np.zeros(len(parts.site), dtype=bool)
        in_lane[target[parts.share < FULL]] = True
        alone = ~in_lane & (parts.share >= FULL)
        points = [self._lattice_points(parts.site[alone], sites, usual)]
        places, spare = self._lanes(parts, target, normal, in_lane)
        mine = self._owned(places)
        points.append(self._admitted(places[mine], spare[mine]))
        position = np.concatenate(points)
        owner = self._regions_of(position, self.size)
        # Of regions thinner than a site each gets its share: the region is that of another place in
        # the particle's site.
        shift = (self._sites_of(position) @ SHIFTS) % 1.0 - 0.5
        shift[:, grid.dimension :] = 0.0
        other = self._regions_of(position + shift * self.size, 0.0)
        return position[owner >= 0], np.where(other >= 0, other, owner)[owner >= 0]

    def _open_sites(self, plane: int, open_cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return this process's sites near surfaces in a plane of cells, and their points.

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

    def _owned(self, points: np.ndarray) -> np.ndarray:
        """Return which points [m], shape (n, 3), lie in cells of this process."""
        grid = self.grid
        own = np.ones(grid.counts[::-1], dtype=bool)
        grid.part.keep_own(own)
        cells = np.floor(points.astype(np.float64) / grid.spacing).astype(np.int64)
        cells = np.minimum(cells, np.array(grid.domain_counts) - 1) - np.array(grid.origin)
        cells[:, grid.dimension :] = 0
        result = np.asarray(((cells >= 0) & (cells < np.array(grid.counts))).all(axis=1))
        i, j, k = cells[result].T
        result[result] = own[k, j, i]
        return result

    def _regions_of(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Return the region of points [m], shape (n,): the first that has it, or the nearest.

        It is -1 where no region is at most `reach` away [m].
        """
        owner, nearest = np.full(len(points), -1), np.full(len(points), reach)
        for number, geometry in enumerate(self.geometries):
            at = np.flatnonzero((nearest > 0.0) | (owner < 0))
            at = at[_near(geometry, points[at], reach)]
            distance = signed_distance(geometry, points[at], self.grid.device)
            better = distance < nearest[at]
            nearest[at[better]] = np.where(distance < 0.0, 0.0, distance)[better]
            owner[at[better]] = number
        return owner

    def _share_in_regions(self, points: np.ndarray, block: float) -> np.ndarray:
        """Return the part of blocks that lies in regions, shape (n,).

        It is linear in the distance of their centers from a surface: exact for planes along the
        axes. Regions that touch fill a block together.

        Args:
            points: centers of the blocks [m], shape (n, 3).
            block: their edge [m].
        """
        result = np.zeros(len(points))
        for geometry in self.geometries:
            at = np.flatnonzero(_near(geometry, points, block))
            distance = signed_distance(geometry, points[at], self.grid.device)
            result[at] += np.clip(0.5 - distance / block, 0.0, 1.0)
        return np.minimum(result, 1.0)

    def _parts(self, sites: np.ndarray) -> SiteFractions:
        """Return the parts of sites of shape (n, 3); empty ones have none."""
        grid, count = self.grid, len(self._blocks)
        block = self.size / SAMPLES[grid.dimension]
        points = (sites[:, None, :] + 0.5 + self._blocks) * self.size
        points[..., grid.dimension :] = 0.0
        flat = points.reshape(-1, 3)
        filled = self._share_in_regions(flat, block)
        # Only blocks in regions matter. Distances to thin solids are negative in these.
        at = np.flatnonzero(filled > 0.0)
        walls, room = self._walls, np.full(len(flat), self.size)
        admitted = self.boundary.admits(flat[at])
        room[at] = np.abs(walls.room(flat[at], self.size)) * np.where(admitted, 1.0, -1.0)
        open_ = np.clip(0.5 + room / block, 0.0, 1.0)
        # Regions often end at walls: their surfaces then cut the same part off.
        weight = np.minimum(filled, open_).reshape(-1, count)
        cut = ((open_ < 1.0) & (filled > 0.0)).reshape(-1, count)
        crossed = np.asarray(cut.any(axis=1), dtype=bool)
        second = np.zeros(weight.shape, dtype=bool)
        at = np.flatnonzero(crossed)
        side, away = self._sides(points[at], weight[at], room.reshape(-1, count)[at])
        second[at] = side
        normal = np.zeros((len(sites), 3))
        normal[at] = away
        crossed = np.asarray(crossed & normal.any(axis=1), dtype=bool)
        pieces = [
            self._parts_of_side(sites, weight * ~second, normal, crossed),
            self._parts_of_side(sites[at], (weight * second)[at], -away, crossed[at]),
        ]
        return SiteFractions.joined(pieces)

    @property
    def _walls(self) -> ThinWalls:
        assert self.grid.barriers is not None, "regions are beside thin solids"
        return self.grid.barriers.walls

    def _sides(
        self, points: np.ndarray, weight: np.ndarray, room: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return which blocks are on the second side of a thin solid.

        The first side is that of the block with the most room, and the second one that where the
        direction away from the solid is opposed.

        Args:
            points: centers of the blocks [m], shape (n, blocks, 3).
            weight: their filled parts, shape (n, blocks).
            room: distance of each from thin solids [m], negative in these.

        Returns:
            Bool of shape (n, blocks); direction away from the solid on the first side, (n, 3), 0
            where all blocks with material have their centers in solids.
        """
        step, axes = STEP * self.size, range(self.grid.dimension)
        away = np.zeros(points.shape)
        at = weight > 0.0
        for axis in axes:
            moved = np.array([points[at], points[at]])
            moved[0, :, axis] += step
            moved[1, :, axis] -= step
            ahead, behind = (np.abs(self._walls.room(x, 2.0 * self.size)) for x in moved)
            away[at, axis] = (ahead - behind) * np.sign(room[at])
        first = np.where(at, room, -np.inf).argmax(axis=1)
        reference = away[np.arange(len(away)), first]
        # Within a solid the nearest side may be the other one.
        reference[room[np.arange(len(away)), first] <= 0.0] = 0.0
        opposed = (away * reference[:, None]).sum(axis=2) < 0.0
        return at & opposed & (room > 0.0), reference

    def _parts_of_side(
        self, sites: np.ndarray, weight: np.ndarray, away: np.ndarray, beside: np.ndarray
    ) -> SiteFractions:
        """Return the parts of sites on one side of thin solids.

        Args:
            sites: shape (n, 3).
            weight: filled parts of blocks, shape (n, blocks).
            away: direction away from the solid, shape (n, 3).
            beside: whether a solid crosses the site, shape (n,).
        """
        share = weight.mean(axis=1)
        kept = share > EMPTY
        sites, weight, share, beside = sites[kept], weight[kept], share[kept], beside[kept]
        full = share >= FULL
        center = (weight @ self._blocks) / share[:, None]
        normal = np.where(beside[:, None], away[kept], center) * ~full[:, None]
        part, block = np.nonzero((weight > 0.0) & ~full[:, None])
        number = np.bincount(part, minlength=len(sites))
        filled = weight[part, block].astype(np.float32)
        return SiteFractions(sites, share, normal, beside & ~full, number, block, filled)

    def _gathered(self, parts: SiteFractions) -> tuple[np.ndarray, np.ndarray]:
        """Return the part that each part is added to, often itself, and the parts' normals.

        A full site gets the normal of the largest part that is added to it.

        A part with a share below NARROW is added to the part with a larger share in the next site
        along the largest component of its normal, which points into the material; not to one on the
        other side of a thin solid. Chains are followed to their end. Parts are added in order of
        their shares, so that the normal of the largest one remains.
        """
        count = len(parts.site)
        axis = np.abs(parts.normal * PREFERRED).argmax(axis=1)
        sign = np.sign(parts.normal[np.arange(count), axis]).astype(np.int64)
        key = _keys(parts.site)
        target, normal = np.arange(count), parts.normal.copy()
        narrow = np.flatnonzero(parts.share < NARROW)
        beyond = parts.site[narrow].copy()
        beyond[np.arange(len(narrow)), axis[narrow]] += sign[narrow]
        first = np.searchsorted(key, _keys(beyond))
        for other in (first, first + 1):  # a site has at most two parts
            m = np.minimum(other, count - 1)
            opposed = (parts.normal[m] * parts.normal[narrow]).sum(axis=1) < 0.0
            apart = parts.beside[m] & parts.beside[narrow] & opposed
            good = (key[m] == _keys(beyond)) & (parts.share[m] > parts.share[narrow]) & ~apart
            target[narrow[good]] = m[good]
        while (target[target] != target).any():
            target = target[target]
        added = np.argsort(parts.share, kind="stable")
        added = added[(target[added] != added) & (parts.share[target[added]] >= FULL)]
        normal[target[added]] = parts.normal[added]  # the last one remains
        return target, normal

    def _lattice_points(self, full: np.ndarray, sites: np.ndarray, usual: np.ndarray) -> np.ndarray:
        """Return this process's points [m] of full sites.

        They are lattice points, or the centers of sites where a wall is too near to these.

        Args:
            full: sites of all processes, shape (n, 3).
            sites: those of this process, shape (m, 3).
            usual: their lattice points [m], shape (m, 3).
        """
        at = np.isin(_keys(sites), _keys(full))
        points, centers = usual[at], self._clipped(self._centers(sites[at]))
        return self._admitted(points, centers)

    def _admitted(self, points: np.ndarray, spare: np.ndarray) -> np.ndarray:
        """Return points [m] of regions where a particle may start, or else spare points.

        A spare point is the center of a block that may be filled by less than half, so that its
        center lies beyond the wall: then there is no particle.
        """
        good = self._may_start(points)
        points = np.where(good[:, None], points, spare)
        good[~good] = self._may_start(points[~good])
        return np.asarray(points[good])

    def _may_start(self, points: np.ndarray) -> np.ndarray:
        """Return which points [m], shape (n, 3), lie in a region where a particle may start."""
        return np.asarray(self.boundary.admits(points) & (self._regions_of(points, 0.0) >= 0))

    def _lanes(
        self, parts: SiteFractions, target: np.ndarray, normal: np.ndarray, in_lane: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the particles of the lanes [m], float32, and for each the center of a block.

        Lanes follow sites of the same nearest axis of the normal, and its sign. In 3-D they are
        sheets, and consist of lines. The amounts of lines are rounded so that their sum is right.

        Args:
            parts: of sites.
            target: the part that each is added to.
            normal: of the parts, shape (n, 3).
            in_lane: which parts are in a lane with those that are added to them.
        """
        head = np.flatnonzero(in_lane)
        if not len(head):
            return np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.float32)
        axis = np.abs(normal[head] * PREFERRED).argmax(axis=1)
        sign = np.sign(normal[head, axis]).astype(np.int64)
        along = np.where(axis == 1, 0, 1)  # lines go upwards, or along x
        over = 3 - axis - along
        site = parts.site[head]
        rows = np.arange(len(head))
        lane = _lane_of(site, axis, sign)
        # Lines that go up begin at their top.
        down = np.where(along == 1, -1, 1)
        keys = (site[rows, axis], down * site[rows, along], site[rows, over], lane)
        order = np.lexsort(keys)
        axis, along, down = axis[order], along[order], down[order]
        # Blocks of the heads in this order, and of the parts that are added to them.
        place = np.full(len(parts.site), -1)
        place[head[order]] = rows
        member, center, weight = self._blocks_of(parts, place[target])
        block = self.size / SAMPLES[self.grid.dimension]
        layer = np.floor(center[np.arange(len(member)), along[member]] / block).astype(np.int64)
        by_layer = np.lexsort((weight, down[member] * layer, member))
        member, layer, center, weight = (
            column[by_layer] for column in (member, layer, center, weight)
        )
        starts = np.flatnonzero(np.diff(member, prepend=-1) | np.diff(layer, prepend=-1))
        amount = np.add.reduceat(weight, starts)
        middle = np.add.reduceat(weight[:, None] * center, starts) / amount[:, None]
        # The fullest block of each member.
        ends = np.flatnonzero(np.diff(member, append=len(rows)))
        spare = center[np.lexsort((weight, member))[ends]]
        member, layer = member[starts], layer[starts]
        width = amount / SAMPLES[self.grid.dimension] ** (self.grid.dimension - 1)
        amount = amount / len(self._blocks)
        line = np.stack([lane, site[rows, over]])[:, order]
        line = np.cumsum(np.append(0, np.diff(line, axis=1).any(axis=0)))[member]
        total = np.bincount(line, weights=amount)
        number = np.diff(np.floor(np.cumsum(total) + 0.5), prepend=0.0).astype(np.int64)
        # At free surfaces, mostly above, amounts are exact, and what is left over is below.
        exact = (np.bincount(line, weights=down[member]) < 0.0) & (number <= total + 0.25)
        factor = np.where(exact, 1.0, number / total)
        sums, ends = np.cumsum(amount * factor[line]), np.cumsum(total * factor)
        start = np.repeat(ends - total * factor, number)
        wanted = start + _ranges(0 * number, number) + 0.5
        at = np.minimum(np.searchsorted(sums, wanted), len(sums) - 1)
        part = (sums[at] - wanted) / (amount * factor[line])[at]
        part = np.clip(np.where(down[member[at]] > 0, 1.0 - part, part), 0.0, 1.0)
        points, each = middle[at], np.arange(len(at))
        points[each, along[member[at]]] = (layer[at] + part) * block
        # In lanes wider than a site particles lie on the left and on the right by turns.
        turn = (np.floor(wanted - start) + line[at]) % 2
        shift = np.where(width[at] > WIDE, 0.25 * width[at] * (1.0 - 2.0 * turn), 0.0)
        points[each, axis[member[at]]] += shift * self.size
        return self._clipped(points), self._clipped(spare[member[at]])

    def _blocks_of(
        self, parts: SiteFractions, place: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the blocks of the parts in lanes.

        Args:
            parts: of sites.
            place: of the part that each is added to, in the order of the lanes; -1 for none.

        Returns:
            The place of each block's part, shape (n,); its center [m], shape (n, 3); its filled
            part, shape (n,).
        """
        axes, count = slice(self.grid.dimension), len(self._blocks)
        full = parts.number == 0
        number = np.where(full, count, parts.number)
        first = np.cumsum(parts.number) - parts.number
        part = np.repeat(np.arange(len(number)), number)
        order = _ranges(np.zeros(len(number), dtype=np.int64), number)
        stored = np.minimum(first[part] + order, max(len(parts.block) - 1, 0))
        block = np.where(full[part], order, parts.block[stored] if len(parts.block) else order)
        weight = np.where(full[part], 1.0, parts.weight[stored] if len(parts.block) else 1.0)
        used = place[part] >= 0
        part, block, weight = part[used], block[used], weight[used]
        center = np.zeros((len(part), 3))
        center[:, axes] = (parts.site[part] + 0.5 + self._blocks[block])[:, axes] * self.size
        return place[part], center, weight.astype(np.float64)


def _near(geometry: Geometry, points: np.ndarray, reach: float) -> np.ndarray:
    """Return which points [m], shape (n, 3), are in a geometry's bounds, or at most `reach` off."""
    bounds = geometry.bounds()
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    low, high = np.array(bounds[0]) - reach, np.array(bounds[1]) + reach
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def _keys(sites: np.ndarray) -> np.ndarray:
    """Return a number per site, in the order (z, y, x); sites from -1 to 2^20."""
    x, y, z = (sites.astype(np.int64) + 1).T
    return np.asarray((z << 42) | (y << 21) | x)


def _lane_of(site: np.ndarray, axis: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the lane of sites, shape (n,): those that touch, with the same axis and sign.

    Along the axis there may be a site between two of a lane, whose share has been added to one.

    Args:
        site: shape (n, 3).
        axis: nearest axis of the normals, shape (n,).
        sign: that of the normals on this axis.
    """
    result, count = np.zeros(len(site), dtype=np.int64), 0
    for own, direction in product(range(3), (-1, 1)):
        at = np.flatnonzero((axis == own) & (sign == direction))
        if not len(at):
            continue
        key, links = _keys(site[at]), []
        order = np.argsort(key)
        reach = [(0, 1) if d != own else (0, 1, 2) for d in range(3)]
        for step in product(*(sorted({-n for n in r} | set(r)) for r in reach)):
            other = _keys(site[at] + np.array(step))
            place = np.minimum(np.searchsorted(key[order], other), len(at) - 1)
            found = key[order][place] == other
            links.append(np.stack([np.flatnonzero(found), order[place[found]]]))
        pairs = np.concatenate(links, axis=1)
        graph = coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(len(at),) * 2)
        lanes, label = connected_components(graph, directed=False)
        result[at] = count + label
        count += lanes
    return result


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
