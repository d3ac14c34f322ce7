# mypy: ignore-errors
"""Kernels on flat fields, and how their native loops are written."""

import warp as wp

from warp_lcp.native import simd

EACH = """
#ifdef __CUDA_ARCH__
for (long long i = start; i < end; i += stride)
#else
SIMD for (long long i = start; i < end; ++i)
#endif
"""


BOUNDED = """
    auto with_bounds = [&](auto body) {
        auto low = [&](long long i) { return l_.data[i]; }; auto high = [&](long long i) { return u_.data[i]; };
        auto least = [&](long long i) { return l_value; }; auto most = [&](long long i) { return u_value; };
        if (l_.data && u_.data) body(low, high); else if (l_.data) body(low, most); else if (u_.data) body(least, high);
        else body(least, most); };
"""  # calls body(lower, upper) with functions of the element, fields or numbers, so that a loop over them tests neither

CODED = BOUNDED.replace(
    "if (l_.data && u_.data)",
    """auto coded_low = [&](long long i) { return code_.data[i] & 1 ? l_value : -(double)INFINITY; };
        auto coded_high = [&](long long i) { return code_.data[i] & 2 ? u_value : (double)INFINITY; };
        if (code_.data) body(coded_low, coded_high); else if (l_.data && u_.data)""",
)  # the same for bounds that may be coded, see `warp_lcp.bounds`

AT_ROW = CODED  # the same for cells of a row that begins at element p
for _field in ("l_", "u_", "code_"):
    AT_ROW = AT_ROW.replace(f"{_field}.data[i]", f"{_field}.data[p + i]")


def flat(source: str) -> str:
    """Return the body of a native function over a span: `EACH {...}` visits its elements i."""
    return simd(source.replace("EACH", EACH))


@wp.func
def span_start(t: int, chunk: int):
    """First element of thread t's span."""
    first = wp.int64(t)
    if chunk > 0:
        first = wp.int64(t) * wp.int64(chunk)
    return first


@wp.func
def span_end(t: int, chunk: int, n: int):
    """One past the last element of thread t's span."""
    last = wp.int64(n)
    if chunk > 0:
        last = wp.min(wp.int64(n), wp.int64(t + 1) * wp.int64(chunk))
    return last


ADD_UP = """const double* v = partials.data + offset; double s = 0;
if (stride == 1) { SIMD8 for (int i = start; i < n; ++i) s += v[i]; }
else for (int i = start; i < n; i += stride) s += v[i];
return s;"""


@wp.func_native(simd(ADD_UP))
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
