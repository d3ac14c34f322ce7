"""Load balancing: boxes whose busiest rank has the least work.

The grid is repartitioned when material has moved far enough for that to pay.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_lcp.distributed.decomposition import (
    OPEN,
    Decomposition,
    Triple,
    cells_with_ghosts,
    cuttings,
    parts,
)
from warp_lcp.grid.particles import Particles
from warp_lcp.multigrid.halo_levels import GATHERED

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

# Fixed cost of a step, as the work of cells full of material.
STEP = 1 << 13
BLOCKS = 128  # blocks of a rank, five along an axis
ROUNDS = 4  # sweeps over the axes: none of them increases the work of the busiest rank

Parts = list[list[int]]  # cells of each box along x, y, z


@dataclass(frozen=True)
class WorkLoad:
    """Work of a step, by blocks of cells.

    Cuts lie between blocks, so that the levels of multigrid that ranks share end at them.

    Args:
        counts: cells (nx, ny, nz) of the whole grid.
        layers: of ghost cells, which no box may be thinner than.
        edge: of a block, in cells.
        material: in cells full of it, shape (blocks along x, y, z).
    """

    counts: Triple
    layers: int
    edge: int
    material: np.ndarray

    def best(
        self, ranks: int, start: Parts | None = None, *, rank: int | None = None
    ) -> tuple[float, Parts] | None:
        """Return the least work of the busiest rank, and the cuts for it.

        Returns None if there are too many ranks for the grid. Cuts along one axis are optimal for
        the given cuts along the others (dynamic programming); the axes are optimized in turn.

        Args:
            ranks: number of ranks.
            start: cuts to start from as well, so that the result is no worse than they are.
            rank: search only this rank's share of the numbers of boxes along x, y, z, where all
                ranks search together; None: search all of them.
        """
        total, candidates = float(self.material.sum()), list[tuple[float, Parts]]()

        def least(p: Triple) -> float:
            """Return a lower bound of the busiest rank's work: an even share of all work."""
            return (
                total
                + OPEN
                * math.prod(
                    n + 2 * self.layers * (a - 1) for n, a in zip(self.counts, p, strict=True)
                )
            ) / ranks

        processes = sorted(cuttings(self.counts, ranks), key=lambda p: (least(p), p))
        for p in processes if rank is None else processes[rank::ranks]:
            if candidates and least(p) >= min(candidates)[0]:
                break
            starts = [[parts(n, a) for n, a in zip(self.counts, p, strict=True)]]
            if start is not None and tuple(map(len, start)) == p:
                starts.append(start)
            candidates += filter(None, map(self._improved, starts))
        return min(candidates) if candidates else None

    def _improved(self, cut: Parts) -> tuple[float, Parts] | None:
        """Return improved cuts and the work of the busiest rank.

        The number of boxes along each axis stays. Returns None if they do not fit into the grid.
        """
        work = math.inf
        for _ in range(ROUNDS):
            before = work
            for axis, part in enumerate(cut):
                if len(part) == 1 and math.isfinite(work):
                    continue
                along = self._along(axis, cut)
                if along is None:
                    return None
                work, part = along
                cut = [*cut[:axis], part, *cut[axis + 1 :]]
            if work >= before:
                break
        return work, cut

    def _along(self, axis: int, cut: Parts) -> tuple[float, list[int]] | None:
        """Return the optimal cuts along an axis, and the work of the busiest rank.

        The cuts along the other axes are fixed. Returns None if the boxes do not fit. The method is
        dynamic programming. w(a, e) is the work of the busiest box between the block boundaries a
        and e. The least work of the busiest box, with k boxes along the axis up to e, is

            W_1(e) = w(0, e),   W_k(e) = min over a of max(W_(k-1)(a), w(a, e))
        """
        n, ranks, other_axes = self.counts[axis], len(cut[axis]), [a for a in range(3) if a != axis]
        ends = np.append(np.arange(0, n, self.edge), n)
        beside, material = (
            cells_with_ghosts(self.counts, [*cut[:axis], [n], *cut[axis + 1 :]], self.layers),
            np.moveaxis(self.material, axis, 0),
        )
        for place, other in enumerate(other_axes, start=1):
            material = np.diff(
                _prefix_sums(material, place).take(
                    -(-np.cumsum([0, *cut[other]]) // self.edge), axis=place
                ),
                axis=place,
            )
        through = _prefix_sums(material.reshape(len(material), -1), 0)
        thick = ends[None] - ends[:, None]
        seen = (
            OPEN
            / n
            * (np.minimum(ends + self.layers, n)[None] - np.maximum(ends - self.layers, 0)[:, None])
        )
        # Work of the busiest box from a block up to another.
        work = np.where(thick >= min(max(self.layers, self.edge), n), 0.0, np.inf)
        for box, cells in enumerate(beside.ravel()):
            np.maximum(work, through[None, :, box] - through[:, None, box] + cells * seen, out=work)
        most, came = work[0], list[np.ndarray]()
        for _ in range(ranks - 1):
            cut_there = np.maximum(most[:, None], work)
            came.append(cut_there.argmin(axis=0))
            most = cut_there.min(axis=0)
        if not math.isfinite(most[-1]):
            return None
        at = [len(ends) - 1]
        for table in reversed(came):
            at.append(int(table[at[-1]]))
        cuts = [0, *(int(ends[place]) for place in reversed(at))]
        return float(most[-1]), [b - a for a, b in itertools.pairwise(cuts)]


def _prefix_sums(material: np.ndarray, axis: int) -> np.ndarray:
    """Return sums along an axis from its start up to each block's."""
    return np.insert(np.cumsum(material, axis=axis), 0, 0.0, axis=axis)


@dataclass(frozen=True)
class Balance:
    """Rules for repartitioning.

    Whether a step repartitions depends on the step's number, the particles' positions and the boxes
    alone, so that a run resumed from a checkpoint does the same.

    Args:
        every: steps between two checks.
        bound: least ratio of a step's time to its time after repartitioning. With it a fifth of
            `every` steps is gained until the next check. Repartitioning takes the time of 2 to 3
            steps, of 5 to 8 where it has to measure a mesh.
        fixed: other cost of a step, in cells full of material.
    """

    every: int = 20
    bound: float = 1.25
    fixed: float = STEP

    def should_rebalance(self, part: Subdomain, step: int) -> bool:
        """Return whether a step checks the balance."""
        return part.ranks.size > 1 and step % self.every == 0

    def rebalance(self, part: Subdomain, particles: Particles, a_cell: int) -> Decomposition | None:
        """Return boxes with a better balance, if they are worth the change; collective.

        Returns None if the present boxes are good enough.

        Args:
            part: the subdomain of this rank.
            particles: this rank's, whose totals have been computed.
            a_cell: particles of a full cell.
        """
        now, layers, fixed = part.decomposition, part.layers, self.fixed
        work = [
            n / a_cell + OPEN * seen
            for n, seen in zip(
                particles.exchange.counts,
                cells_with_ghosts(now.counts, now.parts, layers).ravel("F"),
                strict=True,
            )
        ]
        # The condition is the same on all ranks.
        if max(work) + fixed <= self.bound * (math.fsum(work) / len(work) + fixed):
            return None
        # Each rank searches its share of the box counts; the best result of all ranks counts.
        edge = edge_of_blocks(now.counts, part.ranks.size)
        load = WorkLoad(now.counts, layers, edge, blocks(part, particles, edge) / a_cell)
        everyone = part.ranks.collect(load.best(part.ranks.size, now.parts, rank=part.ranks.rank))
        # The present boxes stay if no boxes end between blocks.
        least, cut = min(
            (found for found in everyone if found is not None), default=(math.inf, now.parts)
        )
        gains = cut != now.parts and max(work) + fixed > self.bound * (least + fixed)
        return now.repartition(cut) if gains else None


def edge_of_blocks(counts: Triple, ranks: int) -> int:
    """Return the edge of the blocks of cells whose load is measured.

    Blocks are the cells that multigrid gathers, or finer where ranks are many.
    """
    edge = 1
    while math.prod(-(-n // edge) for n in counts) > max(GATHERED, BLOCKS * ranks):
        edge *= 2
    return edge


def blocks(part: Subdomain, particles: Particles, edge: int) -> np.ndarray:
    """Return the number of all ranks' particles in each block; collective."""
    counts = part.decomposition.counts
    shape = [-(-n // edge) for n in counts]
    place = np.clip(
        (particles.position.numpy() / (part.grid.spacing * edge)).astype(np.int64),
        0,
        np.array(shape) - 1,
    )
    if part.dimension == 2:
        place[:, 2] = 0
    mine = np.bincount(np.ravel_multi_index(tuple(place.T), shape), minlength=math.prod(shape))
    return np.asarray(part.ranks.total(mine)).reshape(shape)
