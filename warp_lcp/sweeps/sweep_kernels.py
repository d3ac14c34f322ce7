# mypy: ignore-errors
"""Kernels of sweeps.

The scalar problem of one unknown, rows in any order, Jacobi's method, and the size of a change.
"""

import functools
from pathlib import Path
from types import SimpleNamespace

import warp as wp

from warp_lcp.kernels import KernelFile
from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.types import DataType
from warp_lcp.operators.compressed_rows import matrix_rows
from warp_lcp.problem.affine_bounds import AffineSide, bound_at

f64, i32, i8 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32), wp.array(dtype=wp.int8)
ZERO = wp.constant(wp.float64(0.0))
INFINITE = wp.constant(wp.float64(1.0e300))  # larger bounds are infinite


@wp.func
def bound_for_concave(x: wp.float64, y: wp.float64, d: wp.float64, l: wp.float64, u: wp.float64):
    """Return the bound that solves a scalar problem with d < 0.

    There y has the right sign: y >= 0 at l, y <= 0 at u. Of two such bounds it is the one with the
    lesser energy d t^2 / 2 + y t, t the change of x.
    """
    has_l = l > -INFINITE
    has_u = u < INFINITE
    v = x
    if has_l:
        v = l
    if has_u:
        if not has_l:
            v = u
        else:
            s = l - x
            t = u - x
            l_solves = y + d * s >= ZERO
            u_solves = y + d * t <= ZERO
            if u_solves:
                energy_falls = t * (y + wp.float64(0.5) * d * t) < s * (y + wp.float64(0.5) * d * s)
                if energy_falls or not l_solves:
                    v = u
    return v


@wp.func
def scalar_solution(
    x: wp.float64, y: wp.float64, d: wp.float64, l: wp.float64, u: wp.float64, omega: wp.float64
):
    """Return the relaxed solution of the scalar problem of one unknown.

    By the sign of the diagonal d ([Book] 2.2.2, fig. 2.4): clip(x - omega y / d, l, u) for d > 0;
    the bound that the sign of y selects for d = 0; the bound of least energy for d < 0.
    """
    v = x
    if d > ZERO:
        v = wp.clamp(x - omega * y / d, l, u)
    elif d == ZERO:
        if y > ZERO:
            v = l
        if y < ZERO:
            v = u
        if wp.abs(v) > INFINITE:
            v = x  # no minimizer in this direction: x does not change
        v = wp.clamp(v, l, u)
    else:
        v = bound_for_concave(x, y, d, l, u)
    return v


@functools.cache
def row_kernels(a_type: DataType) -> SimpleNamespace:
    """Return the kernels of row sweeps for entries of type a_type.

    `sweep` uses a given order, `greedy` the largest residual.

    Both relax a row by x_i <- clip(x_i - omega y_i / a_ii, l_i, u_i) with y = A x + b, if a_ii > 0;
    see `scalar_solution` for other signs. `sweep` computes y_i from the entries of the row,
    `greedy` updates all of y.
    """
    name = f"warp_lcp.sweep.{a_type.__name__}"
    entries, Rows = wp.array(dtype=a_type), matrix_rows(a_type)

    @forward_kernel(module=name)
    def sweep(
        A: Rows,
        b: f64,
        lowers: AffineSide,
        uppers: AffineSide,
        omega: wp.float64,
        order: i32,
        forward: bool,
        n: int,
        x: f64,
    ):
        """Relax the rows of `order` one after the other, by one thread.

        x_i <- clip(x_i - omega y_i / A_ii, l_i, u_i) with y = A x + b of the current x.

        An empty `order` means all rows, by number.
        """
        for place in range(n):
            r = place
            if not forward:
                r = n - 1 - place
            i = r
            if order.shape[0] > 0:
                i = order[r]
            first = A.ptr[i]
            y = b[i]
            d = ZERO
            for k in range(first, A.ptr[i + 1]):
                j = k - first
                if A.col.shape[0] > 0:
                    j = A.col[k]
                v = wp.float64(A.a[k])
                y += v * x[j]
                if j == i:
                    d += v
            lower = bound_at(lowers, x, i)
            upper = bound_at(uppers, x, i)
            x[i] = scalar_solution(x[i], y, d, lower, upper, omega)

    @forward_kernel(module=name)
    def greedy(
        A: Rows,
        diagonal: entries,
        lowers: AffineSide,
        uppers: AffineSide,
        omega: wp.float64,
        n: int,
        y: f64,
        x: f64,
    ):
        """Relax n times the row whose x would change most, measured by |d| |change|.

        y = A x + b is updated by the row's column, which equals the row: A is symmetric.
        """
        for _ in range(n):
            chosen = int(-1)
            most = ZERO
            for i in range(n):
                lower = bound_at(lowers, x, i)
                upper = bound_at(uppers, x, i)
                d = wp.float64(diagonal[i])
                weight = wp.abs(d)
                if weight == ZERO:
                    weight = wp.float64(1.0)
                size = weight * wp.abs(
                    scalar_solution(x[i], y[i], d, lower, upper, wp.float64(1.0)) - x[i]
                )
                if size > most:
                    most = size
                    chosen = i
            if chosen >= 0:
                i = chosen
                lower = bound_at(lowers, x, i)
                upper = bound_at(uppers, x, i)
                v = scalar_solution(x[i], y[i], wp.float64(diagonal[i]), lower, upper, omega)
                change = v - x[i]
                x[i] = v
                first = A.ptr[i]
                for k in range(first, A.ptr[i + 1]):
                    j = k - first
                    if A.col.shape[0] > 0:
                        j = A.col[k]
                    y[j] += wp.float64(A.a[k]) * change

    return SimpleNamespace(sweep=sweep, greedy=greedy)


@functools.cache
def jacobi_kernel(d_type: DataType) -> wp.Kernel:
    """Return the kernel of Jacobi's method for a diagonal of type d_type."""

    @forward_kernel(module=f"warp_lcp.jacobi.{d_type.__name__}")
    def jacobi(
        d: wp.array(dtype=d_type),
        unit: wp.float64,
        y: f64,
        lower: f64,
        upper: f64,
        unknown: i8,
        omega: wp.float64,
        x: f64,
    ):
        """Solve the scalar problem of each unknown at the same x."""
        i = wp.tid()
        if unknown[i] == wp.int8(1):
            x[i] = scalar_solution(x[i], y[i], unit * wp.float64(d[i]), lower[i], upper[i], omega)

    return jacobi


KERNELS = KernelFile(Path(__file__).parent / "headers/gauss_seidel.h")
CHANGE = KERNELS["sweep.change"]
