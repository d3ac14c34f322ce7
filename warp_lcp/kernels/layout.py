"""Row layout, and the structs that pass stencils and bounds to kernels.

A Warp kernel with one thread a cell reaches 3 % of a CPU's memory bandwidth; one thread for a
*grain* of contiguous elements with a native inner loop reaches nearly all of it. clang vectorizes
such a loop only if the arrays are declared not to alias and if conditionals are written as
selections of values that are computed anyway.
"""

import ctypes
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, TypeAlias, TypeVar, no_type_check

import warp as wp

from warp_lcp.kernels.types import DataType, DeviceArray, StructInstance

QUAD = 4  # cells of a row that a thread takes at a time on CUDA


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


def threads(layout: RowLayout) -> tuple[int, int, int]:
    """Return the number of threads of a launch, by dimension."""
    return -(-layout.planes // layout.slab), layout.rows, layout.chunks
