"""Reach of particles and extrapolated velocities beyond a rank's box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from warp_lcp.distributed.subdomain import Subdomain

# Layers of ghost cells that stay correct during velocity extrapolation: cut cells read faces at
# this distance.
LEAST_RIGHT = 2


def displacement_beyond_ghosts(part: Subdomain, velocity: Sequence[wp.array], dt: float) -> float:
    """Return the largest displacement [cells] that may leave the ghost layers.

    Returns 0 if no particle can leave them. A particle reads faces up to three quarters of its path
    from its start, so faces deep in the box may be faster. Values that are not finite are not
    counted: the particles report them.

    Args:
        part: the subdomain of this rank.
        velocity: of each component on the faces [m/s].
        dt: time step [s].
    """
    worst, most = 0.0, part.layers - 1
    for axis, field in enumerate(velocity):
        sides = [part.cuts >> 2 * axis + side & 1 for side in range(2)]
        if not any(sides):
            continue
        host, others = field.numpy(), tuple(n for n in range(3) if n != 2 - axis)
        # The usual case, and cheap.
        if max(host.max(), -host.min()) * (dt / part.grid.spacing) <= most:
            continue
        way = np.maximum(host.max(axis=others), -host.min(axis=others)) * (dt / part.grid.spacing)
        face = np.arange(len(way))
        inside = [face - part.owned.low[2 - axis], part.owned.high[2 - axis] - face]
        depth = np.min([d for d, cut in zip(inside, sides, strict=True) if cut], axis=0)
        far = way > np.maximum(most, (depth + most - 1) / 1.75)
        worst = max(worst, float(way[far].max(initial=0.0)))
    return worst


class GhostLayerExchange:
    """Halo exchange of ghost layers during velocity extrapolation.

    The extrapolation calls it after every layer. Ghost layers are filled before wrong values in
    them can reach the box.

    Args:
        part: the subdomain of this rank; its ghost layers have been filled.
    """

    def __init__(self, part: Subdomain) -> None:
        self._part = part
        self._right: dict[int, int] = {}  # number of correct layers, by the field's address

    def __call__(self, marks: wp.array, field: wp.array) -> None:
        """Count a layer of a component; collective.

        If few layers are left correct, it exchanges halos.
        """
        right = self._right.get(field.ptr, self._part.layers) - 1
        if right <= LEAST_RIGHT:
            self._part.fill(marks, field)
            right = self._part.layers
        self._right[field.ptr] = right
