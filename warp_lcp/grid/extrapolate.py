"""Velocity from known faces to the faces around them, a layer of faces at a time."""

import typing
from collections.abc import Callable, Sequence

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, cell_kernel
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.transfer_kernels import TINY_WEIGHT
from warp_lcp.native import BLOCK, simd

BLOCKED = -1  # not to be filled
UNKNOWN = 0  # to be filled; positive: known since that layer, 1 from the start
REACH = 2  # layers around faces with weight: as far as the density of a cell tells of particles beyond its neighbors

# Faces first <= i < last of a row. A pass over the marks finds what to fill, so that rows without any cost a byte a face: with one thread
# a row in plain Warp a liquid of 276,000 cells spent 23 ms a step on its extrapolation, in this form it spends 8.
FILL_ROW = """
    const int nz = known_.shape[0], ny = known_.shape[1], nx = known_.shape[2];
    const long long s2 = nx, s1 = s2*ny, row = k*s1 + j*s2;
    signed char* known = (signed char*)known_.data + row; float* field = field_.data + row;
    // where there is no neighboring row the row itself stands in for it, and no mark is low enough to be a source
    const long long a = j > 0 ? -s2 : 0, b = j + 1 < ny ? s2 : 0, c = k > 0 ? -s1 : 0, d = k + 1 < nz ? s1 : 0;
    const signed char now = (signed char)layer;
    const signed char la = a ? now : 0, lb = b ? now : 0, lc = c ? now : 0, ld = d ? now : 0;
    auto source = [](signed char mark, signed char limit) { return (unsigned char)((mark > 0) & (mark <= limit)); };
    auto wanted = [&](long long i, signed char low, signed char high) {
        return (unsigned char)((known[i] == fill) & (source(known[i - (low > 0)], low) | source(known[i + (high > 0)], high)
            | source(known[i + a], la) | source(known[i + b], lb) | source(known[i + c], lc) | source(known[i + d], ld)));
    };
    auto mean = [&](long long i, signed char low, signed char high) {
        const int x0 = source(known[i - (low > 0)], low), x1 = source(known[i + (high > 0)], high), y0 = source(known[i + a], la);
        const int y1 = source(known[i + b], lb), z0 = source(known[i + c], lc), z1 = source(known[i + d], ld);
        const float total = (x0 ? field[i - (low > 0)] : 0.0f) + (x1 ? field[i + (high > 0)] : 0.0f) + (y0 ? field[i + a] : 0.0f)
            + (y1 ? field[i + b] : 0.0f) + (z0 ? field[i + c] : 0.0f) + (z1 ? field[i + d] : 0.0f);
        return total/(float)(x0 + x1 + y0 + y1 + z0 + z1);
    };
    auto fill_one = [&](long long i) {
        const signed char low = i > 0 ? now : 0, high = i + 1 < nx ? now : 0;
        if (wanted(i, low, high)) { field[i] = mean(i, low, high); known[i] = now + 1; }
    };
    #ifdef __CUDA_ARCH__
    for (int i = first; i < last; ++i) fill_one(i);
    #else
    if (first == 0) fill_one(0);
    const int from = first > 0 ? first : 1, end = last < nx ? last : nx - 1;
    for (int start = from; start < end; start += M) {
        const int n = end - start < M ? end - start : M;
        unsigned char fills[M], any = 0;
        MASKED for (int m = 0; m < n; ++m) { const unsigned char w = wanted(start + m, now, now); fills[m] = w; any |= w; }
        if (!any) continue;
        MASKED for (int m = 0; m < n; ++m) {
            const float value = mean(start + m, now, now);
            field[start + m] = fills[m] ? value : field[start + m];
        }
        MASKED for (int m = 0; m < n; ++m) known[start + m] = fills[m] ? (signed char)(now + 1) : known[start + m];
    }
    if (last == nx && nx > 1) fill_one(nx - 1);
    #endif
"""


@wp.func_native(simd(BLOCK + FILL_ROW))
@typing.no_type_check
def fill_row(  # noqa: D103
    known_: I8, field_: F32, layer: int, fill: int, k: int, j: int, first: int, last: int
): ...


@cell_kernel("warp_lcp.grid.extrapolate")
@typing.no_type_check
def layer_kernel(k, j, first, end, known: I8, field: F32, layer: int, fill: int):
    """Fill faces marked `fill` from neighbors known up to `layer`, and mark them layer + 1.

    In place without a race: a face that another thread fills in this launch is marked `fill` or layer + 1 and is not read either way.
    """
    fill_row(known, field, layer, fill, k, j, first, end)


@cell_kernel("warp_lcp.grid.extrapolate")
@typing.no_type_check
def weighted_kernel(k, j, i, least: float, weight: F32, known: I8):
    """Mark the faces that particles gave more weight than `least`."""
    known[k, j, i] = wp.where(weight[k, j, i] > least, wp.int8(1), wp.int8(0))


def complete(
    window: Window, velocity: Sequence[wp.array], weights: Sequence[wp.array], known: Sequence[wp.array],
    join: Callable[[wp.array, wp.array], None] | None = None,
) -> None:  # fmt: skip
    """Continue the particles' velocity to faces near them that none of them gave weight: cells may be full or dense beyond those.

    Args:
        window: faces to consider.
        velocity: of each component [m/s] (updated).
        weights: of the particles on each component's faces.
        known: scratch memory, int8, one field a component.
        join: as of `extrapolate`.
    """
    for field, weight, marks in zip(velocity, weights, known, strict=True):
        marks.zero_()
        window.launch(weighted_kernel, [TINY_WEIGHT, weight, marks])
        extrapolate(window, marks, field, REACH, join=join)


def extrapolate(
    window: Window, known: wp.array, field: wp.array, layers: int, *, start: int = 1, fill: int = UNKNOWN,
    join: Callable[[wp.array, wp.array], None] | None = None,
) -> None:  # fmt: skip
    """Give unknown faces the mean of their known neighbors, layer after layer.

    Args:
        window: faces to consider; `known` must not be positive outside it.
        known: int8, one value a face: positive where `field` is known, `UNKNOWN`, or `BLOCKED` (updated: layer + 1).
        field: one component of the velocity [m/s] (updated).
        layers: how many layers to fill, >= 0.
        start: faces marked 1..start are sources of the first layer.
        fill: the mark of the faces to fill, `UNKNOWN` or `BLOCKED`.
        join: called with known and field after each layer, where faces at two sides of the domain are the same.

    Raises:
        ValueError: the marks would not fit in int8.
    """
    if start + layers > 127:
        raise ValueError(f"layers = {layers} after layer {start}: at most 127 layers fit in int8")
    for layer in range(start, start + layers):
        window.launch(layer_kernel, [known, field, layer, fill])
        if join is not None:
            join(known, field)
