# mypy: ignore-errors
"""Coloring of a sparse matrix in compressed rows."""

import warp as wp

INDICES = wp.array(dtype=wp.int32)


@wp.kernel(enable_backward=False, module="warp_lcp.sparse.color")
def color_kernel(ptr: INDICES, col: INDICES, taken: INDICES, color: INDICES, n: int):
    """Greedy coloring in row order by one thread: the least color that no neighbor has. `taken[c]` is the last row that saw c, plus one."""
    for i in range(n):
        for k in range(ptr[i], ptr[i + 1]):
            j = col[k]
            if j < i:
                taken[color[j]] = i + 1
        c = int(0)
        while taken[c] == i + 1:
            c += 1
        color[i] = c
