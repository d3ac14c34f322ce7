"""The norm in which principal systems measure residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.solvers.principal_system_kernels import kernels
from warp_lcp.vectors import Reduction, launch_spans


class WeightedNorm:
    """||weight^(1/2) r||.

    Args:
        like: a field like those to be measured.
        weight: field like it, >= 0; None: all 1.
    """

    def __init__(self, like: wp.array[Any], weight: wp.array[Any] | None) -> None:
        self._weight, self._device = weight, like.device
        self._sum = wp.zeros(1, dtype=wp.float64, device=like.device)
        self._reduction = Reduction(like.size, like.device, self._sum)
        self.spans = self._reduction.spans

    def of(self, r: wp.array[Any]) -> float:
        """Return the norm of r."""
        if self._weight is None:
            self._reduction.dot(r, r, 0)
        else:
            partials = self._reduction.partials
            launch_spans(kernels(r.dtype).weighted_square, self.spans, [r, self._weight], [partials], self._device)
            self._reduction.add_up(0)
        return float(np.sqrt(self._sum.numpy()[0]))
