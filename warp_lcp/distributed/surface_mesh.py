"""The surface that pictures show, of particles that ranks share: each rank has the triangles of the lattice cells in its box."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_lcp.distributed.subdomain import Subdomain
from warp_lcp.grid.marching_cubes import DeviceMesh
from warp_lcp.grid.staggered import Window
from warp_lcp.grid.surface_mesh import SEEN, SurfaceMesh

OUTSIDE = 1.0  # of the surface, in the ring


def surface_layers(parts: int) -> int:
    """Return how many layers of ghost cells the surface takes on a lattice of so many cells along the edge of a cell."""
    return -(-SEEN // parts) + 1


class SharedSurfaceMesh(SurfaceMesh):
    """Wrap particles of several ranks in a surface; `find` is collective, and takes ghosts among the particles.

    A rank finds the surface on its part of the lattice, smooths it there, and keeps the triangles of the cells that have their low node in
    its box, or in the ring beyond the domain's low sides. So every triangle is some rank's, and points on a cut, which two ranks have, are
    the same on both, bit for bit: their smoothing depends on no point beyond the ghost layers.

    Args:
        part: where this rank works; its ghost layers are at least `surface_layers`.
        settings: as of `SurfaceMesh`, the part's grid among them.
    """

    def __init__(self, part: Subdomain, *settings: Any, **more: Any) -> None:
        super().__init__(*settings, **more)
        self._part = part
        each = np.array([self._parts] * 2 + [self._parts if part.dimension == 3 else 1])[::-1]
        low, high = ((np.array(corner) - 1) * each + 1 for corner in (part.owned.low, part.owned.high))
        for axis in range(part.dimension):
            low[2 - axis] -= part.box.low[axis] == 0
        self._kept = Window.of(low.tolist(), high.tolist(), self.lattice.device)

    def _mirror(self, field: wp.array, *, fold: bool = False) -> None:
        super()._mirror(field, fold=fold)
        self._part.fill(field, parts=self._parts)

    def _mesh(self, phi: wp.array, number: wp.array) -> DeviceMesh:
        self._part.fill(phi, parts=self._parts)
        for axis in range(self.lattice.dimension):
            for side in range(2):
                if self._part.cuts >> 2 * axis + side & 1:
                    phi.transpose((2 - axis, *(n for n in range(3) if n != 2 - axis)))[-side].fill_(OUTSIDE)
        mesh = super()._mesh(phi, number)
        kept, device = self._cubes.corners(phi, number, self._kept).numpy(), self.lattice.device
        used, corners = np.unique(kept, return_inverse=True)
        points = wp.array(mesh.points.numpy()[used], dtype=wp.vec3, device=device)
        return DeviceMesh(points, wp.array(corners.reshape(kept.shape), dtype=wp.int32, device=device))
