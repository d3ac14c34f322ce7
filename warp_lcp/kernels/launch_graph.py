"""Launches that are recorded once and repeated.

On the CPU a thread pool executes them in native code; on CUDA they form a graph.
"""

from __future__ import annotations

import ctypes
import math
import os
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from types import MethodType
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeAlias, cast

import numpy as np
import warp as wp

from warp_lcp.deadline import check_time, is_collective
from warp_lcp.kernels.layout import offset_of
from warp_lcp.kernels.recorded_arguments import (
    ARRAY_BYTES,
    KernelArgument,
    LaunchDimensions,
    Scalar,
    slot_of,
    value_of,
)
from warp_lcp.kernels.thread_pool import (
    ALONE,
    CELLS,
    Operation,
    OperationKind,
    OperationTable,
    Patch,
    copied,
    get_threads,
    prepared,
    ranges,
    team,
)
from warp_lcp.kernels.types import DeviceArray, Dimensions

if TYPE_CHECKING:
    from warp_lcp.kernels.device_graph import DeviceGraph
    from warp_lcp.kernels.vectors import Communicator


class _Recording(threading.local):
    """The program that records this thread's launches; None if they are executed."""

    program: CommandBuffer | None = None


RECORDING = _Recording()


def is_recording() -> bool:
    """Return whether this thread's launches are recorded."""
    return RECORDING.program is not None


@contextmanager
def recording(program: CommandBuffer) -> Iterator[None]:
    """Record this thread's launches by `warp_lcp.kernels` instead of executing them."""
    before, RECORDING.program = RECORDING.program, program
    try:
        yield
    finally:
        RECORDING.program = before


def loops_on_device(device: wp.Device) -> bool:
    """Return whether loops run on the device, without the host.

    The thread pool runs them on the CPU; CUDA needs driver 12.4.
    """
    return bool(wp.is_conditional_graph_supported()) if device.is_cuda else team() is not None


def program_of(launch: Launch | None) -> CommandBuffer | None:
    """Return the program whose `launch` a function is; None if it launches at once."""
    recorder = launch.__self__ if isinstance(launch, MethodType) else None
    return recorder if isinstance(recorder, CommandBuffer) else None


def device_program(launch: Launch | None = None) -> DeviceGraph | None:
    """Return the `DeviceGraph` that records this thread's launches.

    Returns None if there is none, or if `launch` records.
    """
    program = RECORDING.program
    if program is None or not program.device.is_cuda or program_of(launch) is not None:
        return None
    return cast("DeviceGraph", program)  # all programs on CUDA that record are


class Launch(Protocol):
    """Launch function: launches a kernel now, or records it.

    `wp.launch` does the first, `CommandBuffer.launch` the second.
    """

    def __call__(
        self,
        kernel: wp.Kernel,
        dim: Dimensions,
        inputs: Sequence[KernelArgument],
        *,
        device: wp.Device,
        block_dim: int = ...,
    ) -> wp.Launch | None:
        """Launch the kernel now, or record its launch."""


def launch_now(
    kernel: wp.Kernel,
    dim: Dimensions,
    inputs: Sequence[KernelArgument],
    *,
    device: wp.Device,
    **options: int,
) -> wp.Launch | None:
    """Launch a kernel by Warp at once.

    A default argument that held `wp.launch` itself would bypass queued stretches, see
    `joined_graphs.py`.
    """
    return wp.launch(kernel, dim, inputs, device=device, **options)


def launch_graph(graph: wp.Graph) -> None:
    """Launch a captured graph by Warp.

    As with `launch_now`, no default argument holds Warp's function.
    """
    wp.capture_launch(graph)


@dataclass(frozen=True)
class HostTask:
    """A task of the host between launches, such as a halo exchange.

    Args:
        function: performs it.
        operation: creates an operation of the thread pool that replaces it on the CPU; None: there
            is no such operation.
    """

    function: Callable[[], object]
    operation: Callable[[], Operation] | None = None

    def launch(self, launch: Launch = launch_now) -> None:
        """Perform the task now, or record it between the launches."""
        recorded = (is_recording() or program_of(launch) is not None) and team() is not None
        perform(self.operation() if recorded and self.operation else self.function, launch)


@dataclass(frozen=True)
class Conditional:
    """A program that is launched if a number on the device is not 0.

    A graph or the thread pool decides, without the host.
    """

    condition: DeviceArray
    program: CommandBuffer

    def launch(self) -> None:
        """Launch it, or record it in the graph that is being captured."""
        wp.capture_if(self.condition, self.program._launch)


@dataclass(frozen=True)
class Loop:
    """A CUDA program repeated in a graph while a number on the device is not 0."""

    condition: DeviceArray
    program: CommandBuffer

    def launch(self) -> None:
        """Repeat it now, or record the loop in the graph that is being captured."""
        wp.capture_while(self.condition, self.program._launch)


def perform(what: Callable[[], object] | Operation, launch: Launch) -> None:
    """Call a function or run an operation of the thread pool, or record it.

    It runs at once if `launch` launches at once.
    """
    program = program_of(launch)
    if program is None:
        program = RECORDING.program
    if program is not None:
        program.record(what)
    elif isinstance(what, Operation):
        run_table(OperationTable([what]))
    else:
        what()


@contextmanager
def together(device: wp.Device) -> Iterator[Launch]:
    """Yield a launch function that records one table for the thread pool.

    The table runs at the end of the block. On CUDA the function launches at once or records a
    graph.
    """
    if device.is_cuda or team() is None:
        yield launch
        return
    program = CommandBuffer(device)
    yield program.launch
    program.run()


@contextmanager
def as_one_table(device: wp.Device, comm: Communicator | None = None) -> Iterator[None]:
    """Record the launches of a `with` block as one table for the thread pool.

    The table runs at the end of the block. Nothing may be read from the device within. Launches run
    at once on CUDA, and where `comm` is a communicator of several ranks.
    """
    if device.is_cuda or comm is not None or is_recording() or team() is None:
        yield
        return
    program = CommandBuffer(device)
    with recording(program):
        yield
    program.run()


def run_table(table: OperationTable) -> None:
    """Execute a table in the thread pool."""
    at_work = team()
    assert at_work is not None, "a table is made for a team"
    at_work.run(table)


def _run_while(condition: np.ndarray, table: OperationTable) -> None:
    """Repeat a table in the thread pool, unless its condition is 0 at the start."""
    if condition[0]:
        run_table(table)


def launch_ranges(
    kernel: wp.Kernel,
    dim: tuple[int, ...],
    cells: int,
    inputs: Sequence[KernelArgument],
    *,
    device: wp.Device,
    launch: Launch | None,
    ordered: bool,
    first: Patch | None = None,
    sized: int = 0,
    extent: LaunchDimensions | None = None,
) -> None:
    """Launch or record a kernel whose first argument begins with a range of tasks.

    A thread takes such a range.

    Args:
        kernel: with as many coordinates of a thread as `dim` has.
        dim: of the launch where there is no such range.
        cells: cost of a task, in cells of a usual kernel.
        inputs: arguments; numbers may be `Scalar`.
        device: of the launch.
        launch: of a program; None: now.
        ordered: whether tasks write what others read or write.
        first: patches of the first argument, which recorded launches read from memory.
        sized: address of the number of tasks then; 0: that of `dim`.
        extent: memory whose `room` bounds the launch dimensions on CUDA; None: they are always
            `dim`.
    """
    if device.is_cuda and (program := device_program(launch)) is not None:
        program.record_tasks(kernel, dim, inputs, first, sized, extent)
        return
    tasks, recorded = math.prod(dim), launch is None and is_recording()
    if (
        device.is_cuda
        or team() is None
        or (launch is None and not recorded and tasks * cells < 4 * CELLS)
    ):
        (launch or wp.launch)(kernel, dim, [value_of(v) for v in inputs], device=device)
    elif tasks or (recorded and sized):
        entry, arguments, native = prepared(kernel, (1,) * len(dim), [value_of(v) for v in inputs])
        patches = (
            [*([first] if first else ()), *_patches(inputs, kernel, native)] if recorded else ()
        )
        stage = OperationKind(
            entry,
            arguments,
            (inputs, extent),
            tasks // dim[0] if dim[0] else 0,
            dim[0],
            patches=patches,
        )
        perform(
            ranges(stage, cells, ordered=ordered, sized=sized if recorded else 0),
            launch or wp.launch,
        )


def _patches(
    inputs: Sequence[KernelArgument], kernel: wp.Kernel, native: type[ctypes.Structure]
) -> Iterator[Patch]:
    """Yield the kernel arguments that are read from memory in each run.

    They are numbers and replaceable arrays; the arguments are a struct in C.
    """
    for i, value in enumerate(inputs):
        if type(value) is Scalar:
            yield offset_of(native, f"p{i}"), *value.address(kernel.adj.args[i].type)
        elif (slot := slot_of(value)) is not None:
            yield offset_of(native, f"p{i}"), slot.address, ARRAY_BYTES


def _alone(kernel: wp.Kernel, dim: Dimensions, inputs: Sequence[KernelArgument]) -> Operation:
    """Return a CPU kernel launch as an operation that is not cut."""
    entry, arguments, native = prepared(kernel, dim, [value_of(v) for v in inputs])
    return Operation(
        ALONE,
        [OperationKind(entry, arguments, inputs, patches=list(_patches(inputs, kernel, native)))],
    )


def launch(
    kernel: wp.Kernel,
    dim: Dimensions,
    inputs: Sequence[KernelArgument],
    *,
    device: wp.Device,
    block_dim: int = 256,
) -> None:
    """Launch a Warp kernel, now or among recorded launches; numbers may be `Scalar`."""
    program = RECORDING.program
    if program is None and device.is_cpu and team() is not None:
        run_table(OperationTable([_alone(kernel, dim, inputs)]))
    elif program is None:
        wp.launch(kernel, dim, [value_of(v) for v in inputs], device=device, block_dim=block_dim)
    else:
        program.launch(kernel, dim, inputs, device=device, block_dim=block_dim)


def copy(to: DeviceArray, source: DeviceArray) -> None:
    """Copy an array to another one of the same type and size, now or recorded.

    Both are contiguous.
    """
    program = RECORDING.program
    if program is None:
        wp.copy(to, source)
    elif program.device.is_cuda:
        program.record(DeviceCopy(to, source))
    else:
        program.record(copied(to.ptr, source.ptr, _bytes_of(to), (to, source)))


def clear(*arrays: DeviceArray) -> None:
    """Set contiguous arrays to 0, now or among recorded launches."""
    program = RECORDING.program
    for array in arrays:
        if program is None:
            array.zero_()
        elif array.size and program.device.is_cuda:
            program.record(DeviceCopy(array, None))
        elif array.size:
            program.record(copied(array.ptr, 0, _bytes_of(array), array))


@dataclass(frozen=True)
class DeviceCopy:
    """Copy or clearing of an array on CUDA: a node of a graph."""

    to: DeviceArray
    source: DeviceArray | None

    def launch(self) -> None:
        """Copy now, or while a graph is captured."""
        if self.source is None:
            self.to.zero_()
        else:
            wp.copy(self.to, self.source)


@dataclass(frozen=True)
class DeviceCall:
    """Launches by a function of Warp on CUDA, as a sort or a scan: graph nodes."""

    function: Callable[[], object]

    def launch(self) -> None:
        """Call the function now, or while a graph is captured."""
        self.function()


def call(function: Callable[[], object]) -> None:
    """Call a function of Warp that launches on CUDA, now or recorded."""
    program = RECORDING.program
    function() if program is None else program.record(DeviceCall(function))


def _bytes_of(array: DeviceArray) -> int:
    return int(array.size * wp.types.type_size_in_bytes(array.dtype))


Command: TypeAlias = (
    "wp.Launch | Operation | HostTask | Conditional | Loop | DeviceCopy | DeviceCall"
)
"""Entry of a program: a launch, or what stands between launches."""


def _only_operations(commands: Sequence[Command]) -> list[Operation]:
    """Return commands that are all operations of the thread pool."""
    operations = [command for command in commands if isinstance(command, Operation)]
    assert len(operations) == len(commands), "launches among operations of the thread pool"
    return operations


def _launch_alone(command: Command) -> None:
    """Launch a command now, or while a graph is captured."""
    assert not isinstance(command, Operation), "the thread pool executes operations"
    command.launch()


class CommandBuffer:
    """A sequence of kernel launches with fixed arguments.

    Functions that launch take `launch: Launch = launch_now`; given `program.launch`, they record
    instead. On the CPU the thread pool executes a table of them. On CUDA a graph is captured once
    the first run has loaded every kernel. Where the host has tasks between launches, see `perform`,
    there is a table or a graph for each stretch between them.

    Args:
        device: where the kernels run.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._commands: list[Command] = []
        self._arguments: list[object] = []  # a recorded launch holds addresses only
        self._runs = 0
        self._stretches: list[Callable[[], object]] | None = None
        # Launch functions of loops' graphs, by the address of the condition.
        self._loops: dict[int, Callable[[], object]] = {}
        self._native: bool | None = None  # None: not determined yet

    def __len__(self) -> int:
        """Return the number of launches."""
        return len(self._commands)

    def launch(
        self,
        kernel: wp.Kernel,
        dim: Dimensions,
        inputs: Sequence[KernelArgument],
        *,
        device: wp.Device,
        block_dim: int = 256,
    ) -> None:
        """Record a launch, and keep its arguments alive.

        Numbers may be `Scalar` on the CPU.
        """
        self._arguments.append(inputs)
        if self.device.is_cuda or team() is None:
            listed = [value_of(v) for v in inputs]
            self.record(
                wp.launch(kernel, dim, listed, device=device, block_dim=block_dim, record_cmd=True)
            )
        else:
            self.record(_alone(kernel, dim, inputs))

    def record(self, what: Command | Callable[[], object]) -> None:
        """Record a launch, an operation, a host task or a conditional.

        An operation belongs to the thread pool; conditionals need loops on the device.
        """
        if isinstance(what, Conditional) and not self.device.is_cuda:
            self._arguments.append(what)
            self._commands += [
                operation.only_if(what.condition) for operation in what.program._operations()
            ]
        else:
            self._commands.append(HostTask(what) if callable(what) else what)
        self._forget_prepared()

    def _operations(self) -> list[Operation]:
        """Return the commands; the thread pool executes all of them."""
        return _only_operations(self._commands)

    def _forget_prepared(self) -> None:
        """Discard the prepared tables and graphs after new commands."""
        self._stretches = self._native = None
        self._loops.clear()

    @property
    def is_native(self) -> bool:
        """Whether the thread pool executes all of it."""
        if self._native is None:
            self._native = all(isinstance(command, Operation) for command in self._commands)
        return self._native

    def fits(self) -> bool:
        """Return whether the launches have room for the present rows."""
        return True

    @property
    def has_run(self) -> bool:
        """Whether all of its kernels are loaded.

        They are after a run, and on the CPU after recording.
        """
        return self._runs > 0 or not self.device.is_cuda

    def extend(self, other: CommandBuffer) -> None:
        """Append the launches of another program."""
        self._commands += other._commands
        self._arguments += other._arguments
        self._forget_prepared()

    def run(self) -> None:
        """Launch everything once, or record it among the launches of another program."""
        if RECORDING.program is not None:
            RECORDING.program.extend(self)
            return
        if self._stretches is None and self.device.is_cuda and self._runs == 0:
            self._launch()
        else:
            if self._stretches is None:
                self._stretches = self._prepared()
            for stretch in self._stretches:
                stretch()
        self._runs += 1

    def run_while(self, condition: DeviceArray) -> None:
        """Repeat all launches while the condition is not 0; the launches update it.

        Where loops run on the device, control does not return to the host: on CUDA, all but the
        first call are one graph, and return before it has ended; on the CPU, the thread pool checks
        for signals and the deadline. Ranks must find the same condition; they repeat the launches
        without the host unless they have a deadline, which they check together.

        Args:
            condition: shape (1,), wp.int32.
        """
        if RECORDING.program is not None and self.device.is_cuda:
            RECORDING.program.record(Loop(condition, self))
        elif self._loops_here():
            self._loop(condition)
        elif self.device.is_cuda and loops_on_device(self.device) and not self._has_tasks:
            wp.capture_if(condition, self._run_in_time)  # single launches, which load the kernels
            if self._runs:
                self._loop(condition)
        else:
            wp.capture_while(condition, self._run_in_time)

    def _loop(self, condition: DeviceArray) -> None:
        """Repeat all launches on the device while the condition is not 0."""
        if condition.ptr not in self._loops:
            self._loops[condition.ptr] = self._captured_loop(condition)
        self._loops[condition.ptr]()

    def _loops_here(self) -> bool:
        """Return whether `run_while` can run without the host now."""
        if not self.device.is_cuda and team() is not None:
            return self.is_native and not is_collective()
        if self._has_tasks or not loops_on_device(self.device):
            return False
        return self._runs > 0  # the first run loads the kernels

    def _captured_loop(self, condition: DeviceArray) -> Callable[[], object]:
        """Return a function that repeats the launches.

        It launches a graph, or runs a table in the thread pool.
        """
        if not self.device.is_cuda and team() is not None:
            return partial(
                _run_while, condition.numpy(), OperationTable(self._operations(), condition)
            )
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            wp.capture_while(condition, self._launch)
        return partial(launch_graph, capture.graph)

    def _run_in_time(self) -> None:
        check_time()
        self.run()

    @property
    def _has_tasks(self) -> bool:
        return any(isinstance(command, HostTask) for command in self._commands)

    def _prepared(self) -> list[Callable[[], object]]:
        """Return the stretches between host tasks, and the tasks.

        A stretch is a graph, a table or its launches.
        """
        functions: list[Callable[[], object]] = []
        for is_task, group in groupby(
            self._commands, lambda command: isinstance(command, HostTask)
        ):
            stretch = list(group)
            if is_task:
                functions += [task.function for task in stretch if isinstance(task, HostTask)]
            elif self.device.is_cuda:
                functions.append(partial(launch_graph, self._captured(stretch)))
            elif all(isinstance(command, Operation) for command in stretch):
                functions.append(partial(run_table, OperationTable(_only_operations(stretch))))
            else:
                functions += [partial(_launch_alone, command) for command in stretch]
        return functions

    def _captured(self, commands: Sequence[Command]) -> wp.Graph:
        """Capture some launches and return their graph."""
        with wp.ScopedCapture(device=self.device, force_module_load=False) as capture:
            for command in commands:
                _launch_alone(command)
        return capture.graph

    def _launch(self) -> None:
        for command in self._commands:
            _launch_alone(command)

    def differs(self, other: CommandBuffer) -> str:
        """Return where operations differ from another program's; "" if nowhere.

        Arguments that are read from memory may differ.
        """
        if len(self._commands) != len(other._commands):
            return f"{len(self._commands)} operations, {len(other._commands)} before"
        for at, (mine, its) in enumerate(zip(self._commands, other._commands, strict=True)):
            if (
                isinstance(mine, Operation)
                and isinstance(its, Operation)
                and mine.content() != its.content()
            ):
                return f"operation {at}: {mine.name()}, {its.name()} before"
        return ""


class KeyedArgument:
    """Argument of recorded launches that others replace: recordings know it by its key."""

    @property
    def identity(self) -> Hashable:
        """The key; arguments of equal keys share a recording."""
        raise NotImplementedError


def _identity(argument: object) -> Hashable:
    """Return the identity of an argument in a recording.

    An array is known by its address, unless it is replaceable; a list by its elements.
    """
    if isinstance(argument, wp.array):
        slot = slot_of(argument)
        return (argument.ptr, argument.shape) if slot is None else slot.address
    if isinstance(argument, (list, tuple)):
        return tuple(map(_identity, argument))
    if isinstance(argument, dict):
        return tuple((name, _identity(value)) for name, value in argument.items())
    return argument.identity if isinstance(argument, KeyedArgument) else argument


MOST_RECORDED = 32  # recordings of a graph


class NotRecordableError(Exception):
    """A command that a CUDA graph cannot hold.

    It is a task of the host, or a copy of a replaced array.
    """


class LaunchGraph:
    """Recorded launches of a part of a step, between two decisions of the host.

    They are recorded in the first run; on the CPU, later runs are one native call. On CUDA it is
    one graph, see `device_graph.py`, if `on_device` is set. Otherwise, and where launches must go
    through Warp, `record` is called in each run.

    Args:
        device: where the kernels run.
        record: launches by `warp_lcp.kernels` what is to be recorded: kernels, `copy`, `clear`. It
            must not read from the device, nor decide anything by what changes from run to run:
            `Scalar`, `ActiveWindow` and lists stand for that.
        at_once: whether to launch in each run instead.
    """

    # Whether CUDA graphs are captured. They have not been run on a GPU yet.
    on_device: ClassVar[bool] = os.environ.get("WARP_LCP_STEP_GRAPHS") == "1"
    # Creates the recording of a device: `device_graph.DeviceGraph`, set by `warp_lcp.kernels`.
    device_program: ClassVar[type[DeviceGraph]]
    # For tests: each run records again and compares with the first recording.
    verify: ClassVar[bool] = False

    def __init__(
        self, device: wp.Device, record: Callable[..., None], *, at_once: bool = False
    ) -> None:
        self.device, self._record, self.at_once = device, record, at_once
        self._programs: dict[Hashable, CommandBuffer] = {}
        self._threads = 0

    def run(self, *arguments: object, variant: Hashable = None) -> None:
        """Launch everything, or record it in the program that is being recorded.

        Args:
            arguments: of `record`. Other arrays or objects get recordings of their own.
            variant: key of further decisions of `record` about what it launches; each variant is
                recorded once.
        """
        if (
            self.at_once
            or RECORDING.program is not None
            or not (self.on_device if self.device.is_cuda else team())
        ):
            self._record(*arguments)
            return
        if not self.device.is_cuda and self._threads != get_threads():
            self._programs, self._threads = {}, get_threads()
        key = (variant, *map(_identity, arguments))
        program = self._programs.get(key)
        if program is None or not program.fits():
            if len(self._programs) >= MOST_RECORDED:
                self._programs.clear()
            program = self._recorded(arguments)
            if program is None:  # a CUDA graph cannot hold it
                self.at_once = True
                self._record(*arguments)
                return
            self._programs[key] = program
        elif LaunchGraph.verify and not self.device.is_cuda:
            other = self._recorded(arguments)
            assert other is not None
            if difference := other.differs(program):
                raise AssertionError(f"a recorded launch differs: {difference}")
        program.run()

    def forget(self) -> None:
        """Record again in the next run, because arrays have been replaced."""
        self._programs = {}

    def _recorded(self, arguments: tuple[object, ...]) -> CommandBuffer | None:
        """Return the program of some arguments.

        Returns None where a CUDA graph cannot hold it, so that it is launched in each run.
        """
        if not self.device.is_cuda:
            program = CommandBuffer(self.device)
            with recording(program):
                self._record(*arguments)
            return program
        on_device = LaunchGraph.device_program(self.device)
        try:
            with recording(on_device):
                self._record(*arguments)
        except NotRecordableError:
            return None
        on_device.finish()
        return on_device
