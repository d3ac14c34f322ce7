"""Instruction counts of a solve's kernels on a GPU, and the limit of each kernel.

The counts are made on the host. The kernels over the finest grid are recorded in CUDA's form
(`benchmarks/emulated_cuda.py`) and compiled for sm_90, and one warp of each is executed on the
memory that the solve has left (`benchmarks/machine_counts.py`). A kernel takes as long as the
slowest of: its instructions at one a clock and scheduler; those in float64 at their rate;
wavefronts of the L1 cache at one a clock; the bytes of its fields at `SHARE` of the bandwidth; and
a latency of memory for each plane of a thread, as often as the multiprocessors are filled. Launches
of steps are counted in another way (`benchmarks/gpu_launches.py`).
"""

from typing import TYPE_CHECKING

from benchmarks import emulated_cuda  # must precede the package
from warp_lcp.files import Tables
from warp_lcp.kernels import Rows
from warp_lcp.kernels.kernel_variant import KernelVariant
from warp_lcp.kernels.layout import BoundOperands
from warp_lcp.operators.padded_stencil import PaddedStencil

# ruff: isort: split

import math
import re
import struct
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl
from benchmarks.machine_code import Kernel, assemble, tools_missing
from benchmarks.machine_counts import KINDS, IssuedInstructions, issued
from benchmarks.machine_memory import EmulatedMemory, constants_of
from warp_lcp.benchmarks.kernels import BoundByName
from warp_lcp.kernels import StencilKernel, layout
from warp_lcp.kernels import rows as kernel_rows
from warp_lcp.kernels.stencil_kernel import BoundKernel
from warp_lcp.multigrid.stencil_level import StencilLevel

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

assert emulated_cuda

SHAPE = (36, 12, 128)  # planes, rows, cells of a row: a warp's quads fill one
BLOCK, SCHEDULERS, WARP = 256, 4, 32
# Share of the bandwidth that streaming kernels reach; clocks of a load from memory.
SHARE, LATENCY = 0.8, 800
AREAS = (
    "cycle.",
    "projected_multigrid.",
    "stencil.product",
    "residual.",
    "vectors.",
    "active_set.",
    "grid_conjugate_gradient.",
)


@dataclass(frozen=True)
class Gpu:
    """Rates and sizes of a GPU.

    Multiprocessors, clock [GHz], bandwidth [GB/s]; of each multiprocessor: float64 instructions of
    a warp a clock, and warps.
    """

    processors: int
    clock: float
    bandwidth: float
    float64: float
    warps: int


GPUS = {"H200": Gpu(132, 1.98, 4800.0, 2.0, 64), "RTX 4090": Gpu(128, 2.52, 1008.0, 1 / 16, 48)}


@dataclass(frozen=True)
class InstructionCount:
    """Instructions that a warp of a kernel issues, and the kernel's resources.

    Attributes:
        name: of the kernel, with types.
        issued: of a warp.
        cells: of a thread, of the finer level of a transfer.
        waits: how often a thread waits for memory, one wait after another.
        registers: of a thread.
        bytes: of a cell, of the fields that are read and of those that are written.
        spilled: bytes of registers that a thread keeps in memory.
    """

    name: str
    issued: IssuedInstructions
    cells: float
    waits: int
    registers: int
    bytes: float
    spilled: int = 0

    @property
    def a_cell(self) -> float:
        """Issued instructions a cell."""
        return self.issued.instructions / self.cells

    @property
    def key(self) -> str:
        """Name without the way in which threads share the cells."""
        return key(self.name)

    def resident(self, gpu: Gpu) -> int:
        """Return the number of warps that a multiprocessor holds."""
        taken = max(-(-self.registers // 8) * 8, 16) * BLOCK
        return min(65536 // taken * BLOCK // WARP, gpu.warps // (BLOCK // WARP) * (BLOCK // WARP))

    def limits(self, gpu: Gpu, cells: int) -> dict[str, float]:
        """Return the least time [ms] of a kernel over some cells, by each limit."""
        # Warps, and clocks of all multiprocessors in 1 ms.
        warps, clocks = cells / WARP / self.cells, gpu.processors * gpu.clock * 1e6
        turns = math.ceil(warps / (gpu.processors * self.resident(gpu)))
        return {
            "issue": self.issued.instructions * warps / SCHEDULERS / clocks,
            "float64": self.issued.float64 * warps / gpu.float64 / clocks,
            "L1": self.issued.wavefronts * warps / clocks,
            "bytes": self.bytes * cells / (SHARE * gpu.bandwidth * 1e6),
            "latency": turns * self.waits * LATENCY / (gpu.clock * 1e6),
        }


def key(name: str) -> str:
    """Return the name of a kernel, the same for small and large grids.

    How threads share the cells is left out of it.
    """
    return " ".join(
        word for word in name.split() if not re.fullmatch(r"quads|(at|of)\d(or\d)?", word)
    )


def kinds(given: Tables) -> str:
    """Return the suffix of a kernel's name for its arguments.

    It tells apart arguments that change the amount of work.
    """
    return "".join(f" {word}" for word in ("from_zero", "projected") if given.get(word))


def passes() -> dict[str, tuple[BoundByName, Tables]]:
    """Return the kernels over the finest grid in solves of a full basin, by name.

    They are bound as CUDA launches them on large grids.
    """
    cells = np.full(SHAPE, wl.FLUID, dtype=np.int8)
    cells[-1] = wl.AIR
    wall = np.zeros(SHAPE, dtype=bool)
    for side in (0, -1):
        wall[side] = wall[:, side] = wall[:, :, side] = True
    b = np.where(cells == wl.FLUID, np.random.default_rng(2015).standard_normal(SHAPE), 0.0)
    heard: list[tuple[BoundByName, Tables]] = []
    bind = StencilKernel.bind_arguments

    def listening(
        declared: StencilKernel,
        rows: Rows,
        structs: tuple["DataclassInstance", ...],
        kernel_args: Tables,
        stencil: PaddedStencil | None = None,
        bounds: BoundOperands | None = None,
    ) -> BoundKernel:
        bound = bind(declared, rows, structs, kernel_args, stencil, bounds)
        fields = {
            name: bound.kernel_args[name]
            for name in declared.arrays
            if isinstance(bound.kernel_args[name], wp.array)
        }
        if stencil is not None:
            fields |= {"d": stencil.d} | {
                f"w{axis}": w for axis, w in zip("xyz", stencil.weights or (), strict=False)
            }
        fields |= {
            name: value
            for name, value in zip(("lower", "", "upper", "", "code"), bounds or (), strict=False)
            if name
        }
        heard.append((BoundByName(bound, fields), bound.kernel_args))
        return bound

    blocks = math.prod(SHAPE) // 8  # of the next level, too, but not of those in one launch
    many = mock.patch.multiple(
        kernel_rows, MANY_CELLS=1, SUMMED_CELLS=1, MANY_CELLS_OF_BLOCKS=blocks
    )
    with many, mock.patch.object(StencilKernel, "bind_arguments", listening):
        stopping = wl.StoppingCriteria(rtol=0, max_iterations=3)
        lower = np.where(wall, 0.0, -np.inf)
        # Fields of weights, as coarser levels have.
        faces = np.full((*SHAPE[:2], SHAPE[2] + 1), 0.5)
        multigrid, newton = wl.ProjectedMultigrid(), wl.MinimumMapNewton()
        apart, joined = False, True  # two sweeps from zero; a correction with a sweep
        for method, least, face_x, joins in (
            (multigrid, lower, 1.0, apart),
            (multigrid, -np.inf, 1.0, apart),
            (multigrid, lower, 1.0, joined),
            (newton, lower, 1.0, apart),
            (multigrid, lower, faces, apart),
            (multigrid, -np.inf, faces, apart),
            (multigrid, lower, faces, joined),
            (newton, lower, faces, apart),
        ):
            A = wl.GridPoisson(cells, device="cpu", face_x=face_x)
            with mock.patch.object(StencilLevel, "joins_sweeps", joins):
                wl.solve(wl.LCP(A, b, least), method, stopping=stopping)
        A = wl.GridPoisson(cells, device="cpu")
        x = wp.array(np.random.default_rng(7).random(A.layout.size, np.float32), device="cpu")
        A.stencil.product(x, wp.zeros_like(x))
    by_name: dict[str, tuple[BoundByName, Tables]] = {}
    for one, given in heard:
        rows, declared = one.bound.rows, one.bound.form.declared
        if max(rows.size, rows.other_size) == A.layout.size and not (
            declared.box or declared.listed
        ):
            by_name.setdefault(one.name + kinds(given), (one, given))
    return by_name


def cells_of(bound: BoundKernel) -> int:
    """Return the number of cells, or list entries, that a kernel visits.

    Ghost cells count; of a transfer, those of the finer grid.
    """
    rows, L = bound.rows, bound.layout
    return max(rows.size, rows.other_size) or L.planes * L.rows * L.nx


def count(name: str, one: BoundByName, kernel_args: Tables, folder: Path) -> InstructionCount:
    """Compile a pass for CUDA, execute a warp in the middle of the grid, and return what it takes.

    Args:
        name: of the count.
        one: the pass.
        kernel_args: its arguments.
        folder: what is compiled lies there.

    Raises:
        NotImplementedError: it has an instruction that `benchmarks.machine_thread` does not know.
        KeyError: it reads memory outside its fields.
    """
    form, rows = one.bound.form, one.bound.layout
    kernel = _compiled(form, folder)
    slabs, lines, chunks = layout.threads(rows)
    dim = (slabs * lines * chunks,) if form.quads else (slabs, lines, chunks)
    bounds = struct.pack(f"<{len(dim)}I4xQQ", *dim, math.prod(dim), 1)
    parameters = bounds + bytes(layout.native_of(rows)) + one.bound.arguments
    # Threads of a row within the second slab.
    first = (min(1, slabs - 1) * lines + lines // 2) * chunks
    chunk_range = range(
        first + chunks // 2 // WARP * WARP if chunks > 1024 else first, math.prod(dim)
    )[: min(WARP, chunks)]
    arrays = [
        a
        for a in (*one.fields.values(), *kernel_args.values(), rows.spans)
        if isinstance(a, wp.array) and a.size
    ]
    memory = EmulatedMemory((int(a.ptr), a.numpy().copy()) for a in arrays)
    blocks = -(-math.prod(dim) // BLOCK)
    constants = constants_of(parameters, BLOCK, blocks)
    counts = issued(kernel.code, constants, memory, [(t % BLOCK, t // BLOCK) for t in chunk_range])
    planes, size = min(rows.slab, rows.planes), one.bound.rows.size
    ratio = max(one.bound.rows.other_size // size, 1) if size else 1
    finer = 8 if ratio > 4 else 1  # a thread takes an aggregate of the finer level
    cells = planes * (max(rows.grain, 1)) * finer
    cell_count = cells_of(one.bound)
    apart = {*form.declared.by_row, *form.declared.whole, "out"}
    fields = {
        int(a.ptr): a.size * wp.types.type_size_in_bytes(a.dtype)
        for n, a in one.fields.items()
        if a.size and n not in apart
    }
    moved = sum(
        size
        for reached in (counts.read, counts.written)
        for begin, size in fields.items()
        if any(begin <= address < begin + size for address in reached)
    )
    return InstructionCount(
        name, counts, cells, planes, kernel.registers, moved / cell_count, kernel.spilled
    )


def _compiled(form: KernelVariant, folder: Path) -> Kernel:
    """Return a kernel compiled for sm_90."""
    kernel, place = form.kernel, folder / form.kernel.module.name
    if not place.exists():
        # As on a GPU; the emulation compiles kernels for the CPU without optimization.
        kernel.module.options |= {"block_dim": BLOCK, "optimization_level": 3}
        wp.compile_aot_module(
            kernel.module.name, device=None, arch=[90], module_dir=place, use_ptx=True
        )
    (ptx,) = place.glob("*.ptx")
    made = assemble(ptx.read_text(), place / "module.cubin")
    return next(
        one for one in made if re.fullmatch(f"{form.name}_[0-9a-f]+_cuda_kernel_forward", one.name)
    )


def counts(words: tuple[str, ...] = AREAS) -> Iterator[InstructionCount]:
    """Count the kernels whose names begin with one of some words."""
    if missing := tools_missing():
        raise SystemExit(f"{', '.join(missing)}: not installed: pip install 'warp-lcp[ptxas]'")
    with tempfile.TemporaryDirectory() as folder:
        for name, (one, given) in passes().items():
            if name.startswith(words):
                try:
                    yield count(name, one, given, Path(folder))
                except (NotImplementedError, KeyError) as error:
                    print(f"{name}: {error!r}")


def table(counts: Iterable[InstructionCount], n: int) -> Iterator[str]:
    """Yield the lines of a table of kernels, with times over n^3 cells."""
    times = " | ".join(f"{name} ms | limit" for name in GPUS)
    yield (
        "| pass | issued a cell | loads | stores | L1 wavefronts | bytes | registers | warps | "
        f"{times} |"
    )
    yield "|---" * (8 + 2 * len(GPUS)) + "|"
    for one in counts:
        i, c = one.issued, one.cells
        cells = [f"{v / c:.1f}" for v in (i.instructions, i.loads, i.stores, i.wavefronts)]
        cells += [f"{one.bytes:.1f}", str(one.registers), str(one.resident(GPUS["H200"]))]
        for gpu in GPUS.values():
            limits = one.limits(gpu, n**3)
            limit = max(limits, key=lambda name: limits[name])
            cells += [f"{limits[limit]:.3f}", limit]
        yield f"| `{one.name}` | {' | '.join(cells)} |"


def kinds_table(counts: Iterable[InstructionCount]) -> Iterator[str]:
    """Yield the lines of a table of kernels: issued instructions a cell by their kinds."""
    names = (*KINDS, "index")
    yield f"| pass | all | {' | '.join(names)} |"
    yield "|---" * (2 + len(names)) + "|"
    for one in counts:
        cells = [f"{one.issued.kinds[name] / one.cells:.1f}" for name in names]
        yield f"| `{one.name}` | {one.a_cell:.1f} | {' | '.join(cells)} |"
