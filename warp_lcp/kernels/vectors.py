"""Flat fields: conversions, inner products, deterministic sums.

They are the only vector primitives that the solvers use. Every operator stores its fields as flat
arrays (see `warp_lcp.kernels.fields`), so that these serve all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar, no_type_check

import numpy as np
import warp as wp

from warp_lcp.kernels import Rows, StencilKernel
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.fields import zeros
from warp_lcp.kernels.header_text import HEADERS, text
from warp_lcp.kernels.kernel_file import KernelFile
from warp_lcp.kernels.launch_graph import (
    HostTask,
    Launch,
    as_one_table,
    copy,
    is_recording,
    launch_now,
    program_of,
)
from warp_lcp.kernels.launch_graph import launch as launch_recorded
from warp_lcp.kernels.layout import BoundOperands, KernelStencil
from warp_lcp.kernels.readback import DeviceScalar
from warp_lcp.kernels.recorded_arguments import DeviceRows, KernelArgument, Scalar, value_of
from warp_lcp.kernels.thread_pool import Operation
from warp_lcp.kernels.types import DeviceArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Entries = TypeVar("Entries", float, np.ndarray)
CUDA_BLOCK = 256  # threads that add up partial sums
CUDA_SEGMENTS = 256  # blocks of the first stage of a sum of very many numbers
KERNELS = KernelFile(Path(__file__).parent / "headers/vectors.h")
DOT = KERNELS["vectors.dot"]
ADD = KERNELS["vectors.add"]
ADD_UP = KERNELS["vectors.add_up"]
CONVERT = KERNELS["vectors.convert"]


@wp.func_native("\n".join(["", text(HEADERS / "native.h"), text(KERNELS.path, "add_up"), ""]))
def add_up_span(
    partials: wp.array(dtype=wp.float64), offset: int, start: int, n: int, stride: int
) -> wp.float64:
    """Sum every stride-th partial sum, from `offset` + `start` on."""


@no_type_check
@forward_kernel(module="warp_lcp.vectors")
def add_up_kernel(
    partials: wp.array(dtype=wp.float64),
    before: int,
    n: int,
    threads: int,
    segments: int,
    out: wp.array(dtype=wp.float64),
    slot: int,
):
    """Sum every `segments`-th block of a column of n partial sums.

    out[slot + column * segments + segment] is the sum of blocks segment, segment + segments, ... of
    the column, computed by one block of threads. Columns are counted from the one after `before`
    others. The order of the additions does not change from run to run.
    """
    t = wp.tid()
    block = t // threads
    column = block // segments
    segment = block - column * segments
    s = add_up_span(
        partials,
        (before + column) * n,
        segment * threads + t - block * threads,
        n,
        threads * segments,
    )
    total = wp.tile_sum(wp.tile(s))
    if t == block * threads:
        out[slot + block] = total[0]


@no_type_check
@forward_kernel(module="warp_lcp.vectors")
def largest_kernel(
    partials: wp.array(dtype=wp.float64),
    before: int,
    n: int,
    threads: int,
    segments: int,
    out: wp.array(dtype=wp.float64),
    slot: int,
):
    """Return the largest partial result, like the function for sums."""
    t = wp.tid()
    block = t // threads
    column = block // segments
    segment = block - column * segments
    most = -wp.float64(wp.inf)
    for i in range(segment * threads + t - block * threads, n, threads * segments):
        most = wp.max(most, partials[(before + column) * n + i])
    total = wp.tile_max(wp.tile(most))
    if t == block * threads:
        out[slot + block] = total[0]


class Communicator(Protocol):
    """Communicator of a distributed problem: the ranks that share the unknowns.

    All methods are collective and return the same on all ranks.
    """

    def sum(self, values: Entries) -> Entries:
        """Return sums over all parts, entry by entry."""

    def sum_operation(self, sums: np.ndarray) -> Operation:
        """Return an operation that replaces float64 sums by those over all ranks.

        It works in place and runs in the thread pool.
        """

    def max(self, values: Entries) -> Entries:
        """Return the largest over all parts, entry by entry."""

    def min(self, values: Entries) -> Entries:
        """Return the smallest over all parts, entry by entry."""

    def any(self, condition: bool) -> bool:
        """Return whether a condition holds in some part."""

    def join(self, key: bytes) -> bytes:
        """Return a common key made of the keys of all parts."""


def segments_of(n: int) -> int:
    """Return how many GPU blocks add up a column first.

    One block would take long for very many partial sums.
    """
    return CUDA_SEGMENTS if n > CUDA_SEGMENTS * CUDA_BLOCK else 1


def fold(
    kernel: wp.Kernel,
    partials: wp.array[wp.float64],
    n: int | Scalar,
    columns: int,
    out: wp.array[wp.float64],
    slot: int,
    between: wp.array[wp.float64],
    launch: Launch = launch_now,
    most: int | None = None,
    before: int = 0,
) -> None:
    """Reduce columns of n partial results on CUDA, by a sum or a maximum.

    The results of the columns go to out[slot], out[slot + 1], ...

    Args:
        kernel: `add_up_kernel` or `largest_kernel`.
        partials: of one column after another.
        n: of each.
        columns: how many.
        out: receives a number a column.
        slot: of the first.
        between: memory of columns * segments_of(n) numbers, where these are more than the columns.
        launch: of a program.
        most: upper bound of n, where n is a `Scalar`.
        before: columns before the first that is reduced.
    """
    device, segments = partials.device, segments_of(int(value_of(n)) if most is None else most)
    launch = launch_recorded if is_recording() and program_of(launch) is None else launch
    if segments > 1:
        blocks = columns * segments * CUDA_BLOCK
        launch(
            kernel,
            blocks,
            [partials, before, n, CUDA_BLOCK, segments, between, 0],
            device=device,
            block_dim=CUDA_BLOCK,
        )
        partials, before, n = between, 0, segments
    launch(
        kernel,
        columns * CUDA_BLOCK,
        [partials, before, n, CUDA_BLOCK, 1, out, slot],
        device=device,
        block_dim=CUDA_BLOCK,
    )


class Reduction:
    """Sums over flat fields of n elements; the same bits in every run.

    Args:
        n: elements of a field.
        device: of the fields.
        scalars: device array that receives the sums, shape (slots,), float64.
        columns: the most sums that one kernel makes.
        threads: threads of that kernel; default: those of a flat kernel.
        comm: communicator of the other parts of the fields; None if serial.
    """

    def __init__(
        self,
        n: int,
        device: wp.Device,
        scalars: wp.array[wp.float64],
        *,
        columns: int = 1,
        threads: int | None = None,
        comm: Communicator | None = None,
    ) -> None:
        self.scalars, self.columns, self._comm = scalars, columns, comm
        self.threads = threads or Rows.flat(n, device).places
        self.partials = zeros(columns * self.threads, wp.float64, device)
        self._folded = zeros(
            columns * segments_of(self.threads) if device.is_cuda else 0, wp.float64, device
        )

    def add_up(self, slot: int, columns: int = 1, *, launch: Launch = launch_now) -> None:
        """Sum the first columns of partial sums to scalars[slot], scalars[slot + 1], ..."""
        device = self.partials.device
        if device.is_cpu:  # Warp's tiles do not support several CPU threads
            rows = Rows.flat(columns, device)
            ADD_UP.bind(
                rows, partials=self.partials, count=self.threads, scalars=self.scalars, slot=slot
            ).launch(launch)
        else:
            fold(
                add_up_kernel,
                self.partials,
                self.threads,
                columns,
                self.scalars,
                slot,
                self._folded,
                launch,
            )
        if self._comm is not None:
            sum_over_ranks(self._comm, self.scalars, slice(slot, slot + columns), launch)

    def dot(
        self,
        a: DeviceArray,
        b: DeviceArray,
        slot: int,
        *,
        rows: Rows | None = None,
        launch: Launch = launch_now,
    ) -> None:
        """Write the inner product a.b to scalars[slot], over some rows if passed."""
        DOT.bind(rows or rows_of(a), a=a, b=b, out=self.partials).launch(launch)
        self.add_up(slot, launch=launch)


class RowReduction(Reduction):
    """Sums of kernels over the same rows, read back by the host.

    Args:
        rows: of the kernels.
        columns: the most sums that one of them makes.
        slots: of `scalars`, if more than that.
        comm: communicator of the other parts of the fields; None if serial.
    """

    def __init__(
        self, rows: Rows, columns: int = 1, *, slots: int = 0, comm: Communicator | None = None
    ) -> None:
        self.rows, self.reading = rows, DeviceScalar(rows.device, max(columns, slots))
        super().__init__(
            rows.size,
            rows.device,
            self.reading.array,
            columns=columns,
            threads=rows.places,
            comm=comm,
        )

    def of(
        self,
        declared: StencilKernel,
        *structs: DataclassInstance,
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
        slot: int = 0,
        **kernel_args: KernelArgument,
    ) -> np.ndarray:
        """Launch a kernel, bound as by `StencilKernel.bind`; return its sums.

        They are in `scalars` from a slot on.
        """
        with as_one_table(self.rows.device, self._comm):
            self._launch(declared, structs, kernel_args, stencil, bounds, slot, wp.launch)
        return self.reading.numpy()[slot : slot + len(declared.sums)]

    def launch(
        self,
        declared: StencilKernel,
        *structs: DataclassInstance,
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
        slot: int = 0,
        launch: Launch = launch_now,
        **kernel_args: KernelArgument,
    ) -> None:
        """Launch a kernel, or record it; `reading` then has its sums from a slot on."""
        self._launch(declared, structs, kernel_args, stencil, bounds, slot, launch)

    def _launch(
        self,
        declared: StencilKernel,
        structs: tuple[DataclassInstance, ...],
        kernel_args: dict[str, KernelArgument],
        stencil: KernelStencil | None,
        bounds: BoundOperands | None,
        slot: int,
        launch: Launch,
    ) -> None:
        kernel_args["out"] = self.partials
        declared.bind_arguments(self.rows, structs, kernel_args, stencil, bounds).launch(launch)
        self.add_up(slot, columns=len(declared.sums), launch=launch)
        self.reading.changed()


class DynamicReduction:
    """Sums and a maximum of a kernel over rows that change.

    They have the same bits in every run.

    Args:
        declared: the kernel.
        device: of the fields.
        places: of the most rows that are visited; more memory is allocated if larger rows come.
    """

    def __init__(self, declared: StencilKernel, device: wp.Device, places: int = 0) -> None:
        self._declared, self._columns = declared, len(declared.reductions)
        self._reading = DeviceScalar(device, self._columns) if device.is_cuda else None
        self._partials = wp.empty(self._columns * places, dtype=wp.float64, device=device)
        self._between = wp.empty(
            self._columns * CUDA_SEGMENTS if device.is_cuda else 0, dtype=wp.float64, device=device
        )
        self._places = 0

    @property
    def results(self) -> DeviceArray | None:
        """The results on a GPU, a number a column; None on the CPU."""
        return None if self._reading is None else self._reading.array

    def launch(
        self,
        rows: Rows,
        *structs: DataclassInstance,
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
        **kernel_args: KernelArgument,
    ) -> None:
        """Launch the kernel over rows, bound as by `StencilKernel.bind`.

        Its results replace the former ones.
        """
        self.launch_arguments(rows, structs, kernel_args, stencil, bounds)

    def launch_arguments(
        self,
        rows: Rows,
        structs: tuple[DataclassInstance, ...],
        kernel_args: dict[str, KernelArgument],
        stencil: KernelStencil | None = None,
        bounds: BoundOperands | None = None,
    ) -> None:
        """Launch as `launch` does, with arguments as of `StencilKernel.bind_arguments`."""
        self._places, device = rows.places, rows.device
        if is_recording() and device.is_cuda:
            self._record(rows, structs, kernel_args, stencil, bounds)
            return
        if self._partials.size < self._columns * self._places:
            self._partials = wp.empty(self._columns * self._places, dtype=wp.float64, device=device)
        kernel_args["out"] = self._partials
        self._declared.bind_arguments(rows, structs, kernel_args, stencil, bounds).launch()
        if self._reading is None:
            return
        sums, largest = len(self._declared.sums), len(self._declared.largest)
        if not self._places:
            self._reading.array.zero_()
        elif sums:
            fold(
                add_up_kernel,
                self._partials,
                self._places,
                sums,
                self._reading.array,
                0,
                self._between,
            )
        if self._places and largest:
            fold(
                largest_kernel,
                self._partials,
                self._places,
                largest,
                self._reading.array,
                sums,
                self._between,
                before=sums,
            )
        self._reading.changed()

    def _record(
        self,
        rows: Rows,
        structs: tuple[DataclassInstance, ...],
        kernel_args: dict[str, KernelArgument],
        stencil: KernelStencil | None,
        bounds: BoundOperands | None,
    ) -> None:
        """Record the kernel on CUDA, for as many places as the rows have in a run."""
        assert self._reading is not None
        memory, sums, largest = rows.memory, len(self._declared.sums), len(self._declared.largest)
        assert memory is None or isinstance(memory, DeviceRows)
        most = self._places if memory is None else math.prod(memory.room)
        places = self._places if memory is None else memory.places
        if self._partials.size < self._columns * most:
            self._partials = wp.empty(self._columns * most, dtype=wp.float64, device=rows.device)
        kernel_args["out"] = self._partials
        self._declared.bind_arguments(rows, structs, kernel_args, stencil, bounds).launch()
        for kernel, count, before in ((add_up_kernel, sums, 0), (largest_kernel, largest, sums)):
            if count:
                fold(
                    kernel,
                    self._partials,
                    places,
                    count,
                    self._reading.array,
                    before,
                    self._between,
                    most=most,
                    before=before,
                )

    def changed(self) -> None:
        """Mark the results as changed after a recorded `launch` has run."""
        if self._reading is not None:
            self._reading.changed()

    def read(self, arrange: Callable[[np.ndarray], np.ndarray] = np.asarray) -> np.ndarray:
        """Return the results, a number a column.

        Args:
            arrange: reshapes the threads' results, shape (columns, threads), to the order in which
                the host adds them up, columns first.
        """
        if self._reading is not None:
            return self._reading.numpy()
        parts = arrange(
            self._partials.numpy()[: self._columns * self._places].reshape(
                self._columns, self._places
            )
        )
        sums = len(self._declared.sums)
        return np.array(
            [part.sum() if c < sums else part.max(initial=-np.inf) for c, part in enumerate(parts)]
        )


def sum_over_ranks(
    comm: Communicator,
    scalars: wp.array[wp.float64],
    slots: slice,
    launch: Launch = launch_now,
    condition: wp.array[wp.int32] | None = None,
) -> None:
    """Add the sums of the other processes, now or among the launches of a program.

    Args:
        comm: communicator.
        scalars: sums of this process, which are replaced.
        slots: those that are added up.
        launch: of a program.
        condition: number, shape (1,), the same in all processes; where it is 0 nothing is done.
            None: always.
    """

    def operation() -> Operation:
        adding = comm.sum_operation(scalars.numpy()[slots])
        return adding if condition is None else adding.only_if(condition)

    HostTask(
        partial(_sum_over_ranks, comm, scalars, slots, condition),
        operation if scalars.device.is_cpu else None,
    ).launch(launch)


def _sum_over_ranks(
    comm: Communicator,
    scalars: wp.array[wp.float64],
    slots: slice,
    condition: wp.array[wp.int32] | None,
) -> None:
    if condition is not None and not condition.numpy()[0]:
        return
    if scalars.device.is_cpu:
        sums = scalars.numpy()[slots]
        sums[...] = comm.sum(sums)
    else:
        scalars[slots].assign(comm.sum(scalars[slots].numpy()))


def rows_of(field: DeviceArray) -> Rows:
    """Return the rows of kernels over flat fields like this one."""
    return Rows.flat(field.size, field.device)


def convert(a: DeviceArray, b: DeviceArray, *, launch: Launch = launch_now) -> None:
    """Convert b = a between float types.

    Between different types it may be recorded by `launch`.
    """
    if a.dtype is b.dtype:
        copy(b, a)
    else:
        CONVERT.bind(rows_of(a), a=a, b=b).launch(launch)
