"""Extrapolation of a velocity from known faces, layer by layer."""

import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from warp_lcp.grid.cell_kernel import F32, I8, U8, cell_kernel, next_to
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.transfer import TINY_WEIGHT
from warp_lcp.kernels import KernelFile

if TYPE_CHECKING:
    from warp_lcp.grid.barriers import Barriers

BLOCKED = -1  # mark of faces that are not filled
UNKNOWN = 0  # mark of faces to fill; positive: layer in which a face became known, 1 at the start
# Layers around faces with weight: the range in which particles beyond its neighbors affect the
# density of a cell.
REACH = 2

KERNELS = KernelFile(Path(__file__).parent / "headers/staggered.h")
LAYER = KERNELS["warp_lcp.grid.extrapolate.fill_layer"]


@cell_kernel("warp_lcp.grid.extrapolate")
@typing.no_type_check
def weighted_kernel(k, j, i, least: float, weight: F32, known: I8):
    """Mark the faces whose particle weight exceeds `least`."""
    known[k, j, i] = wp.where(weight[k, j, i] > least, wp.int8(1), wp.int8(0))


@cell_kernel("warp_lcp.grid.barriers.fill")
@typing.no_type_check
def fill_side_kernel(k, j, i, layer: int, fill: int, apart: U8, known: I8, field: F32):
    """Fill one layer of faces by the mean of their known neighbors.

    Faces marked `fill` are filled from neighbors known up to `layer` that no thin solid separates
    from them, and are marked layer + 1.
    """
    if int(known[k, j, i]) == fill:
        total = float(0.0)
        count = float(0.0)
        for n in range(6):
            d = n >> 1
            side = 2 * (n & 1) - 1
            c, b, a = next_to(d, side, k, j, i)
            if (
                c >= 0
                and b >= 0
                and a >= 0
                and c < known.shape[0]
                and b < known.shape[1]
                and a < known.shape[2]
            ):
                mark = int(known[c, b, a])
                if mark > 0 and mark <= layer:
                    bits = int(apart[wp.max(c, k), wp.max(b, j), wp.max(a, i)])
                    if (bits >> d) & 1 == 0:
                        total += field[c, b, a]
                        count += 1.0
        if count > 0.0:
            field[k, j, i] = total / count
            known[k, j, i] = wp.int8(layer + 1)


def complete(
    window: Window,
    velocity: Sequence[wp.array],
    weights: Sequence[wp.array],
    known: Sequence[wp.array],
    join: Callable[[wp.array, wp.array], None] | None = None,
    barriers: "Barriers | None" = None,
) -> None:
    """Extrapolate the particles' velocity to nearby faces without weight.

    Cells beyond these faces may be full or dense.

    Args:
        window: faces to consider.
        velocity: velocity of each component [m/s] (updated).
        weights: weights of the particles on each component's faces.
        known: scratch memory, int8, one field a component.
        join: see `extrapolate`.
        barriers: solids thinner than cells; None if there are none.
    """
    for axis, (field, weight, marks) in enumerate(zip(velocity, weights, known, strict=True)):
        window.clear(marks)
        window.launch(weighted_kernel, [TINY_WEIGHT, weight, marks])
        if join is not None:  # weights are 0 in the ring
            join(marks, field)
        extrapolate(
            window,
            marks,
            field,
            REACH,
            join=join,
            apart=None if barriers is None else barriers.apart[axis],
        )


def extrapolate(
    window: Window,
    known: wp.array,
    field: wp.array,
    layers: int,
    *,
    start: int = 1,
    fill: int = UNKNOWN,
    join: Callable[[wp.array, wp.array], None] | None = None,
    apart: wp.array | None = None,
) -> None:
    """Extrapolate a field: unknown faces get the mean of their known neighbors.

    One layer after the other.

    Args:
        window: faces to consider; `known` must not be positive outside it.
        known: int8, one value a face: positive where `field` is known, `UNKNOWN`, or `BLOCKED`
            (updated: layer + 1).
        field: one component of the velocity [m/s] (updated).
        layers: how many layers to fill, >= 0.
        start: faces marked 1..start are sources of the first layer.
        fill: the mark of the faces to fill, `UNKNOWN` or `BLOCKED`.
        join: called with known and field after each layer, where faces at two sides of the domain
            are the same.
        apart: uint8, the neighbors that thin solids separate, see `warp_lcp.grid.barriers`; None if
            there are none.

    Raises:
        ValueError: the marks would not fit in int8.
    """
    if start + layers > 127:
        raise ValueError(f"layers = {layers} after layer {start}: at most 127 layers fit in int8")
    for layer in range(start, start + layers):
        if apart is None:
            window.run(LAYER, known=known, field=field, layer=layer, fill=fill)
        else:
            window.launch(fill_side_kernel, [layer, fill, apart, known, field])
        if join is not None:
            join(known, field)
