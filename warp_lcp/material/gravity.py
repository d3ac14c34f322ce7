"""Gravity, or any uniform acceleration, on the faces."""

import typing
from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_lcp.grid.cell_kernel import F32, cell_kernel
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.transfer import TINY_WEIGHT


@cell_kernel("warp_lcp.material.gravity")
@typing.no_type_check
def accelerate_kernel(k, j, i, change: float, weight: F32, field: F32):
    """Add a change of velocity [m/s] to every face with weight."""
    if weight[k, j, i] > TINY_WEIGHT:
        field[k, j, i] = field[k, j, i] + change


def accelerate(window: Window, velocity: Sequence[wp.array], weights: Sequence[wp.array], change: np.ndarray) -> None:
    """Change the velocity of every face that particles gave weight, closed faces included: they pass it on to the material beside them.

    Args:
        window: faces that particles can reach.
        velocity: each component [m/s] (updated).
        weights: of the particles on each component's faces.
        change: of each component [m/s], shape (3,).
    """
    for axis, (field, weight) in enumerate(zip(velocity, weights, strict=True)):
        if change[axis] != 0.0:
            window.launch(accelerate_kernel, [float(change[axis]), weight, field])
