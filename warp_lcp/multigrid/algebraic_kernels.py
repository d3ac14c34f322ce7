# mypy: ignore-errors
"""Kernels of the algebraic hierarchy that do not run over rows.

They find positions of products and the inverse of the coarsest level.
"""

from typing import Any

import warp as wp

from warp_lcp.kernels.compiler import forward_kernel

INDICES, MATRIX = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.float64)


@forward_kernel(module="warp_lcp.algebraic")
def places_kernel(
    ptr: INDICES,
    col: INDICES,
    right_ptr: INDICES,
    right_col: INDICES,
    out_ptr: INDICES,
    out_col: INDICES,
    at: INDICES,
    place: wp.array(dtype=wp.uint16),
    n: int,
):
    """Find the position of each product of two entries in its row of the product.

    One thread does it, once a pattern. `at` is memory for a row.
    """
    c = wp.int64(0)
    for i in range(n):
        for q in range(out_ptr[i], out_ptr[i + 1]):
            at[out_col[q]] = q - out_ptr[i]
        for k in range(ptr[i], ptr[i + 1]):
            for q in range(right_ptr[col[k]], right_ptr[col[k] + 1]):
                place[c] = wp.uint16(at[right_col[q]])
                c += wp.int64(1)


@forward_kernel(module="warp_lcp.algebraic")
def densify_kernel(ptr: INDICES, col: INDICES, a: wp.array(dtype=Any), out: MATRIX):
    """Expand a sparse row to a dense one, one thread a row."""
    i = wp.tid()
    for j in range(out.shape[1]):
        out[i, j] = wp.float64(0.0)
    for k in range(ptr[i], ptr[i + 1]):
        out[i, col[k]] = wp.float64(a[k])


@forward_kernel(module="warp_lcp.algebraic")
def factor_kernel(matrix: MATRIX, rounding: wp.float64):
    """Factor L U in place without pivoting, by one thread.

    Step c computes row c of U and column c of L, which has a unit diagonal. With s < c:

        u_cr = a_cr - sum_s l_cs u_sr
        l_rc = (a_rc - sum_s l_rs u_sc) / u_cc

    A pivot is zero, or rounding error of a singular component, if its magnitude is at most
    `rounding` times its diagonal. Its unknown is then eliminated, and its pivot set to 0.
    """
    n = matrix.shape[0]
    for c in range(n):
        least = rounding * wp.abs(matrix[c, c])
        pivot = matrix[c, c]
        for s in range(c):
            pivot -= matrix[c, s] * matrix[s, c]
        if wp.abs(pivot) <= least:
            pivot = wp.float64(0.0)
        matrix[c, c] = pivot
        for r in range(c + 1, n):
            lower = matrix[r, c]
            upper = matrix[c, r]
            for s in range(c):
                lower -= matrix[r, s] * matrix[s, c]
                upper -= matrix[c, s] * matrix[s, r]
            if pivot != wp.float64(0.0):
                matrix[r, c] = lower / pivot
                matrix[c, r] = upper
            else:
                matrix[r, c] = wp.float64(0.0)
                matrix[c, r] = wp.float64(0.0)


@forward_kernel(module="warp_lcp.algebraic")
def invert_kernel(factors: MATRIX, inverse: MATRIX):
    """Compute column c of the inverse from the factors, one thread a column.

    Forward substitution solves L v = e_c, back substitution U x = v. Rows and columns of eliminated
    unknowns are 0.
    """
    c = wp.tid()
    n = factors.shape[0]
    for r in range(n):
        v = wp.float64(0.0)
        if r == c:
            v = wp.float64(1.0)
        for s in range(c, r):
            v -= factors[r, s] * inverse[s, c]
        if factors[r, r] == wp.float64(0.0):
            v = wp.float64(0.0)
        inverse[r, c] = v
    for q in range(n):
        r = n - 1 - q
        if factors[r, r] != wp.float64(0.0):
            v = inverse[r, c]
            for s in range(r + 1, n):
                v -= factors[r, s] * inverse[s, c]
            inverse[r, c] = v / factors[r, r]


@forward_kernel(module="warp_lcp.algebraic")
def solve_kernel(inverse: MATRIX, b: wp.array(dtype=Any), x: wp.array(dtype=Any)):
    """Multiply by the inverse: x = A^-1 b."""
    i = wp.tid()
    s = wp.float64(0.0)
    for j in range(inverse.shape[1]):
        s += inverse[i, j] * wp.float64(b[j])
    x[i] = x.dtype(s)


for _T in (wp.float32, wp.float64):
    wp.overload(densify_kernel, [INDICES, INDICES, wp.array(dtype=_T), MATRIX])
    wp.overload(solve_kernel, [MATRIX, wp.array(dtype=_T), wp.array(dtype=_T)])
