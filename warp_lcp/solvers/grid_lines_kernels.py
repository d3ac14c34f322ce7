# mypy: ignore-errors
"""Kernel of line relaxation on a grid: each line of cells is a boxed tridiagonal problem, solved by active sets."""

import functools
from typing import Any

import warp as wp

from warp_lcp.native import simd
from warp_lcp.operators.stencil_kernels import StencilShape, stencil_head

STRIDES = ("1", "s2", "s1")  # along x, y, z
ACROSS = {
    False: ("cx*(x[k-1] + x[k+1])", "cy*(x[k-s2] + x[k+s2])", "cz*(x[k-s1] + x[k+s1])"),
    True: ("wx[k]*x[k-1] + wx[k+1]*x[k+1]", "wy[k]*x[k-s2] + wy[k+s2]*x[k+s2]", "wz[k]*x[k-s1] + wz[k+s1]*x[k+s1]"),
}
WEIGHTS = {False: (("cx", "cx"), ("cy", "cy"), ("cz", "cz")), True: (("wx[k]", "wx[k+1]"), ("wy[k]", "wy[k+s2]"), ("wz[k]", "wz[k+s1]"))}

# 1 free, 0 at l, 2 at u, 3 no unknown. Rows: -before z[k-st] + e z[k] - after z[k+st] + c = 0 where free, z = bound elsewhere.
LINE = """T* x = x_.data + p; const T *b = b_.data + p, *l = l_.data + p, *u = u_.data + p;
    T *c = c_.data + p, *q = q_.data + p, *z = z_.data + p; unsigned char* s = s_.data + p;
    const long long st = {stride}, end = n*st;
    for (long long k = 0; k < end; k += st) {{
        c[k] = b[k] - ({across});
        s[k] = d[k] == 0 ? 3 : (x[k] <= l[k] ? 0 : (x[k] >= u[k] ? 2 : 1)); }}
    for (int pass = 0; pass < most; ++pass) {{
        T q0 = 0, z0 = 0; int wrong = 0;
        for (long long k = 0; k < end; k += st) {{
            const T before = {before}, after = {after}, e = unit*(T)d[k], pivot = e - before*q0;
            if (s[k] == 1 && pivot > 0) {{ q0 = after/pivot; z0 = (before*z0 - c[k])/pivot; }}
            else {{ q0 = 0; z0 = s[k] == 0 ? l[k] : (s[k] == 2 ? u[k] : (s[k] == 3 ? (T)0 : x[k])); }}
            q[k] = q0; z[k] = z0; }}
        for (long long k = end - 2*st; k >= 0; k -= st) z[k] += q[k]*z[k + st];
        for (long long k = 0; k < end; k += st) {{
            if (s[k] == 3) continue;
            const T before = {before}, after = {after}, e = unit*(T)d[k];
            const T low = k > 0 ? before*z[k - st] : (T)0, high = k + st < end ? after*z[k + st] : (T)0, y = e*z[k] - low - high + c[k];
            const T scale = eps*(fabs(e*z[k]) + fabs(low) + fabs(high) + fabs(c[k]));
            if (s[k] == 1) {{
                if (e*(z[k] - l[k]) < -scale) {{ s[k] = 0; ++wrong; }} else if (e*(z[k] - u[k]) > scale) {{ s[k] = 2; ++wrong; }}
            }} else if (l[k] < u[k]) {{
                if (s[k] == 0 ? y < -scale : y > scale) {{ s[k] = 1; ++wrong; }} }} }}
        if (!wrong) break; }}
    for (long long k = 0; k < end; k += st) {{
        if (s[k] == 3) continue;
        T v = x[k] + (T)omega*(z[k] - x[k]);
        v = v > l[k] ? v : l[k]; x[k] = v < u[k] ? v : u[k]; }}"""


@functools.cache
def line_kernel(variable: bool, d_type: Any, w_type: Any, axis: int) -> Any:
    """Return the kernel for lines along an axis, 0, 1, 2 = x, y, z, a thread a line."""
    form = "variable" if variable else "uniform"
    name = f"warp_lcp.grid_lines.{form}_{d_type.__name__}_{w_type.__name__}_{axis}"
    d_array, w_array, field = wp.array(dtype=d_type), wp.array(dtype=w_type), wp.array(dtype=wp.float64)
    states = wp.array(dtype=wp.uint8)
    before, after = WEIGHTS[variable][axis]
    across = " + ".join(term for a, term in enumerate(ACROSS[variable]) if a != axis)
    body = LINE.format(stride=STRIDES[axis], across=across, before=before, after=after)

    @wp.func_native(simd(stencil_head(variable, "double") + "const T eps = 1e-14;" + body))
    def solve_line(
        A: StencilShape, d_: d_array, wx_: w_array, wy_: w_array, wz_: w_array, x_: field, b_: field, l_: field, u_: field, c_: field,
        q_: field, z_: field, s_: states, p: wp.int64, n: int, most: int, omega: wp.float64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=name)
    def lines(
        A: StencilShape, d: d_array, wx: w_array, wy: w_array, wz: w_array, first: wp.int64, s_a: wp.int64, s_b: wp.int64, x: field,
        b: field, lower: field, upper: field, c: field, q: field, z: field, state: states, n: int, most: int, omega: wp.float64,
        color: int,
    ):  # fmt: skip
        """Solve the lines of one color of a checkerboard across them; no two of them touch."""
        i, j = wp.tid()
        if (i + j) % 2 == color:
            p = first + wp.int64(i) * s_a + wp.int64(j) * s_b
            solve_line(A, d, wx, wy, wz, x, b, lower, upper, c, q, z, state, p, n, most, omega)

    return lines
