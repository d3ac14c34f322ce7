"""Native loops over particles: how they are shared out, and the one formula for a particle's grid coordinate.

Written plainly, one thread a particle, the transfers take 71 and 74 ns a particle in 3-D and the advection 129 (one core, 8 particles a
cell, sorted); as native loops over a grain of particles they take 25, 12 and 34. clang vectorizes a loop whose arrays it is told not to
alias, gathers from the fields included.
"""

import typing

import warp as wp

from warp_lcp.native import simd

CPU_GRAIN = 1024  # particles that a CPU thread takes: the launch then costs nothing, the arrays stay in the L2 cache

# Coordinates are rounded after each operation, unlike the rest, so that every kernel finds a particle in the same cell. Taking off the
# cells before a part of a grid is exact, as they are a whole number below the coordinate.
GRID_COORDINATE = """
    auto grid_coordinate = [=](T x, int before = 0) -> T {
    #ifdef __CUDA_ARCH__
        if (sizeof(T) == 4) return (T)__fsub_rn(__fadd_rn(__fmul_rn((float)x, (float)inverse_dx), 1.0f), (float)before);
        return (T)__dsub_rn(__dadd_rn(__dmul_rn((double)x, (double)inverse_dx), 1.0), (double)before);
    #else
        #pragma clang fp contract(off) reassociate(off)
        const T scaled = x*inverse_dx;
        const T coordinate = scaled + (T)1;
        return coordinate - (T)before;
    #endif
    };
"""


def particle_loop(source: str) -> str:
    """Return the body of a native function over particles first <= p < last, with `grid_coordinate(x, cells before)` if wanted."""
    return simd(source.replace("GRID_COORDINATE", GRID_COORDINATE))


def grain(device: wp.Device) -> int:
    """Return how many particles one thread takes."""
    return 1 if device.is_cuda else CPU_GRAIN


def launch(kernel: wp.Kernel, count: int, inputs: list[typing.Any], device: wp.Device) -> None:
    """Launch kernel(count, grain, *inputs), whose thread t takes the particles from t * grain on."""
    each = grain(device)
    wp.launch(kernel, -(-count // each), [count, each, *inputs], device=device)
