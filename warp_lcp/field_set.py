"""A set of flat fields as the columns of a matrix V: V'x and V c, each in one launch."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_lcp.field_set_kernels import kernels
from warp_lcp.vectors import Reduction, launch_spans


class FieldSet:
    """Fields v_0 ... v_(count-1) of n elements, and the sums that inner products with them give.

    Args:
        count: number of fields.
        n: elements of each.
        dtype: their type.
        device: where they live.

    Attributes:
        values: the fields, one after another, shape (count * n,).
        sums: device scalars, shape (count + 1,), float64; `dots` writes them, the last one is `add`'s square norm.
    """

    def __init__(self, count: int, n: int, dtype: Any, device: wp.Device) -> None:
        self.count, self.n, self.dtype, self.device = count, n, dtype, device
        self.values = wp.zeros(count * n, dtype=dtype, device=device)
        self.sums = wp.zeros(count + 1, dtype=wp.float64, device=device)
        self._reduction = Reduction(n, device, self.sums, columns=count)
        self._nothing = wp.empty(0, dtype=wp.float64, device=device)

    def dots(self, x: wp.array[Any], count: int | None = None) -> wp.array[Any]:
        """Write v_j . x for the first `count` fields to `sums`, and return that."""
        count = self.count if count is None else count
        reduction = self._reduction
        after = [reduction.threads, reduction.partials]
        launch_spans(kernels(self.dtype, x.dtype).dots, reduction.spans, [self.values, x, count], after, self.device)
        reduction.add_up(0, columns=count)
        return self.sums

    def add(self, factors: wp.array[Any], x: wp.array[Any], *, sign: float = 1.0, count: int | None = None, norm: bool = False) -> None:
        """X += sign times the sum of factors_j v_j over the first `count` fields; `norm`: then write x . x to the last of `sums`."""
        count = self.count if count is None else count
        before = [self.values, factors, wp.float64(sign), count, x]
        reduction = self._reduction
        after = [reduction.partials if norm else self._nothing]
        launch_spans(kernels(self.dtype, x.dtype).add, reduction.spans, before, after, self.device)
        if norm:
            reduction.add_up(self.count)

    def store(self, x: wp.array[Any], place: int) -> None:
        """v_place = x over the root of the last of `sums`."""
        launch_spans(
            kernels(self.dtype, x.dtype).store, self._reduction.spans, [x, self.sums, self.count, self.values, place], [], self.device
        )

    def take(self, place: int, x: wp.array[Any]) -> None:
        """X = v_place."""
        launch_spans(kernels(self.dtype, x.dtype).take, self._reduction.spans, [self.values, place, x], [], self.device)
