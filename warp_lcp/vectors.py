"""Flat fields: conversions, inner products, deterministic sums. The only vector primitives that the solvers use.

Every operator stores its fields as flat arrays (see `warp_lcp.layout`), so that these serve all of them.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_lcp.native import Spans
from warp_lcp.vector_kernels import add_up_kernel, kernels


class Reduction:
    """Sums over flat fields of n elements; the same bits on every run.

    Args:
        n: elements of a field.
        device: where they live.
        scalars: device array that receives the sums, shape (slots,), float64.
    """

    def __init__(self, n: int, device: wp.Device, scalars: wp.array[wp.float64]) -> None:
        self.spans, self.scalars = Spans.of(n, device), scalars
        self.partials = wp.zeros(self.spans.threads, dtype=wp.float64, device=device)

    def add_up(self, slot: int) -> None:
        """Write the sum of the partial sums to scalars[slot]."""
        s = self.spans
        inputs = [self.partials, s.threads, s.block, self.scalars, slot]
        wp.launch(add_up_kernel, s.block, inputs, device=self.partials.device, block_dim=s.block)

    def dot(self, a: wp.array[Any], b: wp.array[Any], slot: int) -> None:
        """Write a.b to scalars[slot]."""
        launch_spans(kernels(a.dtype, b.dtype).dot, self.spans, [a, b], [self.partials], a.device)
        self.add_up(slot)


def launch_spans(kernel: wp.Kernel, spans: Spans, before: list[Any], after: list[Any], device: wp.Device) -> None:
    """Launch a kernel (*before, n, chunk, stride, *after) with one thread a span."""
    wp.launch(kernel, spans.threads, [*before, spans.n, spans.chunk, spans.stride, *after], device=device)


def convert(a: wp.array[Any], b: wp.array[Any]) -> None:
    """B = a, between float types."""
    if a.dtype is b.dtype:
        wp.copy(b, a)
    else:
        launch_spans(kernels(a.dtype, b.dtype).convert, Spans.of(a.size, a.device), [a, b], [], a.device)
