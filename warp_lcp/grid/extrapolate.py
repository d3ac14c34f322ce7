"""Velocity from known faces to the faces around them, a layer of faces at a time."""

import typing

import warp as wp

from warp_lcp.grid.staggered import CellRange, Window

BLOCKED = -1  # not to be filled
UNKNOWN = 0  # to be filled; positive: known since that layer, 1 from the start


@wp.kernel(enable_backward=False, module="warp_lcp.grid.extrapolate")
@typing.no_type_check
def layer_kernel(cells: CellRange, known: wp.array3d(dtype=wp.int8), field: wp.array3d(dtype=wp.float32), layer: int, fill: int):
    """Fill faces marked `fill` from neighbors known up to `layer`, and mark them layer + 1.

    In place without a race: a face that another thread fills in this launch is marked `fill` or layer + 1 and is not read either way.
    """
    plane, row, chunk = wp.tid()
    k = cells.k + plane
    j = cells.j + row
    first = cells.i + chunk * cells.grain
    nz = known.shape[0]
    ny = known.shape[1]
    nx = known.shape[2]
    for i in range(first, wp.min(first + cells.grain, cells.end)):
        if int(known[k, j, i]) == fill:
            total = float(0.0)
            count = float(0.0)
            for n in range(6):
                side = 2 * (n & 1) - 1
                axis = n >> 1
                a = i + wp.where(axis == 0, side, 0)
                b = j + wp.where(axis == 1, side, 0)
                c = k + wp.where(axis == 2, side, 0)
                if a >= 0 and a < nx and b >= 0 and b < ny and c >= 0 and c < nz:
                    mark = int(known[c, b, a])
                    if mark > 0 and mark <= layer:
                        total += field[c, b, a]
                        count += 1.0
            if count > 0.0:
                field[k, j, i] = total / count
                known[k, j, i] = wp.int8(layer + 1)


def extrapolate(window: Window, known: wp.array, field: wp.array, layers: int, *, start: int = 1, fill: int = UNKNOWN) -> None:
    """Give unknown faces the mean of their known neighbors, layer after layer.

    Args:
        window: faces to consider; `known` must not be positive outside it.
        known: int8, one value a face: positive where `field` is known, `UNKNOWN`, or `BLOCKED` (updated: layer + 1).
        field: one component of the velocity [m/s] (updated).
        layers: how many layers to fill, >= 0.
        start: faces marked 1..start are sources of the first layer.
        fill: the mark of the faces to fill, `UNKNOWN` or `BLOCKED`.

    Raises:
        ValueError: the marks would not fit in int8.
    """
    if start + layers > 127:
        raise ValueError(f"layers = {layers} after layer {start}: at most 127 layers fit in int8")
    for layer in range(start, start + layers):
        window.launch(layer_kernel, [known, field, layer, fill])
