"""Native loops inside Warp kernels: one source that is a vectorized loop on the CPU and one element a thread on CUDA.

A Warp kernel with one thread a cell reaches 3 % of a CPU's memory bandwidth; one thread for a *grain* of contiguous elements with a
native inner loop reaches nearly all of it. clang vectorizes such a loop only if it is told that the arrays do not alias and if
conditionals are written as selections of values that are computed anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

CPU_CHUNK = 8192  # elements of a flat field a CPU thread takes: its operands stay in the L2 cache between fused loops
CUDA_THREADS = 1 << 16  # threads of a flat reduction, several waves of a large GPU
BLOCK = "\n#ifdef __CUDA_ARCH__\nenum { M = 1 };\n#else\nenum { M = 128 };\n#endif\n"  # cells that a row function buffers at a time
CUDA_BLOCK = 256  # threads that add up partial sums
CUDA_SEGMENTS = 256  # blocks that do so first where there are very many

AHEAD = 512  # elements: at 128^3 and 256^3 fetching so far ahead made passes over many fields 20 to 25 % faster

# pragmas of a loop add up
MASKS = """
#if defined(__AVX512BW__) && defined(__AVX512VL__)
#pragma clang loop vectorize_predicate(enable)
#endif
"""

C_TYPES = {wp.uint8: "unsigned char", wp.float32: "float", wp.float64: "double"}


def simd(source: str) -> str:
    """Return the body of a native function: `SIMD for` becomes a vectorized loop, sums may be taken in any order.

    `SIMD8 for` takes half as many elements at a time, which is faster where most of them are doubles; `SIMD64 for` is for bytes.
    `MASKED for` takes what is left of a row after its last whole vector as a vector with a mask, where the processor has masks, instead
    of element by element: for short rows with much work an element.
    """
    pragma = "\n#ifndef __CUDA_ARCH__\n#pragma clang loop vectorize(assume_safety) vectorize_width({}) interleave_count(1)\n#endif\n"
    head = "\n#ifndef __CUDA_ARCH__\n#pragma clang fp reassociate(on) contract(fast)\n#endif\n"
    source = source.replace("MASKED ", MASKS + "SIMD ")
    for word, width in (("SIMD64 ", 64), ("SIMD8 ", 8), ("SIMD ", 16)):
        source = source.replace(word, pragma.format(width))
    return head + source + "\n"


def fetch(begin: str, end: str, **pointers: int) -> str:
    """Return a loop that asks for the cache lines which elements begin ... end of fields will need `AHEAD` elements later.

    The processor's own prefetching does not keep up with a pass over seven fields or more whose rows are short. A request is no fault
    wherever it points. It cannot stand in a vectorized loop, so it comes before each block of one.

    Args:
        begin: first element.
        end: one past the last.
        pointers: bytes of an element, by name of the pointer to it.
    """
    loops = [f"for (int i = {begin}; i < {end}; i += {64 // size}) __builtin_prefetch({p} + i + {AHEAD});" for p, size in pointers.items()]
    return "\n#ifndef __CUDA_ARCH__\n" + " ".join(loops) + "\n#endif\n"


@dataclass(frozen=True)
class Spans:
    """How the n elements of a flat field are shared out: contiguous chunks on the CPU, strided (coalesced) threads on CUDA."""

    n: int
    threads: int
    chunk: int
    stride: int

    @staticmethod
    def of(n: int, device: wp.Device) -> Spans:
        """Return the spans for n elements on a device."""
        if device.is_cuda:
            threads = min(n, CUDA_THREADS)
            return Spans(n, threads, 0, threads)
        return Spans(n, -(-n // CPU_CHUNK), CPU_CHUNK, 1)


def grain(n: int, device: wp.Device) -> int:
    """Return how many cells of a row of n cells one thread takes."""
    return 1 if device.is_cuda else n
