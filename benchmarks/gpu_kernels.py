# mypy: ignore-errors
"""Comparison of each kernel on a device with the same kernel on the CPU.

Run `python -m benchmarks.gpu_kernels [DEVICE]` in the source tree. While solves and steps run, each
kernel is launched once more on the CPU, with copies of all arrays from before the launch, and the
results of both are compared. With `--rehearse` the device is the CPU in CUDA's form with another
order of threads, against the CPU's own form.
"""

import importlib
import sys

if "--rehearse" in sys.argv:
    importlib.import_module("benchmarks.emulated_cuda")  # must precede the package

# ruff: isort: split

import ast
import contextlib
import ctypes
import functools
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path
from unittest import mock

import numpy as np
import warp as wp
from warp._src import build, codegen, context
from warp._src.types import array_t, launch_bounds_t

from warp_lcp.benchmarks import gpu_cases
from warp_lcp.kernels.launch_graph import CommandBuffer

# Comparisons of each variant of a kernel: two sizes, and of each the first launch of sixteen that
# writes something.
SIZES, TRIES = 2, 16
STEPS = 3  # of each scene
# Relative to the largest number that is written, or was there before.
ALLOWED = {"float32": 1e-5, "float64": 1e-12}
ENDLESS = 1e20  # larger numbers represent infinity, and are compared one by one
ROOM, LINE = 4096, 64  # bytes around a copy, for reads beyond arrays, and bytes of alignment
TEMPLATES = (
    "cpu_module_header",
    "cpu_module_template_forward",
    "cpu_block_module_template_forward",
    "cpu_block_entry_body_forward",
)
EMULATED, INVOKE = sys.modules.get("benchmarks.emulated_cuda"), context.invoke


def roots(parents, _):
    """Return the root of each cell's tree."""
    inside, found = (parents >= 0) & (parents < len(parents)), parents
    while not np.array_equal(
        further := np.where(inside, parents[np.where(inside, found, 0)], found), found
    ):
        found = further
    return found


def in_order(numbers, _):
    """Return the sorted entries of lists that depend on the order of threads."""
    return np.sort(numbers)


def totals(numbers, threads):
    """Return the totals of nine sums and seven maxima of each thread."""
    columns = numbers[: 16 * threads].reshape(16, threads)
    return np.concatenate([columns[:9].sum(axis=1), columns[9:].max(axis=1)])


# Kernels (module:name) whose integers (i) or floats (f) depend on the order or number of threads,
# and a function of them that does not.
UNORDERED = {
    "warp_lcp.components*:components_unite": ("i", roots),
    "warp_lcp.material.ballistic_fragments:unite": ("i", roots),
    "warp_lcp.material.ballistic_fragments:board_kernel": ("i", in_order),
    "warp_lcp.grid.node_distance:claim_groups": ("i", in_order),
    "warp_lcp.grid.particles:total": ("f", totals),  # on CUDA a thread sums other particles
}
# Kernels whose float64 numbers are computed from numbers rounded to float32.
SINGLE = (
    "warp_lcp.projected_multigrid.measure.*_float32*:*",
    "*conjugate_gradient.update.float32*:*",
    "*conjugate_gradient.step.*float32*",
    "warp_lcp.grid.particles:total",
    "warp_lcp.grid.volume:*",
    "warp_lcp.material.crowding:*",
    "warp_lcp.material.density_correction*",
    "granular.stress_*",
    "granular.report*",
)
# The tolerance is a hundred times as large: rounding errors of a stage are amplified by later ones.
MANY_STAGES = ("warp_lcp.small_levels.*",)
# x less its last step is rounding error from x = 0: the error is relative to the size of x.
CANCEL = ("warp_lcp.projected_multigrid.undo.*",)
# On a CPU one thread adds all, see `particles.h`.
ONE_THREAD = ("warp_lcp.grid.transfer_*.scatter.*", "warp_lcp.grid.density.scatter_density.*")


def among(name, patterns):
    """Return whether a kernel's name matches one of some patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def arrays_in(arguments):
    """Yield the arrays of parameters, element types and sizes in bytes.

    Arrays in structs count as well.
    """
    for value, kind in arguments:
        if isinstance(value, array_t):
            shape, strides = value.shape[: value.ndim], value.strides[: value.ndim]
            size = wp.types.type_size_in_bytes(kind.dtype) + sum(
                (n - 1) * step for n, step in zip(shape, strides, strict=True)
            )
            yield value, kind.dtype, size if value.data and all(shape) else 0
        elif isinstance(kind, codegen.Struct):
            yield from arrays_in(
                (getattr(value, name), var.type) for name, var in kind.vars.items()
            )


def members(memory, table, dtype):
    """Return the structs of a table with their type; [] for other tables."""
    if not isinstance(dtype, codegen.Struct):
        return []
    assert table.ndim == 1, "tables of structs are lists"
    return [
        (dtype.ctype.from_buffer(memory, i * table.strides[0]), dtype)
        for i in range(table.shape[0])
    ]


def has_handle(kind):
    """Return whether a parameter holds a handle, such as that of a mesh of Warp."""
    return kind is wp.uint64 or (
        isinstance(kind, codegen.Struct) and any(has_handle(var.type) for var in kind.vars.values())
    )


def native(kind):
    """Return the C type of a parameter."""
    if isinstance(kind, codegen.Struct):
        return kind.ctype
    return (
        array_t
        if wp.types.is_array(kind)
        else kind
        if issubclass(kind, ctypes.Array)
        else kind._type_
    )


class LaunchCopies:
    """Copies of the arrays of a launch on the CPU.

    They overlap as the arrays on the device do.

    Args:
        device: of the arrays.
        given: parameters, with their types (updated: addresses become those of the copies).
    """

    def __init__(self, device, arguments):
        self.device, self.arrays, spans = device, {}, []
        self._collect(arguments)
        for address, size, _ in sorted(self.arrays, key=lambda found: found[:2]):
            if not spans or address >= spans[-1][1]:
                spans.append([address, address])
            spans[-1][1] = max(spans[-1][1], address + size)
        self.blocks = [(begin, self._copied(begin, end - begin)) for begin, end in spans]
        self.before = [copy.copy() for _, copy in self.blocks]
        self._move(arguments)

    def there(self):
        """Return the present contents of the device's arrays."""
        return [self._read(begin, len(copy)) for begin, copy in self.blocks]

    def views(self, blocks):
        """Return the numbers of each array, from blocks such as `before`.

        Arrays of structs hold addresses and are left out.
        """
        views = []
        for address, size, dtype in self.arrays:
            if not isinstance(dtype, codegen.Struct):
                at, begin = max(
                    (i, begin) for i, (begin, _) in enumerate(self.blocks) if begin <= address
                )
                kind = np.dtype(wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype)))
                views.append(
                    blocks[at][address - begin : address - begin + size].view(
                        np.uint8 if kind.kind == "b" else kind
                    )
                )
        return views

    def _read(self, address, size):
        return wp.array(ptr=address, dtype=wp.uint8, shape=size, device=self.device).numpy().copy()

    def _copied(self, address, size):
        memory = np.zeros(size + 2 * ROOM + LINE, dtype=np.uint8)
        begin = ROOM + (address - memory.ctypes.data - ROOM) % LINE
        memory[begin : begin + size] = self._read(address, size)
        return memory[begin : begin + size]

    def _collect(self, given):
        for a, dtype, size in arrays_in(given):
            if size:
                self.arrays[a.data, size, dtype] = None
                self._collect(members(self._read(a.data, size), a, dtype))

    def _move(self, arguments):
        for a, dtype, size in arrays_in(arguments):
            at = next(
                (
                    (begin, copy)
                    for begin, copy in self.blocks
                    if size and begin <= a.data < begin + len(copy)
                ),
                None,
            )
            if at:
                offset = a.data - at[0]
                a.data = at[1].ctypes.data + offset
                self._move(members(at[1][offset : offset + size], a, dtype))


class KernelCheck:
    """Comparison of launches, with counts.

    Args:
        device: Warp device.
    """

    def __init__(self, device):
        self.device, self.tried, self.compared = wp.get_device(device), Counter(), Counter()
        self.left_out, self.differs, self.unnoticed, self.arrays, self.worst = (
            set(),
            {},
            set(),
            0,
            (0.0, ""),
        )
        self._here, self.busy = {}, False

    def launch(self, kernel, addresses, run):
        """Launch a kernel by `run`, and compare it if it is still to be compared.

        The launch bounds and arguments are at the addresses.
        """
        name, kinds = f"{kernel.module.name}:{kernel.key}", [arg.type for arg in kernel.adj.args]
        types = [type(launch_bounds_t((1,) * kernel.adj.kernel_dim)), *map(native, kinds)]
        bounds, *values = (
            t.from_buffer_copy(ctypes.string_at(at, ctypes.sizeof(t)))
            for t, at in zip(types, addresses, strict=False)
        )
        arguments = list(zip(values, kinds, strict=True))
        form = name, tuple(bool(a.data) for a, *_ in arrays_in(arguments))
        sized = (*form, tuple(bounds.shape))
        known = self.compared[form] == SIZES or sized in self.compared or self.tried[sized] == TRIES
        if known or self.busy or context.runtime.captures:
            return run()
        if any(map(has_handle, kinds)):
            self.left_out.add(name)
            return run()
        self.tried[sized] += 1
        self.busy = True
        copies = LaunchCopies(self.device, arguments)
        self._launch_here(kernel, name, bounds, values)
        done = run()
        if self._compare(name, bounds.size, copies):
            self.compared.update((form, sized))
        self.busy = False
        return done

    def _launch_here(self, kernel, name, bounds, values):
        """Launch a kernel on the CPU.

        A kernel of blocks that takes the number of threads of a block gets 1.
        """
        labels = [arg.label for arg in kernel.adj.args]
        if "threads" in labels:
            threads = values[labels.index("threads")]
            size, threads.value = bounds.size // threads.value, 1
            bounds = context._build_launch_bounds_from_tuple((size,), kernel.adj.kernel_dim)
        elif among(name, ONE_THREAD):
            bounds = launch_bounds_t((1,) * kernel.adj.kernel_dim)
        if kernel not in self._here:
            with as_on_cpu(kernel.module):
                loaded = kernel.module.load(wp.get_device("cpu"), 1)
            self._here[kernel] = loaded, loaded.get_kernel_hooks(kernel)
        INVOKE(kernel, self._here[kernel][1], [bounds, *values], False)

    def _compare(self, name, threads, copies):
        """Compare the results, and return whether the kernel wrote anything."""
        arrays, blocks = (
            self.arrays,
            (copies.before, [copy for _, copy in copies.blocks], copies.there()),
        )
        of_kind, stays = next(
            (what for known, what in UNORDERED.items() if fnmatchcase(name, known)), ("", None)
        )
        for before, here, threads_result in zip(*map(copies.views, blocks), strict=True):
            written, kind = (
                (bits(before) != bits(here)) | (bits(before) != bits(threads_result)),
                here.dtype,
            )
            if not written.any():
                continue
            allowed = ALLOWED.get(
                "float32" if kind.kind == "f" and among(name, SINGLE) else kind.name, 0.0
            )
            allowed *= 100 if among(name, MANY_STAGES) else 1
            size = max(largest(here[written]), largest(before[written]))
            if among(name, CANCEL):
                size = max(largest(x) for x in copies.views(copies.before) if x.dtype == kind)
            if kind.kind == of_kind:
                here, threads_result = stays(here, threads), stays(threads_result, threads)
                written, size = np.ones(len(here), dtype=bool), largest(here)
            off = difference(here, threads_result, size)
            self.arrays += 1
            self.worst = max(self.worst, (off / (allowed or 1.0), name))
            if off > allowed:
                count = np.count_nonzero(bits(here) != bits(threads_result))
                self.differs[name] = (
                    f"{name} is off by {off:.0e} in {count} of {written.sum()} {kind}"
                )
            if (
                not difference(here, spoiled(threads_result, written, allowed * size), size)
                > allowed
            ):
                self.unnoticed.add(name)
        return self.arrays > arrays

    def found(self):
        """Return the summary of comparisons, and the differences."""
        launches = [key for key in self.compared if len(key) == 3]
        kernels = {name for name, *_ in launches}
        idle = {name for name, *_ in self.tried} - kernels
        text = (
            f"{len(launches)} launches of {len(kernels)} kernels, at most {self.worst[0]:.1g} "
            f"of what is allowed ({self.worst[1]})"
        )
        text += (
            f"; a wrong number is noticed in all {self.arrays} arrays; {len(idle)} more "
            "kernels wrote nothing"
        )
        wrong = [
            *self.differs.values(),
            *(f"{name}: a wrong number is not noticed" for name in self.unnoticed),
        ]
        return (
            f"{text}; left out: {len(self.left_out)} (they ask meshes, which stay on the device)",
            wrong or ["nothing"] * (not launches),
        )


def bits(a):
    """Return numbers as unsigned integers."""
    return a.view(f"u{a.itemsize}")


def largest(a):
    """Return the largest number that does not represent infinity."""
    with np.errstate(invalid="ignore"):
        a = np.abs(a.astype(np.float64))
    return float(a[a < ENDLESS].max(initial=0.0))


def difference(here, other_result, size):
    """Return the largest difference, relative to the larger of size and number.

    For integers: whether any number differs.
    """
    other = bits(here) != bits(other_result)
    if here.dtype.kind != "f":
        return float(other.any())
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = here[other].astype(np.float64), other_result[other].astype(np.float64)
        off = np.where(
            (a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b) / np.maximum(np.abs(a), size)
        )
    return float(np.nan_to_num(off, nan=np.inf).max(initial=0.0))


def spoiled(a, written, allowed):
    """Return a copy of results with one wrong number, to test the comparison.

    A number that was written and is finite is changed by three times the tolerance, if there is
    one.
    """
    wrong, finite = a.copy(), written & (np.abs(a) < ENDLESS)
    at = int(np.argmax(finite if finite.any() else written))
    wrong[at] = (
        ~a[at] if a.dtype.kind != "f" else a[at] + (3 * allowed or 1.0) if finite.any() else 0.0
    )
    return wrong


@functools.cache
def templates():
    """Return Warp's own CPU kernel templates, without the emulation's changes."""
    body = ast.parse(Path(codegen.__file__).read_text()).body
    made = {
        node.targets[0].id: node.value
        for node in body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    return {name: ast.literal_eval(made[name]) for name in TEMPLATES}


@contextlib.contextmanager
def as_on_cpu(module):
    """Use a module's own CPU code in a `with` block, not the emulated CUDA code.

    Kernels come from Warp's own cache.
    """
    with contextlib.ExitStack() as stack:
        if EMULATED:
            stack.enter_context(mock.patch.multiple(codegen, **templates()))
            stack.enter_context(mock.patch.object(wp.config, "kernel_cache_dir"))
            stack.enter_context(mock.patch.dict(module.execs, clear=True))
            build.init_kernel_cache()
        yield


def one_by_one(program):
    """Run a program without a graph."""
    program._launch()
    program._runs += 1


def looked_after(program, condition):
    """Repeat a program while its condition holds, tested on the host."""
    wp.capture_while(condition, program._run_in_time)


@contextlib.contextmanager
def heard(check):
    """Send every launch through a comparison.

    Programs are launched kernel by kernel.
    """
    core, kernels, hooks_of = context.runtime.core, {}, context.ModuleExec.get_kernel_hooks
    on_cuda = core.wp_cuda_launch_kernel

    def known(loaded, kernel):
        hooks = hooks_of(loaded, kernel)
        kernels[ctypes.cast(hooks.forward, ctypes.c_void_p).value] = kernel
        return hooks

    # Parameters: context, function, threads, most blocks, threads of a block, strides, clusters,
    # shared bytes, parameters, ...
    def launch(*args):
        kernel, run = kernels.get(args[1]), lambda: on_cuda(*args)
        return check.launch(kernel, args[8], run) if kernel else run()

    def emulated(invoke):
        return lambda kernel, *rest: check.launch(
            kernel, [ctypes.addressof(p) for p in rest[1]], lambda: invoke(kernel, *rest)
        )

    with contextlib.ExitStack() as stack:
        stack.enter_context(
            mock.patch.multiple(CommandBuffer, run=one_by_one, run_while=looked_after)
        )
        if EMULATED:
            for name in ("invoke", "invoke_cpu_blocks"):
                stack.enter_context(
                    mock.patch.object(context, name, emulated(getattr(context, name)))
                )
        else:
            stack.enter_context(mock.patch.object(context.ModuleExec, "get_kernel_hooks", known))
            stack.enter_context(mock.patch.object(core, "wp_cuda_launch_kernel", launch))
        yield


def stepped(scene, device):
    """Step a scene."""
    assert list(gpu_cases.states(scene, device, STEPS))


def main():
    """Compare, and print a summary in the last line; return 3 after differences."""
    given, broken = [argument for argument in sys.argv[1:] if not argument.startswith("-")], []
    wp.init()
    check = KernelCheck(*(given or ["cpu" if EMULATED else "cuda:0"]))
    steps = [functools.partial(stepped, scene) for scene in gpu_cases.SCENES]
    with heard(check):
        for work in (
            functools.partial(gpu_cases.large, n=32),
            *steps,
            gpu_cases.shapes,
            gpu_cases.methods,
        ):
            try:
                work(check.device.alias)
            except Exception as error:  # wrong kernels can cause any error
                broken.append(f"{type(error).__name__}: {error}")
            check.busy = False
    text, wrong = check.found()
    print("\n" + ("; ".join(wrong + broken) or text))
    return 3 * bool(wrong + broken)


if __name__ == "__main__":
    sys.exit(main())
