# mypy: ignore-errors
"""Kernel that adds up partial sums."""

from pathlib import Path

import warp as wp

from warp_lcp.rows.row_pass import HEADERS, text

SOURCE = "\n".join(["", text(HEADERS / "native.h"), text(Path(__file__).parent / "headers" / "add_up.h"), ""])


@wp.func_native(SOURCE)
def add_up_span(partials: wp.array(dtype=wp.float64), offset: int, start: int, n: int, stride: int) -> wp.float64: ...


@wp.kernel(enable_backward=False, module="warp_lcp.vectors")
def add_up_kernel(partials: wp.array(dtype=wp.float64), n: int, threads: int, segments: int, out: wp.array(dtype=wp.float64), slot: int):
    """out[slot + column * segments + segment] = the sum of every `segments`-th block of a column of n partials, by one block of threads.

    The order of the additions does not change from run to run.
    """
    t = wp.tid()
    block = t // threads
    column = block // segments
    segment = block - column * segments
    s = add_up_span(partials, column * n, segment * threads + t - block * threads, n, threads * segments)
    total = wp.tile_sum(wp.tile(s))
    if t == block * threads:
        out[slot + block] = total[0]
