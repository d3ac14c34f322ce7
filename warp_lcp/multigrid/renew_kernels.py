# mypy: ignore-errors
"""Kernels that take an operator's new rows: they clear what its old rows leave behind, and mark the rows that are others now."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import simd
from warp_lcp.operators.stencil_kernels import StencilShape

SIGN = """
unsigned one = 0, two = 0;
auto add = [&](const auto* w, unsigned seed) {
    const unsigned* bits = (const unsigned*)(w + p); const int words = (n + 1)*(int)(sizeof(*w)/4);  // the last cell's upper face as well
    SIMD for (int k = 0; k < words; ++k) {
        unsigned v = bits[k]*0x9E3779B1u + ((unsigned)k + seed)*0x85EBCA77u; v ^= v >> 15; v *= 0x2C1B3C6Du; v ^= v >> 12; one += v;
        unsigned u = (bits[k] ^ 0xC2B2AE3Du)*0x27D4EB2Fu + ((unsigned)k + seed)*0x165667B1u; u ^= u >> 13; u *= 0x297A2D39u; u ^= u >> 16;
        two += u; } };
add(wx.data, 1u << 20); add(wy.data, 2u << 20); add(wz.data, 3u << 20);
return ((unsigned long long)one << 32) | two;
"""


@functools.cache
def renew_kernels(d_type: Any, real: Any) -> SimpleNamespace:
    """Return `renew`, for the fields and the spans of a level, and `sign`, for the weights of the finest one; a row a thread."""
    name = f"warp_lcp.renew.{d_type.__name__}_{real.__name__}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)
    flags, spans, signs = wp.array2d(dtype=wp.uint8), wp.array2d(dtype=wp.vec2i), wp.array2d(dtype=wp.uint64)

    @wp.func_native("for (int i = first; i < end; ++i) v.data[row + i] = 0;\n")
    def clear(v: wp.array(dtype=Any), row: wp.int64, first: int, end: int): ...

    @wp.func_native(simd(SIGN))
    def sign_row(wx: field, wy: field, wz: field, p: wp.int64, n: int) -> wp.uint64: ...

    @wp.func
    def clear_all(x: field, b: field, t: field, d: d_array, wx: field, wy: field, wz: field, row: wp.int64, first: int, end: int):
        clear(x, row, first, end)
        clear(b, row, first, end)
        clear(t, row, first, end)
        clear(d, row, first, end)
        if wx:
            clear(wx, row, first, end)
            clear(wy, row, first, end)
            clear(wz, row, first, end)

    @wp.kernel(enable_backward=False, module=name)
    def renew(
        A: StencilShape, known: spans, changed: flags, x: field, b: field, t: field, d: d_array, wx: field, wy: field, wz: field
    ):  # fmt: skip
        """Clear what lies in a row's old span and not in its new one, and mark the row."""
        k, j = wp.tid()
        old = known[k, j]
        new = A.spans[k, j]
        if old[0] != new[0] or old[1] != new[1]:
            row = wp.int64(k + 1) * A.s1 + wp.int64(j + 1) * A.s2 + wp.int64(1)
            clear_all(x, b, t, d, wx, wy, wz, row, old[0], wp.min(old[1], new[0]))
            clear_all(x, b, t, d, wx, wy, wz, row, wp.max(old[0], new[1]), old[1])
            known[k, j] = new
            changed[k, j] = wp.uint8(1)

    @wp.kernel(enable_backward=False, module=name)
    def sign(A: StencilShape, wx: field, wy: field, wz: field, known: signs, changed: flags):
        """Mark the row if 64 bits that its weights hash to are others than they were."""
        k, j = wp.tid()
        first = A.spans[k, j][0]
        p = wp.int64(k + 1) * A.s1 + wp.int64(j + 1) * A.s2 + wp.int64(1 + first)
        now = sign_row(wx, wy, wz, p, A.spans[k, j][1] - first)
        if now != known[k, j]:
            known[k, j] = now
            changed[k, j] = wp.uint8(1)

    return SimpleNamespace(renew=renew, sign=sign)
