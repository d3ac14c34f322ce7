# mypy: ignore-errors
"""Kernels that build coarser levels: the Galerkin product with piecewise-constant 2 x 2 x 2 aggregates, and bounds of corrections.

Piecewise-constant aggregation keeps the 7-point stencil on every level and copes with any mask: the weight between two aggregates is the
sum over the faces between them, an aggregate's diagonal the sum of its cells' diagonals less twice the faces inside it.
"""

import functools
from typing import Any

import warp as wp

from warp_lcp.multigrid.cycle_kernels import Aggregates, first_cell, one_plane, one_row
from warp_lcp.native import BLOCK, C_TYPES, simd
from warp_lcp.operators.stencil_kernels import StencilShape, row_count, row_first, row_start
from warp_lcp.vector_kernels import flat, span_end, span_start

options = {"enable_backward": False, "module": "warp_lcp.coarsen"}

UNBOUNDED = 1e30  # stands for an infinite bound of a correction; corrections are of order one

# a row is the same to the last bit whichever kernel makes it: only those that change are made again
IN_ORDER = "\n#ifndef __CUDA_ARCH__\n#pragma clang fp reassociate(off) contract(off)\n#endif\n"


@wp.func
def lower_weight(w: wp.array3d(dtype=Any), uniform: wp.float64, k: int, j: int, i: int):
    """Weight of a lower face."""
    c = uniform
    if w.shape[0] > 0:
        c = wp.float64(w[k, j, i])
    return c


@wp.struct
class Wraps:
    """Offsets from a row of the finer level to the rows around it; 0 where there is none. Wrapped ones on periodic axes."""

    below_x: wp.int64  # of the first cell
    above_x: wp.int64  # of the last cell
    below_y: wp.int64
    above_y: wp.int64
    below_z: wp.int64
    above_z: wp.int64


@wp.func
def below(first: bool, periodic: int, step: wp.int64, n: int):
    """Offset to the row or plane below: a ghost below the first one, unless they wrap around."""
    o = -step
    if first and periodic != 0:
        o = wp.int64(n - 1) * step
    return o


@wp.func
def above(last: bool, periodic: int, step: wp.int64, n: int):
    """Offset to the row or plane above: a ghost above the last one, unless they wrap around."""
    o = step
    if last and periodic != 0:
        o = wp.int64(1 - n) * step
    return o


@wp.func
def depends_on_change(changed: wp.array2d(dtype=wp.uint8), n: wp.vec3i, periodic: wp.vec3i, G: Aggregates, k: int, j: int):
    """Whether one of the rows of aggregates (k, j), or a row beside them, has changed: their faces depend on both their cells."""
    planes = wp.min(G.fz, n[0] - G.fz * k)
    rows = wp.min(G.fy, n[1] - G.fy * j)
    found = int(0)
    for a in range(-1, planes + 1):
        for b in range(-1, rows + 1):
            if (a >= 0 and a < planes) or (b >= 0 and b < rows):
                z = G.fz * k + a
                y = G.fy * j + b
                if periodic[2] != 0:
                    z = (z + n[0]) % n[0]
                if periodic[1] != 0:
                    y = (y + n[1]) % n[1]
                if z >= 0 and z < n[0] and y >= 0 and y < n[1]:
                    if changed[z, y] != wp.uint8(0):
                        found = 1
    return found != 0


@functools.cache
def coarsen_kernels(variable: bool, d_type: Any, real: Any) -> Any:
    """Return the kernel that makes one coarse row a thread on the CPU, one aggregate a thread on CUDA.

    A cell's excess is its diagonal less its faces to other unknowns: what AIR, held unknowns and the shift contribute. An aggregate's
    diagonal is the sum of its cells' excesses plus its outer faces, a sum of positive numbers: taking inner faces off the diagonals would
    cancel. Weights along axes that are not aggregated are not too stiff, so they are multiplied by `stiffen`, the over-correction that the
    prolongation applies to all; the excess, whose held neighbors are one cell and not one aggregate away, by `held`.
    """
    name = f"warp_lcp.coarsen.{'variable' if variable else 'uniform'}_{d_type.__name__}_{real.__name__}"
    d_array, field = wp.array(dtype=d_type), wp.array(dtype=real)

    # equal weights: faces are counted in bytes and scaled at the end
    counts = d_type is wp.uint8
    buffer, diagonal = ("unsigned char", "d[k]") if counts else (C_TYPES[real], "(T)A.unit*(T)d[k]")
    least = "1e-6" if real is wp.float32 else "1e-14"  # of a diagonal: an excess below it is what rounding left
    kept = "v" if counts else f"v > (B){least}*({diagonal}) ? v : (B)0"
    weights = "const auto *wx = wx_.data, *wy = wy_.data, *wz = wz_.data;" if variable else ""

    def face(axis: str, shift: str, other: str) -> str:
        """Weight of a cell's face, stored `shift` after it, to the cell at `other`; 0 unless both are unknowns."""
        if counts:
            return f"(B)(one(d[k]) & one(d[k + {other}]) & (B)(A.c{axis} > 0))"
        weight = f"(B)w{axis}[k + {shift}]" if variable else f"(B)A.c{axis}"
        return f"((d[k] != 0) & (d[k + {other}] != 0)) ? {weight} : (B)0"

    def chunks(body: str) -> str:
        """Source of a loop over the row's cells: bytes go 64 at a time as long as there are as many."""
        if not counts:
            return f"SIMD for (int i = 0; i < fx*m; ++i) {body};"
        loops = "const int whole = fx*m/64*64; SIMD64 for (int i = 0; i < whole; ++i) {0}; SIMD for (int i = whole; i < fx*m; ++i) {0};"
        return loops.format(body)

    @wp.func_native(
        simd(
            IN_ORDER
            + BLOCK
            + f"""typedef {C_TYPES[real]} T; typedef {buffer} B; const int last_cell = A.nx - 1 - fx*start;
        struct No {{ enum {{ value = 0 }}; }}; struct Yes {{ enum {{ value = 1 }}; }};
        auto one = [](B v) -> B {{ return v < (B)1 ? v : (B)1; }};
        // a periodic axis of two cells has one aggregate, and no outer faces
        const bool whole_x = fx == 2 && W.below_x == 1, whole_y = !one_row && W.below_y == A.s2, whole_z = !one_plane && W.below_z == A.s1;
        const T scale = {"(T)A.unit" if counts else "(T)1"}, se = scale*(fx*fy*fz == 8 ? held : stiffen);
        const T sx = whole_x ? (T)0 : fx == 2 ? scale : scale*stiffen, sy = whole_y ? (T)0 : fy == 2 ? scale : scale*stiffen;
        const T sz = whole_z ? (T)0 : fz == 2 ? scale : scale*stiffen;
        B excess[2*M], bx[2*M], ax[2*M], by[2*M], ay[2*M], bz[2*M], az[2*M];
        for (int begin = 0; begin < n; begin += M) {{
            const int m = n - begin < M ? n - begin : (int)M, last = last_cell - fx*begin; const long long p = p0 + fx*begin;
            auto rows = [&](auto two_y, auto two_z) {{
                // Cell i of a row in both planes: what it adds to the aggregate's excess and to the outer faces below and above it. Rows go
                // one after another, for memory is fetched ahead best along them; planes together, which halves the passes.
                auto cell = [&](auto second, int i, long long left, long long right) {{
                    enum {{ UY = decltype(second)::value, NY = decltype(two_y)::value, NZ = decltype(two_z)::value }};
                    B sum = 0, bx_ = 0, ax_ = 0, by_ = 0, ay_ = 0, bz_ = 0, az_ = 0;
                    if (UY) {{ sum = excess[i]; bx_ = bx[i]; ax_ = ax[i]; by_ = by[i]; ay_ = ay[i]; bz_ = bz[i]; az_ = az[i]; }}
                    auto add = [&](auto upper) {{
                        enum {{ UZ = decltype(upper)::value }};
                        const long long k = p + i + (UY ? A.s2 : 0) + (UZ ? A.s1 : 0); const auto* d = d_.data; {weights}
                        const B f = {face("x", "0", "left")}, g = {face("x", "1", "right")};
                        const B h = {face("y", "0", "(UY ? -A.s2 : W.below_y)")}, l = {face("y", "A.s2", "(NY && !UY ? A.s2 : W.above_y)")};
                        const B o = {face("z", "0", "(UZ ? -A.s1 : W.below_z)")}, q = {face("z", "A.s1", "(NZ && !UZ ? A.s1 : W.above_z)")};
                        const B v = (B)({diagonal}) - f - g - h - l - o - q;
                        sum += {kept}; bx_ += f; ax_ += g;
                        if (!UY) by_ += h;
                        if (UY || !NY) ay_ += l;
                        if (!UZ) bz_ += o;
                        if (UZ || !NZ) az_ += q; }};
                    add(No());
                    if (NZ) add(Yes());
                    excess[i] = sum; bx[i] = bx_; ax[i] = ax_; by[i] = by_; ay[i] = ay_; bz[i] = bz_; az[i] = az_; }};
                auto row = [&](auto second) {{ {chunks("cell(second, i, -1, 1)")} }};
                auto end = [&](int i, long long left, long long right) {{  // a cell whose neighbor is at the other end of the row
                    cell(No(), i, left, right);
                    if (decltype(two_y)::value) cell(Yes(), i, left, right); }};
                row(No());
                if (decltype(two_y)::value) row(Yes());
                if (start + begin == 0 && W.below_x != -1) end(0, W.below_x, 1);
                if (last < fx*m && W.above_x != 1) end(last, -1, W.above_x); }};
            if (one_row) {{ if (one_plane) rows(No(), No()); else rows(No(), Yes()); }}
            else {{ if (one_plane) rows(Yes(), No()); else rows(Yes(), Yes()); }}
            T* dc = dc_.data + c + begin; T* wxc = wxc_.data + c + begin; T* wyc = wyc_.data + c + begin; T* wzc = wzc_.data + c + begin;
            if (fx == 2) {{
                SIMD for (int k = 0; k < m; ++k) {{
                    const int a = 2*k, b = a + 1;
                    const T x = sx*(T)bx[a], y = sy*(T)(B)(by[a] + by[b]), z = sz*(T)(B)(bz[a] + bz[b]);
                    wxc[k] = x; wyc[k] = y; wzc[k] = z;
                    const T above = sx*(T)ax[b] + sy*(T)(B)(ay[a] + ay[b]) + sz*(T)(B)(az[a] + az[b]);
                    dc[k] = se*(T)(B)(excess[a] + excess[b]) + x + y + z + above; }}
                if (last < 2*m && last % 2 == 0) dc[last / 2] += sx*(T)ax[last];  // the last cell of an odd row is an aggregate
            }} else {{
                SIMD for (int k = 0; k < m; ++k) {{
                    const T x = sx*(T)bx[k], y = sy*(T)by[k], z = sz*(T)bz[k];
                    wxc[k] = x; wyc[k] = y; wzc[k] = z;
                    dc[k] = se*(T)excess[k] + x + y + z + sx*(T)ax[k] + sy*(T)ay[k] + sz*(T)az[k]; }}
            }}
        }}"""
        )
    )
    def coarsen_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, p0: wp.int64, dc_: field, wxc_: field, wyc_: field, wzc_: field,
        c: wp.int64, n: int, start: int, fx: int, fy: int, fz: int, one_plane: bool, one_row: bool, W: Wraps, stiffen: real, held: real,
    ): ...  # fmt: skip

    @wp.func
    def coarsen_chunk(
        k: int, j: int, c: int, A: StencilShape, d: d_array, wx: field, wy: field, wz: field, n: wp.vec3i, periodic: wp.vec3i,
        C: StencilShape, G: Aggregates, grain: int, stiffen: real, held: real, dc: field, wxc: field, wyc: field, wzc: field,
    ):  # fmt: skip
        plane = one_plane(G, k)
        row = one_row(G, j)
        last_k = G.fz * k
        if not plane:
            last_k += 1
        last_j = G.fy * j
        if not row:
            last_j += 1
        W = Wraps()
        W.below_x = below(True, periodic[0], wp.int64(1), n[2])
        W.above_x = above(True, periodic[0], wp.int64(1), n[2])
        W.below_y = below(j == 0, periodic[1], A.s2, n[1])
        W.above_y = above(last_j == n[1] - 1, periodic[1], A.s2, n[1])
        W.below_z = below(k == 0, periodic[2], A.s1, n[0])
        W.above_z = above(last_k == n[0] - 1, periodic[2], A.s1, n[0])
        m = row_count(C, k, j, c, grain)
        p = first_cell(A, C, G, k, j, c, grain)
        o = row_start(C, k, j, c, grain)
        coarsen_row(
            A, d, wx, wy, wz, p, dc, wxc, wyc, wzc, o, m, row_first(C, k, j, c, grain), G.fx, G.fy, G.fz, plane, row, W, stiffen, held
        )

    @wp.kernel(enable_backward=False, module=name)
    def coarsen(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, n: wp.vec3i, periodic: wp.vec3i, C: StencilShape, G: Aggregates,
        grain: int, stiffen: real, held: real, changed: wp.array2d(dtype=wp.uint8), dc: field, wxc: field, wyc: field, wzc: field,
        changed_c: wp.array2d(dtype=wp.uint8),
    ):  # fmt: skip
        """Make the coarse rows that depend on finer ones which have changed; all threads of a row come to the same answer."""
        k, j, c = wp.tid()
        if depends_on_change(changed, n, periodic, G, k, j):
            changed_c[k, j] = wp.uint8(1)
            coarsen_chunk(k, j, c, A, d, wx, wy, wz, n, periodic, C, G, grain, stiffen, held, dc, wxc, wyc, wzc)
        else:
            changed_c[k, j] = wp.uint8(0)

    coarsen.chunk = coarsen_chunk
    return coarsen


@functools.cache
def hold_kernel(d_type: Any, real: Any) -> Any:
    """Return the kernel that copies the diagonal on the free set, writes 0 elsewhere, and marks the rows that change by it."""
    d_array, u8, target = wp.array(dtype=d_type), wp.array(dtype=wp.uint8), C_TYPES[real]
    out_array = wp.array(dtype=real)

    @wp.func_native(
        simd(
            f"""const auto* d = d_.data + p; const auto* free = free_.data + p; auto* out = out_.data + p; unsigned char moved = 0;
        auto hold = [&](int k) -> unsigned char {{
            const {target} v = free[k] != 0 ? ({target})d[k] : ({target})0; const unsigned char differs = v != out[k];
            out[k] = v; return differs; }};
        const int whole = {"n/64*64" if real is wp.uint8 else "0"};
        SIMD64 for (int k = 0; k < whole; ++k) moved |= hold(k);
        SIMD for (int k = whole; k < n; ++k) moved |= hold(k);
        if (moved) changed_.data[row] = 1;"""
        )
    )
    def hold_row(d_: d_array, free_: u8, out_: out_array, changed_: u8, row: int, p: wp.int64, n: int): ...

    @wp.kernel(enable_backward=False, module=f"warp_lcp.coarsen.hold_{d_type.__name__}_{real.__name__}")
    def hold(A: StencilShape, d: d_array, free: u8, grain: int, rows: int, out: out_array, changed: u8):
        k, j, c = wp.tid()
        hold_row(d, free, out, changed, k * rows + j, row_start(A, k, j, c, grain), row_count(A, k, j, c, grain))

    return hold


@wp.func_native(flat("EACH { flags.data[i] = value; }"))
def mark_span(flags: wp.array(dtype=wp.uint8), value: wp.uint8, start: wp.int64, end: wp.int64, stride: wp.int64): ...


@wp.kernel(**options)
def mark_kernel(flags: wp.array(dtype=wp.uint8), value: wp.uint8, n: int, chunk: int, stride: wp.int64):
    """Mark all rows, or none."""
    t = wp.tid()
    mark_span(flags, value, span_start(t, chunk), span_end(t, chunk, n), stride)


@wp.func
def none_changed(changed: wp.array2d(dtype=wp.uint8)):
    """Whether no row has changed."""
    found = int(0)
    for k in range(changed.shape[0]):
        for j in range(changed.shape[1]):
            if changed[k, j] != wp.uint8(0):
                found = 1
    return found == 0


def factor(
    A: StencilShape,
    d: wp.array3d(dtype=Any),
    wx: wp.array3d(dtype=Any),
    wy: wp.array3d(dtype=Any),
    wz: wp.array3d(dtype=Any),
    n: wp.vec3i,
    periodic: wp.vec3i,
    rounding: wp.float64,
    changed: wp.array2d(dtype=wp.uint8),
    matrix: wp.array2d(dtype=wp.float64),
):
    """Assemble the coarsest level and factor it in place, L D L', by one thread; nothing to do if none of its rows has changed.

    A pivot below `rounding` times its diagonal is a singular component's rounding: its unknown is pinned at 0.
    """
    if none_changed(changed):
        return
    m = n[0] * n[1] * n[2]
    for r in range(m):
        for c in range(r + 1):
            matrix[r, c] = wp.float64(0.0)
    for r in range(m):
        k = r // (n[1] * n[2]) + 1
        j = (r // n[2]) % n[1] + 1
        i = r % n[2] + 1
        if d[k, j, i] != d.dtype(0):
            matrix[r, r] += A.unit * wp.float64(d[k, j, i])
            for axis in range(3):
                q = int(-1)
                w = wp.float64(0.0)
                if axis == 0:
                    w = lower_weight(wx, A.cx, k, j, i)
                    if i > 1:
                        q = r - 1
                    elif periodic[0] != 0:
                        q = r + n[2] - 1
                if axis == 1:
                    w = lower_weight(wy, A.cy, k, j, i)
                    if j > 1:
                        q = r - n[2]
                    elif periodic[1] != 0:
                        q = r + (n[1] - 1) * n[2]
                if axis == 2:
                    w = lower_weight(wz, A.cz, k, j, i)
                    if k > 1:
                        q = r - n[1] * n[2]
                    elif periodic[2] != 0:
                        q = r + (n[0] - 1) * n[1] * n[2]
                if q >= 0:
                    if d[q // (n[1] * n[2]) + 1, (q // n[2]) % n[1] + 1, q % n[2] + 1] != d.dtype(0):
                        matrix[wp.max(r, q), wp.min(r, q)] -= w
    for c in range(m):
        pivot = matrix[c, c]
        for s in range(c):
            pivot -= matrix[c, s] * matrix[c, s] * matrix[s, s]
        if pivot <= rounding * matrix[c, c]:
            pivot = wp.float64(0.0)
        matrix[c, c] = pivot
        for r in range(c + 1, m):
            v = matrix[r, c]
            for s in range(c):
                v -= matrix[r, s] * matrix[c, s] * matrix[s, s]
            if pivot > wp.float64(0.0):
                matrix[r, c] = v / pivot
            else:
                matrix[r, c] = wp.float64(0.0)


INVERT = """
const double* L = matrix.data; double* X = inverse.data;  // L has ones on its diagonal, where it stores the pivots
for (int r = 0; r < m; ++r) {
    SIMD8 for (int c = first; c < end; ++c) X[r*m + c] = r == c ? 1.0 : 0.0;
    for (int s = 0; s < r; ++s) { const double l = L[r*m + s]; SIMD8 for (int c = first; c < end; ++c) X[r*m + c] -= l*X[s*m + c]; } }
for (int r = m - 1; r >= 0; --r) {
    const double pivot = L[r*m + r];
    SIMD8 for (int c = first; c < end; ++c) X[r*m + c] = pivot > 0 ? X[r*m + c]/pivot : 0.0;
    for (int s = r + 1; s < m; ++s) {
        const double l = pivot > 0 ? L[s*m + r] : 0.0; SIMD8 for (int c = first; c < end; ++c) X[r*m + c] -= l*X[s*m + c]; } }
"""


@wp.func_native(simd(INVERT))
def invert_columns(matrix: wp.array2d(dtype=wp.float64), inverse: wp.array2d(dtype=wp.float64), first: int, end: int, m: int): ...


@wp.kernel(**options)
def invert_kernel(
    changed: wp.array2d(dtype=wp.uint8), matrix: wp.array2d(dtype=wp.float64), columns: int, inverse: wp.array2d(dtype=wp.float64)
):
    """So many columns a thread of the inverse, from the factors; nothing to do if none of the rows of cells has changed."""
    t = wp.tid()
    if none_changed(changed):
        return
    m = matrix.shape[0]
    invert_columns(matrix, inverse, t * columns, wp.min(m, (t + 1) * columns), m)


SOLVE = """
#ifdef __CUDA_ARCH__
enum { R = 1 };
#else
enum { R = 64 };
#endif
const int m = nz*ny*nx; const long long s2 = nx + 2, s1 = (ny + 2)*s2; const double* A = inverse.data; double v[R];
for (int begin = first; begin < end; begin += R) {
    const int count = end - begin < R ? end - begin : (int)R;
    for (int r = 0; r < count; ++r) v[r] = 0;
    const double* row = A + begin;  // the inverse is symmetric
    for (int k = 1; k <= nz; ++k) for (int j = 1; j <= ny; ++j) for (int i = 1; i <= nx; ++i, row += m) {
        const double value = (double)b.data[k*s1 + j*s2 + i];
        SIMD8 for (int r = 0; r < count; ++r) v[r] += row[r]*value; }
    for (int r = 0; r < count; ++r) {
        const int q = begin + r; x.data[(q / (ny*nx) + 1)*s1 + (q / nx % ny + 1)*s2 + q % nx + 1] = v[r]; } }
"""


@wp.func_native(simd(SOLVE))
def solve_rows(
    inverse: wp.array2d(dtype=wp.float64),
    b: wp.array3d(dtype=Any),
    x: wp.array3d(dtype=Any),
    nz: int,
    ny: int,
    nx: int,
    first: int,
    end: int,
): ...


@wp.kernel(**options)
def solve_coarsest_kernel(
    inverse: wp.array2d(dtype=wp.float64), n: wp.vec3i, rows: int, b: wp.array3d(dtype=Any), x: wp.array3d(dtype=Any)
):
    """X = inverse b, so many rows a thread."""
    t = wp.tid()
    solve_rows(inverse, b, x, n[0], n[1], n[2], t * rows, wp.min(inverse.shape[0], (t + 1) * rows))


for _real in (wp.float32, wp.float64):
    wp.overload(solve_coarsest_kernel, [wp.array2d(dtype=wp.float64), wp.vec3i, int, wp.array3d(dtype=_real), wp.array3d(dtype=_real)])


@functools.cache
def factor_kernel(d_type: Any, real: Any) -> Any:
    """Return the kernel of `factor` for a type of diagonal and one of weights, in a module of its own: it takes long to compile."""
    d, f = wp.array3d(dtype=d_type), wp.array3d(dtype=real)
    kernel = wp.kernel(factor, enable_backward=False, module=f"warp_lcp.coarsen.factor_{d_type.__name__}_{real.__name__}")
    matrices = [wp.array2d(dtype=wp.uint8), wp.array2d(dtype=wp.float64)]
    return wp.overload(kernel, [StencilShape, d, f, f, f, wp.vec3i, wp.vec3i, wp.float64, *matrices])
