"""The inside of a 2-D surface, filled in an image by the even-odd rule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import minimum_filter

from warp_lcp.scene.camera import Viewpoint
from warp_lcp.simulation import Surface


@dataclass(frozen=True)
class Fill:
    """Colors of a filled surface, 0 to 255: at the domain's top, at its bottom, and along the outline."""

    top: tuple[int, int, int]
    bottom: tuple[int, int, int]
    line: tuple[int, int, int]


FILLS = {
    "water": Fill((120, 196, 238), (18, 84, 162), (12, 62, 128)),
    "sand": Fill((222, 184, 122), (170, 124, 70), (120, 82, 42)),
}
LINE = 2  # pixels of the line along the outline, to either side


def fill_outline(surface: Surface, image: np.ndarray, depth: np.ndarray, view: Viewpoint, fill: Fill, size: list[float]) -> np.ndarray:
    """Return an image in which the inside of a surface is filled, deeper in color toward the bottom, where nothing else is drawn.

    Args:
        surface: segments, closed chains of them.
        image: red, green and blue from 0 to 255, shape (height, width, 3).
        depth: of what is in the image, inf where there is nothing, shape (height, width).
        view: what the image was drawn from.
        fill: the colors.
        size: of the domain [m].

    Returns:
        An image as `image`.
    """
    height, width = depth.shape
    at = view.project(np.asarray(surface.points, dtype=np.float64), (width, height))[:, :2]
    inside = inside_outline(at[surface.corners], height, width)
    (left, bottom), (right, top) = view.project(np.array([[0.0, 0.0, 0.0], [*size, 0.0]]), (width, height))[:, :2]
    empty = np.isinf(depth)
    inside &= empty
    share = np.clip((np.arange(height) + 0.5 - top) / (bottom - top), 0.0, 1.0)[:, None]
    row_color = (1.0 - share) * fill.top + share * fill.bottom
    filled = image.copy()
    filled[inside] = np.broadcast_to(row_color[:, None, :], image.shape)[inside].astype(np.uint8)
    wet = inside | ~empty  # no line where the surface meets a solid or a wall
    rows, columns = np.arange(height)[:, None], np.arange(width)
    wet |= (rows > bottom - LINE - 1) | (rows < top + LINE + 1) | (columns < left + LINE + 1) | (columns > right - LINE - 1)
    filled[inside & ~minimum_filter(wet, 2 * LINE + 1, mode="nearest")] = fill.line
    return filled


def inside_outline(segments: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return whether the middle of each pixel is inside: a line to its left crosses the outline an odd number of times.

    Args:
        segments: their ends, x and y down from the upper left corner [pixels], shape (m, 2, 2).
        height: of the image [pixels].
        width: of the image [pixels].

    Returns:
        Booleans, shape (height, width).
    """
    (x0, y0), (x1, y1) = segments[:, 0].T, segments[:, 1].T
    first = np.clip(np.ceil(np.minimum(y0, y1) - 0.5), 0, height).astype(int)  # rows whose middles the segment crosses
    after = np.clip(np.ceil(np.maximum(y0, y1) - 0.5), 0, height).astype(int)
    count = after - first
    own = np.repeat(np.arange(len(segments)), count)
    row = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count) + first[own]
    x = x0[own] + (row + 0.5 - y0[own]) * (x1[own] - x0[own]) / (y1[own] - y0[own])
    column = np.clip(np.ceil(x - 0.5), 0, width).astype(int)
    crossings = np.bincount(row * (width + 1) + column, minlength=height * (width + 1)).reshape(height, width + 1)
    return np.cumsum(crossings, axis=1)[:, :width] % 2 == 1
