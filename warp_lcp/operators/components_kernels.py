# mypy: ignore-errors
"""Kernels that find connected components without a Dirichlet neighbor: union-find by atomic minima, the same on CPU and CUDA."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import BLOCK, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_first, row_start

options = {"enable_backward": False, "module": "warp_lcp.components"}

FIND = """
    auto find = [&](int i) { while (P[i] != i) i = P[i]; return i; };"""
COEFFICIENTS = """
    const signed char* c = cells.data + p; int* P = parent.data; const long long s1 = A.s1, s2 = A.s2;
    const auto* fx = face_x.data + p; const auto* fy = face_y.data + p; const auto* fz = face_z.data + p;
    auto x = [&](long long k) { return face_x.data ? fx[k] > 0 : A.cx > 0; };
    auto y = [&](long long k) { return face_y.data ? fy[k] > 0 : A.cy > 0; };
    auto z = [&](long long k) { return face_z.data ? fz[k] > 0 : A.cz > 0; };"""

UNITE = simd(
    BLOCK
    + COEFFICIENTS
    + FIND
    + """
    auto unite = [&](int i, int j) {
        int a = find(i), b = find(j);
        while (a != b) {
            if (a < b) { const int t = a; a = b; b = t; }
            const int old = wp::atomic_min(P + a, b);
            if (old == a) return;
            a = find(old); b = find(b); } };
    // what to join is found in bytes, many cells at a time: 1 the cell to the left, 2 the one below along y, 4 along z; the cell to the
    // left has been joined to its own lower neighbors, and those joined to ours need no more
    const unsigned char ax = A.cx > 0, ay = A.cy > 0, az = A.cz > 0; const bool uniform = !face_x.data && !face_y.data && !face_z.data;
    unsigned char join[M];
    for (int begin = 0; begin < n; begin += M) {
        const int m = n - begin < M ? n - begin : (int)M; const signed char* e = c + begin;
        if (uniform) {
            SIMD for (int k = 0; k < m; ++k) {
                const unsigned char in = e[k] == 1, left = ax & (e[k-1] == 1), y = ay & (e[k-s2] == 1), z = az & (e[k-s1] == 1);
                const unsigned char y_done = left & (e[k-1-s2] == 1), z_done = left & (e[k-1-s1] == 1);
                join[k] = in ? (unsigned char)(left | (y & !y_done) << 1 | (z & !z_done) << 2) : (unsigned char)0; }
        } else {
            for (int k = begin; k < begin + m; ++k) {
                const bool in = c[k] == 1, left = c[k-1] == 1 && x(k);
                const bool y_done = left && c[k-1-s2] == 1 && y(k-1) && x(k-s2), z_done = left && c[k-1-s1] == 1 && z(k-1) && x(k-s1);
                const bool y_here = c[k-s2] == 1 && y(k) && !y_done, z_here = c[k-s1] == 1 && z(k) && !z_done;
                join[k - begin] = in ? (unsigned char)(left | y_here << 1 | z_here << 2) : (unsigned char)0; }
        }
        if (first && begin == 0 && join[0] & 1) {  // the neighbor to the left of a first cell is the last one: no chain to rely on
            const int k = 0; join[0] = 1 | (c[k-s2] == 1 && y(k)) << 1 | (c[k-s1] == 1 && z(k)) << 2; }
        for (int k = 0; k < m; ++k) {
            const unsigned char j = join[k]; const int i = (int)(p + begin + k);
            if (!j) continue;
            if (j & 1) {
                const bool edge = first && begin + k == 0;
#ifdef __CUDA_ARCH__
                unite(i, edge ? i + (int)wrap_x : i - 1);
#else
                if (!edge && P[i] == i) P[i] = P[i-1]; else unite(i, edge ? i + (int)wrap_x : i - 1);
#endif
            }
            if (j & 2) unite(i, i + (int)wrap_y);
            if (j & 4) unite(i, i + (int)wrap_z); } }
"""
)
GROUND = simd(
    BLOCK
    + COEFFICIENTS
    + FIND
    + """
    const auto* held = shift.data + p;
    if (!face_x.data && !face_y.data && !face_z.data && !shift.data) {
        const unsigned char ax = A.cx > 0, ay = A.cy > 0, az = A.cz > 0; unsigned char hit[M];
        for (int begin = 0; begin < n; begin += M) {
            const int m = n - begin < M ? n - begin : (int)M; const signed char* e = c + begin; unsigned char any = 0;
            SIMD for (int k = 0; k < m; ++k) {
                const unsigned char h = (ax & ((e[k-1] == 0) | (e[k+1] == 0))) | (ay & ((e[k-s2] == 0) | (e[k+s2] == 0)))
                    | (az & ((e[k-s1] == 0) | (e[k+s1] == 0)));
                hit[k] = e[k] == 1 ? h : (unsigned char)0; any |= hit[k]; }
            for (int k = 0; any && k < m; ++k) if (hit[k]) grounded.data[find((int)(p + begin + k))] = 1; }
        return;
    }
    for (int k = 0; k < n; ++k) {
        if (c[k] != 1) continue;
        bool hit = (c[k-1] == 0 && x(k)) || (c[k+1] == 0 && x(k+1)) || (c[k-s2] == 0 && y(k)) || (c[k+s2] == 0 && y(k+s2))
            || (c[k-s1] == 0 && z(k)) || (c[k+s1] == 0 && z(k+s1));
        if (shift.data) hit = hit || held[k] > 0;
        if (hit) grounded.data[find((int)(p + k))] = 1; }
"""
)
COUNT = simd("""
    const signed char* c = cells.data + p; const int* P = parent.data + p; const unsigned char* g = grounded.data + p; int floating = 0;
    const int q = (int)p;
    SIMD for (int k = 0; k < n; ++k) floating += (c[k] == 1) & (P[k] == q + k) & (g[k] == 0);
    return floating;
""")


@functools.cache
def component_kernels(real: Any) -> SimpleNamespace:
    """Return the kernels for coefficients of type real: `singletons`, `unite`, `ground`, launched in this order, and `count_floating`.

    A row of cells a thread on the CPU, a cell a thread on CUDA. Parents always have smaller numbers, so that trees are the same whatever
    the order of the threads; a lost race is seen in the value that the atomic minimum returns, and tried again.
    """
    name = f"warp_lcp.components.{real.__name__}"
    field, i32, i8, u8 = wp.array(dtype=real), wp.array(dtype=wp.int32), wp.array(dtype=wp.int8), wp.array(dtype=wp.uint8)

    @wp.func_native(UNITE)
    def unite_row(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, parent: i32, p: wp.int64, n: int, first: bool,
        wrap_x: wp.int64, wrap_y: wp.int64, wrap_z: wp.int64,
    ): ...  # fmt: skip

    @wp.func_native(GROUND)
    def ground_row(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, shift: field, parent: i32, grounded: u8, p: wp.int64,
        n: int,
    ): ...  # fmt: skip

    @wp.func_native(COUNT)
    def count_row(cells: i8, parent: i32, grounded: u8, p: wp.int64, n: int) -> int: ...

    @wp.func_native("for (int k = 0; k < n; ++k) { parent.data[p + k] = (int)(p + k); grounded.data[p + k] = 0; }\n")
    def singleton_row(parent: i32, grounded: u8, p: wp.int64, n: int): ...

    @wp.kernel(enable_backward=False, module=name)
    def singletons(A: StencilShape, parent: i32, grounded: u8, grain: int):
        k, j, c = wp.tid()
        singleton_row(parent, grounded, row_start(A, k, j, c, grain), row_count(A, k, j, c, grain))

    @wp.kernel(enable_backward=False, module=name)
    def unite(A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, parent: i32, size: wp.vec3i, grain: int):
        k, j, c = wp.tid()
        wrap_x = wp.int64(A.nx - 1)  # from the first cell of a periodic row to its neighbor below, which is the last
        wrap_y = -A.s2
        wrap_z = -A.s1
        if j == 0:
            wrap_y = wp.int64(size[1] - 1) * A.s2
        if k == 0:
            wrap_z = wp.int64(size[0] - 1) * A.s1
        n = row_count(A, k, j, c, grain)
        unite_row(
            A,
            cells,
            face_x,
            face_y,
            face_z,
            parent,
            row_start(A, k, j, c, grain),
            n,
            row_first(A, k, j, c, grain) == 0,
            wrap_x,
            wrap_y,
            wrap_z,
        )

    @wp.kernel(enable_backward=False, module=name)
    def ground(
        A: StencilShape, cells: i8, face_x: field, face_y: field, face_z: field, shift: field, parent: i32, grounded: u8, grain: int
    ):
        k, j, c = wp.tid()
        n = row_count(A, k, j, c, grain)
        ground_row(A, cells, face_x, face_y, face_z, shift, parent, grounded, row_start(A, k, j, c, grain), n)

    @wp.kernel(enable_backward=False, module=name)
    def count_floating(A: StencilShape, cells: i8, parent: i32, grounded: u8, grain: int, count: i32):
        k, j, c = wp.tid()
        found = count_row(cells, parent, grounded, row_start(A, k, j, c, grain), row_count(A, k, j, c, grain))
        if found > 0:
            wp.atomic_add(count, 0, found)

    return SimpleNamespace(singletons=singletons, unite=unite, ground=ground, count_floating=count_floating)


@wp.kernel(**options)
def component_sums_kernel(
    label: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.uint8),
    r: wp.array(dtype=Any),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
):
    """Sum r over each component, and note which have an unknown that is not free."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if free[i] != wp.uint8(0):
            wp.atomic_add(sums, c, wp.float64(r[i]))
        else:
            held[c] = 1


@wp.kernel(**options)
def remove_means_kernel(
    label: wp.array(dtype=wp.int32),
    sums: wp.array(dtype=wp.float64),
    held: wp.array(dtype=wp.int32),
    sizes: wp.array(dtype=wp.float64),
    r: wp.array(dtype=Any),
):
    """Take the mean off every component that is free as a whole."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            r[i] = r[i] - r.dtype(sums[c] / sizes[c])


@wp.kernel(**options)
def smallest_gap_kernel(
    label: wp.array(dtype=wp.int32),
    x: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    below: wp.array(dtype=wp.float64),
    above: wp.array(dtype=wp.float64),
):
    """Smallest distance to the lower and to the upper bounds over each component."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        wp.atomic_min(below, c, x[i] - lower[i])
        wp.atomic_min(above, c, upper[i] - x[i])


@wp.kernel(**options)
def shift_components_kernel(
    label: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    constant: wp.array(dtype=wp.float64),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    x: wp.array(dtype=wp.float64),
):
    """Add each component's constant, where the component is free as a whole; the sum's rounding stays within the bounds."""
    i = wp.tid()
    c = label[i]
    if c >= 0:
        if held[c] == 0:
            x[i] = wp.clamp(x[i] + constant[c], lower[i], upper[i])


for _T in (wp.float32, wp.float64):
    _L, _S = wp.array(dtype=wp.int32), wp.array(dtype=wp.float64)
    wp.overload(component_sums_kernel, [_L, wp.array(dtype=wp.uint8), wp.array(dtype=_T), _S, _L])
    wp.overload(remove_means_kernel, [_L, _S, _L, _S, wp.array(dtype=_T)])
