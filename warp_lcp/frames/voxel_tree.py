"""Sparse trees of voxels, as OpenVDB and NanoVDB store them.

A tree has 5, 4 and 3 bits per axis: a root node with one entry, one upper internal node of 32^3
entries, lower internal nodes of 16^3 entries and leaf nodes of 8^3 voxels. An entry is a child node
or a tile: a region of one value, outside or inside a level set.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_lcp.simulation import Volume

LEAF, LOWER, UPPER = 8, 16, 32  # entries along an edge of a node
LARGEST = LEAF * LOWER * UPPER  # voxels along an edge of an upper node


@dataclass(frozen=True)
class VoxelTree:
    """Leaf nodes and lower nodes of a volume, in the order of their positions (x, y, z).

    Args:
        background: value outside: the width of the band of a level set [m], else 0.
        low: first voxel (x, y, z) of each leaf node, shape (leaves, 3).
        values: float32 voxels of the leaf nodes, x slowest, shape (leaves, 512); of a vector field
            (leaves, 512, 3). Those of a level set are clipped to its band.
        active: whether a voxel lies within the band, or is not 0, shape (leaves, 512).
        kinds: entries of the lower nodes, shape (nodes, 4096): 0 a tile outside, -1 one inside,
            else the number of a leaf node, from 1.
        lower_places: entry of each lower node in the upper one.
    """

    background: np.float32
    low: np.ndarray
    values: np.ndarray
    active: np.ndarray
    kinds: np.ndarray
    lower_places: np.ndarray

    @classmethod
    def of(cls, volume: Volume) -> VoxelTree:
        """Return the tree of a volume. Index (i, j, k) is the center of that cell.

        Raises:
            ValueError: the values are not on a 3-D grid, not finite, or more than `LARGEST` along
                an axis.
        """
        values, band = volume.values, volume.band
        if (
            values.ndim not in (3, 4)
            or values.shape[3:] not in ((), (3,))
            or not np.isfinite(values).all()
            or max(values.shape[:3]) > LARGEST
        ):
            raise ValueError(
                f"the volume {volume.name!r} must hold finite values of a 3-D grid, at most "
                f"{LARGEST} along an axis"
            )
        background = np.float32(0.0 if band is None else band)
        blocks = _leaf_blocks(values, background)
        voxels = (3, 4, 5)  # axes
        if values.ndim == 4:
            used = np.asarray(blocks.any(axis=(*voxels, 6)))
            inside = np.zeros_like(used)
        elif band is None:
            used = np.asarray(blocks.max(axis=voxels) > 0.0)
            inside = np.zeros_like(used)
        else:
            inside = np.asarray(blocks.max(axis=voxels) <= -background)
            used = np.asarray(blocks.min(axis=voxels) < background) & ~inside
        stored = blocks[used].reshape(-1, LEAF**3, *values.shape[3:])
        if values.ndim == 4:
            active = np.asarray(stored.any(axis=2))
        elif band is None:
            active = stored > 0.0
        else:
            np.clip(stored, -background, background, out=stored)
            active = np.abs(stored) < background
        kinds, places = _lower_nodes(used, inside)
        return cls(background, LEAF * np.argwhere(used), stored, active, kinds, places)


def _leaf_blocks(values: np.ndarray, background: np.float32) -> np.ndarray:
    """Return the values by blocks of a leaf node, shape (nx, ny, nz, 8, 8, 8), or (..., 3).

    With nx, ny and nz blocks; voxels beyond the grid have the background value.
    """
    nz, ny, nx = counts = [-(-count // LEAF) for count in values.shape[:3]]
    shape = (*(LEAF * count for count in counts), *values.shape[3:])
    padded = np.full(shape, background, dtype=np.float32)
    padded[tuple(slice(count) for count in values.shape)] = values
    split = padded.reshape(nz, LEAF, ny, LEAF, nx, LEAF, *values.shape[3:])
    return split.transpose(4, 2, 0, 5, 3, 1, *range(6, split.ndim))


def _lower_nodes(used: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the entries of the lower nodes, shape (nodes, 4096), and their places."""
    counts = [-(-count // LOWER) for count in used.shape]
    kinds = np.zeros([LOWER * count for count in counts], dtype=np.int64)
    kinds[tuple(slice(count) for count in used.shape)] = np.where(
        used, np.cumsum(used).reshape(used.shape), -1 * inside
    )
    nx, ny, nz = counts
    kinds = kinds.reshape(nx, LOWER, ny, LOWER, nz, LOWER).transpose(0, 2, 4, 1, 3, 5)
    nonempty = kinds.any(axis=(3, 4, 5))
    x, y, z = np.argwhere(nonempty).T
    return kinds[nonempty].reshape(-1, LOWER**3), (x * UPPER + y) * UPPER + z
