"""Row layout, and the structs that pass stencils and bounds to kernels.

A Warp kernel with one thread a cell reaches 3 % of a CPU's memory bandwidth; one thread for a
*grain* of contiguous elements with a native inner loop reaches nearly all of it. clang vectorizes
such a loop only if the arrays are declared not to alias and if conditionals are written as
selections of values that are computed anyway.
"""

import ctypes
import functools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol, TypeAlias, TypeVar, no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels.fields import CPU_CHUNK, Layout, Padding
from warp_lcp.kernels.types import DataType, DeviceArray, StructInstance

if TYPE_CHECKING:
    from warp_lcp.kernels.recorded_arguments import RowsMemory

QUAD = 4  # cells of a row that a thread takes at a time on CUDA
# Otherwise single cells, to compare both on a GPU.
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


class Alignment(NamedTuple):
    """Alignment of the rows of a grid's fields.

    Attributes:
        first: elements between a multiple of four and the first cell of a row; -1: any number.
        either: whether there are two more in every second row of a plane.
    """

    first: int = -1
    either: bool = False

    @property
    def word(self) -> str:
        """Part of a kernel's name; empty where rows begin anywhere."""
        return (
            ""
            if self.first < 0
            else f"{self.first}or{self.first + 2}"
            if self.either
            else f"{self.first}"
        )


ANYWHERE = Alignment()


@wp.struct
class RowLayout:
    """Position of the rows in memory, and how threads share them.

    A thread takes a chunk of a row in a slab of planes.
    """

    # Range of tasks of a thread of the pool, see `warp_lcp.kernels.thread_pool`: the first, one
    # past the last; 0: one task a thread.
    begin: int
    end: int
    base: wp.int64  # element of the first cell
    s1: wp.int64  # elements from plane to plane
    s2: wp.int64  # elements from row to row
    nx: int  # cells of a row
    rows: int  # rows of a plane
    planes: int
    grain: int  # cells that a thread takes
    chunks: int  # threads of a row
    slab: int  # planes that a thread takes
    # For fields of three planes: planes before the first that they keep as well, that of ghosts, or
    # none.
    turn: int
    lift: int  # first of those planes, counted from the first plane
    # For such fields: planes of a slab. Each slab has three planes of its own, apart from the next
    # slab's.
    cut: int
    slabs: int  # number of slabs
    apart: int  # planes on either side of a cut that keep a place of their own
    # First cell (even, for `pairs`) and one past the last of each row (k, j) with unknowns; null:
    # all.
    spans: wp.array2d(dtype=wp.vec2i)
    # (plane, row) and (first, one past the last) cell of each row segment of a box in part; null:
    # the whole box.
    pieces: wp.array2d(dtype=wp.vec2i)
    # Other level of a transfer: element of its first cell, elements from plane to plane and from
    # row to row.
    o0: wp.int64
    o1: wp.int64
    o2: wp.int64
    n1: int  # planes and rows of the other level
    n2: int
    fx: int  # its cells for each cell of ours; negative: our cells for each of its cells
    fy: int
    fz: int


class BoundOperands(NamedTuple):
    """Bounds of x as arguments of kernels that support codes.

    Attributes:
        lower: field of lower bounds; empty: `least` holds for all unknowns.
        least: that number.
        upper: likewise, field of upper bounds.
        most: that number.
        code: of `warp_lcp.problem.bounds.Bounds`, wp.uint8; empty: there is none.
    """

    lower: DeviceArray
    least: wp.float64
    upper: DeviceArray
    most: wp.float64
    code: DeviceArray


@wp.struct
class BoundFields:
    """Bounds of x, with the operands of `warp_lcp.problem.bounds.Bounds.operands`."""

    lower: wp.array(dtype=wp.float64)
    upper: wp.array(dtype=wp.float64)
    code: wp.array(dtype=wp.uint8)
    least: wp.float64
    most: wp.float64


BLANK = RowLayout()
NO_ARRAY = bytes(wp.array(dtype=wp.uint8).__ctype__())
# Class of the declarations of structs, and of numbers that C takes by their `value`.
STRUCT = type(RowLayout)
WARP_NUMBERS = (
    wp.bool,
    wp.int8,
    wp.uint8,
    wp.int32,
    wp.uint32,
    wp.int64,
    wp.uint64,
    wp.float32,
    wp.float64,
)
StructType = TypeVar("StructType")
KernelValue: TypeAlias = "DeviceArray | StructInstance | float | None"
"""Member of a kernel's struct: an array, a struct, a number, or None for an empty array."""


def grain(n: int, device: wp.Device) -> int:
    """Return the number of cells that a thread takes of a row of n cells."""
    return 1 if device.is_cuda else n


def check_memory(name: str, array: DeviceArray, dtype: DataType, shape: tuple[int, ...]) -> None:
    """Check an array before its address is passed to kernels.

    Raises:
        TypeError: it is no array of this type.
        ValueError: it has another shape, or is not contiguous.
    """
    if not isinstance(array, wp.array) or array.dtype is not dtype:
        found = array.dtype if isinstance(array, wp.array) else type(array)
        raise TypeError(f"{name} is {found.__name__}, not an array of {dtype.__name__}")
    if tuple(array.shape) != shape or not array.is_contiguous:
        raise ValueError(
            f"{name} has shape {array.shape}{', strided' * (not array.is_contiguous)}: expected "
            f"{shape}, contiguous"
        )


def native_of(struct: StructInstance | DeviceArray) -> ctypes.Structure:
    """Return a Warp struct or array as kernels see it."""
    native: ctypes.Structure = struct.__ctype__()
    return native


def offset_of(native: type[ctypes.Structure], name: str) -> int:
    """Return where a member of a struct begins, in bytes."""
    offset: int = vars(native)[name].offset
    return offset


def _member(value: KernelValue) -> "KernelValue | ctypes.Structure":
    """Return a value as a member of a native struct."""
    if isinstance(value, wp.array):
        return value.ctype or native_of(value)
    return value.value if isinstance(value, WARP_NUMBERS) else value


def put(struct: StructType, members: Mapping[str, KernelValue]) -> StructType:
    """Set members of a Warp struct and return it, without checking their types.

    It takes a third of the time of setting attributes.
    """
    native = native_of(struct)
    for name, value in members.items():
        if value is not None:
            setattr(native, name, _member(value))
    struct.__dict__.update(members)  # keeps the arrays alive
    return struct


def copy_of(struct: StructType) -> StructType:
    """Return a copy of a Warp struct.

    It takes a fraction of the time of constructing one with nested structs.
    """
    native = native_of(struct)
    made = object.__new__(type(struct))
    made.__dict__.update(struct.__dict__, _ctype=type(native).from_buffer_copy(native))
    return made


def packed(arrays: Sequence[DeviceArray | None]) -> list[ctypes.Structure | bytes]:
    """Return arrays as C structs; None becomes a null array."""
    return [NO_ARRAY if a is None else native_of(a) for a in arrays]


@dataclass(frozen=True)
class Pattern:
    """Pattern of a compact stencil: its neighbors and the source of its weights.

    Attributes:
        offsets: (x, y, z), each -1, 0 or 1, of the neighbors. A `symmetric` pattern has those
            before a cell; the weights serve those after it, too.
        symmetric: whether a weight serves both its cells.
        kind: "numbers", one an offset; "arrays"; or "functions", Warp functions (k, j, i) of the
            cell.
        functions: as many as offsets, of that kind: the coefficients, which are minus the weights;
            or numbers, the same everywhere.
    """

    offsets: tuple[tuple[int, int, int], ...]
    symmetric: bool
    kind: str
    functions: tuple[wp.Function | float, ...] = ()

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the weights in the struct."""
        return tuple(f"w{i}" for i in range(len(self.offsets))) if self.kind == "arrays" else ()

    @functools.cached_property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers in the struct."""
        return tuple(f"c{i}" for i in range(len(self.offsets))) if self.kind == "numbers" else ()

    @functools.cached_property
    def word(self) -> str:
        """Key of its kernels."""
        mask = sum(1 << (x + 1 + 3 * (y + 1) + 9 * (z + 1)) for x, y, z in self.offsets)
        return (
            f"compact_{'symmetric_' * self.symmetric}{self.kind}"
            f"{_number_of(self.functions)}_{mask:x}"
        )

    def source(self) -> list[str]:
        """Return C++ for `row_functions.h`: weight functions and a macro that visits them.

        There is one function of the piece's cell for each weight.
        """
        lines = [
            f"const auto weight{i} = [&](long long k) -> T {{ return (T)({self._expression(i)}); "
            f"}};"
            for i in range(len(self.offsets))
        ]
        visits = " ".join(
            f"DO(weight{i}, {x}, {y}, {z})" for i, (x, y, z) in enumerate(self.offsets)
        )
        return [
            *lines,
            f"#define EACH_WEIGHT(DO) {visits}",
            f"constexpr bool SYMMETRIC = {str(self.symmetric).lower()};",
        ]

    def _expression(self, i: int) -> str:
        """Return C++ of a weight at cell k."""
        if self.kind != "functions":
            return f"c{i}" if self.kind == "numbers" else f"w{i}[k]"
        function = self.functions[i]
        return (
            f"{-function!r}"
            if isinstance(function, float)
            else f"-{function.native_func}(place(k)[0], place(k)[1], place(k)[2])"
        )

    @functools.cached_property
    def touch(self) -> wp.Function | None:
        """A Warp function that calls all weight functions; None if there are none.

        A kernel that calls it contains their code.
        """
        touch = None
        for function in self.functions:
            touch = touch if isinstance(function, float) else _touching(function, touch)
        return touch


@functools.cache
def _number_of(functions: tuple[wp.Function | float, ...]) -> str:
    """Return a key of functions that also distinguishes those of equal names."""
    return f"_{_number_of.cache_info().misses}" if functions else ""


def _touching(function: wp.Function, before: wp.Function | None) -> wp.Function:
    if before is None:

        @no_type_check
        def touch(i: int):
            return wp.float64(function(i, i, i))
    else:

        @no_type_check
        def touch(i: int):
            return wp.float64(function(i, i, i)) + before(i)

    touch.__qualname__ = touch.__name__ = f"touch_{function.key}"
    return wp.func(touch)


@functools.cache
def stencil_struct(d: DataType, w: DataType, pattern: Pattern | None = None) -> DataType:
    """Return the struct of a stencil with these types of diagonal and weights.

    It is a 7-point stencil, unless there is a pattern.
    """
    fields, numbers = (
        (("wx", "wy", "wz"), ("cx", "cy", "cz"))
        if pattern is None
        else (pattern.names, pattern.numbers)
    )
    members = dict.fromkeys(("unit", *numbers), wp.float64) | {
        "d": wp.array(dtype=d),
        "known": wp.array(dtype=wp.float64),
    }
    name = f"Stencil_{d.__name__}_{w.__name__}" + (f"_{pattern.word}" if pattern else "")
    return make_struct(name, members | dict.fromkeys(fields, wp.array(dtype=w)))


class KernelStencil(Protocol):
    """Stencil that kernels take: `warp_lcp.operators.padded_stencil.PaddedStencil`, or a product.

    Attributes:
        d: diagonal, a flat stored field.
        weights: of the neighbors, stored; None: numbers, or none.
        pattern: of a compact stencil; None: 7 points.
        struct: arguments of kernels.
    """

    @property
    def d(self) -> DeviceArray: ...  # noqa: D102
    @property
    def weights(self) -> tuple[DeviceArray, ...] | None: ...  # noqa: D102
    @property
    def pattern(self) -> Pattern | None: ...  # noqa: D102
    @property
    def struct(self) -> StructInstance: ...  # noqa: D102


@dataclass(frozen=True)
class PrecomputedProduct:
    """A precomputed product A x + b, passed to a kernel in place of a stencil.

    Matrices use it.

    Args:
        d: diagonal in units of `unit`, stored; 0 where there is no unknown.
        unit: value of one unit of d.
        y: A x + b, stored.
    """

    d: DeviceArray
    unit: float
    y: DeviceArray
    weights: ClassVar[None] = None
    pattern: ClassVar[None] = None

    @functools.cached_property
    def struct(self) -> StructInstance:
        """Arguments of kernels."""
        check_memory("a known product", self.y, wp.float64, (self.d.size,))
        return put(
            copy_of(_blank_stencil(self.d.dtype)),
            {"unit": float(self.unit), "d": self.d, "known": self.y},
        )


@functools.cache
def _blank_stencil(d: DataType) -> StructInstance:
    return stencil_struct(d, wp.float32)()


def make_struct(name: str, members: dict[str, DataType | DeviceArray]) -> DataType:
    """Return a Warp struct with these members.

    Make each struct once: annotations of arrays do not compare equal.
    """
    return wp.struct(
        type(name, (), {"__annotations__": members, "__module__": __name__, "__qualname__": name})
    )


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


def threads(layout: RowLayout) -> tuple[int, int, int]:
    """Return the number of threads of a launch, by dimension."""
    return -(-layout.planes // layout.slab), layout.rows, layout.chunks
