"""Messages between ranks, at once or as operations of the thread pool.

Recorded, the kernels of a program and the exchanges between them form one operation table.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from warp_lcp.distributed.interruptible_wait import waiting
from warp_lcp.distributed.launch import petsc
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.thread_pool import Operation, launched_alone

if TYPE_CHECKING:
    from mpi4py import MPI

    from warp_lcp.distributed.halo import StarForest

COUNT, DATA = 7101, 7102  # tags of messages


class Mailbox(Protocol):
    """Mailbox: carries messages from each rank to its neighbors."""

    def swap(self, outgoing: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Return the messages of the neighbors, in the order of their ranks.

        Args:
            outgoing: an array of one type for every neighbor, of any length.
        """


class MpiMailbox:
    """Mailbox by MPI messages.

    Args:
        comm: of mpi4py.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm

    def swap(self, outgoing: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Exchange messages: first their lengths, then those that are not empty."""
        from mpi4py import MPI

        neighbors, comm = sorted(outgoing), self._comm
        sizes = np.array(
            [[len(outgoing[rank]) for rank in neighbors], [0] * len(neighbors)], dtype=np.int64
        )
        requests = [
            comm.Irecv(sizes[1, n : n + 1], rank, COUNT) for n, rank in enumerate(neighbors)
        ]
        requests += [
            comm.Isend(sizes[0, n : n + 1], rank, COUNT) for n, rank in enumerate(neighbors)
        ]
        with waiting("counts of migrating particles"):
            MPI.Request.Waitall(requests)
        kind = outgoing[neighbors[0]].dtype if neighbors else np.dtype(np.int64)
        incoming = [np.empty(int(size), dtype=kind) for size in sizes[1]]
        requests = [
            comm.Irecv([a.view(np.uint8), MPI.BYTE], rank, DATA)
            for a, rank in zip(incoming, neighbors, strict=True)
            if a.size
        ]
        requests += [
            comm.Isend([outgoing[rank].view(np.uint8), MPI.BYTE], rank, DATA)
            for rank in neighbors
            if outgoing[rank].size
        ]
        with waiting("particles"):
            MPI.Request.Waitall(requests)
        return incoming


@wp.func_native("""
#ifndef __CUDA_ARCH__
unsigned long long* progress = (unsigned long long*)progress_;
__atomic_fetch_add(progress, 1, __ATOMIC_SEQ_CST);
typedef int Fault; typedef Fault (*Call)(void*, void*, const void*, void*, void*);
const Call calls[2] = {(Call)begin_, (Call)end_};
const unsigned long long* pairs = (const unsigned long long*)pairs_;
for (int i = 0; i < 2; ++i)
    for (int p = 0; p < count; ++p)
        if (!progress[1]) {
            const unsigned long long* pair = pairs + 3*p;
            progress[1] = calls[i](*(void**)forest_, (void*)pair[0], (const void*)pair[1], \
(void*)pair[2], (void*)replace_); }
__atomic_fetch_add(progress, 1, __ATOMIC_SEQ_CST);
#endif
""")
def copy_to_leaves(
    begin_: wp.uint64,
    end_: wp.uint64,
    forest_: wp.uint64,
    pairs_: wp.uint64,
    replace_: wp.uint64,
    count: int,
    progress_: wp.uint64,
):
    """Copy roots to leaves: PetscSFBcastBegin for each pair, then PetscSFBcastEnd.

    A pair is three addresses: the unit, the roots and the leaves. `forest_` is the address of the
    star forest's handle, read in each run.
    """


@wp.func_native("""
#ifndef __CUDA_ARCH__
unsigned long long* progress = (unsigned long long*)progress_; double* sums = (double*)sums_; \
double* gathered = (double*)gathered_;
__atomic_fetch_add(progress, 1, __ATOMIC_SEQ_CST);
typedef int Fault; typedef Fault (*Call)(const void*, int, void*, void*, int, void*, void*);
if (!progress[1]) progress[1] = ((Call)gather_)(sums, count, (void*)unit_, \
gathered, count, (void*)unit_, (void*)comm_);
for (int c = 0; c < count; ++c) {
    double sum = gathered[c];
    for (int r = 1; r < ranks; ++r) sum += gathered[r*count + c];
    sums[c] = sum; }
__atomic_fetch_add(progress, 1, __ATOMIC_SEQ_CST);
#endif
""")
def add_of_all(
    gather_: wp.uint64,
    unit_: wp.uint64,
    comm_: wp.uint64,
    sums_: wp.uint64,
    gathered_: wp.uint64,
    count: int,
    ranks: int,
    progress_: wp.uint64,
):
    """Call MPI_Allgather, and add up in the order of the ranks."""


@forward_kernel(module="warp_lcp.messages")
def exchange_kernel(
    begin: wp.uint64,
    end: wp.uint64,
    forest: wp.uint64,
    pairs: wp.uint64,
    replace: wp.uint64,
    count: int,
    progress: wp.uint64,
):
    """Copy roots to leaves over a star forest; one thread, on the CPU."""
    copy_to_leaves(begin, end, forest, pairs, replace, count, progress)


@forward_kernel(module="warp_lcp.messages")
def add_kernel(
    gather: wp.uint64,
    unit: wp.uint64,
    comm: wp.uint64,
    sums: wp.uint64,
    gathered: wp.uint64,
    count: int,
    ranks: int,
    progress: wp.uint64,
):
    """Add the sums of the other ranks; one thread, on the CPU."""
    add_of_all(gather, unit, comm, sums, gathered, count, ranks, progress)


class _Library:
    """Functions of PETSc and MPI, and MPI's constants, for calls from C.

    PETSc is called directly, because petsc4py holds Python's interpreter lock while PETSc waits for
    other ranks, and then no watchdog could run.
    """

    def __init__(self) -> None:
        from mpi4py import MPI

        self.units = {
            size: handle(unit)
            for size, unit in {1: MPI.SIGNED_CHAR, 2: MPI.SHORT, 4: MPI.INT, 8: MPI.DOUBLE}.items()
        }
        self.replace = handle(MPI.REPLACE)
        functions = ctypes.CDLL(petsc().__file__), ctypes.CDLL(MPI.__file__)
        self.begin, self.end, self.gather = (
            functions[0].PetscSFBcastBegin,
            functions[0].PetscSFBcastEnd,
            functions[1].MPI_Allgather,
        )


_library = cache(_Library)


def handle(mpi_object: MPI.Comm | MPI.Datatype | MPI.Op) -> ctypes.c_int | ctypes.c_void_p:
    """Return the C handle of an mpi4py object.

    Open MPI's handles are pointers, MPICH's are numbers.
    """
    from mpi4py import MPI

    kind: type[ctypes.c_int] | type[ctypes.c_void_p] = (
        ctypes.c_int if MPI._sizeof(mpi_object) == ctypes.sizeof(ctypes.c_int) else ctypes.c_void_p
    )
    return kind.from_buffer_copy(
        ctypes.string_at(MPI._addressof(mpi_object), MPI._sizeof(mpi_object))
    )


def exchange(forest: StarForest, roots: np.ndarray, leaves: np.ndarray | None = None) -> None:
    """Halo exchange: copy roots to leaves, which may lie in the same array."""
    exchange_all(forest, [(roots, roots if leaves is None else leaves)])


def exchange_all(forest: StarForest, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    """Halo exchange of many pairs at once: copy roots to leaves over a star forest.

    Roots are the cells of their owners, leaves the ghost cells. The messages of all pairs are in
    transit together.

    Raises:
        RuntimeError: PETSc has failed.
    """
    library = _library()
    with waiting("an exchange of ghost cells"):
        for call in (library.begin, library.end):
            for roots, leaves in pairs:
                where = (ctypes.c_void_p(array.ctypes.data) for array in (roots, leaves))
                _check(
                    call(
                        ctypes.c_void_p(forest.petsc_forest.handle),
                        library.units[roots.dtype.itemsize],
                        *where,
                        library.replace,
                    )
                )


def exchange_operation(forest: StarForest, roots: np.ndarray, leaves: np.ndarray) -> Operation:
    """Return `exchange` as an operation of the thread pool."""
    return exchange_all_operation(forest, [(roots, leaves)])


def exchange_all_operation(
    forest: StarForest, pairs: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Operation:
    """Return `exchange_all` as an operation of the thread pool."""
    library = _library()
    functions = (ctypes.cast(call, ctypes.c_void_p).value for call in (library.begin, library.end))
    listed = [
        (library.units[a.dtype.itemsize].value, a.ctypes.data, b.ctypes.data) for a, b in pairs
    ]
    key = tuple((word or 0) & (1 << 64) - 1 for pair in listed for word in pair)
    words = forest.pairs.setdefault(key, (ctypes.c_uint64 * len(key))(*key))
    kernel_args = [
        *functions,
        ctypes.addressof(forest.handle),
        ctypes.addressof(words),
        library.replace.value,
        len(pairs),
    ]
    return _operation(exchange_kernel, kernel_args, (forest, words, pairs))


def sum_operation(comm: MPI.Comm, sums: np.ndarray) -> Operation:
    """Return an operation that replaces float64 sums by those over all ranks.

    The partial sums are added in the order of the ranks. The operation runs in the thread pool.
    """
    library, gathered = _library(), np.empty((comm.size, sums.size))
    kernel_args = [
        ctypes.cast(library.gather, ctypes.c_void_p).value,
        library.units[8].value,
        handle(comm).value,
    ]
    return _operation(
        add_kernel,
        [*kernel_args, sums.ctypes.data, gathered.ctypes.data, sums.size, comm.size],
        (comm, sums, gathered),
    )


def _operation(
    kernel: wp.Kernel, kernel_args: Sequence[int | None], keep_alive: object
) -> Operation:
    # Handles of MPICH may be negative.
    words = [
        (word or 0) & (1 << 64) - 1 for word in (*kernel_args, ctypes.addressof(waiting.native))
    ]
    launch = wp.launch(kernel, 1, words, device="cpu", record_cmd=True)
    operation = launched_alone(launch, keep_alive)
    operation.check = _check_native
    return operation


def _check_native() -> None:
    fault, waiting.native[1] = waiting.native[1], 0
    _check(fault)


def _check(fault: int) -> None:
    if fault:
        raise RuntimeError(f"an exchange between ranks has failed: error {fault} of PETSc or MPI")
