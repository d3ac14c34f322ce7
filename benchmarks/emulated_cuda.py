# mypy: ignore-errors
"""Emulation of CUDA on the CPU; import it before the package.

The plugin `tests/emulated_cuda.py` runs tests with it. The package decides as on CUDA
(`device.is_cuda`, `__CUDA_ARCH__`). Blocks of threads run as cooperative fibers that meet at
barriers. Threads and blocks run in an unusual order (ORDER = forward, reversed, permuted).
`.numpy()` returns a copy, so that writes to it are lost, as on CUDA. Recorded programs launch what
a graph would hold.

With COMPARE=1 every launch runs in all three orders from equal memory. `differs` counts the kernels
whose results depend on the order and that are not in `ORDER_MATTERS`. Kernels by quads of cells
(`warp_lcp/kernels/headers/quad.h`) load blocks of four cells where rows are aligned. With CELLS=1
each of them also runs by cells, from equal memory: `launched_by_cells` counts such launches,
`otherwise` those whose fields differ in a bit, or whose sums differ by more than rounding. `meter`
counts launches, readbacks and allocations, and calls: of Python, to launch, copy or clear, one for
a whole graph.

Not emulated: torn interleavings and the memory model (threads run one after another), rules of
graphs, the order of streams.
"""

import collections
import ctypes
import fnmatch
import gc
import importlib.abc
import importlib.machinery
import math
import os
import re
import sys
from pathlib import Path

import numpy as np
import warp as wp
from warp._src import codegen, context
from warp._src.types import array_t

ORDERS = ("forward", "reversed", "permuted")
ORDER = ORDERS.index(os.environ.get("ORDER", "permuted"))
COMPARE, CELLS = os.environ.get("COMPARE") == "1", os.environ.get("CELLS") == "1"
PACKAGE = "warp_lcp"
# These modules query CUDA itself, or another process.
REAL = ("warp_lcp.distributed.", "warp_lcp.run.devices", "warp_lcp.benchmarks.")
ADDRESS = 0x6F0000000000  # address at which compiled kernels read the order of threads
# Kernels (module:name) whose results depend on the order of threads, and why they may.
ORDER_MATTERS = {
    "warp_lcp.components*:components_unite": "trees differ, their roots do not",
    "warp_lcp.material.ballistic_fragments:unite": "trees differ, their roots do not",
    "warp_lcp.material.ballistic_fragments:board_kernel": "a list in the order in which threads "
    "come; sums over it are rounded in that order",
    "warp_lcp.grid.node_distance:claim_groups": "lists of nodes in the order in which threads "
    "come; each node is measured for itself",
    "warp_lcp.grid.transfer_*.scatter.*:scatter": "sums of atomic additions are rounded in their "
    "order",
    "warp_lcp.vectors:add_up_kernel": "a tile adds up by place in the block, and the emulation "
    "assigns places again",
}

libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_long,
]
READ_WRITE, PRIVATE_FIXED_ANONYMOUS = 3, 0x02 | 0x10 | 0x20
if libc.mmap(ADDRESS, 4096, READ_WRITE, PRIVATE_FIXED_ANONYMOUS, -1, 0) != ADDRESS:
    raise RuntimeError(f"no memory at {ADDRESS:#x}, where kernels look up the order of threads")
order = ctypes.c_int.from_address(ADDRESS)
order.value = ORDER

CUDA = """
#define __CUDA_ARCH__ 900
static inline void emulated_sync() { WP_TILE_SYNC(); }
#define __syncthreads emulated_sync
template <class T> static inline T emulated_add(T* p, T v) { T old = *p; *p = old + v; return old; }
#define atomicAdd emulated_add
"""
ROUNDED = """
static inline {type} __{kind}{name}_rn({type} a, {type} b) {
#pragma clang fp contract(off) reassociate(off)
return a {sign} b; }
"""
PERMUTED = """
struct emulated_order {
    size_t n, a; int order;
    emulated_order(size_t size) : n(size), a(1), order(*(volatile int*)ADDRESSull) {
        if (order != 2 || n < 3) return;
        const auto divisor = [](size_t x, size_t y) {
            while (y) { const size_t t = x % y; x = y; y = t; }
            return x;
        };
        for (a = (size_t)(0.6180339887*(double)n) | 1; divisor(a, n) != 1;) ++a; }
    size_t operator()(size_t t) const {
        return order == 0 ? t : order == 1 ? n - 1 - t : (t*a + n/3) % n;
    }
};
"""


def swap(template, *pairs):
    """Replace parts of one of Warp's kernel templates."""
    text = getattr(codegen, template)
    for old, new in pairs:
        if old not in text:
            raise RuntimeError(f"Warp {wp.__version__}: {template} has no {old!r}")
        text = text.replace(old, new)
    setattr(codegen, template, text)


def emulate_kernels():
    """Compile kernels as on CUDA, with threads and blocks in another order."""
    rounded = ""
    for kind, type_ in (("f", "float"), ("d", "double")):
        for name, sign in (("add", "+"), ("sub", "-"), ("mul", "*")):
            of = {"{type}": type_, "{kind}": kind, "{name}": name, "{sign}": sign}
            rounded += re.sub("|".join(map(re.escape, of)), lambda m, of=of: of[m[0]], ROUNDED)
    added = CUDA + rounded + PERMUTED.replace("ADDRESS", hex(ADDRESS))
    codegen.cpu_module_header += added.replace("{", "{{").replace("}", "}}")
    loop = "    for (size_t task_index = 0; task_index < dim->size; ++task_index)\n    {{\n"
    permuted = (
        "    const emulated_order of(dim->size);\n    for (size_t task = 0; task < "
        "dim->size; ++task)\n    {{\n"
    )
    swap(
        "cpu_module_template_forward",
        (loop, permuted + "        const size_t task_index = of(task);\n"),
    )
    lane = "const size_t task_index = payload->block_first + (size_t)lane;"
    rest = (
        "const size_t rest = dim->size - payload->block_first, active = rest < "
        "WP_TILE_BLOCK_DIM ? rest : WP_TILE_BLOCK_DIM;\n"
    )
    swap(
        "cpu_block_module_template_forward",
        (lane, f"{rest}    {lane.replace('(size_t)lane', 'emulated_order(active)((size_t)lane)')}"),
    )
    blocks = (
        "    const size_t blocks = (total + block_dim - 1) / block_dim; const emulated_order "
        "of(blocks);\n"
    )
    swap(
        "cpu_block_entry_body_forward",
        ("    while (block_first < total)\n", f"{blocks}    while (block_id < blocks)\n"),
        (
            "        const size_t remaining",
            "        block_first = of(block_id)*block_dim;\n        const size_t remaining",
        ),
        ("        block_first += (size_t)active_count;\n", ""),
    )
    wp.config.enable_cpu_blocks = True
    # Kernels run once or twice on small grids: compiling them well takes longer than it saves.
    wp.config.optimization_level = 0
    # A cache folder of its own, since Warp does not hash templates.
    wp.config.kernel_cache_dir = str(Path(__file__).parents[1] / "build" / "emulated-cuda")


class Loader(importlib.machinery.SourceFileLoader):
    """Module loader whose modules treat the CPU as CUDA."""

    def get_code(self, fullname):
        """Compile the source; ignore cached bytecode."""
        path = self.get_filename(fullname)
        source = self.get_data(path).decode()
        if not fullname.startswith(REAL):
            source = re.sub(r"\.(is_cuda|is_cpu)\b", r".\1_like", source)
        # Fibers are needed only where threads meet at barriers.
        source = source.replace("block_dim: int = 256", "block_dim: int = 1")
        return compile(source, path, "exec", dont_inherit=True)


class Finder(importlib.abc.MetaPathFinder):
    """Finder that loads modules of the package by `Loader`."""

    def find_spec(self, name, path, target=None):
        """Return the spec of a module of the package."""
        spec = (
            importlib.machinery.PathFinder.find_spec(name, path, target)
            if name.partition(".")[0] == PACKAGE
            else None
        )
        if spec and spec.origin and spec.origin.endswith(".py"):
            spec.loader = Loader(name, spec.origin)
        return spec


# Counts of launches, readbacks, allocations and calls; the reader clears it.
meter = collections.Counter[str]()


def counted(what, result):
    """Count a call and return its result."""
    meter[what] += 1
    return result


def counting(what, plain):
    """Return a function that counts its calls."""
    return lambda *args, **given: counted(what, plain(*args, **given))


def emulate_decisions():
    """Make the package decide and Warp launch as on CUDA."""
    if any(name.partition(".")[0] == PACKAGE for name in sys.modules):
        raise RuntimeError(f"{PACKAGE} is imported already: give the plugin to pytest with -p")
    context.Device.is_cuda_like = property(lambda self: True)
    context.Device.is_cpu_like = property(lambda self: False)
    sys.meta_path.insert(0, Finder())
    plain, numpy = wp.launch, wp.array.numpy

    def launch(*args, block_dim=1, **kwargs):
        meter["calls"] += not kwargs.get("record_cmd")
        return plain(*args, block_dim=block_dim, **kwargs)

    wp.launch = launch
    wp.array.numpy = lambda self: counted("readbacks", numpy(self).copy())
    context.CpuDefaultAllocator.allocate = counting(
        "allocations", context.CpuDefaultAllocator.allocate
    )
    for name in ("invoke", "invoke_cpu_blocks"):
        setattr(context, name, counting("launches", getattr(context, name)))
    replay = wp.capture_launch

    def capture_launch(graph):
        calls = meter["calls"]
        done = [c.launch() for c in graph] if isinstance(graph, list) else replay(graph)
        meter["calls"] = calls + 1
        return done

    wp.capture_launch = capture_launch
    context.Launch.launch = counting("calls", context.Launch.launch)
    for name in ("radix_sort_pairs", "array_scan"):
        setattr(wp.utils, name, counting("calls", getattr(wp.utils, name)))
    wp.copy = counting("calls", wp.copy)
    for name in ("zero_", "fill_"):
        setattr(wp.array, name, counting("calls", getattr(wp.array, name)))


def arrays_of(value, kind, arrays):
    """Collect addresses, sizes and element types of the arrays in a kernel argument.

    Arrays in structs and in tables of structs are included. `arrays` maps an address to bytes and
    type.
    """
    if isinstance(value, array_t):
        dtype, shape = getattr(kind, "dtype", None), [value.shape[i] for i in range(value.ndim)]
        item = (
            ctypes.sizeof(dtype.ctype)
            if isinstance(dtype, codegen.Struct)
            else wp.types.type_size_in_bytes(dtype)
        )
        size = (
            sum((n - 1) * abs(value.strides[i]) for i, n in enumerate(shape)) + item
            if value.data and all(shape)
            else 0
        )
        if size > arrays.get(value.data, (0, None))[0]:
            arrays[value.data] = size, dtype
        if size and isinstance(dtype, codegen.Struct) and value.ndim == 1:
            for i in range(shape[0]):
                arrays_of(
                    dtype.ctype.from_address(value.data + i * value.strides[0]), dtype, arrays
                )
    elif isinstance(value, ctypes.Structure) and isinstance(kind, codegen.Struct):
        for name, var in kind.vars.items():
            arrays_of(getattr(value, name), var.type, arrays)


def compared(invoke):
    """Return a launcher that runs kernels in all orders and records differences.

    Every order starts from equal memory.
    """

    def launch(kernel, hooks, params, adjoint):
        arrays = {}
        for argument, value in zip(kernel.adj.args, params[1:], strict=False):
            arrays_of(value, argument.type, arrays)
        before = {address: ctypes.string_at(address, size) for address, (size, _) in arrays.items()}
        after = []
        for order.value in (*({0, 1, 2} - {ORDER}), ORDER):
            for address, data in before.items():
                ctypes.memmove(address, data, len(data))
            invoke(kernel, hooks, params, adjoint)
            after.append(
                {address: ctypes.string_at(address, size) for address, (size, _) in arrays.items()}
            )
        # The hash of a module with arguments in memory is no part of the name.
        name = f"{kernel.module.name.partition('.memory.')[0]}:{kernel.key}"
        if after[0] != after[2] or after[1] != after[2]:
            if not any(fnmatch.fnmatchcase(name, known) for known in ORDER_MATTERS):
                differs[name] += 1

    return launch


PIECES = ("moved",)  # sums that count pieces of rows; only zero or nonzero is compared


def checked_by_cells(invoke):
    """Return a launcher that also runs quad kernels by cells and records differences.

    Both start from equal memory.
    """
    from warp_lcp.kernels import layout
    from warp_lcp.kernels.kernel_variant import KernelVariant

    forms = {}  # variant of each kernel; None for kernels without quads

    def form_of(kernel):
        if kernel not in forms:
            made = (
                o
                for o in gc.get_objects()
                if type(o) is KernelVariant and o.quads and vars(o).get("kernel") is kernel
            )
            forms[kernel] = next(made, None)
        return forms[kernel]

    def launch(kernel, hooks, params, adjoint):
        form = form_of(kernel)
        if form is None:
            invoke(kernel, hooks, params, adjoint)
            return
        counts = meter.copy()
        arrays, (_, rows, kernel_args), columns, twin = (
            {},
            params,
            form.declared.reductions,
            form.by_cells,
        )
        arrays_of(kernel_args, kernel.adj.args[1].type, arrays)
        for address in {kernel_args.out.data} if columns else ():
            arrays.pop(address, None)  # both variants store partial sums in different places
        native, cells = (
            twin.native.from_buffer_copy(bytes(kernel_args)),
            type(rows).from_buffer_copy(rows),
        )
        cells.grain, cells.chunks = 1, cells.nx
        dims = layout.threads(cells)
        out = wp.zeros(len(columns) * math.prod(dims), dtype=wp.float64, device="cpu")
        if columns:
            native.out = out.__ctype__()
        by_cells, arguments = layout.copy_of(layout.BLANK), object.__new__(twin._struct)
        vars(by_cells)["_ctype"], vars(arguments)["_ctype"] = cells, native
        before = {address: ctypes.string_at(address, size) for address, (size, _) in arrays.items()}
        wp.launch(twin.kernel, dims, [by_cells, arguments], device="cpu", block_dim=1)
        expected = {
            address: ctypes.string_at(address, size) for address, (size, _) in arrays.items()
        }
        for address, data in before.items():
            ctypes.memmove(address, data, len(data))
        meter.clear()
        meter.update(counts)
        invoke(kernel, hooks, params, adjoint)
        counts = meter.copy()
        name = " ".join([form.declared.name, *form.words])
        launched_by_cells[name] += 1
        otherwise[name] += not all(
            equal_bits(ctypes.string_at(a, len(data)), data, arrays[a][1])
            for a, data in expected.items()
        )
        if columns:
            count = len(columns) * math.prod(layout.threads(rows))
            sums = np.frombuffer(ctypes.string_at(kernel_args.out.data, 8 * count)).reshape(
                len(columns), -1
            )
            for column, one, other in zip(
                columns, sums, out.numpy().reshape(len(columns), -1), strict=True
            ):
                otherwise[f"{name}: {column}"] += not equal_sums(
                    one, other, column, largest=column in form.declared.largest
                )
        meter.clear()
        meter.update(counts)

    return launch


def equal_bits(one, other, kind):
    """Return whether two arrays of a type have equal bits; all NaN are equal."""
    if one == other or kind not in (wp.float32, wp.float64):
        return one == other
    a, b = (np.frombuffer(data, dtype=wp.dtype_to_numpy(kind)) for data in (one, other))
    either = np.isnan(a) | np.isnan(b)
    return np.array_equal(np.isnan(a), np.isnan(b)) and a[~either].tobytes() == b[~either].tobytes()


def equal_sums(one, other, column, *, largest):
    """Return whether two sets of partial results agree, sums up to rounding."""
    if largest:
        return np.array_equal(one.max(), other.max(), equal_nan=True)
    a, b, size = one.sum(), other.sum(), np.abs(other).sum()
    if column in PIECES:
        return (a == 0) == (b == 0)
    return not (np.isfinite([a, b]).all() and size < 1e300) or bool(abs(a - b) <= 1e-6 * size)


launched_by_cells: collections.Counter[str] = collections.Counter()
otherwise: collections.Counter[str] = collections.Counter()
differs: collections.Counter[str] = collections.Counter()
if COMPARE:
    context.invoke, context.invoke_cpu_blocks = (
        compared(context.invoke),
        compared(context.invoke_cpu_blocks),
    )


def replayed():
    """Replace CUDA graphs by lists of launches that are repeated.

    Call it once the package can be imported. Loops of graphs read their conditions in place.
    """
    from warp_lcp.kernels import device_graph, host_kernel, rows
    from warp_lcp.kernels import joined_graphs as joined
    from warp_lcp.kernels.launch_graph import CommandBuffer, LaunchGraph, Loop

    if CELLS:
        context.invoke = checked_by_cells(context.invoke)
        rows.MANY_CELLS_OF_BLOCKS = 1  # all quads are loaded in blocks where rows allow it

    class HostGraph(LaunchGraph):
        """Launch graph in host memory.

        Its kernels run at once; waits for the device are deferred.
        """

        def run(self, *arguments, **options):
            """Launch all commands and leave their results to the host."""
            waiting, state, counts = joined.WAITING, vars(joined.WAITING).copy(), meter.copy()
            waiting.depth, waiting.programs = 0, []
            try:
                super().run(*arguments, **options)
            finally:
                vars(waiting).update(state)
                meter.clear()
                meter.update(counts)

    host_kernel.LaunchGraph = HostGraph
    device_graph.record_event = lambda device, event: None
    wp.is_conditional_graph_supported = lambda: True
    CommandBuffer._captured = lambda self, commands: list(commands)
    CommandBuffer._captured_loop = lambda self, condition: (
        lambda: wp.capture_launch([Loop(condition, self)])
    )


emulate_kernels()
emulate_decisions()
replayed()
