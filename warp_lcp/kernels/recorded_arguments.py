"""Memory that recorded launches read in each run.

It holds numbers, windows, lists, and addresses of arrays. A launch that is recorded once holds its
arguments as bytes. What changes from run to run stands in memory of its owner. A patch of the
launch, (offset in the arguments, address, bytes), copies it into the arguments before each run.
"""

from __future__ import annotations

import ctypes
import struct
from typing import Any, Protocol, TypeAlias, TypeVar

import warp as wp

from warp_lcp.kernels.layout import RowLayout, native_of, offset_of
from warp_lcp.kernels.types import DataType, DeviceArray, StructInstance

LAYOUT = type(native_of(RowLayout()))
LAYOUT_BYTES, BOX_OFFSET = ctypes.sizeof(LAYOUT), offset_of(LAYOUT, "nx")
_ARRAY = type(native_of(wp.array(dtype=wp.uint8)))
ARRAY_BYTES, SHAPE_OFFSET = ctypes.sizeof(_ARRAY), offset_of(_ARRAY, "shape")
# Members of a RowLayout from `nx` to `slab`; first (k, j, i).
BOX, PLACE = struct.Struct("6i"), struct.Struct("3i")
Cell: TypeAlias = "ctypes._SimpleCData[Any]"  # memory of one number
FORMATS: dict[DataType, type[Cell]] = {
    wp.float32: ctypes.c_float,
    wp.float64: ctypes.c_double,
    wp.int32: ctypes.c_int32,
    wp.int64: ctypes.c_int64,
    wp.bool: ctypes.c_bool,
    float: ctypes.c_float,
    int: ctypes.c_int32,
    bool: ctypes.c_bool,
}


class Scalar:
    """A number that changes between the runs of recorded launches.

    Pass it where a kernel takes a number. A recorded launch reads `value` in each run; any other
    launch uses the value at the time of the call.
    """

    __slots__ = ("_cells", "_scaled", "_value")

    def __init__(self, value: float = 0) -> None:
        self._cells: dict[type[Cell], Cell] = {}  # the number in each type that kernels use
        self._scaled: dict[float, Scalar] = {}
        self._value = value

    @property
    def value(self) -> float:
        """The number."""
        return self._value

    @value.setter
    def value(self, value: float) -> None:
        self._value = value
        for cell in self._cells.values():
            cell.value = value
        for factor, product in self._scaled.items():
            product.value = value * factor

    def scaled(self, factor: float) -> Scalar:
        """Return the number times a factor, updated with it."""
        if factor not in self._scaled:
            self._scaled[factor] = Scalar(self._value * factor)
        return self._scaled[factor]

    def address(self, kind: DataType) -> tuple[int, int]:
        """Return the address and the bytes of the number in one of Warp's types."""
        cell = FORMATS[kind]
        if cell not in self._cells:
            self._cells[cell] = cell(self._value)
        return ctypes.addressof(self._cells[cell]), ctypes.sizeof(cell)


KernelArgument: TypeAlias = "DeviceArray | StructInstance | Scalar | float | None"
"""Argument of a kernel: an array, a struct, a number, or None for an empty array."""
Argument = TypeVar("Argument")


def scaled(number: float | Scalar, factor: float) -> float | Scalar:
    """Return a number times a factor."""
    return number.scaled(factor) if isinstance(number, Scalar) else number * factor


def value_of(number: Argument | Scalar) -> Argument | float:
    """Return a number, or the present value of a `Scalar`."""
    return number.value if isinstance(number, Scalar) else number


class Slot:
    """Address of an array that is replaced between runs.

    The current array has it as attribute `slot`.
    """

    __slots__ = ("_first_store", "_length", "_memory", "address")

    def __init__(self) -> None:
        self._memory = ctypes.create_string_buffer(ARRAY_BYTES)
        self.address = ctypes.addressof(self._memory)
        self._length = ctypes.c_int32.from_buffer(self._memory, SHAPE_OFFSET)
        self._first_store: DeviceArray | None = None  # the last store passed to `point_to_first`

    def point_to(self, array: DeviceArray) -> None:
        """Make recorded launches use this array from now on."""
        self._first_store = None
        ctypes.memmove(self.address, ctypes.addressof(native_of(array)), ARRAY_BYTES)
        array.slot = self

    def point_to_first(self, count: int, store: DeviceArray) -> None:
        """Make recorded launches use the first elements of a flat array from now on."""
        if self._first_store is not store:
            ctypes.memmove(self.address, ctypes.addressof(native_of(store)), ARRAY_BYTES)
            self._first_store = store
        self._length.value = count


def slot_of(argument: KernelArgument) -> Slot | None:
    """Return the slot of an array that is replaced between runs, else None."""
    slot: Slot | None = vars(argument).get("slot") if isinstance(argument, wp.array) else None
    return slot


class LaunchDimensions(Protocol):
    """Memory of launch dimensions that change between runs.

    Attributes:
        extent: dimensions of a launch now.
        room: those of a captured launch: the largest so far.
    """

    extent: tuple[int, ...]
    room: tuple[int, ...]


class RowsMemory:
    """Rows that change between runs: layout, first cell of a box, number of tasks.

    Attributes:
        layout: native struct of the layout.
        place: first (k, j, i) of a box.
        tasks: number of tasks of a kernel over the rows.
    """

    __slots__ = ("layout", "place", "tasks")

    def __init__(self) -> None:
        self.layout = LAYOUT()
        self.place, self.tasks = (ctypes.c_int32 * 3)(), ctypes.c_int64()

    def patches(self, place: int | None) -> list[tuple[int, int, int]]:
        """Return the patches of a launch.

        `place`: offset of `k0` in its arguments; None: it has none.
        """
        found = [(0, ctypes.addressof(self.layout), LAYOUT_BYTES)]
        return (
            found
            if place is None
            else [*found, (place, ctypes.addressof(self.place), ctypes.sizeof(self.place))]
        )

    @property
    def sized(self) -> int:
        """Address of the number of tasks."""
        return ctypes.addressof(self.tasks)

    def set_box(
        self, nx: int, rows: int, planes: int, grain: int, chunks: int, place: tuple[int, int, int]
    ) -> None:
        """Set the rows to whole rows of a box, see `RowLayout`."""
        ctypes.memset(ctypes.addressof(self.layout), 0, LAYOUT_BYTES)
        BOX.pack_into(self.layout, BOX_OFFSET, nx, rows, planes, grain, chunks, 1)
        PLACE.pack_into(self.place, 0, *place)
        self.tasks.value = planes * rows * chunks

    def set_entries(self, count: int, cells: int) -> int:
        """Set the rows to the entries of a list, on the CPU; return the tasks.

        The layout is that of `Rows.entries` with so many `cells` a task.
        """
        chunks = -(-count // cells)
        self.set_box(count, 1, 1, cells, chunks, (0, 0, 0))
        return chunks

    def set_layout(self, layout: RowLayout, place: tuple[int, ...] = (0, 0, 0)) -> None:
        """Set the rows.

        Args:
            layout: a RowLayout.
            place: first (k, j, i).
        """
        ctypes.memmove(
            ctypes.addressof(self.layout), ctypes.addressof(native_of(layout)), LAYOUT_BYTES
        )
        self.place[:] = list(place)
        self.tasks.value = -(-layout.planes // max(layout.slab, 1)) * layout.rows * layout.chunks


class DeviceRows(RowsMemory):
    """Rows that change between runs, on CUDA, with their launch dimensions.

    Attributes:
        extent: threads of a launch (slabs, rows, chunks) now.
        room: those of a captured launch: the largest requested so far. Threads beyond the rows
            return at once.
        places: number of threads, of which each has a place for its sums.
    """

    __slots__ = ("extent", "places", "room", "spare")

    def __init__(self, spare: float = 1.0) -> None:
        """Begin with one thread.

        Where `room` must grow, it grows by the factor `spare` more.
        """
        super().__init__()
        self.extent: tuple[int, ...] = (1, 1, 1)
        self.room: tuple[int, ...] = (1, 1, 1)
        self.places, self.spare = Scalar(), spare

    def set_layout(self, layout: RowLayout, place: tuple[int, ...] = (0, 0, 0)) -> None:
        """Set the rows and their launch dimensions."""
        super().set_layout(layout, place)
        self.extent = -(-layout.planes // max(layout.slab, 1)), layout.rows, layout.chunks
        self.room = larger(self.room, self.extent, self.spare)
        self.places.value = self.tasks.value


def rows_memory(device: wp.Device, spare: float = 1.0) -> RowsMemory:
    """Return memory of rows for recorded launches.

    `spare` as of `DeviceRows`.
    """
    return DeviceRows(spare) if device.is_cuda else RowsMemory()


def larger(room: tuple[int, ...], extent: tuple[int, ...], spare: float = 1.0) -> tuple[int, ...]:
    """Return launch dimensions that contain both arguments.

    Those that must grow do so by the factor `spare` more.
    """
    return tuple(r if r >= e else int(spare * e) for r, e in zip(room, extent, strict=True))
