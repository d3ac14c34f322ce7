# mypy: ignore-errors
"""Kernels of conjugate gradients on a grid by one CPU thread: direction, product, iterate and residual in one pass over memory."""

import functools
from typing import Any

import warp as wp

from warp_lcp.krylov.conjugate_gradient_kernels import GROWTH
from warp_lcp.native import C_TYPES, fetch, simd
from warp_lcp.operators.stencil_kernels import NEIGHBORS, StencilShape, row_count, row_start, stencil_head
from warp_lcp.solvers.projected_multigrid_kernels import BETA, CARRY, NORM, SIZE, STEP
from warp_lcp.solvers.projected_multigrid_kernels import SLOTS as STEP_SLOTS

# slots of the device scalars after those of a step
SQUARE = wp.constant(STEP_SLOTS)  # of the carried residual's norm
TOLERANCE = wp.constant(STEP_SLOTS + 1)
BEST = wp.constant(STEP_SLOTS + 2)  # the least norm so far
ITERATIONS = wp.constant(STEP_SLOTS + 3)  # done, and the most allowed
LIMIT = wp.constant(STEP_SLOTS + 4)
SLOTS = STEP_SLOTS + 5

f64 = wp.array(dtype=wp.float64)


@functools.cache
def advance_kernel(variable: bool, d_type: Any, real: Any) -> Any:
    """Return the kernel that makes the direction p = z + beta p, moves x along it, takes A p off the residual and sums its square."""
    form = "variable" if variable else "uniform"
    d_array, field, T = wp.array(dtype=d_type), wp.array(dtype=real), C_TYPES[real]

    @wp.func_native(
        simd(
            f"""const {T}* z = z_.data + p; {T}* q = p_.data + p;
        {fetch("0", "n", z=4, q=4)}
        if (beta == 0) {{ SIMD for (int k = 0; k < n; ++k) q[k] = z[k]; }}
        else {{ SIMD for (int k = 0; k < n; ++k) q[k] = z[k] + beta*q[k]; }}"""
        )
    )
    def direct_row(z_: field, p_: field, beta: real, p: wp.int64, n: int): ...

    @wp.func_native(
        simd(
            stencil_head(variable, T)
            + f"""const T* x = p_.data + p; T *e = e_.data + p, *r = r_.data + p, s = 0;
        {fetch("0", "n", e=4, r=4)}
        auto each = [&](auto from, auto weigh) {{
            SIMD for (int k = 0; k < n; ++k) {{
                const T c = unit*(T)d[k], v = c*x[k] - {NEIGHBORS[variable]}, w = r[k] - alpha*(c != 0 ? v : (T)0);
                e[k] = from(k) + alpha*x[k]; r[k] = w; s += w*w*weigh(c); }} }};
        auto one = [](T c) {{ return (T)1; }};
        auto inverse = [](T c) {{ const T a = c < 0 ? -c : c; return (T)1/(a > 0 ? a : (T)1); }};
        auto zero = [&](int k) {{ return (T)0; }}; auto old = [&](int k) {{ return e[k]; }};
        if (first) {{ if (weighted) each(zero, inverse); else each(zero, one); }}
        else {{ if (weighted) each(old, inverse); else each(old, one); }}
        out.data[t] = (double)s;"""
        )
    )
    def residual_row(
        A: StencilShape, d_: d_array, wx_: field, wy_: field, wz_: field, p_: field, e_: field, r_: field, alpha: real, first: bool,
        weighted: bool, p: wp.int64, n: int, t: int, out: f64,
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module=f"warp_lcp.grid_conjugate_gradient.{form}_{d_type.__name__}_{real.__name__}")
    def advance(
        A: StencilShape, d: d_array, wx: field, wy: field, wz: field, planes: int, rows: int, z: field, p: field, x: field, r: field,
        scalars: f64, weighted: bool, out: f64,
    ):  # fmt: skip
        """A plane's residual follows when the direction above it is made: both are in the cache."""
        beta = real(scalars[BETA])
        alpha = real(scalars[STEP])
        first = scalars[ITERATIONS] == wp.float64(0.0)
        for s in range(planes + 1):
            if s < planes:
                for j in range(rows):
                    direct_row(z, p, beta, row_start(A, s, j, 0, A.nx), row_count(A, s, j, 0, A.nx))
            k = s - 1
            if k >= 0:
                for j in range(rows):
                    o = row_start(A, k, j, 0, A.nx)
                    n = row_count(A, k, j, 0, A.nx)
                    residual_row(A, d, wx, wy, wz, p, x, r, alpha, first, weighted, o, n, k * rows + j, out)

    return advance


@wp.kernel(enable_backward=False, module="warp_lcp.grid_conjugate_gradient")
def begin_kernel(scalars: f64, going: wp.array(dtype=int), tolerance: wp.float64, limit: int):
    """Before the first iteration: no old direction, no norm yet."""
    scalars[CARRY] = wp.float64(0.0)
    scalars[NORM] = wp.float64(0.0)
    scalars[SIZE] = wp.float64(1.0)
    scalars[SQUARE] = wp.float64(wp.inf)
    scalars[BEST] = wp.float64(wp.inf)
    scalars[TOLERANCE] = tolerance
    scalars[ITERATIONS] = wp.float64(0.0)
    scalars[LIMIT] = wp.float64(limit)
    going[0] = wp.where(limit > 0, 1, 0)


@wp.kernel(enable_backward=False, module="warp_lcp.grid_conjugate_gradient")
def end_kernel(scalars: f64, going: wp.array(dtype=int)):
    """After an iteration: decide whether to go on."""
    scalars[ITERATIONS] += wp.float64(1.0)
    norm = wp.sqrt(scalars[SQUARE])
    enough = norm <= scalars[TOLERANCE] or norm >= GROWTH * scalars[BEST] or scalars[ITERATIONS] >= scalars[LIMIT]
    going[0] = wp.where(enough or not wp.isfinite(norm) or scalars[STEP] == wp.float64(0.0), 0, 1)
    scalars[BEST] = wp.min(scalars[BEST], norm)
