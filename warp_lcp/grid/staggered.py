"""Staggered grid: layout of cells, faces and fields; windows for launches.

A grid of nx x ny x nz cells is stored with one ring of ghost cells, shape (nz + 2, ny + 2, nx + 2),
x fastest; a 2-D grid is nz = 1 and only its plane k = 1 is used. Face fields have the shape of the
cells: element (k, j, i) of component 0 (x), 1 (y) or 2 (z) lies on the lower x, y or z face of cell
(k, j, i). Grid coordinates are X = x / dx + 1 with x [m] the distance from the low corner of the
domain, so that a point lies in cell floor(X). In 2-D, z is ignored. A grid may be a part of a
larger one: points and grid coordinates are then those of the larger grid, so that a point has the
same in all parts, and lies in stored cell floor(X) - origin.
"""

import ctypes
import struct
import typing
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import warp as wp

from warp_lcp.grid.grid_part import GridPart
from warp_lcp.grid.particle_loops import GridPlacement
from warp_lcp.kernels import KernelFile, Rows, StencilKernel
from warp_lcp.kernels.fields import checked_device, zeros
from warp_lcp.kernels.launch_graph import KeyedArgument, Launch, LaunchGraph, clear, launch_ranges
from warp_lcp.kernels.layout import grain
from warp_lcp.kernels.recorded_arguments import (
    DeviceRows,
    RowsMemory,
    Scalar,
    Slot,
    larger,
    rows_memory,
)
from warp_lcp.settings import renamed_names

if typing.TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from warp._src.codegen import StructInstance

    from warp_lcp.grid.barriers import Barriers

KERNELS = KernelFile(Path(__file__).parent / "headers/staggered.h")
CLEAR: dict[type, StencilKernel] = {
    dtype: KERNELS.kernel(
        "warp_lcp.grid.clear.clear", module=f"warp_lcp.grid.clear_{dtype.__name__}", compute=dtype
    )
    for dtype in (wp.int8, wp.float32, wp.float64)
}
COPY = KERNELS["warp_lcp.grid.copy_box.copy"]
FieldT = typing.TypeVar("FieldT")
SEGMENT = 8  # cells of a row that are visited together in an active window
# Planes that a thread takes together on CUDA, and the least cells of a window where it does: fewer
# threads would not fill a GPU.
GROUPED_PLANES, MANY_CELLS = 4, 1 << 18


@wp.struct
class CellRange:
    """A box of cells as kernels see it; a thread takes `grain` cells of a row."""

    # Tasks of a worker thread: the first, and one past the last; 0 if each thread has one task.
    begin: int
    finish: int
    rows: int
    chunks: int  # chunks of a row
    k: int
    j: int
    i: int
    end: int  # one past the last i
    grain: int  # 0: a piece
    # (k, j) and (first, one past the last i) of each piece of an active window.
    pieces: wp.array2d(dtype=wp.vec2i)


@wp.func
@typing.no_type_check
def inside(coordinate: float, count: int):
    """Return a grid coordinate clamped to the domain [1, count + 1]; a NaN becomes 1."""
    x = coordinate
    if not (x > 1.0):
        x = 1.0
    if x > float(count) + 1.0:
        x = float(count) + 1.0
    return x


@wp.func
@typing.no_type_check
def cell_index(coordinate: float, count: int):
    """Return the interior cell 1..count that a grid coordinate lies in."""
    return wp.min(int(inside(coordinate, count)), count)


ORDERED_KERNELS: set[wp.Kernel] = set()
"""Kernels for which one CPU thread visits the cells in order, see `cell_kernel`."""


def _corners(
    choose: typing.Callable[[int, int], int], one: tuple[int, int, int], other: tuple[int, int, int]
) -> tuple[int, int, int]:
    """Return the smaller or larger coordinates of corners; `choose`: min or max."""
    return choose(one[0], other[0]), choose(one[1], other[1]), choose(one[2], other[2])


@dataclass(frozen=True)
class Window(KeyedArgument):
    """Box of stored cells, low <= (k, j, i) < high, over which kernels run.

    Args:
        low: first (k, j, i), ring included.
        high: one past the last (k, j, i).
        device: device on which kernels run.
        near: active segments of rows, see `warp_lcp.grid.active_rows`; kernels may skip the rest of
            the box. None for all. Sums over rows visit the range from the first to the last active
            segment of a row.
    """

    low: tuple[int, int, int]
    high: tuple[int, int, int]
    device: wp.Device
    near: np.ndarray | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of(
        cls, low: typing.Sequence[int], high: typing.Sequence[int], device: wp.Device
    ) -> "Window":
        """Return the box between two corners (k, j, i) given as any sequences."""
        (k, j, i), (c, b, a) = low, high
        return cls((k, j, i), (c, b, a), device)

    def common(self, other: "Window") -> "Window | None":
        """Return the intersection with another window; None if it is empty."""
        low, high = _corners(max, self.low, other.low), _corners(min, self.high, other.high)
        if low[0] >= high[0] or low[1] >= high[1] or low[2] >= high[2]:
            return None
        return Window(low, high, self.device, self.near)

    @cached_property
    def cells(self) -> CellRange:
        """The CellRange that kernels take as their first argument."""
        return (
            self._cells(grain(self.high[2] - self.low[2], self.device))
            if self.near is None
            else _in_part(self._pieces)
        )

    @cached_property
    def _pieces(self) -> wp.array:
        """The pieces to visit, see `pieces_of`."""
        assert self.near is not None
        return wp.array(
            pieces_of(self.near, self.low, self.high), dtype=wp.vec2i, device=self.device
        )

    @cached_property
    def _hulls(self) -> wp.array:
        """The pieces that sums over rows visit, one a row."""
        host = self._pieces.numpy()
        first = np.flatnonzero(
            np.append(True, (host[1:, 0] != host[:-1, 0]).any(axis=1))[: len(host)]
        )
        made = host[first]
        made[:, 1, 1] = host[np.append(first[1:], len(host))[: len(first)] - 1, 1, 1]
        return wp.array(made, dtype=wp.vec2i, device=self.device)

    def _cells(self, each: int) -> CellRange:
        box = CellRange()
        box.k, box.j, box.i = self.low
        box.end, box.grain = self.high[2], each
        box.rows, box.chunks = self.rows[1], -(-(self.high[2] - self.low[2]) // each)
        return box

    @property
    def rows(self) -> tuple[int, int]:
        """Number of planes and rows of the box."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def rows_of(self, sums: wp.array) -> np.ndarray:
        """Return the rows of the box in a field of row sums.

        The field has one or several entries per row of the grid.
        """
        rows = np.asarray(sums.numpy()[self.low[0] : self.high[0], self.low[1] : self.high[1]])
        if self.near is None:
            return rows
        visited = self.near[self.low[0] : self.high[0], self.low[1] : self.high[1]].any(axis=2)
        return np.where(visited.reshape(*visited.shape, *[1] * (rows.ndim - 2)), rows, 0)

    def run(
        self,
        passed: StencilKernel,
        *structs: "DataclassInstance",
        whole: bool = False,
        grouped: bool = False,
        launch: Launch | None = None,
        **kernel_args: object,
    ) -> None:
        """Launch a pass over the box, or record it with `LaunchGraph.launch`.

        Args:
            passed: the pass, with fields of a `box`.
            structs: with fields and numbers, see `StencilKernel.bind`.
            whole: a thread takes a whole row, for counts of a row.
            grouped: a thread takes `GROUPED_PLANES` planes together on CUDA, if the window is
                large; of kernels with `plane_group` of `particles.h`.
            launch: the launch function of a launch graph.
            kernel_args: fields and numbers by name.
        """
        rows = self._grouped if grouped else self._whole if whole else self._shared
        passed.bind_arguments(rows, structs, kernel_args).launch(launch)

    def rows_of_sums(self, planes: int) -> Rows:
        """Return the rows of a pass that sums.

        On a GPU a thread sums a column of `planes` planes, on a CPU whole rows.
        """
        if self.near is None and self.device.is_cuda:
            return Rows.box(self.low, self.high, self.device, slab=planes)
        return self._whole

    @property
    def _grouped(self) -> Rows:
        """Rows of a pass whose threads take planes together on CUDA."""
        (planes, rows), width = self.rows, self.high[2] - self.low[2]
        if not self.device.is_cuda or self.near is not None or planes * rows * width < MANY_CELLS:
            return self._shared
        made = self.rows_of_sums(GROUPED_PLANES)
        return replace(made, single=made.summed)

    @cached_property
    def _shared(self) -> Rows:
        if self.near is None:
            return Rows.box(self.low, self.high, self.device)
        return Rows.in_part(self._pieces, self._visited, self.high)

    @property
    def _visited(self) -> int:
        """Number of cells to visit in an active window, to within the ends of segments."""
        return 0 if self.near is None else SEGMENT * int(np.count_nonzero(self.near))

    @cached_property
    def _whole(self) -> Rows:
        if self.near is None:
            return Rows.box(self.low, self.high, self.device, cells=self.high[2] - self.low[2])
        return Rows.in_part(self._hulls, self._visited, self.high)

    def clear(self, *arrays: wp.array) -> None:
        """Set fields to 0 in the box, or in its active part.

        No memory is allocated for the rest.
        """
        for array in arrays:
            if self.near is None:
                clear(array)
            else:
                self.run(CLEAR[array.dtype], field=array)

    def launch(
        self, kernel: wp.Kernel, inputs: typing.Sequence[object], *, launch: Launch | None = None
    ) -> None:
        """Launch kernel(cells, *inputs) with threads (plane, row, chunk of a row).

        Or record it with `Program.launch`.
        """
        self._launch(kernel, self.cells, inputs, launch)

    def launch_rows(self, kernel: wp.Kernel, inputs: typing.Sequence[object]) -> None:
        """Launch kernel(cells, *inputs) with one thread per row (plane, row, 0).

        For sums that are the same on every run.
        """
        cells = (
            self._cells(self.high[2] - self.low[2]) if self.near is None else _in_part(self._hulls)
        )
        self._launch(kernel, cells, inputs, None)

    def _launch(
        self,
        kernel: wp.Kernel,
        cells: CellRange,
        inputs: typing.Sequence[object],
        launch: Launch | None,
    ) -> None:
        dim, cost = (*self.rows, cells.chunks), cells.grain
        if self.near is not None:
            dim, cost = (1, 1, cells.chunks), self._visited // max(cells.chunks, 1)
        launch_ranges(
            kernel,
            dim,
            cost,
            [cells, *inputs],
            device=self.device,
            launch=launch,
            ordered=kernel in ORDERED_KERNELS,
        )

    @property
    def identity(self) -> typing.Hashable:
        """Key by which recorded launches distinguish windows.

        A window with active segments never equals another.
        """
        return self.low, self.high, None if self.near is None else object()

    @property
    def current(self) -> "Window":
        """The window itself; of an `ActiveWindow` the window of the current step."""
        return self


NO_CELLS, BOX_OF_CELLS = CellRange(), struct.Struct("7i")  # members of a CellRange from `rows` on


def _memory(cells: "StructInstance") -> typing.Any:
    """Return the memory of a Warp struct, a `ctypes.Structure` with its members."""
    return cells.__ctype__()


class _RangeMemory:
    """A CellRange that recorded launches read, and the number of its tasks."""

    def __init__(self) -> None:
        self.range, self.tasks = type(_memory(CellRange()))(), ctypes.c_int64()
        self.first = 0, ctypes.addressof(self.range), ctypes.sizeof(self.range)
        self.sized = ctypes.addressof(self.tasks)
        self.extent: tuple[int, ...] = (1, 1, 1)  # threads of a launch on CUDA now
        self.room: tuple[int, ...] = (1, 1, 1)  # largest dimensions so far

    def set_dim(self, cells: CellRange, dim: tuple[int, int, int]) -> None:
        """Set the CellRange on CUDA, with its threads."""
        self.set_cells(cells, dim[0] * dim[1] * dim[2])
        self.extent, self.room = dim, larger(self.room, dim)

    def set_cells(self, cells: CellRange, tasks: int) -> None:
        """Set the CellRange."""
        ctypes.memmove(self.first[1], ctypes.addressof(_memory(cells)), self.first[2])
        self.tasks.value = tasks

    def set_box(self, rows: int, k: int, j: int, i: int, end: int, tasks: int) -> None:
        """Set a box of whole rows, see `CellRange`."""
        ctypes.memset(self.first[1], 0, self.first[2])
        BOX_OF_CELLS.pack_into(
            self.range, type(_memory(NO_CELLS)).rows.offset, rows, 1, k, j, i, end, end - i
        )
        self.tasks.value = tasks


class ActiveWindow(Window):
    """Window of the current step, in memory that recorded launches read.

    A launch that is recorded with it visits the window of the step in which it runs.

    Args:
        window: the first one.

    Attributes:
        first: plane, row of its first cell.
        sizes: its planes, its rows.
    """

    first: tuple[Scalar, Scalar]
    sizes: tuple[Scalar, Scalar]
    pieces: Scalar
    hulls: Slot
    _rows: tuple[RowsMemory, RowsMemory]  # rows of passes, and of passes that sum
    _sums: dict[int, DeviceRows]  # rows of passes that sum over columns of so many planes, on CUDA
    _ranges: tuple[_RangeMemory, _RangeMemory]  # ranges of kernels for cells, and for rows
    _now: Window

    def __init__(self, window: Window) -> None:
        rows = tuple(rows_memory(window.device) for _ in range(2))
        memory = {
            "_rows": rows,
            "_sums": {},
            "_ranges": (_RangeMemory(), _RangeMemory()),
            "hulls": Slot(),
        }
        numbers = {"first": (Scalar(), Scalar()), "sizes": (Scalar(), Scalar()), "pieces": Scalar()}
        for name, value in {"device": window.device, **memory, **numbers, "_now": None}.items():
            # The frozen dataclass does not allow assignment otherwise.
            object.__setattr__(self, name, value)
        self.move_to(window)

    __eq__, __hash__ = object.__eq__, object.__hash__
    identity = property(lambda self: self)
    low = property(lambda self: self._now.low)
    high = property(lambda self: self._now.high)
    near = property(lambda self: self._now.near)
    current = property(lambda self: self._now)
    cells = property(lambda self: self._now.cells)

    def move_to(self, window: Window) -> None:
        """Set the window of the current step."""
        window, before = window.current, self._now
        if window is before:
            return
        object.__setattr__(self, "_now", window)
        if before is not None and before == window and before.near is None and window.near is None:
            return
        if self.device.is_cuda:
            if LaunchGraph.on_device:
                self._move_on_device(window)
            return
        (k, j, i), planes, rows, end = window.low, *window.rows, window.high[2]
        self.pieces.value = 0
        for number, value in zip((*self.first, *self.sizes), (k, j, planes, rows), strict=True):
            number.value = value
        if window.near is None:  # as `Rows.box` and `Window.cells` have it: a task takes a row
            some = int(end > i)
            for memory in self._rows:
                memory.set_box(end - i, rows, planes, max(end - i, 1), some, window.low)
            for of_cells in self._ranges:
                of_cells.set_box(rows, k, j, i, end, planes * rows)
            return
        for memory, rows_ in zip(self._rows, (window._shared, window._whole), strict=True):
            memory.set_layout(rows_.single)  # whose pieces have their own planes and rows
        for of_cells, pieces in zip(self._ranges, (window._pieces, window._hulls), strict=True):
            of_cells.set_cells(_in_part(pieces), len(pieces))
        self.hulls.point_to(window._hulls)
        self.pieces.value = len(window._hulls)

    def _move_on_device(self, window: Window) -> None:
        for memory, rows in zip(self._rows, (window._shared, window._whole), strict=True):
            memory.set_layout(rows.single, window.low)
        for planes, memory in self._sums.items():
            memory.set_layout(window.rows_of_sums(planes).summed, window.low)
        whole = window._cells(max(window.high[2] - window.low[2], 1))
        for of_cells, cells in zip(self._ranges, (window.cells, whole), strict=True):
            of_cells.set_dim(cells, (*window.rows, cells.chunks))

    def rows_of_sums(self, planes: int) -> Rows:
        """Return the rows of a pass that sums."""
        if not self.device.is_cuda:
            return super().rows_of_sums(planes)
        rows = self._now.rows_of_sums(planes)
        if planes not in self._sums:
            memory = self._sums[planes] = DeviceRows()
            layers, rows_, chunks = self._ranges[0].room
            memory.room = -(-layers // planes), rows_, chunks
            memory.set_layout(rows.summed, self.low)
        return replace(rows, memory=self._sums[planes])

    @property
    def hull_pieces(self) -> wp.array | None:
        """Pieces that sums over rows visit; None for all rows of the box."""
        return None if self.near is None else self._now._hulls

    @property
    def _shared(self) -> Rows:
        return replace(self._now._shared, memory=self._rows[0])

    @property
    def _whole(self) -> Rows:
        return replace(self._now._whole, memory=self._rows[1])

    def launch_rows(self, kernel: wp.Kernel, inputs: typing.Sequence[object]) -> None:
        """Launch kernel(cells, *inputs) with one thread per row."""
        cells = (
            self._now._cells(self.high[2] - self.low[2])
            if self.near is None
            else _in_part(self._now._hulls)
        )
        self._launch(kernel, cells, inputs, None, self._ranges[1])

    def _launch(
        self,
        kernel: wp.Kernel,
        cells: CellRange,
        inputs: typing.Sequence[object],
        launch: Launch | None,
        memory: _RangeMemory | None = None,
    ) -> None:
        memory = memory or self._ranges[0]
        dim, cost = (*self.rows, cells.chunks), cells.grain
        if self.near is not None:
            dim, cost = (1, 1, cells.chunks), self._now._visited // max(cells.chunks, 1)
        launch_ranges(
            kernel,
            dim,
            cost,
            [cells, *inputs],
            device=self.device,
            launch=launch,
            ordered=kernel in ORDERED_KERNELS,
            first=memory.first,
            sized=memory.sized,
            extent=memory,
        )


class DirtyRegion:
    """Dirty region: union of the current window and the last one.

    A pass over it leaves fields as if it had run everywhere, if outside of its window it writes a
    constant.

    Args:
        all: the cells of all windows.
    """

    def __init__(self, all: Window) -> None:
        self.all = all
        self.forget()

    def forget(self) -> None:
        """Forget the last window."""
        self._last = self.all

    def through(self, window: Window | None) -> Window:
        """Return the union of the last window and this one, or of their active parts.

        This window becomes the last. None stands for all cells.
        """
        now, last = (window and window.current.common(self.all)) or self.all, self._last
        self._last = now
        near = None if now.near is None or last.near is None else now.near | last.near
        return Window(
            _corners(min, now.low, last.low), _corners(max, now.high, last.high), now.device, near
        )


def _in_part(pieces: wp.array) -> CellRange:
    """Return the CellRange of some pieces."""
    part = CellRange()
    part.pieces, part.rows, part.chunks = pieces, 1, len(pieces)
    return part


def pieces_of(
    near: np.ndarray, low: typing.Sequence[int], high: typing.Sequence[int]
) -> np.ndarray:
    """Return the runs of marked segments in a box of cells, in order.

    (k, j) and (first, one past the last i), int32, shape (n, 2, 2).

    Args:
        near: not 0 where a segment counts, shape (planes, rows, segments of a row) of the grid.
        low: first cell (k, j, i) of the box.
        high: one past the last.
    """
    part = near[low[0] : high[0], low[1] : high[1]]
    planes, rows, segments = part.shape
    # An unmarked element before each row separates the rows.
    flat = np.zeros(planes * rows * (segments + 1) + 1, dtype=bool)
    flat[:-1].reshape(planes, rows, segments + 1)[..., 1:] = part
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    row, first = np.divmod(changes[::2], segments + 1)
    first, last = (first - 1) * SEGMENT, (changes[1::2] - row * (segments + 1) - 1) * SEGMENT
    k, j = np.divmod(row, rows)
    made = np.stack(
        (k + low[0], j + low[1], np.maximum(first, low[2]), np.minimum(last, high[2])), axis=-1
    )
    return made[made[:, 2] < made[:, 3]].astype(np.int32).reshape(-1, 2, 2)


@dataclass(frozen=True)
class StaggeredGrid:
    """Staggered grid: number and size of cells, and fields on it.

    Args:
        counts: cells (nx, ny, nz); nz = 1 in 2-D.
        spacing: edge of a cell dx [m].
        dimension: 2 or 3.
        device: a Warp device or its name.
        origin: cells (x, y, z) of a larger grid before the first one of this.
        whole: cells of the larger grid of which this is a part; None if it is no part.
        sparse: whether only a small part of its fields will be written, for which memory is taken
            in small pages.
        part: the part of the grid that this process has; all of it if None.

    Attributes:
        barriers: solids thinner than its cells, `warp_lcp.grid.barriers.Barriers`, set by the code
            that places them; None if there are none.

    Raises:
        ValueError: a count is not positive, nz is not 1 in 2-D, or the spacing is not positive.
    """

    counts: tuple[int, int, int]
    spacing: float
    dimension: int
    device: wp.Device = "cpu"  # a name is replaced by its device
    origin: tuple[int, int, int] = (0, 0, 0)
    whole: tuple[int, int, int] | None = None
    sparse: bool = field(default=False, compare=False)
    part: GridPart = field(default=None, compare=False, repr=False)  # type: ignore[assignment]  # set below
    barriers: "Barriers | None" = field(default=None, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Check the arguments and resolve the device."""
        if self.dimension not in (2, 3):
            raise ValueError(f"dimension = {self.dimension}: must be 2 or 3")
        if min(self.counts) < 1 or (self.dimension == 2 and self.counts[2] != 1):
            raise ValueError(
                f"counts = {self.counts}: must be at least 1 cell (nx, ny, nz), and nz = 1 in 2-D"
            )
        if not (np.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(f"spacing = {self.spacing}: must be a positive length [m]")
        object.__setattr__(self, "device", checked_device(self.device))
        object.__setattr__(self, "part", self.part or GridPart(self))

    def divide(self, barriers: "Barriers | None") -> None:
        """Set the barriers that separate the material on their two sides."""
        object.__setattr__(self, "barriers", barriers)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (nz + 2, ny + 2, nx + 2) of every field."""
        nx, ny, nz = self.counts
        return nz + 2, ny + 2, nx + 2

    @property
    def size(self) -> int:
        """Number of elements of a field, ring included."""
        return int(np.prod(self.shape))

    @property
    def domain_counts(self) -> tuple[int, int, int]:
        """Cells of the domain (nx, ny, nz): of the larger grid if this is a part of one."""
        return self.whole or self.counts

    @property
    def extent(self) -> np.ndarray:
        """Sides of the domain [m], shape (3,)."""
        return np.array(self.domain_counts) * self.spacing

    @property
    def planes(self) -> int:
        """Nodes along z that a tent function spans: 1 in 2-D, 2 in 3-D."""
        return self.dimension - 1

    @property
    def cell_volume(self) -> float:
        """Volume of a cell [m^3]; in 2-D its area [m^2] (per meter of depth)."""
        return self.spacing**self.dimension

    def covers(self, low: typing.Sequence[int], high: typing.Sequence[int]) -> bool:
        """Return whether the grid contains all cells from low to high.

        Cells (x, y, z) of the domain, counted from 0, both included.
        """
        begin, end = np.array(self.origin), np.array(self.origin) + self.counts
        return bool((begin <= low).all() and (np.asarray(high) < end).all())

    def refined(self, parts: int) -> "StaggeredGrid":
        """Return the grid with each cell split along each axis; in 2-D not along z."""
        counts, origin, whole = (
            None
            if n is None
            else (n[0] * parts, n[1] * parts, n[2] * (parts if self.dimension == 3 else 1))
            for n in (self.counts, self.origin, self.whole)
        )
        assert counts is not None and origin is not None
        return StaggeredGrid(
            counts, self.spacing / parts, self.dimension, self.device, origin, whole
        )

    def coarser(self) -> "StaggeredGrid":
        """Return the grid of twice the spacing that covers this one, in one process."""
        nx, ny, nz = (-(-n // 2) for n in self.counts)
        return StaggeredGrid((nx, ny, nz), 2.0 * self.spacing, self.dimension, self.device)

    def field(self, dtype: type = wp.float32) -> wp.array:
        """Return a field of zeros with one value per stored cell."""
        return zeros(self.size, dtype, self.device, small_pages=self.sparse).reshape(self.shape)

    def faces(self, dtype: type = wp.float32) -> list[wp.array]:
        """Return a field of zeros for each component: [u, v] in 2-D, [u, v, w] in 3-D."""
        return [self.field(dtype) for _ in range(self.dimension)]

    def to_grid(self, points: np.ndarray) -> np.ndarray:
        """Return the grid coordinates of points [m], shape (n, 3)."""
        return np.asarray(points, dtype=np.float64) / self.spacing + 1.0

    def to_world(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the points [m] at grid coordinates, shape (n, 3)."""
        return (np.asarray(coordinates, dtype=np.float64) - 1.0) * self.spacing

    def interior(self, host: np.ndarray) -> np.ndarray:
        """Return the view (nz, ny, nx) of a host field without its ring."""
        return host[1:-1, 1:-1, 1:-1]

    @cached_property
    def placement(self) -> GridPlacement:
        """Spacing and place of the grid, as kernels over particles take them."""
        return GridPlacement(self.planes, self.spacing, 1.0 / self.spacing, *self.origin)

    @cached_property
    def everywhere(self) -> Window:
        """All stored cells, ring included; in 2-D those of the plane in use."""
        return self.window((1, 1, 1), self.counts, grow=1)

    @cached_property
    def domain(self) -> Window:
        """All cells without the ring."""
        return self.window((1, 1, 1), self.counts)

    def window(
        self, low: typing.Sequence[int], high: typing.Sequence[int], grow: int = 0, shift: int = 0
    ) -> Window:
        """Return the window of cells from low to high, moved, grown and clipped.

        Cells (x, y, z), both included, are moved by `shift` along each axis. If the box lies
        outside of the stored cells, the nearest layer of these is returned.

        Along an axis of n cells, with indices of the padded arrays:

            first = clip(low + shift - grow, 0, n + 1),
            end = max(min(high + shift + grow + 1, n + 2), first + 1).
        """
        first, last = [], []
        for axis in (2, 1, 0):
            if axis == 2 and self.dimension == 2:
                first.append(1)
                last.append(2)
                continue
            first.append(min(max(int(low[axis]) + shift - grow, 0), self.counts[axis] + 1))
            last.append(
                max(min(int(high[axis]) + shift + grow + 1, self.counts[axis] + 2), first[-1] + 1)
            )
        return Window.of(first, last, self.device)


__getattr__ = renamed_names(__name__, Trail="DirtyRegion")


def three_components(fields: Iterable[FieldT]) -> list[FieldT | None]:
    """Return fields of three components; in 2-D the third is None."""
    return [*fields, None, None, None][:3]
