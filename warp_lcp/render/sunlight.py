"""Shadows of the lamp in 3-D images, by a shadow map of points.

The map has the point nearest to the lamp in each direction, as in shadow mapping, but from points
instead of pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

if TYPE_CHECKING:
    import pyvista

    from warp_lcp.render.actors import StyledMesh

# Direction from the domain to the lamp.
LIGHT = np.array([0.25, 0.9, 0.45]) / np.linalg.norm([0.25, 0.9, 0.45])
ACROSS = np.linalg.svd(LIGHT[None])[2][1:]  # two directions perpendicular to it
# Bias of the map in widths: a smaller one would shade rough surfaces by themselves.
BEHIND = 5.0
POINTS = 300_000  # most points of the map
SOFT = 1.5  # widths of the edge of a shadow on the floor
# Color of the floor, and darkness of a shadow.
FLOOR, SHADE = np.array([240.0, 240.0, 240.0]), 0.35
FLOOR_POINTS = 160  # along its longest side


class Sunlight:
    """Shadow map of the lamp.

    Args:
        casters: points [m] on objects that cast shadows, each of shape (n, 3), about `width` apart.
        width: resolution of the map [m].
    """

    def __init__(self, casters: Sequence[np.ndarray], width: float) -> None:
        points = np.concatenate([np.zeros((1, 3)), *casters])
        place = points @ ACROSS.T
        self._width, self._low = (
            max(width, float(np.sqrt(np.ptp(place, axis=0).prod() / POINTS))),
            place.min(axis=0),
        )
        # Of two points in one cell the higher one comes last and is kept.
        order = np.argsort(height := points @ LIGHT)[1:]
        place = self._places(points[order])
        nearest = np.full(place.max(axis=0, initial=0) + 1, -np.inf)
        nearest[tuple(place.T)] = height[order]
        self._nearest = np.pad(maximum_filter(nearest, 3), 1, constant_values=-np.inf)

    def reaches(self, points: np.ndarray) -> np.ndarray:
        """Return the lit fraction at points [m], from 0 to 1, shape (n,)."""
        place, height = self._places(points) + 1, points @ LIGHT + BEHIND * self._width
        last, free = np.array(self._nearest.shape) - 1, np.zeros(len(points))
        for shift in np.ndindex(3, 3):
            free += (
                self._nearest[tuple(np.clip(place + shift - np.array([1, 1]), 0, last).T)] <= height
            )
        return cast(np.ndarray, free / 9.0)

    def floor(self, size: Sequence[float]) -> StyledMesh:
        """Return the floor of a domain [m] with the shadows on it, and its options."""
        import pyvista

        step = max(size[0], size[2]) / FLOOR_POINTS
        nx, nz = (max(2, round(side / step)) for side in (size[0], size[2]))
        below = -1e-3 * size[1]
        spacing = (size[0] / (nx - 1), 1.0, size[2] / (nz - 1))
        mesh = pyvista.ImageData(dimensions=(nx, 1, nz), spacing=spacing, origin=(0.0, below, 0.0))
        light = self.reaches(mesh.points).reshape(nz, nx)
        light = gaussian_filter(light, SOFT * self._width / step, mode="nearest").ravel()
        mesh["color"] = (FLOOR * (1.0 - SHADE * (1.0 - light[:, None]))).astype(np.uint8)
        return mesh, {"scalars": "color", "rgb": True, "lighting": False}

    def _places(self, points: np.ndarray) -> np.ndarray:
        return np.floor((points @ ACROSS.T - self._low) / self._width).astype(int)


def scattered(mesh: pyvista.PolyData, width: float) -> np.ndarray:
    """Return points [m] scattered on the triangles of a pyvista mesh, shape (n, 3).

    One point per square of a given width [m].
    """
    if not mesh.n_cells:
        return np.zeros((0, 3))
    corners = np.asarray(mesh.points, dtype=float)[mesh.triangulate().regular_faces]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    rng = np.random.default_rng(4711)
    count = min(POINTS, 2 * int(area.sum() / width**2) + 1)
    own = corners[rng.choice(len(area), count, p=area / area.sum())]
    share = rng.dirichlet(np.ones(3), count)
    return cast(np.ndarray, np.einsum("ni,nij->nj", share, own))
