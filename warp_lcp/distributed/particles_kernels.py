# mypy: ignore-errors
"""The kernel that tells which particles other ranks must know of."""

import warp as wp

from warp_lcp.grid.particle_loops import particle_loop

INNER, BORDER, OUTSIDE = 0, 1, 2  # of a box: in it and away from its cuts, within reach of them, beyond them

WHERE = """
    typedef float T;
    const T* position = (const T*)x_.data; unsigned char* where = where_.data;
    const T low[3] = {low_[0], low_[1], low_[2]}, high[3] = {high_[0], high_[1], high_[2]};
    GRID_COORDINATE
    SIMD for (int p = first; p < last; ++p) {
        const long long q = 3*(long long)p;
        const T x = grid_coordinate(position[q]), y = grid_coordinate(position[q + 1]), z = grid_coordinate(position[q + 2]);
        const int in = (int)(x >= low[0]) & (int)(x < high[0]) & (int)(y >= low[1]) & (int)(y < high[1])
            & (int)(z >= low[2]) & (int)(z < high[2]);
        const int away = (int)(x >= low[0] + reach) & (int)(x < high[0] - reach) & (int)(y >= low[1] + reach) & (int)(y < high[1] - reach)
            & (int)(z >= low[2] + reach) & (int)(z < high[2] - reach);
        where[p] = (unsigned char)(2 - in - away);
    }
"""


@wp.func_native(particle_loop(WHERE))
def where_some(
    inverse_dx: float, low_: wp.vec3, high_: wp.vec3, reach: float, x_: wp.array(dtype=wp.vec3), where_: wp.array(dtype=wp.uint8),
    first: int, last: int,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="warp_lcp.distributed.particles")
def where_kernel(
    count: int, grain: int, inverse_dx: float, low: wp.vec3, high: wp.vec3, reach: float, position: wp.array(dtype=wp.vec3),
    where: wp.array(dtype=wp.uint8),
):  # fmt: skip
    """Say where particles are: a box begins at the grid coordinates `low` and ends at `high`; `reach` is in cells."""
    first = wp.tid() * grain
    where_some(inverse_dx, low, high, reach, position, where, first, wp.min(first + grain, count))
