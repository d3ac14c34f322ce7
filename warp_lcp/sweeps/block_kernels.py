# mypy: ignore-errors
"""Kernels of blocked Gauss-Seidel: small boxed problems solved by active sets.

The blocks are solved exactly, one after the other.
"""

import functools

import warp as wp

from warp_lcp.kernels.compiler import forward_kernel
from warp_lcp.kernels.types import DataType
from warp_lcp.operators.compressed_rows import matrix_rows
from warp_lcp.problem.affine_bounds import AffineSide, bound_at
from warp_lcp.sweeps.sweep_kernels import INFINITE, ZERO, scalar_solution

f64, i32 = wp.array(dtype=wp.float64), wp.array(dtype=wp.int32)
AT_LOWER, FREE, AT_UPPER = wp.constant(0), wp.constant(1), wp.constant(2)
# Relative to the terms of y and to |x|: rounding error of the elimination in a small block.
ROUNDING = wp.constant(wp.float64(1e-12))
SINGULAR = wp.constant(wp.float64(1e-13))  # relative to the largest entry


@wp.struct
class BlockLists:
    """Lists of the blocks.

    Where each block begins in `rows`, the rows of the blocks, the block of each row and its place
    there, and the order of the blocks.
    """

    first: i32
    rows: i32
    owner: i32
    place: i32
    order: i32


@functools.cache
def block_sweep_kernel(a_type: DataType, m: int) -> wp.Kernel:
    """Return the kernel for entries of type a_type and blocks of at most m unknowns.

    A block is the boxed problem of A_BB and c = b_B + A_BC x_C; its unknowns have the states
    AT_LOWER, FREE and AT_UPPER.
    """
    name = f"warp_lcp.blocked_gauss_seidel.{a_type.__name__}_{m}"
    Rows = matrix_rows(a_type)
    vector = wp.types.vector(length=m, dtype=wp.float64)
    places = wp.types.vector(length=m, dtype=wp.int32)
    table = wp.types.matrix(shape=(m, m + 1), dtype=wp.float64)
    extended = wp.types.vector(length=m + 1, dtype=wp.float64)

    @wp.struct
    class BlockSide:
        """Lower or upper bounds of a block's unknowns.

        Within the block they may be affine in another unknown, `at` >= 0.
        """

        constant: vector
        slope: vector
        at: places

    @wp.func
    def side_at(side: BlockSide, x: vector, p: int):
        """Return the bound of unknown p at x."""
        value = side.constant[p]
        q = side.at[p]
        if q >= 0:
            value = value + side.slope[p] * x[q]
        return value

    @wp.func
    def set_side(side: BlockSide, p: int, S: AffineSide, B: BlockLists, x: f64, i: int, block: int):
        """Return the side with the bound of unknown i as its p-th one.

        The bound is affine in an unknown of the block, or constant while the block is solved.
        """
        updated = side
        updated.constant[p] = bound_at(S, x, i)
        updated.at[p] = -1
        if S.index.shape[0] > 0:
            j = S.index[i]
            if j >= 0:
                if B.owner[j] == block:
                    updated.constant[p] = S.constant[i]
                    updated.slope[p] = S.coefficient[i]
                    updated.at[p] = B.place[j]
        return updated

    @wp.func
    def solve_set(a: table, low: BlockSide, high: BlockSide, state: places, n: int):
        """Solve A x = -c in the free rows, x = bound in the others.

        `a` holds [A, c]. Gaussian elimination with partial pivoting; rows of affine bounds couple x
        to the unknown that they depend on. The last component of the result is 1, or 0 where the
        set is singular.
        """
        t = a
        largest = ZERO
        for p in range(n):
            t[p, m] = -a[p, m]
            if state[p] != FREE:
                for q in range(n):
                    t[p, q] = ZERO
                t[p, p] = wp.float64(1.0)
                j = low.at[p]
                slope = low.slope[p]
                t[p, m] = low.constant[p]
                if state[p] == AT_UPPER:
                    j = high.at[p]
                    slope = high.slope[p]
                    t[p, m] = high.constant[p]
                if j >= 0:
                    t[p, j] -= slope
            for q in range(n):
                largest = wp.max(largest, wp.abs(t[p, q]))
        out = extended()
        regular = wp.float64(1.0)
        for c in range(n):
            best = c
            for p in range(c + 1, n):
                if wp.abs(t[p, c]) > wp.abs(t[best, c]):
                    best = p
            if wp.abs(t[best, c]) <= SINGULAR * largest:
                regular = ZERO
            else:
                for q in range(n):
                    v = t[c, q]
                    t[c, q] = t[best, q]
                    t[best, q] = v
                v = t[c, m]
                t[c, m] = t[best, m]
                t[best, m] = v
                for p in range(c + 1, n):
                    f = t[p, c] / t[c, c]
                    for q in range(c, n):
                        t[p, q] -= f * t[c, q]
                    t[p, m] -= f * t[c, m]
        if regular > ZERO:
            for r in range(n):
                p = n - 1 - r
                s = t[p, m]
                for q in range(p + 1, n):
                    s -= t[p, q] * out[q]
                out[p] = s / t[p, p]
        out[m] = regular
        return out

    @wp.func
    def wanted(a: table, low: BlockSide, high: BlockSide, x: vector, state: places, n: int):
        """Return the active set that x selects: violated states are changed.

        A free unknown outside its bounds goes to the bound; one at its lower bound with y < 0, or
        at its upper bound with y > 0, becomes free. Violations within rounding do not count.
        """
        new = state
        size = ZERO
        for p in range(n):
            size = wp.max(size, wp.abs(x[p]))
        for p in range(n):
            y = a[p, m]
            terms = wp.abs(y)
            for q in range(n):
                y += a[p, q] * x[q]
                terms += wp.abs(a[p, q] * x[q])
            l = side_at(low, x, p)
            u = side_at(high, x, p)
            if state[p] == FREE:
                if x[p] < l - ROUNDING * size:
                    new[p] = AT_LOWER
                elif x[p] > u + ROUNDING * size:
                    new[p] = AT_UPPER
            elif u > l:
                if state[p] == AT_LOWER:
                    if y < -ROUNDING * terms:
                        new[p] = FREE
                elif y > ROUNDING * terms:
                    new[p] = FREE
        return new

    @wp.func
    def solve_block(a: table, low: BlockSide, high: BlockSide, x: vector, n: int):
        """Solve the block by changes of its active set.

        All violated states are changed at first, later the one of least index. If that does not
        end, all sets are tried; if none solves the block, its unknowns are solved as scalar
        problems.

        With y = A x + c, the states mean x = l, y = 0 and x = u; `solve_set` finds x from the
        states, and `wanted` new states from x. The first n + 1 rounds change all violated states,
        later ones that of least index, up to 8 n + 9 in all; then come the 3^n sets in order.
        """
        state = places()
        for p in range(n):
            state[p] = FREE
            if x[p] <= side_at(low, x, p):
                state[p] = AT_LOWER
            elif x[p] >= side_at(high, x, p):
                state[p] = AT_UPPER
        solved = int(0)
        out = x
        sets = int(1)
        for _ in range(n):
            sets = sets * 3
        # Code of the set; below 0: the one that the last set selected. A single place calls the
        # solve, because CUDA would keep registers for two.
        code = int(-1)
        count = int(0)
        while code < sets:
            possible = int(1)
            if code >= 0:
                rest = code
                for p in range(n):
                    state[p] = rest % 3
                    rest = rest // 3
                    if state[p] == AT_LOWER:
                        if low.constant[p] < -INFINITE:
                            possible = 0
                    if state[p] == AT_UPPER:
                        if high.constant[p] > INFINITE:
                            possible = 0
            going = int(0)
            if possible == 1:
                z = solve_set(a, low, high, state, n)
                if z[m] > ZERO:
                    v = vector()
                    for p in range(n):
                        v[p] = z[p]
                    new = wanted(a, low, high, v, state, n)
                    first = int(-1)
                    for p in range(n):
                        q = n - 1 - p
                        if new[q] != state[q]:
                            first = q
                    if first < 0:
                        solved = 1
                        out = v
                        code = sets
                    elif code < 0 and count < 8 * n + 8:
                        going = 1
                        if count <= n:
                            state = new
                        else:
                            state[first] = new[first]
            count += 1
            if going == 0:
                code += 1
        if solved == 0:
            for p in range(n):
                y = a[p, m]
                for q in range(n):
                    y += a[p, q] * out[q]
                out[p] = scalar_solution(
                    out[p], y, a[p, p], side_at(low, out, p), side_at(high, out, p), wp.float64(1.0)
                )
        return out

    @forward_kernel(module=name)
    def sweep(
        A: Rows,
        b: f64,
        lowers: AffineSide,
        uppers: AffineSide,
        omega: wp.float64,
        B: BlockLists,
        begin: int,
        each: int,
        forward: bool,
        x: f64,
    ):
        """Solve `each` blocks per thread, from place `begin` of their order.

        For each block: c = b_B + A_BC x_C with the other unknowns C, then the boxed problem of A_BB
        and c, relaxed by omega and projected onto its bounds.
        """
        thread = wp.tid()
        for step in range(each):
            at = begin + thread * each + step
            if not forward:
                at = begin + thread * each + each - 1 - step
            block = B.order[at]
            start = B.first[block]
            n = B.first[block + 1] - start
            a = table()
            low = BlockSide()
            high = BlockSide()
            old = vector()
            for p in range(n):
                i = B.rows[start + p]
                old[p] = x[i]
                c = b[i]
                row = A.ptr[i]
                for k in range(row, A.ptr[i + 1]):
                    j = k - row
                    if A.col.shape[0] > 0:
                        j = A.col[k]
                    v = wp.float64(A.a[k])
                    if B.owner[j] == block:
                        q = B.place[j]
                        a[p, q] += v
                    else:
                        c += v * x[j]
                a[p, m] = c
                low = set_side(low, p, lowers, B, x, i, block)
                high = set_side(high, p, uppers, B, x, i, block)
            new = solve_block(a, low, high, old, n)
            for p in range(n):
                new[p] = old[p] + omega * (new[p] - old[p])
            # Unknowns on which other bounds depend have constant bounds: they are projected first,
            # so that the order within the block does not matter.
            for p in range(n):
                if low.at[p] < 0 and high.at[p] < 0:
                    new[p] = wp.clamp(new[p], low.constant[p], high.constant[p])
            for p in range(n):
                x[B.rows[start + p]] = wp.clamp(new[p], side_at(low, new, p), side_at(high, new, p))

    return sweep
