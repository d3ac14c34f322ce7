"""How a grid's cells are shared by the ranks: boxes, one a rank, whose cuts lie where coarse cells end."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from warp_lcp.distributed.collective import Collective
from warp_lcp.distributed.ranks import Ranks, petsc

UNEVEN = 1.125  # the largest part may exceed an even share by this factor, so that cuts lie at multiples of large powers of two

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class CellBox:
    """Cells from `low` up to `high`, exclusive, along x, y, z."""

    low: Triple
    high: Triple

    @property
    def counts(self) -> Triple:
        """Cells along x, y, z; 0 where the box is empty."""
        nx, ny, nz = (max(h - l, 0) for l, h in zip(self.low, self.high, strict=True))
        return nx, ny, nz

    @property
    def cells(self) -> int:
        """How many cells it has."""
        return math.prod(self.counts)

    @property
    def slices(self) -> tuple[slice, slice, slice]:
        """Where it lies in an array (nz, ny, nx) of all cells."""
        x, y, z = (slice(l, h) for l, h in zip(self.low, self.high, strict=True))
        return z, y, x

    def grown(self, width: int) -> CellBox:
        """Return the box with so many cells more on all sides."""
        return self._mapped(lambda l: l - width, lambda h: h + width)

    def common(self, other: CellBox) -> CellBox:
        """Return the cells that are in both."""
        low = tuple(max(a, b) for a, b in zip(self.low, other.low, strict=True))
        high = tuple(min(a, b) for a, b in zip(self.high, other.high, strict=True))
        return CellBox(low, high)  # type: ignore[arg-type]

    def moved(self, by: Sequence[int], sign: int = 1) -> CellBox:
        """Return the box moved by so many cells along x, y, z, or back."""
        low, high = (tuple(a + sign * b for a, b in zip(corner, by, strict=True)) for corner in (self.low, self.high))
        return CellBox(low, high)  # type: ignore[arg-type]

    def _mapped(self, low: Any, high: Any) -> CellBox:
        return CellBox(tuple(map(low, self.low)), tuple(map(high, self.high)))


class Decomposition:
    """Boxes of a grid's cells, one a rank, as a DMDA of PETSc has them.

    Args:
        counts: cells (nx, ny, nz) of the whole grid; nz = 1 in 2-D.
        ranks: who share them.
        processes: ranks along x, y, z; None: those with the least cells at cuts.
        cuts: cells of each box along x, y, z; None: even ones, with cuts at multiples of a power of two.

    Attributes:
        boxes: of all ranks.

    Raises:
        ValueError: there are more ranks than the grid can be cut for; the same on all ranks.
    """

    def __init__(
        self, counts: Triple, ranks: Ranks, *, processes: Triple | None = None, cuts: Sequence[Sequence[int]] | None = None
    ) -> None:
        self.counts, self.ranks = counts, ranks
        self.processes = processes or _processes(counts, ranks.size)
        if math.prod(self.processes) != ranks.size:
            raise ValueError(f"processes = {self.processes}: their product must be the number of ranks, {ranks.size}")
        self.parts = [list(c) for c in cuts] if cuts else [parts(n, p) for n, p in zip(counts, self.processes, strict=True)]
        starts = [[0, *itertools.accumulate(part)] for part in self.parts]
        self.boxes = [self._box(starts, place) for place in map(self.place, range(ranks.size))]

    def place(self, rank: int) -> Triple:
        """Return where a rank is among the ranks along x, y, z, as DMDA numbers them."""
        px, py, _ = self.processes
        return rank % px, rank // px % py, rank // (px * py)

    @property
    def box(self) -> CellBox:
        """The box of this rank's cells."""
        return self.boxes[self.ranks.rank]

    @property
    def cut_axes(self) -> tuple[int, ...]:
        """Axes along which there is more than one rank."""
        return tuple(axis for axis, p in enumerate(self.processes) if p > 1)

    def neighbor(self, axis: int, side: int) -> int | None:
        """Return the rank beyond this one's lower (0) or upper (1) side along an axis; None where the domain ends."""
        place = list(self.place(self.ranks.rank))
        place[axis] += 2 * side - 1
        if not 0 <= place[axis] < self.processes[axis]:
            return None
        px, py, _ = self.processes
        return place[0] + px * (place[1] + py * place[2])

    def coarser(self, factors: Triple) -> Decomposition | None:
        """Return the boxes of aggregates of so many cells along x, y, z; None if an aggregate would be cut, or a rank left without."""
        new = []
        for part, factor in zip(self.parts, factors, strict=True):
            if len(part) > 1 and (any(m % factor for m in part[:-1]) or -(-part[-1] // factor) < 1 or min(part) < factor):
                return None
            new.append([-(-m // factor) for m in part])
        nx, ny, nz = (-(-n // f) for n, f in zip(self.counts, factors, strict=True))
        return Decomposition((nx, ny, nz), self.ranks, processes=self.processes, cuts=new)

    @cached_property
    def halo(self) -> Any:
        """What fills one layer of ghost cells, made once for all operators on these boxes."""
        from warp_lcp.distributed.halo import Halo

        return Halo(self, 1)

    @cached_property
    def collective(self) -> Collective:
        """Blocks of code that the ranks leave alike: what fails on one fails on all."""
        return Collective(self.ranks, planned=(ValueError, OSError), last_words=sys.stderr.write)

    @cached_property
    def dmda(self) -> Any:
        """The same as a DMDA of PETSc: one number a cell, 7-point stencils."""
        PETSc = petsc()
        return PETSc.DMDA().create(
            dim=3, dof=1, sizes=self.counts, proc_sizes=self.processes, ownership_ranges=self.parts, stencil_width=1,
            stencil_type=PETSc.DMDA.StencilType.STAR, comm=self.ranks.comm,
        )  # fmt: skip

    @staticmethod
    def _box(starts: list[list[int]], place: Triple) -> CellBox:
        low = tuple(s[p] for s, p in zip(starts, place, strict=True))
        high = tuple(s[p + 1] for s, p in zip(starts, place, strict=True))
        return CellBox(low, high)  # type: ignore[arg-type]


def parts(n: int, p: int) -> list[int]:
    """Return how many of n cells each of p ranks has: about as many, with cuts at multiples of a power of two.

    >>> parts(129, 2), parts(100, 3)
    ([64, 65], [32, 32, 36])
    """
    even, step = n / p, 1 << max(n.bit_length() - 1, 0)
    while step > 1:
        cuts = [0, *(step * round(i * even / step) for i in range(1, p)), n]
        sizes = [b - a for a, b in itertools.pairwise(cuts)]
        if min(sizes) > 0 and max(sizes) <= UNEVEN * math.ceil(even):
            return sizes
        step //= 2
    return [n * (i + 1) // p - n * i // p for i in range(p)]


def _processes(counts: Triple, size: int) -> Triple:
    """Return the ranks along x, y, z with the least cells at cuts; of equal ones those that cut z, whose planes lie in one piece."""
    nx, ny, nz = counts
    found = [((px - 1) * ny * nz + (py - 1) * nx * nz + (pz - 1) * nx * ny, px, py, (px, py, pz)) for px, py, pz in _cuttings(counts, size)]
    if not found:
        most = next(fewer for fewer in range(size - 1, 0, -1) if _cuttings(counts, fewer))
        raise ValueError(f"{size} ranks cannot share {' x '.join(map(str, counts))} cells, each with a box: start {most} or fewer")
    return min(found)[3]


def _cuttings(counts: Triple, size: int) -> list[Triple]:
    """Return the numbers of ranks along x, y, z, whose product is `size`, that leave each rank a cell."""
    pairs = [(px, py) for px in range(1, size + 1) if size % px == 0 for py in range(1, size // px + 1) if size // px % py == 0]
    triples = [(px, py, size // (px * py)) for px, py in pairs]
    return [p for p in triples if all(a <= n for a, n in zip(p, counts, strict=True))]


OPEN = 0.1  # of the work that a cell full of material makes: what a cell without makes, ghost cells too

Corners = tuple[np.ndarray, np.ndarray]  # low and high x, y, z of a box of material, in cells


def balanced_processes(counts: Triple, size: int, *, layers: int, states: Sequence[Sequence[Corners]]) -> Triple | None:
    """Return the ranks along x, y, z for which the busiest has least to do; None if there are too many for the grid.

    Args:
        counts: cells (nx, ny, nz).
        size: ranks.
        layers: of ghost cells, which no box may be thinner than.
        states: where the material is at different times, each as boxes of it.

    >>> dam, pool = (np.zeros(3), np.array([16, 20, 32])), (np.zeros(3), np.array([64, 5, 32]))
    >>> balanced_processes((64, 32, 32), 2, layers=5, states=[[dam], [pool]])
    (1, 1, 2)
    """
    found = []
    for px in (d for d in range(1, size + 1) if size % d == 0):
        for py in (d for d in range(1, size // px + 1) if size // px % d == 0):
            p = px, py, size // (px * py)
            if any(a > 1 and a * layers > n for a, n in zip(p, counts, strict=True)):
                continue
            cuts = [parts(n, a) for n, a in zip(counts, p, strict=True)]
            if all(len(cut) == 1 or min(cut) >= layers for cut in cuts):
                found.append((sum(_most_work(counts, cuts, layers, state) for state in states), px, py, p))
    return min(found)[3] if found else None


def pool(counts: Triple, dimension: int, volume: float, gravity: np.ndarray) -> Corners:
    """Return the box that some cells of material fill when they have come to rest.

    Args:
        counts: cells (nx, ny, nz).
        dimension: 2 or 3.
        volume: of the material, in cells.
        gravity: [m/s^2]; the box lies at the side that it points to most; 0: it is the whole grid.
    """
    low, high = np.zeros(3), np.array(counts, dtype=float)
    axis = int(np.argmax(np.abs(gravity[:dimension])))
    if gravity[axis] == 0.0:
        return low, high
    depth = min(volume / math.prod(counts), 1.0) * counts[axis]
    if gravity[axis] < 0.0:
        high[axis] = depth
    else:
        low[axis] = counts[axis] - depth
    return low, high


def _most_work(counts: Triple, cuts: list[list[int]], layers: int, state: Sequence[Corners]) -> float:
    """Return what the busiest rank has to do, in cells full of material."""
    ends = [np.concatenate([[0], np.cumsum(cut)]) for cut in cuts]
    whole, most = CellBox((0, 0, 0), counts), 0.0
    for place in np.ndindex(*(len(cut) for cut in cuts)):
        low, high = (np.array([end[n + side] for end, n in zip(ends, place, strict=True)]) for side in range(2))
        box = CellBox((int(low[0]), int(low[1]), int(low[2])), (int(high[0]), int(high[1]), int(high[2])))
        full = sum(float(np.prod(np.clip(np.minimum(b, high) - np.maximum(a, low), 0.0, None))) for a, b in state)
        most = max(most, full + OPEN * box.grown(layers).common(whole).cells)
    return most
