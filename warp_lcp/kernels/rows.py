"""Rows that a kernel visits, and how threads share them.

They are the rows of a padded grid, a box, a list, or two levels of a transfer.
"""

import functools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import CPU_CHUNK, Layout, Padding
from warp_lcp.kernels.layout import (
    ANYWHERE,
    BLANK,
    QUAD,
    Alignment,
    RowLayout,
    check_memory,
    copy_of,
    grain,
    put,
    threads,
)
from warp_lcp.kernels.types import DeviceArray

if TYPE_CHECKING:
    from warp_lcp.kernels.recorded_arguments import RowsMemory

# Whether threads take quads on CUDA; else single cells, to compare both on a GPU.
BY_QUADS = os.environ.get("WARP_LCP_QUADS") != "0"
CUDA_THREADS = 1 << 16  # threads of a flat reduction, several times those of a large GPU
# Planes that a thread sums over. On CUDA, partial sums of every cell would take more memory than
# the rest of a method.
PLANES_A_THREAD = {"cpu": 1, "cuda": 16}
# Planes that a thread of a kernel without sums takes on CUDA, where there are more than enough
# cells for all threads: .8 of the time on an H200.
UNSUMMED_PLANES, MANY_CELLS = 4, 1 << 21
# With fewer cells, threads that take quads sum over as few planes; otherwise they are too few to
# hide latencies. The number is computed, not measured.
SUMMED_CELLS = 1 << 24
# Cells of a grid from which quads are loaded in blocks of 16 bytes. Smaller grids are limited by
# latencies, and kernels for their alignments would have to be compiled.
MANY_CELLS_OF_BLOCKS = 1 << 18


@dataclass(frozen=True)
class Rows:
    """The rows that a kernel visits.

    Attributes:
        summed: their layout for a kernel that sums.
        single: their layout for one that does not: a plane a thread.
        size: elements of a field.
        other_size: elements of a field of the other level of a transfer; 0: there is none.
        device: where the fields are.
        place: first stored cell of a box.
        ends: one past the last stored cell (k, j, i) of a box.
        weight: cost of a cell, in cells of a usual kernel.
        memory: a `warp_lcp.kernels.recorded_arguments.RowsMemory` that recorded launches read in
            each run;
            None: the rows never change.
        quads: their layout for a kernel on CUDA that does not sum and whose threads take quads of
            cells; threads that sum take as many there. None: threads take cells.
        alignments: where rows of fields begin, and those of the other level.
    """

    summed: RowLayout
    single: RowLayout
    size: int
    other_size: int
    device: wp.Device
    place: Mapping[str, int] = field(default_factory=dict)
    ends: tuple[int, ...] = ()
    weight: int = 1
    memory: "RowsMemory | None" = None
    quads: "RowLayout | None" = None
    alignments: tuple[Alignment, Alignment] = (ANYWHERE, ANYWHERE)

    @staticmethod
    def of(
        padding: Padding,
        device: wp.Device,
        spans: DeviceArray | None = None,
        *,
        whole: bool = False,
        more: int = 0,
    ) -> "Rows":
        """Return the rows of a padded grid and `more` beyond, or those of its spans.

        `whole`: a thread takes a whole row.
        """
        steps, counts = (
            (padding.plane + padding.row + 1, padding.plane, padding.row),
            tuple(n + more for n in padding.counts),
        )
        return Rows.strided(
            padding.size,
            device,
            steps,
            counts,
            spans,
            cells=counts[2] if whole else None,
            quads=not whole,
        )

    @staticmethod
    def part(
        padding: Padding, device: wp.Device, low: Sequence[int], high: Sequence[int]
    ) -> "Rows":
        """Return the cells low <= (k, j, i) < high of a padded grid.

        Ghost cells have the indices -1 and n. A thread takes whole rows.
        """
        strides, counts = (
            (padding.plane, padding.row, 1),
            tuple(end - begin for begin, end in zip(low, high, strict=True)),
        )
        first = sum((begin + 1) * stride for begin, stride in zip(low, strides, strict=True))
        return Rows.strided(
            padding.size, device, (first, padding.plane, padding.row), counts, cells=counts[2]
        )

    @staticmethod
    def beyond(padding: Padding, device: wp.Device, axis: int, end: int) -> "Rows":
        """Return the ghost cells beyond a side of the grid.

        The axis is 0, 1, 2 for x, y, z; the end is 0 for the lower and 1 for the upper side.
        """
        low, high = [0, 0, 0], list(padding.counts)
        low[2 - axis], high[2 - axis] = (
            (padding.counts[2 - axis], padding.counts[2 - axis] + 1) if end else (-1, 0)
        )
        return Rows.part(padding, device, low, high)

    @staticmethod
    def stored(padding: Padding, device: wp.Device) -> "Rows":
        """Return all stored cells of a padded grid, with ghost cells."""
        counts = tuple(n + 2 for n in padding.counts)
        made = Rows.strided(
            padding.size, device, (0, padding.plane, padding.row), counts, quads=True
        )
        return made._changed(lift=1)

    def after_ghosts(self) -> "Rows":
        """Return the same rows for three-plane fields that begin with a ghost plane.

        Raises:
            ValueError: there are fewer than two planes: with ghost cells, a field has no room for
                three planes and those below them.
        """
        if self.single.planes < 2:
            raise ValueError(
                f"planes: {self.single.planes}: expected at least 2 after one of ghosts"
            )
        return self._changed(turn=1)

    def _changed(self, **members: int) -> "Rows":
        single = put(copy_of(self.single), members)
        summed = single if self.summed is self.single else put(copy_of(self.summed), members)
        quads = None if self.quads is None else put(copy_of(self.quads), members)
        return replace(self, single=single, summed=summed, quads=quads)

    @staticmethod
    def edge(padding: Padding, device: wp.Device, axis: int) -> "Rows":
        """Return the first stored cells along an axis, with the edges.

        The axis is 0, 1, 2 for x, y, z.
        """
        counts = [1 if 2 - axis == a else n + 2 for a, n in enumerate(padding.counts)]
        return Rows.strided(padding.size, device, (0, padding.plane, padding.row), tuple(counts))

    @staticmethod
    def flat(size: int, device: wp.Device, *, serial: bool = False) -> "Rows":
        """Return a flat field as one row; on CUDA, as rows for the threads that sum.

        `serial`: one row for one thread.
        """
        return _flat(size, device.alias, serial)

    @staticmethod
    def of_fields(layout: Layout) -> "Rows":
        """Return a layout's stored fields as one row, without unused chunks.

        Chunks that were never in use are skipped. Sums have the same order.
        """
        if layout.rows is None:
            layout.rows = Rows.flat(layout.size, layout.device)
            if layout.chunks is not None:
                counts = (len(layout.chunks), 1, CPU_CHUNK)
                layout.rows = Rows.strided(
                    layout.size,
                    layout.device,
                    (0, CPU_CHUNK, 0),
                    counts,
                    layout.chunks,
                    cells=CPU_CHUNK,
                    slab=1,
                )
        return layout.rows

    @staticmethod
    def box(
        low: tuple[int, int, int],
        high: tuple[int, int, int],
        device: wp.Device,
        *,
        cells: int | None = None,
        slab: int | None = None,
    ) -> "Rows":
        """Return the rows of stored cells low <= (k, j, i) < high of a grid.

        A thread takes some `cells`, of `slab` planes if it sums.

        Raises:
            ValueError: low is not between 0 and high.
        """
        if not all(0 <= begin <= end for begin, end in zip(low, high, strict=True)):
            raise ValueError(f"box: from {low} to {high}: expected 0 <= low <= high")
        counts = tuple(end - begin for begin, end in zip(low, high, strict=True))
        made = Rows.strided(0, device, (0, 0, 0), counts, cells=cells, slab=slab)
        return replace(made, place=dict(zip(("k0", "j0", "i0"), low, strict=True)), ends=high)

    @staticmethod
    def in_part(pieces: DeviceArray, cells: int, ends: tuple[int, int, int]) -> "Rows":
        """Return row segments of a grid; a thread takes one.

        Args:
            pieces: (k, j) and (first, one past the last i) of each, vec2i, shape (n, 2).
            cells: number of cells of all segments.
            ends: bounds of the segments (k, j, i), exclusive.
        """
        check_memory("pieces", pieces, wp.vec2i, (len(pieces), 2))
        made = Rows.box((0, 0, 0), (1, 1, len(pieces)), pieces.device, cells=1)
        single = put(copy_of(made.single), {"pieces": pieces})
        return replace(
            made,
            single=single,
            summed=single,
            ends=ends,
            weight=max(cells // max(len(pieces), 1), 1),
        )

    @staticmethod
    def entries(
        count: int, device: wp.Device, cells: int | None = None, *, weight: int = 1
    ) -> "Rows":
        """Return a list's entries as the row of a box.

        A thread takes some `cells` of them. An entry costs as much as `weight` cells of a grid.
        """
        return replace(Rows.box((0, 0, 0), (1, 1, count), device, cells=cells), weight=weight)

    @staticmethod
    def listed(
        count: int, device: wp.Device, cells: int | None = None, *, weight: int = 1
    ) -> "Rows":
        """Return the same for a kernel without a box, over whole arrays."""
        return replace(
            Rows.strided(0, device, (0, 0, 0), (1, 1, count), cells=cells), weight=weight
        )

    @staticmethod
    def by_turns(size: int, device: wp.Device, width: int, *, quads: bool = False) -> "Rows":
        """Return a flat field as rows of a width.

        A thread of a kernel that sums takes the same position of each row, its neighbor the next.
        """
        planes = -(-size // width)
        ends = np.full((planes, 1, 2), (0, width))
        ends[-1:, 0, 1] -= planes * width - size
        spans = wp.array(ends, dtype=wp.vec2i, device=device)
        return Rows.strided(
            size,
            device,
            (0, width, 0),
            (planes, 1, width),
            spans,
            cells=1,
            slab=planes,
            quads=quads,
        )

    @staticmethod
    def strided(
        size: int,
        device: wp.Device,
        first: Sequence[int],
        counts: Sequence[int],
        spans: DeviceArray | None = None,
        cells: int | None = None,
        slab: int | None = None,
        *,
        quads: bool = False,
    ) -> "Rows":
        """Return rows by strides and counts.

        The arguments are the first cell's element, the steps from plane to plane and row to row,
        and counts of planes, rows, cells. Threads on CUDA take some `cells` each, or four where
        `quads` is set and the kernel allows it.

        Raises:
            TypeError: spans are of another type.
            ValueError: a count is negative or too large, or spans have another shape.
        """
        alone = (
            UNSUMMED_PLANES
            if not slab and device.is_cuda and math.prod(counts) >= MANY_CELLS
            else 1
        )
        few = not slab and math.prod(counts) < SUMMED_CELLS
        slab, cells = (
            slab or PLANES_A_THREAD["cuda" if device.is_cuda else "cpu"],
            cells or grain(counts[2], device) or 1,
        )
        if not 0 <= min(counts) <= max(counts) < 1 << 31:
            raise ValueError(f"rows: counts {tuple(counts)}: expected below 2^31")
        if spans is not None:
            check_memory("spans", spans, wp.vec2i, tuple(counts[:2]))
        names = ("base", "s1", "s2", "planes", "rows", "nx")
        shared = dict(zip(names, (*first, *counts), strict=True)) | {
            "grain": cells,
            "chunks": -(-counts[2] // cells),
            "spans": spans,
        }
        single = put(copy_of(BLANK), shared | {"slab": alone})
        if not (quads and BY_QUADS and device.is_cuda and size < 1 << 31):
            return Rows(
                single if slab == alone else put(copy_of(single), {"slab": slab}),
                single,
                size,
                0,
                device,
            )
        by_quads = put(copy_of(single), {"grain": QUAD, "chunks": -(-counts[2] // QUAD)})
        slab = UNSUMMED_PLANES if few else slab
        alignments = _alignment(by_quads), ANYWHERE
        summed = put(copy_of(by_quads), {"slab": slab})
        return Rows(summed, single, size, 0, device, quads=by_quads, alignments=alignments)

    def beside(self, other: "Rows", factors: tuple[int, int, int]) -> "Rows":
        """Return the same rows with another level's beside them.

        Args:
            other: the rows of that level.
            factors: its cells along x, y, z for each cell of these rows; negative: cells of these
                rows for each cell of that level.
        """
        made = self._pairs.get((id(other), factors))
        if made is None:
            made = self._pairs[id(other), factors] = other, self._beside(other, factors)
        return made[1]

    @functools.cached_property
    def _pairs(self) -> dict[tuple[int, tuple[int, int, int]], tuple["Rows", "Rows"]]:
        """Cache of rows paired with those of another level.

        The key is the other level and the factors between both.
        """
        return {}

    def _beside(self, other: "Rows", factors: tuple[int, int, int]) -> "Rows":
        L, other_layout = self.single, other.single
        members = {
            "o0": other_layout.base,
            "o1": other_layout.s1,
            "o2": other_layout.s2,
            "n1": other_layout.planes,
            "n2": other_layout.rows,
        }
        members |= dict(zip(("fx", "fy", "fz"), factors, strict=True))
        quads = (
            None
            if self.quads is None or not {*factors} <= {-2, -1, 1, 2}
            else put(copy_of(self.quads), members)
        )
        summed = None if self.summed is L else put(copy_of(self.summed), members)
        # A thread takes the cells of one of the other level's threads.
        if not self.device.is_cpu and factors[0] < 0:
            members |= {"grain": -factors[0], "chunks": -(L.nx // factors[0])}
        single = put(copy_of(L), members)
        alignments = self.alignments[0], ANYWHERE if factors[0] < 0 else other.alignments[0]
        made = Rows(summed or single, single, self.size, other.size, self.device, quads=quads)
        return replace(made, alignments=alignments)

    @functools.cached_property
    def count(self) -> int:
        """Number of rows."""
        return int(self.single.planes * self.single.rows)

    @functools.cached_property
    def places(self) -> int:
        """Number of partial sums of each kind, one a thread."""
        planes, rows, chunks = threads(self.summed)
        return planes * rows * chunks


def _alignment(layout: RowLayout) -> Alignment:
    """Return the alignment of rows, for reading fields in blocks."""
    first, plane, row = layout.base % 4, layout.s1 % 4, layout.s2 % 4
    if layout.planes * layout.rows * layout.nx < MANY_CELLS_OF_BLOCKS:
        return ANYWHERE
    if plane == row == 0:
        return Alignment(first)
    return Alignment(1, either=True) if first % 2 and (plane, row) == (0, 2) else ANYWHERE


@functools.lru_cache(maxsize=1024)
def _flat(size: int, name: str, serial: bool) -> Rows:
    device = wp.get_device(name)
    if serial or not device.is_cuda or not size:
        return Rows.strided(
            size, device, (0, 0, 0), (1, 1, size), cells=max(size, 1) if serial else CPU_CHUNK
        )
    return Rows.by_turns(size, device, min(size, QUAD * CUDA_THREADS), quads=True)
