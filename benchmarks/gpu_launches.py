"""Instruction counts of launches of a step, made when each kernel is first launched.

A launch is executed on the memory that it reads, before it runs in the emulation
(`benchmarks/emulated_cuda.py`): later launches overwrite some of it. All kinds of kernels are
counted: over boxes, lists and rows with gaps, and Warp kernels without a declaration. Kernels of
one block that meet at barriers, as the small levels of a cycle, are not.
"""

from benchmarks import emulated_cuda  # must precede the package

# ruff: isort: split

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.gpu_counts import BLOCK, WARP, InstructionCount
from benchmarks.machine_code import Kernel, assemble
from benchmarks.machine_counts import issued, mean_of
from benchmarks.machine_memory import ProcessMemory, constants_of, packed

WARPS = 16  # warps of a launch that are executed
FAILURES = (NotImplementedError, LookupError, RuntimeError, AssertionError)


class LaunchCounter:
    """Counts of the first launch of each kernel.

    Args:
        folder: for what is compiled.

    Attributes:
        counts: by key.
        failures: reasons of kernels that were not counted, by key.
    """

    def __init__(self, folder: Path) -> None:
        self.counts: dict[str, InstructionCount] = {}
        self.failures: dict[str, str] = {}
        self._folder = folder
        self._modules: dict[str, list[Kernel]] = {}

    def count(self, key: str, kernel: Any, params: list[Any], cells: float) -> None:
        """Count a launch, if none with this key has been counted.

        Args:
            key: of the count.
            kernel: Warp's.
            params: its launch bounds and arguments, as Warp passes them.
            cells: that it visits.
        """
        if not key or key in self.counts or key in self.failures or not params[0].size:
            return
        try:
            self.counts[key] = self._counted(key, kernel, params, cells)
        except FAILURES as error:
            self.failures[key] = f"{error!r}"

    def _counted(self, key: str, kernel: Any, params: list[Any], cells: float) -> InstructionCount:
        threads = params[0].size
        code = self._compiled(kernel)
        constants = constants_of(packed(params), BLOCK, -(-threads // BLOCK))
        memory = ProcessMemory()
        every = -(-threads // WARP)
        taken = min(WARPS, every)
        firsts = [every * (2 * i + 1) // (2 * taken) * WARP for i in range(taken)]
        counts = mean_of(
            [
                issued(
                    code.code,
                    constants,
                    memory,
                    [(t % BLOCK, t // BLOCK) for t in range(t0, min(t0 + WARP, threads))],
                )
                for t0 in firsts
            ]
        )
        arrays: dict[int, tuple[int, Any]] = {}
        for argument, value in zip(kernel.adj.args, params[1:], strict=False):
            emulated_cuda.arrays_of(value, argument.type, arrays)
        moved = sum(
            size
            for reached in (counts.read, counts.written)
            for begin, size in spans_of(arrays)
            if any(begin <= address < begin + size for address in reached)
        )
        return InstructionCount(
            key,
            counts,
            cells=cells / threads,
            waits=counts.waits,
            registers=code.registers,
            bytes=moved / max(cells, 1),
            spilled=code.spilled,
        )

    def _compiled(self, kernel: Any) -> Kernel:
        """Return a kernel compiled for sm_90."""
        module = kernel.module
        if module.name not in self._modules:
            place = self._folder / module.name
            options = dict(module.options)
            # As on a GPU; the emulation compiles kernels for the CPU without optimization.
            module.options |= {"block_dim": BLOCK, "optimization_level": 3}
            wp.compile_aot_module(
                module.name, device=None, arch=[90], module_dir=place, use_ptx=True
            )
            module.options.update(options)
            (ptx,) = place.glob("*.ptx")
            self._modules[module.name] = assemble(ptx.read_text(), place / "module.cubin")
        pattern = f"{re.escape(kernel.key)}_[0-9a-f]+_cuda_kernel_forward"
        made = [one for one in self._modules[module.name] if re.fullmatch(pattern, one.name)]
        if len(made) > 1:  # overloads for several types
            made = [one for one in made if one.name.startswith(kernel.get_mangled_name())]
        if len(made) != 1:
            raise RuntimeError(f"{len(made)} kernels {kernel.key} in {module.name}")
        return made[0]


def spans_of(arrays: dict[int, tuple[int, Any]]) -> Iterator[tuple[int, int]]:
    """Yield address and size of the arrays, of those that overlap the first alone."""
    end = 0
    for begin, (size, _) in sorted(arrays.items()):
        if size and begin >= end:
            yield begin, size
            end = begin + size
