# mypy: ignore-errors
"""Kernels of a set of fields: inner products with all of them, and their combinations."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_lcp.native import C_TYPES
from warp_lcp.vector_kernels import flat, span_end, span_start


@functools.cache
def kernels(set_type: Any, real: Any) -> SimpleNamespace:
    """Return the kernels for a set of fields of type set_type, one after another in `v`, and a field of type real."""
    name = f"warp_lcp.field_set.{set_type.__name__}_{real.__name__}"
    fields, field, f64, T = wp.array(dtype=set_type), wp.array(dtype=real), wp.array(dtype=wp.float64), C_TYPES[real]

    @wp.func_native(flat("const auto* v = v_.data + at; const auto* x = x_.data; double s = 0; EACH { s += (double)v[i]*x[i]; } return s;"))
    def dot_span(v_: fields, at: wp.int64, x_: field, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...

    @wp.func_native(flat(f"const auto* v = v_.data + at; auto* x = x_.data; const {T} c = ({T})factor; EACH {{ x[i] += c*({T})v[i]; }}"))
    def add_span(v_: fields, at: wp.int64, factor: wp.float64, x_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(flat("const auto* x = x_.data; double s = 0; EACH { s += (double)x[i]*x[i]; } return s;"))
    def square_span(x_: field, start: wp.int64, end: wp.int64, stride: wp.int64) -> wp.float64: ...

    @wp.func_native(flat("auto* v = v_.data + at; const auto* x = x_.data; EACH { v[i] = scale*x[i]; }"))
    def store_span(x_: field, scale: wp.float64, v_: fields, at: wp.int64, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.func_native(flat("const auto* v = v_.data + at; auto* x = x_.data; EACH { x[i] = v[i]; }"))
    def take_span(v_: fields, at: wp.int64, x_: field, start: wp.int64, end: wp.int64, stride: wp.int64): ...

    @wp.kernel(enable_backward=False, module=name)
    def dots(v: fields, x: field, count: int, n: int, chunk: int, stride: wp.int64, threads: int, partials: f64):
        """Partial sums of v_j . x for the first `count` fields."""
        t = wp.tid()
        for j in range(count):
            at = wp.int64(j) * wp.int64(n)
            partials[j * threads + t] = dot_span(v, at, x, span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def add(v: fields, factors: f64, sign: wp.float64, count: int, x: field, n: int, chunk: int, stride: wp.int64, partials: f64):
        """X += sign times the sum of factors_j v_j; partial sums of x . x where there is room for them."""
        t = wp.tid()
        start = span_start(t, chunk)
        end = span_end(t, chunk, n)
        for j in range(count):
            add_span(v, wp.int64(j) * wp.int64(n), sign * factors[j], x, start, end, stride)
        if partials.shape[0] > 0:
            partials[t] = square_span(x, start, end, stride)

    @wp.kernel(enable_backward=False, module=name)
    def store(x: field, square: f64, slot: int, v: fields, place: int, n: int, chunk: int, stride: wp.int64):
        """v_place = x over the root of square[slot]; 0 where that is 0."""
        t = wp.tid()
        scale = wp.float64(0.0)
        if square[slot] > wp.float64(0.0):
            scale = wp.float64(1.0) / wp.sqrt(square[slot])
        store_span(x, scale, v, wp.int64(place) * wp.int64(n), span_start(t, chunk), span_end(t, chunk, n), stride)

    @wp.kernel(enable_backward=False, module=name)
    def take(v: fields, place: int, x: field, n: int, chunk: int, stride: wp.int64):
        """X = v_place."""
        t = wp.tid()
        take_span(v, wp.int64(place) * wp.int64(n), x, span_start(t, chunk), span_end(t, chunk, n), stride)

    return SimpleNamespace(dots=dots, add=add, store=store, take=take)
