"""Domain decomposition: one box of cells a rank.

Cuts lie on the boundaries of coarse cells.
"""

from __future__ import annotations

import itertools
import math
import sys
import weakref
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike

from warp_lcp.distributed.collective import Collective
from warp_lcp.distributed.halo import Halo
from warp_lcp.distributed.launch import petsc
from warp_lcp.distributed.ranks import Ranks
from warp_lcp.grid.cell_box import CellBox, Triple
from warp_lcp.settings import renamed_method

if TYPE_CHECKING:
    from petsc4py import PETSc

# The largest part may exceed an even share by this factor, so that cuts lie at multiples of large
# powers of two.
UNEVEN = 1.125


class Decomposition:
    """Domain decomposition: one box of cells per rank, as in a DMDA of PETSc.

    Args:
        counts: cells (nx, ny, nz) of the whole grid; nz = 1 in 2-D.
        ranks: the ranks.
        processes: ranks along x, y, z; None: those with the fewest cells at cuts.
        cuts: cells of each box along x, y, z; None: even ones, with cuts at multiples of a power of
            two.
        periodic: periodic axes.

    Attributes:
        boxes: of all ranks.

    Raises:
        ValueError: there are more ranks than the grid can be cut for; the same on all ranks.

    Example:
        >>> import numpy as np, warp_lcp as wl
        >>> from warp_lcp.distributed import Decomposition, Ranks
        >>> def operator(n):
        ...     boxes = Decomposition((n, n, n), Ranks.world())
        ...     cells = np.full(boxes.box.counts[::-1], wl.FLUID)
        ...     return wl.GridPoisson(cells, decomposition=boxes)
    """

    def __init__(
        self,
        counts: Triple,
        ranks: Ranks,
        *,
        processes: Triple | None = None,
        cuts: Sequence[Sequence[int]] | None = None,
        periodic: Sequence[int] = (),
    ) -> None:
        self.counts, self.ranks, self.periodic = counts, ranks, tuple(periodic)
        self.processes = processes or _processes(counts, ranks.size)
        if math.prod(self.processes) != ranks.size:
            raise ValueError(
                f"processes = {self.processes}: the product must be the number of ranks, "
                f"{ranks.size}"
            )
        self.parts = (
            [list(c) for c in cuts]
            if cuts
            else [parts(n, p) for n, p in zip(counts, self.processes, strict=True)]
        )
        starts = [[0, *itertools.accumulate(part)] for part in self.parts]
        places = map(self.place, range(ranks.size))
        self.boxes = [
            CellBox.of(*([s[p + n] for s, p in zip(starts, place, strict=True)] for n in range(2)))
            for place in places
        ]

    def repartition(self, cuts: Sequence[Sequence[int]]) -> Decomposition:
        """Return a decomposition of the same cells and ranks with other box sizes.

        `cuts` holds the cells of each box along x, y, z.
        """
        px, py, pz = map(len, cuts)
        other = Decomposition(
            self.counts, self.ranks, processes=(px, py, pz), cuts=cuts, periodic=self.periodic
        )
        other.collective = self.collective  # MPI would run out of communicators if each had its own
        return other

    cut_anew = renamed_method("cut_anew", repartition)

    def place(self, rank: int) -> Triple:
        """Return the position of a rank among the ranks along x, y, z (DMDA order)."""
        px, py, _ = self.processes
        return rank % px, rank // px % py, rank // (px * py)

    @property
    def box(self) -> CellBox:
        """Box of this rank's cells."""
        return self.boxes[self.ranks.rank]

    @property
    def cut_axes(self) -> tuple[int, ...]:
        """Axes along which there is more than one rank."""
        return tuple(axis for axis, p in enumerate(self.processes) if p > 1)

    @property
    def joined(self) -> tuple[int, ...]:
        """Periodic axes with more than one rank: boxes at opposite sides are neighbors."""
        return tuple(axis for axis in self.cut_axes if axis in self.periodic)

    @property
    def shifts(self) -> list[Triple]:
        """Periodic shifts in cells along x, y, z; the first is zero.

        Neighboring cells appear once for each shift.
        """
        return self._shifts(self.joined)

    def _shifts(self, axes: Sequence[int]) -> list[Triple]:
        each = [(0, n, -n) if axis in axes else (0,) for axis, n in enumerate(self.counts)]
        return [(x, y, z) for x in each[0] for y in each[1] for z in each[2]]

    def boxes_overlap(self, box: CellBox, other: CellBox) -> bool:
        """Return whether two boxes share cells, periodic images included."""
        return any(box.moved(shift).common(other).cells for shift in self._shifts(self.periodic))

    def neighbor(self, axis: int, side: int) -> int | None:
        """Return the neighbor rank at the lower (0) or upper (1) side along an axis.

        Returns None at a side of the domain.
        """
        place = list(self.place(self.ranks.rank))
        place[axis] += 2 * side - 1
        if axis in self.joined:
            place[axis] %= self.processes[axis]
        if not 0 <= place[axis] < self.processes[axis]:
            return None
        px, py, _ = self.processes
        return place[0] + px * (place[1] + py * place[2])

    def coarser(self, factors: Triple) -> Decomposition | None:
        """Return the decomposition of aggregates of cells along x, y, z.

        A box of m cells along an axis has ceil(m / factor) aggregates. Returns None if a box
        boundary would cut an aggregate, or a rank would have no cells.
        """
        new = []
        for part, factor in zip(self.parts, factors, strict=True):
            if len(part) > 1 and (
                any(m % factor for m in part[:-1])
                or -(-part[-1] // factor) < 1
                or min(part) < factor
            ):
                return None
            new.append([-(-m // factor) for m in part])
        nx, ny, nz = (-(-n // f) for n, f in zip(self.counts, factors, strict=True))
        return Decomposition(
            (nx, ny, nz), self.ranks, processes=self.processes, cuts=new, periodic=self.periodic
        )

    @property
    def ghosts(self) -> Halo | None:
        """Halo exchange of operators; None if there is one rank."""
        return self.halo if self.ranks.size > 1 else None

    @property
    def comm(self) -> Ranks | None:
        """The ranks as the communicator of reductions; None if there is one rank."""
        return self.ranks if self.ranks.size > 1 else None

    def together(self) -> AbstractContextManager[None]:
        """Return a block in which an exception of one rank is raised on all."""
        return self.collective.together()

    def check_operator(
        self, shape: tuple[int, ...], periodic: Sequence[bool], coefficients: Mapping[str, object]
    ) -> None:
        """Check that a grid operator fits the boxes; collective.

        Args:
            shape: of its cells.
            periodic: its periodic axes.
            coefficients: numbers, arrays or None, by name.

        Raises:
            ValueError: the shape is not that of the box, an axis is periodic, a box is one cell
                thin at a cut, or the kinds of coefficients differ; on all ranks.
        """
        with self.together():
            expected = tuple(reversed(self.box.counts))
            if any(periodic):
                raise ValueError(
                    "periodic: periodic axes are not supported on several ranks; use one rank"
                )
            if shape != expected and not (shape == expected[1:] and self.counts[2] == 1):
                raise ValueError(
                    f"cells has shape {shape}: expected {expected}, the cells of rank "
                    f"{self.ranks.rank}"
                )
            for axis in self.cut_axes:
                if min(self.parts[axis]) < 2:
                    raise ValueError(
                        f"a rank has one cell along {'xyz'[axis]}: boxes of shared operators have "
                        "at least two"
                    )
        kinds = [
            (name, (value is not None and np.ndim(cast(ArrayLike, value)) > 0) or value)
            for name, value in sorted(coefficients.items())
        ]
        self.ranks.agree("the kind of coefficients", kinds)

    @cached_property
    def halo(self) -> Halo:
        """Halo exchange of one ghost layer, shared by all operators on these boxes."""
        return Halo(self, 1)

    @cached_property
    def collective(self) -> Collective:
        """Collective blocks: an exception on one rank is raised on all."""
        return Collective(self.ranks, planned=(ValueError, OSError), last_words=sys.stderr.write)

    @cached_property
    def dmda(self) -> PETSc.DMDA:
        """DMDA of PETSc with these boxes: one value per cell, 7-point stencils."""
        PETSc = petsc()
        distributed_array = PETSc.DMDA().create(
            dim=3,
            dof=1,
            sizes=self.counts,
            proc_sizes=self.processes,
            ownership_ranges=self.parts,
            stencil_width=1,
            stencil_type=PETSc.DMDA.StencilType.STAR,
            comm=self.ranks.comm,
        )
        weakref.finalize(self, distributed_array.destroy)  # as of `halo.StarForest`
        return distributed_array


def parts(n: int, p: int) -> list[int]:
    """Return the number of cells of each of p ranks, for n cells.

    The numbers are about equal, with cuts at multiples of a power of two.

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
    """Return the ranks along x, y, z with the fewest cells at cuts.

    These are (px - 1) ny nz + (py - 1) nx nz + (pz - 1) nx ny cells, one for each cut face. Among
    equals, the numbers that cut z are chosen: planes of constant z are contiguous.
    """
    nx, ny, nz = counts
    candidates = [
        ((px - 1) * ny * nz + (py - 1) * nx * nz + (pz - 1) * nx * ny, px, py, (px, py, pz))
        for px, py, pz in cuttings(counts, size)
    ]
    if not candidates:
        most = next(fewer for fewer in range(size - 1, 0, -1) if cuttings(counts, fewer))
        raise ValueError(
            f"{size} ranks cannot share {' x '.join(map(str, counts))} cells, each with a box: "
            f"start {most} or fewer"
        )
    return min(candidates)[3]


def cuttings(counts: Triple, size: int) -> list[Triple]:
    """Return all numbers of ranks along x, y, z whose product is `size`.

    Each rank has at least one cell.
    """
    divisors = [p for p in range(1, size + 1) if size % p == 0]
    triples = [
        (px, py, size // (px * py)) for px in divisors for py in divisors if size // px % py == 0
    ]
    return [p for p in triples if all(a <= n for a, n in zip(p, counts, strict=True))]


# Work of a cell without material, ghost cells too, relative to a cell full of material.
OPEN = 0.1

Corners = tuple[np.ndarray, np.ndarray]  # low and high x, y, z of a box of material, in cells


def balanced_processes(
    counts: Triple, size: int, *, layers: int, states: Sequence[Sequence[Corners]]
) -> Triple | None:
    """Return the ranks along x, y, z with the least work of the busiest rank.

    Returns None if there are too many ranks for the grid.

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
    for p in cuttings(counts, size):
        cuts = [parts(n, a) for n, a in zip(counts, p, strict=True)]
        if all(len(cut) == 1 or min(cut) >= layers for cut in cuts):
            found.append((sum(_largest_work(counts, cuts, layers, state) for state in states), p))
    return min(found)[1] if found else None


def pool(counts: Triple, dimension: int, volume: float, gravity: np.ndarray) -> Corners:
    """Return the box that material fills at rest.

    Args:
        counts: cells (nx, ny, nz).
        dimension: 2 or 3.
        volume: of the material, in cells.
        gravity: [m/s^2]; the box lies at the side along its largest component; 0: it is the whole
            grid.
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


def _largest_work(
    counts: Triple, cuts: list[list[int]], layers: int, state: Sequence[Corners]
) -> float:
    """Return the work of the busiest rank, in cells full of material."""
    low, high = _ends(cuts)
    work = OPEN * cells_with_ghosts(counts, cuts, layers)
    for corners in state:
        work += _of_boxes(
            [
                np.clip(np.minimum(b, h) - np.maximum(a, l), 0.0, None)
                for a, b, l, h in zip(*corners, low, high, strict=True)
            ]
        )
    return float(work.max())


def cells_with_ghosts(counts: Triple, cuts: Sequence[Sequence[int]], layers: int) -> np.ndarray:
    """Return the number of cells of each box with its ghost layers.

    Shape (boxes along x, y, z).
    """
    return _of_boxes(
        [
            np.minimum(h + layers, n) - np.maximum(l - layers, 0)
            for l, h, n in zip(*_ends(cuts), counts, strict=True)
        ]
    )


def _ends(cuts: Sequence[Sequence[int]]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the first and end indices of boxes along x, y, z."""
    ends = [np.cumsum([0, *cut]) for cut in cuts]
    return [end[:-1] for end in ends], [end[1:] for end in ends]


def _of_boxes(sides: Sequence[np.ndarray]) -> np.ndarray:
    """Return the volumes of all boxes from the lengths of their sides."""
    x, y, z = sides
    return np.multiply.outer(np.multiply.outer(x, y), z)
