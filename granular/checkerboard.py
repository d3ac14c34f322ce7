# mypy: ignore-errors
"""Damping of the pattern that exerts no force: a checkerboard in the pressure and one in the shear balance each other on every face.

Noise in the fraction feeds the pattern and no equation takes it away. Where p = (-1)^(i + j), the shear stress with -p at a cell's low-low
corner, +p at the two mixed ones and -p at high-high cancels grad p; in 3-D half of that on the edges of each shear does. So a part of what
of the pressure alternates in all directions, (-1, 2, -1)/4 along each axis, can be taken from p and added to the copies with those signs,
and no velocity changes. Only cells deep in dense sand take part, away from solids that cut cells.
"""

import functools

import warp as wp

from granular.yield_set import SHAPE, native
from warp_lcp.grid.cell_kernel import F32, U8, cell_kernel

DAMPED = 0.15  # of the pattern in a step

DAMP = (
    SHAPE
    + """
    const unsigned char* flags = flags_.data + row; const float* from = from_.data + row; float* now = now_.data + row;
    const float* share[3] = {share_x.data + row, share_y.data + (DIM == 3 ? row : 0), share_z.data + (DIM == 3 ? row : 0)};
    for (int i = first; i < last; ++i) {
        if (!(flags[i] & SHEARS_HERE) || flags[i] & PARTLY) continue;
        bool deep = true; float pattern = 0.0f;
        for (int c = DIM == 3 ? -1 : 0; c <= (DIM == 3 ? 1 : 0); ++c) for (int b = -1; b <= 1; ++b) for (int a = -1; a <= 1; ++a) {
            const long long o = i + a + b*s[1] + c*s[2];
            deep = deep && (flags[o] & SHEARS_HERE);
            const float weight = (a ? -0.25f : 0.5f)*(b ? -0.25f : 0.5f)*(DIM == 2 ? 1.0f : c ? -0.25f : 0.5f);
            pattern += weight*from[o];
        }
        for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q)
            deep = deep && share[d][i + (q & 1)*s[ALPHA[d]] + (q >> 1)*s[BETA[d]]] > 0.0f;
        const float by = (float)DAMPED*pattern;
        if (!deep || from[i] < by) continue;
        now[i] = from[i] - by;
        for (int d = 0; d < SHEARS; ++d) for (int q = 0; q < 4; ++q)
            now[(FIRST + 4*d + q)*layer + i] += (DIM == 3 ? 0.5f : 1.0f)*((q == 0 || q == 3) ? by : -by);
    }
"""
)

_STRESS = wp.array4d(dtype=wp.float32)


@functools.cache
def damping_kernel(dimension: int) -> wp.Kernel:
    """Return the kernel for 2 or 3 dimensions."""

    @wp.func_native(native(DAMP, dimension, wp.float32, box=False, DAMPED=DAMPED))
    def damp_row(
        flags_: U8, share_x: F32, share_y: F32, share_z: F32, from_: _STRESS, now_: _STRESS, k: int, j: int, first: int, last: int
    ): ...  # fmt: skip

    @cell_kernel(f"granular.checkerboard_{dimension}d")
    def damp(k, j, first, end, flags: U8, share_x: F32, share_y: F32, share_z: F32, source: _STRESS, now: _STRESS):
        """Take a part of the pattern from `now`, found in `source`, which holds the same."""
        damp_row(flags, share_x, share_y, share_z, source, now, k, j, first, end)

    return damp
