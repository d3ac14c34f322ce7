# mypy: ignore-errors
"""CUDA graphs of a step's launches, whose arguments lie in device memory.

A graph is captured once. Quantities that change from run to run (windows, list lengths, replaced
arrays, `Scalar`s) stand in memory of the host, see `recorded_arguments.py`. The arguments of all
kernels of a graph lie one after another in one array of the device, the *image*. Each run gathers
the changed numbers in one pinned buffer. The graph copies it to the device, writes its bytes to
their places in the image (one kernel), and launches the kernels, each of which reads its arguments
from there. Launch dimensions are those of the largest rows; threads beyond the present ones return
at once.
"""

import ast
import ctypes
import functools
import inspect
import types
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.joined_graphs import queue_stretch, settle
from warp_lcp.kernels.kernel_variant import BLOCKS_OF_QUADS, KernelVariant, task_of
from warp_lcp.kernels.launch_graph import (
    Command,
    CommandBuffer,
    DeviceCopy,
    HostTask,
    Loop,
    NotRecordableError,
)
from warp_lcp.kernels.layout import RowLayout, make_struct, native_of, offset_of, threads
from warp_lcp.kernels.recorded_arguments import (
    ARRAY_BYTES,
    LAYOUT_BYTES,
    KernelArgument,
    LaunchDimensions,
    Scalar,
    slot_of,
    value_of,
)
from warp_lcp.kernels.stencil_kernel import BoundKernel
from warp_lcp.kernels.thread_pool import Operation, Patch
from warp_lcp.kernels.types import DataType, DeviceArray, Dimensions

ALIGNED = 16  # bytes
FIRST = "tasks_"  # member of a kernel's arguments: number of its tasks
BEYOND = {
    1: f"if wp.int64(wp.tid()) >= given_[0].{FIRST}:\n    return",
    3: f"""
plane_, row_, chunk_ = wp.tid()
if row_ >= given_[0].{{0}}.rows or chunk_ >= given_[0].{{0}}.chunks:
    return
if wp.int64((plane_ * given_[0].{{0}}.rows + row_) * given_[0].{{0}}.chunks + chunk_) \
>= given_[0].{FIRST}:
    return
""",
}


@forward_kernel(module="warp_lcp.device_graph")
def patch_kernel(
    cells: wp.array(dtype=wp.uint8),
    source: wp.array(dtype=int),
    place: wp.array(dtype=int),
    image: wp.array(dtype=wp.uint8),
):
    """Write a byte that changes from run to run to its position in the arguments."""
    t = wp.tid()
    image[place[t]] = cells[source[t]]


@functools.cache
def pass_from_memory(form: KernelVariant) -> tuple[DataType, wp.Kernel]:
    """Return a kernel's argument struct, and the kernel that reads it from memory.

    That kernel takes an array of such structs and reads the first element.
    """
    if form.pattern is not None and form.pattern.touch is not None:
        raise NotRecordableError(f"{form.declared.label}: a stencil of Warp functions")
    run, Fields = form.run, form.fields
    Piece = make_struct(f"Piece_{Fields.key}", {"L": RowLayout, "F": Fields})
    pieces = wp.array(dtype=Piece)

    if form.quads:

        def from_memory(args: pieces):
            P = args[0]
            q = task_of(P.L, wp.tid())
            run(P.L, P.F, q[0], q[1], q[2], 1)
    else:

        def from_memory(args: pieces):
            i, j, c = wp.tid()
            P = args[0]
            if i < (P.L.planes + P.L.slab - 1) // P.L.slab and j < P.L.rows and c < P.L.chunks:
                run(P.L, P.F, i, j, c, 1)

    name = form.declared.name.rpartition(".")[2]
    from_memory.__name__ = from_memory.__qualname__ = name
    words = "_".join([form.declared.name, *form.words])
    options = {"launch_bounds": BLOCKS_OF_QUADS} if form.quads else {}
    return Piece, forward_kernel(module=f"{run.module.name}.memory.{words}", **options)(from_memory)


_KERNELS: dict[tuple[wp.Kernel, int], tuple[DataType, wp.Kernel]] = {}


def kernel_from_memory(kernel: wp.Kernel, sized: int) -> tuple[DataType, wp.Kernel]:
    """Return the struct of a Warp kernel's arguments, and a kernel that reads it.

    That kernel takes an array of one such struct instead of arguments.

    Args:
        kernel: the kernel.
        sized: dimensions of a launch whose threads beyond the number of tasks return at once, see
            `launch_ranges`; 0: none do.
    """
    if (kernel, sized) not in _KERNELS:
        _KERNELS[kernel, sized] = _compiled_from_memory(kernel, sized)
    return _KERNELS[kernel, sized]


def _compiled_from_memory(kernel: wp.Kernel, sized: int) -> tuple[DataType, wp.Kernel]:
    name = kernel.key.replace("__", "_")
    members = {FIRST: wp.int64} | {arg.label: arg.type for arg in kernel.adj.args}
    Given = make_struct(f"Given_{kernel.module.name.replace('.', '_')}_{name}", members)
    tree = ast.parse(kernel.adj.source)
    made = tree.body[0]
    before = [f"{arg.label} = given_[0].{arg.label}" for arg in kernel.adj.args]
    if sized:
        before.insert(0, BEYOND[sized].format(kernel.adj.args[0].label))
    made.body = [*ast.parse("\n".join(before)).body, *made.body]
    made.decorator_list, made.args.args = [], [ast.arg("given_")]
    old = inspect.unwrap(kernel.func)
    function = types.FunctionType(old.__code__, old.__globals__, old.__name__, (), old.__closure__)
    function.__qualname__, function.__module__ = old.__qualname__, old.__module__
    kind = wp.array(dtype=Given)
    function.__signature__ = inspect.Signature(
        [inspect.Parameter("given_", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=kind)]
    )
    function.__annotations__ = {"given_": kind}
    module = wp.get_module(f"{kernel.module.name}.memory.{name}{'_sized' * bool(sized)}")
    return Given, wp.Kernel(
        function, kernel.key, module, {"enable_backward": False}, source=ast.unparse(tree)
    )


class DeviceGraph(CommandBuffer):
    """Recorded launches on a CUDA device, whose arguments are patched in each run.

    Args:
        device: the device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        # Arguments of `_add`, each with its command and its place.
        self._pieces: list[tuple[int, wp.Kernel, DataType, tuple[int, ...], bytes, int, int]] = []
        self._patches: list[tuple[int, int, int]] = []
        self._bytes = 0
        # Memory of rows, and the launch dimensions that have been captured.
        self._extents: list[tuple[LaunchDimensions, tuple[int, ...]]] = []
        self._buffer: np.ndarray | None = None
        self._copied: wp.Event | None = None  # event after which the buffer may be written

    def record(self, what: "Command | Callable[[], object]") -> None:
        """Record a launch, a copy or a conditional.

        Raises:
            NotRecordable: it is a task of the host, or a copy of an array that is replaced.
        """
        if isinstance(what, DeviceCopy):
            if any(slot_of(array) is not None for array in (what.to, what.source)):
                raise NotRecordableError("a copy of an array that is replaced")
        elif isinstance(what, (HostTask, Operation)) or callable(what):
            raise NotRecordableError("a task of the host")
        super().record(what)

    def extend(self, other: CommandBuffer) -> None:
        """Append the launches of a program with fixed arguments."""
        for command in other._commands:
            self.record(command)
        self._arguments += other._arguments

    def launch(
        self,
        kernel: wp.Kernel,
        dim: Dimensions,
        inputs: Sequence[KernelArgument],
        *,
        device: wp.Device,
        block_dim: int = 256,
    ) -> None:
        """Record a launch; numbers may be `Scalar`."""
        dims = tuple(dim) if isinstance(dim, Sequence) else (dim,)
        self._record_kernel(kernel, dims, inputs, (), 0, sized=0, block_dim=block_dim)

    def record_tasks(
        self,
        kernel: wp.Kernel,
        dim: tuple[int, ...],
        inputs: Sequence[KernelArgument],
        first: Patch | None,
        sized: int,
        extent: LaunchDimensions | None,
    ) -> None:
        """Record a kernel launch with ranges of tasks.

        Arguments as of `launch_ranges`.
        """
        if extent is None or not sized:
            self._record_kernel(kernel, dim, inputs, (), 0, sized=0)
            return
        room = self._register_dimensions(extent)
        self._record_kernel(
            kernel, room[-len(dim) :], inputs, (first,) if first else (), sized, sized=len(dim)
        )

    def record_pass(self, bound: BoundKernel) -> None:
        """Record the launch of a stencil kernel."""
        patches, layout = bound.patches(), bound.layout
        if not patches:
            if 0 not in threads(layout):
                super().launch(
                    bound.form.kernel,
                    bound.form.dim(layout),
                    [layout, bound.fields],
                    device=self.device,
                )
            return
        struct, kernel = pass_from_memory(bound.form)
        room = (
            bound.form.dim(layout)
            if bound.rows.memory is None
            else self._register_dimensions(bound.rows.memory)
        )
        memory = bytes(native_of(layout)).ljust(LAYOUT_BYTES, b"\0") + bound.arguments
        self._add(kernel, struct, room, memory, patches, bound)

    def _register_dimensions(self, memory: LaunchDimensions) -> tuple[int, ...]:
        """Return the launch dimensions for rows in memory.

        `fits` compares them with those of a later run.
        """
        self._extents.append((memory, memory.room))
        return memory.room

    def _record_kernel(
        self,
        kernel: wp.Kernel,
        dim: tuple[int, ...],
        inputs: Sequence[KernelArgument],
        first: tuple[Patch, ...],
        tasks: int,
        *,
        sized: int,
        block_dim: int = 256,
    ) -> None:
        changing = any(type(v) is Scalar or slot_of(v) is not None for v in inputs)
        if not (changing or first or sized):
            super().launch(kernel, dim, inputs, device=self.device, block_dim=block_dim)
            return
        struct, compiled = kernel_from_memory(kernel, sized)
        arguments = struct()
        for arg, value in zip(kernel.adj.args, inputs, strict=True):
            setattr(arguments, arg.label, value_of(value))  # Warp checks the type
        native, patches = type(native_of(arguments)), []
        if first:
            offset, address, size = first[0]
            patches.append((offset_of(native, kernel.adj.args[0].label) + offset, address, size))
        if sized:
            patches.append((offset_of(native, FIRST), tasks, 8))
        for arg, value in zip(kernel.adj.args, inputs, strict=True):
            offset = offset_of(native, arg.label)
            if type(value) is Scalar:
                patches.append((offset, *value.address(arg.type)))
            elif (slot := slot_of(value)) is not None:
                patches.append((offset, slot.address, ARRAY_BYTES))
        self._add(
            compiled,
            struct,
            dim,
            bytes(native_of(arguments)),
            patches,
            (arguments, inputs),
            block_dim,
        )

    def _add(
        self,
        kernel: wp.Kernel,
        struct: DataType,
        dim: tuple[int, ...],
        memory: bytes,
        patches: list[Patch],
        keep_alive: object,
        block_dim: int = 256,
    ) -> None:
        at = self._bytes
        self._bytes += -(-len(memory) // ALIGNED) * ALIGNED
        self._patches += [(at + offset, address, size) for offset, address, size in patches]
        self._arguments.append(keep_alive)
        self._pieces.append(
            (len(self._commands), kernel, struct, tuple(dim), memory, at, block_dim)
        )
        self._commands.append(None)

    def finish(self) -> None:
        """Allocate the image, and create the launches that read from it."""
        if not self._pieces:
            return
        host = np.zeros(self._bytes, dtype=np.uint8)
        for *_, memory, at, _ in self._pieces:
            host[at : at + len(memory)] = np.frombuffer(memory, dtype=np.uint8)
        image = wp.array(host, device=self.device)
        self._arguments.append(image)
        for which, kernel, struct, dim, _, at, block_dim in self._pieces:
            given = wp.array(ptr=image.ptr + at, dtype=struct, shape=1, device=self.device)
            self._arguments.append(given)
            made = wp.launch(
                kernel, dim, [given], device=self.device, block_dim=block_dim, record_cmd=True
            )
            self._commands[which] = made
        self._prepare_patches(image)

    def _prepare_patches(self, image: DeviceArray) -> None:
        """Create the buffer of changing arguments, its copy, and the patch launch.

        The launch writes the bytes to the image.
        """
        places: dict[tuple[int, int], int] = {}
        size, source, place = 0, [], []
        for at, address, count in self._patches:
            if (address, count) not in places:
                places[address, count] = size
                size += count
            begin = places[address, count]
            source.append(np.arange(begin, begin + count))
            place.append(np.arange(at, at + count))
        self._sources = [(begin, address, count) for (address, count), begin in places.items()]
        pinned = wp.zeros(size, dtype=wp.uint8, device="cpu", pinned=wp.is_cuda_available())
        cells = wp.zeros(size, dtype=wp.uint8, device=self.device)
        self._pinned, self._buffer = pinned, np.zeros(size, dtype=np.uint8)
        lists = [
            wp.array(np.concatenate(numbers).astype(np.int32), dtype=wp.int32, device=self.device)
            for numbers in (source, place)
        ]
        inputs = [cells, *lists, image]
        self._arguments += [inputs, pinned]
        made = wp.launch(patch_kernel, len(lists[0]), inputs, device=self.device, record_cmd=True)
        self._commands[:0] = [DeviceCopy(cells, pinned), made]

    def fits(self) -> bool:
        """Return whether all rows need at most the captured threads."""
        return all(
            e <= r
            for memory, room in self._extents
            for e, r in zip(memory.extent, room, strict=True)
        )

    @property
    def commands(self) -> list[Command]:
        """Commands of the program's graph, in order."""
        return self._commands

    def captured(self, commands: list[Command]) -> wp.Graph:
        """Capture some launches and return their graph."""
        return self._captured(commands)

    def run(self) -> None:
        """Launch the graph, or queue it to be joined with others, see `joined_graphs.py`.

        The first run launches kernel by kernel, which loads the kernels.
        """
        settle(self)  # in case its buffer is still queued
        if self._buffer is not None:
            self._refresh()
        if not queue_stretch(self):
            self.launch_now()

    def launch_now(self) -> None:
        """Launch the graph with the arguments in its buffer.

        New loops launch a graph of their own.
        """
        if self._runs:
            super().run()
        else:
            for command in self._commands:
                if isinstance(command, Loop):
                    command.program.run_while(command.condition)
                else:
                    command.launch()
            self._runs = 1
        self._note_copy()

    def note_launch(self) -> None:
        """Note that a joined graph has launched it."""
        self._runs += 1
        self._note_copy()

    def _note_copy(self) -> None:
        if self._buffer is not None:
            self._copied = record_event(self.device, self._copied)

    def _refresh(self) -> None:
        """Write changed arguments to the pinned buffer.

        It waits until the copy of an earlier run has read the buffer.
        """
        address = self._buffer.ctypes.data
        for begin, source, count in self._sources:
            ctypes.memmove(address + begin, source, count)
        view = host_view(self._pinned)
        if self._runs and np.array_equal(view, self._buffer):
            return
        if self._copied is not None:
            wp.synchronize_event(self._copied)
        view[:] = self._buffer


class Upload(DeviceGraph):
    """Copy of a host array to the device, launched as a recorded stretch.

    An unchanged array is not copied.

    Args:
        host: NumPy array, read in each run.
        array: of the same bytes, on the device; nothing else writes to it.
    """

    def __init__(self, host: np.ndarray, array: DeviceArray) -> None:
        super().__init__(array.device)
        size = host.nbytes
        self._pinned = wp.zeros(size, dtype=wp.uint8, device="cpu", pinned=wp.is_cuda_available())
        self._buffer, self._sources = np.zeros(size, dtype=np.uint8), [(0, host.ctypes.data, size)]
        target = wp.array(ptr=array.ptr, dtype=wp.uint8, shape=size, device=array.device)
        self._arguments += [host, array, target, self._pinned]
        self._commands = [DeviceCopy(target, self._pinned)]
        self._sent = False

    @property
    def has_run(self) -> bool:
        """Return True: there are no kernels to load."""
        return True

    def run(self) -> None:
        """Launch or queue the copy, if the host's array has changed."""
        address = self._sources[0][1]
        if self._sent and np.array_equal(
            self._buffer,
            np.frombuffer((ctypes.c_uint8 * len(self._buffer)).from_address(address), np.uint8),
        ):
            return
        self._sent = True
        super().run()


def record_event(device: wp.Device, event: wp.Event | None) -> wp.Event | None:
    """Record an event behind all launches so far, and return it."""
    return wp.get_stream(device).record_event(event) if device.is_cuda else None


def host_view(pinned: DeviceArray) -> np.ndarray:
    """Return a view of host memory as a writable array."""
    return np.frombuffer((ctypes.c_uint8 * pinned.size).from_address(pinned.ptr), dtype=np.uint8)
