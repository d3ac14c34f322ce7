# mypy: ignore-errors
"""Persistent kernels: several kernels in one launch on CUDA.

On the CPU they are separate launches. A block of threads or a cluster of blocks executes them. All
threads meet at a barrier after each kernel. A cluster (compute capability 9.0 on) is a few blocks
on neighboring multiprocessors that have a barrier in hardware. It is used where a kernel has more
tasks than a block has threads.
"""

import functools
import math

import numpy as np
import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.kernel_variant import KernelVariant
from warp_lcp.kernels.launch_graph import Launch, launch_now, perform
from warp_lcp.kernels.layout import RowLayout, make_struct, native_of, put, threads
from warp_lcp.kernels.stencil_kernel import BoundKernel
from warp_lcp.kernels.thread_pool import Operation
from warp_lcp.kernels.types import DataType, StructInstance

CUDA_THREADS = 512  # threads of a block that inverts a matrix
THREADS = 256  # threads of a block that executes kernels: with 512 they spill registers
BLOCKS = 8  # blocks of a cluster: every GPU with clusters has as many
CLUSTERED = 90  # least architecture with clusters
MOST = 5  # most variants


@wp.struct
class EmptyArguments:
    """Arguments of an unused kernel variant of a persistent kernel.

    Eight bytes, as all structs of arguments are multiples of that.
    """

    unused: wp.int64


@wp.func
def nothing(L: RowLayout, F: EmptyArguments, slab: int, row: int, chunk: int, count: int):
    """Do nothing, in place of an unused variant."""


class PersistentKernel:
    """A table of kernels on the device that one launch executes.

    Grids of 16^3 cells take less time than launches.

    Args:
        name: of the kernel, as a stencil kernel has one.
        stages: the kernels in order, of five variants at most, without sums. Those that are the
            same object are stored once.

    Attributes:
        tasks: the largest number of tasks of a kernel.
        threads: of the launch.

    Raises:
        ValueError: no kernel, too many variants, a kernel that sums, or kernels on several devices.
    """

    def __init__(self, name: str, stages: list[BoundKernel]) -> None:
        forms = tuple(dict.fromkeys(stage.form for stage in stages))
        names = [form.declared.name for form in forms]
        if not stages or any(stage.rows.device is not stages[0].rows.device for stage in stages):
            raise ValueError(f"{name}: takes passes, all on one device")
        if len(forms) > MOST:
            raise ValueError(
                f"{name}: {', '.join(names)} are {len(forms)} forms: a sequence takes {MOST}"
            )
        if summing := [form.declared.name for form in forms if form.declared.sums]:
            raise ValueError(f"{name}: {summing[0]} sums, which passes of a sequence cannot")
        self.device, self._stages, self._forms = stages[0].rows.device, tuple(stages), forms
        self.tasks = max(math.prod(threads(stage.layout)) for stage in stages)
        clustered = has_clusters(self.device) and self.tasks > THREADS
        self.threads = THREADS * (BLOCKS if clustered else 1)
        self._name = name
        self.kernel, self._Tables, self._structs = _sequence_kernel(name, forms, clustered)

    def kernel_by_quads(self, *, clustered: bool) -> wp.Kernel:
        """Return the kernel as a GPU launches it, by one block or a cluster of them."""
        forms = tuple(dict.fromkeys(form.by_quads or form for form in self._forms))
        return _sequence_kernel(self._name, forms, clustered)[0]

    @functools.cached_property
    def tables(self) -> StructInstance:
        """Tables of the kernels by variant, and the order of execution."""
        places = dict[int, tuple[int, int]]()
        table_bytes: list[list[bytes]] = [[] for _ in self._forms]
        for bound in {id(stage): stage for stage in self._stages}.values():
            which = self._forms.index(bound.form)
            places[id(bound)] = which, len(table_bytes[which])
            table_bytes[which].append(bytes(native_of(bound.layout)) + bound.arguments)
        tables = self._Tables()
        tables.order = wp.array(
            [places[id(stage)] for stage in self._stages], dtype=wp.vec2i, device=self.device
        )
        for table, struct, pieces in zip(TABLES, self._structs, table_bytes, strict=False):
            stored = wp.array(np.frombuffer(b"".join(pieces), dtype=np.uint8), device=self.device)
            typed = wp.array(ptr=stored.ptr, dtype=struct, shape=len(pieces), device=self.device)
            # A recorded launch holds the tables alone, so the tables must hold the arrays whose
            # addresses they have.
            typed.keep_alive = stored, self._stages
            put(tables, {table: typed})
        return tables

    def launch(self, launch: Launch = launch_now) -> None:
        """Launch all kernels, or record their launch."""
        if self.device.is_cuda:
            inputs = [self.tables, 0, len(self._stages), self.threads]
            launch(self.kernel, self.threads, inputs, device=self.device, block_dim=THREADS)
            return
        operations: dict[
            int, Operation | None
        ] = {}  # operations of the thread pool for repeated kernels
        for stage in self._stages:
            key = id(stage)
            if key not in operations:
                operations[key] = stage.operation()
            if operations[key] is None:
                stage.launch(launch)
            else:
                perform(operations[key], launch)


TABLES = tuple(f"pieces{i}" for i in range(MOST))


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
"""
)
def sync_block():
    """Wait for all threads of the block."""


@wp.func_native(
    """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900 && defined(__CUDACC__)
asm volatile("barrier.cluster.arrive.release;" ::: "memory");
asm volatile("barrier.cluster.wait.acquire;" ::: "memory");
#elif defined(__CUDA_ARCH__)
__syncthreads();
#endif
"""
)
def meet_in_cluster():
    """Wait for all threads of the cluster, and make their writes visible."""


def has_clusters(device: wp.Device) -> bool:
    """Return whether a device launches clusters of blocks."""
    return bool(device.is_cuda and device.arch >= CLUSTERED)


@functools.cache
def _shared(form: KernelVariant | None) -> tuple[DataType, wp.Function]:
    """Return the struct of a kernel with its arguments, and its sharing function.

    The function distributes the kernel's rows over threads.
    """
    run, Fields = (form.run_in_turn, form.fields) if form else (nothing, EmptyArguments)
    Piece = make_struct(f"Piece_{Fields.key}", {"L": RowLayout, "F": Fields})
    pieces = wp.array(dtype=Piece)

    def share(given: pieces, place: int, t: int, threads: int):
        P = given[place]
        a_plane = P.L.rows * P.L.chunks
        for q in range(t, (P.L.planes + P.L.slab - 1) // P.L.slab * a_plane, threads):
            run(P.L, P.F, q // a_plane, q % a_plane // P.L.chunks, q % P.L.chunks, 1)

    share.__module__ = run.module.name if form else __name__
    share.__qualname__ = f"{run.key}_shared"
    return Piece, wp.func(share)


@functools.cache
def _sequence_kernel(
    name: str, forms: tuple[KernelVariant, ...], clustered: bool
) -> tuple[wp.Kernel, DataType, tuple[DataType, ...]]:
    # Warp needs a branch for each variant; unused ones have empty arguments and do nothing.
    (One, first), (Two, second), (Three, third), (Four, fourth), (Five, fifth) = (
        _shared(form) for form in (*forms, *(None,) * (MOST - len(forms)))
    )
    kinds = [form.declared.name.rpartition(".")[2] for form in forms]
    words = [
        *dict.fromkeys(word for form in forms for word in form.words),
        *["cluster"] * clustered,
    ]
    variant = f"{'_'.join(kinds)}.{'_'.join(words)}"
    wait = meet_in_cluster if clustered else sync_block
    structs = (One, Two, Three, Four, Five)
    members = {"order": wp.array(dtype=wp.vec2i)} | {
        n: wp.array(dtype=s) for n, s in zip(TABLES, structs, strict=True)
    }
    Tables = make_struct(f"{name.replace('.', '_')}_{variant.replace('.', '_')}", members)

    def sequence(T: Tables, begin: int, end: int, threads: int):
        """Execute the kernels from `begin` to `end`, with a barrier after each.

        Every thread reaches every barrier: the bounds of the loop are the same for all.
        """
        t = wp.tid()
        for s in range(begin, end):
            at = T.order[s]
            if at[0] == 0:
                first(T.pieces0, at[1], t, threads)
            elif at[0] == 1:
                second(T.pieces1, at[1], t, threads)
            elif at[0] == 2:
                third(T.pieces2, at[1], t, threads)
            elif at[0] == 3:
                fourth(T.pieces3, at[1], t, threads)
            else:
                fifth(T.pieces4, at[1], t, threads)
            wait()

    sequence.__name__ = sequence.__qualname__ = name.rpartition(".")[2]
    options = {"cluster_dim": BLOCKS} if clustered else {}
    module = f"warp_lcp.{name}.{variant}"
    # The least number of blocks, 1, must be given: without it ptxas uses at most 128 registers and
    # spills.
    kernel = forward_kernel(module=module, launch_bounds=(THREADS, 1), **options)(sequence)
    return kernel, Tables, structs
