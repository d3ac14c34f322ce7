"""The problem: y = A x + b with bounds l <= x <= u. LCP, mixed LCP, boxed LCP and linear system are one class."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_lcp.layout import Array, layout_of

if TYPE_CHECKING:
    from warp_lcp.operators.protocol import Operator


class LCP:
    """A linear complementarity problem ([Book] 1.2).

    y = A x + b, l <= x <= u, and for every i: y_i > 0 => x_i = l_i; y_i < 0 => x_i = u_i; y_i = 0 otherwise. `lower=0`, `upper=inf` is
    the LCP; a row with bounds -inf and inf is an equation; without finite bounds the problem is a linear system.

    Fields that are device arrays of type wp.float64 in the operator's stored layout already (for a grid: padded by one cell, shape
    (nz + 2, ny + 2, nx + 2)) are used in place, so that a time-stepping code can change them between solves; results then come back in
    that layout too.

    Args:
        A: an Operator.
        b: field of A's shape, units of y.
        lower: l, a number or a field; -inf where there is none.
        upper: u, a number or a field; inf where there is none.

    Raises:
        ValueError: a NaN, a wrong shape, l > u, l = inf, u = -inf, or no unknown; the message names the argument.
    """

    def __init__(self, A: Operator, b: Array, lower: Any = 0.0, upper: Any = np.inf) -> None:
        self.A, self.layout = A, layout_of(A)
        if getattr(A, "unknowns", self.layout.size) == 0:
            raise ValueError("A has no unknowns: the problem is empty")
        self.in_place = isinstance(b, wp.array) and self.layout.holds(b, wp.float64) and tuple(b.shape) != tuple(A.shape)
        self.b = self._field(b, "b")
        self.lower, self.upper = self._field(lower, "lower"), self._field(upper, "upper")
        self.unknown = _unknown(A, self.layout)
        self._check()

    @property
    def device(self) -> wp.Device:
        """The device of the problem's arrays."""
        return self.layout.device

    def _field(self, values: Any, name: str) -> wp.array[Any]:
        """Return a number or a field as a stored field, float64."""
        if not isinstance(values, wp.array):
            host = np.asarray(values, dtype=np.float64)
            values = np.full(self.layout.shape, host) if host.ndim == 0 else host
        return self.layout.load(values, wp.float64, name)

    def _check(self) -> None:
        inside = self.unknown.numpy() == 1
        b, lower, upper = (f.numpy()[inside] for f in (self.b, self.lower, self.upper))
        if not np.isfinite(b).all():
            raise ValueError(f"b holds {np.count_nonzero(~np.isfinite(b))} values that are not finite")
        for name, bound, wrong in (("lower", lower, np.inf), ("upper", upper, -np.inf)):
            if np.isnan(bound).any():
                raise ValueError(f"{name} holds {np.count_nonzero(np.isnan(bound))} NaN")
            if (bound == wrong).any():
                raise ValueError(f"{name} holds {wrong}: no x could meet it")
        if (lower > upper).any():
            raise ValueError(f"lower > upper in {np.count_nonzero(lower > upper)} unknowns")


def _unknown(A: Any, layout: Any) -> wp.array[Any]:
    """Return a stored int8 field that is 1 on unknowns: a grid's cell types serve as they are."""
    cells = getattr(A, "cells", None)
    if isinstance(cells, wp.array):
        return cells.flatten()
    return wp.full(layout.size, 1, dtype=wp.int8, device=layout.device)
