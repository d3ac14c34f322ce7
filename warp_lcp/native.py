"""Native loops inside Warp kernels: one source that is a vectorized loop on the CPU and one element a thread on CUDA.

A Warp kernel with one thread a cell reaches 3 % of a CPU's memory bandwidth; one thread for a *grain* of contiguous elements with a
native inner loop reaches nearly all of it. clang vectorizes such a loop only if it is told that the arrays do not alias and if
conditionals are written as selections of values that are computed anyway.
"""

from __future__ import annotations

import warp as wp

CPU_CHUNK = 8192  # elements of a flat field a CPU thread takes: its operands stay in the L2 cache between fused loops
CUDA_THREADS = 1 << 16  # threads of a flat reduction, several waves of a large GPU
CUDA_BLOCK = 256  # threads that add up partial sums
CUDA_SEGMENTS = 256  # blocks that do so first where there are very many

C_TYPES = {wp.uint8: "unsigned char", wp.float32: "float", wp.float64: "double"}


def grain(n: int, device: wp.Device) -> int:
    """Return how many cells of a row of n cells one thread takes."""
    return 1 if device.is_cuda else n
